"""Times of reading records and rig files: `python -m benchmarks.record_reading`.

Prints the shortest CPU time of nine rounds for one record of 13 frames, one position of the flight
log, and one rig file.
"""

from __future__ import annotations

import time
import timeit
from collections.abc import Callable

from daemon.mission.canonical_json import parse_record
from daemon.mission.exposure import (
    Exposure,
    FrameRecord,
    NavigationRecord,
    TemperatureRecord,
    exposure_bytes,
    from_json,
)
from daemon.mission.log.log_records import message_of, record_of
from drivers.contract import NavSample
from processing.rig import load_rig, shipped_rigs

GPS_NS = 1_447_000_003_000_000_000


def example_exposure() -> Exposure:
    """A record of 13 frames, eight temperatures and a position."""
    frames = tuple(
        FrameRecord(
            sensor=f"SU{index:02}",
            head_serial="H1",
            file=f"SU{index:02}.tif",
            sha256="a" * 64,
            width_px=4992,
            height_px=3328,
            pixel_format="Mono16",
            device_ns=123_456_789_012,
            counter=7,
            exposure_time_us=1000.0,
            temperature_c=23.5,
            mono_ns=998_877_665_544,
            mid_exposure_gps_ns=GPS_NS,
            time_sigma_ns=900,
            time_source="event-mark",
            settings={"gain_db": 3.0, "exposure_time_us": 1000.0},
        )
        for index in range(13)
    )
    navigation = NavigationRecord(
        receiver="gnss",
        gps_ns=GPS_NS,
        method="interpolated",
        gap_ns=200_000_000,
        fix="3d",
        satellites=14,
        latitude_deg=47.0,
        longitude_deg=15.0,
        height_m=1000.0,
        horizontal_sigma_m=0.02,
        vertical_sigma_m=0.03,
        velocity_ned_mps=(60.0, 1.0, None),
        speed_sigma_mps=0.01,
    )
    return Exposure(
        number=5,
        mark_gps_ns=GPS_NS,
        mark_source="event-mark",
        time_budget_ns={"mark": 50, "latch": 100},
        frames=frames,
        temperatures=tuple(TemperatureRecord(str(probe), 20.0, 5) for probe in range(8)),
        navigation=navigation,
    )


def main() -> None:
    exposure = example_exposure()
    data = exposure_bytes(exposure)
    content = parse_record(data, "exposure.json")
    sample = NavSample(
        receiver="gnss",
        gps_ns=GPS_NS,
        mono_ns=5,
        fix="3d",
        satellites=14,
        latitude_deg=47.0,
        longitude_deg=15.0,
        height_m=1000.0,
        horizontal_sigma_m=0.02,
        vertical_sigma_m=0.03,
        velocity_ned_mps=(60.0, 1.0, 2.0),
        speed_sigma_mps=0.01,
        roll_rad=0.1,
        pitch_rad=0.2,
        heading_rad=0.3,
        leap_seconds=18,
        time_valid=True,
    )
    message = message_of(sample)
    rig = shipped_rigs()["ultracam-x"]
    assert from_json(content) == exposure
    assert record_of(message) == sample
    steps: dict[str, tuple[Callable[[], object], int]] = {
        "parse_record": (lambda: parse_record(data, "exposure.json"), 300),
        "from_json": (lambda: from_json(content), 300),
        "exposure_bytes": (lambda: exposure_bytes(exposure), 300),
        "record_of": (lambda: record_of(message), 2000),
        "load_rig": (lambda: load_rig(rig), 5),
    }
    for name, (step, count) in steps.items():
        rounds = timeit.repeat(step, number=count, repeat=9, timer=time.process_time)
        print(f"{name:15} {min(rounds) / count * 1e6:9.1f} us")


if __name__ == "__main__":
    main()

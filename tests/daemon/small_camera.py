"""A camera of three tiny heads and what it flies: missions, captures and pixels for the tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon.mission.exposure import CaptureRecord, Exposure, FrameRecord, TemperatureRecord
from daemon.mission.layout import Mission
from daemon.mission.log.log_records import LoggedRecord
from daemon.mission.store.level0_folder import unsealed_exposure
from daemon.mission.store.store import Level0Writer
from drivers.contract import EventMark, TemperatureSample
from processing.rig import Rig, rig_from_mapping

SENSORS = ("SU00", "SU01", "SU10")
WIDTH_PX, HEIGHT_PX = 64, 48
BOOT_ID = "5a0c2a2e-1b5f-4f7e-9d0e-0d6b1f6f0a11"

RIG_TOML = """\
format = 1
name = "small"
timing = "synchronous"
frame_interval_s = 1.0
master_cone = "0"
reference_cone = "0"

[calibration]
id = "small-1"
date = "2026-11-01"
""" + "".join(
    f"""
[[cone]]
name = "{cone}"
role = "pan"
bands = ["pan"]
position_mm = [0, 0, 0]
rotation_rad = [0, 0, 0]
probe = "{cone}"
calibration_c = 20.0

[cone.lens]
f_mm = 100.0
"""
    + "".join(
        f"""
[[cone.sensor]]
name = "{sensor}"
width_px = {WIDTH_PX}
height_px = {HEIGHT_PX}
pitch_um = 7.2
x_mm = 0.0
y_mm = 0.0
"""
        for sensor in sensors
    )
    for cone, sensors in (("0", SENSORS[:2]), ("1", SENSORS[2:]))
)


def small_rig() -> Rig:
    """Two cones, three sensors of 64 x 48 px."""
    import tomllib

    return rig_from_mapping(tomllib.loads(RIG_TOML), "small.toml")


FLOWN_UTC = datetime(2026, 11, 21, 10, 15, tzinfo=UTC)


def new_mission(root: Path, started_utc: datetime = FLOWN_UTC) -> Mission:
    """A mission that has just begun."""
    return Mission.create(
        root,
        "small",
        rig_toml=RIG_TOML.encode(),
        service_toml=b"# flown by a test\n",
        started_utc=started_utc,
    )


def pixels_of(number: int, sensors: Sequence[str] = SENSORS) -> dict[str, NDArray[np.uint16]]:
    """Frames of an exposure, different for each, the same every time."""
    return {
        sensor: np.random.default_rng([number, index])
        .integers(0, 4096, (HEIGHT_PX, WIDTH_PX))
        .astype(np.uint16)
        for index, sensor in enumerate(SENSORS)
        if sensor in sensors
    }


def frame_record(sensor: str, number: int) -> FrameRecord:
    """What the head knew of its frame."""
    return FrameRecord(
        sensor=sensor,
        head_serial=f"S-{sensor}",
        file="",
        sha256="",
        width_px=WIDTH_PX,
        height_px=HEIGHT_PX,
        pixel_format="Mono12",
        device_ns=5_000_000_000_000_000_000 + number,
        counter=number,
        exposure_time_us=4000.0,
        temperature_c=31.5,
        mono_ns=number * 1_000_000_000 + 20_000_000,
        settings={"gain_db": 0.0, "tdi_shifts": 12},
    )


def capture_of(number: int, sensors: Sequence[str] = SENSORS) -> CaptureRecord:
    """An exposure whose frames are here, and not on the disk yet."""
    return CaptureRecord(
        number=number,
        trigger_sequence=number,
        trigger_mono_ns=number * 1_000_000_000,
        trigger_sigma_ns=200_000,
        boot_id=BOOT_ID,
        frames=tuple(frame_record(sensor, number) for sensor in sensors),
        missing=tuple((sensor, "no frame came") for sensor in SENSORS if sensor not in sensors),
        line_id="line-1",
        calibration_id="small-1",
        software="syntopic test",
        simulated=True,
    )


def final_record(stored: CaptureRecord, gps_ns: int = 1_447_000_000_000_000_000) -> Exposure:
    """The record of a stored exposure, with its mark and temperatures."""
    return replace(
        unsealed_exposure(stored),
        mark_gps_ns=gps_ns + stored.number * 1_000_000_000,
        mark_sigma_ns=60,
        mark_source="event-mark",
        mark_count=stored.number,
        temperatures=(TemperatureRecord("0", 32.0, 500_000_000), TemperatureRecord("1", None, 0)),
    )


def store_one(writer: Level0Writer, number: int, sensors: Sequence[str] = SENSORS) -> CaptureRecord:
    """Store an exposure and say how it is stored."""
    capture = capture_of(number, sensors)
    return replace(capture, frames=writer.write(capture, pixels_of(number, sensors)))


def fly(mission: Mission, numbers: Sequence[int]) -> None:
    """Store and seal exposures in order."""
    writer = Level0Writer(mission)
    for number in numbers:
        writer.seal(final_record(store_one(writer, number)))
    writer.close()


def cut_chain_before(mission: Mission, number: int) -> None:
    """Cut the chain file before the first line that names an exposure, as a power cut may."""
    lines = mission.chain_path.read_bytes().splitlines(keepends=True)
    first = next(i for i, line in enumerate(lines) if f'"number":{number},'.encode() in line)
    mission.chain_path.write_bytes(b"".join(lines[:first]))


def mark_of(number: int) -> EventMark:
    """The receiver's mark of an exposure, as it would be logged."""
    return EventMark(
        receiver="gnss",
        channel=0,
        gps_ns=1_447_000_000_000_000_000 + number * 1_000_000_000,
        accuracy_ns=60,
        count=number,
        count_bits=16,
        time_valid=True,
        mono_ns=number * 1_000_000_000 + 300_000_000,
    )


def complete_from_log(stored: CaptureRecord, records: Sequence[LoggedRecord]) -> Exposure:
    """A stand-in for the matching: the mark of the same count, the last temperature of a probe."""
    exposure = unsealed_exposure(stored)
    probes = {r.probe: r for r in records if isinstance(r, TemperatureSample)}
    temperatures = tuple(
        TemperatureRecord(p, r.value_c, stored.trigger_mono_ns - r.mono_ns)
        for p, r in sorted(probes.items())
    )
    for record in records:
        if isinstance(record, EventMark) and record.count == stored.number:
            return replace(
                exposure,
                mark_gps_ns=record.gps_ns,
                mark_sigma_ns=record.accuracy_ns,
                mark_source="event-mark",
                mark_count=record.count,
                temperatures=temperatures,
            )
    return replace(exposure, temperatures=temperatures)

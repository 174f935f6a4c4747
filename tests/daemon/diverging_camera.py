"""A camera of two tiny heads that look apart, and a flown mission of it, for tests of commands."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from daemon.mission.canonical_json import sha256_hex
from daemon.mission.exposure import CaptureRecord, FrameRecord, NavigationRecord, TemperatureRecord
from daemon.mission.layout import Mission
from daemon.mission.store.store import Level0Writer
from tests.daemon.small_camera import final_record

HEADS = ("LEFT", "RIGHT")
WIDTH_PX, HEIGHT_PX = 96, 64
GPS_NS = 1_447_000_000_000_000_000
ROOT = Path(__file__).parents[2]

RIG_TOML = """\
format = 1
name = "diverging"
timing = "synchronous"
frame_interval_s = 1.0
master_cone = "LEFT"
reference_cone = "LEFT"

[calibration]
id = "diverging-1"
date = "2026-11-01"
""" + "".join(
    f"""
[[cone]]
name = "{name}"
role = "pan"
bands = ["pan"]
position_mm = [0, 0, 0]
rotation_rad = [{omega}, 0, 0]
probe = "{name}"
calibration_c = 20.0

[cone.lens]
f_mm = 20.0

[[cone.sensor]]
name = "{name}"
serial = "S-{name}"
width_px = {WIDTH_PX}
height_px = {HEIGHT_PX}
pitch_um = 7.2
x_mm = 0.0
y_mm = 0.0
"""
    for name, omega in zip(HEADS, (-0.3, 0.3), strict=True)
)


SERVICE_TOML = b"[plan]\nground_height_m = 100.0\n"


def flown_mission(
    root: Path, numbers: Sequence[int] = (1, 2, 3, 4), service_toml: bytes = SERVICE_TOML
) -> Mission:
    """A mission whose exposures are stored and sealed, each with time, position and attitude."""
    mission = Mission.create(
        root,
        "diverging",
        rig_toml=RIG_TOML.encode(),
        service_toml=service_toml,
        started_utc=datetime(2026, 11, 21, 10, 15, tzinfo=UTC),
    )
    writer = Level0Writer(mission)
    for number in numbers:
        seed = np.random.default_rng(number)
        pixels = {
            head: seed.integers(200, 4000, (HEIGHT_PX, WIDTH_PX)).astype(np.uint16)
            for head in HEADS
        }
        capture = CaptureRecord(
            number=number,
            trigger_sequence=number,
            frames=tuple(frame_of(head, number) for head in HEADS),
            calibration_id="diverging-1",
            calibration_sha256=sha256_hex(RIG_TOML.encode()),
            simulated=True,
        )
        stored = replace(capture, frames=writer.write(capture, pixels))
        record = final_record(stored, GPS_NS)
        readings = tuple(TemperatureRecord(head, 21.0, 0) for head in HEADS)
        writer.seal(replace(record, temperatures=readings, navigation=navigation_at(number)))
    writer.close()
    return mission


def frame_of(head: str, number: int) -> FrameRecord:
    """What the head knew of its frame."""
    return FrameRecord(
        sensor=head,
        head_serial=f"S-{head}",
        file="",
        sha256="",
        width_px=WIDTH_PX,
        height_px=HEIGHT_PX,
        pixel_format="Mono12",
        device_ns=number * 1_000_000_000,
        counter=number,
        exposure_time_us=2000.0,
        temperature_c=31.5,
        mono_ns=number * 1_000_000_000,
        mid_exposure_gps_ns=GPS_NS + number * 1_000_000_000,
        time_sigma_ns=100,
        time_source="event-mark",
        settings={"TdiShifts": 0},
    )


def navigation_at(number: int) -> NavigationRecord:
    """Eastward at 50 m/s, 900 m above the ground."""
    return NavigationRecord(
        receiver="gnss",
        gps_ns=GPS_NS + number * 1_000_000_000,
        method="interpolated",
        gap_ns=100_000_000,
        fix="3d",
        satellites=12,
        latitude_deg=48.0,
        longitude_deg=11.0 + number * 0.0007,
        height_m=1000.0,
        horizontal_sigma_m=0.02,
        vertical_sigma_m=0.03,
        velocity_ned_mps=(0.0, 50.0, 0.0),
        speed_sigma_mps=0.02,
        roll_rad=0.0,
        pitch_rad=0.0,
        heading_rad=np.pi / 2,
    )


def copied(mission: Mission, folder: Path) -> Mission:
    """A copy of a mission that a test may damage."""
    return Mission.open(Path(shutil.copytree(mission.path, folder / mission.id)))


def syntopic(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command as a user does, without the right to read files whose mode forbids it."""
    return subprocess.run(
        [sys.executable, "-m", "daemon", *arguments],
        capture_output=True, text=True, timeout=300, cwd=ROOT, check=False,
        preexec_fn=_without_override if os.geteuid() == 0 else None,
    )  # fmt: skip


def _without_override() -> None:
    """Give up the capabilities by which root reads and writes whatever it likes.

    Source: capabilities(7), CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH; prctl(2), PR_CAPBSET_DROP.
    """
    import ctypes

    for capability in (1, 2):
        ctypes.CDLL(None).prctl(24, capability, 0, 0, 0)

"""Reading an exposure's Level-0 folder back: its record, its frames, and their hashes.

The folder may be ours or laid out by hand (docs/reference/formats.md). Writing is in
`daemon.mission.store.store`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon.mission.canonical_json import RECORD_MAX_BYTES, RecordError, parse_record, sha256_hex
from daemon.mission.exposure import (
    CaptureRecord,
    Exposure,
    FrameRecord,
    RecordState,
    capture_from_json,
    from_json,
)
from daemon.mission.store.frame_checks import mismatches
from daemon.mission.store.frame_files import frame_files, other_spelling
from daemon.mission.store.level0 import RasterError, read_frame
from processing.rig import Rig, Sensor

EXPOSURE_FILE = "exposure.json"
CAPTURE_FILE = "capture.json"
_BLOCK_BYTES = 4 << 20


@dataclass(frozen=True)
class SealedRecord:
    """An exposure's record as stored on disk, with the hash of its bytes."""

    exposure: Exposure
    sha256: str


def read_sealed(folder: Path) -> SealedRecord | None:
    """The final record of an exposure, or None where it is not sealed.

    Raises:
        RecordError: the record is damaged, or belongs to another exposure.
    """
    data = _read_small(folder / EXPOSURE_FILE)
    if data is None:
        return None
    name = f"{folder.name}/{EXPOSURE_FILE}"
    exposure = from_json(parse_record(data, name), name)
    if folder.name.isdigit() and int(folder.name) != exposure.number:
        raise RecordError([f"{name}: number is {exposure.number}; the folder is {folder.name}"])
    return SealedRecord(exposure, sha256_hex(data))


def read_capture(folder: Path) -> CaptureRecord | None:
    """The record from when the pixels became durable, or None for a foreign folder.

    Raises:
        RecordError: the record is damaged.
    """
    data = _read_small(folder / CAPTURE_FILE)
    if data is None:
        return None
    name = f"{folder.name}/{CAPTURE_FILE}"
    return capture_from_json(parse_record(data, name), name)


def unsealed_exposure(capture: CaptureRecord) -> Exposure:
    """An exposure that is not sealed yet: no mark, no navigation, no temperatures."""
    known = {field.name: getattr(capture, field.name) for field in fields(CaptureRecord)}
    state: RecordState = "degraded" if capture.missing else "complete"
    return Exposure(**known, state=state if capture.frames else "lost")


def load_level0(
    folder: Path,
    rig: Rig,
    *,
    calibration_sha256: str = "",
    read: Callable[[Path], bytes] = Path.read_bytes,
) -> tuple[dict[str, NDArray[np.uint16]], Exposure]:
    """Read the frames of an exposure, flown or laid out by hand, for a rig.

    Each file is read once and hashed as it is read; it is compared with its record and with the
    rig (`daemon.mission.store.frame_checks`).

    What the record does not say is filled in: without `frames` the TIFF of each sensor is
    taken (`daemon.mission.store.frame_files`); sensors without a file are listed as missing.

    Args:
        folder: such as `L0/000001`.
        rig: names the sensors and their sizes.
        calibration_sha256: hash of the rig file; refuse an exposure whose record names another.
        read: content of a frame's file; frames may be elsewhere than their names.

    Returns:
        Pixels by sensor, shape (height, width), and the exposure.

    Raises:
        RecordError: a record or frames that cannot be used, one sentence per mistake.
    """
    if not folder.is_dir():
        raise RecordError([f"{folder}: no such folder; give the folder of an exposure"])
    exposure = _record_or_defaults(folder)
    records = list(exposure.frames)
    if not records and exposure.state != "lost":
        files = frame_files(folder, [sensor.name for sensor in rig.sensors])
        records = [_default_frame(rig.sensor(name), file) for name, file in files.items()]
    frames: dict[str, NDArray[np.uint16]] = {}
    loaded: list[FrameRecord] = []
    missing = dict(exposure.missing)
    problems: list[str] = []
    if calibration_sha256 and exposure.calibration_sha256 not in ("", calibration_sha256):
        problems.append(
            f"{folder.name}: was flown with calibration {exposure.calibration_id or '(unnamed)'}, "
            f"SHA-256 {exposure.calibration_sha256[:12]}...; the mission's rig file has "
            f"{calibration_sha256[:12]}...: put the rig file of the flight back, or choose another "
            "calibration with --rig"
        )
    sensors = {sensor.name: sensor for sensor in rig.sensors}
    for record in records:
        sensor = sensors.get(record.sensor)
        if sensor is None:
            known = ", ".join(sensors)
            problems.append(f"{folder.name}: sensor {record.sensor!r}; rig {rig.name} has {known}")
            continue
        path = folder / (record.file or f"{record.sensor}.tif")
        if not path.exists():
            if other := other_spelling(path):
                problems.append(
                    f"{folder.name}/{other}: the record names it {path.name}; rename it"
                )
            missing.setdefault(record.sensor, f"{path.name} is not in its folder")
            continue
        try:
            frame = read_frame(
                path, width_px=sensor.width_px, height_px=sensor.height_px, read=read
            )
        except RasterError as error:
            problems.append(f"{folder.name}: {error}")
            continue
        problems += [
            f"{folder.name}/{path.name}: {problem}"
            for problem in mismatches(exposure.number, record, sensor, frame)
        ]
        frames[record.sensor] = frame.pixels
        height_px, width_px = frames[record.sensor].shape
        loaded.append(replace(record, file=path.name, width_px=width_px, height_px=height_px))
    if problems:
        raise RecordError(problems)
    for sensor in rig.sensors:
        if sensor.name not in frames:
            missing.setdefault(sensor.name, "no frame in the folder")
    state: RecordState = "lost" if not frames else "degraded" if missing else exposure.state
    return frames, replace(
        exposure, frames=tuple(loaded), missing=tuple(missing.items()), state=state
    )


def hash_file(path: Path, progress: Callable[[int], None] | None = None) -> str:
    """SHA-256 of a file, lower-case hexadecimal; `progress` gets the bytes of each step."""
    digest = hashlib.sha256()
    buffer = bytearray(_BLOCK_BYTES)
    view = memoryview(buffer)
    with path.open("rb", buffering=0) as file:
        while count := file.readinto(buffer):
            digest.update(view[:count])
            if progress is not None:
                progress(count)
    return digest.hexdigest()


def _record_or_defaults(folder: Path) -> Exposure:
    sealed = read_sealed(folder)
    if sealed is not None:
        return sealed.exposure
    capture = read_capture(folder)
    if capture is not None:
        return unsealed_exposure(capture)
    return Exposure(number=int(folder.name) if folder.name.isdigit() and int(folder.name) else 1)


def _default_frame(sensor: Sensor, file: str) -> FrameRecord:
    return FrameRecord(
        sensor=sensor.name,
        head_serial=sensor.serial,
        file=file,
        sha256="",
        width_px=sensor.width_px,
        height_px=sensor.height_px,
        pixel_format="Mono16",
        device_ns=None,
        counter=None,
        exposure_time_us=None,
        temperature_c=None,
        mono_ns=0,
    )


def _read_small(path: Path) -> bytes | None:
    try:
        with path.open("rb") as file:
            return file.read(RECORD_MAX_BYTES + 1)
    except FileNotFoundError:
        return None
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise RecordError([f"{path}: cannot be read ({reason})"]) from error

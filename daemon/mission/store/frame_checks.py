"""Whether a frame is what its record and its rig say, and whether its settings are possible.

Compared is what is given on both sides; what a record written by hand leaves out is not compared
(docs/reference/formats.md).
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from daemon.mission.canonical_json import RecordError
from daemon.mission.exposure import FrameRecord
from daemon.mission.store.level0 import DecodedFrame
from processing.rig import Sensor

EXPOSURE_TIME_MAX_US = 600e6
TDI_SETTING = "TdiShifts"
UNSPECIFIC_FORMAT = "Mono16"
"""Format of a record that names no pixel format: 16-bit words of any content."""

_FORMAT = re.compile(r"(?P<kind>[A-Za-z]+?)(?P<bits>8|1[0-6])(p|P|Packed)?")
_BAYER = {"BayerRG": "RGGB", "BayerBG": "BGGR", "BayerGR": "GRBG", "BayerGB": "GBRG"}
_BAYER |= {f"S{pattern}": pattern for pattern in _BAYER.values()}  # as V4L2 calls them


def mismatches(
    number: int, record: FrameRecord, sensor: Sensor, frame: DecodedFrame
) -> Iterator[str]:
    """Mismatches of a frame with its record or its rig, one message each.

    Args:
        number: of the exposure.
        record: the exposure's record of the frame.
        sensor: of the rig it is processed with.
        frame: as its file holds it.
    """
    if record.sha256 and record.sha256 != frame.sha256:
        yield "was altered after it was stored: its SHA-256 differs from the record's"
    if record.head_serial and sensor.serial and record.head_serial != sensor.serial:
        yield f"is of head {record.head_serial}; the rig has head {sensor.serial} there"
    for what, found, wanted in (
        ("width_px", record.width_px, sensor.width_px),
        ("height_px", record.height_px, sensor.height_px),
    ):
        if found and found != wanted:
            yield f"{what} is {found} in the record; the sensor and the file have {wanted}"
    yield from _format_mismatches(record.pixel_format, sensor)
    if frame.description.get("syntopic") == 1:
        yield from _description_mismatches(number, record, frame)
    yield from setting_problems(record, sensor)


def setting_problems(record: FrameRecord, sensor: Sensor) -> Iterator[str]:
    """Exposure times and TDI counts that are impossible, one message each."""
    time_us = record.exposure_time_us
    if time_us is not None and not 0.0 < time_us <= EXPOSURE_TIME_MAX_US:
        yield (
            f"exposure_time_us is {time_us:g}; an exposure time is positive and "
            f"{EXPOSURE_TIME_MAX_US:g} at most, null where it is not known"
        )
    shifts = record.settings.get(TDI_SETTING, 0)
    if isinstance(shifts, str) or shifts != int(shifts) or not 0 <= shifts < sensor.height_px:
        yield (
            f"settings.{TDI_SETTING} is {shifts!r}; a whole number from 0 to "
            f"{sensor.height_px - 1} is possible, the rows of the sensor less one"
        )
    elif shifts and sensor.colour_filter_array != "none":
        yield (
            f"settings.{TDI_SETTING} is {shifts}; a sensor with a colour filter array has no TDI"
        )


def tdi_shifts(record: FrameRecord, sensor: Sensor) -> int:
    """TDI shifts of a frame; 0 where its record has none.

    Raises:
        RecordError: the count, or the exposure time, cannot be.
    """
    if problems := [f"{record.sensor}: {problem}" for problem in setting_problems(record, sensor)]:
        raise RecordError(problems)
    return int(record.settings.get(TDI_SETTING, 0))


def _format_mismatches(pixel_format: str, sensor: Sensor) -> Iterator[str]:
    found = _FORMAT.fullmatch(pixel_format)
    if found is None:
        return
    if int(found["bits"]) < sensor.bits:
        yield f"pixel_format is {pixel_format}; the rig's sensor has {sensor.bits} bits"
    pattern = _BAYER.get(found["kind"])
    if pattern is not None and pattern != sensor.colour_filter_array:
        yield (
            f"pixel_format is {pixel_format}, which is {pattern}; the rig's sensor has "
            f"colour_filter_array {sensor.colour_filter_array}"
        )


def _description_mismatches(number: int, record: FrameRecord, frame: DecodedFrame) -> Iterator[str]:
    """Compare the file's own description with the record, where both have a value."""
    recorded = {
        "exposure": number,
        "sensor": record.sensor,
        "head_serial": record.head_serial or None,
        "pixel_format": None if record.pixel_format == UNSPECIFIC_FORMAT else record.pixel_format,
        "exposure_time_us": record.exposure_time_us,
        "device_ns": None if record.device_ns is None else str(record.device_ns),
        "counter": record.counter,
        TDI_SETTING: record.settings.get(TDI_SETTING),
    }
    settings = frame.description.get("settings")
    stored_values = {**frame.description, **(settings if isinstance(settings, dict) else {})}
    for key, wanted in recorded.items():
        found = stored_values.get(key)
        if found not in (None, "") and wanted is not None and found != wanted:
            yield f"its file has {key} {found!r}; the record has {wanted!r}"

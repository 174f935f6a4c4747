"""Answers about the optics and the arrangement of a new rig: units, limits and plausibility."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from daemon import DaemonError
from drivers.cameras.head_description import HeadDescription

FOCAL_LENGTH_MM: Final = (1.0, 2000.0)
PIXEL_SIZE_UM: Final = (0.5, 50.0)
SENSOR_SIDE_MAX_MM: Final = 150.0
FIELD_OF_VIEW_DEG: Final = (0.2, 140.0)
ANGLE_DEG: Final = (0.0, 75.0)
DISTANCE_MM: Final = (0.0, 5000.0)
INTERVAL_S: Final = (0.05, 3600.0)
_LENGTHS_M: Final = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "nm": 1e-9}
_NUMBER: Final = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?: *(mm|cm|um|µm|nm|m))?")


class AnswerError(DaemonError, ValueError):
    """An answer that cannot be right; the message states why and what would be."""


class Arrangement(StrEnum):
    """How the heads of a rig stand to each other."""

    SINGLE = "single"
    SIDE_BY_SIDE = "side-by-side"
    FORE_AFT = "fore-aft"
    NADIR_OBLIQUE = "nadir-oblique"


@dataclass(frozen=True)
class Answers:
    """What a person states about a rig.

    Heads are in the order of the arrangement: from left to right, from front to back, or nadir,
    front, right, back, left. `focal_lengths_mm` and `pixel_sizes_um` have one value for each.
    `angle_deg` is between the axes of neighbouring heads, or between nadir and oblique ones.
    """

    name: str
    arrangement: Arrangement
    heads: Sequence[HeadDescription]
    focal_lengths_mm: Sequence[float]
    pixel_sizes_um: Sequence[float]
    angle_deg: float = 0.0
    distance_mm: float = 0.0
    interval_s: float = 2.0


def lengths(text: str, unit: str, count: int | None) -> tuple[float, ...]:
    """Lengths of all heads from one answer, in `unit` where they state none.

    Args:
        text: one number for all heads, or one for each, separated by spaces.
        unit: "mm" or "um".
        count: number of heads; None where it is not known yet.

    Raises:
        AnswerError: no number, or a number of values that is neither 1 nor `count`.

    Example:
        >>> lengths("50", "mm", 2), lengths("0.05 m", "mm", 1), lengths("50 51.5", "mm", 2)
        ((50.0, 50.0), (50.0,), (50.0, 51.5))
    """
    if "," in text:
        raise AnswerError(
            f"{text!r} has a comma; write a decimal point, and a space between the values of heads"
        )
    rest, values = text.strip(), []
    while rest:
        found = _NUMBER.match(rest)
        if found is None or (found.end() < len(rest) and not rest[found.end()].isspace()):
            raise AnswerError(f"{text!r} is no number in {unit}; write a value such as 50 or 50 mm")
        factor = _LENGTHS_M[found[2] or unit] / _LENGTHS_M[unit]
        values.append(round(float(found[1]) * factor, 9))
        rest = rest[found.end() :].lstrip()
    if not values or (count is not None and len(values) not in (1, count)):
        given = f"{len(values)} values" if values else "no value"
        each = "one for each head" if count is None else f"one for each of {count}"
        raise AnswerError(f"{text!r} has {given}; give one for all heads, or {each}")
    return tuple(values) * ((count or 1) if len(values) == 1 else 1)


def focal_length_mm(value: float) -> float:
    """A focal length in mm that a lens has.

    Raises:
        AnswerError: it is out of range; the message names the unit that was probably meant.
    """
    return _in_range(value, FOCAL_LENGTH_MM, "focal length", ("um", "mm", "m"))


def pixel_size_um(value: float) -> float:
    """A pixel size in um that a sensor has.

    Raises:
        AnswerError: it is out of range; the message names the unit that was probably meant.
    """
    return _in_range(value, PIXEL_SIZE_UM, "pixel size", ("nm", "um", "mm"))


def _in_range(
    value: float, limits: tuple[float, float], what: str, units: tuple[str, str, str]
) -> float:
    """The value, in the middle one of three units that are a thousand apart."""
    (low, high), (smaller, unit, larger) = limits, units
    if low <= value <= high:
        return value
    sentence = f"a {what} of {value:g} {unit} is outside {low:g} to {high:g} {unit}"
    if 0 < value < low:
        meant, factor = larger, 1000.0
    elif value > high:
        meant, factor = smaller, 1e-3
    else:
        raise AnswerError(sentence)
    right = f"{value * factor:g}"
    raise AnswerError(f"{sentence}; {value:g} {meant} would be {right} {unit}: write {right}")


def in_range(value: float, limits: tuple[float, float], what: str, unit: str) -> float:
    """The value; AnswerError where it is outside the limits or no finite number."""
    low, high = limits
    if not low <= value <= high:
        raise AnswerError(f"{what} is {value:g} {unit}; it is {low:g} to {high:g} {unit}")
    return value


def side_mm(head: HeadDescription, pixel_um: float) -> tuple[float, float]:
    """Width and height of the pixels that a head delivers, mm."""
    return head.width_px * pixel_um * 1e-3, head.height_px * pixel_um * 1e-3


def field_of_view_deg(head: HeadDescription, focal_mm: float, pixel_um: float) -> float:
    """Angle that the wider side of a head sees."""
    return math.degrees(2.0 * math.atan(max(side_mm(head, pixel_um)) / (2.0 * focal_mm)))


def optics_problem(head: HeadDescription, focal_mm: float, pixel_um: float) -> str | None:
    """A sentence where size and focal length make no camera; None where they may.

    A number of another unit within the limits of its own often fails here.
    """
    side = max(side_mm(head, pixel_um))
    pixels = f"{head.width_px} x {head.height_px} pixels of {pixel_um:g} um"
    if side > SENSOR_SIDE_MAX_MM:
        return (
            f"{pixels} would be a sensor of {side:.0f} mm; check the pixel size (um) of "
            f"{head.model or 'the head'}"
        )
    angle = field_of_view_deg(head, focal_mm, pixel_um)
    low, high = FIELD_OF_VIEW_DEG
    if low <= angle <= high:
        return None
    return (
        f"{pixels} behind a focal length of {focal_mm:g} mm see {angle:.2g} degrees; check focal "
        "length (mm) and pixel size (um)"
    )


def arrangement_problem(arrangement: Arrangement, count: int) -> str | None:
    """A sentence where so many heads cannot stand like this."""
    low, high = {
        Arrangement.SINGLE: (1, 1),
        Arrangement.SIDE_BY_SIDE: (2, 16),
        Arrangement.FORE_AFT: (2, 16),
        Arrangement.NADIR_OBLIQUE: (2, 5),
    }[arrangement]
    if low <= count <= high:
        return None
    wanted = f"{low}" if low == high else f"{low} to {high}"
    return f"arrangement {arrangement.value} has {wanted} heads, and {count} are chosen"

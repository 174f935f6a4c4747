"""Other readings of orientations and image measurements, of which rays meet better in one.

Neither BINGO nor PATB states axes, units and directions in its files. Where rays miss each other,
others are tried, and the one that explains it is named.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.exchange.block import BlockCamera, BlockError, BlockImage
from daemon.postflight.exchange.intersected_points import Measured, intersected

Array = NDArray[np.float64]

TRIED_PX: Final = 1.0
"""Median misfit above which other readings are tried."""
_BETTER: Final = 0.5
"""Share of it below which another reading is the right one."""
_ALIKE_PX: Final = 0.02
_POINTS: Final = 400
_EXCHANGED: Final = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Reading:
    """Rotations (3, 3) of images by name, with what they are read as, and what to correct."""

    name: str
    cure: str
    rotations: Callable[[], Mapping[str, Array]]


def refuse_other_reading(
    folder: Path,
    cameras: Sequence[BlockCamera],
    images: Sequence[BlockImage],
    measured: Mapping[str, Measured],
    median_px: float,
    readings: Iterable[Reading],
) -> None:
    """Refuse a block whose rays meet clearly better in another reading.

    The rays of images that look down with small angles meet within pixels with a wrong unit, too.

    Args:
        folder: of the files, for the message.
        cameras: of the block.
        images: as read, in the order of `measured`.
        measured: of each image.
        median_px: misfit as read.
        readings: of the angles or matrices.

    Raises:
        BlockError: such a reading, with both misfits.
    """
    some = _some(measured)
    found: list[tuple[float, str, str]] = []

    def tried(
        name: str, cure: str, own: Sequence[BlockImage], points: Mapping[str, Measured]
    ) -> None:
        try:
            _, misfit_px = intersected(folder, cameras, own, points)
        except BlockError:
            return
        found.append((misfit_px, name, cure))

    for reading in readings:
        turns = reading.rotations()
        own = [replace(one, rotation=turns[key]) for one, key in zip(images, measured, strict=True)]
        tried(reading.name, reading.cure, own, some)
    for name, cure, own in _of_images(images):
        tried(name, cure, own, some)
    pitch = cameras[images[0].camera].pitch_mm or 1.0
    for name, cure, change in _of_measurements(pitch):
        tried(name, cure, images, _changed(some, change))
    if not found:
        return
    # Several may fit alike, such as both orders of small angles: the first is the simplest.
    alike_px = min(found)[0] + _ALIKE_PX
    misfit_px, name, cure = next(one for one in found if one[0] <= alike_px)
    if misfit_px < _BETTER * median_px:
        as_read = (
            f"as read the rays miss each other by {median_px:.2f} px (median)"
            if math.isfinite(median_px)
            else "as read rays meet behind the cameras, or measurements lie outside of their images"
        )
        raise BlockError(
            f"{folder}: {as_read}, with {name} they miss each other by {misfit_px:.2f} px; {cure}"
        )


def _of_images(
    images: Sequence[BlockImage],
) -> Iterator[tuple[str, str, list[BlockImage]]]:
    """Directions and columns of orientations that are exchanged."""
    yield (
        "transposed rotations",
        "write them from the camera to the grid",
        [replace(one, rotation=one.rotation.T) for one in images],
    )
    yield (
        "X and Y of the places exchanged",
        "write easting before northing, as the format has it",
        [replace(one, centre_m=_EXCHANGED @ one.centre_m) for one in images],
    )


def _of_measurements(
    pitch_mm: float,
) -> Iterator[tuple[str, str, Callable[[float, float], tuple[float, float]]]]:
    """Axes and units of measurements."""
    axes = "write x right, y up, in mm from the middle of the image"
    yield "y of the measurements reversed", axes, lambda x, y: (x, -y)
    yield "x of the measurements reversed", axes, lambda x, y: (-x, y)
    yield "x and y of the measurements reversed", axes, lambda x, y: (-x, -y)
    yield "x and y of the measurements exchanged", axes, lambda x, y: (y, x)
    yield "the measurements in um", axes, lambda x, y: (x * 1e-3, y * 1e-3)
    yield "the measurements in px", axes, lambda x, y: (x * pitch_mm, y * pitch_mm)


def _changed(
    measured: Mapping[str, Measured], change: Callable[[float, float], tuple[float, float]]
) -> dict[str, Measured]:
    return {
        name: replace(one, points={point: change(*xy) for point, xy in one.points.items()})
        for name, one in measured.items()
    }


def _some(measured: Mapping[str, Measured]) -> dict[str, Measured]:
    """A part of the points, spread over those measured in two images or more."""
    count: dict[str, int] = {}
    for one in measured.values():
        for point in one.points:
            count[point] = count.get(point, 0) + 1
    names = [point for point, rays in count.items() if rays > 1]
    kept = set(names[:: 1 + len(names) // _POINTS])
    return {
        name: replace(one, points={p: xy for p, xy in one.points.items() if p in kept})
        for name, one in measured.items()
    }

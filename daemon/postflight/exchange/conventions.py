"""Other conventions of a block's files, each with the sentence that names it.

Axes and principal point of measurements; direction and axes of poses; columns and unit of points.
Which of them a file has is decided by the projections (`reprojections.py`), not here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import permutations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.exchange.block import VISION_FROM_CAMERA
from daemon.postflight.exchange.colmap import camera_pose, vision_pose
from processing.geometry.rotation import quaternions_from_rotations, rotations_from_quaternions

Array = NDArray[np.float64]

_AXES: Final[tuple[tuple[str, tuple[tuple[int, int], tuple[int, int]]], ...]] = (
    ("their y is reversed", ((1, 0), (0, -1))),
    ("their x is reversed", ((-1, 0), (0, 1))),
    ("their x and y are reversed", ((-1, 0), (0, -1))),
    ("their columns and rows are exchanged", ((0, 1), (1, 0))),
    ("they are turned by 90 degrees", ((0, -1), (1, 0))),
    ("they are turned by 90 degrees", ((0, 1), (-1, 0))),
    ("their columns and rows are exchanged and reversed", ((0, -1), (-1, 0))),
)
WRITE_AXES: Final = "write them with the axes of the format"
_WRITE_POSES: Final = "write the orientations as the format has them"
_WRITE_POINTS: Final = "write the points in the system of the orientations"
_UNITS: Final = (
    ("in metres and the orientations in feet", 1.0 / 0.3048),
    ("in feet and the orientations in metres", 0.3048),
    ("in metres and the orientations in millimetres", 1e3),
    ("in millimetres and the orientations in metres", 1e-3),
)


@dataclass(frozen=True)
class Explanation:
    """A sentence's middle, `what`, and its end, `cure`."""

    what: str
    cure: str


@dataclass(frozen=True)
class Convention:
    """Another reading of measurements: `of` gives the pixels (n, 2) in the block's convention."""

    why: Explanation
    of: Callable[[Array], Array]


def of_measurements(centre: Array, size: Array) -> Iterator[Convention]:
    """Axes that are reversed, turned or exchanged, and an exchanged principal point.

    Args:
        centre: principal point of each measurement, px, shape (n, 2).
        size: columns and rows of its image, shape (n, 2).
    """
    for name, rows in _AXES:
        turn = np.array(rows, float)
        why = Explanation(name, WRITE_AXES)
        yield Convention(why, partial(_turned, turn, centre, centre))
        # From the corner of the image: a reversed axis begins at the other side.
        start = np.where((turn < 0.0).any(axis=1), size - 1.0, 0.0)
        yield Convention(why, partial(_turned, turn, np.zeros(2), start))
    why = Explanation("x and y of the principal point are exchanged", "correct the camera")
    yield Convention(why, lambda px: px - centre[:, ::-1] + centre)


def _turned(turn: Array, about: Array, start: Array, px: Array) -> Array:
    return np.asarray(start + (px - about) @ turn.T)


def of_poses(rotation: Array, place: Array) -> Iterator[tuple[Explanation, Array, Array]]:
    """Poses that were written in the other direction, with other axes, or in another order.

    Args:
        rotation: frame_from_camera of each image, shape (n, 3, 3).
        place: its projection centre, shape (n, 3).

    Yields:
        The explanation, rotations and places.
    """
    turn, shift = (np.array(part) for part in zip(*map(vision_pose, rotation, place), strict=True))
    back = turn.transpose(0, 2, 1)

    def posed(turns: Array, shifts: Array) -> tuple[Array, Array]:
        both = [camera_pose(one, other) for one, other in zip(turns, shifts, strict=True)]
        return np.array([one for one, _ in both]), np.array([one for _, one in both])

    yield (
        Explanation(
            "the orientations are those of the world from the camera, and those of the camera from "
            "the world are read",
            _WRITE_POSES,
        ),
        *posed(back, -np.einsum("nij,nj->ni", back, shift)),
    )
    yield (
        Explanation("the rotations are transposed", _WRITE_POSES),
        *posed(back, shift),
    )
    yield (
        Explanation("the translations are the projection centres", _WRITE_POSES),
        *posed(turn, -np.einsum("nij,nj->ni", turn, shift)),
    )
    yield (
        Explanation("y and z of the camera axes are reversed", _WRITE_POSES),
        rotation @ VISION_FROM_CAMERA,
        place,
    )
    ordered = np.roll(quaternions_from_rotations(turn), 1, axis=1)
    yield (
        Explanation("the quaternions are x, y, z, w, and w, x, y, z are read", _WRITE_POSES),
        *posed(np.array([rotations_from_quaternions(one) for one in ordered]), shift),
    )


def of_points(xyz: Array) -> Iterator[tuple[Explanation, Array]]:
    """Columns that are exchanged or reversed, and other units; coordinates (n, 3)."""
    for order in list(permutations(range(3)))[1:]:
        moved = [name for k, name in enumerate("XYZ") if order[k] != k]
        what = f"columns {', '.join(moved[:-1])} and {moved[-1]} of the points are exchanged"
        yield Explanation(what, _WRITE_POINTS), xyz[:, order]
    for k, name in enumerate("XYZ"):
        what = f"{name} of the points is reversed"
        yield Explanation(what, _WRITE_POINTS), np.asarray(xyz * np.where(np.arange(3) == k, -1, 1))
    for unit, factor in _UNITS:
        yield Explanation(f"the points are {unit}", _WRITE_POINTS), np.asarray(xyz * factor)

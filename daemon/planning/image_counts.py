"""Number of images that see each point of a planned line's strip, by band and valid pixels.

A point of the ground is followed back into each image by the homography of its footprint, over
relief along the ray to the projection centre. There it is seen if it is in the image's valid area.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from daemon.planning.model import LocalPlane, PlannedLine, Point
from processing.quality.valid_area import ValidArea

Array: TypeAlias = NDArray[np.float64]
Flags: TypeAlias = NDArray[np.bool_]
Counts: TypeAlias = NDArray[np.int16]
Relief: TypeAlias = Callable[[Array], Array]
"""Metres above the level ground of the footprints, (...), of points (..., 2): latitude and
longitude, degrees."""

ACROSS_MIN_POINTS = 9
"""Minimum number of points across a strip."""
MAX_POINTS_PER_IMAGE = 256
"""Points are so many to the length of an image, not closer than `STEP_M`."""
MIN_POINTS_PER_IMAGE = 16
"""No fewer points than these to the length of an image, however small it is."""
STEP_M = 2.0
"""Resolution of coverage; a narrower hole is ignored."""

_EDGE = 1e-9
_CORNERS = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
"""Of an image, as shares of its width and height from the top left, in the order of a footprint."""


@dataclass(frozen=True)
class ExposureFootprint:
    """An exposure as the advisor sees it.

    `corners` is its footprint on level ground: left and right behind, right and left ahead; empty
    where position or attitude are not known. `exclusion_reason` is why it does not count, such as
    "refly" or "tilted"; empty where it does. `area` is its valid area, None where all of it is
    valid; `partly` names the causes of the gaps. `eye` is the projection centre and its height
    above the level ground, metres; without it relief is left out.
    """

    number: int
    corners: tuple[Point, ...]
    exclusion_reason: str = ""
    area: ValidArea | None = None
    gap_cause: str = ""
    projection_centre: tuple[Point, float] | None = None


@dataclass(frozen=True)
class LineStrip:
    """The ground that a line must see: points along and across it, metres.

    `relief_m` (n, m) is above level ground; None is level. `cell_m` is the extent
    of a point's cell along and across.
    """

    start: Array
    ahead: Array
    length_m: float
    along: Array
    across: Array
    relief_m: Array | None
    cell_m: tuple[float, float]

    @property
    def left(self) -> Array:
        return np.array([-self.ahead[1], self.ahead[0]])

    @property
    def points(self) -> Array:
        """In the plane, (n, m, 2)."""
        along, across = self.along[:, None, None], self.across[None, :, None]
        return np.asarray(self.start + along * self.ahead + across * self.left)

    def place(self, along_m: float, across_m: float) -> Array:
        """In the plane."""
        return np.asarray(self.start + along_m * self.ahead + across_m * self.left)


@dataclass(frozen=True)
class StripCoverage:
    """The points of a strip that an image may see, `where` in its rows and columns.

    `inside` are those within its footprint, `gaps` those of them without valid pixels, by band.
    """

    taken: ExposureFootprint
    where: tuple[slice, slice]
    inside: Flags
    gaps: Mapping[str, Flags] = field(default_factory=dict)


def strip_of(
    line: PlannedLine,
    plane: LocalPlane,
    *,
    half_width_m: float,
    image_along_m: float,
    relief: Relief | None = None,
) -> LineStrip | None:
    """The strip of a line; None where the line has no length."""
    start, end = np.array(plane.flat(line.start)), np.array(plane.flat(line.end))
    length_m = float(np.hypot(*(end - start)))
    if length_m == 0.0:
        return None
    ahead = (end - start) / length_m
    step_m = min(
        max(STEP_M, image_along_m / MAX_POINTS_PER_IMAGE), image_along_m / MIN_POINTS_PER_IMAGE
    )
    along = np.arange(0.0, length_m + step_m / 2, step_m)
    count = max(ACROSS_MIN_POINTS, round(2 * half_width_m / step_m) + 1)
    across = np.linspace(-half_width_m, half_width_m, count)
    strip = LineStrip(
        start=start,
        ahead=ahead,
        length_m=length_m,
        along=along,
        across=across,
        relief_m=None,
        cell_m=(step_m, 2 * half_width_m / (count - 1)),
    )
    if relief is None:
        return strip
    return replace(strip, relief_m=relief(_degrees(plane, strip.points)))


@dataclass(frozen=True)
class FlightFootprints:
    """Exposures and their footprints in a plane, (n, 4, 2) metres."""

    taken: Sequence[ExposureFootprint]
    corners_m: Array
    projection_centres_m: Sequence[tuple[Array, float] | None]

    def near(self, strip: LineStrip) -> tuple[ExposureFootprint, ...]:
        """Those whose footprint may touch a strip, in their order."""
        return tuple(self.taken[k] for k in self._near(strip))

    def _near(self, strip: LineStrip) -> Sequence[int]:
        offset_m = self.corners_m - strip.start
        reach, across_m = offset_m @ strip.ahead, offset_m @ strip.left
        margin_m = np.array(
            [
                _shift_m(strip, c, e)
                for c, e in zip(self.corners_m, self.projection_centres_m, strict=True)
            ]
        )
        near = reach.max(axis=1) + margin_m >= 0.0
        near &= reach.min(axis=1) - margin_m <= strip.along[-1]
        near &= across_m.max(axis=1) + margin_m >= strip.across[0]
        near &= across_m.min(axis=1) - margin_m <= strip.across[-1]
        return [int(k) for k in np.flatnonzero(near)]

    def seen(self, strip: LineStrip) -> Iterator[StripCoverage]:
        """Visible part of a strip in each image; images that see nothing of it are skipped."""
        for k in self._near(strip):
            found = _seen(strip, self.taken[k], self.corners_m[k], self.projection_centres_m[k])
            if found is not None:
                yield found


def project_footprints(plane: LocalPlane, taken: Sequence[ExposureFootprint]) -> FlightFootprints:
    """Exposures laid out in a plane; those without a footprint are passed over."""
    placed = [one for one in taken if one.corners]
    corners = [[plane.flat(corner) for corner in one.corners] for one in placed]
    eyes = [
        None if e is None else (np.array(plane.flat(e[0])), e[1])
        for e in (t.projection_centre for t in placed)
    ]
    return FlightFootprints(placed, np.array(corners).reshape(-1, 4, 2), eyes)


def _seen(
    strip: LineStrip,
    taken: ExposureFootprint,
    corners: Array,
    projection_centre: tuple[Array, float] | None,
) -> StripCoverage | None:
    margin_m = _shift_m(strip, corners, projection_centre)
    offset_m = corners - strip.start
    ends = np.stack([offset_m @ strip.ahead, offset_m @ strip.left], axis=1)
    low, high = ends.min(axis=0) - margin_m, ends.max(axis=0) + margin_m
    first, last = np.searchsorted(strip.along, [low[0], high[0]])
    left, right = np.searchsorted(strip.across, [low[1], high[1]])
    if first >= last or left >= right:
        return None
    along, across = strip.along[first:last, None], strip.across[None, left:right]
    if strip.relief_m is not None and projection_centre is not None:
        centre = projection_centre[0] - strip.start
        height_m, relief_m = projection_centre[1], strip.relief_m[first:last, left:right]
        stretch = height_m / np.maximum(height_m - relief_m, 1e-3 * height_m)
        at = float(centre @ strip.ahead), float(centre @ strip.left)
        # Where the rays through points of the terrain meet the level ground.
        along, across = (c + (x - c) * stretch for c, x in zip(at, (along, across), strict=True))
    found = _image_from_ground(ends)
    if found is None:
        return None
    u, v, w = (row[0] * along + (row[1] * across + row[2]) for row in found)
    inside: Flags = (w > 0.0) & (u >= -_EDGE) & (u <= w + _EDGE) & (v >= -_EDGE) & (v <= w + _EDGE)
    if not inside.any():
        return None
    gaps = {}
    if taken.area is not None and taken.area.gaps:
        positive = np.where(inside, w, 1.0)
        gaps = gaps_of(taken.area, np.stack([u / positive, v / positive], axis=-1), inside)
    return StripCoverage(taken, (slice(first, last), slice(left, right)), inside, gaps)


def _shift_m(
    strip: LineStrip, corners: Array, projection_centre: tuple[Array, float] | None
) -> float:
    """Maximum displacement by relief of the ground an image sees, metres."""
    if projection_centre is None or strip.relief_m is None:
        return 0.0
    highest_m = float(np.max(np.abs(strip.relief_m)))
    reach_m = float(np.max(np.hypot(*(corners - projection_centre[0]).T)))
    return reach_m * highest_m / max(projection_centre[1] - highest_m, 1.0)


def count_images(
    strip: LineStrip, seen: Sequence[StripCoverage]
) -> tuple[Counts, Mapping[str, Counts]]:
    """Number of images with each point inside, and by band the number with it in a gap."""
    shape = (len(strip.along), len(strip.across))
    inside: Counts = np.zeros(shape, np.int16)
    in_gaps: dict[str, Counts] = {}
    for one in seen:
        inside[one.where] += one.inside
        for band, flags in one.gaps.items():
            in_gaps.setdefault(band, np.zeros(shape, np.int16))[one.where] += flags
    return inside, in_gaps


def image_shares(corners: Array, points: Array) -> Array:
    """Positions of points of level ground in an image, as shares of its width and height, (..., 2).

    Args:
        corners: (4, 2), the footprint; points: (..., 2), in the same plane.

    Returns:
        Shares from the top left corner; NaN behind the camera.
    """
    found = _image_from_ground(corners)
    if found is None:
        return np.full(points.shape, np.nan)
    u, v, w = (points @ row[:2] + row[2] for row in found)
    w = np.where(w > 0.0, w, np.nan)
    return np.stack([u / w, v / w], axis=-1)


def _image_from_ground(corners: Array) -> Array | None:
    """The homography from level ground to shares of the image, (3, 3), its last row positive in
    front of the camera; None where the footprint has no area."""
    middle = corners.mean(axis=0)
    scale = max(float(np.abs(corners - middle).max()), 1e-9)
    rows = []
    for (x, y), (u, v) in zip((corners - middle) / scale, _CORNERS, strict=True):
        rows.append([x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y])
        rows.append([0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y])
    try:
        found = np.linalg.solve(np.array(rows), _CORNERS.reshape(-1))
    except np.linalg.LinAlgError:
        return None
    h: Array = np.append(found, 1.0).reshape(3, 3)
    h[:, :2] /= scale
    h[:, 2] -= h[:, :2] @ middle
    return h


def is_inside(shares: Array) -> Flags:
    """Whether points are in the image, its edges included."""
    flags: Flags = np.all((shares >= -_EDGE) & (shares <= 1.0 + _EDGE), axis=-1)
    return flags


def gaps_of(area: ValidArea | None, shares: Array, inside: Flags) -> dict[str, Flags]:
    """By band, the points in the image that have no valid pixels there."""
    if area is None or not area.gaps:
        return {}
    columns = np.clip(np.nan_to_num(shares[..., 0]) * area.columns, 0, area.columns - 1)
    rows = np.clip(np.nan_to_num(shares[..., 1]) * area.rows, 0, area.rows - 1)
    i, j = rows.astype(np.int64), columns.astype(np.int64)
    return {band: inside & ~area.mask(band)[i, j] for band in area.gaps}


def _degrees(plane: LocalPlane, points: Array) -> Array:
    origin, north = plane.place(0.0, 0.0), plane.place(0.0, 1.0)
    east = plane.place(1.0, 0.0)
    return np.stack(
        [
            origin.latitude_deg + points[..., 1] * (north.latitude_deg - origin.latitude_deg),
            origin.longitude_deg + points[..., 0] * (east.longitude_deg - origin.longitude_deg),
        ],
        axis=-1,
    )

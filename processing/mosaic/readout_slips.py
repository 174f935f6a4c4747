"""Read-out slips: displaced rows or columns of one frame, detected by residuals.

A head that drops or repeats lines shifts a band of its frame, or everything after one line. The
adjustment spreads that over sensors that are in order; the residuals of the frame's own tie
points, rejected ones included, still step along its rows or columns. Nothing is corrected here.

Source: docs/explanation/mathematics/validity.md#read-out-slips.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from processing.matching.tie_points import PAN_TO_COLOUR, PAN_TO_PAN, TiePoints
from processing.mosaic.slip_bins import (
    MEDIAN_EFFICIENCY_FACTOR,
    bin_residuals,
    level_of,
    order_along,
    points_of_frame,
    shifted_runs,
)
from processing.mosaic.slip_settings import SlipSettings
from processing.quality.figures.stitching import SlipFigures
from processing.rig import Rig

Array = NDArray[np.float64]
Axis = Literal["rows", "columns"]

_MAD_TO_SIGMA: Final = 1.4826
MIN_SIGMA_PX: Final = 0.02
SIGMA_POINTS: Final = 4000
"""Of each class from which the spread is taken: to one per cent."""
MIN_COMMON_FRACTION: Final = 0.3
"""A point of a band has its shift within this share of it and three standard deviations."""
ALTERNATIVE_GAIN: Final = 0.8
ROBUST_LIMIT: Final = 12.0
"""Normalised residual above which a tie point counts as a blunder whatever its size."""


@dataclass(frozen=True)
class Slip:
    """A band of one frame that is displaced against the rest of the frame.

    The band reaches from pixel `first` to `last` along `axis`; `dx_px`, `dy_px` are its shift
    against the rest in the VIP (x right, y up), PAN pixels, `share` its part of the frame, `score`
    the shift over its standard deviation, `points` the tie points in the band. `alternatives` are
    frames that see the same tie points and explain them nearly as well.
    """

    sensor: str
    axis: Axis
    first: int
    last: int
    dx_px: float
    dy_px: float
    share: float
    score: float
    points: int
    alternatives: tuple[str, ...] = ()

    @property
    def length_px(self) -> float:
        """Length of the shift, PAN pixels."""
        return math.hypot(self.dx_px, self.dy_px)


def find_slips(
    rig: Rig,
    tie_points: TiePoints,
    residuals_px: Array,
    *,
    sensors: Collection[str] | None = None,
    settings: SlipSettings | None = None,
) -> tuple[Slip, ...]:
    """Search the residuals of every frame for bands of rows or columns that are shifted.

    A tie point of a shifted band is off in both of its frames. The band that explains most is taken
    as the cause, its shift is taken out of all its tie points, and the search goes on.

    Args:
        rig: the camera.
        tie_points: all that were matched, those that the adjustment rejected included.
        residuals_px: place of a less place of b in the VIP (n, 2), x right, y up; NaN where the
            adjustment had no use for a point.
        sensors: the frames to search; None searches all.
        settings: None takes the defaults.

    Returns:
        One shifted band a frame, that which explains most first; none for a healthy exposure.
    """
    settings = settings or SlipSettings()
    residuals, sigma = residuals_px.copy(), _sigma_px(tie_points, residuals_px)
    usable = np.asarray(np.isfinite(residuals).all(axis=1), np.bool_)
    causes: list[Slip] = []
    for _ in range(settings.max_rounds):
        found = [
            band
            for number, name in enumerate(tie_points.names)
            if sensors is None or name in sensors
            for band in _bands(rig, tie_points, number, residuals, sigma, usable, settings)
        ]
        if not found:
            break
        slip, gain = max(found, key=lambda band: band[1])
        if gain <= 0.0:
            break
        if slip.sensor not in {cause.sensor for cause in causes}:
            others = _alternatives(tie_points, slip, gain, found)
            others += tuple(
                n for n in _shown_by_one(tie_points, slip, residuals) if n not in others
            )
            causes.append(replace(slip, alternatives=others))
        for side, sign in _sides(tie_points, slip):
            residuals[side] -= sign * np.array([slip.dx_px, slip.dy_px])
    return tuple(causes)


def of_sensor(tie_points: TiePoints, sensor: str) -> NDArray[np.bool_]:
    """Mark tie points that have an image in a frame.

    Args:
        tie_points: n points.
        sensor: name of the frame's sensor.

    Returns:
        True for such points, (n,).
    """
    number = tie_points.names.index(sensor)
    return np.asarray((tie_points.sensor_a == number) | (tie_points.sensor_b == number), np.bool_)


def inside_slips(tie_points: TiePoints, slips: Sequence[Slip]) -> NDArray[np.bool_]:
    """Mark tie points that lie in one of the bands.

    Args:
        tie_points: n points.
        slips: shifted bands.

    Returns:
        True for such points, (n,).
    """
    inside = np.zeros(len(tie_points), np.bool_)
    for slip in slips:
        for side, _ in _sides(tie_points, slip):
            inside |= side
    return inside


def slip_of(
    rig: Rig,
    tie_points: TiePoints,
    residuals_px: Array,
    sensor: str,
    *,
    settings: SlipSettings | None = None,
) -> Slip | None:
    """Measure the slip of one frame by residuals against its calibrated place.

    Where the frame has two parts, the one farther from the calibrated place is the shifted one.

    Args:
        rig: the camera.
        tie_points: all of them.
        residuals_px: as of `find_slips`, of an adjustment that this frame had no part in.
        sensor: the frame.
        settings: None takes the defaults.

    Returns:
        The shifted band; None where the frame has none.
    """
    found = find_slips(rig, tie_points, residuals_px, sensors=(sensor,), settings=settings)
    slip = next(iter(found), None)
    if slip is None:
        return None
    size = rig.sensor(sensor).height_px if slip.axis == "rows" else rig.sensor(sensor).width_px
    if slip.first > 0 and slip.last < size - 1:
        return slip
    inside, outside = np.zeros((0, 2)), np.zeros((0, 2))
    banded, own = _sides(tie_points, slip), _sides(tie_points, replace(slip, first=0, last=size))
    for (band, sign), (every, _) in zip(banded, own, strict=True):
        inside = np.concatenate([inside, sign * residuals_px[band]])
        outside = np.concatenate([outside, sign * residuals_px[every & ~band]])
    near, far = (float(np.hypot(*np.nanmedian(part, axis=0))) for part in (inside, outside))
    if near >= far or not len(outside):
        return slip
    first, last = (slip.last + 1, size - 1) if slip.first == 0 else (0, slip.first - 1)
    return replace(
        slip,
        first=first,
        last=last,
        dx_px=-slip.dx_px,
        dy_px=-slip.dy_px,
        share=(last - first + 1) / size,
        points=len(outside),
    )


def slip_figures(rig: Rig, slips: Sequence[Slip]) -> SlipFigures:
    """The worst slip in figures of the quality report.

    Args:
        rig: the camera.
        slips: from `find_slips`, the worst first.

    Returns:
        Figures of the first, and the sensors of all; empty without slips.
    """
    if not slips:
        return SlipFigures()
    worst = slips[0]
    return SlipFigures(
        slip_sensor=worst.sensor,
        slip_cone=rig.cone_of(worst.sensor).name,
        slip_px=worst.length_px,
        slip_axis=worst.axis,
        slip_first=worst.first,
        slip_last=worst.last,
        slip_alternatives=tuple(worst.alternatives),
        slip_sensors=tuple(slip.sensor for slip in slips),
    )


def _alternatives(
    tie_points: TiePoints, slip: Slip, gain: float, found: Sequence[tuple[Slip, float]]
) -> tuple[str, ...]:
    """Frames whose band explains nearly as much with the same tie points."""
    own = inside_slips(tie_points, (slip,))
    return tuple(
        other.sensor
        for other, explained in found
        if other.sensor != slip.sensor
        and explained > ALTERNATIVE_GAIN * gain
        and np.mean(own[inside_slips(tie_points, (other,))]) > 0.5
    )


def _shown_by_one(tie_points: TiePoints, slip: Slip, residuals: Array) -> tuple[str, ...]:
    """The PAN frame that alone shows a band of the colour master shifted: it may be its own."""
    rows = _sides(tie_points, slip)[1][0] & (tie_points.kind == PAN_TO_COLOUR)
    rows &= np.isfinite(residuals).all(axis=1)
    shift = -np.array([slip.dx_px, slip.dy_px])
    along = residuals @ shift / float(shift @ shift)
    seen_in = tie_points.sensor_a[rows]
    shown = [n for n in np.unique(seen_in) if np.median(along[rows][seen_in == n]) > 0.5]
    return (tie_points.names[shown[0]],) if len(shown) == 1 else ()


def _sigma_px(tie_points: TiePoints, residuals_px: Array) -> Array:
    """Standard deviation (n,) of a residual's coordinate: relative sigma times its class's."""
    sigma = np.ones(len(tie_points))
    for kind in (PAN_TO_PAN, PAN_TO_COLOUR):
        of_kind = tie_points.kind == kind
        if of_kind.any():
            relative = tie_points.sigma_px[of_kind]
            some = slice(None, None, max(1, len(relative) // SIGMA_POINTS))
            relative = relative / float(np.median(relative[some]))
            scaled = np.abs(residuals_px[of_kind][some]) / relative[some, None]
            spread = _MAD_TO_SIGMA * float(np.nanmedian(scaled))
            sigma[of_kind] = np.maximum(relative * spread, MIN_SIGMA_PX)
    return sigma


def _bands(
    rig: Rig,
    tie_points: TiePoints,
    number: int,
    residuals: Array,
    sigma: Array,
    usable: NDArray[np.bool_],
    settings: SlipSettings,
) -> list[tuple[Slip, float]]:
    """The most shifted bands of a frame along rows and columns, and what each explains."""
    rows, raw, own = points_of_frame(
        tie_points.sensor_a,
        tie_points.sensor_b,
        tie_points.raw_a,
        tie_points.raw_b,
        residuals,
        usable,
        number,
    )
    if len(rows) < 6 * settings.bin_points:
        return []
    sensor = rig.sensor(tie_points.names[number])
    own_px, own_sigma = _own_px(rig, sensor.name), sigma[rows]
    axes: tuple[tuple[Axis, int, int], ...] = (
        ("rows", 1, sensor.height_px),
        ("columns", 0, sensor.width_px),
    )
    return [
        band
        for axis, index, size in axes
        if (
            band := _best_band(
                sensor.name, axis, size, raw[:, index], own, own_sigma, settings, own_px=own_px
            )
        )
    ]


def _own_px(rig: Rig, sensor: str) -> float:
    """Size of a frame's pixel in the virtual image, PAN pixels."""
    cone, image = rig.cone_of(sensor), rig.virtual_image
    if image is None:
        return 1.0
    return rig.sensor(sensor).pitch_mm / image.pitch_mm * image.f_mm / cone.lens.f_mm


def _best_band(
    name: str,
    axis: Axis,
    size: int,
    at: Array,
    residuals: Array,
    sigma: Array,
    settings: SlipSettings,
    *,
    own_px: float,
) -> tuple[Slip, float] | None:
    """Of all bands of one frame along one axis that are shifted, the one that explains most.

    Points are sorted along the axis into bins; a band is a run of bins, at most half of all: a step
    in the middle of a frame shifts its first or its last half.
    """
    per = settings.bin_points
    bins = len(at) // per
    order = order_along(at, size)[: bins * per]
    medians, sums, weight = bin_residuals(residuals, sigma, order, per)
    level = level_of(medians)
    runs = shifted_runs(sums, weight, level, settings.limit)
    if not len(runs):
        return None
    at, residuals, sigma = at[order], residuals[order], sigma[order]
    best: tuple[Slip, float] | None = None
    for run in runs:
        at_bin, width, score = int(run[0]), int(run[1]), float(run[2])
        band = slice(at_bin, at_bin + width)
        shift = _shift_of_run(sums, weight, level, band)
        if np.abs(shift).max() > settings.min_shift_px(width * per):
            first, last = _extend_band(medians, shift, level, at_bin, at_bin + width)
            band = slice(first * per, last * per)
            outside = _level_outside(residuals, band)
            dx, dy = np.median(residuals[band], axis=0) - outside
            shift = np.tile(outside - level, (len(residuals), 1))
            shift[band] += dx, dy
            explained = _explained(residuals - level, sigma, shift)
            # A wrong scale or rotation is a ramp, which a band only seems to be.
            ramp = _explained(residuals - level, sigma, _ramp(at, residuals - level))
            explained = explained if explained > ramp else 0.0
            off = np.abs(residuals[band] - outside - (dx, dy)).max(axis=1)
            near = off < MIN_COMMON_FRACTION * math.hypot(dx, dy) + 3.0 * sigma[band]
            large = max(abs(dx), abs(dy)) > max(
                settings.min_shift_px(band.stop - band.start),
                settings.min_whole_px(float(np.sum(near)) / len(residuals), own_px),
            )
            if (
                large
                and explained > 0.0
                and np.mean(near) > settings.min_share
                and _own_score(residuals[band], np.array([dx, dy])) > settings.own_limit
                and (best is None or explained > best[1])
            ):
                start = 0 if first == 0 else int(at[band.start])
                stop = size - 1 if last == bins else math.ceil(at[band.stop - 1])
                share = (stop - start + 1) / size
                points = band.stop - band.start
                slip = Slip(name, axis, start, stop, float(dx), float(dy), share, score, points)
                best = slip, explained
    return best


def _shift_of_run(sums: Array, weight: Array, level: Array, run: slice) -> Array:
    """Shift of a run of bins (2,) against the frame or against the rest, the larger of each."""
    inside, held = sums[run.stop] - sums[run.start], weight[run.stop] - weight[run.start]
    mean, rest = inside / held, (sums[-1] - inside) / (weight[-1] - held)
    shifts = mean - level, mean - rest
    return np.asarray(np.where(np.abs(shifts[0]) > np.abs(shifts[1]), *shifts))


def _extend_band(
    medians: Array, shift: Array, level: Array, first: int, last: int
) -> tuple[int, int]:
    """The run of bins around `first:last` whose medians are nearer to the shifted level.

    It ends before it holds more than half of the bins: then the rest would be the band.
    """
    main = int(np.argmax(np.abs(shift)))
    nearer = (medians[:, main] - level[main]) / shift[main] > 0.5
    most = (len(medians) + 1) // 2
    while first > 0 and nearer[first - 1] and last - first < most:
        first -= 1
    while last < len(medians) and nearer[last] and last - first < most:
        last += 1
    return first, last


def _own_score(residuals: Array, shift: Array) -> float:
    """Shift (2,) of a band over the standard deviation that its own points (n, 2) show.

    Under the edge of a cloud points scatter several times more than those of their kind.
    """
    main = int(np.argmax(np.abs(shift)))
    along = residuals[:, main]
    spread = _MAD_TO_SIGMA * float(np.median(np.abs(along - np.median(along))))
    sigma = MEDIAN_EFFICIENCY_FACTOR * max(spread, MIN_SIGMA_PX) / math.sqrt(len(along))
    return float(abs(shift[main])) / sigma


def _level_outside(residuals: Array, band: slice) -> Array:
    outside = np.concatenate([residuals[: band.start], residuals[band.stop :]])
    return np.asarray(np.median(outside, axis=0))


def _ramp(at: Array, residuals: Array) -> Array:
    """Residuals (n, 2) that grow evenly along the axis, by the medians of both outer thirds."""
    third = max(len(at) // 3, 1)
    low, high = np.median(residuals[:third], axis=0), np.median(residuals[-third:], axis=0)
    first, last = float(np.median(at[:third])), float(np.median(at[-third:]))
    along = (at - first) / max(last - first, 1.0)
    return np.asarray(low + along[:, None] * (high - low))


def _explained(residuals: Array, sigma: Array, shift: Array) -> float:
    """By how much the shift lessens the robust sum of squares of residuals (n, 2)."""

    def cost(left: Array) -> float:
        squares = np.sum((left / sigma[:, None]) ** 2, axis=1)
        return float(np.sum(np.minimum(squares, ROBUST_LIMIT**2)))

    return cost(residuals) - cost(residuals - shift)


def _sides(tie_points: TiePoints, slip: Slip) -> list[tuple[NDArray[np.bool_], float]]:
    """Tie points in the band: those whose first frame it is, and those whose second, with signs."""
    number = tie_points.names.index(slip.sensor)
    index = 1 if slip.axis == "rows" else 0
    sides = []
    for of, raw, sign in (
        (tie_points.sensor_a, tie_points.raw_a, 1.0),
        (tie_points.sensor_b, tie_points.raw_b, -1.0),
    ):
        at = raw[:, index]
        sides.append(((of == number) & (at >= slip.first) & (at <= slip.last), sign))
    return sides

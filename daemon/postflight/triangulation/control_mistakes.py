"""Control of photographs that contradicts the block: far away, exchanged, columns for rows.

The block as positions of EXIF place it is metres off as a whole, so that control is compared after
a common shift. What remains is found before the adjustment, where control would distort the block
or be rejected.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.triangulation.ground_control import GroundControl
from daemon.postflight.triangulation.photograph_block import PhotographBlock
from processing.bundle.camera_model import ideal_mm, principal_distance_mm
from processing.geometry.positions_fit import NotPlacedError, fit_positions

Array = NDArray[np.float64]

_FAR_M: Final = 2_000.0
"""A control point this far from the photographs, beyond their own extent, is not of the block."""
_LIMIT_M: Final = 3.0
_LIMIT_HEIGHTS: Final = 0.05
"""Deviation from the other points that the placing by EXIF explains, in flying heights."""
_DOUBTFUL_M: Final = 0.5
_DOUBTFUL: Final = 3.0
"""Median deviations beyond which a point is named where the adjustment fails."""
_OTHERS_MIN: Final = 4
_OUTLYING: Final = 4.0
"""A point this many times farther off than any of the others, which four at least must be."""
_SHARE: Final = 0.3
"""An exchange explains deviations that it reduces to less than this share."""


def control_mistakes(found: PhotographBlock, control: GroundControl) -> list[str]:
    """One sentence for each mistake that makes the control unusable.

    Args:
        found: oriented photographs.
        control: its points, measured in these photographs.

    Returns:
        Empty where the control agrees with the block as far as positions of EXIF show.
    """
    if not len(control.names) or not len(control.image):
        return []
    outside = _outside(found, control)
    if outside:
        return outside
    far = _far(found, control)
    if far:
        return far
    deviation, limit = _deviations(found, control, control.xyz_m)
    outlying = _outlying(found, control, limit)
    if outlying:
        return outlying
    own = _total(deviation)
    if not own > limit * len(control.names) / 2.0:
        return []
    turned = replace(control, px=control.px[:, ::-1])
    if _total(_deviations(found, turned, control.xyz_m)[0]) < _SHARE * own:
        return [
            "columns and rows of the measured pixels are exchanged: with rows first the control "
            "agrees with the photographs"
        ]
    return _exchanged(found, control, deviation, limit)


def doubtful_control(found: PhotographBlock, control: GroundControl) -> list[str]:
    """Points that are far from where the photographs show them, against the others; a sentence."""
    if not len(control.names) or not len(control.image):
        return []
    deviation, _ = _deviations(found, control, control.xyz_m)
    size = np.linalg.norm(deviation, axis=1)
    limit = max(_DOUBTFUL_M, _DOUBTFUL * float(np.nanmedian(size)))
    bad = [k for k in np.argsort(-np.nan_to_num(size)).tolist() if size[k] > limit]
    if not bad:
        return []
    listed = ", ".join(f"{control.names[k]} by {size[k]:.1f} m" for k in bad[:5])
    return [
        f"control contradicts the photographs after a common shift: {listed}; check coordinates "
        "and measurements of these points"
    ]


def shift_to_control(found: PhotographBlock, control: GroundControl) -> Array:
    """From places by EXIF to the control, median over its points, (3,) m; zero without control."""
    if not len(control.names) or not len(control.image):
        return np.zeros(3)
    away = control.xyz_m - _measured_places(found, control, control.xyz_m)
    away = away[np.isfinite(away[:, 0])]
    return np.median(away, axis=0) if len(away) else np.zeros(3)


def contradiction_m(found: PhotographBlock, control: GroundControl) -> float:
    """Sum of the deviations of control from the photographs after a common shift, m.

    Args:
        found: oriented photographs.
        control: its points, measured in these photographs.

    Returns:
        Infinite where a measurement is outside its image.
    """
    if _outside(found, control):
        return float("inf")
    return _total(_deviations(found, control, control.xyz_m)[0])


def unmeasured(control: GroundControl) -> list[str]:
    """Control points that no photograph of the block shows, one sentence."""
    seen = np.bincount(control.point, minlength=len(control.names))
    names = [name for name, count in zip(control.names, seen, strict=True) if not count]
    return [f"control not measured in the block: {', '.join(names)}"] if names else []


def _outside(found: PhotographBlock, control: GroundControl) -> list[str]:
    size = np.array([(one.width_px, one.height_px) for one in found.sizes])
    end = size[found.camera_of[control.image]] - 0.5
    beyond = np.any((control.px < -0.5) | (control.px > end), axis=1)
    if not np.any(beyond):
        return []
    fits_turned = np.all(control.px <= end[:, ::-1], axis=1)
    largest = size[found.camera_of[control.image][np.argmax(beyond)]]
    cure = "; columns and rows appear exchanged" if fits_turned[beyond].all() else ""
    names = sorted({control.names[k] for k in control.point[beyond]})
    return [
        f"{int(beyond.sum())} measurements of {', '.join(names[:5])} are outside the image of "
        f"{largest[0]} x {largest[1]} px{cure}"
    ]


def _far(found: PhotographBlock, control: GroundControl) -> list[str]:
    station = found.block.station_m
    middle = station.mean(axis=0)
    extent = float(np.linalg.norm(station - middle, axis=1).max())
    away = np.linalg.norm(control.xyz_m - middle, axis=1)
    far = np.flatnonzero(~(away < _FAR_M + 5.0 * extent))
    if not len(far):
        return []
    listed = ", ".join(f"{control.names[k]} ({away[k] / 1000.0:.1f} km)" for k in far[:5])
    return [
        f"control is not where the photographs are: {listed}. Check the coordinate system and the "
        "order of east and north"
    ]


def _outlying(found: PhotographBlock, control: GroundControl, limit_m: float) -> list[str]:
    """The one point that all others contradict, which agree with each other."""
    place = _measured_places(found, control, control.xyz_m)
    known = np.flatnonzero(np.isfinite(place[:, 0]))
    if len(known) < _OTHERS_MIN + 1:
        return []
    worst, sentences = _OUTLYING, []
    for k in known.tolist():
        rest = known[known != k]
        try:
            fit = fit_positions(place[rest], control.xyz_m[rest])
        except NotPlacedError:
            continue
        away_m = float(np.linalg.norm(fit.applied(place[k][None])[0] - control.xyz_m[k]))
        others_m = float(np.linalg.norm(fit.residual_m, axis=1).max())
        if away_m > limit_m and away_m > worst * others_m:
            worst = away_m / others_m
            sentences = [
                f"control point {control.names[k]} is {away_m:.1f} m from where the photographs "
                f"and the other {len(rest)} points place it, which agree to {others_m:.1f} m. "
                "Check its coordinates and its measurements, or leave it out"
            ]
    return sentences


def _deviations(
    found: PhotographBlock, control: GroundControl, xyz_m: Array
) -> tuple[Array, float]:
    """Of the measured from the given places (n, 3) less the median; NaN where not measured."""
    place = _measured_places(found, control, xyz_m)
    away = place - xyz_m
    shift = np.nanmedian(away, axis=0) if np.isfinite(away[:, 0]).any() else np.zeros(3)
    height = float(np.median(found.block.station_m[:, 2]) - found.block.ground_m)
    return away - shift, max(_LIMIT_M, _LIMIT_HEIGHTS * abs(height))


def _measured_places(found: PhotographBlock, control: GroundControl, xyz_m: Array) -> Array:
    """Intersected places; of points in one photograph, where their ray meets their height."""
    of = found.camera_of[control.image]
    ray = np.column_stack([found.image_mm(control.image, control.px), np.zeros(len(of))])
    for k, camera in enumerate(found.cameras):
        own, terms = of == k, np.array([term.value for term in camera.terms])
        ray[own, :2] = ideal_mm(camera, camera.interior, terms, ray[own, :2])
        ray[own, 2] = -principal_distance_mm(camera, camera.interior)
    ray = np.einsum("nij,nj->ni", found.block.rotation[control.image], ray)
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    start = found.block.station_m[control.image]
    place = np.full((len(control.names), 3), np.nan)
    single = []
    for point in range(len(control.names)):
        rows = np.flatnonzero(control.point == point)
        across = np.eye(3) - ray[rows, :, None] * ray[rows, None, :]
        normal = across.sum(axis=0)
        if len(rows) >= 2 and np.linalg.cond(normal) < 1e4:
            right = np.einsum("nij,nj->i", across, start[rows])
            place[point] = np.linalg.solve(normal, right)
        elif len(rows):
            single.append((point, rows[0]))
    known = np.isfinite(place[:, 2])
    up = float(np.median((place - xyz_m)[known, 2])) if known.any() else None
    for point, row in single:
        height = xyz_m[point, 2] + up if up is not None else found.block.ground_m
        distance = (height - start[row, 2]) / ray[row, 2]
        if distance > 0.0:
            place[point] = start[row] + distance * ray[row]
            if up is None:
                place[point, 2] = xyz_m[point, 2]
    return place


def _total(deviation: Array) -> float:
    return float(np.nansum(np.linalg.norm(deviation, axis=1)))


def _exchanged(
    found: PhotographBlock, control: GroundControl, deviation: Array, limit: float
) -> list[str]:
    """Pairs of points whose names are exchanged, or coordinates."""
    size = np.linalg.norm(deviation, axis=1)
    bad = [int(k) for k in np.flatnonzero(size > limit)]
    if len(bad) > 40:
        return []
    sentences = []
    for a, b in combinations(bad, 2):
        turned = control.xyz_m.copy()
        turned[[a, b]] = turned[[b, a]]
        other = np.linalg.norm(_deviations(found, control, turned)[0], axis=1)
        if other[a] + other[b] < _SHARE * (size[a] + size[b]):
            sentences.append(
                f"control points {control.names[a]} and {control.names[b]} are exchanged: as given "
                f"they are {size[a]:.1f} m and {size[b]:.1f} m from where the photographs show "
                f"them, exchanged {other[a]:.1f} m and {other[b]:.1f} m. Exchange their names"
            )
    return sentences

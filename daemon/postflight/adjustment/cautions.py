"""What a reader of an adjustment would see in its tables: sentences with what is to be done."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from scipy.special import chdtri

from daemon.postflight.adjustment.antenna_effects import antenna_effects
from daemon.postflight.adjustment.contradictions import SUSPICIOUS_SIGMA0
from daemon.postflight.adjustment.separate_blocks import separate_blocks
from daemon.postflight.adjustment.variance_factors import (
    fine_positions,
    variance_factor_cautions,
)
from processing.bundle.adjust import Adjustment
from processing.bundle.adjustment_results import PointDifferences, exposures_of
from processing.bundle.data_snooping import observation_name

_LEFT_OUT_SHARE: Final = 0.25
_MAX_LISTED: Final = 20
_OF_OBSERVATIONS: Final = 8
"""Kinds of observations that have a name; the rest are prior values."""

_LARGE_RESIDUAL: Final = 4.5
"""Of its own standard deviation a posteriori."""

_WEAK_DEG: Final = 6.0
"""Standard deviation of an angle beyond which an orientation is hardly determined."""

_CHECK_SIGNIFICANCE: Final = 0.001


def global_test(result: Adjustment) -> tuple[list[float], bool | None]:
    """Test sigma0 against the a priori standard deviations.

    Args:
        result: the adjustment.

    Returns:
        Limits of sigma0 (99 %) if these are right, and whether it is inside; without redundancy no
        limits and None.
    """
    if result.redundancy <= 0:
        return [], None
    low, high = np.sqrt(chdtri(result.redundancy, [0.995, 0.005]) / result.redundancy)
    return [float(low), float(high)], bool(low <= result.sigma0 <= high)


def cautions_of(result: Adjustment, checks: PointDifferences) -> list[str]:
    """Name what is suspicious in an adjustment that converged.

    Args:
        result: the adjustment.
        checks: check points against it.

    Returns:
        A sentence for each.
    """
    found = []
    if result.redundancy == 0:
        found.append(
            "redundancy is 0: no observation is controlled by the others, and sigma0 and standard "
            "deviations are not known"
        )
    elif result.settings.is_snooping and not math.isfinite(result.reject_limit or math.nan):
        found.append(
            f"data snooping with redundancy {result.redundancy} cannot test any observation; the "
            "test pope needs 2"
        )
    settings = result.settings
    if settings.free_datum != "unknowns" and not result.rank_defects:
        found.append(
            f"free_datum = {settings.free_datum} has no effect: the observations determine the "
            "position, orientation and scale of the block"
        )
    if result.sigma0 > SUSPICIOUS_SIGMA0:
        found.append(
            f"sigma0 is {result.sigma0:.5g}: image coordinates may be of another unit, y may point "
            "down, a sigma may be of another unit, or blunders are in the observations (--reject)"
        )
    else:
        found += variance_factor_cautions(result)
    found += fine_positions(result)
    found += _largest_residual(result)
    found += _weak_orientations(result) or _check_points(checks)
    groups = separate_blocks(result.network)
    if len(groups) > 1:
        counts = ", ".join(str(len(group)) for group in groups[:5])
        found.append(
            f"the images form {len(groups)} blocks that no object point connects ({counts} "
            "images): each rests on its own control"
        )
    points, seen = result.network.points, result.network.image_points.point
    several = np.bincount(seen, minlength=len(points.names)) >= 2
    lost = int((several & result.left_out).sum())
    if result.sigma0 <= SUSPICIOUS_SIGMA0 and lost > _LEFT_OUT_SHARE * several.sum():
        found.append(
            f"{lost} of {int(several.sum())} object points in two or more images are left out, for "
            "their rays do not fix them: are images, or their starting positions, at one place?"
        )
    control = np.flatnonzero((np.nan_to_num(points.sigma_m, nan=-1.0) >= 0.0).any(axis=1))
    tied = np.concatenate([result.network.distances.point_a, result.network.distances.point_b])
    used = np.union1d(seen, tied)
    unseen = [points.names[k] for k in np.setdiff1d(control, used)]
    if unseen:
        found.append(
            f"{len(unseen)} control points have no image point: {', '.join(unseen[:_MAX_LISTED])}"
        )
    return found


def _largest_residual(result: Adjustment) -> list[str]:
    """The observation that stands out where sigma0 is beyond its limit and nothing is tested."""
    limits, _ = global_test(result)
    if not limits or not limits[1] < result.sigma0 <= SUSPICIOUS_SIGMA0:
        return []
    if result.settings.is_snooping:
        return []
    rows = result.equations
    own = np.flatnonzero(rows.group < _OF_OBSERVATIONS)
    size = np.abs(result.standardised[own])
    if not own.size or size.max() < _LARGE_RESIDUAL:
        return []
    worst = int(own[int(np.argmax(size))])
    name = observation_name(
        result.network, int(rows.group[worst]), int(rows.source[worst]), int(rows.axis[worst])
    )
    if named := antenna_effects(result):
        return named
    return [
        f"sigma0 is above its interval, and the largest residual is {size.max():.3g} of its own "
        f"standard deviations ({name}): blunders are likely; adjust with --significance 0.05"
    ]


def _weak_orientations(result: Adjustment) -> list[str]:
    """Images whose angles hardly anything determines, as of control on one line."""
    found = []
    for one in exposures_of(result):
        sigma = np.degrees(np.nan_to_num(one.angles_sigma_rad))
        # Omega and kappa are of one axis where phi is 90 degrees.
        if abs(math.cos(one.angles_rad[1])) > 0.1 and sigma.max() > _WEAK_DEG:
            found.append((float(sigma.max()), one.name))
    if not found:
        return []
    worst, name = max(found)
    return [
        f"the attitudes of {len(found)} images are hardly determined, that of {name} to "
        f"{min(worst, 180.0):.3g} degrees: is the control on one line or too close together? Add "
        "control away from it, GNSS positions or measured attitudes"
    ]


def _check_points(checks: PointDifferences) -> list[str]:
    """Check points that are farther off than the adjustment predicts."""
    known = np.isfinite(checks.difference_m)
    count = int(known.sum())
    if not count or not math.isfinite(checks.squares):
        return []
    if checks.squares * count <= chdtri(count, _CHECK_SIGNIFICANCE):
        return []
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.nan_to_num(np.abs(checks.difference_m) / checks.sigma_m, nan=0.0)
    row, axis = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    return [
        f"check points are off by more than predicted (normalised square {checks.squares:.4g}, 1 "
        f"is expected), most {checks.names[row]}: {checks.difference_m[row, axis]:.4g} m in "
        f"{'XYZ'[axis]}, predicted {checks.sigma_m[row, axis]:.4g} m. Another unit, frame or name, "
        "or systematic errors in images or control"
    ]

"""Results of an adjustment: parameters with their sigmas, checks, residuals.

Everything is derived from an `Adjustment`; nothing is adjusted here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.bundle.adjust import Adjustment
from processing.bundle.forward_models import FORWARD
from processing.bundle.network import INTERIOR, Model
from processing.bundle.normal_equations import point_normals
from processing.bundle.terms import UNITS
from processing.geometry.rotation import angles_by_rotation_vector, omega_phi_kappa

Array = NDArray[np.float64]

HIGH_CORRELATION = 0.95
SIGNIFICANT_T = 2.0
NARROW_DEG = 1.0


@dataclass(frozen=True)
class AdjustedParameter:
    """One parameter of interior orientation, in `unit`; `t` is |value| / sigma.

    `high_correlations` names parameters of the same camera with a correlation beyond 0.95.
    """

    camera: str
    name: str
    unit: str
    value: float
    sigma: float
    t: float
    high_correlations: tuple[tuple[str, float], ...]

    @property
    def is_insignificant(self) -> bool:
        """Not significant, or highly correlated with another parameter: may be left out."""
        return self.t < SIGNIFICANT_T or bool(self.high_correlations)


@dataclass(frozen=True)
class AdjustedOrientation:
    """Position (3,) m and omega, phi, kappa (3,) rad with standard deviations; NaN where held."""

    name: str
    position_m: Array
    position_sigma_m: Array
    angles_rad: Array
    angles_sigma_rad: Array


@dataclass(frozen=True)
class PointDifferences:
    """Differences (adjusted less given) at `names` (n, 3) m, and their predicted sigmas (n, 3).

    `squares` is the mean of the differences' squares in their own covariances: 1 when prediction
    and truth agree.
    """

    names: tuple[str, ...]
    difference_m: Array
    sigma_m: Array
    squares: float

    @property
    def rms_m(self) -> Array:
        """(3,)."""
        return np.asarray(np.sqrt(np.mean(self.difference_m**2, axis=0)))

    @property
    def predicted_m(self) -> Array:
        """(3,) root mean square of the predicted sigmas."""
        return np.asarray(np.sqrt(np.mean(self.sigma_m**2, axis=0)))


@dataclass(frozen=True)
class ResidualPattern:
    """Mean image residuals by cells: places (n, 2) mm, means (n, 2) mm, counts (n,)."""

    places_mm: Array
    mean_mm: Array
    count: NDArray[np.int64]


def parameters_of(result: Adjustment) -> tuple[AdjustedParameter, ...]:
    """Estimated interior orientation and additional parameters of every camera.

    Args:
        result: the adjustment.

    Returns:
        Estimated parameters, camera by camera, the ten before additional ones; held ones are left
        out.
    """
    found = []
    for index, camera in enumerate(result.network.cameras):
        columns = np.concatenate([result.layout.interior[index], result.layout.terms[index]])
        values = np.concatenate([result.state.interior[index], result.state.terms[index]])
        names = [*INTERIOR, *(t.name for t in camera.terms)]
        units = [_unit(name, camera.model) for name in INTERIOR] + [
            UNITS[t.kind] for t in camera.terms
        ]
        free = np.flatnonzero(columns >= 0)
        own = result.cofactors[np.ix_(columns[free], columns[free])]
        spread = np.sqrt(np.clip(np.diag(own), 1e-300, None))
        correlation = own / spread[:, None] / spread
        for k, at in enumerate(free):
            unit, factor = units[at]
            sigma = float(spread[k]) * result.sigma0
            high = [
                (names[free[j]], float(correlation[k, j]))
                for j in range(len(free))
                if j != k and abs(correlation[k, j]) > HIGH_CORRELATION
            ]
            found.append(
                AdjustedParameter(
                    camera.name,
                    names[at],
                    unit,
                    float(values[at]) * factor,
                    sigma * factor,
                    abs(float(values[at])) / sigma if sigma > 0.0 else math.inf,
                    tuple(high),
                )
            )
    return tuple(found)


def exposures_of(result: Adjustment) -> tuple[AdjustedOrientation, ...]:
    """Projection centre and angles of every image's station and attitude.

    Args:
        result: the adjustment.

    Returns:
        One orientation per image, in the order of the network.
    """
    images, layout = result.network.images, result.layout
    found = []
    angles = omega_phi_kappa(result.state.attitude)
    by_vector = angles_by_rotation_vector("XYZ", result.state.attitude)
    for k, name in enumerate(images.names):
        s, a = images.station[k], images.attitude[k]
        found.append(
            AdjustedOrientation(
                name,
                result.state.station[s],
                _sigmas(result, layout.station[s], np.eye(3)),
                angles[a],
                _sigmas(result, layout.attitude[a], by_vector[a]),
            )
        )
    return tuple(found)


def heads_of(result: Adjustment) -> tuple[AdjustedOrientation, ...]:
    """Relative orientation of every head.

    Args:
        result: the adjustment.

    Returns:
        One orientation per head, in the order of the network: offset in rig axes, rig from camera.
    """
    angles = omega_phi_kappa(result.state.head_rotation)
    by_vector = angles_by_rotation_vector("XYZ", result.state.head_rotation)
    return tuple(
        AdjustedOrientation(
            head.name,
            result.state.head_offset[k],
            _sigmas(result, result.layout.head_offset[k], np.eye(3)),
            angles[k],
            _sigmas(result, result.layout.head_rotation[k], by_vector[k]),
        )
        for k, head in enumerate(result.network.heads)
    )


def check_point_differences(
    result: Adjustment, names: Sequence[str], xyz_m: Array, sigma_m: Array
) -> PointDifferences:
    """Adjusted object points against independent coordinates.

    Args:
        result: the adjustment.
        names: of the points; those that were not adjusted are skipped.
        xyz_m: independent coordinates, shape (n, 3), m; NaN is not compared.
        sigma_m: their standard deviations, shape (n, 3), m; NaN counts as zero.

    Returns:
        Differences and their predicted sigmas, for the points that were compared.
    """
    at = {name: index for index, name in enumerate(result.network.points.names)}
    checked_names, differences, sigmas, squares, count = [], [], [], 0.0, 0
    for name, given, own in zip(names, xyz_m, sigma_m, strict=True):
        index = at.get(name)
        if index is None or not np.isfinite(result.point_cofactor[index]).all():
            continue
        covariance = result.sigma0**2 * result.point_cofactor[index] + np.diag(
            np.nan_to_num(own) ** 2
        )
        difference = result.state.points[index] - given
        there = np.isfinite(given)
        part = difference[there]
        squares += float(part @ np.linalg.solve(covariance[np.ix_(there, there)], part))
        count += int(there.sum())
        checked_names.append(name)
        differences.append(difference)
        sigmas.append(np.sqrt(np.diag(covariance)))
    return PointDifferences(
        tuple(checked_names),
        np.array(differences).reshape(-1, 3),
        np.array(sigmas).reshape(-1, 3),
        squares / count if count else math.nan,
    )


def control_residuals(result: Adjustment) -> PointDifferences:
    """Adjusted less given coordinates of weighted control points.

    Args:
        result: the adjustment.

    Returns:
        Differences, NaN for coordinates without a sigma and for those that data snooping left out;
        `sigma_m` is a priori.
    """
    sigma = result.network.points.sigma_m
    rows = np.flatnonzero((np.nan_to_num(sigma) > 0.0).any(axis=1))
    rows = rows[np.isfinite(result.point_cofactor[rows]).all(axis=(1, 2))]
    difference = result.state.points[rows] - result.network.points.xyz_m[rows]
    used = (np.nan_to_num(sigma[rows]) > 0.0) & ~result.excluded.control[rows]
    difference = np.where(used, difference, np.nan)
    weighted = difference / sigma[rows]
    return PointDifferences(
        tuple(result.network.points.names[k] for k in rows),
        difference,
        sigma[rows],
        float(np.nanmean(weighted**2)) if weighted.size else math.nan,
    )


def narrow_points(
    result: Adjustment, below_deg: float = NARROW_DEG
) -> tuple[tuple[str, float], ...]:
    """Object points whose rays are nearly parallel: their depth is hardly determined.

    Args:
        result: the adjustment.
        below_deg: angle between rays, degrees.

    Returns:
        Name and angle of two rays that fix a depth as well, degrees, narrowest first.

    Source: docs/explanation/mathematics/bundle.md#points-of-nearly-parallel-rays.
    """
    values = np.linalg.eigvalsh(point_normals(result.equations, result.layout))
    points = result.layout.eliminated_points
    free = ~result.layout.locked[points].any(axis=1) & ~result.network.points.at_infinity[points]
    share = np.clip(values[:, 0] / np.maximum(values[:, 2], 1e-300), 0.0, 1.0)
    angle = np.degrees(2.0 * np.arctan(np.sqrt(share)))
    own = np.flatnonzero(free & (angle < below_deg))
    own = own[np.argsort(angle[own], kind="stable")]
    return tuple((result.network.points.names[points[k]], float(angle[k])) for k in own)


def image_residuals_mm(result: Adjustment) -> Array:
    """Computed less measured coordinates of every image point.

    Args:
        result: the adjustment.

    Returns:
        Shape (image points, 2), mm; NaN for points that were not adjusted.
    """
    residual = np.full((len(result.network.image_points.image), 2), np.nan)
    rows = result.equations
    weight = np.sqrt(np.where(result.weight > 0.0, result.weight, 1.0))
    for axis in range(2):
        own = rows.group == axis
        source = rows.source[own]
        residual[source, axis] = result.residual[own] * rows.sigma[own] / weight[source]
    return residual


def systematic_residuals(
    result: Adjustment, camera: int, cells: tuple[int, int]
) -> ResidualPattern:
    """Mean image residuals of one camera over a grid of cells.

    Args:
        result: the adjustment.
        camera: index of the camera; it has image points.
        cells: (columns, rows) over the extent of its image points.

    Returns:
        Means of the cells that have points, row by row.

    Source: Ladstädter et al. (2010), fig. 10.
    """
    table = result.network.image_points
    residual = image_residuals_mm(result)
    own = (result.network.images.camera[table.image] == camera) & np.isfinite(residual).all(axis=1)
    xy, residual = table.xy_mm[own], residual[own]
    low, high = xy.min(axis=0), xy.max(axis=0)
    index = np.clip(((xy - low) / (high - low) * cells).astype(int), 0, np.array(cells) - 1)
    flat = index[:, 1] * cells[0] + index[:, 0]
    count = np.bincount(flat, minlength=cells[0] * cells[1])
    seen = count > 0
    mean = np.stack(
        [
            np.bincount(flat, weights=residual[:, axis], minlength=len(count))[seen] / count[seen]
            for axis in range(2)
        ],
        axis=1,
    )
    column, row = np.meshgrid(np.arange(cells[0]), np.arange(cells[1]))
    centre = (np.stack([column.ravel(), row.ravel()], axis=1) + 0.5) / cells * (high - low) + low
    return ResidualPattern(centre[seen], mean, count[seen])


def _sigmas(result: Adjustment, columns: NDArray[np.int64], by: Array) -> Array:
    if (columns < 0).any():
        return np.full(3, np.nan)
    covariance = by @ result.cofactors[np.ix_(columns, columns)] @ by.T
    return np.asarray(result.sigma0 * np.sqrt(np.clip(np.diag(covariance), 0.0, None)))


def _unit(name: str, model: Model) -> tuple[str, float]:
    powers = {"k1": "mm^-2", "k2": "mm^-4", "k3": "mm^-6", "p1": "mm^-1", "p2": "mm^-1"}
    if name in powers:
        return ("1" if model in FORWARD else powers[name]), 1.0
    return ("mm", 1.0) if name in ("dx0", "dy0", "df") else ("1", 1.0)

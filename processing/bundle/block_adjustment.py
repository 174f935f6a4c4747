"""Adjustment of images with measured orientations and tie points, and what follows from it.

The images share one mounting (boresight and lever arm), estimated with its calibration as an
observation. Orientations carry their full covariance. Systematic errors that are not unknowns are
estimated afterwards from the same equations (`added_parameters`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.camera_orientations import CameraOrientations, camera_orientations
from processing.bundle.flown_network import (
    MeasuredOrientations,
    MountingPrior,
    flown_exposures,
)
from processing.bundle.frame_patterns import FramePatterns
from processing.bundle.initial_values import intersect
from processing.bundle.network import CameraModel, ImagePoints, Images, Network, Points
from processing.bundle.residual_weights import block_settings, weighted_by_residuals
from processing.geometry.rotation import vectors_from_rotations

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_IMAGE_GROUPS: Final = (0, 1)
_GNSS_GROUPS: Final = (4, 5)
_ATTITUDE_GROUP: Final = 6


@dataclass(frozen=True)
class TieObservations:
    """Image points (m,): image, point, coordinates in mm (m, 2), and sigmas of x and y in mm."""

    image: Indices
    point: Indices
    xy_mm: Array
    sigma_mm: tuple[float, float]


@dataclass(frozen=True)
class AdjustedMounting:
    """Corrections of boresight (rad) and lever arm (m) about and along the camera's axes, (6,).

    Attributes:
        correction, sigma: (6,).
        share_of_prior: (6,) sigma over that of the calibration; near one, the images contribute
            nothing.
    """

    correction: Array
    sigma: Array
    share_of_prior: Array


@dataclass(frozen=True)
class BlockAdjustment:
    """Adjusted images and points.

    Attributes:
        result: the adjustment with all its statistics.
        cameras: orientations of the images with their covariance, mounting applied.
        points: the points that were adjusted, as numbered by the caller.
        xyz_m, xyz_sigma_m: (points, 3).
        rejected: (m,) image points that contradict the others.
        image_factors: variance factors of image x and y.
        mounting: None without any.
    """

    result: Adjustment
    cameras: CameraOrientations
    points: Indices
    xyz_m: Array
    xyz_sigma_m: Array
    rejected: NDArray[np.bool_]
    image_factors: tuple[float, float]
    mounting: AdjustedMounting | None

    @property
    def sigma0(self) -> float:
        """A posteriori standard deviation of unit weight."""
        return self.result.sigma0


@dataclass(frozen=True)
class AddedParameters:
    """Estimates of parameters that were not among the unknowns, (k,), with covariance (k, k)."""

    value: Array
    covariance: Array

    @property
    def sigma(self) -> Array:
        """Standard deviations, (k,); infinite where the observations do not contain them."""
        return np.sqrt(np.diag(self.covariance))


def adjust_images(
    f_mm: float,
    measured: MeasuredOrientations,
    ties: TieObservations,
    xyz_m: Array,
    prior: MountingPrior | None,
    *,
    reject_beyond: float = 4.0,
    rounds: int = 8,
    start: tuple[Array, Array] | None = None,
    patterns: Sequence[FramePatterns | None] = (),
) -> BlockAdjustment:
    """Adjust images with their measured orientations and tie points.

    Args:
        f_mm: principal distance.
        measured: orientations of the images.
        ties: image points; points are numbered by the rows of `xyz_m`.
        xyz_m: (p, 3) starting values; points without an image point are ignored.
        prior: of the mounting; None holds it.
        reject_beyond: standardised residual beyond which an observation is left out; with a sigma0
            below one, in standard deviations as given.
        rounds: adjustments that may leave something out.
        start: stations (n, 3) and rotations (n, 3, 3) to begin with; None: as measured.
        patterns: what stitching may have left in each image, None where nothing; empty: in none.

    Returns:
        Adjusted orientations and points.

    Raises:
        NetworkError, RankDefectError: as `processing.bundle.adjust.adjust`.

    Source: docs/explanation/mathematics/bundle.md#adjustment.
    """
    network, points = _network(f_mm, measured, ties, xyz_m, prior, start, patterns)
    settings = AdjustmentSettings(reject_beyond=reject_beyond, max_rounds=rounds)
    result = adjust(network, settings)
    if result.sigma0 < 1.0 and result.excluded.others:
        # Measured orientations keep their standard deviations where image points fit better.
        result = adjust(network, replace(settings, reject_beyond=reject_beyond / result.sigma0))
    return _of(result, points, prior)


def adjust_as_after_landing(
    f_mm: float,
    measured: MeasuredOrientations,
    ties: TieObservations,
    xyz_m: Array,
    prior: MountingPrior | None,
    *,
    start: tuple[Array, Array] | None = None,
    patterns: Sequence[FramePatterns | None] = (),
) -> BlockAdjustment:
    """Adjust a whole block as the triangulation after landing does.

    Blunders are found with weights that fall with the residual.

    Args:
        f_mm: principal distance.
        measured: orientations of the images.
        ties: image points, with the sigmas of `sigma_by_residuals`.
        xyz_m: (p, 3) starting values.
        prior: of the mounting; None holds it.
        start: as of `adjust_images`.
        patterns: as of `adjust_images`.

    Returns:
        Adjusted orientations and points.

    Raises:
        NetworkError, RankDefectError: as `processing.bundle.adjust.adjust`.

    Source: docs/explanation/mathematics/bundle.md#adjustment.
    """
    network, points = _network(f_mm, measured, ties, xyz_m, prior, start, patterns)
    return _of(adjust(network, block_settings()), points, prior)


def sigma_by_residuals(
    f_mm: float,
    measured: MeasuredOrientations,
    ties: TieObservations,
    xyz_m: Array,
    prior: MountingPrior | None,
    *,
    start: tuple[Array, Array] | None = None,
    patterns: Sequence[FramePatterns | None] = (),
) -> tuple[float, float]:
    """Standard deviations of image coordinates, as the triangulation after landing finds them.

    Args:
        f_mm: principal distance.
        measured: orientations of the images.
        ties: image points, with sigmas to begin with.
        xyz_m: (p, 3) starting values.
        prior: of the mounting; None holds it.
        start: as of `adjust_images`.
        patterns: as of `adjust_images`.

    Returns:
        Of x and y, mm.

    Raises:
        NetworkError, RankDefectError: as `processing.bundle.adjust.adjust`.
    """
    network, _ = _network(f_mm, measured, ties, xyz_m, prior, start, patterns)
    matched = np.ones(len(ties.image), dtype=bool)
    weighted = weighted_by_residuals(network, block_settings(), matched)
    x, y = weighted.image_points.sigma_mm[0]
    return float(x), float(y)


def _network(
    f_mm: float,
    measured: MeasuredOrientations,
    ties: TieObservations,
    xyz_m: Array,
    prior: MountingPrior | None,
    start: tuple[Array, Array] | None,
    patterns: Sequence[FramePatterns | None],
) -> tuple[Network, Indices]:
    """The network, and the numbers of its points."""
    points, point = np.unique(ties.point, return_inverse=True)
    n = len(measured.position_m)
    names = tuple(str(k) for k in range(n))
    every = np.arange(n)
    flown = flown_exposures(names, measured, prior, start=start)
    sigma = np.tile(ties.sigma_mm, (len(ties.xy_mm), 1))
    network = Network(
        cameras=(CameraModel("camera", f_mm),),
        stations=flown.stations,
        attitudes=flown.attitudes,
        images=Images(names, every, every, np.zeros(n, dtype=np.int64),
                      np.full(n, 0 if flown.heads else -1)),
        points=Points(
            tuple(str(k) for k in range(len(points))),
            xyz_m[points],
            np.full((len(points), 3), np.nan),
            np.zeros(len(points), dtype=bool),
        ),
        image_points=ImagePoints(ties.image, point.astype(np.int64), ties.xy_mm, sigma),
        heads=flown.heads,
        gnss=flown.gnss,
        measured_attitudes=flown.measured_attitudes,
        patterns=tuple(patterns) if any(one is not None for one in patterns) else (),
    )  # fmt: skip
    return network, points


def intersected(
    f_mm: float, station_m: Array, rotation: Array, ties: TieObservations, points: int
) -> Array:
    """Points nearest to all their rays.

    Args:
        f_mm: principal distance.
        station_m: (n, 3).
        rotation: (n, 3, 3).
        ties: image points.
        points: their number.

    Returns:
        Shape (points, 3), m, NaN where rays are parallel or fewer than two.
    """
    ray = np.column_stack([ties.xy_mm, np.full(len(ties.xy_mm), -f_mm)])
    direction = np.einsum("nij,nj->ni", rotation[ties.image], ray)
    xyz, _ = intersect(points, ties.point, station_m[ties.image], direction)
    return xyz


def added_parameters(
    result: Adjustment,
    position: Array,
    attitude: Array,
    sigma: Array,
    *,
    image_mm: Array | None = None,
) -> AddedParameters:
    """Estimate effects on observations that the adjustment had no unknowns for.

    One step of an adjustment with these unknowns, from the equations of the one without.

    Args:
        result: the adjustment.
        position: (n, 3, k) derivatives of the measured positions by the parameters.
        attitude: (n, 3, k) likewise of rotation vectors about the camera's axes.
        sigma: (k,) a priori standard deviations, infinite for none.
        image_mm: (m, 2, k) likewise of image coordinates, mm; None: they depend on no parameter.

    Returns:
        Values and covariance; a parameter that the observations do not contain has an infinite
        variance or keeps that of its prior.

    Source: docs/explanation/mathematics/bundle.md#added-parameters.
    """
    rows = result.equations
    count = position.shape[2]
    design = np.zeros((len(rows.misclosure), count))
    for table, groups in ((position, _GNSS_GROUPS), (attitude, (_ATTITUDE_GROUP,))):
        own = np.flatnonzero(np.isin(rows.group, groups))
        design[own] = table[rows.source[own], rows.axis[own]] / rows.sigma[own, None]
    if image_mm is not None:
        design += _without_points(result, image_mm)
    into = np.asarray(rows.reduced.T @ design)
    normal = design.T @ design - into.T @ (result.cofactors @ into)
    normal += np.diag(1.0 / np.square(sigma))
    size = np.sqrt(np.clip(np.diag(design.T @ design) + 1.0 / np.square(sigma), 1e-300, None))
    values, vectors = np.linalg.eigh(normal / size[:, None] / size)
    known = values > 1e-9
    inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T / size[:, None] / size
    # A parameter that takes part in an undetermined direction is not known.
    open_share = np.square(vectors[:, ~known]).sum(axis=1)
    inverse[np.diag_indices(count)] += np.where(open_share > 1e-6, np.inf, 0.0)
    right = design.T @ rows.misclosure
    found = np.where(np.isfinite(inverse), inverse, 0.0) @ right
    return AddedParameters(
        np.where(open_share > 1e-6, np.nan, found), max(1.0, result.sigma0) ** 2 * inverse
    )


def _of(result: Adjustment, points: Indices, prior: MountingPrior | None) -> BlockAdjustment:
    mounting = None
    if result.network.heads and prior is not None:
        mounting = adjusted_mounting(result, prior)
    factor = {g.name: g.factor for g in result.groups if np.isfinite(g.factor)}
    unit = max(1.0, result.sigma0)
    spread = np.sqrt(np.clip(np.einsum("pii->pi", result.point_cofactor), 0.0, None))
    return BlockAdjustment(
        result,
        camera_orientations(result),
        points,
        result.state.points,
        np.where(result.left_out[:, None], np.nan, unit * spread),
        result.rejected | result.left_out[result.network.image_points.point],
        (float(factor.get("image x", 1.0)), float(factor.get("image y", 1.0))),
        mounting,
    )


def _without_points(result: Adjustment, image_mm: Array) -> Array:
    """Rows of derivatives of image coordinates, less what moves of object points absorb."""
    rows = result.equations
    count = image_mm.shape[2]
    design = np.zeros((len(rows.misclosure), count))
    own = np.flatnonzero(np.isin(rows.group, _IMAGE_GROUPS))
    source = rows.source[own]
    weight = np.sqrt(result.weight[source]) / rows.sigma[own]
    design[own] = image_mm[source, rows.group[own]] * weight[:, None]
    seen = rows.point >= 0
    points = int(rows.point.max(initial=-1)) + 1
    part, point = rows.point_part[seen], rows.point[seen]
    normal, right = np.zeros((points, 3, 3)), np.zeros((points, 3, count))
    np.add.at(normal, point, part[:, :, None] * part[:, None, :])
    np.add.at(right, point, part[:, :, None] * design[seen][:, None, :])
    moved = np.linalg.pinv(normal, hermitian=True) @ right
    design[seen] -= np.einsum("na,nak->nk", part, moved[point])
    return design


def adjusted_mounting(result: Adjustment, prior: MountingPrior) -> AdjustedMounting:
    """Corrections of the mounting of the first head, which the calibration gives as none.

    Args:
        result: the adjustment.
        prior: of the mounting.

    Returns:
        Values and standard deviations.
    """
    layout, state = result.layout, result.state
    columns = np.concatenate([layout.head_rotation[0], layout.head_offset[0]])
    spread = np.sqrt(np.clip(result.cofactors[columns, columns], 0.0, None))
    given = np.repeat([prior.boresight_sigma_rad, prior.lever_arm_sigma_m], 3)
    return AdjustedMounting(
        np.concatenate([vectors_from_rotations(state.head_rotation[0][None])[0],
                        state.head_offset[0]]),
        max(1.0, result.sigma0) * spread,
        spread / given,
    )  # fmt: skip

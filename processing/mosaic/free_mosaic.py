"""Free image mosaicking: positions of all sensors from tie points alone.

The adjustment and its statistics are here; the unknowns are laid out in
`processing.mosaic.model`, what observations weigh is in `processing.mosaic.weights`, and whether
the result agrees with the calibration is evaluated in `processing.mosaic.validity`.

Source: docs/explanation/mathematics/mosaicking.md#observation-equations; Ladstädter et al. (2010),
eq. 1-7, tables 1 and 2.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement, corrected_mm_from_raw, start_similarity
from processing.geometry.topology import free_cones, mosaic_cones
from processing.matching.tie_points import PAN_TO_COLOUR, PAN_TO_PAN, TiePoints
from processing.mosaic.adjustment import (
    ConstrainedSolution,
    ObservationBlock,
    normal_equations,
    redundancy_numbers,
    solve,
)
from processing.mosaic.clusters import clustered_cofactor
from processing.mosaic.datum import (
    DatumConstraint,
    datum_candidates,
    datum_constraints,
    layer_constraints,
    mounting_constraints,
)
from processing.mosaic.model import MosaicModel, build_model, placement_at, vip_and_design
from processing.mosaic.moving_objects import one_sided_shifts, shifted_cofactor
from processing.mosaic.weights import (
    CLASSES,
    MosaicSettings,
    TiePointGroup,
    block_after_step,
    block_of,
    class_scales,
    full_weight,
    groups_of,
    initial_weights,
    weight_factors,
)
from processing.rig import Rig

__all__ = [
    "DatumConstraint",
    "Mosaic",
    "MosaicSettings",
    "adjust_mosaic",
    "datum_constraints",
    "free_mosaic",
    "layer_constraints",
    "vip_precision_px",
]

Array = NDArray[np.float64]

_STRAIGHT_PX: Final = 0.05
"""Steps this small change neither derivatives nor, by more than 1e-6 px, their predictions: a step
d is off by d squared over the size of the image."""


@dataclass(frozen=True)
class Mosaic:
    """The outcome of an adjustment; placements in the virtual image and how good they are.

    `values` (u,) are accumulated corrections against the start, `covariance` (u, u) theirs, a
    posteriori, both in the unknowns' own units (see `MosaicModel`); correlated neighbours
    (`processing.mosaic.clusters`) and moving objects (`processing.mosaic.moving_objects`) are in
    it. `residuals_px` (n, 2) is place
    of a minus place of b in the VIP after the adjustment, (x right, y up), for all tie points,
    outliers included; `redundancy_numbers` (n, 2) likewise; `outliers` (n,) marks points not used.
    `sigma0` has no unit; `sigma0_px` is that of one coordinate difference of a P/P pair.
    `used` counts points per pair, `undetermined` names unknowns held at their start.
    `pseudo_observations` is the number of directions held. `supported` is true where calibration
    and platform are observations (`processing.mosaic.calibration_support`).
    """

    method: str
    model: MosaicModel
    start: Mapping[str, SensorPlacement]
    placements: Mapping[str, SensorPlacement]
    sigma0: float
    sigma0_px: float
    sigma0_um: float
    sigma_pp_px: float
    sigma_pc_px: float
    redundancy: float
    observations: int
    values: Array
    covariance: Array
    residuals_px: Array
    redundancy_numbers: Array
    outliers: NDArray[np.bool_]
    used: Mapping[tuple[str, str], int]
    iterations: int
    rank: int
    constrained_rank: int
    constraints: int
    undetermined: tuple[str, ...]
    pseudo_observations: int
    datum_sensors: tuple[str, ...]
    supported: bool = False

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the unknowns, (u,), in the order of `values`."""
        return self.model.names

    def value(self, name: str) -> float:
        """The correction of one unknown.

        Args:
            name: such as `SU00.x`.

        Returns:
            The correction in the unknown's own unit (see `MosaicModel`), such as mm.
        """
        return float(self.values[self.model.names.index(name)])

    def sigma(self, name: str) -> float:
        """The standard deviation of one unknown.

        Args:
            name: such as `SU00.x`.

        Returns:
            A posteriori, in the unknown's own unit.
        """
        i = self.model.names.index(name)
        return math.sqrt(max(float(self.covariance[i, i]), 0.0))


def free_mosaic(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    tie_points: TiePoints,
    *,
    settings: MosaicSettings | None = None,
    excluded_datum_sensors: Sequence[str] = (),
    begin: Mosaic | None = None,
    prior: Array | None = None,
) -> Mosaic:
    """Adjust all sensors of the PAN cones and the layer of the colour master.

    Which unknowns there are follows from the rig: with a master cone the layers of the others are
    projective transformations onto its own; without one the PAN heads converge, and each has the
    three angles of its mounting, whose mean turn is zero.

    Args:
        rig: the camera.
        placements: the start: calibration + TDM, layers by platform calibration.
        tie_points: matched points.
        settings: None takes the defaults.
        excluded_datum_sensors: master sensors the datum (eq. 6) does not rest on.
        begin: an adjustment of the same points in another datum, to go on from.
        prior: information on the unknowns in addition to the points, see `adjust_mosaic`.

    Returns:
        The mosaic. What tie points do not determine (missing frames, empty overlaps) stays at its
        start and is named.

    Source: Ladstädter et al. (2010), eq. 1-7.
    """
    start = _starts(placements)
    cones = mosaic_cones(rig)
    free_sensors = [s.name for cone in cones if len(cone.sensors) >= 2 for s in cone.sensors]
    free_layers, free_mountings = free_cones(rig)
    model = build_model(
        rig,
        start,
        free_sensors=free_sensors,
        free_layers=free_layers,
        free_mountings=free_mountings,
    )
    touched = _touched(tie_points)
    datum = tuple(
        s.name
        for s in datum_candidates(rig)
        if s.name in touched and s.name not in excluded_datum_sensors
    )
    if rig.master_cone is None:
        constraints = mounting_constraints(dict.fromkeys(rig.cone_of(s).name for s in datum))
    else:
        datum = tuple(name for name in datum if name in model.sensors)
        constraints = datum_constraints(start, datum)
    for cone in cones:
        present = [s.name for s in cone.sensors if s.name in touched]
        if cone.name != rig.master_cone and len(cone.sensors) >= 2 and present:
            constraints += layer_constraints(present)
    return adjust_mosaic(
        rig,
        start,
        tie_points,
        model=model,
        constraints=constraints,
        settings=settings or MosaicSettings(),
        method="free",
        datum_sensors=datum,
        begin=begin,
        prior=prior,
    )


def adjust_mosaic(
    rig: Rig,
    start: Mapping[str, SensorPlacement],
    tie_points: TiePoints,
    *,
    model: MosaicModel,
    constraints: Sequence[DatumConstraint],
    settings: MosaicSettings,
    method: str,
    datum_sensors: tuple[str, ...],
    kinds: Sequence[int] = CLASSES,
    begin: Mosaic | None = None,
    prior: Array | None = None,
) -> Mosaic:
    """Gauss-Newton with robust weights, variance components and data snooping.

    Each round linearises (but after a step too small to matter), weighs (a soft weight while the
    model is still far off, then points whose normalised residual exceeds `outlier_limit` are left
    out), solves, and estimates what the two classes of points are worth, until corrections and
    outliers no longer change.

    Args:
        rig: the camera.
        start: placements by calibration + TDM, by sensor name.
        tie_points: matched points.
        model: the unknowns.
        constraints: the datum.
        settings: a-priori accuracy and limits.
        method: name of the method, for the result.
        datum_sensors: names of the sensors the datum rests on, for the result.
        kinds: classes of tie points that take part, `PAN_TO_PAN` or `PAN_TO_COLOUR`.
        begin: an adjustment of the same points and unknowns to go on from, without a first look or
            soft weights.
        prior: information (u, u) that draws the unknowns to their start, in the inverse square of
            `MosaicModel.units` and of a weight like that of the points. With it nothing else is
            held: what is known of every unknown is in it, and is not to be taken for better known.

    Returns:
        The mosaic.

    Source: docs/explanation/mathematics/mosaicking.md#observation-equations and #weights.
    """
    groups = groups_of(rig, start, tie_points, settings, kinds)
    for group in groups:
        if begin is None:
            group.factor = initial_weights(model, start, group)
        else:
            group.factor = (~begin.outliers[group.rows]).astype(np.float64)
    matrix = np.zeros((len(constraints), len(model.names)))
    for i, constraint in enumerate(constraints):
        for name, coefficient in constraint.coefficients.items():
            matrix[i, model.names.index(name)] = coefficient
    scaled_matrix = matrix * model.units
    values = np.zeros(len(model.names)) if begin is None else begin.values.copy()
    class_scale = dict.fromkeys(CLASSES, 1.0) if begin is None else _scales_of(begin, settings)
    least = settings.min_iterations if begin is None else 1
    solution: ConstrainedSolution | None = None
    blocks: list[ObservationBlock] = []
    iterations = 0
    bent = True
    for iterations in range(1, settings.max_iterations + 1):
        if bent:
            blocks = [block_of(model, start, g, values, class_scale[g.kind]) for g in groups]
        else:
            blocks = [
                block_after_step(block, g, class_scale[g.kind])
                for block, g in zip(blocks, groups, strict=True)
            ]
        normal, right = normal_equations(blocks, len(values))
        if prior is not None:
            normal += prior
            right -= prior @ (values / model.units)
        solution = solve(
            normal,
            right,
            scaled_matrix,
            -scaled_matrix @ (values / model.units),
            fixed_at=-values / model.units,
            min_information=1.0 / settings.undetermined_px**2 if prior is None else 0.0,
        )
        values = values + solution.dp * model.units
        soft = iterations < least - 1
        changed = False
        for group, block in zip(groups, blocks, strict=True):
            v = (solution.dp[block.columns] @ block.design - block.misclosure).reshape(2, -1).T
            weightless = dataclasses.replace(block, weight=full_weight(group, class_scale))
            group.difference = v
            group.redundancy = redundancy_numbers(weightless, solution.cofactor).reshape(2, -1).T
        class_scale, moved = class_scales(groups, class_scale, settings)
        for group, factor in zip(groups, weight_factors(groups, settings, soft=soft), strict=True):
            changed = changed or bool(np.any((factor > 0.0) != (group.factor > 0.0)))
            group.factor = factor
        largest = float(np.abs(solution.dp).max(initial=0.0))
        bent, still = largest > _STRAIGHT_PX, largest < settings.converged_px
        if iterations >= least and still and not changed and not moved:
            break
    return _mosaic(
        start,
        tie_points,
        model,
        settings,
        _Adjusted(groups, blocks, class_scale, values, solution, iterations),
        method=method,
        constraints=len(constraints),
        datum_sensors=datum_sensors,
        supported=prior is not None,
    )


@dataclass(frozen=True)
class _Adjusted:
    """What the iterations of an adjustment ended with."""

    groups: Sequence[TiePointGroup]
    blocks: Sequence[ObservationBlock]
    class_scale: Mapping[int, float]
    values: Array
    solution: ConstrainedSolution | None
    iterations: int


def _mosaic(
    start: Mapping[str, SensorPlacement],
    tie_points: TiePoints,
    model: MosaicModel,
    settings: MosaicSettings,
    adjusted: _Adjusted,
    *,
    method: str,
    constraints: int,
    datum_sensors: tuple[str, ...],
    supported: bool,
) -> Mosaic:
    class_scale, solution = adjusted.class_scale, adjusted.solution
    unknowns = len(model.names)
    n = len(tie_points)
    residuals, redundancy = np.full((n, 2), np.nan), np.full((n, 2), np.nan)
    outliers = np.ones(n, dtype=np.bool_)
    squares, used_points, free = 0.0, 0, 0.0
    used = dict.fromkeys(tie_points.pairs, 0)
    for group in adjusted.groups:
        good = group.factor > 0.0
        residuals[group.rows] = group.difference
        redundancy[group.rows] = group.redundancy
        outliers[group.rows] = ~good
        used[(group.a, group.b)] = int(good.sum())
        used_points += int(good.sum())
        free += float(group.redundancy[good].sum())
        sigma = group.sigma[good] * class_scale[group.kind]
        squares += float(np.sum((group.difference[good] / sigma[:, None]) ** 2))
    undetermined = np.empty((unknowns, 0)) if solution is None else solution.undetermined
    held = undetermined.shape[1]
    # With a prior the unknowns take less from the points than one degree of freedom each.
    freedom = free if supported else 2 * used_points - unknowns + constraints + held
    sigma0 = math.sqrt(squares / freedom) if freedom > 0 else 1.0
    cofactor = np.zeros((unknowns, unknowns))
    if solution is not None:
        scales = np.array([class_scale[group.kind] for group in adjusted.groups])
        cofactor = clustered_cofactor(
            adjusted.groups,
            adjusted.blocks,
            solution.cofactor,
            scales,
            sigma0,
            pitch_mm=model.pitch_mm,
        )
        shifts = one_sided_shifts(adjusted.groups, settings)
        cofactor = cofactor + shifted_cofactor(
            adjusted.groups, adjusted.blocks, solution.cofactor, scales, shifts
        )
    ratio = class_scale[PAN_TO_COLOUR] / class_scale[PAN_TO_PAN]
    pitch_um = model.pitch_mm * 1e3
    sigma0_px = sigma0 * settings.sigma_pp_px * class_scale[PAN_TO_PAN]
    return Mosaic(
        method=method,
        model=model,
        start=start,
        placements={name: placement_at(model, p, adjusted.values) for name, p in start.items()},
        sigma0=sigma0,
        sigma0_px=sigma0_px,
        sigma0_um=sigma0_px * pitch_um,
        sigma_pp_px=sigma0_px,
        sigma_pc_px=sigma0 * settings.sigma_pc_px * ratio * class_scale[PAN_TO_PAN],
        redundancy=float(freedom),
        observations=2 * used_points,
        values=adjusted.values,
        covariance=cofactor * np.outer(model.units, model.units) * sigma0**2,
        residuals_px=residuals,
        redundancy_numbers=redundancy,
        outliers=outliers,
        used=used,
        iterations=adjusted.iterations,
        rank=0 if solution is None else solution.rank,
        constrained_rank=0 if solution is None else solution.constrained_rank,
        constraints=constraints,
        undetermined=_named(model, undetermined),
        pseudo_observations=held,
        datum_sensors=datum_sensors,
        supported=supported,
    )


def _starts(placements: Mapping[str, SensorPlacement]) -> dict[str, SensorPlacement]:
    """Placements with S at calibration + TDM, the reference of datum and validity."""
    return {
        name: dataclasses.replace(p, similarity=start_similarity(p))
        for name, p in placements.items()
    }


def _touched(tie_points: TiePoints) -> set[str]:
    seen = set(np.unique(tie_points.sensor_a)) | set(np.unique(tie_points.sensor_b))
    return {tie_points.names[i] for i in seen}


def _scales_of(mosaic: Mosaic, settings: MosaicSettings) -> dict[int, float]:
    """The factors on the a-priori sigmas that an adjustment ended with."""
    pan = mosaic.sigma_pp_px / settings.sigma_pp_px
    ratio = mosaic.sigma_pc_px / settings.sigma_pc_px / pan
    return {PAN_TO_PAN: 1.0, PAN_TO_COLOUR: ratio}


def _named(model: MosaicModel, undetermined: Array) -> tuple[str, ...]:
    if not undetermined.shape[1]:
        return ()
    share = np.sqrt(np.sum(undetermined**2, axis=1))
    limit = min(0.3, float(share.max()))
    return tuple(name for name, s in zip(model.names, share, strict=True) if s >= limit)


def vip_precision_px(mosaic: Mosaic, sensor: str, colrow: Array) -> Array:
    """Standard deviation of where raw pixels fall, by the tie points alone.

    It holds in the mosaic's datum; calibration and TDM are not part of it.

    Args:
        mosaic: the adjustment.
        sensor: name of the sensor.
        colrow: raw column and row, (n, 2).

    Returns:
        x and y in the virtual image, (n, 2), px.

    Source: docs/explanation/mathematics/mosaicking.md#accuracy.
    """
    start = mosaic.start[sensor]
    _, columns, design = vip_and_design(
        mosaic.model, start, corrected_mm_from_raw(start, colrow), mosaic.values
    )
    q = mosaic.covariance[np.ix_(columns, columns)]
    variance = np.einsum("ian,ij,jan->na", design, q, design)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

"""What the observations of a mosaic weigh: classes of points, shared corners, blunders.

A-priori accuracy, variance components and data snooping; the adjustment that asks for them is in
`processing.mosaic.free_mosaic`.

Source: docs/explanation/mathematics/mosaicking.md#weights.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement, corrected_mm_from_raw, vip_mm_from_raw
from processing.geometry.projective import apply_projective
from processing.geometry.topology import corners
from processing.matching.tie_points import PAN_TO_COLOUR, PAN_TO_PAN, TiePoints
from processing.mosaic.adjustment import ObservationBlock
from processing.mosaic.model import MosaicModel, vip_and_design
from processing.rig import Rig

Array = NDArray[np.float64]

CLASSES = (PAN_TO_PAN, PAN_TO_COLOUR)

_HUBER = 2.0
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True)
class MosaicSettings:
    """A-priori accuracy and the rules of the adjustment.

    `sigma_pp_px`, `sigma_pc_px` are the a-priori standard deviations of one coordinate difference
    of a typical P/P and P/C point, in PAN px; the ratio of the two is found again from the data.
    `parallax_px` is what relief leaves in P/C points of this exposure.
    A direction of the unknowns that tie points know worse than `undetermined_px` (at the farthest
    point of the image) is held at its start, to so much: calibration and platform know it better.
    """

    sigma_pp_px: float = 0.1
    sigma_pc_px: float = 0.3
    parallax_px: float = 0.0
    outlier_limit: float = 4.0
    max_iterations: int = 20
    min_iterations: int = 3
    converged_px: float = 1e-3
    min_class_redundancy: float = 30.0
    undetermined_px: float = 1.0


@dataclass
class TiePointGroup:
    """The tie points of one pair of sensors, ready for linearisation."""

    a: str
    b: str
    kind: int
    rows: NDArray[np.int64]
    corrected_a: Array
    corrected_b: Array
    sigma: Array
    difference: Array = field(default_factory=lambda: np.empty((0, 2)))
    redundancy: Array = field(default_factory=lambda: np.empty((0, 2)))
    factor: Array = field(default_factory=lambda: np.empty(0))


def groups_of(
    rig: Rig,
    start: Mapping[str, SensorPlacement],
    tie_points: TiePoints,
    settings: MosaicSettings,
    kinds: Sequence[int],
) -> list[TiePointGroup]:
    """Tie points by pair of sensors, with their a-priori accuracy.

    Args:
        rig: the camera.
        start: placements by calibration + TDM, by sensor name.
        tie_points: matched points.
        settings: a-priori standard deviations.
        kinds: classes that take part, `PAN_TO_PAN` or `PAN_TO_COLOUR`.

    Returns:
        Pairs that have points.

    Source: docs/explanation/mathematics/mosaicking.md#weights.
    """
    typical = {}
    for kind in CLASSES:
        sigmas = tie_points.sigma_px[tie_points.kind == kind]
        typical[kind] = float(np.median(sigmas)) if len(sigmas) else 1.0
    apriori = {
        PAN_TO_PAN: settings.sigma_pp_px,
        PAN_TO_COLOUR: math.hypot(settings.sigma_pc_px, settings.parallax_px),
    }
    shared = corners(rig)
    groups = []
    for number, (a, b) in enumerate(tie_points.pairs):
        rows = np.flatnonzero(tie_points.overlap == number)
        if not len(rows):
            continue
        kind = int(tie_points.kind[rows[0]])
        if kind not in kinds:
            continue
        relative = tie_points.sigma_px[rows] / typical[kind]
        if kind == PAN_TO_COLOUR:
            # Parallax is not smaller where the match is sharper.
            share = settings.sigma_pc_px * relative
            sigma = np.hypot(share, settings.parallax_px)
        else:
            sigma = apriori[kind] * relative
            xy = vip_mm_from_raw(start[a], tie_points.raw_a[rows])
            for corner in shared:
                # m differences of n images hold the information of n - 1.
                meeting = sum(
                    p[0] in corner.sensors and p[1] in corner.sensors for p in tie_points.pairs
                )
                inside = corner.rectangle.contains(xy)
                sigma[inside] *= math.sqrt(max(1.0, meeting / (len(corner.sensors) - 1)))
        groups.append(
            TiePointGroup(
                a=a,
                b=b,
                kind=kind,
                rows=rows,
                corrected_a=corrected_mm_from_raw(start[a], tie_points.raw_a[rows]),
                corrected_b=corrected_mm_from_raw(start[b], tie_points.raw_b[rows]),
                sigma=np.maximum(sigma, 1e-6),
            )
        )
    return groups


def initial_weights(
    model: MosaicModel, start: Mapping[str, SensorPlacement], group: TiePointGroup
) -> Array:
    """Weight factors before any adjustment: points far from their pair's median are left out.

    Args:
        model: the unknowns.
        start: placements by calibration + TDM, by sensor name.
        group: m points; receives their differences at the start, px, and redundancies of one.

    Returns:
        1 or, for a point left out, 0, (m,).
    """
    a = _started_px(model, start[group.a], group.corrected_a)
    b = _started_px(model, start[group.b], group.corrected_b)
    off = a - b
    off = np.abs(off - np.median(off, axis=0))
    spread = np.maximum(_MAD_TO_SIGMA * np.median(off, axis=0), 0.2)
    group.difference = a - b
    group.redundancy = np.ones((len(a), 2))
    return np.asarray((off < 6.0 * spread).all(axis=1), dtype=np.float64)


def _started_px(model: MosaicModel, start: SensorPlacement, corrected_mm: Array) -> Array:
    xy = apply_projective(start.layer @ start.similarity.matrix, corrected_mm)
    return np.asarray(xy / model.pitch_mm)


def full_weight(group: TiePointGroup, class_scale: Mapping[int, float]) -> Array:
    """Weights as if no point were left out.

    Args:
        group: m points.
        class_scale: factor on the a-priori sigmas, by kind.

    Returns:
        1 / sigma squared, (2 m,), px^-2: x of all points, then y.
    """
    return np.tile(1.0 / (group.sigma * class_scale[group.kind]) ** 2, 2)


def block_of(
    model: MosaicModel,
    start: Mapping[str, SensorPlacement],
    group: TiePointGroup,
    values: Array,
    scale: float,
) -> ObservationBlock:
    """Observation equations of a group, linearised.

    Args:
        model: the unknowns.
        start: placements by calibration + TDM, by sensor name.
        group: m points.
        values: the unknowns at which to linearise, (u,).
        scale: factor on the a-priori sigmas.

    Returns:
        2 m equations, px: x of all points, then y; unknowns in `MosaicModel.units`.

    Source: docs/explanation/mathematics/mosaicking.md#observation-equations.
    """
    a, columns_a, design_a = vip_and_design(model, start[group.a], group.corrected_a, values)
    b, columns_b, design_b = vip_and_design(model, start[group.b], group.corrected_b, values)
    columns = np.concatenate([columns_a, columns_b])
    design = np.empty((len(columns), 2 * len(a)))
    k = len(columns_a)
    units = model.units[columns][:, None]
    np.multiply(design_a.reshape(k, 2 * len(a)), units[:k], out=design[:k])
    np.multiply(design_b.reshape(len(columns_b), 2 * len(b)), -units[k:], out=design[k:])
    return ObservationBlock(
        columns=columns,
        design=design,
        misclosure=(b - a).T.reshape(-1),
        weight=np.tile(group.factor / (group.sigma * scale) ** 2, 2),
    )


def block_after_step(
    block: ObservationBlock, group: TiePointGroup, scale: float
) -> ObservationBlock:
    """A block after a step along its derivatives that left `group.difference`, newly weighed.

    Args:
        block: before the step.
        group: its points.
        scale: factor on the a-priori sigmas.

    Returns:
        The block with the same derivatives.
    """
    return replace(
        block,
        misclosure=-group.difference.T.reshape(-1),
        weight=np.tile(group.factor / (group.sigma * scale) ** 2, 2),
    )


def class_scales(
    groups: Sequence[TiePointGroup], before: Mapping[int, float], settings: MosaicSettings
) -> tuple[dict[int, float], bool]:
    """Variance components: P/P and P/C sigmas that make both classes fit their residuals.

    P/P keeps its a-priori sigma (unit weight); only the ratio is estimated.

    Args:
        groups: points with differences and redundancies of an adjustment.
        before: factors of that adjustment, by kind.
        settings: `min_class_redundancy`, below which the factors stay.

    Returns:
        Factors on the a-priori sigmas by kind, and whether their ratio moved by more than two per
        mille.

    Source: docs/explanation/mathematics/mosaicking.md#weights.
    """
    variance = {}
    for kind in CLASSES:
        squares = redundancy = 0.0
        for group in groups:
            if group.kind == kind:
                w = group.factor[:, None]
                squares += float(np.sum(w * (group.difference / group.sigma[:, None]) ** 2))
                redundancy += float(np.sum((w > 0.0) * group.redundancy))
        if redundancy < settings.min_class_redundancy or squares <= 0.0:
            return dict(before), False
        variance[kind] = squares / redundancy
    ratio = math.sqrt(variance[PAN_TO_COLOUR] / variance[PAN_TO_PAN])
    after = {PAN_TO_PAN: 1.0, PAN_TO_COLOUR: ratio}
    return after, abs(ratio / before[PAN_TO_COLOUR] - 1.0) > 0.002


def weight_factors(
    groups: Sequence[TiePointGroup], settings: MosaicSettings, *, soft: bool
) -> list[Array]:
    """Weight factors of each group from normalised residuals, the larger of both coordinates.

    Args:
        groups: points with differences and redundancies of an adjustment.
        settings: `outlier_limit`.
        soft: Huber about the group's median, for rounds in which the model does not fit yet. Else
            zero beyond the limit (data snooping, w-test against the robust spread of the class),
            one within.

    Returns:
        0 to 1, (m,) for each group.

    Source: docs/explanation/mathematics/mosaicking.md#weights.
    """
    factors = []
    for w in normalised_residuals(groups, soft=soft):
        largest = np.abs(w).max(axis=1)
        if soft:
            factors.append(np.minimum(1.0, _HUBER / np.maximum(largest, 1e-12)))
        else:
            factors.append((largest <= settings.outlier_limit).astype(np.float64))
    return factors


def normalised_residuals(groups: Sequence[TiePointGroup], *, soft: bool) -> list[Array]:
    """Residuals over their standard deviation and the robust spread of their class.

    Args:
        groups: points with differences and redundancies of an adjustment.
        soft: whether residuals count from the group's median.

    Returns:
        x and y, (m, 2) for each group.

    Source: docs/explanation/mathematics/mosaicking.md#weights.
    """
    normalised = []
    for group in groups:
        unit = group.sigma[:, None] * np.sqrt(np.maximum(group.redundancy, 1e-3))
        middle = np.median(group.difference, axis=0) if soft else 0.0
        normalised.append((group.difference - middle) / unit)
    spread = {}
    for kind in CLASSES:
        every = [n.ravel() for n, g in zip(normalised, groups, strict=True) if g.kind == kind]
        if every:
            typical = float(np.median(np.abs(np.concatenate(every))))
            spread[kind] = max(_MAD_TO_SIGMA * typical, 1e-9)
    return [n / spread[g.kind] for n, g in zip(normalised, groups, strict=True)]

"""Figures of the stitching of one exposure: tie points, fit, displacements, balance, bands."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

import numpy as np

from processing.image.balance import Balance
from processing.image.colour import BandRegistration
from processing.image.head_response import HeadResponse, head_response
from processing.matching.tie_points import PAN_TO_COLOUR, PAN_TO_PAN, TiePoints
from processing.mosaic.free_mosaic import Mosaic
from processing.mosaic.validity import Validity
from processing.quality.figures import FigureGroup
from processing.quality.figures.image import BalanceFigures, ResponseFigures
from processing.quality.figures.stitching import (
    AdjustmentFigures,
    BandFitFigures,
    DisplacedSensorFigures,
    DisplacementFigures,
    DisplacementTestFigures,
    GreenFigures,
    MisreadProbeFigures,
    PoorestOverlapFigures,
    TiePointFigures,
)
from processing.radiometry.level1 import level1_counts_per_dn
from processing.rig import Rig


def stitching_figures(
    rig: Rig,
    tie_points: TiePoints,
    mosaic: Mosaic,
    *,
    validity: Validity | None,
    balance: Balance,
    bands: Sequence[BandRegistration],
    present: Collection[str],
    changed: Collection[str] = (),
) -> Iterator[FigureGroup]:
    """Tie points, adjustment, displaced sensor, balance and colour registration.

    Args:
        rig: the camera.
        tie_points: those the mosaic is of.
        mosaic: what the image was made with.
        validity: test of the calibration; None where it was not made.
        balance: of the PAN heads.
        bands: how the other colours were registered to green.
        present: sensors with a frame; overlaps of others do not count as poor in tie points.
        changed: sensors whose signal changes within the frame, which say nothing about gains.

    Yields:
        Groups of figures.
    """
    yield _adjustment(mosaic)
    response = head_response(balance.cells, changed)
    if response is not None:
        yield _response(rig, response)
    # An offset draws the gains, a gain no offset.
    odd = {response.sensor} if response is not None and response.sensor else set()
    outlier = balance.outlier_without({*changed, *odd})
    yield (
        BalanceFigures(balance.spread)
        if outlier is None
        else BalanceFigures(balance.spread, outlier.sensor, outlier.signal, outlier.alternatives)
    )
    yield from _tie_points(rig, tie_points, mosaic)
    poorest = poorest_overlap(rig, mosaic, present)
    if poorest is not None:
        yield PoorestOverlapFigures(mosaic.used[poorest], "-".join(poorest))
    yield from _displacement(validity)
    yield BandFitFigures(
        points_by_band={band.band: band.points for band in bands},
        rms_px_by_band={band.band: band.rms_px for band in bands},
    )


def _response(rig: Rig, response: HeadResponse) -> ResponseFigures:
    counts = max(level1_counts_per_dn(s.bits) for cone in rig.pan_cones for s in cone.sensors)
    if response.sensor:
        counts = level1_counts_per_dn(rig.sensor(response.sensor).bits)
    return ResponseFigures(
        response_sensor=response.sensor or None,
        response_offset_dn=None if response.offset is None else response.offset / counts,
        response_slope=response.slope,
        response_axis=None if response.slope is None else response.axis,
        response_alternatives=response.alternatives,
        response_limit_dn=response.offset_limit / counts,
    )


def poorest_overlap(rig: Rig, mosaic: Mosaic, present: Collection[str]) -> tuple[str, str] | None:
    """The overlap of PAN sensors with the fewest tie points in use.

    Args:
        rig: the camera.
        mosaic: the adjustment.
        present: sensors with a frame; overlaps of others are left out.

    Returns:
        Names of both sensors; None without such an overlap.
    """
    pan = {s.name for cone in rig.pan_cones for s in cone.sensors if s.name in present}
    overlaps = [pair for pair in mosaic.used if pan.issuperset(pair)]
    return min(overlaps, key=lambda pair: mosaic.used[pair], default=None)


def _adjustment(mosaic: Mosaic) -> AdjustmentFigures:
    is_redundant = mosaic.redundancy > 0
    unknowns = dict.fromkeys(name.split(".")[0] for name in mosaic.undetermined)
    return AdjustmentFigures(
        sigma0=mosaic.sigma0 if is_redundant else None,
        sigma0_px=mosaic.sigma0_px if is_redundant else None,
        sigma0_um=mosaic.sigma0_um if is_redundant else None,
        redundancy=mosaic.redundancy,
        outliers=int(np.count_nonzero(mosaic.outliers)),
        undetermined=tuple(unknowns),
    )


def _tie_points(rig: Rig, tie_points: TiePoints, mosaic: Mosaic) -> Iterator[FigureGroup]:
    used = ~mosaic.outliers
    colour = used & (tie_points.kind == PAN_TO_COLOUR)
    yield TiePointFigures(
        tie_points_pp=int(np.count_nonzero(used & (tie_points.kind == PAN_TO_PAN))),
        tie_points_pc=int(np.count_nonzero(colour)),
    )
    if rig.virtual_image is not None and colour.any():
        squares = np.sum(mosaic.residuals_px[colour] ** 2, axis=1)
        yield GreenFigures(float(np.sqrt(squares.mean())) / rig.virtual_image.colour_ratio)


def _displacement(validity: Validity | None) -> Iterator[FigureGroup]:
    if validity is None or not validity.hypotheses:
        yield DisplacedSensorFigures()
        return
    moved = validity.displaced
    is_one = not validity.several_displaced
    yield DisplacedSensorFigures(moved.sensor if moved is not None and is_one else None)
    yield DisplacementTestFigures(
        displacement_test=validity.hypotheses[0].statistic / validity.limit,
        relative_displacements=tuple(
            f"{pair.sensor_a}-{pair.sensor_b}" for pair in validity.relative if pair.significant
        ),
    )
    if (bias := validity.probe_bias) is not None:
        yield MisreadProbeFigures(bias.probe, bias.bias_k, bias.sigma_k)
    if moved is not None:
        yield DisplacementFigures(
            displacement_x_px=moved.dx_px,
            displacement_y_px=moved.dy_px,
            displacement_sigma_px=max(moved.sigma_x_px, moved.sigma_y_px),
            displaced_alternatives=tuple(validity.alternatives),
            displaced_several=1 if validity.several_displaced else None,
        )

"""Adjustment of tie points to tested placements, and the choice of the mosaic of an image.

The order of adjustment, test, robust datum and support is decided here; each has a module of
its own (`processing.mosaic.free_mosaic`, `processing.mosaic.validity`,
`processing.mosaic.calibration_support`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from processing.geometry.placement import SensorPlacement, start_similarity
from processing.matching.tie_points import TiePoints
from processing.mosaic.calibration_support import (
    contradicted_colour,
    supported_mosaic,
    weakly_determined_sensors,
)
from processing.mosaic.confirmed_points import unconfirmed
from processing.mosaic.fixed_mosaic import fixed_mosaic
from processing.mosaic.free_mosaic import Mosaic, MosaicSettings, free_mosaic
from processing.mosaic.model import residuals_px
from processing.mosaic.mounting import most_scaled_head, verified_mosaic
from processing.mosaic.pan_only import pan_only_mosaic
from processing.mosaic.readout_slips import Slip, find_slips, inside_slips, of_sensor, slip_of
from processing.mosaic.validity import Validity, evaluate_master, robust_datum
from processing.rig import Rig

SLIP_ROUNDS: Final = 4
Method = Literal["free", "fixed", "pan-only"]
Placements = Mapping[str, SensorPlacement]


@dataclass(frozen=True)
class Stitching:
    """The mosaics of one exposure.

    `tie_points` are those accepted. `equal_datum` has its datum over all master sensors, `free`
    over those in place, both by tie points alone; `image` is what the image is made with: `free`,
    or supported by calibration because of the sensors `weak`. `slips` are shifted bands of frames,
    whose tie points are not among those accepted. `validity` is None with the methods that are
    there to be compared with.
    """

    tie_points: TiePoints
    equal_datum: Mosaic
    free: Mosaic
    image: Mosaic
    validity: Validity | None
    weak: tuple[str, ...]
    slips: tuple[Slip, ...] = ()


def stitch(
    rig: Rig,
    start: Placements,
    tie_points: TiePoints,
    *,
    present: Collection[str],
    temperatures_c: Mapping[str, float],
    method: Method,
    settings: MosaicSettings,
    ends: TiePoints | None = None,
) -> Stitching:
    """Adjust, test, correct the datum, and support what tie points do not determine.

    Args:
        rig: the camera.
        start: calibration + TDM, layers by platform calibration.
        tie_points: matched points.
        present: sensors with a frame.
        temperatures_c: temperatures that were read, by probe name.
        method: "free", or one to be compared with.
        settings: of the adjustment.
        ends: points along the ends of frames, which are searched for read-out slips alone.

    Returns:
        The mosaics, their test and what was found.
    """
    if method != "free":
        other = fixed_mosaic if method == "fixed" else pan_only_mosaic
        mosaic = other(rig, start, tie_points, settings=settings)
        if method == "pan-only":
            mosaic = verified_mosaic(rig, mosaic, tie_points)
        return Stitching(tie_points, mosaic, mosaic, mosaic, None, ())
    tie_points = tie_points.only(~unconfirmed(rig, start, tie_points))
    mosaic = free_mosaic(rig, start, tie_points, settings=settings)
    if ends is None:
        ends = tie_points.only(np.zeros(len(tie_points), np.bool_))
    tie_points, mosaic, slips = _without_slips(rig, start, tie_points, ends, mosaic, settings)
    validity = evaluate_master(rig, mosaic, temperatures_c)
    contradicted = contradicted_colour(rig, tie_points, mosaic, validity)
    if contradicted.any():
        fewer = tie_points.only(~contradicted)
        without = free_mosaic(rig, start, fewer, settings=settings)
        evaluated = evaluate_master(rig, without, temperatures_c)
        if not contradicted_colour(rig, tie_points, without, evaluated).any():
            # P/P points do not say so: it was a cloud, or something else that is nearer.
            tie_points, mosaic, validity = fewer, without, evaluated
    mosaic = verified_mosaic(rig, mosaic, tie_points)
    robust = robust_datum(rig, start, tie_points, mosaic, validity, settings=settings)
    weak = weakly_determined_sensors(rig, robust, present)
    image = robust
    if weak:
        image = supported_mosaic(
            rig, start, tie_points, robust, validity, temperatures_c, settings=settings
        )
    return Stitching(tie_points, mosaic, robust, image, validity, weak, slips)


def _without_slips(
    rig: Rig,
    start: Placements,
    tie_points: TiePoints,
    ends: TiePoints,
    mosaic: Mosaic,
    settings: MosaicSettings,
) -> tuple[TiePoints, Mosaic, tuple[Slip, ...]]:
    """Leave out the tie points of shifted bands and adjust again.

    An adjustment with a shifted band in it spreads the shift over healthy sensors and bends the
    frame to meet it halfway. Its size and reach are measured with the frame itself left out. A head
    of another scale is searched at that scale: its residuals would hide a band, or seem to be one.
    """
    slips: tuple[Slip, ...] = ()
    scaled, adjusted = _rescaled(rig, start, tie_points, mosaic, settings)
    for _ in range(SLIP_ROUNDS):
        searched = tie_points.joined(ends)
        of_ends = residuals_px(adjusted.model, adjusted.placements, ends)
        found = find_slips(rig, searched, np.concatenate([adjusted.residuals_px, of_ends]))
        if not found:
            break
        candidate = found[0].sensor
        others = tie_points.only(~of_sensor(tie_points, candidate))
        without = free_mosaic(rig, scaled, others, settings=settings)
        seen = residuals_px(without.model, without.placements, searched)
        slip = slip_of(rig, searched, seen, candidate) or found[0]
        slip = replace(slip, alternatives=found[0].alternatives)
        slips += (slip,)
        tie_points = tie_points.only(~inside_slips(tie_points, (slip,)))
        ends = ends.only(~inside_slips(ends, (slip,)))
        adjusted = mosaic = free_mosaic(rig, scaled, tie_points, settings=settings)
    if slips and scaled is not start:
        mosaic = free_mosaic(rig, start, tie_points, settings=settings)
    return tie_points, mosaic, slips


def _rescaled(
    rig: Rig,
    start: Placements,
    tie_points: TiePoints,
    mosaic: Mosaic,
    settings: MosaicSettings,
) -> tuple[Placements, Mosaic]:
    """Placements with converging heads at the scales their neighbours show, and their mosaic."""
    for _ in mosaic.model.mountings:
        head = most_scaled_head(rig, mosaic, tie_points)
        if head is None:
            break
        name, scale = head
        start = {
            sensor: _scaled(p, 1.0 + scale) if p.cone.name == name else p
            for sensor, p in start.items()
        }
        mosaic = free_mosaic(rig, start, tie_points, settings=settings)
    return start, mosaic


def _scaled(placement: SensorPlacement, factor: float) -> SensorPlacement:
    """The placement of a head with another principal distance."""
    other = replace(placement, f_ratio=placement.f_ratio * factor)
    return replace(other, similarity=start_similarity(other))

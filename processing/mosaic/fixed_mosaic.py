"""The earlier stitching method, kept as a baseline: calibrated sensor positions, layers by P alone.

PAN layers go onto the master layer by P/P points, then green onto the PAN by P/C points, each by
a projective transformation; the free method is in `processing.mosaic.free_mosaic`.

Source: docs/explanation/mathematics/mosaicking.md#earlier-method; Ladstädter et al. (2010), "Image
post processing", steps 1-6 of the previous versions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from processing.geometry.placement import SensorPlacement
from processing.geometry.topology import free_cones
from processing.matching.tie_points import PAN_TO_COLOUR, PAN_TO_PAN, TiePoints
from processing.mosaic.datum import DatumConstraint, datum_candidates
from processing.mosaic.free_mosaic import (
    Mosaic,
    MosaicSettings,
    adjust_mosaic,
)
from processing.mosaic.model import ROTATION_NAMES, build_model
from processing.rig import Rig


def fixed_mosaic(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    tie_points: TiePoints,
    *,
    settings: MosaicSettings | None = None,
) -> Mosaic:
    """Stitch with sensors at their given positions: 8 unknowns per layer but the master's.

    Converging PAN heads, which have no master, stay at the angles of the platform calibration.

    Args:
        rig: the camera.
        placements: positions taken as they are: calibration, with or without TDM.
        tie_points: matched points.
        settings: None takes the defaults.

    Returns:
        The mosaic; sigma0 is that of the P/P step (of P/C where there are no P/P points), and the
        covariance of green does not hold the PAN's.
    """
    settings = settings or MosaicSettings()
    mountings = free_cones(rig)[1]
    pan_layers = [c.name for c in rig.pan_cones if c.name not in (rig.master_cone, *mountings)]
    colour = rig.colour_master_cone
    colour_layers = [] if colour is None or rig.cone(colour).role == "pan" else [colour]
    pan = adjust_mosaic(
        rig,
        placements,
        tie_points,
        model=build_model(
            rig, placements, free_sensors=(), free_layers=pan_layers, free_mountings=mountings
        ),
        constraints=[
            DatumConstraint({f"{cone}.{axis}": 1.0})
            for cone in mountings
            for axis in ROTATION_NAMES
        ],
        settings=settings,
        method="fixed",
        datum_sensors=tuple(s.name for s in datum_candidates(rig)),
        kinds=(PAN_TO_PAN,),
    )
    if not colour_layers:
        return pan
    green = adjust_mosaic(
        rig,
        pan.placements,
        tie_points,
        model=build_model(rig, placements, free_sensors=(), free_layers=colour_layers),
        constraints=(),
        settings=settings,
        method="fixed",
        datum_sensors=pan.datum_sensors,
        kinds=(PAN_TO_COLOUR,),
    )
    return _joined(rig, placements, tie_points, pan, green)


def _joined(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    tie_points: TiePoints,
    pan: Mosaic,
    green: Mosaic,
) -> Mosaic:
    layers = [*pan.model.layers, *green.model.layers]
    first = pan if pan.observations else green
    of_pan = (tie_points.kind == PAN_TO_PAN)[:, None]
    unknowns = len(pan.values)
    total = unknowns + len(green.values)
    covariance = np.zeros((total, total))
    covariance[:unknowns, :unknowns] = pan.covariance
    covariance[unknowns:, unknowns:] = green.covariance
    return dataclasses.replace(
        pan,
        model=build_model(
            rig,
            placements,
            free_sensors=(),
            free_layers=layers,
            free_mountings=list(pan.model.mountings),
        ),
        placements=green.placements,
        sigma0=first.sigma0,
        sigma0_px=first.sigma0_px,
        sigma0_um=first.sigma0_um,
        sigma_pc_px=green.sigma_pc_px,
        redundancy=pan.redundancy + green.redundancy,
        observations=pan.observations + green.observations,
        values=np.concatenate([pan.values, green.values]),
        covariance=covariance,
        residuals_px=np.where(of_pan, pan.residuals_px, green.residuals_px),
        redundancy_numbers=np.where(of_pan, pan.redundancy_numbers, green.redundancy_numbers),
        outliers=np.where(of_pan[:, 0], pan.outliers, green.outliers),
        used={pair: pan.used[pair] + green.used[pair] for pair in tie_points.pairs},
        iterations=pan.iterations + green.iterations,
        rank=pan.rank + green.rank,
        constrained_rank=pan.constrained_rank + green.constrained_rank,
        undetermined=pan.undetermined + green.undetermined,
        pseudo_observations=pan.pseudo_observations + green.pseudo_observations,
    )

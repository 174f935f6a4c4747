"""The experiment with an UltraCam L: PAN stitched without the colour master's help.

P/P tie points alone, a layer transformation of four parameters, and layers that were not
pre-corrected by the platform calibration: what is lost without P/C points, not a method to fly.

Source: Ladstädter et al. (2010), "UltraCam L project review", fig. 10 left.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from processing.geometry.placement import SensorPlacement
from processing.geometry.projective import rotation_homography
from processing.geometry.topology import free_cones
from processing.matching.tie_points import PAN_TO_PAN, TiePoints
from processing.mosaic.datum import DatumConstraint, datum_candidates, mounting_constraints
from processing.mosaic.free_mosaic import (
    Mosaic,
    MosaicSettings,
    adjust_mosaic,
)
from processing.mosaic.model import build_model
from processing.rig import Rig


def _without_precorrection(
    rig: Rig, placements: Mapping[str, SensorPlacement]
) -> dict[str, SensorPlacement]:
    """Placements whose PAN layers know nothing of the cones' calibrated rotations.

    Principal distances and sensor positions stay; the colour cones keep their layers.

    Raises:
        ValueError: the rig has no virtual image.
    """
    if rig.virtual_image is None:
        raise ValueError(f"rig {rig.name} has no [virtual_image]; nothing can be stitched")
    f_mm = rig.virtual_image.f_mm
    plain = {
        cone.name: rotation_homography(np.eye(3), cone.lens.f_mm, f_mm) for cone in rig.pan_cones
    }
    return {
        name: dataclasses.replace(p, layer=plain[p.cone.name]) if p.cone.name in plain else p
        for name, p in placements.items()
    }


def pan_only_mosaic(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    tie_points: TiePoints,
    *,
    precorrected: bool = False,
    settings: MosaicSettings | None = None,
) -> Mosaic:
    """Stitch PAN layers onto the master's by similarities, from P/P tie points.

    Without a master cone the mountings of the PAN heads, from P/P tie points alone: twelve angles,
    nine of them determinable.

    Sensors stay at their given positions in their layers. The colour cones stay where `placements`
    have them.

    Args:
        rig: the camera.
        placements: calibration + TDM, layers by platform calibration.
        tie_points: matched points; those with the colour master are not looked at.
        precorrected: keep the calibrated rotations of the PAN cones; the experiment did not.
        settings: None takes the defaults.

    Returns:
        The mosaic, its method "pan-only".

    Raises:
        ValueError: the rig has no virtual image.
    """
    keeps_precorrection = precorrected or rig.master_cone is None
    start = dict(placements) if keeps_precorrection else _without_precorrection(rig, placements)
    mountings = free_cones(rig)[1]
    layers = [c.name for c in rig.pan_cones if c.name not in (rig.master_cone, *mountings)]
    constraints = [c for name in layers for c in _similarity_constraints(name)]
    return adjust_mosaic(
        rig,
        start,
        tie_points,
        model=build_model(
            rig, start, free_sensors=(), free_layers=layers, free_mountings=mountings
        ),
        constraints=constraints + mounting_constraints(mountings),
        settings=settings or MosaicSettings(),
        method="pan-only",
        datum_sensors=tuple(s.name for s in datum_candidates(rig)),
        kinds=(PAN_TO_PAN,),
    )


def _similarity_constraints(layer: str) -> list[DatumConstraint]:
    """What makes a layer transformation of eight parameters one of four."""
    return [
        DatumConstraint({f"{layer}.p11": 1.0, f"{layer}.p22": -1.0}),
        DatumConstraint({f"{layer}.p12": 1.0, f"{layer}.p21": 1.0}),
        DatumConstraint({f"{layer}.p31": 1.0}),
        DatumConstraint({f"{layer}.p32": 1.0}),
    ]

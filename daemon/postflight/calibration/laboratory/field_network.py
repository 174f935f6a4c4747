"""The bundle adjustment of a 3D test field: cameras, heads, terms of every CCD.

What the adjustment finds becomes a rig in `field`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from daemon.postflight.calibration.laboratory.field_measurement import (
    FieldExposure,
    TargetField,
    TargetObservations,
    master_of,
    offset_m,
)
from daemon.postflight.calibration.laboratory.head_geometry import LENS_KEYS
from processing.bundle.network import (
    INTERIOR,
    Attitudes,
    CameraModel,
    HeadMounting,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)
from processing.bundle.terms import Kind, Part, Term
from processing.geometry.placement import layer_mm_from_raw
from processing.geometry.rotation import rotation_matrix
from processing.rig import Cone, Rig, Sensor

LENS_FREE: Final = ("k1", "k2", "p1", "p2")


def lab_network(
    rig: Rig,
    exposures: Sequence[FieldExposure],
    field: TargetField,
    observations: TargetObservations,
    *,
    offset_sigma_mm: float,
    skew_sigma_per_mm: float,
    sigma_px: float,
    drawn: Rig,
) -> Network:
    """The bundle: a camera and a head for every cone, terms for every CCD.

    `drawn` is the rig file whose projection centres count as observed.
    """
    master = master_of(rig)
    cone_index = {cone.name: k for k, cone in enumerate(rig.cones)}
    of_sensor = np.array([cone_index[rig.cone_of(s.name).name] for s in rig.sensors])
    cone_of_observation = of_sensor[observations.sensor]
    observed = set(cone_of_observation.tolist())
    pairs = sorted(
        set(zip(observations.exposure.tolist(), cone_of_observation.tolist(), strict=True))
    )
    image_of = {pair: k for k, pair in enumerate(pairs)}
    xy = np.empty_like(observations.px)
    sigma = np.empty_like(observations.px)
    for j, sensor in enumerate(rig.sensors):
        own = observations.sensor == j
        xy[own] = layer_mm_from_raw(sensor, observations.px[own])
        sigma[own] = sigma_px * sensor.pitch_mm
    heads = tuple(
        HeadMounting(
            cone.name,
            rotation_matrix(*cone.rotation_rad),
            offset_m(drawn, cone),
            rotation_free=free,
            offset_free=free,
            offset_sigma_m=offset_sigma_mm * 1e-3 if free else None,
        )
        for k, cone in enumerate(rig.cones)
        for free in [cone.name != master.name and k in observed]
    )
    used = np.unique(observations.target)
    point_of = np.full(len(field.names), -1)
    point_of[used] = np.arange(len(used))
    names = tuple(e.name for e in exposures)
    held = np.zeros(len(exposures), bool)
    return Network(
        cameras=tuple(
            _camera(cone, skew_sigma_per_mm)
            if k in observed
            # A cone that took no part stays as it is.
            else CameraModel(cone.name, cone.lens.f_mm)
            for k, cone in enumerate(rig.cones)
        ),
        stations=Stations(names, np.stack([e.position_m for e in exposures]), held),
        attitudes=Attitudes(names, np.stack([e.object_from_rig for e in exposures]), held),
        images=Images(
            tuple(f"{exposures[e].name}/{rig.cones[c].name}" for e, c in pairs),
            station=np.array([e for e, _ in pairs]),
            attitude=np.array([e for e, _ in pairs]),
            camera=np.array([c for _, c in pairs]),
            head=np.array([c for _, c in pairs]),
        ),
        points=Points(
            tuple(field.names[k] for k in used),
            field.xyz_m[used],
            np.repeat(field.sigma_m[used, None], 3, axis=1),
            np.zeros(len(used), bool),
        ),
        image_points=ImagePoints(
            image=np.array(
                [
                    image_of[pair]
                    for pair in zip(
                        observations.exposure.tolist(), cone_of_observation.tolist(), strict=True
                    )
                ]
            ),
            point=point_of[observations.target],
            xy_mm=xy,
            sigma_mm=sigma,
        ),
        heads=heads,
    )


def term_name(sensor: Sensor, kind: Kind) -> str:
    return f"{sensor.name} {kind}"


def _camera(cone: Cone, skew_sigma_per_mm: float) -> CameraModel:
    parts = tuple(_part(cone, sensor) for sensor in cone.sensors)
    terms, sigma = [], {}
    for k, sensor in enumerate(cone.sensors):
        kinds: list[Kind] = ["shift-x", "shift-y", "scale", "perspective-x", "perspective-y"]
        if k > 0:
            kinds.append("rotation")
        for kind in kinds:
            terms.append(Term(term_name(sensor, kind), kind, (sensor.name,), parts))
            if kind in ("perspective-x", "perspective-y"):
                sigma[term_name(sensor, kind)] = skew_sigma_per_mm
    interior = np.array([float(getattr(cone.lens, LENS_KEYS[name])) for name in INTERIOR])
    return CameraModel(
        cone.name,
        cone.lens.f_mm,
        interior=interior,
        free=frozenset(LENS_FREE),
        sigma=sigma,
        terms=tuple(terms),
    )


def _part(cone: Cone, sensor: Sensor) -> Part:
    half = np.array([sensor.width_px, sensor.height_px]) * sensor.pitch_mm / 2.0
    return Part(
        sensor.name,
        cone.name,
        sensor.x_mm - float(half[0]),
        sensor.y_mm - float(half[1]),
        sensor.x_mm + float(half[0]),
        sensor.y_mm + float(half[1]),
    )

"""Where tie points are weak, calibration and platform take part in the adjustment.

The free mosaic uses tie points alone. Over water, sand, snow or under a cloud there are too few,
and their noise would bend the image. This module detects that, and computes the prior information
of calibration, temperature and platform. The adjustment itself is in
`processing.mosaic.free_mosaic`.

Source: docs/explanation/mathematics/mosaicking.md#supported-mosaic.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.geometry.drift import sensor_dc
from processing.geometry.placement import SensorPlacement
from processing.matching.tie_points import PAN_TO_COLOUR, TiePoints
from processing.mosaic.free_mosaic import Mosaic, MosaicSettings, free_mosaic, vip_precision_px
from processing.mosaic.validity import Validity
from processing.rig import Cone, Rig, Sensor

Array = NDArray[np.float64]

MIN_OVERLAP_POINTS = 12
MIN_REDUNDANCY = 30.0
"""Below, sigma0 is taken as it was assumed."""


@dataclass(frozen=True)
class SupportSettings:
    """When support is called for, and how well is known what supports.

    A PAN sensor that tie points place worse than `above_px` (RMS of a coordinate over its middle
    and corners) rests on calibration. `rotation_rad` is the standard deviation of a cone's rotation
    against the master's: the platform calibration's, and what the aircraft turns between syntopic
    instants. `floor_px` is for all that is not modelled in a layer; of the colour master, whose
    parallax is the terrain's, `colour_shift_px` and `colour_floor_px`. A temperature is known to
    `probe_sigma_k` where its probe was read, to `unknown_sigma_k` where others stand in for it, and
    to `blind_sigma_k` where none was read at all.
    """

    above_px: float = 0.04
    rotation_rad: float = 30e-6
    floor_px: float = 0.05
    colour_shift_px: float = 3.0
    colour_floor_px: float = 0.3
    probe_sigma_k: float = 0.1
    unknown_sigma_k: float = 2.0
    blind_sigma_k: float = 15.0
    displaced_px: float = 10.0


def weakly_determined_sensors(
    rig: Rig,
    mosaic: Mosaic,
    present: Collection[str],
    *,
    settings: SupportSettings | None = None,
) -> tuple[str, ...]:
    """PAN sensors that tie points alone do not place well enough.

    Args:
        rig: the camera.
        mosaic: adjusted by tie points alone.
        present: sensors with a frame; the others are not looked at.
        settings: None takes the defaults.

    Returns:
        Names of sensors in the order of the rig.
    """
    settings = settings or SupportSettings()
    weak = []
    for cone in rig.pan_cones:
        for sensor in cone.sensors:
            if sensor.name not in present:
                continue
            right, low = sensor.width_px - 1.0, sensor.height_px - 1.0
            places = [(right / 2, low / 2), (0, 0), (right, 0), (0, low), (right, low)]
            sigma = vip_precision_px(mosaic, sensor.name, np.array(places, np.float64))
            if not math.sqrt(float(np.mean(sigma**2))) <= settings.above_px:
                weak.append(sensor.name)
    return tuple(weak)


def contradicted_colour(
    rig: Rig, tie_points: TiePoints, mosaic: Mosaic, validity: Validity
) -> NDArray[np.bool_]:
    """Mark P/C points that may put a sensor where it is not.

    Those of a sensor found off its calibrated place that P/P points do not hold on every side. A
    cloud under the camera is nearer than the ground, and the colour master is next to the PAN
    cones: all P/C points of a sensor that sees the cloud have a common error, and hide P/P points.

    Args:
        rig: the camera.
        tie_points: n points, those `mosaic` is of.
        mosaic: adjusted by tie points alone.
        validity: test of that mosaic.

    Returns:
        True for such points, (n,).
    """
    affected = {
        h.sensor for h in (validity.displaced, validity.insignificant_displacement) if h is not None
    }
    if validity.probe_bias is not None:
        affected.add(validity.hypotheses[0].sensor)
    for pair in validity.relative:
        if pair.significant:
            affected |= {pair.sensor_a, pair.sensor_b}
    affected &= _loose(rig, mosaic)
    numbers = [i for i, name in enumerate(tie_points.names) if name in affected]
    affected_points = np.isin(tie_points.sensor_a, numbers)
    return np.asarray((tie_points.kind == PAN_TO_COLOUR) & affected_points, np.bool_)


def _loose(rig: Rig, mosaic: Mosaic) -> set[str]:
    """PAN sensors with an overlap that holds too few P/P points."""
    pan = {s.name for cone in rig.pan_cones for s in cone.sensors}
    poor = [
        pair for pair, used in mosaic.used.items() if set(pair) <= pan and used < MIN_OVERLAP_POINTS
    ]
    return {name for pair in poor for name in pair}


def supported_mosaic(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    tie_points: TiePoints,
    mosaic: Mosaic,
    validity: Validity,
    temperatures_c: Mapping[str, float],
    *,
    settings: MosaicSettings | None = None,
    support: SupportSettings | None = None,
) -> Mosaic:
    """The mosaic adjusted again with what calibration, temperature and platform know.

    A sensor that was found displaced gets no support for its place; nor does any of its cone where
    it is not known which moved.

    Args:
        rig: the camera.
        placements: calibration + TDM, as of `mosaic`.
        tie_points: those of `mosaic`.
        mosaic: the free mosaic, its datum repaired.
        validity: the test of it.
        temperatures_c: temperatures that were read, by probe name.
        settings: of the adjustment; None takes the defaults.
        support: None takes the defaults.

    Returns:
        A supported mosaic; `undetermined` stays what tie points alone do not determine.
    """
    support = support or SupportSettings()
    moved = _moved(rig, validity)
    excluded = [s.name for s in rig.master_sensors if s.name in moved]
    covariance = _covariance(rig, mosaic, moved, temperatures_c, support)
    information = np.asarray(np.linalg.inv(covariance), np.float64)
    found = mosaic
    # The weight of what is known is in units of the points' own, which comes out of the adjustment.
    for _ in range(2):
        unit = found.sigma0 if found.redundancy >= MIN_REDUNDANCY else 1.0
        found = free_mosaic(
            rig,
            placements,
            tie_points,
            settings=settings,
            excluded_datum_sensors=excluded,
            prior=information * unit**2,
        )
    return dataclasses.replace(found, undetermined=mosaic.undetermined)


def _moved(rig: Rig, validity: Validity) -> set[str]:
    moved = set()
    first = validity.displaced or validity.insignificant_displacement
    if first is not None:
        moved |= {first.sensor, *validity.alternatives}
        if validity.several_displaced:
            moved |= {s.name for s in rig.master_sensors}
    for pair in validity.relative:
        if pair.significant:
            moved |= {pair.sensor_a, pair.sensor_b}
    return moved


def _covariance(
    rig: Rig,
    mosaic: Mosaic,
    moved: Collection[str],
    temperatures_c: Mapping[str, float],
    settings: SupportSettings,
) -> Array:
    """What is known of the unknowns, (u, u), in units of `MosaicModel.units`."""
    model = mosaic.model
    covariance = np.zeros((len(model.names), len(model.names)))
    for cone in rig.cones:
        free = [s for s in cone.sensors if s.name in model.sensors]
        for sensor in free:
            first = model.sensors[sensor.name]
            at = np.arange(first, first + 4)
            covariance[at, at] += _sensor_variance(sensor, temperatures_c)
            if sensor.name in moved:
                covariance[at[:2], at[:2]] += (settings.displaced_px * sensor.pitch_mm) ** 2
        covariance += _probe_covariance(mosaic, free, temperatures_c, settings)
        if cone.name in model.mountings:
            at = np.arange(model.mountings[cone.name], model.mountings[cone.name] + 3)
            covariance[at, at] += (cone.rotation_sigma_urad * 1e-6) ** 2
        if cone.name in model.layers:
            at = np.arange(model.layers[cone.name], model.layers[cone.name] + 8)
            covariance[np.ix_(at, at)] += _layer_covariance(mosaic, cone, settings)
    return covariance / np.outer(model.units, model.units)


def _sensor_variance(sensor: Sensor, temperatures_c: Mapping[str, float]) -> Array:
    """Of x, y (mm), rotation (rad) and scale; the last two as good as places at the corners."""
    tdm_um = sensor.drift.sigma_um_per_k * sensor_dc(sensor, temperatures_c)
    place_mm = math.hypot(sensor.position_sigma_um, tdm_um) * 1e-3
    half_mm = math.hypot(sensor.width_px, sensor.height_px) / 2.0 * sensor.pitch_mm
    own = place_mm / half_mm
    return np.square([place_mm, place_mm, own, own])


def _probe_covariance(
    mosaic: Mosaic,
    sensors: Sequence[Sensor],
    temperatures_c: Mapping[str, float],
    settings: SupportSettings,
) -> Array:
    """What the uncertain temperature of a probe moves, all its sensors together."""
    size = len(mosaic.model.names)
    covariance = np.zeros((size, size))
    for probe in dict.fromkeys(s.probe for s in sensors):
        moved = np.zeros(size)
        for sensor in sensors:
            if sensor.probe == probe:
                first = mosaic.model.sensors[sensor.name]
                drift = sensor.drift
                moved[first : first + 4] = (
                    drift.x_um_per_k * 1e-3,
                    drift.y_um_per_k * 1e-3,
                    drift.rotation_urad_per_k * 1e-6,
                    drift.scale_ppm_per_k * 1e-6,
                )
        read = probe in temperatures_c
        unknown_k = settings.unknown_sigma_k if temperatures_c else settings.blind_sigma_k
        sigma_k = settings.probe_sigma_k if read else unknown_k
        covariance += np.outer(moved, moved) * sigma_k**2
    return covariance


def _layer_covariance(mosaic: Mosaic, cone: Cone, settings: SupportSettings) -> Array:
    """Of p11 .. p32: small rotations of the cone, and a floor under each.

    A rotation (a, b, c) about x, y, z takes x to (x - c y - b f) / (1 + (b x - a y) / f), and y
    alike; lengths in half sizes.
    """
    model = mosaic.model
    colour = cone.role != "pan"
    reach = cone.lens.f_mm / model.half_size_mm
    rotations = np.zeros((8, 3))
    rotations[[5, 7], 0] = reach, -1.0 / reach
    rotations[[2, 6], 1] = -reach, 1.0 / reach
    rotations[[1, 3], 2] = -1.0, 1.0
    pixel = model.pitch_mm / model.half_size_mm
    floor = np.full(8, (settings.colour_floor_px if colour else settings.floor_px) * pixel)
    if colour:
        floor[[2, 5]] = settings.colour_shift_px * pixel
    return rotations @ rotations.T * settings.rotation_rad**2 + np.diag(floor**2)

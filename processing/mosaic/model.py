"""The model of a mosaic: which S and P are free, and how VIP points depend on them.

The unknowns are accumulated corrections against the start (calibration + TDM), never increments;
their adjustment is in `processing.mosaic.free_mosaic`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement, vip_mm_from_raw
from processing.geometry.projective import (
    apply_projective,
    chained_jacobian,
    projective_jacobian,
    rotation_homography,
)
from processing.geometry.rotation import rotations_from_vectors, skew
from processing.geometry.similarity import Similarity, apply_similarity
from processing.matching.tie_points import TiePoints
from processing.rig import Rig

Array = NDArray[np.float64]

SIMILARITY_NAMES = ("x", "y", "rotation", "scale")
LAYER_NAMES = ("p11", "p12", "p13", "p21", "p22", "p23", "p31", "p32")
ROTATION_NAMES = ("rotation_x", "rotation_y", "rotation_z")


@dataclass(frozen=True)
class MosaicModel:
    """Free similarities, layers and mountings of a rig, and the place of their unknowns.

    Unknowns of a sensor: x, y (mm), rotation (rad), scale (1): S = (x0 + x, y0 + y, r0 + rotation,
    s0 (1 + scale)), turned and scaled about the sensor's centre. Unknowns of a layer: p11 .. p32
    (1) of P = N^-1 (I + p) N P0, N dividing by `half_size_mm`. Unknowns of a mounting: the
    rotation vector (rad) that turns a head further, about the axes of the virtual camera (x right,
    y forward, z up): R = exp(rotation) R0, and with it P = K exp(rotation) K^-1 P0.

    `units` is the size of each unknown that moves the farthest image point by about one pixel.
    """

    names: tuple[str, ...]
    sensors: Mapping[str, int]
    layers: Mapping[str, int]
    units: Array
    half_size_mm: float
    pitch_mm: float
    f_mm: float
    mountings: Mapping[str, int] = field(default_factory=dict)


def build_model(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    *,
    free_sensors: Sequence[str],
    free_layers: Sequence[str],
    free_mountings: Sequence[str] = (),
) -> MosaicModel:
    """Lay out the unknowns: of each free sensor, of each free mounting, of each free layer.

    Args:
        rig: the camera.
        placements: of the free sensors, by name.
        free_sensors: sensors whose similarity S is adjusted.
        free_layers: cones whose layer transformation P is adjusted.
        free_mountings: cones whose mounting is adjusted.

    Returns:
        Names, places and units of the unknowns.

    Raises:
        ValueError: the rig has no virtual image.

    Source: docs/explanation/mathematics/mosaicking.md#parameters-and-degrees-of-freedom.
    """
    image = rig.virtual_image
    if image is None:
        raise ValueError(f"rig {rig.name} has no [virtual_image]; nothing can be stitched")
    pitch = image.pitch_mm
    half_size = max(image.width_px, image.height_px) / 2.0 * pitch
    names: list[str] = []
    units: list[float] = []
    sensors, layers, mountings = {}, {}, {}
    for name in free_sensors:
        sensor = placements[name].sensor
        reach = np.hypot(sensor.width_px, sensor.height_px) / 2.0 * sensor.pitch_mm
        sensors[name] = len(names)
        names += [f"{name}.{what}" for what in SIMILARITY_NAMES]
        units += [pitch, pitch, pitch / reach, pitch / reach]
    for name in free_mountings:
        mountings[name] = len(names)
        names += [f"{name}.{what}" for what in ROTATION_NAMES]
        # A turn about the axis of sight moves the farthest point by half the image.
        units += [pitch / image.f_mm, pitch / image.f_mm, pitch / half_size]
    for name in free_layers:
        layers[name] = len(names)
        names += [f"{name}.{what}" for what in LAYER_NAMES]
        units += [pitch / half_size] * 8
    return MosaicModel(
        tuple(names), sensors, layers, np.array(units), half_size, pitch, image.f_mm, mountings
    )


def placement_at(model: MosaicModel, start: SensorPlacement, values: Array) -> SensorPlacement:
    """The placement of a sensor with given unknowns.

    Args:
        model: the unknowns.
        start: the sensor's placement at calibration + TDM.
        values: the unknowns, (u,).

    Returns:
        A copy of `start` with adjusted S and P.
    """
    return dataclasses.replace(
        start,
        similarity=_similarity(model, start, values),
        layer=_layer_correction(model, start, values) @ start.layer,
    )


def vip_and_design(
    model: MosaicModel, start: SensorPlacement, corrected_mm: Array, values: Array
) -> tuple[Array, NDArray[np.int64], Array]:
    """VIP points of a sensor and their derivatives.

    Args:
        model: the unknowns.
        start: the sensor's placement at calibration + TDM.
        corrected_mm: u' (n, 2).
        values: the unknowns (u,).

    Returns:
        Points (n, 2) in px of the virtual image, the indices (k,) of the unknowns touched, and the
        points' derivatives by these, (k, 2, n), px per unknown's own unit.

    Source: docs/explanation/mathematics/mosaicking.md#observation-equations; Ladstädter et al.
    (2010), eq. 1 and 2.
    """
    n = len(corrected_mm)
    similarity = _similarity(model, start, values)
    layer_mm = apply_similarity(similarity, corrected_mm)
    start_mm = apply_projective(start.layer, layer_mm)
    first_sensor = model.sensors.get(start.sensor.name)
    first_layer = model.layers.get(start.cone.name)
    first_mounting = model.mountings.get(start.cone.name)
    columns = np.concatenate(
        [
            np.arange(first, first + size, dtype=np.int64)
            for first, size in ((first_sensor, 4), (first_mounting, 3), (first_layer, 8))
            if first is not None
        ]
        or [np.empty(0, dtype=np.int64)]
    )
    design = np.zeros((len(columns), 2, n))
    size = model.half_size_mm
    jacobian = projective_jacobian(start.layer, layer_mm)
    vip_mm = start_mm
    if first_mounting is not None:
        rotation = values[first_mounting : first_mounting + 3]
        homography = _rotation_homography(rotation, model.f_mm)
        vip_mm = apply_projective(homography, start_mm)
        further = small_rotation_design(vip_mm, model.f_mm)
        design[-3:] = np.einsum("ajn,jk->kan", further, _left_jacobian(rotation))
        jacobian = chained_jacobian(projective_jacobian(homography, start_mm), jacobian)
    if first_layer is not None:
        x, y = start_mm[:, 0] / size, start_mm[:, 1] / size
        scaled = np.stack([x, y], axis=1)
        correction = _scaled_correction(values[first_layer : first_layer + 8])
        moved = apply_projective(correction, scaled)
        vip_mm = moved * size
        by_w = size / (correction[2, 0] * x + correction[2, 1] * y + 1.0)
        d = design[len(columns) - 8 :]
        for axis in (0, 1):
            np.multiply(x, by_w, out=d[3 * axis, axis])
            np.multiply(y, by_w, out=d[3 * axis + 1, axis])
            d[3 * axis + 2, axis] = by_w
            np.multiply(d[3 * axis, axis], -moved[:, axis], out=d[6, axis])
            np.multiply(d[3 * axis + 1, axis], -moved[:, axis], out=d[7, axis])
        jacobian = chained_jacobian(projective_jacobian(correction, scaled), jacobian)
    if first_sensor is not None:
        arm_x = layer_mm[:, 0] - similarity.x_mm
        arm_y = layer_mm[:, 1] - similarity.y_mm
        # arm = s0 (1 + scale) R u', so its derivative by scale is arm / (1 + scale).
        stretch = 1.0 / (1.0 + values[first_sensor + 3])
        for axis in (0, 1):
            by_x, by_y = jacobian[:, axis, 0], jacobian[:, axis, 1]
            design[0, axis] = by_x
            design[1, axis] = by_y
            design[2, axis] = by_y * arm_x - by_x * arm_y
            design[3, axis] = (by_x * arm_x + by_y * arm_y) * stretch
    design /= model.pitch_mm
    return vip_mm / model.pitch_mm, columns, design


def residuals_px(
    model: MosaicModel, placements: Mapping[str, SensorPlacement], tie_points: TiePoints
) -> Array:
    """Place of a less place of b in the VIP, of tie points, adjusted ones or others.

    Args:
        model: gives the pixel pitch.
        placements: by sensor name.
        tie_points: n points.

    Returns:
        x right, y up, (n, 2), px.
    """
    residuals = np.full((len(tie_points), 2), np.nan)
    for number, (a, b) in enumerate(tie_points.pairs):
        rows = np.flatnonzero(tie_points.overlap == number)
        separation = vip_mm_from_raw(placements[a], tie_points.raw_a[rows]) - vip_mm_from_raw(
            placements[b], tie_points.raw_b[rows]
        )
        residuals[rows] = separation / model.pitch_mm
    return residuals


def _similarity(model: MosaicModel, start: SensorPlacement, values: Array) -> Similarity:
    first = model.sensors.get(start.sensor.name)
    s = start.similarity
    if first is None:
        return s
    x, y, rotation, scale = (float(v) for v in values[first : first + 4])
    return Similarity(s.x_mm + x, s.y_mm + y, s.rotation_rad + rotation, s.scale * (1.0 + scale))


def _layer_correction(model: MosaicModel, start: SensorPlacement, values: Array) -> Array:
    mounting = model.mountings.get(start.cone.name)
    if mounting is not None:
        return _rotation_homography(values[mounting : mounting + 3], model.f_mm)
    first = model.layers.get(start.cone.name)
    if first is None:
        return np.eye(3)
    shrink = np.diag([1.0 / model.half_size_mm, 1.0 / model.half_size_mm, 1.0])
    grow = np.diag([model.half_size_mm, model.half_size_mm, 1.0])
    return np.asarray(grow @ _scaled_correction(values[first : first + 8]) @ shrink)


def small_rotation_design(vip_mm: Array, f_mm: float) -> Array:
    """How points of the virtual image move by a small turn of their rays.

    The ray (x, y, -f) turned by w moves by w x (x, y, -f).

    Args:
        vip_mm: points, (n, 2), mm.
        f_mm: principal distance of the virtual image.

    Returns:
        Derivatives of x and y by the three components of w, (2, 3, n), mm/rad.
    """
    x, y = vip_mm[:, 0], vip_mm[:, 1]
    return np.array(
        [
            [x * y / f_mm, -f_mm - x * x / f_mm, -y],
            [f_mm + y * y / f_mm, -x * y / f_mm, x],
        ]
    )


def _rotation_homography(rotation: Array, f_mm: float) -> Array:
    """The homography of the virtual image that a turn of the head makes, (3, 3), mm."""
    return rotation_homography(rotations_from_vectors(rotation), f_mm, f_mm)


def _left_jacobian(rotation: Array) -> Array:
    """What a change of a small rotation vector turns further, to second order, (3, 3)."""
    cross = skew(rotation[None])[0]
    return np.asarray(np.eye(3) + 0.5 * cross + cross @ cross / 6.0)


def _scaled_correction(p: Array) -> Array:
    return np.array(
        [[1.0 + p[0], p[1], p[2]], [p[3], 1.0 + p[4], p[5]], [p[6], p[7], 1.0]], dtype=np.float64
    )

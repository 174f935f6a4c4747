"""The true camera: true position and temperature of every sensor, and the rays of its pixels.

Projection code of its own, written from the definitions of the rig file and sharing nothing with
the pipeline's. The electronics behind the pixels are in `electronics`.

Conventions as in `processing.rig`. Rays and image points are arrays (..., 3) or (..., 2), float64.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from processing.rig import Cone, Lens, Rig, Sensor
from sim_hw.world.flight import Pose
from sim_hw.world.seeding import random_stream

Array = NDArray[np.float64]

MOUNTING_RESIDUAL_RAD = 20e-6
BODY_FROM_CAMERA = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Camera x right, y forward, z up; body x forward, y right, z down."""


@dataclass(frozen=True)
class ProbeTemperatures:
    """The true temperature of every probe over time: dC, an offset of its own, a slow wave."""

    base_c: Mapping[str, float]
    wave_k: Mapping[str, float]
    period_s: Mapping[str, float]
    phase: Mapping[str, float]

    def at(self, probe: str, t_s: float) -> float:
        angle = 2 * math.pi * t_s / self.period_s[probe] + self.phase[probe]
        return self.base_c[probe] + self.wave_k[probe] * math.sin(angle)


def true_temperatures(rig: Rig, seed: int, *, dc_k: float) -> ProbeTemperatures:
    """Temperatures `dc_k` above those of the calibration, a few tenths of a kelvin apart."""
    random = random_stream(seed, "temperatures")
    reference = {cone.probe: cone.calibration_c for cone in rig.cones}
    reference.update({s.probe: s.calibration_c for s in rig.sensors if s.probe not in reference})
    probes = rig.probes
    return ProbeTemperatures(
        base_c={p: reference[p] + dc_k + float(random.uniform(-0.3, 0.3)) for p in probes},
        wave_k={p: float(random.uniform(0.1, 0.4)) for p in probes},
        period_s={p: float(random.uniform(400, 900)) for p in probes},
        phase={p: float(random.uniform(0, 2 * math.pi)) for p in probes},
    )


@dataclass(frozen=True)
class TrueCamera:
    """A rig with the errors its calibration does not know.

    `place_error_mm` is added to the calibrated place of each sensor, in its layer (x right, y up).
    `mounting_error_rad` is the rotation of a cone in addition to its platform calibration:
    master_from_cone = R(calibrated) R(error).
    """

    rig: Rig
    place_error_mm: Mapping[str, tuple[float, float]]
    mounting_error_rad: Mapping[str, tuple[float, float, float]]
    _rotation: dict[str, Array] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        rotation = {
            cone.name: rotation_opk(cone.rotation_rad)
            @ rotation_opk(self.mounting_error_rad[cone.name])
            for cone in self.rig.cones
        }
        object.__setattr__(self, "_rotation", rotation)

    def master_from_cone(self, cone: Cone) -> Array:
        """The true rotation of a cone against the master cone, (3, 3)."""
        return self._rotation[cone.name]

    def layer_from_pixel(
        self, sensor: Sensor, columns: Array, rows: Array, *, temperature_c: float
    ) -> Array:
        """Physical layer coordinates, mm, of pixel positions; shape (..., 2)."""
        dc = temperature_c - sensor.calibration_c
        pitch = sensor.pitch_um * 1e-3
        right = (columns - (sensor.width_px - 1) / 2) * pitch
        up = ((sensor.height_px - 1) / 2 - rows) * pitch
        angle_rad = sensor.rotation_rad + sensor.drift.rotation_urad_per_k * 1e-6 * dc
        scale = sensor.scale * (1 + sensor.drift.scale_ppm_per_k * 1e-6 * dc)
        error = self.place_error_mm[sensor.name]
        x = sensor.x_mm + error[0] + sensor.drift.x_um_per_k * 1e-3 * dc
        y = sensor.y_mm + error[1] + sensor.drift.y_um_per_k * 1e-3 * dc
        c, s = scale * math.cos(angle_rad), scale * math.sin(angle_rad)
        straight = np.stack([x + c * right - s * up, y + s * right + c * up], axis=-1)
        return straight + skewed_by(sensor, straight - np.array([x, y]))

    def directions(
        self,
        cone: Cone,
        sensor: Sensor,
        columns: Array,
        rows: Array,
        *,
        sensor_c: float,
        cone_c: float,
    ) -> Array:
        """Directions in the axes of the master camera of positions on a sensor, shape (..., 3)."""
        measured = self.layer_from_pixel(sensor, columns, rows, temperature_c=sensor_c)
        ideal = undistorted(cone.lens, measured)
        f_mm = principal_distance_mm(cone, cone_c)
        image = np.concatenate([ideal, np.full((*ideal.shape[:-1], 1), -f_mm)], axis=-1)
        return np.asarray(image @ self.master_from_cone(cone).T)


def true_camera(
    rig: Rig, seed: int, *, displaced_px: Mapping[str, tuple[float, float]]
) -> TrueCamera:
    """Draw the errors of a calibration, and displace sensors by (right, up) in their pixels.

    The master cone defines the virtual image plane and so has no mounting error.
    """
    place: dict[str, tuple[float, float]] = {}
    for sensor in rig.sensors:
        draw = random_stream(seed, "place", sensor.name).normal(0, 1, 2)
        moved = displaced_px.get(sensor.name, (0.0, 0.0))
        x, y = (
            float(e) * sensor.position_sigma_um * 1e-3 + d * sensor.pitch_um * 1e-3
            for e, d in zip(draw, moved, strict=True)
        )
        place[sensor.name] = (x, y)
    mounting = {}
    for cone in rig.cones:
        draw = random_stream(seed, "mounting", cone.name).normal(0, MOUNTING_RESIDUAL_RAD, 3)
        if cone.name == rig.master_cone:
            draw = np.zeros(3)
        mounting[cone.name] = (float(draw[0]), float(draw[1]), float(draw[2]))
    return TrueCamera(rig=rig, place_error_mm=place, mounting_error_rad=mounting)


def skewed_by(sensor: Sensor, about_mm: Array) -> Array:
    """How far perspective skew moves points (..., 2) about the sensor's centre, in its layer."""
    x, y = about_mm[..., 0], about_mm[..., 1]
    ppm = sensor.skew_x_ppm_per_mm * x + sensor.skew_y_ppm_per_mm * y
    return np.stack([x * ppm * 1e-6, y * ppm * 1e-6], axis=-1)


def undistorted(lens: Lens, xy_mm: Array) -> Array:
    """Ideal from measured image coordinates: the ten parameters, z = -f, and the grid on top.

    Source: Heier et al. (2002), eq. 5.1.
    """
    x, y = xy_mm[..., 0], xy_mm[..., 1]
    r2 = x * x + y * y
    radial = r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3)) + lens.df_mm / lens.f_mm
    dx = (
        lens.dx0_mm
        + x * radial
        + lens.p1 * (r2 + 2 * x * x)
        + 2 * lens.p2 * x * y
        + lens.b1 * x
        + lens.b2 * y
    )
    dy = lens.dy0_mm + y * radial + 2 * lens.p1 * x * y + lens.p2 * (r2 + 2 * y * y)
    if (grid := lens.residual_grid) is not None:
        nodes = [
            (value - axis[0]) / (axis[-1] - axis[0]) * (len(axis) - 1)
            for value, axis in ((y, grid.y_mm), (x, grid.x_mm))
        ]
        more_um = [
            map_coordinates(np.array(table), nodes, order=1, mode="nearest")
            for table in (grid.dx_um, grid.dy_um)
        ]
        dx, dy = dx + 1e-3 * more_um[0], dy + 1e-3 * more_um[1]
    return np.stack([x + dx, y + dy], axis=-1)


def principal_distance_mm(cone: Cone, temperature_c: float) -> float:
    """The physical principal distance of a cone at a temperature of its probe."""
    lens = cone.lens
    return lens.f_mm * (1 + lens.f_ppm_per_k * 1e-6 * (temperature_c - cone.calibration_c))


def rotation_opk(angles_rad: tuple[float, float, float]) -> Array:
    """R = Rx(omega) Ry(phi) Rz(kappa), (3, 3)."""
    return np.asarray(Rotation.from_euler("XYZ", angles_rad).as_matrix())


def projection_centre_m(cone: Cone, pose: Pose) -> Array:
    """Where a cone's projection centre is in the world, east, north, up."""
    lever_m = np.asarray(cone.position_mm) * 1e-3
    return np.asarray(pose.position_enu_m + pose.enu_from_body @ lever_m)


def image_centre_m(rig: Rig, pose: Pose) -> Array:
    """Where the stitched image is seen from: the master cone's projection centre.

    Of a rig without a master cone the mean of the panchromatic cones' centres.
    """
    seen_from = [
        projection_centre_m(cone, pose)
        for cone in rig.cones
        if (cone.role == "pan" if rig.master_cone is None else cone.name == rig.master_cone)
    ]
    return np.asarray(np.mean(seen_from, axis=0))


def world_directions(directions: Array, pose: Pose) -> Array:
    """Turn directions from master camera axes into east, north, up."""
    return np.asarray(directions @ (pose.enu_from_body @ BODY_FROM_CAMERA).T)


def ideal_image_mm(ground_m: Array, rig: Rig, pose: Pose) -> Array:
    """Where the ideal master camera sees ground points: image plane, mm, shape (..., 2).

    Calibrated principal distance and point, no distortion; the camera stands where
    `image_centre_m` is at `pose`.
    """
    if rig.virtual_image is None:
        raise ValueError(f"rig {rig.name} has no virtual image")
    centre = image_centre_m(rig, pose)
    seen = (ground_m - centre) @ (pose.enu_from_body @ BODY_FROM_CAMERA)
    return np.asarray(-rig.virtual_image.f_mm * seen[..., :2] / seen[..., 2:])


def ideal_pixels(ground_m: Array, rig: Rig, pose: Pose) -> tuple[Array, Array]:
    """Columns and rows in the virtual image as the ideal master camera sees ground points."""
    image = rig.virtual_image
    if image is None:
        raise ValueError(f"rig {rig.name} has no virtual image")
    xy = ideal_image_mm(ground_m, rig, pose) / (image.pitch_um * 1e-3)
    return xy[..., 0] + (image.width_px - 1) / 2, (image.height_px - 1) / 2 - xy[..., 1]

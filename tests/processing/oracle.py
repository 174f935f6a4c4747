"""The geometry once more, by other means: OpenCV's camera model, no code shared with the pipeline.

OpenCV turns ideal into distorted points with the polynomial that eq. 5.1 uses the other way round,
so that measured points put in as "object points" come out ideal.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.rig import Cone, Lens, Rig, Sensor

Array = NDArray[np.float64]


def ideal_from_measured(lens: Lens, measured_mm: Array) -> Array:
    """Heier et al. (2002), eq. 5.1, by cv2.projectPoints; (n, 2) mm.

    B1, B2, df and the offsets are an affine matrix.
    """
    points = np.column_stack([measured_mm, np.ones(len(measured_mm))])
    # OpenCV: p1 goes with 2xy in x and r2 + 2y2 in y; the paper's P1 with r2 + 2x2 in x.
    coefficients = np.array([lens.k1, lens.k2, lens.p2, lens.p1, lens.k3])
    curved, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), coefficients)
    stretch = lens.df_mm / lens.f_mm
    linear = np.array([[stretch + lens.b1, lens.b2], [0.0, stretch]])
    shift = np.array([lens.dx0_mm, lens.dy0_mm])
    return np.asarray(curved[:, 0, :] + measured_mm @ linear.T + shift)


def rotation_of(cone: Cone) -> Array:
    """master_from_cone as a product of three Rodrigues rotations."""
    omega, phi, kappa = cone.rotation_rad
    about_x, _ = cv2.Rodrigues(np.array([omega, 0.0, 0.0]))
    about_y, _ = cv2.Rodrigues(np.array([0.0, phi, 0.0]))
    about_z, _ = cv2.Rodrigues(np.array([0.0, 0.0, kappa]))
    return np.asarray(about_x @ about_y @ about_z)


def vip_px_of_raw(
    rig: Rig, cone: Cone, sensor: Sensor, colrow: Array, temperature_c: float, tdi_shifts: int
) -> Array:
    """Virtual pixels of raw pixels at a temperature common to all probes, step by step."""
    dc = temperature_c - sensor.calibration_c
    pitch = sensor.pitch_um / 1000.0
    angle_rad = sensor.rotation_rad + sensor.drift.rotation_urad_per_k * dc / 1e6
    scale = sensor.scale * (1.0 + sensor.drift.scale_ppm_per_k * dc / 1e6)
    centre = (
        sensor.x_mm + sensor.drift.x_um_per_k * dc / 1000.0,
        sensor.y_mm + sensor.drift.y_um_per_k * dc / 1000.0,
    )
    points = []
    for column, row in colrow:
        true_row = row - sensor.tdi_row_sign * tdi_shifts / 2.0
        right = (column - (sensor.width_px - 1) / 2.0) * pitch * scale
        up = ((sensor.height_px - 1) / 2.0 - true_row) * pitch * scale
        rotated = complex(right, up) * np.exp(1j * angle_rad)
        skew = sensor.skew_x_ppm_per_mm * rotated.real + sensor.skew_y_ppm_per_mm * rotated.imag
        place = complex(*centre) + rotated * (1.0 + skew / 1e6)
        points.append((place.real, place.imag))
    ideal = ideal_from_measured(cone.lens, np.array(points))
    # Rays at f(T), turned into the master camera and seen by a pinhole that looks down -z.
    f_now = cone.lens.f_mm * (
        1.0 + cone.lens.f_ppm_per_k * (temperature_c - cone.calibration_c) / 1e6
    )
    rays = np.column_stack([ideal, np.full(len(ideal), -f_now)])
    image = rig.virtual_image
    assert image is not None
    # OpenCV looks along +z with y down: half a turn about x leads from camera axes to OpenCV's.
    to_opencv, _ = cv2.Rodrigues(np.array([np.pi, 0.0, 0.0]))
    rotation, _ = cv2.Rodrigues(to_opencv @ rotation_of(cone))
    f_px = image.f_mm / (image.pitch_um / 1000.0)
    camera = np.array(
        [
            [f_px, 0.0, (image.width_px - 1) / 2.0],
            [0.0, f_px, (image.height_px - 1) / 2.0],
            [0.0, 0.0, 1.0],
        ]
    )
    pixels, _ = cv2.projectPoints(rays, rotation, np.zeros(3), camera, np.zeros(5))
    return np.asarray(pixels[:, 0, :])


def placed(layer: Array, similarity: tuple[float, float, float, float], xy_mm: Array) -> Array:
    """x_vip = P S u' by cv2.transform and cv2.perspectiveTransform; (n, 2) mm.

    Source: Ladstädter et al. (2010), eq. 1.
    """
    x, y, angle_rad, scale = similarity
    c, s = scale * np.cos(angle_rad), scale * np.sin(angle_rad)
    affine = np.array([[c, -s, x], [s, c, y]])
    in_layer = cv2.transform(xy_mm[:, None, :], affine)
    return np.asarray(cv2.perspectiveTransform(in_layer, layer)[:, 0, :])

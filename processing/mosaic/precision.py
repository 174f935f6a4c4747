"""The stated accuracy of a stitched image: tie points, and the calibration its datum rests on.

Three parts: the adjustment's covariance, which `processing.mosaic.free_mosaic` makes; calibration
and drift coefficients of the master sensors the datum rests on; and the temperature of the master
cone, which a common expansion hides in. Whether the calibration holds is tested in
`processing.mosaic.validity`.

Source: docs/explanation/mathematics/mosaicking.md#accuracy-of-the-image. Eq. 6 is that of
Ladstädter et al. (2010).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from processing.geometry.drift import sensor_dc
from processing.geometry.placement import corrected_mm_from_raw, vip_mm_from_raw
from processing.mosaic.datum import datum_candidates
from processing.mosaic.free_mosaic import Mosaic, vip_precision_px
from processing.mosaic.held import HeldPart
from processing.mosaic.model import vip_and_design
from processing.quality.figures.stitching import PrecisionFigures
from processing.rig import Rig, Sensor

Array = NDArray[np.float64]

PROBE_SIGMA_K = 0.1
UNKNOWN_SIGMA_K = 2.0
BLIND_SIGMA_K = 15.0
"""A probe that was read, one that others stand in for, and all of them where none was read."""


@dataclass(frozen=True)
class UncertaintyContribution:
    """Covariance besides tie points and datum (`processing.mosaic.uncertainty_contribution`).

    `datum` (4, 4) is that of shift x, y (px), scale and rotation (px per mm) of the whole image;
    `frames` (2,) the variance of a coordinate, px squared, of one sensor's pixels, by its name;
    `parts` are patterns of errors over the image, independent of each other.
    """

    datum: Array = field(default_factory=lambda: np.zeros((4, 4)))
    frames: Mapping[str, Array] = field(default_factory=dict)
    parts: tuple[HeldPart, ...] = ()


def precision_figures(
    rig: Rig,
    mosaic: Mosaic,
    present: Collection[str],
    measured_c: Mapping[str, float],
    uncertainty_contribution: UncertaintyContribution | None = None,
) -> PrecisionFigures | None:
    """How well centre and corners of the PAN sensors that are there are placed, in figures.

    Args:
        rig: the camera.
        mosaic: what the image was made with.
        present: sensors with a frame.
        measured_c: temperatures that were read, by probe name.
        uncertainty_contribution: what findings add; None is nothing.

    Returns:
        Root mean square over the sensors, and the worst of them; None without a sensor.
    """
    by_sensor: dict[str, float] = {}
    of_datum = datum_covariance(rig, mosaic, measured_c)
    for cone in rig.pan_cones:
        for sensor in cone.sensors:
            if sensor.name in present:
                right, low = sensor.width_px - 1.0, sensor.height_px - 1.0
                points = [(right / 2, low / 2), (0, 0), (right, 0), (0, low), (right, low)]
                sigma = placed_sigma_px(
                    rig,
                    mosaic,
                    sensor.name,
                    np.array(points, np.float64),
                    of_datum,
                    uncertainty_contribution,
                )
                by_sensor[sensor.name] = float(np.sqrt(np.mean(sigma**2)))
    if not by_sensor:
        return None
    worst = max(by_sensor, key=lambda name: by_sensor[name])
    sigma_px = float(np.sqrt(np.mean(np.square(list(by_sensor.values())))))
    return PrecisionFigures(sigma_px, by_sensor[worst], worst)


def placed_sigma_px(
    rig: Rig,
    mosaic: Mosaic,
    sensor: str,
    colrow: Array,
    of_datum: Array,
    uncertainty_contribution: UncertaintyContribution | None = None,
) -> Array:
    """Standard deviation of the positions of raw pixels in the virtual image.

    What tie points do not determine counts with the a-priori accuracy it is held with.

    Args:
        rig: the camera.
        mosaic: what the image was made with.
        sensor: name of the sensor.
        colrow: raw column and row, (n, 2).
        of_datum: its covariance, by `datum_covariance`.
        uncertainty_contribution: what findings add; None is nothing.

    Returns:
        x and y, (n, 2), px.

    Source: docs/explanation/mathematics/mosaicking.md#accuracy-of-the-image.
    """
    tie_points = vip_precision_px(mosaic, sensor, colrow)
    held = {name.split(".")[0] for name in mosaic.undetermined}
    if held & {sensor, rig.cone_of(sensor).name} and not mosaic.supported:
        tie_points = tie_points * max(1.0, 1.0 / max(mosaic.sigma0, 1e-6))
    placed_mm = vip_mm_from_raw(mosaic.placements[sensor], colrow)
    datum = moved_datum_design(rig, mosaic, placed_mm)
    uncertainty_contribution = uncertainty_contribution or UncertaintyContribution()
    moved = of_datum + uncertainty_contribution.datum
    variance = np.sum((datum @ moved) * datum, axis=1).reshape(-1, 2)
    variance = variance + uncertainty_contribution.frames.get(sensor, np.zeros(2))
    for part in uncertainty_contribution.parts:
        variance = variance + part.at(mosaic, sensor, colrow) ** 2
    return np.asarray(np.sqrt(tie_points**2 + variance))


def placed_covariance_px(
    rig: Rig, mosaic: Mosaic, points: Mapping[str, Array], measured_c: Mapping[str, float]
) -> tuple[Array, Array]:
    """Covariance of the positions of raw pixels of several sensors in the virtual image.

    Args:
        rig: the camera.
        mosaic: what the image was made with.
        points: raw pixels (n, 2) by sensor name.
        measured_c: temperatures that were read, by probe name.

    Returns:
        The part of the tie points, and that of the datum (calibration, drift coefficients and
        temperature of the master cone), each (2 n, 2 n), px squared: x and y (up) of the first
        point, of the second, and so on, sensor by sensor.
    """
    jacobian = placed_design_px(mosaic, points)
    similarity = np.concatenate(
        [
            moved_datum_design(rig, mosaic, vip_mm_from_raw(mosaic.placements[name], colrow))
            for name, colrow in points.items()
        ]
    )
    return (
        jacobian @ mosaic.covariance @ jacobian.T,
        similarity @ datum_covariance(rig, mosaic, measured_c) @ similarity.T,
    )


def placed_design_px(mosaic: Mosaic, points: Mapping[str, Array]) -> Array:
    """Derivatives of the positions of raw pixels in the virtual image by the mosaic's unknowns.

    Args:
        mosaic: what the image was made with.
        points: raw pixels (n, 2) by sensor name.

    Returns:
        (2 n, unknowns), px: x and y (up) of the first point, of the second, sensor by sensor.
    """
    model, rows = mosaic.model, []
    for name, colrow in points.items():
        start = mosaic.start[name]
        corrected = corrected_mm_from_raw(start, colrow)
        _, columns, design = vip_and_design(model, start, corrected, mosaic.values)
        row = np.zeros((2 * len(colrow), len(model.names)))
        row[:, columns] = design.transpose(2, 1, 0).reshape(2 * len(colrow), len(columns))
        rows.append(row)
    return np.concatenate(rows)


def disturbance_covariance_px(
    rig: Rig,
    mosaic: Mosaic,
    points: Mapping[str, Array],
    uncertainty_contribution: UncertaintyContribution,
) -> Array:
    """Covariance that findings add to the positions of raw pixels.

    Args:
        rig: the camera.
        mosaic: what the image was made with.
        points: raw column and row (n, 2) by sensor name.
        uncertainty_contribution: what findings add.

    Returns:
        (2 n, 2 n), px squared, in the order of `placed_covariance_px`.
    """
    designs = [
        moved_datum_design(rig, mosaic, vip_mm_from_raw(mosaic.placements[name], colrow))
        for name, colrow in points.items()
    ]
    own = [
        np.tile(uncertainty_contribution.frames.get(name, np.zeros(2)), len(colrow))
        for name, colrow in points.items()
    ]
    design = np.concatenate(designs)
    covariance = design @ uncertainty_contribution.datum @ design.T + np.diag(np.concatenate(own))
    for part in uncertainty_contribution.parts:
        errors = [part.at(mosaic, name, colrow).reshape(-1) for name, colrow in points.items()]
        error = np.concatenate(errors)
        covariance += np.outer(error, error)
    return np.asarray(covariance)


def datum_covariance(rig: Rig, mosaic: Mosaic, measured_c: Mapping[str, float]) -> Array:
    """Covariance of the datum.

    The datum is the best similarity over the master sensors it rests on (eq. 6), so what their
    places are off by, each on its own or all with their probe, carries over by that fit. Of
    converging heads the mean turn is held at the platform calibration: it is known as well as one
    head's turn over the root of their number.

    Args:
        rig: the camera.
        mosaic: what the image was made with.
        measured_c: temperatures that were read, by probe name.

    Returns:
        Shift x, y (px), scale and rotation (px per mm), (4, 4).

    Source: docs/explanation/mathematics/mosaicking.md#accuracy-of-the-image.
    """
    sensors, place_mm, fit = _datum_fit(rig, mosaic)
    own_um2 = np.array(
        [
            s.position_sigma_um**2 + (s.drift.sigma_um_per_k * sensor_dc(s, measured_c)) ** 2
            for s in sensors
        ]
    )
    own = np.diag(own_um2)
    if len(sensors) == 1:
        # What turns and stretches the sensor moves its second place in addition to the first.
        own = own_um2[0] * np.array([[1.0, 1.0], [1.0, 2.0]])
    covariance = fit @ np.kron(own, np.eye(2)) @ fit.T
    for probe, moved in _moved_um_per_kelvin(rig, sensors, place_mm).items():
        unknown_k = UNKNOWN_SIGMA_K if measured_c else BLIND_SIGMA_K
        sigma_k = PROBE_SIGMA_K if probe in measured_c else unknown_k
        common = fit @ moved * sigma_k
        covariance += np.outer(common, common)
    if rig.master_cone is None:
        sigmas = {
            rig.cone_of(s.name).name: rig.cone_of(s.name).rotation_sigma_urad for s in sensors
        }
        variance = float(np.mean(np.square(list(sigmas.values())))) / len(sigmas)
        f_um = mosaic.model.f_mm * 1e-3
        covariance += np.diag([f_um**2, f_um**2, 0.0, 1e-6]) * variance
    return np.asarray(covariance / (mosaic.model.pitch_mm * 1e3) ** 2)


def datum_per_kelvin_px(rig: Rig, mosaic: Mosaic) -> Array:
    """How one kelvin that no probe has read moves the datum.

    Args:
        rig: the camera.
        mosaic: what the image was made with.

    Returns:
        Shift x, y (px), scale and rotation (px per mm), per K, (4,).
    """
    sensors, place_mm, fit = _datum_fit(rig, mosaic)
    moved = sum(_moved_um_per_kelvin(rig, sensors, place_mm).values(), np.zeros(2 * len(place_mm)))
    return np.asarray(fit @ moved / (mosaic.model.pitch_mm * 1e3))


def datum_by_places(rig: Rig, mosaic: Mosaic) -> Array:
    """How the datum moves with the places it rests on.

    Args:
        rig: the camera.
        mosaic: what the image was made with.

    Returns:
        Shift x, y (px), scale and rotation (px per mm) for a pixel of x and y of each place,
        (4, 2 m).
    """
    return _datum_fit(rig, mosaic)[2]


def _datum_fit(rig: Rig, mosaic: Mosaic) -> tuple[list[Sensor], Array, Array]:
    """Sensors of the datum, places (m, 2) mm, and the fit (4, 2 m) of a similarity to them.

    One sensor alone holds its own scale and rotation. It has two places, half of its height apart:
    each moves the second against the first by the standard deviation of the first.
    """
    candidates = datum_candidates(rig)
    sensors = [s for s in candidates if s.name in mosaic.datum_sensors] or list(candidates)
    place_mm = np.array([_place_mm(rig, mosaic, s) for s in sensors])
    if len(sensors) == 1:
        half_mm = sensors[0].height_px / 2.0 * sensors[0].pitch_mm
        place_mm = np.concatenate([place_mm, place_mm + np.array([[0.0, half_mm]])])
    design = datum_design(place_mm)
    return sensors, place_mm, np.linalg.inv(design.T @ design) @ design.T


def _moved_um_per_kelvin(rig: Rig, sensors: Sequence[Sensor], place_mm: Array) -> dict[str, Array]:
    """Where one kelvin takes the places of the datum, (2 m,) um, by probe.

    The principal distance takes part of an expansion back. The second place of a sensor alone
    takes part in its own scale and rotation.
    """
    cones = [rig.cone_of(s.name) for s in sensors]
    times = len(place_mm) // len(sensors)
    result = {}
    for probe in dict.fromkeys([s.probe for s in sensors] + [cone.probe for cone in cones]):
        moved = np.zeros((len(place_mm), 2))
        for i, (s, cone) in enumerate(zip(sensors, cones, strict=True)):
            for k in range(i * times, (i + 1) * times):
                if s.probe == probe:
                    x, y = place_mm[k] - place_mm[i * times]
                    scale, rotation = (
                        s.drift.scale_ppm_per_k * 1e-3,
                        s.drift.rotation_urad_per_k * 1e-3,
                    )
                    moved[k] += (s.drift.x_um_per_k, s.drift.y_um_per_k)
                    moved[k] += (scale * x - rotation * y, scale * y + rotation * x)
                if cone.probe == probe:
                    moved[k] -= cone.lens.f_ppm_per_k * 1e-3 * place_mm[k]
        result[probe] = moved.reshape(-1)
    return result


def _place_mm(rig: Rig, mosaic: Mosaic, sensor: Sensor) -> tuple[float, float]:
    """Where the sensor's middle lies: in the master's layer, which is the virtual image, or there
    by the head's mounting."""
    if rig.master_cone is not None:
        return sensor.x_mm, sensor.y_mm
    middle = np.array([[(sensor.width_px - 1) / 2.0, (sensor.height_px - 1) / 2.0]])
    x, y = vip_mm_from_raw(mosaic.start[sensor.name], middle)[0]
    return float(x), float(y)


def moved_datum_design(rig: Rig, mosaic: Mosaic, xy_mm: Array) -> Array:
    """How the datum moves points of the image.

    Of converging heads it is a rotation of the virtual camera: its shift grows towards the edges.

    Args:
        rig: the camera.
        mosaic: gives the principal distance.
        xy_mm: points of the virtual image, (n, 2), mm.

    Returns:
        As of `datum_design`, (2 n, 4).
    """
    design = datum_design(xy_mm)
    if rig.master_cone is None:
        x, y = xy_mm.T / mosaic.model.f_mm
        design[0::2, 0] += x * x
        design[1::2, 0] += x * y
        design[0::2, 1] += x * y
        design[1::2, 1] += y * y
    return design


def datum_design(xy_mm: Array) -> Array:
    """How shift, scale and rotation move points.

    Args:
        xy_mm: points of the virtual image, (n, 2), mm.

    Returns:
        (2 n, 4), rows x and y of each point in turn, columns shift x, shift y, scale, rotation.

    Example:
        >>> datum_design(np.array([[10.0, 5.0]]))
        array([[ 1.,  0., 10., -5.],
               [ 0.,  1.,  5., 10.]])
    """
    design = np.zeros((2 * len(xy_mm), 4))
    design[0::2, 0], design[1::2, 1] = 1.0, 1.0
    design[0::2, 2], design[1::2, 2] = xy_mm[:, 0], xy_mm[:, 1]
    design[0::2, 3], design[1::2, 3] = -xy_mm[:, 1], xy_mm[:, 0]
    return design

"""Series of the stitching records of a flight for the sensors of one cone, by exposure.

Contrasts of their places that no shift, scale or rotation of the whole cone can change, and what
calibration, drift coefficients and probes make of them; what follows for the sensors is in
`processing.mosaic.flight_validity`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from processing.mosaic.misfit import (
    POSITION,
    orthogonal_complement,
    per_kelvin,
    similarity_directions,
)
from processing.mosaic.stitch_record import StitchRecord
from processing.rig import Cone, Rig, Sensor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ConeContrasts:
    """Contrasts (c, n) of what records call `names` (n,), and what is known of them, px and ppm.

    `displacement` (c, 2 m) is what a px of each sensor's x and y makes of them, `thermal_design`
    (c,) what a kelvin, by probe; `place`, `drift` (c, c) are covariances of what calibration
    leaves, and of what coefficients leave of a kelvin.
    """

    sensors: tuple[Sensor, ...]
    names: tuple[str, ...]
    contrasts: Array
    displacement: Array
    thermal_design: Mapping[str, Array]
    place: Array
    drift: Array


@dataclass(frozen=True)
class ContrastSeries:
    """Contrasts of one cone over a flight: y (t, c), covariance (t, c, c), dC (t,).

    `factor` is the variance of differences between neighbours over that of their covariance.
    """

    numbers: tuple[int, ...]
    y: Array
    covariance: Array
    dc_k: Array
    factor: float = 1.0


def is_master(rig: Rig, cone: Cone) -> bool:
    """Whether a cone is the rig's master cone.

    Args:
        rig: the camera.
        cone: one of its cones.

    Returns:
        False for all cones of a rig without a master.
    """
    return cone.name == rig.master_cone


def contrasts_of(rig: Rig, cone: Cone, *, quantities: Sequence[str] = POSITION) -> ConeContrasts:
    """The master's sensors up to a common similarity, two sensors of others by difference.

    Args:
        rig: the camera.
        cone: a PAN cone of two sensors or more, three of the master.
        quantities: `POSITION` or, of the master, `POSITION_AND_SCALE`.

    Returns:
        Contrasts of the records' values, and their covariances.
    """
    relative = not is_master(rig, cone)
    sensors = cone.sensors[:2] if relative else cone.sensors
    pitch_um = sensors[0].pitch_um if rig.virtual_image is None else rig.virtual_image.pitch_um
    places = [(s.x_mm, s.y_mm) for s in sensors]
    contrasts = np.hstack([np.eye(2), -np.eye(2)])
    if not relative:
        contrasts = orthogonal_complement(
            similarity_directions(places, pitch_um * 1e-3, quantities)
        )
    unit = np.array([1.0 if q == "scale" else 1.0 / pitch_um for q in quantities])
    # A calibrated scale is as good as places of the same sigma half a diagonal from the centre.
    half_mm = [math.hypot(s.width_px, s.height_px) / 2.0 * s.pitch_mm for s in sensors]
    known = np.array(
        [[1e3 / h if q == "scale" else 1.0 / pitch_um for q in quantities] for h in half_mm]
    )
    variances = [
        np.concatenate([(k * sigma) ** 2 for k, sigma in zip(known, sigmas, strict=True)])
        for sigmas in (
            [s.position_sigma_um for s in sensors],
            [s.drift.sigma_um_per_k for s in sensors],
        )
    ]
    thermal_design = {}
    for probe in dict.fromkeys(s.probe for s in sensors):
        own = [s.probe == probe for s in sensors]
        moves = np.array([per_kelvin(s, quantities, pitch_um) for s in sensors])
        moves *= np.array(own)[:, None]
        if relative:
            moves -= _of_layer(sensors, own) / pitch_um
        thermal_design[probe] = contrasts @ moves.ravel()
    units = {"x": "x_um", "y": "y_um", "scale": "scale_ppm"}
    width = len(quantities)
    axes = [i * width + k for i in range(len(sensors)) for k in (0, 1)]
    return ConeContrasts(
        sensors=sensors,
        names=tuple(f"{s.name}.{units[q]}" for s in sensors for q in quantities),
        contrasts=contrasts * np.tile(unit, len(sensors)),
        displacement=contrasts[:, axes],
        thermal_design=thermal_design,
        place=contrasts * variances[0] @ contrasts.T,
        drift=contrasts * variances[1] @ contrasts.T,
    )


def _of_layer(sensors: Sequence[Sensor], own: Sequence[bool]) -> Array:
    """What their scales and rotations make of the sensors' places per kelvin, um: the layer's."""
    drifts = [s.drift for s, mine in zip(sensors, own, strict=True) if mine]
    scale = sum(d.scale_ppm_per_k for d in drifts) / len(sensors) * 1e-3
    rotation = sum(d.rotation_urad_per_k for d in drifts) / len(sensors) * 1e-3
    return np.array(
        [[scale * s.x_mm - rotation * s.y_mm, scale * s.y_mm + rotation * s.x_mm] for s in sensors]
    )


def series_of(rig: Rig, view: ConeContrasts, records: Mapping[int, StitchRecord]) -> ContrastSeries:
    """The exposures with all of the contrasts' sensors, with the rig's own calibration.

    Args:
        rig: the camera, as calibrated.
        view: contrasts of one cone.
        records: by number of the exposure.

    Returns:
        Contrasts by exposure, in the order of their numbers.
    """
    numbers, y, covariance, dc = [], [], [], []
    for number in sorted(records):
        record = records[number]
        if record.calibration_id != rig.calibration_id or not set(view.names) <= set(record.names):
            continue
        at = [record.names.index(name) for name in view.names]
        numbers.append(number)
        y.append(view.contrasts @ record.values[at])
        covariance.append(view.contrasts @ record.covariance[np.ix_(at, at)] @ view.contrasts.T)
        dc.append(float(np.mean([record.dc_k[s.name] for s in view.sensors])))
    size = len(view.contrasts)
    return ContrastSeries(
        tuple(numbers),
        np.array(y).reshape(-1, size),
        np.array(covariance).reshape(-1, size, size),
        np.array(dc),
    )


def variance_factor(series: ContrastSeries) -> float:
    """Variance of differences between neighbouring exposures over that of their covariance.

    Args:
        series: contrasts of one cone.

    Returns:
        At least 1; 1 for less than four exposures.

    Source: docs/explanation/mathematics/validity.md#over-a-flight.

    Example:
        Differences of one contrast are 1, covariances 1 each: q = 1 / 2, the median of chi-square
        with one degree of freedom is 0.455.

        >>> y = np.array([[0.0], [1.0], [0.0], [1.0]])
        >>> series = ContrastSeries((1, 2, 3, 4), y, np.ones((4, 1, 1)), np.zeros(4))
        >>> round(variance_factor(series), 3), round(float(chdtri(1, 0.5)), 3)
        (1.099, 0.455)
    """
    size = series.y.shape[1]
    if len(series.numbers) < 4:
        return 1.0
    off = np.diff(series.y, axis=0)
    spread = series.covariance[1:] + series.covariance[:-1]
    q = np.einsum("ti,ti->t", off, np.linalg.solve(spread, off[..., None])[..., 0])
    return max(1.0, float(np.median(q)) / float(chdtri(size, 0.5)))


def probe_bias_series(view: ConeContrasts, series: ContrastSeries, probe: str) -> Array:
    """Bias of a probe in each exposure, from places and scales.

    Args:
        view: contrasts of positions and scales.
        series: those contrasts by exposure.
        probe: name of a probe of the cone.

    Returns:
        How much too large the probe reads, (t,), K.

    Source: docs/explanation/mathematics/validity.md#probe-that-misreads.
    """
    design = -view.thermal_design[probe]
    weight = np.linalg.inv(series.covariance + view.place)
    normal_vector = np.einsum("i,tij,tj->t", design, weight, series.y)
    return np.asarray(normal_vector / np.einsum("i,tij,j->t", design, weight, design), np.float64)


def with_probe_ignored(
    view: ConeContrasts, series: ContrastSeries, probe: str, *, bias_k: Array, sigma_k: float
) -> ContrastSeries:
    """The series where a probe's readings count for nothing.

    Args:
        view: contrasts of one cone.
        series: those contrasts by exposure.
        probe: name of the probe.
        bias_k: how much too large it reads, (t,), K.
        sigma_k: standard deviation of the temperature without it, K.

    Returns:
        The series with the bias taken out of dC, and a larger covariance.
    """
    thermal_design = view.thermal_design[probe]
    share = sum(s.probe == probe for s in view.sensors) / len(view.sensors)
    return replace(
        series,
        covariance=series.covariance + np.outer(thermal_design, thermal_design) * sigma_k**2,
        dc_k=series.dc_k - share * bias_k,
    )

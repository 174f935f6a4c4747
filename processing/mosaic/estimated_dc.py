"""dC as the stitching sees it: how far sensors of one cone have moved apart, in sensor lengths.

A second way to dC in addition to the probes, for cones of two or more CCDs, always with its
standard deviation. What drift does is in `processing.geometry.drift`; nothing found here moves a
pixel.

Source: docs/explanation/mathematics/drift.md#estimated-dc; Ladstädter et al. (2010), fig. 1,
"estimation of dC from the stitching scales".
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.geometry.drift import sensor_dc
from processing.mosaic.free_mosaic import Mosaic
from processing.quality.figures.circumstances import EstimatedDcFigures
from processing.rig import Rig, Sensor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EstimateSettings:
    """What the estimate assumes and the test demands.

    `probe_sigma_k` is a measured dC's standard deviation. An estimate whose own is above
    `max_sigma_k` is none. The flag is raised at `limit` standard deviations of the difference
    (0.1 % of one test at 3.29; 4.5 allows for a flight of ten thousand) if it is also more than
    `min_difference_k`.
    """

    probe_sigma_k: float = 0.1
    max_sigma_k: float = 10.0
    limit: float = 4.5
    min_difference_k: float = 1.0


@dataclass(frozen=True)
class EstimatedDc:
    """dC of one cone by stitching and by its probes, K.

    `estimated_k` and `sigma_k` are None where dC is not determinable: fewer than two sensors found,
    or a mount that expands like silicon (`rate_ppm_per_k` near zero). `expansion_ppm` is how much
    more than the sensors the distances between them have grown since calibration. `measured_k` is
    None where no probe of the cone has a temperature.
    """

    cone: str
    estimated_k: float | None
    sigma_k: float | None
    measured_k: float | None
    expansion_ppm: float | None
    rate_ppm_per_k: float
    disagrees: bool


def estimate_dc(
    rig: Rig,
    mosaic: Mosaic,
    temperatures_c: Mapping[str, float],
    *,
    measured: Mapping[str, float] | None = None,
    displaced: Collection[str] = (),
    settings: EstimateSettings | None = None,
) -> tuple[EstimatedDc, ...]:
    """dC of every PAN cone of two or more sensors.

    The quantity behind it is, per cone, ln(scale of the constellation) - mean of ln(scale of the
    sensors): the constellation's is the best-fit similarity of adjusted onto calibrated sensor
    positions. A similarity common to the cone (datum, layer transformation, drift of the principal
    distance) drops out; what is left is the expansion of the mount relative to silicon.

    Args:
        rig: the camera.
        mosaic: a free mosaic, in any datum.
        temperatures_c: temperature by probe name, as the mosaic's start was made with; a probe
            without one held its sensors at calibration.
        measured: those of them that were read and not bridged; None is all.
        displaced: sensors left out, whose place carries no information on temperature.
        settings: None takes the defaults.

    Returns:
        One estimate for each such cone, in the order of the rig.

    Source: docs/explanation/mathematics/drift.md#estimated-dc.
    """
    settings = settings or EstimateSettings()
    return tuple(
        _estimate(
            cone.name,
            cone.sensors,
            mosaic,
            temperatures_c,
            temperatures_c if measured is None else measured,
            displaced,
            settings,
        )
        for cone in rig.pan_cones
        if len(cone.sensors) >= 2
    )


def combined_dc(estimates: Sequence[EstimatedDc]) -> tuple[float, float] | None:
    """Weighted mean of the cones' estimates.

    Args:
        estimates: from `estimate_dc`.

    Returns:
        dC and its standard deviation, K; None where no cone has an estimate.
    """
    known = [
        (e.estimated_k, e.sigma_k)
        for e in estimates
        if e.estimated_k is not None and e.sigma_k is not None
    ]
    if not known:
        return None
    weight = sum(1.0 / sigma**2 for _, sigma in known)
    return sum(k / sigma**2 for k, sigma in known) / weight, 1.0 / math.sqrt(weight)


def estimated_dc_figures(estimates: Sequence[EstimatedDc]) -> EstimatedDcFigures:
    """dC by stitching in figures of the quality report.

    Args:
        estimates: from `estimate_dc`.

    Returns:
        dC over all cones with an estimate, and the cones whose probes disagree.
    """
    combined = combined_dc(estimates)
    return EstimatedDcFigures(
        dc_estimated_k=None if combined is None else combined[0],
        dc_estimated_sigma_k=None if combined is None else combined[1],
        dc_disagreement=tuple(estimate.cone for estimate in estimates if estimate.disagrees),
    )


def expansion_rate(sensors: Sequence[Sensor]) -> tuple[float, float]:
    """Expansion of the constellation relative to its sensors by the rig file.

    Args:
        sensors: of one cone, two at least.

    Returns:
        The rate, and its sigma by that of the drift coefficients (`sigma_um_per_k`), ppm/K.
    """
    lever = _levers(sensors)
    moved = np.array([[s.drift.x_um_per_k, s.drift.y_um_per_k] for s in sensors])
    sigma = np.array([s.drift.sigma_um_per_k for s in sensors])
    # um over mm is 1e-3, so 1e3 ppm.
    growth = float(np.sum(lever * moved)) * 1e3
    spread = math.sqrt(float(np.sum((lever * sigma[:, None]) ** 2))) * 1e3
    return growth - float(np.mean([s.drift.scale_ppm_per_k for s in sensors])), spread


def _estimate(
    cone: str,
    sensors: Sequence[Sensor],
    mosaic: Mosaic,
    temperatures_c: Mapping[str, float],
    readings_c: Mapping[str, float],
    displaced: Collection[str],
    settings: EstimateSettings,
) -> EstimatedDc:
    estimable = [sensor_dc(s, readings_c) for s in sensors if s.probe in readings_c]
    measured = float(np.mean(estimable)) if estimable else None
    found = [s for s in sensors if _is_found(mosaic, s.name) and s.name not in displaced]
    if len(found) < 2:
        return EstimatedDc(cone, None, None, measured, None, expansion_rate(sensors)[0], False)
    rate, rate_sigma = expansion_rate(found)
    lever = _levers(found)
    functional = np.zeros(len(mosaic.model.names))
    for sensor, (x, y) in zip(found, lever, strict=True):
        first = mosaic.model.sensors[sensor.name]
        functional[first : first + 2] = x, y
        functional[first + 3] = -1.0 / len(found)
    dc = np.array([sensor_dc(s, temperatures_c) for s in found])
    grown_ppm = float(functional @ mosaic.values) * 1e6
    moved = np.array([[s.drift.x_um_per_k, s.drift.y_um_per_k] for s in found])
    scales = np.array([s.drift.scale_ppm_per_k for s in found])
    expected_ppm = float(np.sum(lever * moved * dc[:, None]) * 1e3 - np.mean(scales * dc))
    start_k = float(np.mean(dc))
    variance = float(functional @ mosaic.covariance @ functional) * 1e12
    variance += _calibration_variance(found, lever)
    estimated = sigma = None
    disagrees = False
    if abs(rate) > 3.0 * rate_sigma and rate != 0.0:
        estimated = start_k + grown_ppm / rate
        # The rate's own uncertainty turns what was seen, not what was assumed, into kelvin.
        sigma = math.sqrt(variance + (rate_sigma * estimated) ** 2) / abs(rate)
        if sigma > settings.max_sigma_k:
            estimated = sigma = None
    if estimated is not None and sigma is not None and measured is not None:
        difference = abs(estimated - measured)
        limit = settings.limit * math.hypot(sigma, settings.probe_sigma_k)
        disagrees = difference > max(limit, settings.min_difference_k)
    return EstimatedDc(cone, estimated, sigma, measured, expected_ppm + grown_ppm, rate, disagrees)


def _levers(sensors: Sequence[Sensor]) -> Array:
    """(m, 2), 1/mm: sum over levers times shifts (mm) is the growth of the constellation."""
    place = np.array([[s.x_mm, s.y_mm] for s in sensors])
    place -= place.mean(axis=0)
    spread = float(np.sum(place**2))
    return place / spread if spread > 0.0 else np.zeros_like(place)


def _calibration_variance(sensors: Sequence[Sensor], lever: Array) -> float:
    """Of the calibrated positions and scales, ppm squared.

    A calibrated scale is as good as positions of the same sigma half a diagonal from the centre.
    """
    variance = 0.0
    for sensor, (x, y) in zip(sensors, lever, strict=True):
        half_mm = math.hypot(sensor.width_px, sensor.height_px) / 2.0 * sensor.pitch_mm
        own = (x * x + y * y) * 1e6 + 1e6 / (half_mm * len(sensors)) ** 2
        variance += own * sensor.position_sigma_um**2
    return variance


def _is_found(mosaic: Mosaic, sensor: str) -> bool:
    held = {f"{sensor}.{what}" for what in ("x", "y", "scale")}
    return sensor in mosaic.model.sensors and not held & set(mosaic.undetermined)

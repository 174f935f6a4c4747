"""TDM, the temperature dependent model: a sensor's place and a cone's principal distance at dC.

dC is the temperature at exposure minus the temperature at calibration, measured by the sensor's or
the cone's own probe. A sensor that follows its probe with a lag has a temperature of its own under
the name `lagged_probe` gives it; `lag_step` is the filter it is made with.

Source: docs/explanation/mathematics/drift.md#linear-model and #lag; Ladstädter et al. (2010),
"temperature dependant model".
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from processing.geometry.similarity import Similarity
from processing.rig import Cone, Rig, Sensor


def sensor_dc(sensor: Sensor, temperatures_c: Mapping[str, float]) -> float:
    """dC of a sensor, K; zero where its probe has no temperature.

    Uses the lagged temperature where the rig configures a lag and the value is present.
    """
    known = temperatures_c.get(sensor.probe, sensor.calibration_c)
    if sensor.drift.lag_s > 0.0:
        known = temperatures_c.get(lagged_probe(sensor), known)
    return known - sensor.calibration_c


def lagged_probe(sensor: Sensor) -> str:
    """Name of a sensor's lagged temperature in a table of probe temperatures."""
    return f"{sensor.probe}/{sensor.name}"


def lagged_sensors(rig: Rig) -> tuple[Sensor, ...]:
    """The sensors that follow their probes with a lag."""
    return tuple(sensor for sensor in rig.sensors if sensor.drift.lag_s > 0.0)


def lag_step(lagged_c: float, before_c: float, now_c: float, step_s: float, lag_s: float) -> float:
    """One step of a first-order lag: dy/dt = (x - y) / lag.

    Exact for a probe that went straight from `before_c` to `now_c`, whatever the step.

    Args:
        lagged_c: y at the beginning of the step.
        before_c: x there.
        now_c: x at its end.
        step_s: its length; below or at zero changes nothing.
        lag_s: time constant; zero follows at once.
    """
    if lag_s <= 0.0:
        return now_c
    if step_s <= 0.0:
        return lagged_c
    behind_c = (now_c - before_c) / step_s * lag_s
    return now_c - behind_c + (lagged_c - before_c + behind_c) * math.exp(-step_s / lag_s)


def cone_dc(cone: Cone, temperatures_c: Mapping[str, float]) -> float:
    """dC of a cone's lens, K; zero where its probe has no temperature."""
    return temperatures_c.get(cone.probe, cone.calibration_c) - cone.calibration_c


def missing_probes(rig: Rig, temperatures_c: Mapping[str, float]) -> tuple[str, ...]:
    """Probes of the rig without a temperature in the exposure: their sensors stay at calibration."""
    return tuple(probe for probe in rig.probes if probe not in temperatures_c)


def physical_similarity(sensor: Sensor, dc_k: float) -> Similarity:
    """layer_from_sensor in the physical layer at dC (before lens correction)."""
    drift = sensor.drift
    return Similarity(
        x_mm=sensor.x_mm + drift.x_um_per_k * 1e-3 * dc_k,
        y_mm=sensor.y_mm + drift.y_um_per_k * 1e-3 * dc_k,
        rotation_rad=sensor.rotation_rad + drift.rotation_urad_per_k * 1e-6 * dc_k,
        scale=sensor.scale * (1.0 + drift.scale_ppm_per_k * 1e-6 * dc_k),
    )


def principal_distance(cone: Cone, dc_k: float) -> float:
    """f(T) in mm."""
    return cone.lens.f_mm * (1.0 + cone.lens.f_ppm_per_k * 1e-6 * dc_k)

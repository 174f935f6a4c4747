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
    """dC of a sensor: temperature of the exposure minus that of the calibration.

    Uses the lagged temperature where the rig configures a lag and the value is present.

    Args:
        sensor: the sensor; its probe, lag and calibration temperature are used.
        temperatures_c: temperature by probe, lagged ones by `lagged_probe`, degC.

    Returns:
        dC, K; zero where its probe has no temperature.

    Example:
        >>> from processing.rig import find_rig
        >>> sensor = find_rig("ultracam-x").sensor("SU00")
        >>> sensor.probe, sensor.calibration_c
        ('0', 20.0)
        >>> sensor_dc(sensor, {"0": 12.5}), sensor_dc(sensor, {})
        (-7.5, 0.0)
    """
    known = temperatures_c.get(sensor.probe, sensor.calibration_c)
    if sensor.drift.lag_s > 0.0:
        known = temperatures_c.get(lagged_probe(sensor), known)
    return known - sensor.calibration_c


def lagged_probe(sensor: Sensor) -> str:
    """Name of a sensor's lagged temperature in a table of probe temperatures.

    Args:
        sensor: the sensor; whether it has a lag does not matter.

    Returns:
        "<probe>/<sensor>".

    Example:
        >>> from processing.rig import find_rig
        >>> lagged_probe(find_rig("ultracam-x").sensor("SU01"))
        '0/SU01'
    """
    return f"{sensor.probe}/{sensor.name}"


def lagged_sensors(rig: Rig) -> tuple[Sensor, ...]:
    """The sensors that follow their probes with a lag.

    Args:
        rig: the camera.

    Returns:
        Sensors whose `drift.lag_s` is positive, in file order.
    """
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

    Returns:
        y at the end of the step, degC.

    Source: docs/explanation/mathematics/drift.md#lag.

    Example:
        A probe at 30 degC throughout: after one time constant 1 - 1/e of the way is done.

        >>> round(lag_step(20.0, 30.0, 30.0, step_s=60.0, lag_s=60.0), 3)
        26.321
    """
    if lag_s <= 0.0:
        return now_c
    if step_s <= 0.0:
        return lagged_c
    behind_c = (now_c - before_c) / step_s * lag_s
    return now_c - behind_c + (lagged_c - before_c + behind_c) * math.exp(-step_s / lag_s)


def cone_dc(cone: Cone, temperatures_c: Mapping[str, float]) -> float:
    """dC of a cone's lens: temperature of the exposure minus that of the calibration.

    Args:
        cone: the cone; its own probe and calibration temperature are used.
        temperatures_c: temperature by probe, degC.

    Returns:
        dC, K; zero where its probe has no temperature.
    """
    return temperatures_c.get(cone.probe, cone.calibration_c) - cone.calibration_c


def missing_probes(rig: Rig, temperatures_c: Mapping[str, float]) -> tuple[str, ...]:
    """Probes of the rig without a temperature in the exposure: their sensors stay at calibration.

    Args:
        rig: the camera.
        temperatures_c: temperature by probe, degC.

    Returns:
        Names of the probes, in the order of the file.

    Example:
        >>> from processing.rig import find_rig
        >>> rig = find_rig("ultracam-x")
        >>> missing_probes(rig, dict.fromkeys(rig.probes[1:], 20.0)) == rig.probes[:1]
        True
    """
    return tuple(probe for probe in rig.probes if probe not in temperatures_c)


def physical_similarity(sensor: Sensor, dc_k: float) -> Similarity:
    """layer_from_sensor in the physical layer at dC (before lens correction).

    Args:
        sensor: calibrated place and drift.
        dc_k: dC of the sensor, K.

    Returns:
        The similarity from sensor coordinates to the layer, mm.

    Source: docs/explanation/mathematics/drift.md#linear-model.

    Example:
        2 um/K over 10 K move a sensor by 20 um.

        >>> from processing.rig import Sensor, ThermalDrift
        >>> sensor = Sensor(
        ...     name="S", width_px=100, height_px=100, pitch_um=5.0, x_mm=8.0, y_mm=0.0,
        ...     calibration_c=20.0, probe="P", drift=ThermalDrift(x_um_per_k=2.0)
        ... )
        >>> round(physical_similarity(sensor, 10.0).x_mm, 6)
        8.02
    """
    drift = sensor.drift
    return Similarity(
        x_mm=sensor.x_mm + drift.x_um_per_k * 1e-3 * dc_k,
        y_mm=sensor.y_mm + drift.y_um_per_k * 1e-3 * dc_k,
        rotation_rad=sensor.rotation_rad + drift.rotation_urad_per_k * 1e-6 * dc_k,
        scale=sensor.scale * (1.0 + drift.scale_ppm_per_k * 1e-6 * dc_k),
    )


def principal_distance(cone: Cone, dc_k: float) -> float:
    """Principal distance of a cone at dC, f(T) = f (1 + rate * dC).

    Args:
        cone: `lens.f_mm` and `lens.f_ppm_per_k` are used.
        dc_k: dC of the cone, K.

    Returns:
        f(T), mm.

    Source: docs/explanation/mathematics/drift.md#linear-model.

    Example:
        28.03 ppm/K of 100.5 mm are 2.8 um a kelvin.

        >>> from processing.rig import find_rig
        >>> round(principal_distance(find_rig("ultracam-x-mini").cone("0"), 10.0), 4)
        100.5282
    """
    return cone.lens.f_mm * (1.0 + cone.lens.f_ppm_per_k * 1e-6 * dc_k)

"""TDM, the temperature dependent model: a sensor's place and a cone's principal distance at dC.

dC is the temperature at exposure minus the temperature at calibration, measured by the sensor's or
the cone's own probe. A time lag of a probe is the caller's to filter: temperatures come in as they
hold.

Source: DESIGN 5.3; seeds/ultracam-calibration.txt, "temperature dependant model".
"""

from __future__ import annotations

from collections.abc import Mapping

from processing.rig import Cone, Rig, Sensor
from processing.similarity import Similarity


def sensor_dc(sensor: Sensor, temperatures_c: Mapping[str, float]) -> float:
    """dC of a sensor, K; zero where its probe has no temperature."""
    return temperatures_c.get(sensor.probe, sensor.calibration_c) - sensor.calibration_c


def cone_dc(cone: Cone, temperatures_c: Mapping[str, float]) -> float:
    """dC of a cone's lens, K; zero where its probe has no temperature."""
    return temperatures_c.get(cone.probe, cone.calibration_c) - cone.calibration_c


def missing_probes(rig: Rig, temperatures_c: Mapping[str, float]) -> tuple[str, ...]:
    """Probes the rig asks for and the exposure lacks: their sensors stay at calibration."""
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

"""A proposed calibration from learned drift: the changed rig, with old and new values.

What was learned is in `processing.calibration.thermal_learning`; a person decides whether it
is accepted.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from processing.calibration.thermal_learning import LearnedDrift, LearnedScale, LearnedSensor
from processing.rig import Cone, Rig, Sensor


@dataclass(frozen=True)
class ProposedChange:
    """One value, old and new, with the standard deviation of the new one and what it does.

    `where` is a sensor or a cone, `what` the key in the rig file. `effect_px` is what the change
    moves the farthest pixel by at the largest dC flown (a rate), or at any (a place).
    """

    where: str
    what: str
    old: float
    new: float
    sigma: float
    effect_px: float

    @property
    def significance(self) -> float:
        """The change over its standard deviation."""
        return abs(self.new - self.old) / self.sigma if self.sigma > 0.0 else math.inf


_RATES = {
    "x_um": "x_um_per_k",
    "y_um": "y_um_per_k",
    "rotation_urad": "rotation_urad_per_k",
    "scale_ppm": "scale_ppm_per_k",
}


def proposed_rig(
    rig: Rig, learned: LearnedDrift, *, calibration_id: str, date: str
) -> tuple[Rig, tuple[ProposedChange, ...]]:
    """The rig with the learned rates and, since they belong together, the intercepts as places.

    What stitching cannot see keeps its old value: the sums over the sensors of a cone do not
    change, nor does anything of the master cone's lens. Scales of layers at the calibration
    temperature are not turned into principal distances.

    Args:
        rig: the camera, with the calibration that was flown.
        learned: corrections to it.
        calibration_id: of the proposed calibration.
        date: of the proposed calibration, YYYY-MM-DD.

    Returns:
        The proposed rig, and every changed value, old and new.
    """
    sensors = {s.sensor: s for s in learned.sensors}
    scales = {s.cone: s for s in learned.scales}
    changes: list[ProposedChange] = []
    cones = []
    for cone in rig.cones:
        new = tuple(
            _sensor(cone, s, sensors[s.name], changes) if s.name in sensors else s
            for s in cone.sensors
        )
        proposed = dataclasses.replace(cone, sensors=new)
        if cone.name in scales:
            proposed = _lens(proposed, scales[cone.name], changes)
        cones.append(proposed)
    proposal = dataclasses.replace(
        rig, cones=tuple(cones), calibration_id=calibration_id, calibration_date=date
    )
    return proposal, tuple(changes)


def _sensor(
    cone: Cone, sensor: Sensor, found: LearnedSensor, changes: list[ProposedChange]
) -> Sensor:
    m = len(cone.sensors)
    half_um = math.hypot(sensor.width_px, sensor.height_px) / 2.0 * sensor.pitch_um
    # What an urad or a ppm does at the sensor's corner, um.
    arm_um = {
        "x_um": 1.0,
        "y_um": 1.0,
        "rotation_urad": half_um * 1e-6,
        "scale_ppm": half_um * 1e-6,
    }
    drift = sensor.drift
    for quantity, key in _RATES.items():
        old = getattr(drift, key)
        effect = (
            abs(found.rates[quantity]) * arm_um[quantity] * found.largest_dc_k / sensor.pitch_um
        )
        new = old + found.rates[quantity]
        changes.append(
            ProposedChange(sensor.name, key, old, new, found.rate_sigmas[quantity], effect)
        )
        drift = dataclasses.replace(drift, **{key: new})
    # The inner part is as good as it was learned, the common part as good as it was.
    learned_um = max(found.rate_sigmas["x_um"], found.rate_sigmas["y_um"])
    drift = dataclasses.replace(
        drift, sigma_um_per_k=math.hypot(learned_um, drift.sigma_um_per_k / math.sqrt(m))
    )
    offsets, sigmas = found.offsets, found.offset_sigmas
    new_sensor = dataclasses.replace(
        sensor,
        drift=drift,
        x_mm=sensor.x_mm + offsets["x_um"] * 1e-3,
        y_mm=sensor.y_mm + offsets["y_um"] * 1e-3,
        rotation_rad=sensor.rotation_rad + offsets["rotation_urad"] * 1e-6,
        scale=sensor.scale * (1.0 + offsets["scale_ppm"] * 1e-6),
        position_sigma_um=math.hypot(
            max(sigmas["x_um"], sigmas["y_um"]), sensor.position_sigma_um / math.sqrt(m)
        ),
    )
    places = (
        ("x_um", "x_mm", 1e-3),
        ("y_um", "y_mm", 1e-3),
        ("rotation_urad", "rotation_rad", 1e-6),
        ("scale_ppm", "scale", 1e-6),
    )
    for quantity, key, unit in places:
        effect = abs(offsets[quantity]) * arm_um[quantity] / sensor.pitch_um
        old, new = getattr(sensor, key), getattr(new_sensor, key)
        changes.append(ProposedChange(sensor.name, key, old, new, sigmas[quantity] * unit, effect))
    return new_sensor


def _lens(cone: Cone, found: LearnedScale, changes: list[ProposedChange]) -> Cone:
    old = cone.lens.f_ppm_per_k
    new = old + found.f_ppm_per_k
    changes.append(
        ProposedChange(
            f"cone {cone.name}", "f_ppm_per_k", old, new, found.sigma_ppm_per_k, found.effect_px
        )
    )
    return dataclasses.replace(cone, lens=dataclasses.replace(cone.lens, f_ppm_per_k=new))

"""Calibration of a whole rig in a 3D test field (`calibrate lab`).

Every CCD's shift, rotation, scale and perspective skew, every cone's lens and its rotation against
the master cone, in one bundle adjustment. Datum: principal distance and principal point of the
cones stay as they are, and the first CCD of each cone is not turned. Sources:
Ladstädter et al. (2010), laboratory calibration; docs/how-to/processing/calibration.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from daemon.postflight.calibration.laboratory.field_measurement import (
    FieldExposure,
    Progress,
    TargetField,
    TargetObservations,
    master_of,
)
from daemon.postflight.calibration.laboratory.field_network import LENS_FREE, lab_network, term_name
from daemon.postflight.calibration.laboratory.head_geometry import LENS_KEYS
from daemon.postflight.calibration.laboratory.laboratory_series import SeriesError
from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.network import INTERIOR, NetworkError
from processing.bundle.rank_diagnosis import RankDefectError
from processing.bundle.terms import Kind
from processing.geometry.rotation import omega_phi_kappa
from processing.rig import Rig, Sensor

EXPECTED_SIGMA_PX: Final = 0.02
_SKEW: Final[tuple[Kind, Kind]] = ("perspective-x", "perspective-y")
_MAX_ROUNDS: Final = 6
_CONVERGED_SHARE: Final = 0.03
_CONVERGED_MM: Final = 5e-5
"""What a CCD moves by passes through its lens only in the next round: 2 in a thousand of it."""


@dataclass(frozen=True)
class RigCalibration:
    """Result: the rig with its new places, and the last adjustment, whose cofactor holds
    for them."""

    rig: Rig
    before: Rig
    observations: TargetObservations
    adjustment: Adjustment
    sigma_px: float
    rejected: int
    temperatures_c: Mapping[str, float]


def calibrate_rig(
    rig: Rig,
    exposures: Sequence[FieldExposure],
    field: TargetField,
    observations: TargetObservations,
    *,
    offset_sigma_mm: float,
    skew_sigma_per_mm: float,
    progress: Progress,
) -> RigCalibration:
    """Adjust everything; twice, so that the second time corrections are small and nothing wrong
    is among the measurements.

    Args:
        offset_sigma_mm: how well the drawing knows the cones' projection centres.
        skew_sigma_per_mm: how far a CCD's skew is from the rig file's, beforehand (one sigma).

    Raises:
        SeriesError: what cannot be determined, named.
    """

    def adjusted(
        current: Rig, own: TargetObservations, sigma_px: float, settings: AdjustmentSettings
    ) -> Adjustment:
        network = lab_network(
            current,
            exposures,
            field,
            own,
            offset_sigma_mm=offset_sigma_mm,
            skew_sigma_per_mm=skew_sigma_per_mm,
            sigma_px=sigma_px,
            drawn=rig,
        )
        try:
            return adjust(
                network,
                settings,
                progress=lambda what, step, _: progress(f"adjusting: {what}", step, 0),
            )
        except RankDefectError as error:
            raise SeriesError([d.sentence for d in error.rank_defects]) from error
        except NetworkError as error:
            raise SeriesError(list(error.problems)) from error

    first = adjusted(rig, observations, EXPECTED_SIGMA_PX, AdjustmentSettings(robust=True))
    # Discs that are none, and targets taken for others, are out; the noise is what was found.
    accepted = ~first.rejected & (first.weight > 0.0)
    observations = TargetObservations(
        *(getattr(observations, f)[accepted] for f in ("exposure", "sensor", "target", "px"))
    )
    found_px = EXPECTED_SIGMA_PX * _image_factor(first)
    current = _moved(rig, first)
    for _ in range(_MAX_ROUNDS):
        result = adjusted(current, observations, found_px, AdjustmentSettings())
        current = _moved(current, result)
        factor = _image_factor(result)
        if abs(factor - 1.0) < _CONVERGED_SHARE and _largest_move(result) < _CONVERGED_MM:
            break
        found_px *= factor
    seen = [e.temperatures for e in exposures]
    probes = {name for t in seen for name in t}
    mean = {p: float(np.mean([t[p] for t in seen if p in t])) for p in sorted(probes)}
    return RigCalibration(
        rig=_at_temperatures(_skewed(current, result), mean),
        before=rig,
        observations=observations,
        adjustment=result,
        sigma_px=found_px,
        rejected=int((~accepted).sum()),
        temperatures_c=mean,
    )


def _image_factor(result: Adjustment) -> float:
    """Image noise found over that expected, without what was rejected."""
    used = ~result.rejected & (result.weight > 0.0)
    own = (result.equations.group <= 1) & np.isin(result.equations.source, np.flatnonzero(used))
    freedom = float(result.redundancy_number[own].sum())
    squares = float(np.sum(result.residual[own] ** 2))
    return float(np.sqrt(squares / max(freedom, 1.0)))


def _largest_move(result: Adjustment) -> float:
    """Largest shift of a CCD that an adjustment found, mm."""
    return max(
        abs(float(value))
        for camera, values in zip(result.network.cameras, result.state.terms, strict=True)
        for term, value in zip(camera.terms, values, strict=True)
        if term.kind in ("shift-x", "shift-y")
    )


def _moved(rig: Rig, result: Adjustment) -> Rig:
    """The rig with what an adjustment found, but for skew: it is held to the rig file's in every
    round, and so counted from there."""
    master = master_of(rig)
    cones = []
    angles = omega_phi_kappa(result.state.head_rotation)
    for k, cone in enumerate(rig.cones):
        camera = result.network.cameras[k]
        if not camera.terms:
            cones.append(cone)
            continue
        values = dict(
            zip([t.name for t in camera.terms], result.state.terms[k].tolist(), strict=True)
        )
        lens: dict[str, Any] = {
            LENS_KEYS[n]: float(v)
            for n, v in zip(INTERIOR, result.state.interior[k], strict=True)
            if n in LENS_FREE
        }
        right, forward, up = (float(v) * 1e3 for v in result.state.head_offset[k])
        at = master.position_mm
        is_master = cone.name == master.name
        cones.append(
            replace(
                cone,
                lens=replace(cone.lens, **lens, residual_grid=None),
                rotation_rad=cone.rotation_rad
                if is_master
                else (float(angles[k, 0]), float(angles[k, 1]), float(angles[k, 2])),
                position_mm=cone.position_mm
                if is_master
                else (at[0] + forward, at[1] + right, at[2] - up),
                sensors=tuple(_placed(s, values) for s in cone.sensors),
            )
        )
    return replace(rig, cones=tuple(cones))


def _placed(sensor: Sensor, values: Mapping[str, float]) -> Sensor:
    return replace(
        sensor,
        x_mm=sensor.x_mm + values[term_name(sensor, "shift-x")],
        y_mm=sensor.y_mm + values[term_name(sensor, "shift-y")],
        scale=sensor.scale * (1.0 + values[term_name(sensor, "scale")]),
        rotation_rad=sensor.rotation_rad + values.get(term_name(sensor, "rotation"), 0.0),
    )


def _at_temperatures(rig: Rig, mean: Mapping[str, float]) -> Rig:
    """The new places hold at the temperatures of the calibration."""
    return replace(
        rig,
        cones=tuple(
            replace(
                cone,
                calibration_c=round(mean.get(cone.probe, cone.calibration_c), 2),
                sensors=tuple(
                    replace(s, calibration_c=round(mean.get(s.probe, s.calibration_c), 2))
                    for s in cone.sensors
                ),
            )
            for cone in rig.cones
        ),
    )


def _skewed(rig: Rig, result: Adjustment) -> Rig:
    """The rig with the skew that the last adjustment found."""
    found = {
        term.name: float(value) * 1e6
        for camera, values in zip(result.network.cameras, result.state.terms, strict=True)
        for term, value in zip(camera.terms, values, strict=True)
    }

    def skewed(sensor: Sensor) -> Sensor:
        x, y = (found.get(term_name(sensor, kind), 0.0) for kind in _SKEW)
        return replace(
            sensor,
            skew_x_ppm_per_mm=sensor.skew_x_ppm_per_mm + x,
            skew_y_ppm_per_mm=sensor.skew_y_ppm_per_mm + y,
        )

    return replace(
        rig,
        cones=tuple(replace(c, sensors=tuple(skewed(s) for s in c.sensors)) for c in rig.cones),
    )

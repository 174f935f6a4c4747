"""Test of the calibration: sensors in the stitching against calibration + TDM.

This module holds the test and the datum that follows from it; the adjustment is in
`processing.mosaic.free_mosaic`. Displacements are (x right, y up), found minus expected, in PAN px.

Source: docs/explanation/mathematics/validity.md#one-displaced-sensor; Ladstädter et al. (2010),
"Optimal IO reconstruction", fig. 5 and 6.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from processing.geometry.placement import SensorPlacement
from processing.matching.tie_points import TiePoints
from processing.mosaic.free_mosaic import Mosaic, MosaicSettings, datum_constraints, free_mosaic
from processing.mosaic.misfit import (
    POSITION,
    POSITION_AND_SCALE,
    Misfit,
    PriorSigmas,
    ProbeBias,
    expected_covariance,
    found_quantities,
    misfit,
    similarity_directions,
)
from processing.rig import Rig

Array = NDArray[np.float64]

MIN_PAN_POINTS = 24
"""Fewer used P/P points do not determine a sensor's place."""

Observability = Literal["named", "relative", "unobservable"]


@dataclass(frozen=True)
class ValiditySettings:
    """What the tests assume and demand.

    `family_alpha` is the probability of naming any sensor of a healthy rig. A sensor is an
    alternative to the named one unless it is `odds` times less likely; so is a probe.
    """

    prior_sigmas: PriorSigmas = field(default_factory=PriorSigmas)
    family_alpha: float = 0.001
    odds_limit: float = 19.0


@dataclass(frozen=True)
class Residual:
    """Where the stitching puts a master sensor against calibration + TDM (fig. 5d)."""

    sensor: str
    dx_px: float
    dy_px: float
    sigma_x_px: float
    sigma_y_px: float


@dataclass(frozen=True)
class Displacement:
    """One master sensor's displacement against the others, if it alone had moved.

    `statistic` is chi-square with two degrees of freedom on a healthy rig.
    """

    sensor: str
    dx_px: float
    dy_px: float
    sigma_x_px: float
    sigma_y_px: float
    statistic: float

    @property
    def length_px(self) -> float:
        """Length of the displacement, PAN px."""
        return math.hypot(self.dx_px, self.dy_px)


@dataclass(frozen=True)
class RelativeDisplacement:
    """Two sensors of one cone against each other (a minus b); which of them moved is not known."""

    cone: str
    sensor_a: str
    sensor_b: str
    dx_px: float
    dy_px: float
    sigma_x_px: float
    sigma_y_px: float
    statistic: float
    limit: float

    @property
    def significant(self) -> bool:
        """True where the statistic exceeds its limit."""
        return self.statistic > self.limit


@dataclass(frozen=True)
class Validity:
    """The verdict on one exposure.

    `observability` states per cone what can be determined: a single displaced sensor is named, only
    a relative displacement is seen, or nothing (one sensor: the layer transformation absorbs it).
    `consistent` is the global test of the master sensors. `displaced` is the named sensor, with
    `alternatives` that fit nearly as well; `several_displaced` is true where one sensor does not
    explain it all.
    `probe_bias` is a probe whose error explains the misfit nearly as well as the named sensor, or,
    with no sensor named, clearly better. `insignificant_displacement` is a sensor that would be
    named if more than P/C points and a few P/P showed it, or its alternatives.
    """

    observability: Mapping[str, Observability]
    residuals: tuple[Residual, ...]
    global_statistic: float
    global_degrees_of_freedom: int
    global_limit: float
    hypotheses: tuple[Displacement, ...]
    limit: float
    displaced: Displacement | None
    alternatives: tuple[str, ...]
    several_displaced: bool
    relative: tuple[RelativeDisplacement, ...]
    probe_bias: ProbeBias | None = None
    insignificant_displacement: Displacement | None = None

    @property
    def consistent(self) -> bool:
        """True where the global test is passed."""
        return self.global_statistic <= self.global_limit


def evaluate_master(
    rig: Rig,
    mosaic: Mosaic,
    temperatures_c: Mapping[str, float],
    *,
    settings: ValiditySettings | None = None,
) -> Validity:
    """Test the master cone's sensors, and the relative places in cones of two or more.

    The covariance of the residuals is that of stitching + calibration (`position_sigma_um`) + TDM
    (coefficient sigma times dC, and the probe's sigma common to its sensors). The datum does not
    matter: shift, rotation and scale common to the master sensors are taken out. A sensor is only
    named where no probe's error explains it better.

    Args:
        rig: the camera.
        mosaic: a free mosaic, in any datum.
        temperatures_c: temperature by probe name, as the mosaic's start was made with.
        settings: None takes the defaults.

    Returns:
        The verdict.

    Source: docs/explanation/mathematics/validity.md#one-displaced-sensor and #probe-that-misreads.
    """
    settings = settings or ValiditySettings()
    master = [
        s.name
        for s in rig.master_sensors
        if s.name in mosaic.model.sensors and _is_found(mosaic, s.name)
    ]
    cause = _Cause()
    places = None
    limit = math.inf
    if len(master) >= 3:
        places = misfit(rig, mosaic, master, temperatures_c, prior_sigmas=settings.prior_sigmas)
        limit = float(chdtri(2, settings.family_alpha / len(master)))
        cause = _cause(rig, mosaic, places, temperatures_c, settings, limit)
    degrees_of_freedom = 0 if places is None else len(places.y)
    hypotheses = cause.hypotheses
    explanation = cause.displaced or cause.insignificant_displacement
    fits = [
        h.sensor
        for h in hypotheses[1:]
        if hypotheses[0].statistic - h.statistic < 2.0 * math.log(settings.odds_limit)
    ]
    several_displaced = bool(
        explanation
        and cause.degrees_of_freedom > 0
        and cause.remainder > chdtri(cause.degrees_of_freedom, settings.family_alpha)
    )
    return Validity(
        observability=_observability(rig, mosaic),
        residuals=_residuals(rig, mosaic, master, temperatures_c, settings),
        global_statistic=0.0 if places is None else places.statistic,
        global_degrees_of_freedom=degrees_of_freedom,
        global_limit=float(chdtri(degrees_of_freedom, settings.family_alpha))
        if degrees_of_freedom
        else 0.0,
        hypotheses=hypotheses,
        limit=limit,
        displaced=cause.displaced,
        alternatives=tuple(fits) if explanation else (),
        several_displaced=several_displaced,
        relative=_relative(rig, mosaic, temperatures_c, settings),
        probe_bias=cause.probe_bias,
        insignificant_displacement=cause.insignificant_displacement,
    )


@dataclass(frozen=True)
class _Cause:
    """Named causes, best hypothesis first; the remaining chi-square and its degrees of freedom."""

    hypotheses: tuple[Displacement, ...] = ()
    displaced: Displacement | None = None
    insignificant_displacement: Displacement | None = None
    probe_bias: ProbeBias | None = None
    remainder: float = 0.0
    degrees_of_freedom: int = 0


def _cause(
    rig: Rig,
    mosaic: Mosaic,
    places: Misfit,
    temperatures_c: Mapping[str, float],
    settings: ValiditySettings,
    limit: float,
) -> _Cause:
    """A sensor that moved or a probe that misreads: which explains the misfit.

    The sensors' places show that something is wrong. Their scales identify the cause: a
    wrong temperature grows the cone and its sensors by the drift coefficients, a slip does not.
    """
    hypotheses = _hypotheses(places)
    best = hypotheses[0]
    remainder, degrees_of_freedom = places.statistic - best.statistic, len(places.y) - 2
    is_undisplaced = _Cause(hypotheses, remainder=remainder, degrees_of_freedom=degrees_of_freedom)
    if best.statistic <= limit:
        return is_undisplaced
    near = 2.0 * math.log(settings.odds_limit)
    likely = [h.sensor for h in hypotheses if best.statistic - h.statistic < near]
    counts = pan_points(rig, mosaic)
    if any(counts[sensor] < MIN_PAN_POINTS for sensor in likely):
        # A place that hardly any points determine explains the misfit as well.
        return replace(is_undisplaced, insignificant_displacement=best)
    displacement = replace(is_undisplaced, displaced=best)
    names = [s.name for s in places.sensors]
    scaled = all(f"{name}.scale" not in mosaic.undetermined for name in names)
    wide = misfit(
        rig,
        mosaic,
        names,
        temperatures_c,
        quantities=POSITION_AND_SCALE if scaled else POSITION,
        prior_sigmas=settings.prior_sigmas,
    )
    read = [p for p in dict.fromkeys(s.probe for s in wide.sensors) if p in temperatures_c]
    if not read:
        return displacement
    probe_bias = max((_misread(wide, probe) for probe in read), key=lambda m: m.statistic)
    lead = probe_bias.statistic - _hypotheses(wide)[0].statistic
    if lead < -near:
        return displacement
    with_free_cause = wide.with_free_cause(wide.probe_bias(probe_bias.probe))
    still = _hypotheses(with_free_cause)
    if still[0].statistic > limit:
        # However wrong the probe may be, a sensor has moved, too.
        left = with_free_cause.statistic - still[0].statistic
        return _Cause(
            still, still[0], remainder=left, degrees_of_freedom=len(with_free_cause.y) - 3
        )
    return replace(displacement if lead <= near else is_undisplaced, probe_bias=probe_bias)


def _hypotheses(found: Misfit) -> tuple[Displacement, ...]:
    """Each sensor, if it alone had moved; the likeliest first."""
    result = []
    for i, sensor in enumerate(found.sensors):
        fit = found.fit(found.displacement(i))
        result.append(
            Displacement(
                sensor=sensor.name,
                dx_px=float(fit.size[0]),
                dy_px=float(fit.size[1]),
                sigma_x_px=math.sqrt(float(fit.cofactor[0, 0])),
                sigma_y_px=math.sqrt(float(fit.cofactor[1, 1])),
                statistic=fit.statistic,
            )
        )
    return tuple(sorted(result, key=lambda h: -h.statistic))


def _misread(found: Misfit, probe: str) -> ProbeBias:
    fit = found.fit(found.probe_bias(probe))
    sigma_k = math.sqrt(float(fit.cofactor[0, 0]))
    return ProbeBias(probe, float(fit.size[0]), sigma_k, fit.statistic)


def pan_points(rig: Rig, mosaic: Mosaic) -> dict[str, int]:
    """P/P points in use.

    Args:
        rig: the camera.
        mosaic: the adjustment.

    Returns:
        Number of points by PAN sensor, zero where it has none.
    """
    counts = {s.name: 0 for cone in rig.pan_cones for s in cone.sensors}
    for (a, b), used in mosaic.used.items():
        if a in counts and b in counts:
            counts[a] += used
            counts[b] += used
    return counts


def robust_datum(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    tie_points: TiePoints,
    mosaic: Mosaic,
    validity: Validity,
    *,
    settings: MosaicSettings | None = None,
) -> Mosaic:
    """The mosaic in the datum of the master sensors that are still in place.

    The inner geometry is the same; what changes is the datum, which a displaced sensor pulls by a
    quarter of its displacement. Where another sensor may be the one that moved, the datum rests on
    neither, if two are left to carry it.

    Args:
        rig: the camera.
        placements: the start of the mosaic.
        tie_points: those the mosaic is of.
        mosaic: with all master sensors in its datum.
        validity: its test.
        settings: of the adjustment; None takes the defaults.

    Returns:
        The mosaic; `mosaic` itself without a displaced sensor.

    Source: docs/explanation/mathematics/mosaicking.md#robust-datum.
    """
    if validity.displaced is None:
        return mosaic
    candidates = (validity.displaced.sensor, *validity.alternatives)
    if len(set(mosaic.datum_sensors) - set(candidates)) < 2:
        candidates = candidates[:1]
    return free_mosaic(
        rig,
        placements,
        tie_points,
        settings=settings,
        excluded_datum_sensors=candidates,
        begin=mosaic,
    )


def _is_found(mosaic: Mosaic, sensor: str) -> bool:
    return f"{sensor}.x" not in mosaic.undetermined and f"{sensor}.y" not in mosaic.undetermined


def _observability(rig: Rig, mosaic: Mosaic) -> dict[str, Observability]:
    result: dict[str, Observability] = {}
    for cone in rig.pan_cones:
        names = [s.name for s in cone.sensors if s.name in mosaic.model.sensors]
        seen = sum(_is_found(mosaic, name) for name in names)
        if cone.name == rig.master_cone and seen >= 4:
            result[cone.name] = "named"
        elif seen >= (3 if cone.name == rig.master_cone else 2):
            result[cone.name] = "relative"
        else:
            result[cone.name] = "unobservable"
    return result


def _residuals(
    rig: Rig,
    mosaic: Mosaic,
    sensors: Sequence[str],
    temperatures_c: Mapping[str, float],
    settings: ValiditySettings,
) -> tuple[Residual, ...]:
    if not sensors:
        return ()
    found, stitching = found_quantities(mosaic, sensors)
    prior = expected_covariance(
        rig, mosaic, sensors, temperatures_c, prior_sigmas=settings.prior_sigmas
    )
    datum = [name for name in mosaic.datum_sensors if name in sensors]
    if len(datum) >= 2:
        places = [mosaic.start[name].similarity for name in sensors]
        directions = similarity_directions(
            [(p.x_mm, p.y_mm) for p in places], mosaic.model.pitch_mm
        )
        rows = np.zeros((4, len(found)))
        for k, constraint in enumerate(datum_constraints(mosaic.start, datum)):
            for name, coefficient in constraint.coefficients.items():
                sensor, what = name.rsplit(".", 1)
                rows[k, 2 * sensors.index(sensor) + (what == "y")] = coefficient
        into_datum = np.eye(len(found)) - directions @ np.linalg.inv(rows @ directions) @ rows
        prior = into_datum @ prior @ into_datum.T
    sigma = np.sqrt(np.maximum(np.diag(stitching + prior), 0.0))
    return tuple(
        Residual(
            sensor=name,
            dx_px=float(found[2 * i]),
            dy_px=float(found[2 * i + 1]),
            sigma_x_px=float(sigma[2 * i]),
            sigma_y_px=float(sigma[2 * i + 1]),
        )
        for i, name in enumerate(sensors)
    )


def _relative(
    rig: Rig, mosaic: Mosaic, temperatures_c: Mapping[str, float], settings: ValiditySettings
) -> tuple[RelativeDisplacement, ...]:
    pairs = []
    for cone in rig.pan_cones:
        if cone.name != rig.master_cone and len(cone.sensors) >= 2:
            seen = [s.name for s in cone.sensors if _is_found(mosaic, s.name)]
            seen = [name for name in seen if name in mosaic.model.sensors]
            pairs += [(cone.name, a, b) for a, b in itertools.combinations(seen, 2)]
    result = []
    difference = np.hstack([np.eye(2), -np.eye(2)])
    for cone_name, a, b in pairs:
        found, stitching = found_quantities(mosaic, (a, b))
        prior = expected_covariance(
            rig, mosaic, (a, b), temperatures_c, prior_sigmas=settings.prior_sigmas
        )
        delta = difference @ found
        covariance = difference @ (stitching + prior) @ difference.T
        result.append(
            RelativeDisplacement(
                cone=cone_name,
                sensor_a=a,
                sensor_b=b,
                dx_px=float(delta[0]),
                dy_px=float(delta[1]),
                sigma_x_px=math.sqrt(float(covariance[0, 0])),
                sigma_y_px=math.sqrt(float(covariance[1, 1])),
                statistic=float(delta @ np.linalg.inv(covariance) @ delta),
                limit=float(chdtri(2, settings.family_alpha / len(pairs))),
            )
        )
    return tuple(result)

"""Sensors displaced in flight, detected from the stitching of many exposures.

One exposure sees a displacement of a few hundredths of a pixel through its own noise; a flight of
them sees when it began, and what calibration does not know drops out of the difference. The single
exposure is evaluated in `processing.mosaic.validity`.

Model, cone by cone, of contrasts y of the sensors' places that no shift, scale or rotation of the
whole cone can change: y_t = b + k dC_t + steps + noise. b is what calibration leaves, k what drift
coefficients leave, both with the rig file's sigmas; the noise is the adjustment's and the probe's.
The sensors' scales distinguish a displaced sensor from a biased probe.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from processing.mosaic.flight_series import (
    ConeContrasts,
    ContrastSeries,
    contrasts_of,
    is_master,
    probe_bias_series,
    series_of,
    variance_factor,
    with_probe_ignored,
)
from processing.mosaic.misfit import POSITION_AND_SCALE, ProbeBias
from processing.mosaic.stitch_record import StitchRecord
from processing.rig import Cone, Rig

Array = NDArray[np.float64]
Kind = Literal["named", "several", "relative", "misread"]


@dataclass(frozen=True)
class FlightSettings:
    """What is assumed and demanded.

    `family_alpha` is the probability of reporting any step in a healthy flight, all cones and
    exposures together. A step needs `min_exposures` on either side of it, for one
    exposure may be wrong. Sensors, probes and exposures within `odds_limit` of the best are
    alternatives. The sigma of a biased probe is `unknown_sigma_k`.
    """

    family_alpha: float = 0.001
    odds_limit: float = 19.0
    probe_sigma_k: float = 0.1
    unknown_sigma_k: float = 10.0
    min_exposures: int = 3
    max_displacements: int = 4
    outlier_alpha: float = 1e-4
    neighbours: int = 3


@dataclass(frozen=True)
class FlightDisplacement:
    """A sensor that has been displaced since an exposure, (x right, y up), PAN px.

    "named": it is `sensor`, unless one of `alternatives`. "several": more than one sensor of the
    cone moved, and which is not determinable; dx, dy are of the one that fits best. "relative": of
    two sensors, `sensor` has moved against `alternatives[0]`, or that against this. "misread": the
    probe of `probe_bias` reads wrong, by that on average (`sensor` is empty, dx and dy are of the
    one that fits best); with the other kinds, `probe_bias` is a probe that explains it nearly as
    well, None if none does.
    `since` is the first exposure with it, between `earliest` and `latest`; `from_start`
    is true where all of the flight has it. `sigma_px` is that of the length.
    """

    cone: str
    kind: Kind
    sensor: str
    alternatives: tuple[str, ...]
    since: int
    earliest: int
    latest: int
    from_start: bool
    dx_px: float
    dy_px: float
    sigma_px: float
    statistic: float
    limit: float
    probe_bias: ProbeBias | None = None

    @property
    def length_px(self) -> float:
        """Length of the displacement, PAN px."""
        return math.hypot(self.dx_px, self.dy_px)

    @property
    def sentence(self) -> str:
        """The finding in one sentence."""
        size = f"{self.length_px:.2f} +- {self.sigma_px:.2f} px"
        since = f"since exposure {self.since}"
        if self.from_start:
            since = f"since before exposure {self.since}"
        elif self.earliest != self.latest:
            since += f" (it began between {self.earliest} and {self.latest})"
        probe = ""
        if self.probe_bias is not None:
            way = "high" if self.probe_bias.bias_k > 0.0 else "low"
            off = f"{abs(self.probe_bias.bias_k):.1f} +- {self.probe_bias.sigma_k:.1f} K too {way}"
            probe = f"probe {self.probe_bias.probe} has read {off}"
        if self.kind == "misread":
            earlier = "" if self.from_start else " or earlier"
            return f"P{probe[1:]} on average since exposure {self.since}{earlier}; check it."
        if self.kind == "relative":
            cause_text = f"or {probe}; what it was" if probe else "which of them moved"
            return (
                f"{self.sensor} and {self.alternatives[0]} have been displaced against each other "
                f"by {size} {since}{', ' if probe else '; '}{cause_text} cannot be determined."
            )
        if self.kind == "several":
            return (
                f"More than one sensor of cone {self.cone} has been displaced {since}; which ones "
                "cannot be determined from the stitching."
            )
        others = [*self.alternatives, *([f"that {probe}"] if probe else [])]
        unless = f", unless it is {' or '.join(others)}" if others else ""
        return f"{self.sensor} has been displaced by {size} {since}{unless}."


@dataclass(frozen=True)
class FlightValidity:
    """The verdict on a flight; `exposures` counts those used, by cone."""

    steps: tuple[FlightDisplacement, ...]
    exposures: Mapping[str, int]
    left_out: Mapping[str, tuple[int, ...]]


def evaluate_flight(
    rig: Rig,
    records: Mapping[int, StitchRecord],
    *,
    settings: FlightSettings | None = None,
) -> FlightValidity:
    """Look for sensors that moved, in the stitching records of a flight.

    The master cone's single displaced sensor is named; in cones of two only the relative
    displacement is seen, in cones of one nothing.

    Args:
        rig: the camera, as calibrated.
        records: by number of the exposure; those of other calibrations are skipped.
        settings: None takes the defaults.

    Returns:
        Displacements cone by cone, the exposures used and those left out as outliers.

    Source: docs/explanation/mathematics/validity.md#over-a-flight.
    """
    settings = settings or FlightSettings()
    evaluated = [c for c in rig.pan_cones if len(c.sensors) >= (3 if is_master(rig, c) else 2)]
    steps: list[FlightDisplacement] = []
    used, left_out = {}, {}
    for cone in evaluated:
        view = contrasts_of(rig, cone)
        series, dropped = _without_outliers(series_of(rig, view, records), settings)
        used[cone.name], left_out[cone.name] = len(series.numbers), dropped
        if len(series.numbers) >= 2 * settings.min_exposures:
            wide = view
            if is_master(rig, cone):
                wide = contrasts_of(rig, cone, quantities=POSITION_AND_SCALE)
            retained = {number: records[number] for number in series.numbers}
            both = (view, series), (wide, series_of(rig, wide, retained))
            steps += _steps(rig, cone, both, settings, len(evaluated))
    return FlightValidity(tuple(steps), used, left_out)


def _without_outliers(
    series: ContrastSeries, settings: FlightSettings
) -> tuple[ContrastSeries, tuple[int, ...]]:
    """Leave out exposures that agree with neither their neighbours before nor those after."""
    count, size = series.y.shape
    limit = float(chdtri(size, settings.outlier_alpha))
    factor = variance_factor(series)
    good = np.ones(count, np.bool_)
    reach = settings.neighbours
    for t in range(count):
        sides = [series.y[max(0, t - reach) : t], series.y[t + 1 : t + 1 + reach]]
        distances = []
        for side in sides:
            if len(side) >= 2:
                off = series.y[t] - np.median(side, axis=0)
                spread = series.covariance[t] * factor * (1.0 + math.pi / 2.0 / len(side))
                distances.append(float(off @ np.linalg.solve(spread, off)))
        good[t] = not distances or min(distances) <= limit
    dropped = tuple(n for n, is_good in zip(series.numbers, good, strict=True) if not is_good)
    retained = tuple(n for n, is_good in zip(series.numbers, good, strict=True) if is_good)
    return (
        ContrastSeries(retained, series.y[good], series.covariance[good], series.dc_k[good]),
        dropped,
    )


def _steps(
    rig: Rig,
    cone: Cone,
    views: tuple[tuple[ConeContrasts, ContrastSeries], tuple[ConeContrasts, ContrastSeries]],
    settings: FlightSettings,
    cones: int,
) -> list[FlightDisplacement]:
    """Steps one after the other, each with those before it taken out, in order of strength.

    The first view detects them, the second estimates them. After a biased probe is found, the rest
    of the flight is evaluated without it: a stuck probe causes no single step.
    """
    (view, series), wide = ((v, replace(s, factor=variance_factor(s))) for v, s in views)
    count, size = series.y.shape
    limit = float(chdtri(size, settings.family_alpha / count / cones))
    reach = settings.min_exposures
    places = np.array([0, *range(reach, count - reach + 1)])
    found: list[FlightDisplacement] = []
    probe_bias: list[FlightDisplacement] = []
    taken: list[int] = []
    is_ambiguous: set[str] = set()
    while len(found) < settings.max_displacements:
        information, right = _scan(view, series, settings, taken)
        statistics = np.full(count, -np.inf)
        for t in places:
            if t not in taken:
                statistics[t] = right[t] @ np.linalg.solve(information[t], right[t])
        best = int(np.argmax(statistics))
        if statistics[best] <= limit:
            break
        normal = information[best], right[best]
        weighed = normal
        if wide[0] is not view:
            known, normal_vector = _scan(*wide, settings, taken)
            weighed = known[best], normal_vector[best]
        taken.append(best)
        near = np.flatnonzero(statistics > statistics[best] - 2.0 * math.log(settings.odds_limit))
        step = _step(
            cone,
            (view, normal),
            (wide[0], weighed),
            (float(statistics[best]), limit),
            [series.numbers[t] for t in (best, near.min(), near.max())],
            settings,
            from_start=best == 0,
            relative=not is_master(rig, cone),
        )
        probe = step.probe_bias.probe if step.probe_bias else ""
        if step.kind == "misread" and probe not in is_ambiguous:
            is_ambiguous.add(probe)
            bias_k = probe_bias_series(*wide, probe)
            unknown = settings.unknown_sigma_k
            series = with_probe_ignored(view, series, probe, bias_k=bias_k, sigma_k=unknown)
            is_trusted = with_probe_ignored(*wide, probe, bias_k=bias_k, sigma_k=unknown)
            wide = wide[0], is_trusted
            probe_bias, found, taken = [*probe_bias, step], [], []
        else:
            found.append(step)
    return sorted(probe_bias + found, key=lambda step: step.since)


def _scan(
    view: ConeContrasts,
    series: ContrastSeries,
    settings: FlightSettings,
    taken: Sequence[int],
) -> tuple[Array, Array]:
    """Information (t, c, c) and right-hand side (t, c) of a step at each exposure.

    Everything else (calibration, drift, steps taken) is eliminated.
    """
    count, size = series.y.shape
    thermal_design = np.array(list(view.thermal_design.values()))
    probe = thermal_design.T @ thermal_design * settings.probe_sigma_k**2
    weight = np.linalg.inv((series.covariance + probe) * series.factor)
    known = [covariance + 1e-12 * np.eye(size) for covariance in (view.place, view.drift)]
    # Columns of the nuisance: offset, drift by dC, and the steps already taken.
    after = [(np.arange(count) >= t).astype(np.float64) for t in taken]
    design = np.stack([np.ones(count), series.dc_k, *after])
    unknowns = len(design) * size
    normal = np.einsum("at,bt,tij->aibj", design, design, weight).reshape(unknowns, unknowns)
    for k, covariance in enumerate((known[0] + probe, known[1])):
        part = slice(k * size, (k + 1) * size)
        normal[part, part] += np.linalg.inv(covariance)
    weighted = np.einsum("tij,tj->ti", weight, series.y)
    target = np.einsum("at,ti->ai", design, weighted).ravel()
    own = np.cumsum(weight[::-1], axis=0)[::-1]
    mixed = np.cumsum(np.einsum("at,tij->taij", design, weight)[::-1], axis=0)[::-1]
    mixed = mixed.reshape(count, unknowns, size)
    eliminated = np.linalg.solve(
        normal,
        np.concatenate([mixed, np.broadcast_to(target[:, None], (count, unknowns, 1))], axis=2),
    )
    crossed = np.einsum("tui,tuj->tij", mixed, eliminated)
    information = own - crossed[:, :, :size]
    right = np.cumsum(weighted[::-1], axis=0)[::-1] - crossed[:, :, size]
    return information + 1e-12 * np.eye(size), right


_Normal = tuple[Array, Array]
"""Information (c, c) and right-hand side (c,) of a step."""


def _step(
    cone: Cone,
    narrow: tuple[ConeContrasts, _Normal],
    wide: tuple[ConeContrasts, _Normal],
    test: tuple[float, float],
    numbers: Sequence[int],
    settings: FlightSettings,
    *,
    from_start: bool,
    relative: bool,
) -> FlightDisplacement:
    odds_limit = 2.0 * math.log(settings.odds_limit)
    fits = _moved(*narrow)
    kind: Kind = "relative" if relative else "named"
    probe_bias = max(
        (_misread(*wide, probe) for probe in wide[0].thermal_design), key=lambda m: m.statistic
    )
    lead = probe_bias.statistic - _moved(*wide)[0][0]
    freedom = len(narrow[1][1]) - 2
    if not relative and lead >= -odds_limit:
        # Sensors that have moved as well are searched again without the probe.
        with_free_probe = _moved(wide[0], _with_free_probe(*wide, probe_bias.probe))
        displacement = with_free_probe[0][0] > chdtri(
            2, settings.family_alpha / len(with_free_probe)
        )
        if lead > odds_limit or displacement:
            kind = "misread"
    statistic, name, delta, cofactor = fits[0]
    several = freedom > 0 and test[0] - statistic > chdtri(freedom, settings.family_alpha)
    if kind == "named" and several:
        kind = "several"
    near = [f[1] for f in fits[1:] if statistic - f[0] < odds_limit]
    length = max(float(np.hypot(*delta)), 1e-12)
    sigma = math.sqrt(float(delta @ cofactor @ delta)) / length
    return FlightDisplacement(
        cone=cone.name,
        kind=kind,
        sensor="" if kind == "misread" else name,
        alternatives=() if kind == "misread" else tuple(near),
        since=numbers[0],
        earliest=numbers[1],
        latest=numbers[2],
        from_start=from_start,
        dx_px=float(delta[0]),
        dy_px=float(delta[1]),
        sigma_px=sigma,
        statistic=test[0],
        limit=test[1],
        probe_bias=probe_bias if lead >= -odds_limit else None,
    )


def _moved(view: ConeContrasts, normal: _Normal) -> list[tuple[float, str, Array, Array]]:
    """Each sensor, if it alone had moved: chi-square, name, displacement and its cofactor."""
    information, right = normal
    fits = []
    for i, sensor in enumerate(view.sensors):
        design = view.displacement[:, 2 * i : 2 * i + 2]
        cofactor = np.asarray(np.linalg.inv(design.T @ information @ design), np.float64)
        delta = cofactor @ design.T @ right
        fits.append((float(delta @ design.T @ right), sensor.name, delta, cofactor))
    return sorted(fits, key=lambda fit: -fit[0])


def _misread(view: ConeContrasts, normal: _Normal, probe: str) -> ProbeBias:
    information, right = normal
    design = -view.thermal_design[probe]
    known = float(design @ information @ design)
    normal_vector = float(design @ right)
    return ProbeBias(probe, normal_vector / known, 1.0 / math.sqrt(known), normal_vector**2 / known)


def _with_free_probe(view: ConeContrasts, normal: _Normal, probe: str) -> _Normal:
    """The same where the probe may read anything since then."""
    information, right = normal
    design = view.thermal_design[probe]
    taken = information @ design / float(design @ information @ design)
    normal_vector = float(design @ right)
    return information - np.outer(taken, design @ information), right - taken * normal_vector

"""Did a sensor move in flight? What the stitching of many exposures says together (DESIGN 5.4).

One exposure sees a displacement of a few hundredths of a pixel through its own noise; a flight of
them sees when it began, and what calibration does not know drops out of the difference. The single
exposure is judged in `processing.mosaic.validity`.

Model, cone by cone, of contrasts y of the sensors' places that no shift, scale or rotation of the
whole cone can change: y_t = b + k dC_t + steps + noise. b is what calibration leaves, k what drift
coefficients leave, both with the rig file's sigmas; the noise is the adjustment's and the probe's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from processing.mosaic.stitch_record import StitchRecord
from processing.rig import Cone, Rig, Sensor

Array = NDArray[np.float64]
Kind = Literal["named", "several", "relative"]


@dataclass(frozen=True)
class FlightSettings:
    """What is assumed and demanded.

    `family_alpha` is the probability of telling of any step in a healthy flight, all cones and
    exposures together. A step is told from `least_exposures` on either side of it, for one
    exposure may be wrong. Sensors and exposures within `odds` of the best are alternatives to it.
    """

    family_alpha: float = 0.001
    odds: float = 19.0
    probe_sigma_k: float = 0.1
    least_exposures: int = 3
    most_steps: int = 4
    outlier_alpha: float = 1e-4
    neighbours: int = 3


@dataclass(frozen=True)
class Step:
    """A sensor that has been displaced since an exposure, (x right, y up), PAN px.

    "named": it is `sensor`, unless one of `alternatives`. "several": more than one sensor of the
    cone moved, and which cannot be told; dx, dy are of the one that fits best. "relative": of two
    sensors, `sensor` has moved against `alternatives[0]`, or that against this.
    `since` is the first exposure with it, between `earliest` and `latest`; `from_start` says that
    all of the flight has it. `sigma_px` is that of the length.
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

    @property
    def length_px(self) -> float:
        return math.hypot(self.dx_px, self.dy_px)

    @property
    def sentence(self) -> str:
        """For a person who has just landed."""
        size = f"{self.length_px:.2f} +- {self.sigma_px:.2f} px"
        since = f"since exposure {self.since}"
        if self.from_start:
            since = f"since before exposure {self.since}"
        elif self.earliest != self.latest:
            since += f" (it began between {self.earliest} and {self.latest})"
        if self.kind == "relative":
            return (
                f"{self.sensor} and {self.alternatives[0]} have been displaced against each other "
                f"by {size} {since}; which of them moved cannot be told."
            )
        if self.kind == "several":
            return (
                f"More than one sensor of cone {self.cone} has been displaced {since}; which ones "
                "cannot be told from the stitching."
            )
        unless = f", unless it is {' or '.join(self.alternatives)}" if self.alternatives else ""
        return f"{self.sensor} has been displaced by {size} {since}{unless}."


@dataclass(frozen=True)
class FlightValidity:
    """The judgement on a flight; `exposures` counts those used, by cone."""

    steps: tuple[Step, ...]
    exposures: Mapping[str, int]
    left_out: Mapping[str, tuple[int, ...]]


@dataclass(frozen=True)
class _Series:
    """Contrasts of one cone over a flight: y (t, c), weights (t, c, c), dC (t,)."""

    numbers: tuple[int, ...]
    y: Array
    covariance: Array
    dc_k: Array


def judge_flight(
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
        records: by number of the exposure; those of other calibrations are passed over.
        settings: None takes the defaults.
    """
    settings = settings or FlightSettings()
    judged = [c for c in rig.pan_cones if len(c.sensors) >= (3 if _is_master(rig, c) else 2)]
    steps: list[Step] = []
    used, left_out = {}, {}
    for cone in judged:
        pairs = [cone.sensors] if _is_master(rig, cone) else [cone.sensors[:2]]
        for sensors in pairs:
            series = _series(rig, sensors, records, relative=not _is_master(rig, cone))
            series, dropped = _without_outliers(series, settings)
            used[cone.name], left_out[cone.name] = len(series.numbers), dropped
            if len(series.numbers) >= 2 * settings.least_exposures:
                relative = not _is_master(rig, cone)
                steps += _steps(cone, sensors, series, settings, len(judged), relative=relative)
    return FlightValidity(tuple(steps), used, left_out)


def _is_master(rig: Rig, cone: Cone) -> bool:
    return cone.name == rig.master_cone


def _contrasts(sensors: Sequence[Sensor], *, relative: bool) -> Array:
    if relative:
        return np.hstack([np.eye(2), -np.eye(2)])
    directions = np.zeros((2 * len(sensors), 4))
    for i, sensor in enumerate(sensors):
        directions[2 * i] = (1.0, 0.0, sensor.x_mm, -sensor.y_mm)
        directions[2 * i + 1] = (0.0, 1.0, sensor.y_mm, sensor.x_mm)
    full, _, _ = np.linalg.svd(directions, full_matrices=True)
    return np.asarray(full[:, 4:].T, np.float64)


def _series(
    rig: Rig,
    sensors: Sequence[Sensor],
    records: Mapping[int, StitchRecord],
    *,
    relative: bool,
) -> _Series:
    pitch_um = sensors[0].pitch_um if rig.virtual_image is None else rig.virtual_image.pitch_um
    names = [f"{s.name}.{axis}_um" for s in sensors for axis in "xy"]
    contrasts = _contrasts(sensors, relative=relative) / pitch_um
    numbers, y, covariance, dc = [], [], [], []
    for number in sorted(records):
        record = records[number]
        if record.calibration_id != rig.calibration_id or not set(names) <= set(record.names):
            continue
        at = [record.names.index(name) for name in names]
        numbers.append(number)
        y.append(contrasts @ record.values[at])
        covariance.append(contrasts @ record.covariance[np.ix_(at, at)] @ contrasts.T)
        dc.append(float(np.mean([record.dc_k[s.name] for s in sensors])))
    size = len(contrasts)
    return _Series(
        tuple(numbers),
        np.array(y).reshape(-1, size),
        np.array(covariance).reshape(-1, size, size),
        np.array(dc),
    )


def _without_outliers(series: _Series, settings: FlightSettings) -> tuple[_Series, tuple[int, ...]]:
    """Leave out exposures that agree with neither their neighbours before nor those after."""
    count, size = series.y.shape
    limit = float(chi2.isf(settings.outlier_alpha, size))
    factor = _variance_factor(series)
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
    kept = tuple(n for n, is_good in zip(series.numbers, good, strict=True) if is_good)
    return (
        _Series(kept, series.y[good], series.covariance[good], series.dc_k[good]),
        dropped,
    )


def _variance_factor(series: _Series) -> float:
    """By how much exposures differ more from their neighbours than their covariance says; >= 1."""
    size = series.y.shape[1]
    if len(series.numbers) < 4:
        return 1.0
    off = np.diff(series.y, axis=0)
    spread = series.covariance[1:] + series.covariance[:-1]
    q = np.einsum("ti,ti->t", off, np.linalg.solve(spread, off[..., None])[..., 0])
    return max(1.0, float(np.median(q)) / float(chi2.ppf(0.5, size)))


def _steps(
    cone: Cone,
    sensors: Sequence[Sensor],
    series: _Series,
    settings: FlightSettings,
    cones: int,
    *,
    relative: bool,
) -> list[Step]:
    """Steps one after the other, each with those before it taken out, in order of strength."""
    contrasts = _contrasts(sensors, relative=relative)
    count, size = series.y.shape
    limit = float(chi2.isf(settings.family_alpha / count / cones, size))
    reach = settings.least_exposures
    places = np.array([0, *range(reach, count - reach + 1)])
    found: list[Step] = []
    taken: list[int] = []
    for _ in range(settings.most_steps):
        information, right = _scan(sensors, series, contrasts, settings, taken)
        statistics = np.full(count, -np.inf)
        for t in places:
            if t not in taken:
                statistics[t] = right[t] @ np.linalg.solve(information[t], right[t])
        best = int(np.argmax(statistics))
        if statistics[best] <= limit:
            break
        taken.append(best)
        near = np.flatnonzero(statistics > statistics[best] - 2.0 * math.log(settings.odds))
        found.append(
            _step(
                cone,
                sensors,
                contrasts,
                (information[best], right[best]),
                (float(statistics[best]), limit),
                [series.numbers[t] for t in (best, near.min(), near.max())],
                settings,
                from_start=best == 0,
                relative=relative,
            )
        )
    return sorted(found, key=lambda step: step.since)


def _scan(
    sensors: Sequence[Sensor],
    series: _Series,
    contrasts: Array,
    settings: FlightSettings,
    taken: Sequence[int],
) -> tuple[Array, Array]:
    """Information (t, c, c) and right-hand side (t, c) of a step at each exposure.

    Everything else (calibration, drift, steps taken) is eliminated.
    """
    count, size = series.y.shape
    pitch_um = sensors[0].pitch_um
    moved = np.array([[s.drift.x_um_per_k, s.drift.y_um_per_k] for s in sensors]).ravel()
    per_kelvin = contrasts @ moved / pitch_um
    probe = np.outer(per_kelvin, per_kelvin) * settings.probe_sigma_k**2
    weight = np.linalg.inv((series.covariance + probe) * _variance_factor(series))
    place = np.repeat([s.position_sigma_um**2 for s in sensors], 2)
    drift = np.repeat([s.drift.sigma_um_per_k**2 for s in sensors], 2)
    known = [
        contrasts * variance @ contrasts.T / pitch_um**2 + 1e-12 * np.eye(size)
        for variance in (place, drift)
    ]
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


def _step(
    cone: Cone,
    sensors: Sequence[Sensor],
    contrasts: Array,
    normal: tuple[Array, Array],
    test: tuple[float, float],
    numbers: Sequence[int],
    settings: FlightSettings,
    *,
    from_start: bool,
    relative: bool,
) -> Step:
    information, right = normal
    fits = []
    for i, sensor in enumerate(sensors):
        design = contrasts[:, 2 * i : 2 * i + 2]
        cofactor = np.linalg.inv(design.T @ information @ design)
        delta = cofactor @ design.T @ right
        fits.append((float(delta @ design.T @ right), sensor.name, delta, cofactor))
    fits.sort(key=lambda fit: -fit[0])
    statistic, name, delta, cofactor = fits[0]
    freedom = len(right) - 2
    kind: Kind = "relative" if relative else "named"
    if freedom > 0 and test[0] - statistic > chi2.isf(settings.family_alpha, freedom):
        kind = "several"
    near = [f[1] for f in fits[1:] if statistic - f[0] < 2.0 * math.log(settings.odds)]
    length = max(float(np.hypot(*delta)), 1e-12)
    sigma = math.sqrt(float(delta @ cofactor @ delta)) / length
    return Step(
        cone=cone.name,
        kind=kind,
        sensor=name,
        alternatives=tuple(near),
        since=numbers[0],
        earliest=numbers[1],
        latest=numbers[2],
        from_start=from_start,
        dx_px=float(delta[0]),
        dy_px=float(delta[1]),
        sigma_px=sigma,
        statistic=test[0],
        limit=test[1],
    )

"""Temperature probes over a flight: which of them are valid, and values for the others.

Pure functions on recorded samples; whether a reading may be used in one exposure alone is decided
in `processing.geometry.conditions`, the temperature by stitching in
`processing.mosaic.estimated_dc`.
"""

from __future__ import annotations

import bisect
import enum
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from processing.quality.report import NO_FLAGS, Flag
from processing.rig import Rig


class ProbeState(enum.Enum):
    """State of a probe; the flag it raises is `FLAGS`."""

    GOOD = "good"
    MISSING = "missing"
    OPEN = "open"
    OUT_OF_RANGE = "out of range"
    STUCK = "stuck"
    JUMP = "jump"


FLAGS: Mapping[ProbeState, Flag] = {
    ProbeState.GOOD: NO_FLAGS,
    ProbeState.MISSING: Flag.TEMPERATURE_STALE,
    ProbeState.OPEN: Flag.TEMPERATURE_MISSING,
    ProbeState.OUT_OF_RANGE: Flag.TEMPERATURE_RANGE,
    ProbeState.STUCK: Flag.TEMPERATURE_RANGE,
    ProbeState.JUMP: Flag.TEMPERATURE_RANGE,
}


@dataclass(frozen=True)
class ProbeSample:
    """A reading at an instant of any one clock; None is an open sensor."""

    time_s: float
    value_c: float | None


@dataclass(frozen=True)
class ProbeSettings:
    """What a probe of a camera may do.

    A cone of several kilograms changes by less than `max_rate_k_per_s`; a step beyond that and
    `jump_k` is no temperature. A probe that stays within `stuck_k` over `stuck_s` while the others'
    median moves by `others_moved_k` is stuck. `sigma_k` is a good probe's standard deviation. A
    bridge without any history of the probe is worth `unknown_sigma_k`; each minute since the last
    good reading adds `sigma_k_per_minute`.
    """

    low_c: float = -40.0
    high_c: float = 70.0
    missing_s: float = 30.0
    max_rate_k_per_s: float = 0.1
    jump_k: float = 2.0
    stuck_s: float = 600.0
    stuck_k: float = 0.05
    others_moved_k: float = 2.0
    sigma_k: float = 0.1
    unknown_sigma_k: float = 2.0
    sigma_k_per_minute: float = 0.05


@dataclass(frozen=True)
class ProbeReading:
    """A probe at an instant: its temperature or what stands in for it, and how sure that is.

    `sources` are the probes, or `stitching`, a bridged value comes from; empty for the probe's own.
    `value_c` is None where nothing can stand in.
    """

    state: ProbeState
    value_c: float | None
    sigma_k: float
    sources: tuple[str, ...] = ()

    @property
    def flag(self) -> Flag:
        """The flag that the probe's state raises."""
        return FLAGS[self.state]


def bridge_by_others(rig: Rig, usable_c: Mapping[str, float]) -> dict[str, float]:
    """Temperatures for the probes of one exposure that have none, from those that have one.

    The camera warms as a whole: a probe without a reading is taken to be as far above its
    calibration temperature as the median of the others.

    Args:
        rig: the camera.
        usable_c: temperatures that can be used, degC, by probe name.

    Returns:
        Temperatures of the other probes, degC; empty where `usable_c` has none of the rig's.
    """
    reference = calibration_temperatures(rig)
    offsets = [usable_c[p] - reference[p] for p in reference if p in usable_c]
    if not offsets:
        return {}
    common = statistics.median(offsets)
    return {p: reference[p] + common for p in reference if p not in usable_c}


def calibration_temperatures(rig: Rig) -> dict[str, float]:
    """Temperature at calibration of every probe.

    Args:
        rig: the camera.

    Returns:
        degC by probe: of the cone it belongs to, else of the first sensor that uses it.
    """
    result = {sensor.probe: sensor.calibration_c for sensor in reversed(rig.sensors)}
    result |= {cone.probe: cone.calibration_c for cone in reversed(rig.cones)}
    return {probe: result[probe] for probe in rig.probes}


def evaluate_probes(
    histories: Mapping[str, Sequence[ProbeSample]],
    at_s: float,
    calibration_c: Mapping[str, float],
    *,
    estimates: Mapping[str, tuple[float, float]] | None = None,
    settings: ProbeSettings | None = None,
) -> dict[str, ProbeReading]:
    """Evaluate every probe at an instant from earlier readings, and bridge the bad ones.

    Args:
        histories: samples by probe, in order of time.
        at_s: the instant, on the clock of the samples.
        calibration_c: temperature at calibration, for every probe wanted.
        estimates: temperature (degC) and its standard deviation (K) by stitching, for probes whose
            cone has an estimate; used for bridging only, weighted with the other probes.
        settings: None takes the defaults.

    Returns:
        State and temperature of every probe of `calibration_c`.
    """
    settings = settings or ProbeSettings()
    past = {
        probe: tuple(s for s in histories.get(probe, ()) if s.time_s <= at_s)
        for probe in calibration_c
    }
    states = {probe: _own_state(samples, at_s, settings) for probe, samples in past.items()}
    trusted = [probe for probe, state in states.items() if state is ProbeState.GOOD]
    # The one that stands still is compared with all others, so that it cannot hide behind itself.
    stuck = [p for p in trusted if _is_stuck(p, trusted, past, at_s, settings)]
    for probe in stuck:
        states[probe] = ProbeState.STUCK
    trusted = [probe for probe in trusted if probe not in stuck]
    result = {}
    for probe, state in states.items():
        if state is ProbeState.GOOD:
            value = past[probe][-1].value_c
            result[probe] = ProbeReading(state, value, settings.sigma_k)
        else:
            by_stitching = (estimates or {}).get(probe)
            result[probe] = _bridge(
                probe, state, trusted, past, at_s, calibration_c, by_stitching, settings
            )
    return result


def _own_state(samples: Sequence[ProbeSample], at_s: float, settings: ProbeSettings) -> ProbeState:
    """State of a probe by its own readings."""
    if not samples or at_s - samples[-1].time_s > settings.missing_s:
        return ProbeState.MISSING
    last = samples[-1].value_c
    if last is None or not math.isfinite(last):
        return ProbeState.OPEN
    if not settings.low_c <= last <= settings.high_c:
        return ProbeState.OUT_OF_RANGE
    plausible = _plausible_readings(samples, settings)
    return ProbeState.GOOD if plausible and plausible[-1] is samples[-1] else ProbeState.JUMP


def _plausible_readings(
    samples: Sequence[ProbeSample], settings: ProbeSettings
) -> list[ProbeSample]:
    """Readings that can follow each other; what jumps away is left out until it comes back.

    What is possible counts from reading to reading: a probe that stays away does not become
    valid by staying long.
    """
    plausible_samples: list[ProbeSample] = []
    before_s = -math.inf
    for sample in samples:
        value = sample.value_c
        if value is None or not settings.low_c <= value <= settings.high_c:
            continue
        if plausible_samples:
            last = plausible_samples[-1].value_c
            assert last is not None
            possible = settings.max_rate_k_per_s * (sample.time_s - before_s)
            before_s = sample.time_s
            if abs(value - last) > max(settings.jump_k, possible):
                continue
        before_s = sample.time_s
        plausible_samples.append(sample)
    return plausible_samples


def _before_stuck(samples: Sequence[ProbeSample], settings: ProbeSettings) -> list[ProbeSample]:
    values = [s.value_c for s in samples if s.value_c is not None]
    k = len(samples)
    while k and abs(values[k - 1] - values[-1]) <= settings.stuck_k:
        k -= 1
    return list(samples[:k])


def _is_stuck(
    probe: str,
    trusted: Sequence[str],
    past: Mapping[str, Sequence[ProbeSample]],
    at_s: float,
    settings: ProbeSettings,
) -> bool:
    since_s = at_s - settings.stuck_s
    own = [s.value_c for s in past[probe] if s.time_s >= since_s and s.value_c is not None]
    if past[probe][0].time_s > since_s or len(own) < 3 or max(own) - min(own) > settings.stuck_k:
        return False
    moves = []
    for other in trusted:
        if other != probe:
            then, now = _at(past[other], since_s), _at(past[other], at_s)
            if then is not None and now is not None:
                moves.append(now - then)
    return len(moves) >= 2 and abs(statistics.median(moves)) > settings.others_moved_k


def _bridge(
    probe: str,
    state: ProbeState,
    trusted: Sequence[str],
    past: Mapping[str, Sequence[ProbeSample]],
    at_s: float,
    calibration_c: Mapping[str, float],
    by_stitching: tuple[float, float] | None,
    settings: ProbeSettings,
) -> ProbeReading:
    """Where the others stand, by the distance this probe kept from them while it was good."""
    parts: list[tuple[float, float]] = []
    sources: list[str] = []
    now = [_above(past[p], at_s, calibration_c[p]) for p in trusted]
    known = [k for k in now if k is not None]
    if known:
        good = _plausible_readings(past[probe], settings)
        if state is ProbeState.STUCK:
            good = _before_stuck(good, settings)
        good = good[-60:]
        distances = []
        for sample in good:
            others = [_above(past[p], sample.time_s, calibration_c[p]) for p in trusted]
            there = [k for k in others if k is not None]
            if there and sample.value_c is not None:
                own = sample.value_c - calibration_c[probe]
                distances.append(own - statistics.median(there))
        distance, sigma = 0.0, settings.unknown_sigma_k
        if distances:
            distance = statistics.median(distances)
            minutes = (at_s - good[-1].time_s) / 60.0
            spread = statistics.pstdev(distances) + settings.sigma_k_per_minute * minutes
            sigma = min(settings.unknown_sigma_k, math.hypot(2.0 * settings.sigma_k, spread))
        parts.append((calibration_c[probe] + statistics.median(known) + distance, sigma))
        sources += trusted
    if by_stitching is not None:
        parts.append(by_stitching)
        sources.append("stitching")
    if not parts:
        return ProbeReading(state, None, math.inf)
    weight = sum(1.0 / s**2 for _, s in parts)
    value = sum(v / s**2 for v, s in parts) / weight
    return ProbeReading(state, value, 1.0 / math.sqrt(weight), tuple(sources))


def _above(samples: Sequence[ProbeSample], time_s: float, calibration_c: float) -> float | None:
    value = _at(samples, time_s)
    return None if value is None else value - calibration_c


def _at(samples: Sequence[ProbeSample], time_s: float) -> float | None:
    """The last reading at an instant, None where there was none or it was open."""
    index = bisect.bisect_right(samples, time_s, key=lambda s: s.time_s)
    return samples[index - 1].value_c if index else None

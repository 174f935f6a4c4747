"""Timestamps say how good they are: 95 +- 2.5 % of errors lie inside two stated sigmas.

A thousand independent hosts, each with a crystal, interrupts and round trips of its own
(`tests.daemon.time_truth`); every time is made by the service's own pieces from what hardware would
say. Truth and estimator share no code and no numbers but those a data sheet gives.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from daemon.clock import HostClock
from daemon.exposure import Capture, FrameRecord
from daemon.flight import compose, instant_of
from daemon.matching import Pulse
from daemon.navigation import Track
from daemon.temperatures import Temperatures
from drivers.contract import EventMark
from processing.quality import Flag
from processing.rig import find_rig
from tests.daemon.time_truth import Fired, Host, delay_error_ns, inside, receiver_stamp

RUNS = 1000
WARM_S = 60
COAST_S = 60
INTERVAL_S = 2.7
EPOCH_NS = 1_400_000_000_000_000_000
PPS_LATENCY_NS, PPS_SIGMA_NS = 4_000, 3_000
ACCURACY_NS, RESOLUTION_NS = 25.0, 1.0
SPREAD_NS, HEAD_NS = 700, 1_500
EXPOSURE_US = 4000.0
SETS = (
    "pulse per second, mark lost",
    "marks only, its own mark",
    "marks only, mark lost",
    "60 s after the last edge and mark",
    "60 s after the last mark",
)
_RIG = find_rig("ultracam-x-mini")
RIG = replace(
    _RIG,
    cones=tuple(replace(cone, mark_to_mid_exposure_sigma_ns=HEAD_NS) for cone in _RIG.cones),
)
DELAYS_NS = {cone.name: 900_000 * index for index, cone in enumerate(RIG.cones)}
STROBE_NS = DELAYS_NS[RIG.reference_cone] + 2_000_000
FAR_SENSOR = next(
    sensor.name for sensor in RIG.sensors if RIG.cone_of(sensor.name).name != RIG.reference_cone
)


@dataclass(frozen=True)
class Stamp:
    """The error of a frame's time, and the sigma that was stated with it."""

    error_ns: float
    sigma_ns: float


def pulse_of(fired: Fired) -> Pulse:
    middle_ns = (fired.before_ns + fired.after_ns) // 2
    half_ns = (fired.after_ns - fired.before_ns + 1) // 2
    return Pulse(1, middle_ns, half_ns, 1, DELAYS_NS, STROBE_NS, SPREAD_NS)


def mark_of(chance: np.random.Generator, fired: Fired) -> EventMark:
    strobe_s = fired.true_s + STROBE_NS * 1e-9
    said_ns = receiver_stamp(chance, strobe_s, ACCURACY_NS, RESOLUTION_NS)
    return EventMark("gnss", 0, EPOCH_NS + said_ns, round(ACCURACY_NS), 0, 0, True, 0)


def stamp(
    chance: np.random.Generator, clock: HostClock, fired: Fired, mark: EventMark | None
) -> Stamp:
    """A frame's time as the service records it, against when it was truly exposed."""
    pulse = pulse_of(fired)
    frame = FrameRecord(FAR_SENSOR, "", "", "", 1, 1, "Mono12", None, None, EXPOSURE_US, None, 0)
    record = compose(
        RIG,
        Capture(1, frames=(frame,)),
        pulse,
        instant_of(mark, pulse, clock),
        Track(),
        Temperatures({}),
        Flag(0),
    )
    (timed,) = record.frames
    assert timed.mid_exposure_gps_ns is not None and timed.time_sigma_ns is not None
    delay_ns = DELAYS_NS[RIG.cone_of(FAR_SENSOR).name] + 2_000_000
    true_ns = fired.true_s * 1e9 + delay_ns
    true_ns += delay_error_ns(chance, SPREAD_NS) + chance.normal(0.0, HEAD_NS)
    return Stamp(timed.mid_exposure_gps_ns - EPOCH_NS - true_ns, timed.time_sigma_ns)


def one_host(seed: int) -> list[Stamp]:
    """One stamp for each of SETS."""
    chance = np.random.default_rng([20261121, seed])
    host = Host(chance, WARM_S + COAST_S + 10.0)
    with_pps, marks_only = HostClock(), HostClock()
    for k in range(3):
        arrived_ns = round(host.clock.reads(0.2 * k + 0.06))
        for clock in (with_pps, marks_only):
            clock.message_arrived(EPOCH_NS + 200_000_000 * k, arrived_ns)
    for second in range(1, WARM_S):
        with_pps.pps_edge(host.edge(float(second)) - PPS_LATENCY_NS, PPS_SIGMA_NS)
    at_s = 1.0 + chance.uniform(0.0, 1.0)
    key = 0
    while at_s < WARM_S - INTERVAL_S:
        fired = host.fire(at_s)
        mark, pulse = mark_of(chance, fired), pulse_of(fired)
        for clock in (with_pps, marks_only):
            clock.pulse_given(pulse.sigma_ns)
            strobe_ns = pulse.mono_ns + STROBE_NS
            clock.mark_matched(
                mark.gps_ns, strobe_ns, pulse.sigma_ns, accuracy_ns=mark.accuracy_ns, key=key
            )
        at_s += INTERVAL_S + chance.uniform(0.0, 0.05)
        key += 1
    last, later = host.fire(at_s), host.fire(at_s + COAST_S)
    return [
        stamp(chance, with_pps, last, None),
        stamp(chance, marks_only, last, mark_of(chance, last)),
        stamp(chance, marks_only, last, None),
        stamp(chance, with_pps, later, None),
        stamp(chance, marks_only, later, None),
    ]


@pytest.fixture(scope="module")
def stamps() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    hosts = [one_host(seed) for seed in range(RUNS)]
    return {
        name: (
            np.array([host[index].error_ns for host in hosts]),
            np.array([host[index].sigma_ns for host in hosts]),
        )
        for index, name in enumerate(SETS)
    }


@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", SETS)
def test_95_percent_of_a_thousand_independent_times_lie_inside_two_sigmas(
    stamps: dict[str, tuple[np.ndarray, np.ndarray]], name: str
) -> None:
    errors_ns, sigmas_ns = stamps[name]
    assert len(errors_ns) == RUNS
    assert 0.925 <= inside(errors_ns, sigmas_ns, 2.0) <= 0.975
    assert inside(errors_ns, sigmas_ns, 4.0) >= 0.99

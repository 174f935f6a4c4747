"""`python -m benchmarks.time_chain OUT.svg`: do timestamps say how good they are?

Independent hosts, each with a crystal, interrupts and round trips of its own
(`benchmarks.time_truth`); every time is made by the service's own pieces from what hardware would
say. Truth and estimator share no code, and no numbers but those a data sheet gives.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

# Small matrices: more threads only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.time_truth import Fired, Host, delay_error_ns, inside, receiver_stamp
from daemon.cli.benchmark.measurement import machine
from daemon.mission.exposure import CaptureRecord, FrameRecord
from daemon.onboard.flight.record_builder import build_record, instant_of
from daemon.onboard.flight.temperatures import TemperatureHistory
from daemon.onboard.timing.gps_clock import GpsClock
from daemon.onboard.timing.matching import FiredPulse
from daemon.orientation.navigation import Track
from daemon.postflight.plots import COLOURS, svg_of, titles
from drivers.contract import EventMark
from processing.quality.report import Flag
from processing.rig import find_rig

Errors = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Errors and stated sigmas, ns."""
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


def pulse_of(fired: Fired) -> FiredPulse:
    middle_ns = (fired.before_ns + fired.after_ns) // 2
    half_ns = (fired.after_ns - fired.before_ns + 1) // 2
    return FiredPulse(1, middle_ns, half_ns, 1, DELAYS_NS, STROBE_NS, SPREAD_NS)


def mark_of(rng: np.random.Generator, fired: Fired) -> EventMark:
    strobe_s = fired.true_s + STROBE_NS * 1e-9
    stamped_ns = receiver_stamp(rng, strobe_s, ACCURACY_NS, RESOLUTION_NS)
    return EventMark("gnss", 0, EPOCH_NS + stamped_ns, round(ACCURACY_NS), 0, 0, True, 0)


def stamp(rng: np.random.Generator, clock: GpsClock, fired: Fired, mark: EventMark | None) -> Stamp:
    """A frame's time as the service records it, against when it was truly exposed."""
    pulse = pulse_of(fired)
    frame = FrameRecord(FAR_SENSOR, "", "", "", 1, 1, "Mono12", None, None, EXPOSURE_US, None, 0)
    record = build_record(
        RIG,
        CaptureRecord(1, frames=(frame,)),
        pulse,
        instant_of(mark, pulse, clock),
        Track(),
        TemperatureHistory(),
        Flag(0),
    )
    (timed,) = record.frames
    assert timed.mid_exposure_gps_ns is not None and timed.time_sigma_ns is not None
    delay_ns = DELAYS_NS[RIG.cone_of(FAR_SENSOR).name] + 2_000_000
    true_ns = fired.true_s * 1e9 + delay_ns
    true_ns += delay_error_ns(rng, SPREAD_NS) + rng.normal(0.0, HEAD_NS)
    return Stamp(timed.mid_exposure_gps_ns - EPOCH_NS - true_ns, timed.time_sigma_ns)


def one_host(seed: int, *, temperature_factor: float = 1.0) -> list[Stamp]:
    """One stamp for each of SETS, of a host, a crystal and a trigger unit drawn with that seed."""
    rng = np.random.default_rng([20261121, seed])
    host = Host(rng, WARM_S + COAST_S + 10.0, temperature_factor=temperature_factor)
    with_pps, marks_only = warmed(host), GpsClock()
    at_s = 1.0 + rng.uniform(0.0, 1.0)
    key = 0
    while at_s < WARM_S - INTERVAL_S:
        fired = host.fire(at_s)
        mark, pulse = mark_of(rng, fired), pulse_of(fired)
        for clock in (with_pps, marks_only):
            clock.pulse_given(pulse.sigma_ns)
            strobe_ns = pulse.mono_ns + STROBE_NS
            clock.mark_matched(
                mark.gps_ns, strobe_ns, pulse.sigma_ns, accuracy_ns=mark.accuracy_ns, key=key
            )
        at_s += INTERVAL_S + rng.uniform(0.0, 0.05)
        key += 1
    last, later = host.fire(at_s), host.fire(at_s + COAST_S)
    return [
        stamp(rng, with_pps, last, None),
        stamp(rng, marks_only, last, mark_of(rng, last)),
        stamp(rng, marks_only, last, None),
        stamp(rng, with_pps, later, None),
        stamp(rng, marks_only, later, None),
    ]


def stamps(runs: int, *, first: int = 0, temperature_factor: float = 1.0) -> Mapping[str, Errors]:
    """Errors and stated sigmas of so many independent hosts, for each of SETS."""
    hosts = [
        one_host(seed, temperature_factor=temperature_factor) for seed in range(first, first + runs)
    ]
    return {
        name: (
            np.array([host[index].error_ns for host in hosts]),
            np.array([host[index].sigma_ns for host in hosts]),
        )
        for index, name in enumerate(SETS)
    }


def row(name: str, errors: Errors) -> str:
    """A row of the table in docs/explanation/time.md."""
    off, sigma = errors
    shares = " | ".join(f"{100 * inside(off, sigma, k):.1f} %" for k in (1.0, 2.0, 3.0))
    worst = float(np.max(np.abs(off) / sigma))
    median_us, off_us = np.median(sigma) * 1e-3, np.median(np.abs(off)) * 1e-3
    return f"| {name} | {off_us:.1f} us | {median_us:.1f} us | {shares} | {worst:.1f} |"


def coasts(runs: int, after_s: Sequence[float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Clock error and stated sigma so long after the last edge, shape (runs, times), ns."""
    errors = np.empty((runs, len(after_s)))
    sigmas = np.empty_like(errors)
    for run in range(runs):
        rng = np.random.default_rng([4711, run])
        host = Host(rng, WARM_S + max(after_s) + 5.0)
        clock = warmed(host)
        for index, after in enumerate(after_s):
            at_s = WARM_S - 1.0 + after
            estimate = clock.gps_at(round(host.clock.reads(at_s)))
            assert estimate is not None
            errors[run, index] = estimate.gps_ns - EPOCH_NS - at_s * 1e9
            sigmas[run, index] = estimate.sigma_ns
    return errors, sigmas


def warmed(host: Host) -> GpsClock:
    """A clock after a minute of edges, named by messages."""
    clock = GpsClock()
    for k in range(3):
        arrived_ns = round(host.clock.reads(0.2 * k + 0.06))
        clock.message_arrived(EPOCH_NS + 200_000_000 * k, arrived_ns)
    for second in range(1, WARM_S):
        clock.pps_edge(host.edge(float(second)) - PPS_LATENCY_NS, PPS_SIGMA_NS)
    return clock


def drawing(
    after_s: Sequence[float], errors: NDArray[np.float64], sigmas: NDArray[np.float64]
) -> str:
    """Errors of coasting clocks over time in units of the sigma that was stated with each."""
    relative = np.clip(errors / sigmas, -4.0, 4.0)
    within = np.percentile(np.abs(errors / sigmas), 95.45, axis=0)

    def draw(figure: Figure) -> None:
        plot = figure.subplots()
        plot.plot(after_s, relative[:120].T, color="#9bb8d3", linewidth=0.5)
        for sign in (1.0, -1.0):
            plot.plot(after_s, sign * within, "--", color="#1b4f72", linewidth=1.6)
            plot.axhline(2.0 * sign, color=COLOURS[1], linewidth=0.8)
        whole = [k for k, seconds in enumerate(after_s) if seconds % 10 == 0]
        medians_us = np.median(sigmas, axis=0) * 1e-3
        ticks = [f"{after_s[k]:.0f}\n{medians_us[k]:.1f} us" for k in whole]
        plot.set_xticks([after_s[k] for k in whole], ticks)
        plot.set(xlim=(0.0, max(after_s)), ylim=(-4.0, 4.0))
        title = f"Errors of {len(errors)} coasting clocks over the stated sigma"
        note = "120 hosts drawn; dashed: 95.45 % lie between, two sigmas if sigmas are true"
        x_label = f"coasting, s; below, median stated sigma\n{note}"
        titles(plot, title, x_label, "error / stated sigma")

    return svg_of(draw)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.time_chain", description=__doc__)
    parser.add_argument("svg", type=Path, help="where the drawing goes")
    parser.add_argument("--runs", type=int, default=1000, help="independent hosts")
    parser.add_argument(
        "--temperature-factor", type=float, default=1.0, help="what temperature does, times"
    )
    given = parser.parse_args(arguments)
    after_s = [1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 45.0, 50.0, 55.0, 60.0]
    errors_ns, sigmas_ns = coasts(given.runs // 2, after_s)
    given.svg.write_text(drawing(after_s, errors_ns, sigmas_ns), encoding="utf-8")
    print("the clock alone, within two sigmas so long after the last edge:")
    for index, after in enumerate(after_s):
        share = inside(errors_ns[:, index], sigmas_ns[:, index], 2.0)
        print(f"  {after:.0f} s: {100 * share:.1f} %")
    print(f"{machine()}; {given.runs} hosts, harshness {given.temperature_factor:g}\n")
    print("| set | median error | median sigma | within 1 sigma | within 2 | within 3 | worst |")
    print("|---|---|---|---|---|---|---|")
    for name, errors in stamps(given.runs, temperature_factor=given.temperature_factor).items():
        print(row(name, errors))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""`python -m benchmarks.pairing`: does every exposure get its own frames, mark and position?

Flies the service's real pieces on a fake clock (see `benchmarks.fast_flight`): without a fault,
with every fault of the library at every kind of device, and with many at once. Which frame, mark
and place is whose is known to the emulated world alone.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from benchmarks.fast_flight import FastFlight
from benchmarks.fast_flight_score import Score
from processing.rig import find_rig
from sim_hw.faults.catalogue import CATALOGUE
from sim_hw.faults.plan import PlannedFault
from sim_hw.processes.discrete_event_rig import RECEIVER_NAME, devices_of

RIG = "ultracam-x-mini"
SMALL_RIG = "ultracam-l-mini"
"""Four heads instead of thirteen: the same flight in half the time."""
A_HEAD = "head"
"""Placeholder for the first head of a rig."""
INTERVAL_S = 1.37
FIRST_FAULT_S = 20.0
MANY_EVERY_S = 30.0
LASTING_S = 4.0
MIN_MATCHED_SHARE = 0.98

VARIANTS = (
    ("clock-step", RECEIVER_NAME, (0.001, 0.37, -0.37, 1.0, -1.0, 18.0, -18.0)),
    ("clock-step", A_HEAD, (0.018, 0.37, -1.37)),
    ("wrong-week", RECEIVER_NAME, (-1024.0, 1.0)),
    ("late", A_HEAD, (2.0, 9.0)),
    ("late", f"{RECEIVER_NAME}/mark", (1.37, 2.0, 5.0)),
)
"""Faults whose amount matters: name, device, amounts."""


@dataclass(frozen=True)
class Case:
    """One flight: what it is called, and its faults."""

    title: str
    device: str
    planned: tuple[PlannedFault, ...]


def single_cases(exposures: int, seed: int = 1, rig_name: str = RIG) -> Iterator[Case]:
    """Every fault at every kind of device: the next message, and again for some seconds."""
    devices = devices_of(find_rig(rig_name))
    span_s = max(exposures * INTERVAL_S - 2 * FIRST_FAULT_S, 10.0)
    varied = {(name, device): amounts for name, device, amounts in VARIANTS}
    for kind in CATALOGUE.values():
        for device in (A_HEAD, RECEIVER_NAME, f"{RECEIVER_NAME}/mark", "trigger", "probes"):
            name, _, topic = device.partition("/")
            name = next(iter(devices)) if name == A_HEAD else name
            if devices[name] not in kind.devices:
                continue
            if topic and kind.level != "message":
                continue
            for amount in varied.get((kind.name, device), (kind.amount,)):
                rng = random.Random(f"{seed}-{kind.name}-{device}-{amount}")
                times_s = sorted(FIRST_FAULT_S + rng.uniform(0.0, span_s) for _ in range(2))
                lasting_s = None if kind.level == "clock" and kind.duration_s is None else LASTING_S
                planned = (
                    PlannedFault(kind.name, name, times_s[0], None, kind.duration_s, amount, topic),
                    PlannedFault(kind.name, name, times_s[1], None, lasting_s, amount, topic),
                )
                shown = f" {kind.amount_key}={amount:g}" if kind.amount_key else ""
                # A clock that steps for good steps once: twice would be two faults.
                once = kind.level == "clock" and kind.duration_s is None
                yield Case(f"{kind.name}{shown}", device, planned[: 1 if once else 2])


def many_case(exposures: int, seed: int) -> Case:
    """Faults of all kinds at all devices, at random, for the whole flight."""
    rng = random.Random(f"many-{seed}")
    devices = devices_of(find_rig(RIG))
    planned = []
    at_s = FIRST_FAULT_S
    while at_s < exposures * INTERVAL_S:
        kind = rng.choice(list(CATALOGUE.values()))
        of = rng.choice(sorted(kind.devices))
        device = rng.choice([name for name, its in devices.items() if its == of])
        duration_s = rng.choice((kind.duration_s, rng.uniform(0.5, 6.0)))
        if kind.level == "clock":
            duration_s = rng.uniform(5.0, 60.0)
        amount = kind.amount if kind.name == "wrong-week" else kind.amount * rng.uniform(0.2, 3)
        planned.append(PlannedFault(kind.name, device, at_s, None, duration_s, amount))
        at_s += rng.expovariate(1.0 / MANY_EVERY_S)
    return Case(f"many: {len(planned)} faults", "all", tuple(planned))


def fly(case: Case, exposures: int, seed: int, rig_name: str = RIG) -> Score:
    """One flight of a case."""
    with tempfile.TemporaryDirectory() as mission:
        flight = FastFlight(
            rig_name, case.planned, exposures=exposures, seed=seed, mission=Path(mission)
        )
        return flight.fly()


def total(scores: Sequence[Score]) -> Score:
    """The sum of some flights."""
    summed = Score()
    for score in scores:
        for item in fields(Score):
            if item.name == "examples":
                summed.examples += score.examples
            elif item.name == "longest_open_s":
                summed.longest_open_s = max(summed.longest_open_s, score.longest_open_s)
            else:
                total_ = getattr(summed, item.name) + getattr(score, item.name)
                setattr(summed, item.name, total_)
    return summed


def shortcomings(score: Score, *, single: bool = True) -> list[str]:
    """What of the promises a flight did not keep; empty where it kept all."""
    found = []
    if score.wrong:
        found.append(
            f"{score.frames_wrong} frames, {score.marks_wrong} marks and "
            f"{score.navigation_wrong} positions are wrongly paired"
        )
    if score.times_wrong:
        found.append(f"{score.times_wrong} times are off by more than six sigmas")
    if score.hangs:
        found.append(f"{score.hangs} exposures hang")
    if score.imbalances:
        found.append(f"the ledger was out of balance {score.imbalances} times")
    if score.sealed != score.exposures:
        found.append(f"{score.sealed} of {score.exposures} exposures have a record")
    if single and score.untouched_matched != score.untouched:
        found.append(f"{score.untouched - score.untouched_matched} untouched are not matched")
    if not single and score.pairs_matched < MIN_MATCHED_SHARE * score.pairs:
        found.append(f"only {score.pairs_matched} of {score.pairs} pairs are matched")
    return found


COLUMNS = (
    "fault",
    "device",
    "exposures",
    "frames that came",
    "right",
    "wrong",
    "marks that came",
    "right",
    "wrong",
    "positions wrong",
    "untouched",
    "matched",
    "longest open",
)


def row(case: Case, score: Score) -> str:
    """A row of the table in docs/reference/results/faults.md."""
    cells = (
        case.title,
        case.device,
        score.exposures,
        score.frames_received,
        score.frames_right,
        score.frames_wrong,
        score.marks_received,
        score.marks_right,
        score.marks_wrong,
        score.navigation_wrong,
        score.untouched,
        score.untouched_matched,
        f"{score.longest_open_s:.1f} s",
    )
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.pairing", description=__doc__)
    add = parser.add_argument
    add("--exposures", type=int, default=10_000, help="of the flights with none and with many")
    add("--each", type=int, default=100, help="exposures of the flight with each single fault")
    add("--only", default="", help="faults whose name begins so; 'none' and 'many' are names too")
    add("--seed", type=int, default=1, help="seed for all random generators")
    given = parser.parse_args(arguments)
    cases = [
        (Case("none", "", ()), given.exposures),
        *((case, given.each) for case in single_cases(given.each, given.seed)),
        (many_case(given.exposures, given.seed), given.exposures),
    ]
    print("| " + " | ".join(COLUMNS) + " |")
    print("|" + "---|" * len(COLUMNS))
    scores = []
    failed = 0
    started = time.monotonic()
    for case, exposures in cases:
        if not case.title.startswith(given.only):
            continue
        score = fly(case, exposures, given.seed)
        scores.append(score)
        print(row(case, score), flush=True)
        for sentence in shortcomings(score, single=not case.title.startswith("many")):
            failed += 1
            print(f"  {case.title} {case.device}: {sentence}", file=sys.stderr, flush=True)
            for example in score.examples[:3]:
                print(f"    {example}", file=sys.stderr, flush=True)
    total_score = total(scores)
    print(
        f"\n{total_score.exposures} exposures, {total_score.occurrences} hits of faults, "
        f"{total_score.pairs_matched} of {total_score.pairs} pairs of frame and mark matched, "
        f"{total_score.wrong} wrong, {time.monotonic() - started:.0f} s"
    )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())

"""`python -m benchmarks.silent_errors`: do wrong inputs pass as good images?

Plants wrong inputs of sizes from 0.5 to 4 times their published detection limit, by seed, processes
them as `syntopic process` does and holds image and report against the emulator's truth. With
`--clean` it renders healthy exposures over hard scenes instead and counts false alarms, with
`--drawn` it draws their adjustments without rendering, with `--toned` their signals, fifty of each
rendered light. It exits with 1 where an error is silent or misdescribed, or the stated sigmas are
not those of the errors.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.stats import chi2, poisson

from benchmarks.silent_errors.cases import WIDEST, Case, by_exposure, draw, run
from benchmarks.silent_errors.clean import clean_rows, clean_summary
from benchmarks.silent_errors.drawn import false_alarms
from benchmarks.silent_errors.exposures import RIGS
from benchmarks.silent_errors.limits import LIMITS, table
from daemon.cli.benchmark.measurement import machine

Row = dict[str, Any]

MAX_ALARMS: Final = 3e-4
"""Share of drawn healthy exposures whose verdict may change."""


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.silent_errors")
    add = parser.add_argument
    add("--count", type=int, default=150, help="Wrong inputs to draw (default: 150).")
    add("--seed", type=int, default=1, help="Seed for all random generators (default: 1).")
    add("--rig", action="append", choices=RIGS, help="Only this rig; repeat.")
    add("--kind", action="append", choices=sorted(LIMITS), help="Only this kind; repeat.")
    add("--jobs", type=int, default=1, help="Processes (default: 1).")
    add("--results", type=Path, help="File of results, one JSON object a line; it is continued.")
    add("--clean", type=int, default=0, help="Healthy exposures to render instead.")
    add("--drawn", type=int, default=0, help="Healthy exposures to draw without rendering instead.")
    add("--toned", type=int, default=0, help="Healthy exposures of drawn signals instead.")
    add("--json", action="store_true", help="Print one JSON object.")
    add("--limits", action="store_true", help="Print the published detection limits.")
    given = parser.parse_args()
    if given.limits:
        print(table())
        return
    if given.clean or given.toned:
        count, toned = given.toned or given.clean, bool(given.toned)
        found = list(clean_rows(count, given.seed, given.results, toned=toned))
        print(
            json.dumps({"machine": machine(), "clean": found})
            if given.json
            else clean_summary(found)
        )
        failed = _alarms(found)
        if toned and len(failed) <= count * MAX_ALARMS:
            failed = []
        sys.exit(_reported([*failed, *interval_failures(found, "healthy")]))
    if given.drawn:
        alarms = false_alarms(given.drawn, given.seed, given.results)
        print(json.dumps({"machine": machine(), "drawn": given.drawn, "alarms": alarms}))
        sys.exit(1 if alarms["any"] > given.drawn * MAX_ALARMS else 0)
    cases = draw(given.count, given.seed, rigs=given.rig or (), kinds=given.kind or ())
    rows = list(results(cases, given.results, given.jobs))
    if given.json:
        print(json.dumps({"machine": machine(), "cases": rows}))
    else:
        print(summary(rows))
    sys.exit(_reported(failures(rows)))


def _reported(failed: Sequence[str]) -> int:
    """Print what failed, one sentence a line; the exit status."""
    for sentence in failed:
        print(f"FAILED: {sentence}", file=sys.stderr)
    return 1 if failed else 0


def _alarms(rows: Iterable[Row]) -> list[str]:
    return [f"{row['number']} {row['scene']}: {row['alarm']}" for row in rows if row["alarm"]]


def failures(rows: Sequence[Row]) -> list[str]:
    """What of a run is not as required, one sentence each.

    Args:
        rows: outcomes.

    Returns:
        Silent and misdescribed cases, normalised errors outside of their interval, and a sigma of
        flagged images that states nothing.
    """
    flagged = [row for row in rows if row["flags"]]
    unflagged = [row for row in rows if not row["flags"]]
    failed = _wrong(rows) + interval_failures(unflagged, "unflagged")
    wide, expected, most = wide_sigmas(flagged)
    if wide > most:
        failed.append(
            f"{wide} flagged images state more than {WIDEST:g} times their error, {expected:.1f} "
            f"are expected of what they state, {most} in one of 1,000 runs"
        )
    failed += interval_failures(flagged, "flagged", lower=False)
    pooled = _pooled(flagged)
    if pooled is not None and not pooled.stated_px <= WIDEST * pooled.true_px:
        failed.append(
            f"flagged images state {pooled.stated_px:.3f} px, more than {WIDEST:g} times their "
            f"true RMS of {pooled.true_px:.3f} px"
        )
    return failed


def interval_failures(rows: Sequence[Row], label: str, *, lower: bool = True) -> list[str]:
    """A sentence where normalised errors lie outside of the 99.9 % interval of chi-square.

    Args:
        rows: outcomes; those without a stitched image do not count.
        label: of these images.
        lower: False holds them to the upper limit alone.
    """
    pooled = _pooled(rows)
    if pooled is None or (pooled.mean <= pooled.high and (pooled.mean >= pooled.low or not lower)):
        return []
    return [
        f"{label} images: mean square of normalised errors {pooled.mean:.3f} is outside of "
        f"{pooled.low:.3f} .. {pooled.high:.3f} (rank {pooled.rank})"
    ]


@dataclass(frozen=True)
class _Pooled:
    """Normalised errors of some images with the 99.9 % interval, and RMS errors and sigmas."""

    images: int
    rank: int
    mean: float
    low: float
    high: float
    true_px: float
    stated_px: float


def _pooled(rows: Iterable[Row]) -> _Pooled | None:
    some = [row for row in rows if row["rank"]]
    if not some:
        return None
    rank = sum(row["rank"] for row in some)
    low, high = (float(chi2.ppf(p, rank)) / rank for p in (0.0005, 0.9995))
    true_px, stated_px = (
        float(np.sqrt(np.mean([row[key] ** 2 for row in some])))
        for key in ("error_px", "stated_px")
    )
    mean = sum(row["squares"] for row in some) / rank
    return _Pooled(len(some), rank, mean, low, high, true_px, stated_px)


def wide_sigmas(rows: Iterable[Row]) -> tuple[int, float, int]:
    """How many images state more than `WIDEST` times their error, and how many are expected to.

    An error of a few unknowns is small by chance, however honest its sigma is.

    Args:
        rows: outcomes; those without a stated covariance do not count.

    Returns:
        Their number, its expectation where the stated covariances hold, and what it reaches in one
        of 1,000 runs (Poisson).
    """
    some = [row for row in rows if row["rank"] and row.get("freedom")]
    wide = sum(row["stated_px"] > WIDEST * row["error_px"] for row in some)
    freedom = np.array([row["freedom"] for row in some])
    expected = float(np.sum(chi2.cdf(freedom / WIDEST**2, freedom)))
    return wide, expected, int(poisson.ppf(0.999, expected))


def results(cases: Sequence[Case], file: Path | None, jobs: int) -> Iterable[Row]:
    """Outcomes by case; those that are in the file already are not run again."""
    known = {row["number"]: row for row in _read(file)}
    left = [case for case in by_exposure(cases) if case.number not in known]
    yield from (known[case.number] for case in cases if case.number in known)
    if jobs > 1:
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            for outcome in pool.map(run, left, chunksize=8):
                yield _write(file, asdict(outcome))
    else:
        for case in left:
            yield _write(file, asdict(run(case)))


def _read(file: Path | None) -> list[Row]:
    if file is None or not file.exists():
        return []
    return [json.loads(line) for line in file.read_text().splitlines() if line]


def _write(file: Path | None, row: Row) -> Row:
    if file is not None:
        with file.open("a") as out:
            out.write(json.dumps(row) + "\n")
    print(f"{row['number']} {row['rig']} {row['description']}: {row['result']}", file=sys.stderr)
    return row


def summary(rows: Sequence[Row]) -> str:
    """Markdown: a line for each kind, the cases that are wrong, and the sigmas of all."""
    lines = [
        "| kind | drawn | above the limit | of these found | right | silent | misled "
        "| largest error over sigma |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for kind in LIMITS:
        of_kind = [row for row in rows if row["kind"] == kind]
        if not of_kind:
            continue
        above = [row for row in of_kind if row["above"]]
        counts = [
            len(of_kind),
            len(above),
            *(sum(r["result"] == what for r in above) for what in ("found", "right")),
            *(sum(r["result"] == what for r in of_kind) for what in ("silent", "misled")),
        ]
        good = [r["over_sigma"] for r in of_kind if r["over_sigma"] is not None]
        worst = f"{max(good):.2f}" if good else "–"
        lines.append(f"| `{kind}` | " + " | ".join(map(str, counts)) + f" | {worst} |")
    lines += ["", *_wrong(rows), "", *_sigmas(rows)]
    return "\n".join(lines)


def _wrong(rows: Iterable[Row]) -> list[str]:
    return [
        f"{row['result']}: {row['number']} {row['kind']} {row['rig']} {row['description']} "
        f"({row['share']:.2f} of the limit): {row['verdict']} {row['flags']} {row['named']}, "
        f"error/sigma {row['over_sigma'] or 0:.2f} ({row['error_px'] or 0:.3f} px), "
        f"{row['worst_of'] or 'no head'} {row['worst'] or 0:.2f} of {row['worst_limit'] or 0:.2f}, "
        f"band {row['band_px']:.2f} px, radiance {row['radiance']:.1%} of {row['radiance_of']}, "
        f"detail {row['detail']:.0%}, blank {row['blank']:.1%} of {row['blank_of'] or 'none'}"
        for row in rows
        if row["result"] in ("silent", "misled")
    ]


def _sigmas(rows: Sequence[Row]) -> list[str]:
    """Normalised errors of flagged and unflagged images against the 99.9 % points of chi-square."""
    lines = []
    for label, flagged in (("without a flag", False), ("with a flag", True)):
        some = [r for r in rows if bool(r["flags"]) == flagged]
        pooled = _pooled(some)
        if pooled is None:
            continue
        wide, expected, _ = wide_sigmas(some)
        lines.append(
            f"{label}: {pooled.images} images, mean square of normalised errors {pooled.mean:.3f} "
            f"(rank {pooled.rank}, {pooled.low:.3f} .. {pooled.high:.3f}); {pooled.true_px:.3f} px "
            f"true, {pooled.stated_px:.3f} stated; {wide} state more than {WIDEST:g} times their "
            f"error, {expected:.1f} are expected of what they state"
        )
    return lines


if __name__ == "__main__":
    main()

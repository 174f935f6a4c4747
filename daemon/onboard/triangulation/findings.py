"""What is wrong with a live triangulation, each with its name, its sentence and its cure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from daemon.onboard.triangulation.drifts import MOUNTING, Drift
from daemon.onboard.triangulation.exposure_ranges import ranges
from processing.pipelines.live_triangulation import LiveTriangulation

MIN_TIES: Final = 6
"""Points an image must share with others to count as tied."""
MIN_TRIED: Final = 12
MIN_FOUND_SHARE: Final = 0.15
"""Of the points tried between two lines; fewer: they do not tie."""
SIGNIFICANT: Final = 4.0
CONTRADICTED_FACTOR: Final = 4.0
"""Variance factor of measured positions or attitudes: their errors are twice the stated ones."""
HEIGHT_MODEL_SIGMAS: Final = 3.0
HEIGHT_MODEL_MIN_M: Final = 5.0

LOST: Final = "lost, no head delivered an image"
NOT_SEALED: Final = "it is not sealed"
NOT_PROCESSED: Final = "it was not processed"
CUT_OFF: Final = "landing did not wait for it"
"""Reasons why an exposure is not in the block."""


@dataclass(frozen=True)
class TriangulationFinding:
    """A named problem, what to do, and the exposures and lines it is about."""

    name: str
    sentence: str
    exposures: tuple[int, ...] = ()
    lines: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "sentence": self.sentence,
            "exposures": list(self.exposures),
            "lines": list(self.lines),
        }


@dataclass(frozen=True)
class HeightModelCheck:
    """Tie points against the configured height model: median difference and its standard deviation
    in m; `problem` where the model cannot be used."""

    difference_m: float | None = None
    sigma_m: float | None = None
    problem: str = ""


def findings_of(
    live: LiveTriangulation,
    drifts: Sequence[Drift],
    *,
    skipped: Mapping[int, str],
    planned_lines: Sequence[str] = (),
    heights: HeightModelCheck | None = None,
    has_landed: bool = False,
) -> tuple[TriangulationFinding, ...]:
    """Everything that is wrong, the gravest first.

    Args:
        skipped: exposures that are not in the block, with the reason.
        planned_lines: ids of the plan's lines.
        heights: the check of the height model, if one is configured.
        has_landed: lines that were not flown count only then.
    """
    found = [
        *_skipped(live, skipped),
        *_untied(live),
        *_lines(live),
        *_single_strip(live, drifts),
        *_contradicted(live, drifts),
        *_heights(heights),
    ]
    if has_landed:
        found += _plan(live, planned_lines)
    found += [
        TriangulationFinding(
            "ADJUSTMENT_FAILED",
            f"An adjustment failed: {sentence}. The orientations keep their last values.",
        )
        for sentence in live.problems[-1:]
    ]
    return tuple(found)


def line_ties(live: LiveTriangulation) -> dict[tuple[str, str], tuple[int, int]]:
    """Points tried and found between each pair of lines that overlap, by sorted pair."""
    table: dict[tuple[str, str], list[int]] = {}
    for image, ties in zip(live.images, live.ties, strict=True):
        for other, tried in ties.tried.items():
            if other == image.line:
                continue
            first, second = sorted((image.line, other))
            counts = table.setdefault((first, second), [0, 0])
            counts[0] += tried
            counts[1] += ties.found.get(other, 0)
    return {pair: (tried, found) for pair, (tried, found) in table.items()}


def untied_numbers(live: LiveTriangulation) -> tuple[int, ...]:
    """Exposures that share fewer than `MIN_TIES` points with others, or whose own line is not found
    in them."""
    if len(live.images) < 2:
        return ()
    found = []
    for one, ties in zip(live.orientations, live.ties, strict=True):
        tried = ties.tried.get(one.image.line, 0)
        matched = ties.found.get(one.image.line, 0)
        if one.ties < MIN_TIES or (tried >= MIN_TRIED and matched < MIN_FOUND_SHARE * tried):
            found.append(one.image.number)
    return tuple(found)


def untied_pairs(live: LiveTriangulation) -> tuple[tuple[str, str], ...]:
    """Pairs of overlapping lines that do not tie."""
    return tuple(
        pair
        for pair, (tried, found) in line_ties(live).items()
        if tried >= MIN_TRIED and found < MIN_FOUND_SHARE * tried
    )


def _skipped(live: LiveTriangulation, skipped: Mapping[int, str]) -> list[TriangulationFinding]:
    by_reason: dict[str, list[int]] = {}
    for number, reason in skipped.items():
        by_reason.setdefault(reason, []).append(number)
    found = []
    for reason, numbers in by_reason.items():
        where = f"Exposures {ranges(numbers)} are not in the block"
        if reason in ("no instant", "no navigation", "no height"):
            name, why = "NO_GNSS", f"{reason}. Check the receiver and its antenna."
        elif reason == "no attitude":
            name, why = "NO_ATTITUDE", "no attitude. Check the inertial unit and its configuration."
        elif reason == LOST:
            name, why = "EXPOSURES_LOST", f"{reason}. Fly them again."
        elif reason == CUT_OFF:
            name, why = "NOT_TRIANGULATED", f"{reason}. Run `syntopic triangulate MISSION --live`."
        else:
            name, why = "NO_IMAGE", f"{reason}. Run `syntopic process` after landing."
        if not live.images:
            where = f"There is no block: exposures {ranges(numbers)} cannot be used"
        found.append(TriangulationFinding(name, f"{where}: {why}", tuple(numbers)))
    return found


def _untied(live: LiveTriangulation) -> list[TriangulationFinding]:
    numbers = untied_numbers(live)
    if not numbers:
        return []
    return [
        TriangulationFinding(
            "UNTIED_EXPOSURES",
            f"Exposures {ranges(numbers)} do not tie to their neighbours (water, cloud, uniform "
            "ground, no overlap, or another exposure's image). Do not rely on more than their "
            "measured orientation. Fly a cross line over land, or fly them again.",
            numbers,
        )
    ]


def _lines(live: LiveTriangulation) -> list[TriangulationFinding]:
    table = line_ties(live)
    return [
        TriangulationFinding(
            "LINES_NOT_TIED",
            f"Lines {first} and {second} overlap, but only {table[first, second][1]} of "
            f"{table[first, second][0]} points tie them (water, cloud, moved shadows or a wrong "
            "orientation). Fly a cross line over both.",
            lines=(first, second),
        )
        for first, second in untied_pairs(live)
    ]


def _single_strip(live: LiveTriangulation, drifts: Sequence[Drift]) -> list[TriangulationFinding]:
    lines = tuple(dict.fromkeys(one.line for one in live.images))
    tied_across = any(found for _, found in line_ties(live).values())
    if live.last is None or tied_across:
        return []
    mounting = {name for name, _, _ in MOUNTING}
    open_ones = [d.name for d in drifts if d.name in mounting and not d.is_determined]
    if len(lines) == 1:
        what = "The block is a single strip. Nothing checks its roll about the flight direction"
    else:
        what = f"The {len(lines)} lines do not tie: each is a strip. Nothing checks their roll"
    not_determined = f" Not determined by the images: {', '.join(open_ones)}." if open_ones else ""
    return [
        TriangulationFinding(
            "SINGLE_STRIP",
            f"{what} and its place in addition to GNSS and inertial unit.{not_determined} Fly a "
            "cross line or a second line with side overlap.",
            lines=lines,
        )
    ]


def _contradicted(live: LiveTriangulation, drifts: Sequence[Drift]) -> list[TriangulationFinding]:
    found: list[TriangulationFinding] = []
    if live.last is None:
        return found
    for group in live.last.result.groups:
        if not np.isfinite(group.factor) or group.factor < CONTRADICTED_FACTOR:
            continue
        ratio = group.factor**0.5
        if group.name.startswith("GNSS"):
            found.append(
                TriangulationFinding(
                    "GNSS_CONTRADICTED",
                    f"{group.name} positions err {ratio:.1f} times as much as stated, by the tie "
                    "points. Check the receiver's corrections; the accuracy is stated accordingly.",
                )
            )
        elif group.name == "attitude":
            found.append(
                TriangulationFinding(
                    "ATTITUDE_CONTRADICTED",
                    f"Attitudes err {ratio:.1f} times as much as stated, by the tie points. Check "
                    "the inertial unit's alignment and mounting.",
                )
            )
    for one in drifts:
        if one.significance < SIGNIFICANT:
            continue
        change = f"{one.value:.3g} {one.unit}, {one.significance:.0f} standard deviations"
        if one.unit == "mdeg/h":
            name, cure = "ATTITUDE_DRIFT", "Fly a turn of alignment and check the inertial unit."
        elif one.name == "time offset":
            name, cure = "TIME_OFFSET", "Check the event mark's edge and [mount] time_offset_ms."
        elif one.name.startswith("boresight"):
            name, cure = "BORESIGHT_CHANGED", "Calibrate the boresight after landing."
        else:
            name, cure = "LEVER_ARM_CHANGED", "Check antenna_m in [mount]."
        found.append(
            TriangulationFinding(name, f"{one.name[0].upper()}{one.name[1:]}: {change}. {cure}")
        )
    return found


def _heights(check: HeightModelCheck | None) -> list[TriangulationFinding]:
    if check is None:
        return []
    if check.problem:
        return [
            TriangulationFinding(
                "HEIGHT_MODEL_FAILED",
                f"The height model cannot be used: {check.problem}. Heights are those of tie "
                "points. Check [plan] elevation.",
            )
        ]
    if check.difference_m is None or check.sigma_m is None:
        return []
    limit_m = max(HEIGHT_MODEL_MIN_M, HEIGHT_MODEL_SIGMAS * check.sigma_m)
    if abs(check.difference_m) <= limit_m:
        return []
    return [
        TriangulationFinding(
            "HEIGHT_MODEL_CONTRADICTED",
            f"Tie points lie {check.difference_m:+.1f} m from the height model (median). Check its "
            "coordinate system and whether its heights count from the geoid ([plan] "
            "elevation_crs).",
        )
    ]


def _plan(live: LiveTriangulation, planned: Sequence[str]) -> list[TriangulationFinding]:
    flown = {one.line for one in live.images}
    left = tuple(line for line in planned if line not in flown)
    if not left:
        return []
    return [
        TriangulationFinding(
            "PLAN_CUT_SHORT",
            f"{len(left)} of {len(planned)} planned lines have no image in the block: "
            f"{', '.join(left[:8])}{', ...' if len(left) > 8 else ''}. The accuracy is that of the "
            "lines that were flown.",
            lines=left,
        )
    ]

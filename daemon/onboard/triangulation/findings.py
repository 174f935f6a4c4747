"""What is wrong with a live triangulation, each with its name, its sentence and its cure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from daemon.onboard.triangulation.drifts import MOUNTING, Drift
from daemon.onboard.triangulation.exposure_ranges import ranges
from daemon.onboard.triangulation.heading_check import headings_off, typical_off
from daemon.onboard.triangulation.height_model_check import HeightModelCheck
from processing.bundle.adjust import Adjustment
from processing.bundle.statistics import ObservationGroup
from processing.pipelines.live_triangulation import LiveTriangulation

MIN_TIES: Final = 6
"""Points an image must share with others to count as tied."""
MIN_TRIED: Final = 12
MIN_FOUND_SHARE: Final = 0.15
"""Of the points tried between two lines; fewer: they do not tie."""
SIGNIFICANT: Final = 4.0
CONTRADICTED_FACTOR: Final = 4.0
"""Variance factor of measured positions or attitudes: their errors are twice the stated ones."""
MIN_LEFT_OUT: Final = 3
LEFT_OUT_SHARE: Final = 0.25
"""Of the exposures; fewer attitudes or positions that were left out are single blunders."""
GROUND_CHANGED_SHARE: Final = 0.1
"""Of the tie points."""
UNCOVERED_SHARE: Final = 0.02
"""Of the tie points; fewer lie at the edge of the height model."""

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
class BlockTies:
    """How the images of a block are tied, in flight or after landing.

    Attributes:
        numbers, lines: of the exposures, by image.
        ties: points that an image shares with others, by image.
        own_line: points tried and found in the image's own line, by image.
        pairs: points tried and found between each pair of lines that overlap, by sorted pair.
        groups: statistics of the adjustment; None before the first.
        problems: sentences of adjustments that failed.
        attitudes_left_out, positions_left_out: exposures whose measured attitude or position the
            adjustment left out.
        headings_off_deg: by image, see `headings_off`; empty if they were not compared.
    """

    numbers: tuple[int, ...]
    lines: tuple[str, ...]
    ties: tuple[int, ...]
    own_line: tuple[tuple[int, int], ...]
    pairs: Mapping[tuple[str, str], tuple[int, int]]
    groups: tuple[ObservationGroup, ...] | None
    problems: tuple[str, ...] = ()
    attitudes_left_out: tuple[int, ...] = ()
    positions_left_out: tuple[int, ...] = ()
    headings_off_deg: tuple[float, ...] = ()

    @property
    def untied_numbers(self) -> tuple[int, ...]:
        """Exposures that share fewer than `MIN_TIES` points with others, or whose own line is not
        found in them."""
        if len(self.numbers) < 2:
            return ()
        return tuple(
            number
            for number, ties, (tried, found) in zip(
                self.numbers, self.ties, self.own_line, strict=True
            )
            if ties < MIN_TIES or _is_untied(tried, found)
        )

    @property
    def untied_pairs(self) -> tuple[tuple[str, str], ...]:
        """Pairs of overlapping lines that do not tie."""
        return tuple(pair for pair, counts in self.pairs.items() if _is_untied(*counts))


def _is_untied(tried: int, found: int) -> bool:
    return tried >= MIN_TRIED and found < MIN_FOUND_SHARE * tried


def live_ties(live: LiveTriangulation) -> BlockTies:
    """Ties of the block in flight."""
    table: dict[tuple[str, str], list[int]] = {}
    for image, ties in zip(live.images, live.ties, strict=True):
        for other, tried in ties.tried.items():
            if other == image.line:
                continue
            first, second = sorted((image.line, other))
            counts = table.setdefault((first, second), [0, 0])
            counts[0] += tried
            counts[1] += ties.found.get(other, 0)
    return BlockTies(
        tuple(one.number for one in live.images),
        tuple(one.line for one in live.images),
        tuple(one.ties for one in live.orientations),
        tuple(
            (ties.tried.get(image.line, 0), ties.found.get(image.line, 0))
            for image, ties in zip(live.images, live.ties, strict=True)
        ),
        {pair: (tried, found) for pair, (tried, found) in table.items()},
        None if live.last is None else live.last.result.groups,
        tuple(live.problems),
        *(
            ((), ())
            if live.last is None
            else left_out_exposures(
                live.last.result, [live.images[k].number for k in live.last_images]
            )
        ),
        headings_off_deg=tuple(
            headings_off(
                [one.line for one in live.images],
                np.array([one.time_s for one in live.images]),
                np.array([one.position_m for one in live.images]).reshape(-1, 3),
                np.array([one.rotation for one in live.images]).reshape(-1, 3, 3),
            ).tolist()
        ),
    )


def left_out_exposures(
    result: Adjustment, numbers: Sequence[int]
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Exposures whose attitude, and those whose position, an adjustment left out.

    Args:
        numbers: of the exposures, in the order of the stations.
    """
    excluded = result.excluded
    return (
        tuple(numbers[int(k)] for k in np.flatnonzero(excluded.attitude.any(axis=1))),
        tuple(numbers[int(k)] for k in np.flatnonzero(excluded.gnss.any(axis=1))),
    )


def findings_of(
    block: BlockTies,
    drifts: Sequence[Drift],
    *,
    skipped: Mapping[int, str],
    planned_lines: Sequence[str] = (),
    missing_at_ends: Mapping[str, int] | None = None,
    heights: HeightModelCheck | None = None,
    has_landed: bool = False,
) -> tuple[TriangulationFinding, ...]:
    """Everything that is wrong, the gravest first.

    Args:
        skipped: exposures that are not in the block, with the reason.
        planned_lines: ids of the plan's lines.
        missing_at_ends: planned exposures before the first and behind the last image, by line.
        heights: the check of the height model, if one is configured.
        has_landed: lines that were not flown count only then.
    """
    found = [
        *_skipped(block, skipped),
        *_untied(block),
        *_lines(block),
        *_single_strip(block, drifts),
        *_contradicted(block, drifts),
        *_heights(heights),
    ]
    if has_landed:
        found += _plan(block, planned_lines, missing_at_ends or {})
    found += [
        TriangulationFinding(
            "ADJUSTMENT_FAILED",
            f"An adjustment failed: {sentence}. The orientations keep their last values.",
        )
        for sentence in block.problems[-1:]
    ]
    return tuple(found)


def _skipped(block: BlockTies, skipped: Mapping[int, str]) -> list[TriangulationFinding]:
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
        if not block.numbers:
            where = f"There is no block: exposures {ranges(numbers)} cannot be used"
        found.append(TriangulationFinding(name, f"{where}: {why}", tuple(numbers)))
    return found


def _untied(block: BlockTies) -> list[TriangulationFinding]:
    numbers = block.untied_numbers
    if not numbers:
        return []
    found = [
        TriangulationFinding(
            "UNTIED_EXPOSURES",
            f"Exposures {ranges(numbers)} do not tie to their neighbours (water, cloud, uniform "
            "ground, no overlap, another exposure's image, or a wrong measured orientation). Do "
            "not rely on more than their measured orientation. Fly a cross line over land, or "
            "fly them again.",
            numbers,
        )
    ]
    # What ties has a right heading, wherever the nose points.
    off = dict(zip(block.numbers, block.headings_off_deg, strict=False))
    turned = tuple(number for number in numbers if off.get(number))
    if len(turned) >= MIN_LEFT_OUT:
        found.append(
            TriangulationFinding(
                "HEADING_CONTRADICTED",
                f"The headings of exposures {ranges(turned)} do not fit the direction of flight, "
                f"by {typical_off(np.array([off[k] for k in turned]))} degrees. Check the sign and "
                "the zero of the inertial unit's heading, and [mount].",
                turned,
            )
        )
    return found


def _lines(block: BlockTies) -> list[TriangulationFinding]:
    table = block.pairs
    return [
        TriangulationFinding(
            "LINES_NOT_TIED",
            f"Lines {first} and {second} overlap, but only {table[first, second][1]} of "
            f"{table[first, second][0]} points tie them (water, cloud, moved shadows or a wrong "
            "orientation). Fly a cross line over both.",
            lines=(first, second),
        )
        for first, second in block.untied_pairs
    ]


def _single_strip(block: BlockTies, drifts: Sequence[Drift]) -> list[TriangulationFinding]:
    lines = tuple(dict.fromkeys(block.lines))
    tied_across = any(found for _, found in block.pairs.values())
    if block.groups is None or tied_across:
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


def _contradicted(block: BlockTies, drifts: Sequence[Drift]) -> list[TriangulationFinding]:
    found: list[TriangulationFinding] = []
    for what, name, numbers, cure in (
        ("Attitudes", "ATTITUDE_CONTRADICTED", block.attitudes_left_out,
         "Check the inertial unit's alignment and mounting."),
        ("Positions", "GNSS_CONTRADICTED", block.positions_left_out,
         "Check the receiver's corrections, and whether its clock or the event marks stepped."),
    ):  # fmt: skip
        if len(numbers) >= max(MIN_LEFT_OUT, LEFT_OUT_SHARE * len(block.numbers)):
            found.append(
                TriangulationFinding(
                    name,
                    f"{what} of exposures {ranges(numbers)} contradict the tie points and were "
                    f"left out. {cure}",
                    tuple(numbers),
                )
            )
    for group in block.groups or ():
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
        elif one.unit == "mdeg/K":
            name = "BORESIGHT_WITH_TEMPERATURE"
            cure = "Calibrate the boresight near the temperatures of the flight."
        elif one.unit in ("um", "um/h"):
            name = "PRINCIPAL_DISTANCE"
            cure = "Calibrate the camera, or run `syntopic triangulate MISSION --interior`."
        elif one.name.startswith("time offset"):
            name, cure = (
                "TIME_OFFSET",
                (
                    "Check the event mark's edge, the receiver's clock, and time_offset_ms and "
                    "antenna_m in [mount]: at one speed, a wrong lever arm along the flight is "
                    "the same."
                ),
            )
        elif one.name.startswith("boresight"):
            name, cure = (
                "BORESIGHT_CHANGED",
                (
                    "Calibrate the boresight after landing, and check the sign of antenna_m in "
                    "[mount]: at one flying height, a wrong lever arm is the same."
                ),
            )
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
    found = []
    if check.uncovered > UNCOVERED_SHARE:
        found.append(
            TriangulationFinding(
                "HEIGHT_MODEL_INCOMPLETE",
                f"{100.0 * check.uncovered:.0f} % of the tie points lie where the height model has "
                "no height; the live map takes the plan's ground height there. Give a height model "
                "of the whole block ([plan] elevation).",
            )
        )
    if check.arrangement:
        return [
            *found,
            TriangulationFinding(
                "HEIGHT_MODEL_CONTRADICTED",
                check.arrangement_sentence("[plan] elevation"),
            ),
        ]
    if not check.is_contradicted:
        if check.share_off >= GROUND_CHANGED_SHARE:
            found.append(
                TriangulationFinding(
                    "GROUND_CHANGED",
                    f"{100.0 * check.share_off:.0f} % of the tie points lie more than "
                    f"{check.limit_m:.1f} m from the height model, the others fit: it is older "
                    "than the ground there, or without its buildings and trees. Do not rely on "
                    "places in the orthomosaic there, or give a newer model ([plan] elevation).",
                )
            )
        return found
    if check.unit is not None:
        return [
            *found,
            TriangulationFinding(
                "HEIGHT_MODEL_CONTRADICTED",
                f"Tie points lie {check.difference_m:+.1f} m from the height model (median), as if "
                f"its heights were in {check.unit}. Give a height model in metres ([plan] "
                "elevation).",
            ),
        ]
    return [
        *found,
        TriangulationFinding(
            "HEIGHT_MODEL_CONTRADICTED",
            f"Tie points lie {check.difference_m:+.1f} m from the height model (median). Check its "
            "coordinate system and whether its heights count from the geoid ([plan] "
            "elevation_crs).",
        ),
    ]


def _plan(
    block: BlockTies, planned: Sequence[str], missing: Mapping[str, int]
) -> list[TriangulationFinding]:
    flown = set(block.lines)
    left = tuple(line for line in planned if line not in flown)
    found = []
    if missing:
        named = tuple(missing)
        found.append(
            TriangulationFinding(
                "PLAN_CUT_SHORT",
                f"{sum(missing.values())} planned exposures at the ends of lines "
                f"{', '.join(named[:8])}{', ...' if len(named) > 8 else ''} have no image in the "
                "block. The accuracy is that of the parts that were flown.",
                lines=named,
            )
        )
    if not left:
        return found
    return [
        *found,
        TriangulationFinding(
            "PLAN_CUT_SHORT",
            f"{len(left)} of {len(planned)} planned lines have no image in the block: "
            f"{', '.join(left[:8])}{', ...' if len(left) > 8 else ''}. The accuracy is that of the "
            "lines that were flown.",
            lines=left,
        ),
    ]

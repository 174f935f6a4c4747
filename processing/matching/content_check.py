"""Check that frames show the ground that the calibration predicts.

Texture that matches nowhere is no water: frames are swapped, of another exposure, turned or
mirrored, or a head has moved beyond the search range. Frames whose tie points fail are
searched again farther away; what is found there moves the prediction, and what is not is named.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement, vip_mm_from_raw
from processing.geometry.topology import exact_colour_ratio
from processing.matching.patches import INTERPOLATION, MARGIN_PX, match_patches
from processing.matching.texture import has_texture
from processing.matching.tie_point_search import (
    PAN_TO_PAN,
    PairSearch,
    TiePointSettings,
    colour_searches,
    pan_searches,
    usable_pixels,
)
from processing.matching.tie_points import TiePoints
from processing.quality.figures.image import ContentFigures
from processing.rig import Rig

Array = NDArray[np.float64]
Frame = NDArray[Any]

MIN_ATTEMPTED: Final = 40
SUSPICIOUS_SHARE: Final = 0.25
"""A frame of whose positions so few were matched is looked at again."""
MIN_TEXTURED: Final = 100
"""Textured positions of a band from which on hardly a match with green is no accident."""
MISMATCHED_BAND_SHARE: Final = 0.01
"""A band of whose textured positions fewer match green shows something else: of a desert's, with
texture little above noise, 0.02 to 0.2 match, of other ground none."""
MISMATCHED_SHARE: Final = 0.1
"""A frame of whose textured positions so few were matched shows something else."""
AMBIGUOUS_SHARE: Final = 0.1
"""A frame of which so many positions resemble several places has repeated texture, such as rows of
vines: 0.2 and more of them do there, at most 0.02 of a frame that shows other ground."""
WIDE_SEARCH_PX: Final = 60
WIDE_POINTS: Final = 60
MIN_AGREEING: Final = 12
AGREEING_PX: Final = 3.0


@dataclass(frozen=True)
class ContentCheck:
    """Frames that do not show what they should, by sensor name.

    `shifted_px` were found elsewhere, by so much in the VIP (x right, y up); `mismatched` were not
    found although they have texture, with the number of textured positions that were tried.
    """

    shifted_px: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    mismatched: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class WideSearch:
    """Positions (n,) of one frame pair that were looked for far from their prediction.

    `correlated` resemble a place, `distinct` one place only. `differences_mm` (m, 2) is how far
    those that do both lie apart in the VIP, the first frame less the second.
    """

    correlated: NDArray[np.bool_]
    distinct: NDArray[np.bool_]
    differences_mm: Array


NOT_SEARCHED: Final = WideSearch(np.zeros(0, np.bool_), np.zeros(0, np.bool_), np.zeros((0, 2)))


def check_content(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    frames: Mapping[str, Frame],
    tie_points: TiePoints,
    *,
    settings: TiePointSettings | None = None,
) -> ContentCheck:
    """Look again at frames that hardly match any other.

    Args:
        rig: the camera.
        placements: where the frames were expected.
        frames: Level-1 words by sensor name.
        tie_points: what was matched there.
        settings: those it was matched with; None takes the defaults.

    Returns:
        Shifted and mismatched frames; empty where every frame has enough matches.
    """
    settings, image = settings or TiePointSettings(), rig.virtual_image
    pan = {s.name for cone in rig.pan_cones for s in cone.sensors}
    attempted, found = _counts(tie_points)
    unmatched = _suspicious(attempted, found)
    # Green is searched three times as far in PAN pixels: a shifted frame may match it alone.
    apart = _suspicious(*_counts(tie_points, pan)) - unmatched
    suspicious = unmatched | apart
    if not suspicious or image is None:
        return ContentCheck()
    ratio = exact_colour_ratio(rig) or 1.0
    searches = pan_searches(rig, placements, frames, settings)
    searches += colour_searches(rig, placements, frames, settings, ratio)
    tried = tie_points.counts()
    textured = dict.fromkeys(suspicious, 0)
    matched = dict.fromkeys(suspicious, 0)
    searched = dict.fromkeys(suspicious, 0)
    ambiguous = dict.fromkeys(suspicious, 0)
    differences_px: dict[tuple[str, str], Array] = {}
    for search in searches:
        if not len(search.at_b) or search.pair[0] not in frames:
            continue
        names = set(search.pair) & (suspicious if search.kind == PAN_TO_PAN else unmatched)
        rough = _textured(rig, frames, search, settings) if names else np.zeros(0, np.bool_)
        if np.count_nonzero(rough) < MIN_AGREEING:
            continue
        wide = _wide_search(placements, frames, search, rough, settings)
        differences_px[search.pair] = wide.differences_mm / image.pitch_mm
        for name in names:
            textured[name] += int(np.count_nonzero(rough))
            matched[name] += tried[search.pair]
            searched[name] += len(wide.correlated)
            ambiguous[name] += int(np.count_nonzero(wide.correlated & ~wide.distinct))
    shifts = _shifts_px(suspicious, set(attempted) - suspicious, differences_px)
    shifted, mismatched = {}, {}
    for name in sorted(suspicious):
        if textured[name] < MIN_ATTEMPTED:
            continue
        if name in shifts:
            # Matches rare but in place: the frame is where it should be.
            if math.hypot(*shifts[name]) > AGREEING_PX:
                shifted[name] = shifts[name]
        elif (
            name in unmatched
            and matched[name] < MISMATCHED_SHARE * textured[name]
            and (ambiguous[name] < AMBIGUOUS_SHARE * searched[name] or not searched[name])
        ):
            mismatched[name] = textured[name]
    return ContentCheck(shifted, mismatched)


def _shifts_px(
    suspicious: Collection[str],
    others: Collection[str],
    differences_px: Mapping[tuple[str, str], Array],
) -> dict[str, tuple[float, float]]:
    """How far frames lie off, frame by frame from those that lie in place.

    Where none does, all lie off against the one that resembles its neighbours the most.

    Args:
        suspicious: frames to place.
        others: frames in place.
        differences_px: by pair, of matched positions, the first frame less the second, (n, 2).

    Returns:
        x right and y up, px, of the suspicious frames that are found.
    """
    placed = dict.fromkeys(others, (0.0, 0.0))
    points = dict.fromkeys(sorted(suspicious), 0)
    for pair, off in differences_px.items():
        for name in set(pair) & points.keys():
            points[name] += len(off)
    if not placed and any(points.values()):
        placed[max(points, key=lambda name: points[name])] = (0.0, 0.0)
    # The frame with the most points next to placed ones comes first: it carries the others.
    while True:
        near: dict[str, list[Array]] = {}
        for (a, b), off in differences_px.items():
            if a in placed and b in points and b not in placed:
                near.setdefault(b, []).extend(off + placed[a])
            elif b in placed and a in points and a not in placed:
                # The first frame lies where its neighbour shows the ground.
                near.setdefault(a, []).extend(np.array(placed[b]) - off)
        for name in sorted(near, key=lambda name: -len(near[name])):
            shift = _consensus_shift(near[name])
            if shift is not None:
                placed[name] = shift
                break
        else:
            return {name: shift for name, shift in placed.items() if name in points}


def moved_placements(
    placements: Mapping[str, SensorPlacement], check: ContentCheck, pitch_mm: float
) -> dict[str, SensorPlacement]:
    """Predictions for a second search: the shifted frames where they were found.

    Args:
        placements: predictions of the first search, by sensor name.
        check: what the first search found.
        pitch_mm: pixel pitch of the virtual image, to which `check.shifted_px` refers.

    Returns:
        Placements by sensor name, those of shifted frames with a translated layer.
    """
    moved = dict(placements)
    for name, (dx_px, dy_px) in check.shifted_px.items():
        shift = np.eye(3)
        shift[:2, 2] = dx_px * pitch_mm, dy_px * pitch_mm
        moved[name] = dataclasses.replace(placements[name], layer=shift @ placements[name].layer)
    return moved


def content_figures(check: ContentCheck, alternatives: Sequence[str] = ()) -> ContentFigures:
    """Figures of the quality report from the check.

    Args:
        check: shifted and mismatched frames of one exposure.
        alternatives: frames that may show other ground instead of the mismatched ones.

    Returns:
        Names of the sensors, the largest shift in PAN pixels, the most textured positions of a
        mismatched frame; None without any.
    """
    shifts_px = [float(np.hypot(*shift)) for shift in check.shifted_px.values()]
    return ContentFigures(
        mismatched_sensors=tuple(check.mismatched),
        mismatched_positions=max(check.mismatched.values(), default=None),
        mismatched_alternatives=tuple(alternatives),
        shifted_sensors=tuple(check.shifted_px),
        shifted_px=max(shifts_px, default=None),
    )


def _suspicious(attempted: Mapping[str, int], found: Mapping[str, int]) -> set[str]:
    """Frames of whose positions hardly any was matched."""
    return {
        name
        for name, count in attempted.items()
        if count >= MIN_ATTEMPTED and found[name] < SUSPICIOUS_SHARE * count
    }


def _counts(
    tie_points: TiePoints, among: Collection[str] | None = None
) -> tuple[dict[str, int], dict[str, int]]:
    """Positions tried and points matched, by sensor; of pairs `among` some sensors, if given."""
    attempted: dict[str, int] = {}
    found: dict[str, int] = {}
    counts = tie_points.counts()
    for pair, tried in zip(tie_points.pairs, tie_points.attempted, strict=True):
        if among is not None and not set(pair) <= set(among):
            continue
        for name in pair:
            attempted[name] = attempted.get(name, 0) + tried
            found[name] = found.get(name, 0) + counts[pair]
    return attempted, found


def _textured(
    rig: Rig, frames: Mapping[str, Frame], search: PairSearch, settings: TiePointSettings
) -> NDArray[np.bool_]:
    """Which positions (n,) of a search have texture well above noise in both frames."""
    window = settings.window_pp_px if search.kind == PAN_TO_PAN else settings.window_pc_px
    a, b = (rig.sensor(name) for name in search.pair)
    in_b = has_texture(frames[b.name], b, search.at_b, window)
    if search.region is not None:
        return in_b
    middle = search.at_a + (search.step - 1) // 2
    return in_b & has_texture(frames[a.name], a, middle, window * search.step)


def _wide_search(
    placements: Mapping[str, SensorPlacement],
    frames: Mapping[str, Frame],
    search: PairSearch,
    textured: NDArray[np.bool_],
    settings: TiePointSettings,
) -> WideSearch:
    """Look for some of the textured positions up to `WIDE_SEARCH_PX` away."""
    if search.region is not None:
        return NOT_SEARCHED
    a, b = search.pair
    to_pan = search.kind == PAN_TO_PAN
    window = settings.window_pp_px if to_pan else settings.window_pc_px
    reach = WIDE_SEARCH_PX // search.step
    limits = np.array(usable_pixels(placements[b]), dtype=np.int64)
    margin_px = window // 2 + MARGIN_PX + 1 + reach
    inside = (
        (search.at_b[:, 0] >= limits[0] + margin_px)
        & (search.at_b[:, 0] <= limits[1] - margin_px)
        & (search.at_b[:, 1] >= limits[2] + margin_px)
        & (search.at_b[:, 1] <= limits[3] - margin_px)
    )
    rows = np.flatnonzero(textured & inside)
    rows = rows[:: max(1, len(rows) // WIDE_POINTS)]
    if not len(rows):
        return NOT_SEARCHED
    found = match_patches(
        frames[a],
        frames[b],
        np.ascontiguousarray(search.at_a[rows]),
        np.ascontiguousarray(search.at_b[rows]),
        limits,
        search.step,
        window // 2,
        reach,
        frames[a].dtype == np.uint16,
        INTERPOLATION,
    )
    correlated = (found[:, 7] > 0.0) & (found[:, 5] >= settings.min_correlation)
    distinct = found[:, 6] >= settings.min_peak_margin
    good = correlated & distinct
    differences_mm = vip_mm_from_raw(placements[a], found[good, 0:2]) - vip_mm_from_raw(
        placements[b], found[good, 2:4]
    )
    return WideSearch(correlated, distinct, differences_mm)


def _consensus_shift(shifts: list[Array]) -> tuple[float, float] | None:
    """The shift that most points have in common; None where too few have one."""
    if len(shifts) < MIN_AGREEING:
        return None
    every = np.array(shifts)
    near = np.abs(every[:, None] - every[None]).max(axis=2) < AGREEING_PX
    best = near[int(np.argmax(near.sum(axis=1)))]
    if np.count_nonzero(best) < max(MIN_AGREEING, 0.3 * len(every)):
        return None
    x, y = np.median(every[best], axis=0)
    return float(x), float(y)

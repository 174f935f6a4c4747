"""Matches of ground that repeats itself are found by the positions of their exposures."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.calibration.flight.images import FlightImages
from processing.calibration.flight.plausible_pairs import contradicting_pairs
from tests.processing.calibration.flown_tracks import FlightPlan, flown, nominal_rig, true_rig

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Matches = dict[tuple[int, int], Indices]

RIG = nominal_rig([("left", (0.0, 10.0, 0.0)), ("right", (0.0, -10.0, 0.0))])
LINES = ((0.0, 100.0), (180.0, 130.0), (90.0, 100.0))
COMMON_MIN = 15
PATCH_PX = 300.0


def matched(images: FlightImages) -> tuple[list[Array], Matches]:
    """Image points of each image, and matches by common points."""
    tracks = images.tracks
    rows = [np.flatnonzero(tracks.image == k) for k in range(len(images.head))]
    found = {}
    for a, b in combinations(range(len(rows)), 2):
        _, at, bt = np.intersect1d(
            tracks.point[rows[a]], tracks.point[rows[b]], return_indices=True
        )
        if len(at) >= COMMON_MIN:
            found[a, b] = np.column_stack([at, bt])
    return [tracks.px[own] for own in rows], found


def planted(
    px: list[Array],
    true: Matches,
    count: int,
    random: np.random.Generator,
    *,
    points: int = 80,
    quarters: int | None = None,
) -> tuple[list[Array], Matches]:
    """Matches of one patch that lies in two images, turned by a multiple of 90 degrees.

    The multiple is random for each pair, or `quarters` for all.
    """
    px = [one.copy() for one in px]
    pairs = [p for p in combinations(range(len(px)), 2) if p not in true]
    wrong: Matches = {}
    for k in random.permutation(len(pairs))[:count]:
        a, b = pairs[int(k)]
        patch = random.uniform(0.0, PATCH_PX, (points, 2))
        place = random.uniform(0.0, (600.0, 300.0), (2, 2))
        turned = patch - PATCH_PX / 2
        for _ in range(int(random.integers(4)) if quarters is None else quarters):
            turned = turned @ np.array([[0.0, 1.0], [-1.0, 0.0]])
        rows = np.arange(points)
        wrong[a, b] = np.column_stack([rows + len(px[a]), rows + len(px[b])])
        px[a] = np.concatenate([px[a], patch + place[0]])
        px[b] = np.concatenate([px[b], turned + PATCH_PX / 2 + place[1]])
    return px, wrong


@pytest.mark.parametrize("roll_deg", [0.0, 10.0])
def test_planted_pairs_are_found_and_true_ones_stay(roll_deg: float) -> None:
    """Also where the rig file has the master look down, and it is inclined."""
    random = np.random.default_rng(7)
    images = flown(true_rig(RIG, 3), FlightPlan(LINES), 5)
    inclined = nominal_rig(
        [("left", (0.0, 10.0 - roll_deg, 0.0)), ("right", (0.0, -10.0 - roll_deg, 0.0))]
    )
    px, true = matched(images)
    px, wrong = planted(px, true, len(true) // 3, random)
    assert len(wrong) > 50
    found = contradicting_pairs(
        inclined.cones, images.head, images.exposure, images.position_m, px, {**true, **wrong}
    )
    assert not found & true.keys()
    assert len(found & wrong.keys()) > 0.9 * len(wrong)


@pytest.mark.parametrize("quarters", range(4))
def test_planted_pairs_that_agree_on_one_turn_do_not_turn_part_of_the_flight(quarters: int) -> None:
    """As in a mosaic of a few pictures, whose matches are stronger than the true ones."""
    images = flown(true_rig(RIG, 3), FlightPlan(LINES), 5)
    px, true = matched(images)
    random = np.random.default_rng(7)
    count = int(0.3 * len(true))
    px, wrong = planted(px, true, count, random, points=200, quarters=quarters)
    found = contradicting_pairs(
        RIG.cones, images.head, images.exposure, images.position_m, px, {**true, **wrong}
    )
    assert len(found & true.keys()) < 0.1 * len(true)
    assert len(found & wrong.keys()) > 0.9 * len(wrong)


def test_positions_of_other_exposures_contradict_no_single_pair() -> None:
    """They contradict all of them, which is not for this function to decide."""
    random = np.random.default_rng(8)
    images = flown(true_rig(RIG, 3), FlightPlan(LINES), 5)
    px, true = matched(images)
    shuffled = images.position_m[random.permutation(len(images.position_m))]
    found = contradicting_pairs(RIG.cones, images.head, images.exposure, shuffled, px, true)
    assert len(found) < 0.5 * len(true)


def test_without_matches_there_is_nothing_to_contradict() -> None:
    images = flown(true_rig(RIG, 3), FlightPlan(LINES), 5)
    px, _ = matched(images)
    assert not contradicting_pairs(
        RIG.cones, images.head, images.exposure, images.position_m, px, {}
    )

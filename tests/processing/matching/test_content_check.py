"""Where frames lie that hardly match their neighbours, from how far pairs of them lie apart."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.matching.content_check import _shifts_px

Array = NDArray[np.float64]


def apart(
    true_px: dict[str, tuple[float, float]], *pairs: str, points: int = 20
) -> dict[tuple[str, str], Array]:
    """Differences of matched positions where frames lie off by `true_px`, a tenth of a px noise."""
    random = np.random.default_rng(5)
    return {
        (a, b): np.subtract(true_px[a], true_px[b]) + random.normal(0.0, 0.1, (points, 2))
        for a, b in pairs
    }


def test_frames_are_placed_by_neighbours_that_were_placed_before() -> None:
    true = {"A": (0.0, 0.0), "B": (7.0, -9.0), "C": (-20.0, 30.0), "D": (-41.0, 2.0)}
    found = _shifts_px({"B", "C", "D"}, {"A"}, apart(true, "AB", "CB", "CD"))
    assert set(found) == {"B", "C", "D"}
    for name, shift in found.items():
        # By what a frame lies off it goes back.
        assert shift == pytest.approx((-true[name][0], -true[name][1]), abs=0.2)


def test_where_no_frame_is_in_place_all_go_by_the_one_with_most_points() -> None:
    true = {"A": (3.0, 4.0), "B": (7.0, -9.0), "C": (-20.0, 30.0), "D": (1.0, 2.0)}
    some = apart(true, "AB", "BC")
    found = _shifts_px({"A", "B", "C", "D"}, (), some)
    assert found["B"] == (0.0, 0.0) and set(found) == {"A", "B", "C"}
    assert found["A"] == pytest.approx((4.0, -13.0), abs=0.2)
    assert found["C"] == pytest.approx((27.0, -39.0), abs=0.2)
    assert _shifts_px({"A", "B"}, (), {}) == {}


def test_a_frame_that_resembles_nothing_is_not_placed_and_carries_no_other() -> None:
    true = {"A": (0.0, 0.0), "B": (7.0, -9.0), "C": (-20.0, 30.0)}
    pairs = apart(true, "AB", "BC")
    pairs["A", "B"] = np.random.default_rng(1).uniform(-60.0, 60.0, (20, 2))
    assert _shifts_px({"B", "C"}, {"A"}, pairs) == {}
    few = apart(true, "AB", points=11)
    assert _shifts_px({"B"}, {"A"}, few) == {}


def test_the_points_of_all_neighbours_in_place_count_together() -> None:
    true = {"A": (0.0, 0.0), "B": (7.0, -9.0), "C": (0.0, 0.0)}
    found = _shifts_px({"B"}, {"A", "C"}, apart(true, "AB", "BC", points=7))
    assert found["B"] == pytest.approx((-7.0, 9.0), abs=0.2)

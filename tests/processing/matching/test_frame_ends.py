"""Tie points along the ends of PAN frames."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.geometry.placement import nominal_placements, raw_from_vip_mm, vip_mm_from_raw
from processing.matching.frame_ends import END_PX, WINDOW_PX, match_frame_ends
from processing.matching.tie_points import PAN_TO_COLOUR, TiePoints, match_tie_points
from processing.rig import find_rig

pytestmark = pytest.mark.trust

X = find_rig("ultracam-x-mini")
PLACES = nominal_placements(X, {}, {})
Frames = dict[str, NDArray[Any]]


def _texture(xy: NDArray[Any]) -> NDArray[Any]:
    """Waves of several directions, on the ground of the virtual image (mm)."""
    random = np.random.default_rng(5)
    seen = np.zeros(len(xy))
    for _ in range(24):
        frequency, phase = random.uniform(-2 * np.pi * 6, 2 * np.pi * 6, 2), random.uniform(0, 6.28)
        seen += np.cos(xy @ frequency + phase)
    return 8000.0 + 900.0 * seen


def _frames(*names: str) -> Frames:
    found = {}
    for name in names:
        s = X.sensor(name)
        columns, rows = np.meshgrid(np.arange(s.width_px), np.arange(s.height_px))
        raw = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
        seen = _texture(vip_mm_from_raw(PLACES[name], raw)).reshape(columns.shape)
        found[name] = np.asarray(np.rint(seen), np.uint16) & np.uint16(0xFFFC)
    return found


@pytest.fixture(scope="module")
def frames() -> Frames:
    return _frames("SU03", "G")


@pytest.fixture(scope="module")
def regular(frames: Frames) -> TiePoints:
    return match_tie_points(X, PLACES, frames)


def test_ends_without_regular_points_have_points_of_their_own(
    frames: Frames, regular: TiePoints
) -> None:
    ends = match_frame_ends(X, PLACES, frames, regular)
    number = ends.names.index("SU03")
    assert len(ends) > 40 and set(ends.sensor_a) == {number}
    assert set(ends.kind) == {PAN_TO_COLOUR} and ends.pairs == regular.pairs
    height, reach = X.sensor("SU03").height_px, 3 * (WINDOW_PX // 2 + 1)
    near_low = ends.raw_a[:, 1] > height - 1 - END_PX
    assert np.count_nonzero(near_low) > 20
    # Their windows lie within the last 50 rows, those of regular points hardly reach these.
    assert ends.raw_a[near_low, 1].min() - reach > height - 55
    there = raw_from_vip_mm(PLACES["G"], vip_mm_from_raw(PLACES["SU03"], ends.raw_a))
    np.testing.assert_allclose(np.median(there - ends.raw_b, axis=0), 0.0, atol=0.02)


def test_rows_shifted_at_the_end_shift_its_points_alone(frames: Frames, regular: TiePoints) -> None:
    frame = frames["SU03"].copy()
    frame[792:] = frames["SU03"][789:829]
    ends = match_frame_ends(X, PLACES, {**frames, "SU03": frame}, regular)
    there = raw_from_vip_mm(PLACES["G"], vip_mm_from_raw(PLACES["SU03"], ends.raw_a))
    rows_off = 3.0 * (there - ends.raw_b)[:, 1]
    low = ends.raw_a[:, 1] > 790
    # The first rows of a window are in place.
    assert 2.0 < abs(float(np.median(rows_off[low]))) < 3.1
    assert abs(float(np.median(rows_off[ends.raw_a[:, 1] < 700]))) < 0.05


def test_ends_with_regular_points_are_not_matched_again(frames: Frames, regular: TiePoints) -> None:
    s = X.sensor("SU03")
    random = np.random.default_rng(1)
    at = np.concatenate(
        [
            np.column_stack([random.uniform(0, s.width_px, 40), np.full(40, row)])
            for row in (10.0, s.height_px - 10.0)
        ]
        + [
            np.column_stack([np.full(40, column), random.uniform(0, s.height_px, 40)])
            for column in (10.0, s.width_px - 10.0)
        ]
    )
    everywhere = replace(
        regular.only(np.arange(len(regular)) < len(at)),
        raw_a=at,
        raw_b=at,
        sensor_a=np.full(len(at), regular.names.index("SU03")),
        sensor_b=np.full(len(at), regular.names.index("G")),
    )
    assert len(match_frame_ends(X, PLACES, frames, everywhere)) == 0


def test_without_the_colour_master_there_are_none(frames: Frames, regular: TiePoints) -> None:
    assert len(match_frame_ends(X, PLACES, {"SU03": frames["SU03"]}, regular)) == 0

"""What of an image is valid, in a few boxes: areas against the masks they were made of."""

from __future__ import annotations

import json

import numpy as np
import pytest

from processing.quality.valid_area import (
    BOXES_MAX,
    CELLS,
    ValidArea,
    area_of,
    as_json,
    boxes_of,
    from_json,
    gap_cells,
    grid_of,
)

pytestmark = pytest.mark.trust


def area_from(mask: np.ndarray, saturated_bit: int = 0) -> ValidArea:
    grid = grid_of(mask.shape[1], mask.shape[0])
    return area_of({"pan": gap_cells(mask, *grid, saturated_bit=saturated_bit)})


def test_a_complete_image_takes_no_box_and_an_empty_one_takes_one() -> None:
    full_area = area_from(np.ones((300, 400), np.uint8))
    assert (full_area.gaps, full_area.share("pan")) == ({}, 1.0)
    empty = area_from(np.zeros((300, 400), np.uint8))
    assert empty.gaps == {"pan": ((0, 0, CELLS, CELLS * 3 // 4),)}
    assert empty.share("pan") == 0.0


def test_a_missing_head_is_one_box_with_its_area_and_place() -> None:
    mask = np.ones((1300, 2000), np.uint8)
    mask[100:533, 1400:1900] = 0
    area = area_from(mask)
    ((left, top, right, bottom),) = area.gaps["pan"]
    assert (left / area.columns, right / area.columns) == pytest.approx((0.7, 0.95), abs=0.003)
    assert (top / area.rows, bottom / area.rows) == pytest.approx((1 / 13, 0.41), abs=0.005)
    assert 1.0 - area.share("pan") == pytest.approx(433 * 500 / mask.size, abs=0.003)


def test_a_gap_of_any_outline_keeps_its_area_within_few_boxes() -> None:
    y, x = np.mgrid[0:800, 0:1200]
    mask = ((x - 500) ** 2 + (y - 380) ** 2 > 210**2).astype(np.uint8)
    area = area_from(mask)
    assert len(area.gaps["pan"]) <= BOXES_MAX
    assert 1.0 - area.share("pan") == pytest.approx(1.0 - mask.mean(), rel=0.04)


def test_saturated_roofs_are_no_gap_and_a_saturated_field_is() -> None:
    mask = np.ones((1600, 2400), np.uint8)
    mask[200:215, 300:330] |= 0x80
    assert area_from(mask, 0x80).gaps == {}
    mask[800:1200, 1200:2000] |= 0x80
    assert 1.0 - area_from(mask, 0x80).share("pan") == pytest.approx(
        400 * 800 / mask.size, rel=0.03
    )
    assert area_from(mask).gaps == {}


def test_noise_never_grows_beyond_its_bound() -> None:
    cells = np.random.default_rng(1).random((160, 240)) < 0.5
    assert len(boxes_of(cells)) <= BOXES_MAX


def test_a_box_once_written_is_read_again() -> None:
    area = ValidArea(240, 160, {"pan": ((0, 0, 80, 60), (80, 0, 90, 10)), "red": ((3, 4, 5, 6),)})
    assert from_json(json.loads(json.dumps(as_json(area)))) == area


@pytest.mark.parametrize(
    "content",
    [
        None,
        [],
        {},
        {"columns": 240, "rows": 160},
        {"columns": 240, "rows": 0, "gaps": {}},
        {"columns": 10**9, "rows": 160, "gaps": {}},
        {"columns": 240, "rows": 160, "gaps": {"pan": [[0, 0, 241, 5]]}},
        {"columns": 240, "rows": 160, "gaps": {"pan": [[5, 0, 5, 5]]}},
        {"columns": 240, "rows": 160, "gaps": {"pan": [[0, 0, "x", 5]]}},
        {"columns": 240, "rows": 160, "gaps": {"pan": 7}},
    ],
)
def test_what_is_no_valid_area_is_not_believed(content: object) -> None:
    assert from_json(content) is None

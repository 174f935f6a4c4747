"""Cells of gaps: majorities, coarser cells, and what is refused as JSON, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from processing.quality.report import Flag
from processing.quality.valid_area import _coarser, _smoothed, boxes_of, from_json
from tests.processing.quality.test_report import evaluated


@pytest.mark.parametrize(("count", "saturated"), [(12, False), (13, True)])
def test_a_cell_follows_the_majority_of_the_25_around_it(count: int, saturated: bool) -> None:
    cells = np.zeros((9, 11), np.bool_)
    window = np.arange(25) < count
    cells[2:7, 3:8] = window.reshape(5, 5)
    cells[0, :] = cells[:, 0] = True
    assert bool(_smoothed(cells)[4, 5]) == saturated
    assert _smoothed(cells).shape == cells.shape
    # Beyond the image nothing is saturated: of the corner's 25 cells 9 lie in it.
    assert not _smoothed(np.ones((9, 11), np.bool_))[0, 0]
    assert _smoothed(np.ones((9, 11), np.bool_))[1, 1]


def test_a_coarser_cell_is_a_gap_where_half_of_its_four_are() -> None:
    cells = np.array([[1, 0, 0, 0, 1], [1, 0, 1, 0, 0], [1, 0, 1, 1, 1]], np.bool_)
    assert _coarser(cells).tolist() == [[True, False, True], [True, True, True]]


def test_boxes_of_coarser_cells_end_at_the_image() -> None:
    cells = np.zeros((7, 9), np.bool_)
    cells[::2, ::2] = True
    boxes = boxes_of(cells, most=1)
    assert len(boxes) <= 1
    assert all(right <= 9 and bottom <= 7 for _, _, right, bottom in boxes)


@pytest.mark.parametrize(
    "content",
    [
        {"columns": "240", "rows": 160, "gaps": {}},
        {"columns": 240, "rows": "160", "gaps": {}},
        {"columns": 240, "rows": 160, "gaps": []},
        {"columns": 240, "rows": 241, "gaps": {}},
        {"columns": 0, "rows": 160, "gaps": {}},
        {"columns": 240, "rows": 160, "gaps": {"pan": [[0, 0, 5, 161]]}},
        {"columns": 240, "rows": 160, "gaps": {"pan": [[0, 5, 5, 5]]}},
        {"columns": 240, "rows": 160, "gaps": {"pan": [[-1, 0, 5, 5]]}},
        {"columns": 240, "rows": 160, "gaps": {"pan": [[0, -1, 5, 5]]}},
        {"columns": 240, "rows": 160, "gaps": {"pan": [[0, 0, 5]]}},
        {"columns": 240, "rows": 160, "gaps": {7: []}},
    ],
)
def test_an_area_that_does_not_fit_its_grid_is_refused(content: object) -> None:
    assert from_json(content) is None


def test_an_area_as_large_as_its_grid_is_taken() -> None:
    content = {"columns": 240, "rows": 240, "gaps": {"pan": [[0, 0, 240, 240]]}}
    area = from_json(content)
    assert area is not None and area.share("pan") == 0.0
    one = from_json({"columns": 1, "rows": 1, "gaps": {}})
    assert one is not None and one.share("pan") == 1.0


@pytest.mark.parametrize(
    ("causes", "slipped", "raised"),
    [(None, None, True), ("2", None, True), ("2", "1", True), ("2", "2", False)],
)
def test_a_layer_that_a_slip_explains_is_no_expired_calibration(
    causes: str | None, slipped: str | None, raised: bool
) -> None:
    figures = {
        "platform_test": 2.0,
        "platform_causes": causes,
        "platform_shift_px": 1.5,
        "platform_shift_head": "2",
        "slip_cone": slipped,
    }
    report = evaluated(figures)
    assert (Flag.CALIBRATION_EXPIRED in report.flags) == raised

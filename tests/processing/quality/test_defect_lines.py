"""Single lines that show no ground, planted in means of bundles and in frames."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.image.line_means import LineMeans, line_means
from processing.quality.defect_lines import (
    DefectLine,
    _average_differences,
    _worst,
    defect_line_figures,
    defect_lines,
)
from processing.rig import find_rig

pytestmark = pytest.mark.trust

Array = NDArray[np.float32]
BUNDLES, LINES, AT = 20, 120, 50


def ground(seed: int = 1, *, contrast: float = 0.2) -> Array:
    """Means of ground that changes from bundle to bundle, and little from line to line."""
    random = np.random.default_rng(seed)
    along = np.cumsum(random.normal(0.0, 0.004, (BUNDLES, LINES)), axis=1)
    bundles = random.normal(0.0, contrast, (BUNDLES, 1))
    return np.asarray(1000.0 * np.exp(along + bundles), np.float32)


def with_line(values: Array | float, *, width: int = 1, means: Array | None = None) -> Array:
    changed = ground() if means is None else means.copy()
    changed[:, AT : AT + width] = values
    return changed


def test_a_line_stuck_at_a_value_among_those_of_the_ground_is_found() -> None:
    assert _worst(ground()) is None
    found = _worst(with_line(1000.0))
    assert found is not None and found[0] == AT
    difference = np.abs(1000.0 / ground()[:, AT - 1] - 1.0)
    assert found[1] == pytest.approx(np.median(difference), abs=0.02)


def test_a_line_that_differs_by_less_than_the_limit_is_not_found() -> None:
    own = ground()[:, AT : AT + 1]
    for factor, found in ((1.06, True), (0.94, True), (1.03, False), (0.97, False)):
        assert (_worst(with_line(factor * own)) is not None) is found


def test_an_edge_and_a_line_that_a_lens_spreads_are_ground() -> None:
    plain = ground()
    edge = plain.copy()
    edge[:, AT:] *= 1.5
    spread = plain.copy()
    spread[:, AT - 1 : AT + 2] *= (1.12, 1.3, 1.12)
    assert _worst(edge) is None
    assert _worst(spread) is None
    assert _worst(with_line(1.3 * plain[:, AT : AT + 2], width=2)) is None


def test_a_narrow_road_that_goes_over_from_one_line_to_the_next_is_ground() -> None:
    means = ground()
    means[:5, AT + 1] *= 1.9
    means[5:12, AT] *= 1.9
    assert _worst(means) is None
    means[:12, AT] = means[:12, AT - 1] * 1.9
    means[:12, AT + 1] = means[:12, AT - 1]
    found = _worst(means)
    assert found is not None and found[0] == AT


def test_differences_are_averages_over_the_bundles() -> None:
    means = np.full((4, 9), 100.0, np.float32)
    means[:, 4] = (110.0, 90.0, 100.0, 120.0)
    expected = [0.0, 0.05, 0.1, 0.05, 0.0]
    assert _average_differences(means) == pytest.approx(expected, abs=3e-3)


def test_lines_of_frames_are_named_with_their_number() -> None:
    sensors = find_rig("ultracam-x-mini").master_sensors
    rows = LineMeans(with_line(1000.0), ground(), 7)
    columns = LineMeans(ground(), with_line(300.0), 7)
    found = defect_lines(sensors, {sensors[0].name: rows, sensors[1].name: columns})
    assert [(line.sensor, line.axis, line.at) for line in found] == [
        (sensors[1].name, "columns", AT),
        (sensors[0].name, "rows", AT + 7),
    ]
    figures = defect_line_figures(found)
    assert figures is not None and figures.defect_line_at == AT
    assert figures.defect_line == found[0].relative
    assert defect_line_figures(()) is None


def test_a_stuck_column_of_a_frame_is_found() -> None:
    (sensor,) = find_rig("ultracam-l-mini").cone("0").sensors
    random = np.random.default_rng(3)
    hills = random.normal(0.0, 200.0, (sensor.height_px // 32, 1)).repeat(32, axis=0)
    frame = 8000.0 + hills + random.normal(0.0, 30.0, (len(hills), 700))
    frame[:, 333] = 8100.0
    means = line_means(np.asarray(frame, np.uint16), (0, len(frame) - 1))
    found = defect_lines([sensor], {sensor.name: means})
    assert not found  # 200 of 8,000 is less than the limit
    frame[:, 333] = 9000.0
    means = line_means(np.asarray(frame, np.uint16), (0, len(frame) - 1))
    (line,) = defect_lines([sensor], {sensor.name: means})
    assert line == DefectLine(sensor.name, "columns", 333, line.relative)

"""The share of the finest detail where a part of the frame holds no data."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from processing.image.sharpness import sharpness
from processing.rig import find_rig

pytestmark = pytest.mark.trust

SENSOR = find_rig("ultracam-x-mini").master_sensors[0]


def _ground(blur_px: float = 1.2) -> np.ndarray:
    random = np.random.default_rng(4)
    ground = gaussian_filter(random.normal(0.0, 4000.0 * blur_px, (360, 400)), blur_px)
    return np.asarray(9000.0 + ground, np.uint16)


@pytest.mark.parametrize(
    "lost",
    [
        *(np.s_[300:], np.s_[:60], np.s_[100:130]),
        *(np.s_[:, 300:], np.s_[:, :60], np.s_[:, 170:230], np.s_[200:260, 150:]),
    ],
)
def test_where_data_end_is_no_detail(lost: tuple[slice, ...]) -> None:
    frame = _ground()
    rows = (0, len(frame) - 1)
    whole = sharpness(SENSOR, frame, rows)
    frame[lost] = 0
    found = sharpness(SENSOR, frame, rows)
    assert found == pytest.approx(whole, abs=0.02)
    frame[:] = 0
    assert sharpness(SENSOR, frame, rows) == (None, None)


def test_all_parts_of_a_frame_count() -> None:
    sharp, blurred = _ground(0.7), _ground(2.0)
    rows = (0, len(sharp) - 1)
    ends = [sharpness(SENSOR, frame, rows) for frame in (blurred, sharp)]
    found = []
    for part in range(4):
        frame = blurred.copy()
        frame[:, 100 * part : 100 * part + 100] = sharp[:, 100 * part : 100 * part + 100]
        found.append(sharpness(SENSOR, frame, rows))
    assert (np.array(ends[0]) < np.min(found, axis=0)).all()
    assert (np.max(found, axis=0) < np.array(ends[1])).all()
    assert np.ptp(found, axis=0) == pytest.approx([0.0, 0.0], abs=0.05)


@pytest.mark.parametrize("columns", [(0, 33), (40, 75), (300, 399)])
def test_narrow_strips_are_judged(columns: tuple[int, int]) -> None:
    frame = _ground()
    rows = (0, len(frame) - 1)
    whole = sharpness(SENSOR, frame, rows)
    assert sharpness(SENSOR, frame, rows, columns) == pytest.approx(whole, abs=0.05)


def test_a_strip_is_judged_where_it_lies() -> None:
    sharp, frame = _ground(0.7), _ground(2.0)
    frame[:, 300:] = sharp[:, 300:]
    rows = (0, len(frame) - 1)
    assert sharpness(SENSOR, frame, rows, (300, 399)) == sharpness(SENSOR, sharp, rows, (300, 399))
    frame[180:] = sharp[180:]
    low = (180, len(frame) - 1)
    assert sharpness(SENSOR, frame, low) == sharpness(SENSOR, sharp, low)

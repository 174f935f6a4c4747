"""The share of the finest detail where a part of the frame holds no data."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from processing.image.sharpness import sharpness
from processing.rig import find_rig

pytestmark = pytest.mark.trust

SENSOR = find_rig("ultracam-x-mini").master_sensors[0]


@pytest.mark.parametrize("lost", [slice(300, None), slice(None, 60), slice(100, 130)])
def test_lines_without_data_are_no_detail(lost: slice) -> None:
    random = np.random.default_rng(4)
    ground = gaussian_filter(random.normal(0.0, 4000.0, (360, 400)), 1.2)
    frame = np.asarray(8000.0 + ground, np.uint16)
    rows = (0, len(frame) - 1)
    whole = sharpness(SENSOR, frame, rows)
    frame[lost] = 0
    found = sharpness(SENSOR, frame, rows)
    assert found == pytest.approx(whole, abs=0.02)
    frame[:] = 0
    assert sharpness(SENSOR, frame, rows) == (None, None)

"""Words that were not read out, planted in frames."""

from __future__ import annotations

import numpy as np
import pytest

from processing.quality.readout import blank_unread, unread_figures
from processing.radiometry.level1 import unread_fraction
from processing.rig import find_rig

MINI = find_rig("ultracam-x-mini")
SENSOR = MINI.sensor("SU00")


def frame(value: int = 1500) -> np.ndarray:
    return np.full((SENSOR.height_px, SENSOR.width_px), value, np.uint16)


def test_every_row_is_looked_at_in_every_256th_column() -> None:
    raw = frame()
    # 1248 columns: 0, 256, 512, 768 and 1024; of them two are lost in one row.
    raw[7, 200:520] = 0
    share = 2.0 / (5 * SENSOR.height_px)
    assert unread_fraction(SENSOR, raw) == pytest.approx(share)
    found = unread_figures({"SU00": share, "SU01": 0.0, "R": None})
    assert found is not None and found.unread_worst_sensor == "SU00"
    assert found.unread_worst_fraction == share
    assert unread_figures({"SU00": None}) is None


def test_runs_of_16_values_that_were_not_read_out_become_no_data() -> None:
    raw = frame()
    raw[3:6] = 0
    raw[10, 100:116] = 0
    raw[12, 100:115] = 0
    corrected = frame(9000)
    assert not blank_unread(SENSOR, raw, 0.0009, corrected)
    assert not blank_unread(SENSOR, raw, None, corrected)
    assert (corrected == 9000).all()
    assert blank_unread(SENSOR, raw, unread_fraction(SENSOR, raw), corrected)
    expected = frame(9000)
    expected[3:6] = 0
    expected[10, 100:116] = 0
    assert (corrected == expected).all()

"""How much of an overlap is too bright to be matched."""

from __future__ import annotations

import numpy as np
import pytest

from processing.geometry.placement import nominal_placements
from processing.matching.tie_point_search import saturated_window_fraction
from processing.rig import find_rig

RIG = find_rig("ultracam-x-mini")
START = nominal_placements(RIG, dict.fromkeys(RIG.probes, 20.0), {})


def test_the_share_of_matching_windows_with_saturated_pixels_is_reported() -> None:
    frames = {s.name: np.full((s.height_px, s.width_px), 2000, np.uint16) for s in RIG.sensors}
    assert saturated_window_fraction(RIG, START, frames, ("SU03", "SU11")) == 0.0
    # A single saturated pixel spoils its window: one in every other row of windows.
    frames["SU03"][::38, ::19] |= 1
    share = saturated_window_fraction(RIG, START, frames, ("SU03", "SU11"))
    assert share == pytest.approx(0.5, abs=0.05)
    frames["SU11"] |= 1
    assert saturated_window_fraction(RIG, START, frames, ("SU03", "SU11")) == 1.0


def test_sensors_that_do_not_overlap_share_nothing() -> None:
    frames = {s.name: np.ones((s.height_px, s.width_px), np.uint16) for s in RIG.sensors}
    assert saturated_window_fraction(RIG, START, frames, ("SU00", "SU03")) is None

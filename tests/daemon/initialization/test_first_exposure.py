"""`syntopic init` to the first stored exposure, with fake cameras of Aravis and an emulated
receiver.

Figures: docs/reference/results/processing.md, record `first-exposure`.
"""

from __future__ import annotations

import pytest

from benchmarks import first_exposure

LIMIT_S = 180.0
"""Time limit of one arrangement on a busy machine."""


@pytest.mark.system
@pytest.mark.peer
@pytest.mark.realtime
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("arrangement", "heads"),
    [
        pytest.param(*one, marks=[] if one[0] == "nadir-oblique" else [pytest.mark.soak])
        for one in first_exposure.ARRANGEMENTS
    ],
)
def test_the_first_exposure_is_stored_within_minutes(arrangement: str, heads: int) -> None:
    needed = first_exposure.missing()
    if needed is not None:
        pytest.skip(needed)
    found = first_exposure.measure(arrangement, heads)
    print(found)
    assert found.check in ("pass", "waiting")
    assert found.frames == heads
    assert "UNCALIBRATED" in found.flags and found.verdict != "good"
    assert "FRAME_MISSING" not in found.flags and "NOT_PROCESSED" not in found.flags
    assert found.total_s < LIMIT_S

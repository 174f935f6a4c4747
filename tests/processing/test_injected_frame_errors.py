"""Frames without light, and blocks of rows that are sent twice: both once went as `good`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from benchmarks.silent_errors.exposures import healthy
from processing.quality.figures.image import DarkFrameFigures
from processing.quality.report import Verdict
from processing.rig import Sensor
from tests.processing.injected_errors import rendered

pytestmark = [pytest.mark.trust, pytest.mark.timeout(300)]


@pytest.mark.parametrize(
    ("rig", "sensor", "first", "count"),
    [
        ("ultracam-x-mini", "SU00", 300, 100),
        ("ultracam-l-mini", "SU00", 900, 200),
        ("ultracam-l-mini", "N", 400, 60),
    ],
)
def test_a_block_of_rows_that_is_sent_twice_is_named_with_both_places(
    rig: str, sensor: str, first: int, count: int
) -> None:
    def sent_twice(frame: Any) -> Any:
        frame[first : first + count] = frame[first - count : first]
        return frame

    outcome = rendered(rig).with_frame(sensor, sent_twice).outcome()
    assert outcome.verdict == "refly" and "FRAME_CORRUPT" in outcome.flags
    assert outcome.figure("repeated_lines_sensor") == sensor
    assert (outcome.figure("repeated_lines_first"), outcome.figure("repeated_lines")) == (
        first,
        count,
    )
    assert outcome.figure("repeated_lines_source") == first - count
    assert "sent twice" in outcome.sentences


def dark(sensor: Sensor, noise_dn: float = 3.0) -> Callable[[Any], Any]:
    """Noise about black: the shutter was closed."""

    def change(frame: Any) -> Any:
        noise = np.random.default_rng(3).normal(sensor.black_dn, noise_dn, frame.shape)
        return np.clip(np.rint(noise), 0, 4095).astype(np.uint16)

    return change


@pytest.mark.parametrize(
    ("rig", "sensor"),
    [
        *(("ultracam-x-mini", name) for name in ("SU00", "SU20", "G", "N")),
        *(("ultracam-l-mini", name) for name in ("SU00", "SU10", "RGB", "N")),
        *(("dmc-mini", name) for name in ("P2", "R")),
    ],
)
def test_a_head_without_light_is_named_and_no_neighbour_is(rig: str, sensor: str) -> None:
    exposure = rendered(rig)
    outcome = exposure.with_frame(sensor, dark(exposure.rig.sensor(sensor))).outcome()
    assert outcome.verdict == "refly" and "FRAME_CORRUPT" in outcome.flags
    assert outcome.figure("dark_sensors") == sensor and outcome.figure("dark_noises") < 6.0
    assert f"No light in the frame of {sensor}" in outcome.sentences
    for accused in ("mismatched_sensors", "blurred_sensor", "gain_outlier", "signal_step_sensor"):
        assert outcome.figure(accused) is None, outcome.sentences
    assert "BLUR" not in outcome.flags and "OVEREXPOSED" not in outcome.flags, outcome.sentences


@pytest.mark.parametrize("sensors", [("nadir",), ("8",), ("5", "7")])
def test_a_dark_head_that_shares_no_ground_is_named(sensors: tuple[str, ...]) -> None:
    exposure = healthy("midas-mini", 0)
    assert exposure.process().report.figures.of(DarkFrameFigures).dark_sensors == ()
    for name in sensors:
        exposure = exposure.with_frame(name, dark(exposure.rig.sensor(name)))
    report = exposure.process().report
    assert report.figures.of(DarkFrameFigures).dark_sensors == sensors
    assert report.verdict is Verdict.REFLY

"""Wrong radiometry and sharpness of one head that once went as `good`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from processing.quality.words import wrong_format
from tests.processing.planted import Planted, rendered

pytestmark = [pytest.mark.trust, pytest.mark.timeout(300)]

BLACK_DN = 64


@pytest.fixture(scope="module")
def healthy() -> Planted:
    return rendered("ultracam-x-mini")


def _gain(factor: float, first: int = 0, axis: int = 0) -> Callable[[Any], Any]:
    """Signal above black times a factor, from one line on."""

    def change(frame: Any) -> Any:
        lines = frame if axis == 0 else frame.T
        signal = (lines[first:].astype(np.float64) - BLACK_DN) * factor + BLACK_DN
        lines[first:] = np.clip(np.rint(signal), 0, 4095)
        return frame

    return change


def _banded(dn: int, period: int) -> Callable[[Any], Any]:
    def change(frame: Any) -> Any:
        bands = dn * ((np.arange(len(frame)) // period) % 2)
        return np.clip(frame.astype(np.int32) + bands[:, None], 0, 4095).astype(np.uint16)

    return change


@pytest.mark.parametrize(
    ("sensor", "axis", "line", "factor"),
    [("SU11", 0, 416, 1.08), ("SU00", 1, 600, 1.08), ("G", 0, 400, 1.2), ("SU30", 0, 300, 0.9)],
)
def test_a_gain_step_within_a_frame_is_named_with_its_line(
    healthy: Planted, sensor: str, axis: int, line: int, factor: float
) -> None:
    outcome = healthy.with_frame(sensor, _gain(factor, line, axis)).outcome()
    assert outcome.verdict == "usable" and "FRAME_CORRUPT" in outcome.flags
    assert outcome.figure("signal_step_sensor") == sensor
    assert outcome.figure("signal_step_axis") == ("rows", "columns")[axis]
    assert abs(outcome.figure("signal_step_at") - (line - 1)) <= 1
    assert outcome.figure("signal_step") == pytest.approx(factor - 1.0, abs=0.03)


def test_banding_is_named(healthy: Planted) -> None:
    outcome = healthy.with_frame("SU10", _banded(30, 20)).outcome()
    assert outcome.figure("signal_step_sensor") == "SU10" and "banding" in outcome.sentences


@pytest.mark.parametrize("factor", [0.5, 0.85, 1.3])
def test_a_pan_head_with_another_exposure_is_named_and_draws_no_other(
    healthy: Planted, factor: float
) -> None:
    clean = healthy.outcome()
    outcome = healthy.with_frame("SU11", _gain(factor)).outcome()
    assert outcome.verdict == "usable" and outcome.figure("gain_outlier") == "SU11"
    assert outcome.figure("gain_outlier_signal") == pytest.approx(factor, rel=0.02)
    both = (outcome.product.pan > 0) & (clean.product.pan > 0)
    ratio = np.median(outcome.product.pan[both] / clean.product.pan[both])
    assert ratio == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize(("sensor", "size"), [("SU11", (0, 0)), ("SU30", (0, 0)), ("SU02", (1, 5))])
def test_a_blurred_or_smeared_head_is_named(
    healthy: Planted, sensor: str, size: tuple[int, int]
) -> None:
    def blurred(frame: Any) -> Any:
        if size == (0, 0):
            return cv2.GaussianBlur(frame, size, 1.5)
        return cv2.blur(frame, size)

    outcome = healthy.with_frame(sensor, blurred).outcome()
    assert outcome.verdict == "usable" and "BLUR" in outcome.flags
    assert outcome.figure("blurred_sensor") == sensor and outcome.figure("blurred_ratio") < 0.6


@pytest.mark.parametrize(
    ("named", "change"),
    [("left-justified", lambda f: f << 4), ("byte-swapped", lambda f: f.byteswap())],
)
def test_words_of_another_format_are_named(
    healthy: Planted, named: str, change: Callable[[Any], Any]
) -> None:
    outcome = healthy.with_frame("SU20", change).outcome()
    assert outcome.verdict == "refly" and outcome.figure("word_format") == named
    assert outcome.figure("word_format_sensors") == "SU20" and "pixel format" in outcome.sentences


def test_formats_of_words_by_the_rig_file(healthy: Planted) -> None:
    frame = healthy.frames["SU00"]
    right = healthy.rig.sensor("SU00")
    left = replace(right, justified="left")
    assert wrong_format(right, frame) is None and wrong_format(left, frame << 4) is None
    assert wrong_format(left, frame) == "right-justified"
    assert wrong_format(right, frame + np.uint16(4096)) == "beyond 12 bits"

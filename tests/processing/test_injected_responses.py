"""PAN heads that respond otherwise to light: an offset, another tone curve, a slow change."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.processing.injected_errors import BLACK_DN, InjectedExposure, rendered

pytestmark = [pytest.mark.trust, pytest.mark.timeout(300)]

STITCHED = {"ultracam-x-mini": "SU21", "ultracam-l-mini": "SU10", "dmc-mini": "P3"}


def check_response(exposure: InjectedExposure, sensor: str, change: Callable[[Any], Any]) -> Any:
    """The outcome, after a check that this sensor is named, and no other as the only one."""
    outcome = exposure.with_frame(sensor, change).outcome()
    assert outcome.verdict == "usable" and "FRAME_CORRUPT" in outcome.flags
    others = outcome.figure("response_alternatives") or ""
    named = {outcome.figure("response_sensor"), *others.split(", ")}
    assert sensor in named, outcome.sentences
    assert outcome.figure("gain_outlier") in (None, sensor)
    return outcome


@pytest.mark.parametrize(("rig", "sensor"), STITCHED.items())
def test_an_offset_of_a_whole_pan_frame_is_named(rig: str, sensor: str) -> None:
    def offset(frame: Any) -> Any:
        return np.clip(frame.astype(np.int32) + 100, 0, 4095).astype(np.uint16)

    outcome = check_response(rendered(rig), sensor, offset)
    assert abs(outcome.figure("response_offset_dn")) == pytest.approx(100.0, rel=0.35)
    assert "dark signal" in outcome.sentences


@pytest.mark.parametrize(("rig", "sensor"), STITCHED.items())
def test_another_tone_curve_of_a_pan_head_is_named(rig: str, sensor: str) -> None:
    def curved(frame: Any) -> Any:
        signal = np.maximum(frame.astype(np.float64) - BLACK_DN, 0.0)
        return np.rint(1500.0 * (signal / 1500.0) ** 0.8 + BLACK_DN).clip(0, 4095).astype(np.uint16)

    outcome = check_response(rendered(rig), sensor, curved)
    assert "tone curve" in outcome.sentences


@pytest.mark.parametrize(("rig", "sensor"), STITCHED.items())
def test_signal_that_changes_slowly_over_a_pan_frame_is_named(rig: str, sensor: str) -> None:
    def sloping(frame: Any) -> Any:
        factor = np.linspace(0.9, 1.1, len(frame))[:, None]
        signal = (frame.astype(np.float64) - BLACK_DN) * factor + BLACK_DN
        return np.rint(signal).clip(0, 4095).astype(np.uint16)

    outcome = check_response(rendered(rig), sensor, sloping)
    assert abs(outcome.figure("response_slope")) == pytest.approx(0.2, rel=0.3)
    assert "from one side of its frame to the other" in outcome.sentences

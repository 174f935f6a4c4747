"""Frames that show other ground than they should, although they are sharp and well exposed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import pytest

from tests.processing.planted import Planted, rendered, turned

pytestmark = [pytest.mark.trust, pytest.mark.timeout(300)]

Frames = Mapping[str, Any]


@pytest.fixture(scope="module")
def healthy() -> Planted:
    return rendered("ultracam-x-mini")


@pytest.fixture(scope="module")
def elsewhere() -> Planted:
    return rendered("ultracam-x-mini", seed=12, dc_k=-15.0)


def _swapped(a: str, b: str) -> Callable[[Frames, Frames], Frames]:
    return lambda frames, _: {**frames, a: frames[b], b: frames[a]}


def _turned(name: str) -> Callable[[Frames, Frames], Frames]:
    return lambda frames, _: {**frames, name: frames[name][::-1, ::-1].copy()}


def _mirrored(name: str) -> Callable[[Frames, Frames], Frames]:
    return lambda frames, _: {**frames, name: frames[name][:, ::-1].copy()}


def _old(*names: str) -> Callable[[Frames, Frames], Frames]:
    return lambda frames, others: {**frames, **{name: others[name] for name in names}}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (_swapped("SU00", "SU11"), {"SU00", "SU11"}),
        (_swapped("SU20", "SU21"), {"SU20", "SU21"}),
        (_turned("SU30"), {"SU30"}),
        (_mirrored("SU10"), {"SU10"}),
        (_turned("G"), {"G"}),
        (_old("SU02"), {"SU02"}),
        (_old("R", "G", "B", "N"), {"G"}),
    ],
)
def test_other_ground_in_a_frame_is_named_and_flown_again(
    healthy: Planted,
    elsewhere: Planted,
    change: Callable[[Frames, Frames], Frames],
    named: set[str],
) -> None:
    outcome = replace(healthy, frames=change(healthy.frames, elsewhere.frames)).outcome()
    assert outcome.verdict == "refly" and "FRAME_CORRUPT" in outcome.flags
    assert set(str(outcome.figure("mismatched_sensors")).split(", ")) == named
    assert "other ground" in outcome.sentences and "water" not in outcome.sentences
    assert "DISPLACED_SENSOR" not in outcome.flags


@pytest.mark.parametrize("band", ["R", "B", "N"])
def test_other_ground_in_a_colour_band_is_named(healthy: Planted, band: str) -> None:
    outcome = replace(healthy, frames=_turned(band)(healthy.frames, {})).outcome()
    assert outcome.verdict == "refly" and "other ground" in outcome.sentences


def test_frames_without_texture_are_not_called_other_ground(healthy: Planted) -> None:
    flat = {name: frame // 16 * 0 + 900 for name, frame in healthy.frames.items()}
    outcome = replace(healthy, frames={**healthy.frames, "SU30": flat["SU30"]}).outcome()
    assert outcome.figure("mismatched_sensors") is None and "other ground" not in outcome.sentences
    assert outcome.verdict != "good"


@pytest.mark.parametrize(
    ("cone", "angles"),
    [
        ("1", {"x_rad": 6e-4}),
        ("3", {"y_rad": 1e-3}),
        ("G", {"x_rad": 1e-3}),
        ("2", {"z_rad": 3e-3}),
    ],
)
def test_a_cone_turned_beyond_the_search_is_found_corrected_and_named(
    healthy: Planted, cone: str, angles: dict[str, float]
) -> None:
    outcome = healthy.with_cone(cone, turned(**angles)).outcome()
    assert outcome.verdict == "usable" and outcome.figure("platform_causes") == cone
    assert outcome.inner_px < 0.02
    assert outcome.stated_sigma_px < 3.0 * outcome.true_sigma_px < 6.0 * outcome.stated_sigma_px

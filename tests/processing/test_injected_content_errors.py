"""Frames that show other ground than they should, although they are sharp and well exposed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from processing.geometry.placement import nominal_placements
from processing.matching.content_check import check_content, moved_placements
from processing.matching.tie_points import match_tie_points
from processing.radiometry.level1 import level1_counts_per_dn
from tests.processing.injected_errors import InjectedExposure, rendered, with_platform_rotation

pytestmark = [pytest.mark.trust, pytest.mark.timeout(300)]

Frames = Mapping[str, Any]


@pytest.fixture(scope="module")
def error_free() -> InjectedExposure:
    return rendered("ultracam-x-mini")


@pytest.fixture(scope="module")
def elsewhere() -> InjectedExposure:
    return rendered("ultracam-x-mini", seed=12, dc_k=-15.0)


def _swapped(a: str, b: str) -> Callable[[Frames, Frames], Frames]:
    return lambda frames, _: {**frames, a: frames[b], b: frames[a]}


def _rotated(name: str) -> Callable[[Frames, Frames], Frames]:
    return lambda frames, _: {**frames, name: frames[name][::-1, ::-1].copy()}


def _mirrored(name: str) -> Callable[[Frames, Frames], Frames]:
    return lambda frames, _: {**frames, name: frames[name][:, ::-1].copy()}


def _old(*names: str) -> Callable[[Frames, Frames], Frames]:
    return lambda frames, others: {**frames, **{name: others[name] for name in names}}


ROTATED_GREEN = _rotated("G")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (_swapped("SU00", "SU11"), {"SU00", "SU11"}),
        (_swapped("SU20", "SU21"), {"SU20", "SU21"}),
        (_rotated("SU30"), {"SU30"}),
        (_mirrored("SU10"), {"SU10"}),
        (ROTATED_GREEN, {"G"}),
        (_old("SU02"), {"SU02"}),
        (_old("R", "G", "B", "N"), {"G"}),
    ],
)
def test_other_ground_in_a_frame_is_named_and_flown_again(
    error_free: InjectedExposure,
    elsewhere: InjectedExposure,
    change: Callable[[Frames, Frames], Frames],
    named: set[str],
) -> None:
    outcome = replace(error_free, frames=change(error_free.frames, elsewhere.frames)).outcome()
    assert outcome.verdict == "refly" and "FRAME_CORRUPT" in outcome.flags
    assert set(str(outcome.figure("mismatched_sensors")).split(", ")) == named
    assert "other ground" in outcome.sentences and "water" not in outcome.sentences
    assert "DISPLACED_SENSOR" not in outcome.flags
    # One frame that contradicts all others is alone.
    alone = outcome.figure("mismatched_alternatives") is None
    assert alone == (named != {"G"} or change is ROTATED_GREEN)


@pytest.mark.parametrize(
    ("rig", "group"),
    [("ultracam-x-mini", "pan"), ("ultracam-x-mini", "colour"), ("ultracam-l-mini", "pan")],
)
def test_of_pan_and_colour_heads_of_two_exposures_either_may_be_wrong(rig: str, group: str) -> None:
    exposure, other = rendered(rig), rendered(rig, seed=12, dc_k=-15.0)
    cones = exposure.rig.pan_cones if group == "pan" else exposure.rig.colour_cones
    changed = [s.name for cone in cones for s in cone.sensors]
    outcome = replace(exposure, frames=_old(*changed)(exposure.frames, other.frames)).outcome()
    assert outcome.verdict == "refly" and "FRAME_CORRUPT" in outcome.flags
    assert "of all PAN heads or of all colour heads are of another exposure" in outcome.sentences
    accused = (
        outcome.figure("mismatched_sensors") + ", " + outcome.figure("mismatched_alternatives")
    )
    assert set(changed) <= set(accused.split(", "))


@pytest.mark.parametrize("calibrated", [True, False])
def test_red_and_green_exchanged_are_both_named(
    error_free: InjectedExposure, calibrated: bool
) -> None:
    planted = replace(error_free, frames=_swapped("R", "G")(error_free.frames, {}))
    if not calibrated:
        planted = replace(planted, radiometry={})
    outcome = planted.outcome()
    assert outcome.verdict == "refly" and "FRAME_CORRUPT" in outcome.flags
    pairs = zip(
        outcome.figure("exchanged_frames").split(", "),
        outcome.figure("exchanged_from").split(", "),
        strict=True,
    )
    assert dict(pairs) == {"R": "G", "G": "R"}
    assert outcome.figure("exchanged_by") == ("fixed pattern" if calibrated else "geometry")
    assert "frame of R comes from head G" in outcome.sentences.replace("The", "the")
    assert "CALIBRATION_EXPIRED" not in outcome.flags


@pytest.mark.parametrize(("a", "b"), [("B", "N"), ("SU02", "SU21")])
def test_frames_exchanged_between_calibrated_heads_are_named(
    error_free: InjectedExposure, a: str, b: str
) -> None:
    outcome = replace(error_free, frames=_swapped(a, b)(error_free.frames, {})).outcome()
    assert outcome.verdict == "refly" and outcome.figure("exchanged_by") == "fixed pattern"
    assert set(outcome.figure("exchanged_frames").split(", ")) == {a, b}


def test_an_error_free_exposure_has_its_own_frames(error_free: InjectedExposure) -> None:
    for planted in (error_free, replace(error_free, radiometry={})):
        assert planted.outcome().figure("exchanged_frames") is None


@pytest.mark.parametrize("band", ["R", "B", "N"])
def test_other_ground_in_a_colour_band_is_named(error_free: InjectedExposure, band: str) -> None:
    outcome = replace(error_free, frames=_rotated(band)(error_free.frames, {})).outcome()
    assert outcome.verdict == "refly" and "other ground" in outcome.sentences


def _part_of(name: str) -> Callable[[Frames, Frames], Frames]:
    """A sixteenth of one frame is of another exposure."""

    def change(frames: Frames, other: Frames) -> Frames:
        mixed = frames[name].copy()
        part = slice(230, 438), slice(405, 717)
        mixed[part] = other[name][part]
        return {**frames, name: mixed}

    return change


@pytest.mark.parametrize(
    "name",
    [
        "SU11",
        pytest.param("SU30", marks=pytest.mark.soak),
        "G",
        pytest.param("R", marks=pytest.mark.soak),
        pytest.param("B", marks=pytest.mark.soak),
    ],
)
def test_a_part_of_a_frame_of_another_exposure_is_named_with_its_place(
    error_free: InjectedExposure, elsewhere: InjectedExposure, name: str
) -> None:
    changed = _part_of(name)(error_free.frames, elsewhere.frames)
    outcome = replace(error_free, frames=changed).outcome()
    assert outcome.verdict == "refly" and "FRAME_CORRUPT" in outcome.flags
    assert outcome.figure("other_ground_sensor") == name, outcome.sentences
    assert outcome.figure("other_ground_alternatives") is None
    assert "another exposure" in outcome.sentences
    # A region is three cells wide, of 78 by 52 pixels.
    for key, true, cell in (
        ("first_column", 405, 78),
        ("last_column", 716, 78),
        ("first_row", 230, 52),
        ("last_row", 437, 52),
    ):
        assert abs(outcome.figure(f"other_ground_{key}") - true) <= 1.5 * cell, key


def test_frames_without_texture_are_not_called_other_ground(error_free: InjectedExposure) -> None:
    flat = {name: frame // 16 * 0 + 900 for name, frame in error_free.frames.items()}
    outcome = replace(error_free, frames={**error_free.frames, "SU30": flat["SU30"]}).outcome()
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
def test_a_cone_rotated_beyond_the_search_is_found_corrected_and_named(
    error_free: InjectedExposure, cone: str, angles: dict[str, float]
) -> None:
    outcome = error_free.with_cone(cone, with_platform_rotation(**angles)).outcome()
    assert outcome.verdict == "usable" and outcome.figure("platform_causes") == cone
    assert outcome.inner_px < 0.02
    assert outcome.stated_sigma_px < 3.0 * outcome.true_sigma_px < 6.0 * outcome.stated_sigma_px


def test_a_shifted_frame_is_sought_where_it_lies_at_any_pitch_of_the_image(
    error_free: InjectedExposure,
) -> None:
    rig = error_free.rig
    assert rig.virtual_image is not None
    counts = level1_counts_per_dn(rig.sensors[0].bits)
    frames = {name: frame * np.uint16(counts) for name, frame in error_free.frames.items()}
    frames["SU20"] = np.roll(frames["SU20"], 24, axis=1)
    placed = nominal_placements(rig, {}, {})
    tie_points = match_tie_points(rig, placed, frames)
    layers = []
    for factor in (1.0, 1.5):
        image = replace(rig.virtual_image, pitch_um=factor * rig.virtual_image.pitch_um)
        content = check_content(replace(rig, virtual_image=image), placed, frames, tie_points)
        assert set(content.shifted_px) == {"SU20"}
        layers.append(moved_placements(placed, content, image.pitch_mm)["SU20"].layer)
    assert np.allclose(layers[0], layers[1], atol=1e-9)
    moved_px = layers[0][:2, 2] / rig.sensor("SU20").pitch_mm
    assert np.hypot(*moved_px) == pytest.approx(24.0, abs=1.0)


@pytest.mark.parametrize(("ground", "seed"), [("rows", 2), ("rows", 3), ("desert", 1)])
def test_repeated_and_weak_texture_is_not_called_other_ground(ground: str, seed: int) -> None:
    outcome = rendered("ultracam-x-mini", seed=seed, ground=ground, dc_k=12.0).outcome()
    assert "other ground" not in outcome.sentences and "TIE_POINTS" in outcome.flags
    assert outcome.figure("stitched_sigma_px") < 0.6
    assert outcome.absolute_px < 3.0 * outcome.figure("stitched_sigma_px")


def test_other_ground_among_rows_of_vines_is_never_good(error_free: InjectedExposure) -> None:
    vines = rendered("ultracam-x-mini", seed=2, ground="rows", dc_k=12.0)
    frames = {**vines.frames, "SU11": error_free.frames["SU11"]}
    outcome = replace(vines, frames=frames).outcome()
    assert outcome.verdict != "good" and "TIE_POINTS" in outcome.flags

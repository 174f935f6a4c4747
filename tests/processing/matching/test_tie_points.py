"""Tie points of a made-up exposure: where they lie, how true they are, what is left out."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Mapping

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement, nominal_placements, vip_mm_from_raw
from processing.matching.tie_points import (
    PAN_TO_COLOUR,
    PAN_TO_PAN,
    TiePoints,
    TiePointSettings,
    match_tie_points,
)
from processing.rig import Rig, find_rig
from tests.processing.synthetic_exposure import expose

PITCH_MM = 7.2e-3
TDI = 6


def quarter_rig() -> Rig:
    """Four PAN sensors of ultracam-x-mini around one corner, and green."""
    mini = find_rig("ultracam-x-mini")
    keep = {"SU00", "SU10", "SU20", "SU30", "G"}
    cones = []
    for cone in mini.cones:
        sensors = tuple(s for s in cone.sensors if s.name in keep)
        if sensors:
            cones.append(dataclasses.replace(cone, sensors=sensors))
    return dataclasses.replace(mini, cones=tuple(cones))


@functools.cache
def scene() -> tuple[
    Rig, dict[str, SensorPlacement], dict[str, SensorPlacement], dict[str, NDArray[np.uint16]]
]:
    """Rig, start, truth and Level-1 frames of an exposure at dC = 15 K, sensors out of place."""
    rig = quarter_rig()
    moved = {"SU00": (0.8, -0.5), "SU20": (2.3, 1.4), "SU30": (-1.5, -3.1)}
    exposure = expose(rig, dc_k=15.0, displaced=moved, tdi_shifts=TDI)
    frames = {}
    for name, raw in exposure.frames.items():
        black = rig.sensor(name).black_dn
        raw_words_masked = np.clip((raw.astype(np.float64) - black) * 8.0, 2, 65534).astype(
            np.uint16
        )
        raw_words_masked &= 0xFFFE
        raw_words_masked[: exposure.tdi_shifts[name]] = 0
        frames[name] = raw_words_masked
    start = nominal_placements(rig, exposure.temperatures_c, exposure.tdi_shifts)
    truth = nominal_placements(exposure.true_rig, exposure.temperatures_c, exposure.tdi_shifts)
    return rig, start, truth, frames


def gaps_px(points: TiePoints, placements: Mapping[str, SensorPlacement]) -> NDArray[np.float64]:
    """Place of a minus place of b in the virtual image, px (n, 2)."""
    result = np.zeros((len(points), 2))
    for i, name in enumerate(points.names):
        for sensors, raw, sign in (
            (points.sensor_a, points.raw_a, 1.0),
            (points.sensor_b, points.raw_b, -1.0),
        ):
            mine = sensors == i
            if mine.any():
                result[mine] += sign * vip_mm_from_raw(placements[name], raw[mine]) / PITCH_MM
    return result


def test_points_of_every_pair_meet_in_the_true_geometry_without_bias() -> None:
    rig, start, truth, frames = scene()
    points = match_tie_points(rig, start, frames)
    error = gaps_px(points, truth)
    # The scene itself is interpolated to about 0.006 px of PAN.
    for number, pair in enumerate(points.pairs):
        own = error[points.overlap == number]
        bar = 0.01 if points.kind[points.overlap == number][0] == PAN_TO_PAN else 0.02
        assert len(own) > 100, pair
        assert np.abs(own.mean(axis=0)).max() < bar, pair
    assert np.abs(error[points.kind == PAN_TO_PAN]).max() < 0.05
    assert np.abs(error[points.kind == PAN_TO_COLOUR]).max() < 0.3
    assert len(points) > 0.95 * sum(points.attempted)
    # And in the geometry as calibrated they do not meet: the test would notice.
    assert np.abs(gaps_px(points, start)).max() > 2.0


def test_points_are_spread_over_the_entire_strip_and_the_entire_sensor() -> None:
    rig, start, _, frames = scene()
    points = match_tie_points(rig, start, frames)
    for number, (a, b) in enumerate(points.pairs):
        own = points.overlap == number
        along = np.ptp(points.raw_a[own], axis=0)
        if (a, b) == ("SU00", "SU10"):
            assert along[1] > 0.93 * (832 - TDI)
        elif points.kind[own][0] == PAN_TO_COLOUR:
            assert along[0] > 0.85 * 1248
            assert along[1] > 0.75 * 832
            quadrant = (points.raw_a[own] > (624, 416)) @ np.array([1, 2])
            assert np.bincount(quadrant, minlength=4).min() > 0.15 * own.sum()


def test_windows_never_share_pixels_of_one_frame_within_a_pair_and_green_is_used_once() -> None:
    rig, start, _, frames = scene()
    points = match_tie_points(rig, start, frames)
    settings = TiePointSettings()
    first = points.raw_a[points.overlap == 0]
    gap = np.abs(first[:, None] - first[None]).max(axis=2) + 1e9 * np.eye(len(first))
    assert gap.min() > settings.window_pp_px - 7  # a search may draw neighbours together
    green = points.raw_b[points.kind == PAN_TO_COLOUR]
    gap = np.abs(green[:, None] - green[None]).max(axis=2) + 1e9 * np.eye(len(green))
    assert gap.min() > settings.window_pc_px - 3


def test_no_point_uses_a_partly_exposed_row() -> None:
    rig, start, _, frames = scene()
    points = match_tie_points(rig, start, frames)
    half = TiePointSettings().window_pp_px // 2
    assert points.raw_a[points.kind == PAN_TO_PAN, 1].min() > TDI + half - 1


def test_a_missing_frame_has_no_points_and_leaves_the_others_theirs() -> None:
    rig, start, _, frames = scene()
    rest = {name: frame for name, frame in frames.items() if name != "SU20"}
    points = match_tie_points(rig, start, rest)
    counts = points.counts()
    assert counts[("SU00", "SU20")] == 0
    assert counts[("SU20", "SU30")] == 0
    assert counts[("SU00", "SU10")] > 100
    assert counts[("SU20", "G")] == 0
    without_green = {name: frame for name, frame in frames.items() if name != "G"}
    assert not (match_tie_points(rig, start, without_green).kind == PAN_TO_COLOUR).any()
    assert len(match_tie_points(rig, start, {})) == 0


def test_overlaps_have_fewer_points_only_where_green_ties_both_sensors() -> None:
    rig, start, _, frames = scene()
    settings = TiePointSettings(points_per_supported_overlap=30, supporting_points=100)
    full = match_tie_points(rig, start, frames).counts()
    seen = match_tie_points(rig, start, frames, settings=settings).counts()
    to_pan = [pair for pair in full if "G" not in pair]
    assert all(0 < seen[pair] <= 30 < full[pair] for pair in to_pan)
    assert all(seen[pair] == full[pair] for pair in full if "G" in pair)
    without_green = {name: frame for name, frame in frames.items() if name != "G"}
    alone = match_tie_points(rig, start, without_green, settings=settings).counts()
    assert all(alone[pair] == full[pair] for pair in to_pan)


def test_an_overlap_has_all_points_where_green_ties_one_sensor_alone() -> None:
    rig, start, _, frames = scene()
    full = match_tie_points(rig, start, frames).counts()
    tied = {pair[0]: count for pair, count in full.items() if "G" in pair}
    least = min(tied, key=lambda name: tied[name])
    settings = TiePointSettings(points_per_supported_overlap=30, supporting_points=tied[least] + 1)
    seen = match_tie_points(rig, start, frames, settings=settings).counts()
    for pair in (pair for pair in full if "G" not in pair):
        few = all(tied[name] > tied[least] for name in pair)
        assert seen[pair] <= 30 if few else seen[pair] == full[pair], pair
    assert any(seen[pair] == full[pair] for pair in full if least in pair and "G" not in pair)


def test_water_has_few_points_and_states_how_many_were_sought() -> None:
    rig, start, _, frames = scene()
    rng = np.random.default_rng(3)
    water = {
        name: (8 * np.rint(rng.normal(300.0, 10.0, frame.shape))).astype(np.uint16)
        for name, frame in frames.items()
    }
    points = match_tie_points(rig, start, water)
    assert sum(points.attempted) > 1000
    assert len(points) < 0.01 * sum(points.attempted)


def test_frames_of_the_wrong_shape_or_type_are_refused() -> None:
    rig, start, _, frames = scene()
    with pytest.raises(ValueError, match=r"SU00 is \(10, 10\)"):
        match_tie_points(rig, start, {"SU00": np.zeros((10, 10), np.uint16)})
    with pytest.raises(ValueError, match="float64"):
        match_tie_points(rig, start, {"SU00": frames["SU00"].astype(np.float64)})


def test_the_same_frames_give_the_same_points_to_the_last_bit() -> None:
    rig, start, _, frames = scene()
    a, b = (match_tie_points(rig, start, frames) for _ in range(2))
    np.testing.assert_array_equal(a.raw_a, b.raw_a)
    np.testing.assert_array_equal(a.sigma_px, b.sigma_px)


def test_a_mini_exposure_is_matched_in_well_under_a_second_of_two_cores() -> None:
    """Counted in processor seconds, so that a busy machine does not fail it."""
    rig, start, _, frames = scene()
    match_tie_points(rig, start, frames)
    used = []
    for _ in range(3):
        begin = time.process_time()
        points = match_tie_points(rig, start, frames)
        used.append((time.process_time() - begin) / len(points))
    # 5,500 points of the whole mini rig; waiting threads spin and are counted, too.
    assert 5500 * min(used) < 1.5

"""Regions of other ground: which windows of a frame are wrong, and which frame is named."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.image.colour import BandRegistration, ColourSettings
from processing.matching.tie_points import TiePoints, TiePointSettings
from processing.quality import other_ground
from processing.quality.other_ground import (
    MAX_CHECKED,
    OtherGround,
    _region,
    _suspicious,
    _textured,
    other_ground_figures,
    other_ground_regions,
)
from processing.rig import find_rig

Array = NDArray[Any]
RIG = find_rig("ultracam-x-mini")
SHAPE = (832, 1248)
SETTINGS: dict[str, Any] = {"settings": TiePointSettings(), "colour": ColourSettings()}
PART = ((300.0, 230.0), (612.0, 438.0))
FRAMES = {s.name: np.zeros((2, 2), np.uint16) for s in RIG.sensors}


def _grid(step: int = 48) -> Array:
    columns, rows = np.meshgrid(np.arange(24, SHAPE[1], step), np.arange(24, SHAPE[0], step))
    return np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)


def _inside(at: Array) -> Array:
    return np.asarray((at >= PART[0]).all(axis=1) & (at < PART[1]).all(axis=1))


def test_a_part_that_matches_nothing_is_found_with_its_place() -> None:
    at = _grid()
    lost, matched = at[_inside(at)], at[~_inside(at)]
    rows = _suspicious(lost, matched, SHAPE)
    assert len(rows) > 0.7 * len(lost)
    every, none = np.ones(len(rows), np.bool_), np.zeros(len(rows), np.bool_)
    (region,) = _region("SU11", SHAPE, matched, lost[rows], every, none)
    assert region.sensor == "SU11" and region.positions == len(rows)
    assert np.abs(np.subtract(region.columns, (300, 612))).max() <= 78
    assert np.abs(np.subtract(region.rows, (230, 438))).max() <= 52


def test_windows_without_texture_or_that_resemble_the_ground_are_no_other_ground() -> None:
    at = _grid()
    lost, matched = at[_inside(at)], at[~_inside(at)]
    every, none = np.ones(len(lost), np.bool_), np.zeros(len(lost), np.bool_)
    assert not list(_region("SU11", SHAPE, matched, lost, none, none))
    assert not list(_region("SU11", SHAPE, matched, lost, every, every))
    third = np.arange(len(lost)) % 3 == 0
    assert not list(_region("SU11", SHAPE, matched, lost, every, third))
    tenth = np.arange(len(lost)) % 10 == 0
    assert list(_region("SU11", SHAPE, matched, lost, every, tenth))


@pytest.mark.parametrize("bad", [0, 4001])
def test_windows_with_saturated_or_missing_pixels_are_not_compared(bad: int) -> None:
    sensor = RIG.sensor("R")
    random = np.random.default_rng(3)
    frame = 2 * random.integers(500, 4000, (sensor.height_px, sensor.width_px)).astype(np.uint16)
    at = np.array([[200, 200], [600, 400]])
    window = (frame, sensor, at, 15)
    assert _textured((window, window), 3).tolist() == [True, True]
    changed = frame.copy()
    changed[400 + 7, 600 - 12] = bad
    assert _textured((window, (changed, sensor, at, 15)), 3).tolist() == [True, False]
    even = np.full_like(frame, 4000)
    assert _textured((window, (even, sensor, at, 15)), 3).tolist() == [False, False]


def test_positions_that_fail_all_over_a_frame_are_not_suspicious() -> None:
    at = _grid()
    lost = np.arange(len(at)) % 3 == 0
    assert len(_suspicious(at[lost], at[~lost], SHAPE)) == 0
    assert len(_suspicious(at[:0], at, SHAPE)) == 0
    beyond = np.vstack([at[lost], [[np.nan, 4.0]]])
    assert len(_suspicious(beyond, at[~lost], SHAPE)) == 0


def test_of_many_positions_evenly_spread_ones_are_looked_at() -> None:
    at = _grid(16)
    lost, matched = at[at[:, 0] < 624], at[at[:, 0] >= 624]
    rows = _suspicious(lost, matched, SHAPE)
    assert MAX_CHECKED / 2 < len(rows) <= MAX_CHECKED
    assert np.ptp(lost[rows], axis=0).min() > 500


def _named(
    monkeypatch: pytest.MonkeyPatch, pan: list[str], bands: list[str], compared: list[str]
) -> list[tuple[str, tuple[str, ...]]]:
    def regions(names: list[str]) -> Any:
        def found(*_: Any) -> Iterator[OtherGround]:
            for number, name in enumerate(names):
                yield OtherGround(name, (0, 10), (0, 10), 20 + number)

        return found

    monkeypatch.setattr(other_ground, "_of_pan", regions(pan))
    monkeypatch.setattr(other_ground, "_of_bands", regions(bands))
    registrations = [
        BandRegistration(band, band, np.eye(3), 100, 0.1, registered=True) for band in compared
    ]
    found = other_ground_regions(RIG, {}, FRAMES, _no_points(), registrations, **SETTINGS)
    return [(region.sensor, region.alternatives) for region in found]


def _no_points() -> TiePoints:
    none = np.zeros(0)
    whole = np.zeros(0, np.int64)
    places = np.zeros((0, 2))
    return TiePoints((), (), (), whole, whole, places, places, none, none, whole, whole)


@pytest.mark.parametrize(
    ("pan", "bands", "compared", "named"),
    [
        ([], [], ["red", "blue"], []),
        (["SU11"], [], ["red", "blue"], [("SU11", ())]),
        (["SU11"], [], ["nir"], [("SU11", ("G",))]),
        ([], ["R"], ["red", "blue"], [("R", ())]),
        ([], ["R", "B"], ["red", "blue"], [("G", ())]),
        (["SU11", "SU10"], ["R", "B"], ["red", "blue"], [("G", ())]),
        (["SU11"], ["R"], ["red", "blue"], [("G", ("R",))]),
    ],
)
def test_the_frame_that_no_other_head_confirms_is_named(
    monkeypatch: pytest.MonkeyPatch,
    pan: list[str],
    bands: list[str],
    compared: list[str],
    named: list[tuple[str, tuple[str, ...]]],
) -> None:
    assert _named(monkeypatch, pan, bands, compared) == named


def test_frames_that_are_known_to_be_wrong_are_not_compared(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def unexpected(*_: Any) -> Iterator[OtherGround]:
        raise AssertionError

    monkeypatch.setattr(other_ground, "_of_pan", unexpected)
    monkeypatch.setattr(other_ground, "_of_bands", unexpected)
    points = _no_points()
    assert not other_ground_regions(RIG, {}, FRAMES, points, (), explained={"SU00"}, **SETTINGS)
    without_green = {name: frame for name, frame in FRAMES.items() if name != "G"}
    assert not other_ground_regions(RIG, {}, without_green, points, (), **SETTINGS)


def test_figures_hold_the_largest_region_and_the_other_frames() -> None:
    assert other_ground_figures(()).other_ground_sensor is None
    figures = other_ground_figures(
        (
            OtherGround("SU11", (1, 2), (3, 4), 9, alternatives=("G",)),
            OtherGround("SU10", (5, 6), (7, 8), 8, alternatives=("G",)),
        )
    )
    assert figures.other_ground_sensor == "SU11" and figures.other_ground_positions == 9
    assert figures.other_ground_alternatives == ("G", "SU10")
    assert (figures.other_ground_first_column, figures.other_ground_last_column) == (1, 2)
    assert (figures.other_ground_first_row, figures.other_ground_last_row) == (3, 4)

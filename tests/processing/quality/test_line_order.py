"""Lines that are exchanged or of two exposures, planted in ground with detail of all sizes."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from processing.quality.line_order import MAX_RATIO, disorder, line_order_figures
from processing.rig import Rig, find_rig

pytestmark = pytest.mark.trust

MINI = find_rig("ultracam-x-mini")
PLAIN = MINI.sensor("SU00")
BAYER = find_rig("midas-mini").sensors[0]
Frame = NDArray[np.uint16]


def ground(seed: int = 1, *, bayer: bool = False, size: tuple[int, int] = (208, 312)) -> Frame:
    random = np.random.default_rng(seed)
    frame = 1000.0 + random.normal(0.0, 8.0, size)
    for sigma, contrast in ((1.2, 60.0), (5.0, 120.0), (20.0, 200.0)):
        seen = cv2.GaussianBlur(random.normal(0.0, 1.0, size), (0, 0), sigma)
        frame += contrast * seen / seen.std()
    if bayer:
        # Red and blue of RGGB: half and twice as bright as green.
        frame[0::2, 0::2] *= 0.5
        frame[1::2, 1::2] *= 2.0
    return np.asarray(np.rint(np.clip(frame, 1.0, 4094.0)), np.uint16)


def exchanged(frame: Frame, axis: int) -> Frame:
    lines = (frame if axis == 0 else frame.T).copy()
    lines[0::2], lines[1::2] = lines[1::2].copy(), lines[0::2].copy()
    return lines if axis == 0 else lines.T


@pytest.mark.parametrize("sensor", [PLAIN, BAYER], ids=["plain", "bayer"])
@pytest.mark.parametrize("axis", [0, 1])
def test_lines_that_are_exchanged_or_of_two_exposures_do_not_follow_from_each_other(
    sensor: object, axis: int
) -> None:
    bayer = sensor is BAYER
    of = BAYER if bayer else PLAIN
    frame, other = (ground(seed, bayer=bayer) for seed in (1, 2))
    for along in (0, 1):
        assert 0.0 < disorder(of, frame, along) < 1.12
    assert disorder(of, exchanged(frame, axis), axis) > 1.5
    if not bayer:
        assert disorder(of, exchanged(frame, axis), 1 - axis) < MAX_RATIO
    mixed = frame.copy()
    lines, others = (f if axis == 0 else f.T for f in (mixed, other))
    lines[1::2] = others[1::2]
    assert disorder(of, mixed, axis) > 2.0


def test_another_colour_filter_array_than_stated_is_noticed() -> None:
    frame = ground(bayer=True)
    assert disorder(BAYER, np.roll(frame, 1, axis=1), 0) > 1.5
    swapped = dataclasses.replace(BAYER, colour_filter_array="BGGR")
    # Red and blue exchanged leave green in its place.
    assert disorder(swapped, frame, 0) < MAX_RATIO


@pytest.mark.parametrize("period", [2.5, 3.0, 4.0, 5.3])
def test_rows_of_plants_along_the_lines_are_in_order(period: float) -> None:
    frame = ground().astype(float)
    frame += 200.0 * np.sin(2.0 * np.pi * np.arange(len(frame)) / period + 0.4)[:, None]
    assert disorder(PLAIN, np.rint(np.clip(frame, 1, 4094)).astype(np.uint16), 0) < MAX_RATIO or (
        # Of a period of four lines some phases are pairs.
        period == 4.0
    )


@pytest.mark.parametrize("axis", [0, 1])
def test_a_few_per_cent_between_odd_and_even_lines_are_usual_also_over_water(axis: int) -> None:
    """Green in lines of red and of blue, or two read-outs; twelve per cent are not usual."""
    for percent, is_usual in ((4.0, True), (-4.0, True), (12.0, False)):
        water = np.random.default_rng(3).normal(900.0, 9.0, (208, 312))
        lines = water if axis == 0 else water.T
        lines[1::2] *= 1.0 + 0.01 * percent
        frame = np.rint(water).astype(np.uint16)
        assert (disorder(PLAIN, frame, axis) < MAX_RATIO) is is_usual, percent


@pytest.mark.parametrize(("shift", "least"), [(0, 98.9), (1, 5.0)])
@pytest.mark.parametrize("axis", [0, 1])
def test_lines_that_are_read_twice_are_out_of_order(shift: int, least: float, axis: int) -> None:
    """Neighbours that do not differ at all leave a ratio without end; the report has figures."""
    lines = np.roll(np.repeat(ground()[::2], 2, axis=0), shift, axis=0)
    found = disorder(PLAIN, lines if axis == 0 else lines.T.copy(), axis)
    assert least < found < 99.1


def test_a_frame_without_ground_or_of_a_few_lines_is_not_judged() -> None:
    assert disorder(PLAIN, np.full((208, 312), 700, np.uint16), 0) == 0.0
    dark = np.random.default_rng(1).integers(64, 66, (208, 312)).astype(np.uint16)
    assert disorder(PLAIN, dark, 0) == 0.0
    left = dataclasses.replace(PLAIN, justified="left")
    assert disorder(left, dark << 4, 0) == 0.0
    assert disorder(PLAIN, exchanged(ground(size=(30, 312)), 0), 0) == 0.0
    assert disorder(PLAIN, exchanged(ground(size=(32, 312)), 0), 0) > 1.5
    half = ground()
    half[100:] = 0
    assert disorder(PLAIN, half, 0) == 0.0


def test_the_frame_and_the_axis_are_named() -> None:
    rig: Rig = MINI
    frames = {"SU00": ground(1), "SU10": ground(2)}
    assert line_order_figures(rig, frames) is None and line_order_figures(rig, {}) is None
    found = line_order_figures(rig, {**frames, "SU10": exchanged(ground(2), 1)})
    assert found is not None and found.line_order is not None and found.line_order > 1.5
    assert (found.line_order_sensor, found.line_order_axis) == ("SU10", "columns")

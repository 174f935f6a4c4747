"""Lines that repeat the line before, planted in raw frames of noise."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.quality.repeated_lines import (
    RepeatedLines,
    repeated_line_figures,
    repeated_lines,
)
from processing.rig import find_rig

pytestmark = pytest.mark.trust

MINI = find_rig("ultracam-x-mini")
HEIGHT, WIDTH = 203, 96


def noisy(seed: int = 1, *, noise_dn: float = 12.0) -> NDArray[np.uint16]:
    random = np.random.default_rng(seed)
    return random.normal(900.0, noise_dn, (HEIGHT, WIDTH)).astype(np.uint16)


def stuck(first: int, count: int, *, noise_dn: float = 12.0) -> NDArray[np.uint16]:
    frame = noisy(noise_dn=noise_dn)
    frame[first : first + count] = frame[first - 1]
    return frame


@pytest.mark.parametrize("first", [1, 2, 3, 4, 5, 97, HEIGHT - 20])
@pytest.mark.parametrize("count", [4, 5, 20])
def test_a_run_of_repeated_lines_is_found_where_it_lies(first: int, count: int) -> None:
    assert repeated_lines("N", stuck(first, count)) == RepeatedLines("N", first, count, first - 1)


@pytest.mark.parametrize(("first", "source"), [(43, 1), (100, 60), (141, 140 - 37), (120, 0)])
def test_a_block_that_is_sent_twice_is_found_with_both_places(first: int, source: int) -> None:
    frame, count = noisy(), 37
    # Saturated in the middle, where lines are compared at first.
    frame[:, WIDTH // 2 - 10 : WIDTH // 2 + 10] = 4095
    frame[first : first + count] = frame[source : source + count]
    assert repeated_lines("N", frame) == RepeatedLines("N", first, count, source)
    frame[first + 2 : first + count : 3, 7] += 1
    assert repeated_lines("N", frame) is None
    frame[source : source + count] = frame[first : first + count][::-1]
    assert repeated_lines("N", frame) is None


@pytest.mark.parametrize("noise_dn", [0.3, 2.0, 12.0])
def test_healthy_frames_and_single_lines_repeat_nothing(noise_dn: float) -> None:
    assert repeated_lines("N", noisy(noise_dn=noise_dn)) is None
    assert repeated_lines("N", stuck(40, 3, noise_dn=noise_dn)) is None


@pytest.mark.parametrize("value", [0, 4095])
def test_lines_of_one_value_are_not_read_out_or_saturated(value: int) -> None:
    frame = noisy()
    frame[50:90] = value
    assert repeated_lines("N", frame) is None


def test_of_several_runs_and_frames_the_longest_counts() -> None:
    two = stuck(30, 6)
    two[100:112] = two[99]
    assert repeated_lines("N", two) == RepeatedLines("N", 100, 12, 99)
    figures = repeated_line_figures(MINI, {"SU00": stuck(9, 7), "SU10": two, "G": noisy(2)})
    assert figures is not None
    assert figures.repeated_lines == 12
    assert (figures.repeated_lines_sensor, figures.repeated_lines_first) == ("SU10", 100)
    assert figures.repeated_lines_source == 99
    assert repeated_line_figures(MINI, {"SU00": noisy(), "G": noisy(2)}) is None

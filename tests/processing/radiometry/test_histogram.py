"""The histogram of a raw frame counts what is there, in the bins the converter's range gives."""

from __future__ import annotations

import numpy as np
import pytest

from processing.radiometry.exposure_control import BINS, EVERY, sampled_histogram


@pytest.mark.parametrize(("word_bits", "step"), [(12, 64), (16, 1024), (8, 4)])
def test_every_bin_gets_what_lies_in_it(word_bits: int, step: int) -> None:
    values = (np.arange(BINS) * step).astype(np.uint16)
    frame = np.repeat(np.tile(values, (EVERY, 1)), EVERY, axis=1)
    assert sampled_histogram(frame, word_bits) == (1,) * BINS
    assert sampled_histogram(frame + np.uint16(step - 1), word_bits) == (1,) * BINS


def test_saturated_pixels_are_in_the_last_bin_and_the_sample_is_a_sixtyfourth() -> None:
    frame = np.full((160, 240), 4095, np.uint16)
    counts = sampled_histogram(frame, 12)
    assert counts[-1] == sum(counts) == 160 * 240 // 64


def test_a_converter_of_fewer_values_than_bins_leaves_bins_empty() -> None:
    values = np.arange(16, dtype=np.uint16)
    frame = np.repeat(np.tile(values, (EVERY, 1)), EVERY, axis=1)
    counts = sampled_histogram(frame, 4)
    assert counts[::4] == (1,) * 16 and sum(counts) == 16

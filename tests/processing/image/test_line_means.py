"""Sums of bundles of pixels along rows and columns, against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from processing.image.line_means import BUNDLE_PX, BUNDLES, LineMeans, line_means


def means(frame: np.ndarray) -> LineMeans:
    return line_means(frame, (0, len(frame) - 1))


@pytest.mark.parametrize("shape", [(64, 64), (100, 1300), (1403, 40), (1300, 1311)])
def test_means_are_those_of_the_bundles(shape: tuple[int, int]) -> None:
    frame = np.random.default_rng(3).integers(0, 65536, shape).astype(np.uint16)
    found_means = means(frame)
    for found, lines in ((found_means.by_row, frame), (found_means.by_column, frame.T)):
        count, length = lines.shape
        bundles = min(BUNDLES, length // BUNDLE_PX)
        assert found.shape == (bundles, count) and found.dtype == np.float32
        for k in range(bundles):
            first = k * (length // bundles)
            expected = lines[:, first : first + BUNDLE_PX].mean(axis=1)
            assert found[k] == pytest.approx(expected, rel=1e-6)


def test_a_frame_smaller_than_a_bundle_has_none() -> None:
    found = means(np.ones((20, 40), np.uint16))
    assert found.by_row.shape == (1, 20) and found.by_column.shape == (0, 40)
    assert not found.by_row.any()

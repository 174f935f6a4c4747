"""Sums of bundles of pixels along rows and columns, against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from processing.image.line_means import BUNDLE_PX, BUNDLES, line_means


@pytest.mark.parametrize("shape", [(64, 64), (100, 1300), (1403, 40), (1300, 1311)])
def test_means_are_those_of_the_bundles(shape: tuple[int, int]) -> None:
    frame = np.random.default_rng(3).integers(0, 65536, shape).astype(np.uint16)
    by_row, by_column = line_means(frame)
    for found, lines in ((by_row, frame), (by_column, frame.T)):
        count, length = lines.shape
        bundles = min(BUNDLES, length // BUNDLE_PX)
        assert found.shape == (bundles, count) and found.dtype == np.float32
        for k in range(bundles):
            first = k * (length // bundles)
            expected = lines[:, first : first + BUNDLE_PX].mean(axis=1)
            assert found[k] == pytest.approx(expected, rel=1e-6)


def test_a_frame_smaller_than_a_bundle_has_none() -> None:
    by_row, by_column = line_means(np.ones((20, 40), np.uint16))
    assert by_row.shape == (1, 20) and by_column.shape == (0, 40)
    assert not by_row.any()

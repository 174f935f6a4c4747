"""Tracks of features through photographs: what the library fails on is a pair that is unrelated."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from processing.matching.photograph_tracks import ImageFeatures, match_photographs


def test_a_pair_that_the_robust_estimation_fails_on_is_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    random = np.random.default_rng(1)
    descriptors = random.random((60, 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    features = [ImageFeatures(random.uniform(0, 500, (60, 2)), descriptors) for _ in range(2)]

    def failing(*_: object) -> None:
        raise cv2.error("(-215:Assertion failed) !model.empty() in function 'setModelParameters'")

    monkeypatch.setattr(cv2, "findFundamentalMat", failing)
    assert match_photographs(features, [(0, 1)]) == {}

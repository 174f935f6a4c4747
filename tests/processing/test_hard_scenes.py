"""Over ground that is hard to stitch the image is right, or its report states that it is not.

Rendered by the emulator, held against its truth; the whole set, with pictures, is in
docs/reference/results/accuracy.md.
"""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.hard_scenes import SCENES, Camera, Outcome
from processing.pipelines.stitched import Product
from processing.quality.report import Flag

pytestmark = pytest.mark.timeout(600)

QUICK = (
    *("open-water", "desert", "snow", "night", "haze"),
    *("traffic", "cloud-corner", "roofs", "rows"),
)
SLOW = tuple(name for name in SCENES if name not in QUICK)

WEAK = ("desert", "snow", "haze", "rows")
"""Ground with so little to hold on to that calibration takes part."""


@pytest.fixture(scope="module")
def camera(tmp_path_factory: pytest.TempPathFactory) -> Camera:
    # Red, blue and near infrared say nothing about the stitching.
    return Camera(tmp_path_factory.mktemp("scenes"), without=("R", "B", "N"))


def check(outcome: Outcome, product: Product) -> None:
    assert outcome.right or outcome.flagged, outcome
    assert outcome.is_consistent, outcome
    # Whatever happened, there is an image, and it is no worse than the fixed method's.
    assert np.count_nonzero(product.valid) > 0.99 * product.valid.size
    assert outcome.inner_rms_px < max(outcome.fixed_rms_px + 0.01, 0.05), outcome


@pytest.mark.parametrize("name", QUICK)
def test_the_image_is_right_or_states_that_it_is_not(camera: Camera, name: str) -> None:
    outcome, product = camera.evaluate(name)
    check(outcome, product)
    assert bool(outcome.weak_sensors) == (name in (*WEAK, "night")), outcome
    if outcome.weak_sensors:
        assert outcome.flags & Flag.TIE_POINTS
    if name == "night":
        assert outcome.flags & Flag.UNDEREXPOSED and outcome.verdict == "refly"
    elif name == "desert":
        assert outcome.verdict == "refly"
    elif name == "snow":
        assert outcome.absolute_rms_px < 0.15 and outcome.flags & Flag.SIGMA0
    else:
        # Nothing moved in this camera, and nobody is to be accused.
        assert outcome.right and outcome.displaced == "", outcome
    if name == "roofs":
        assert outcome.flags & Flag.OVEREXPOSED
    if name == "traffic":
        assert outcome.flags == Flag(0) and int(np.count_nonzero(product.mosaic.outliers)) > 200


@pytest.mark.soak
@pytest.mark.parametrize("name", SLOW)
def test_the_other_scenes_are_right_or_say_that_they_are_not(camera: Camera, name: str) -> None:
    outcome, product = camera.evaluate(name)
    check(outcome, product)
    if SCENES[name].displaced_px and outcome.right:
        assert outcome.displaced in ("SU02", "")

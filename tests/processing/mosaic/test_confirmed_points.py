"""Single matches under clouds: a frame does not go where one wrong point puts it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from processing.matching.tie_points import PAN_TO_PAN, TiePoints
from processing.mosaic.confirmed_points import unconfirmed
from processing.mosaic.free_mosaic import MosaicSettings
from processing.mosaic.precision import datum_covariance, placed_sigma_px
from processing.mosaic.stitching import stitch
from processing.rig import find_rig
from tests.processing.mosaic.test_free_mosaic import image_points
from tests.processing.synthetic import Truth, make_truth, tie_points_of

MINI = find_rig("ultracam-x-mini")
PAIR = 3


def clouded(truth: Truth, left: int, *, wrong: int = 0) -> TiePoints:
    """One P/P pair with so many points, of which some are 4 to 7 px off, each elsewhere."""
    points = tie_points_of(truth, np.random.default_rng(4), per_overlap=60, per_sensor=100)
    keep = points.overlap != PAIR
    keep[np.flatnonzero(points.overlap == PAIR)[:left]] = True
    points = points.only(keep)
    raw = points.raw_b.copy()
    rows = np.flatnonzero(points.overlap == PAIR)[:wrong]
    raw[rows] += 4.0 * np.column_stack([np.cos(rows), np.sin(rows)]) + [3.0, 0.0]
    return dataclasses.replace(points, raw_b=raw)


@pytest.mark.parametrize(
    ("left", "wrong", "marked"), [(4, 0, 4), (5, 0, 0), (11, 3, 3), (8, 4, 8), (12, 3, 0)]
)
def test_few_points_need_others_that_agree(left: int, wrong: int, marked: int) -> None:
    truth = make_truth(MINI, np.random.default_rng(2))
    points = clouded(truth, left, wrong=wrong)
    found = unconfirmed(MINI, truth.start, points)
    assert int(found.sum()) == marked
    assert (points.overlap[found] == PAIR).all()
    if 0 < marked < left:
        assert found[np.flatnonzero(points.overlap == PAIR)[:wrong]].all()


def test_a_frame_under_a_cloud_rests_on_calibration_and_not_on_one_wrong_point() -> None:
    truth = make_truth(MINI, np.random.default_rng(2), sensor_px=0.05, layer_px=0.2)
    every = tie_points_of(
        truth, np.random.default_rng(4), per_overlap=200, sigma_pp_px=0.02, sigma_pc_px=0.1
    )
    of_frame = np.array(["SU30" in every.pairs[i] for i in every.overlap])
    single = np.flatnonzero(of_frame & (every.kind == PAN_TO_PAN))[:1]
    keep = ~of_frame
    keep[single] = True
    points = every.only(keep)
    raw = points.raw_b.copy()
    raw[np.flatnonzero(np.array(["SU30" in points.pairs[i] for i in points.overlap]))] += 4.0
    found = stitch(
        MINI,
        truth.start,
        dataclasses.replace(points, raw_b=raw),
        present=[s.name for s in MINI.sensors],
        temperatures_c=dict.fromkeys(MINI.probes, 20.0),
        method="free",
        settings=MosaicSettings(),
    )
    assert "SU30" in found.weak
    places, true = image_points(truth, found.image)
    error = np.sqrt(np.mean((places - true) ** 2, axis=1))
    corners = np.array([[0.0, 0.0], [900.0, 600.0]])
    datum = datum_covariance(MINI, found.image, dict.fromkeys(MINI.probes, 20.0))
    sigma = placed_sigma_px(MINI, found.image, "SU30", corners, datum)
    assert error.max() < 3.0 * sigma.max()
    assert sigma.max() < 2.0

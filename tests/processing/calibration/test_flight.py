"""Calibration of heads from a flight: errors against the truth agree with their covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from processing.bundle.network import INTERIOR
from processing.calibration.flight.adjustment import FlightCalibration, calibrate_flight
from processing.calibration.flight.images import FREE, FlightCalibrationError
from processing.rig import Rig
from tests.processing.calibration.flown_tracks import (
    F_MM,
    FlightPlan,
    flown,
    nominal_rig,
    true_rig,
)

Array = NDArray[np.float64]

ONE_HEAD = nominal_rig([("head", (0.0, 0.0, 0.0))])
SIDE_BY_SIDE = nominal_rig([("left", (0.0, 0.0, 0.0)), ("right", (0.0, -25.0, 0.0))])
NADIR_OBLIQUE = nominal_rig([("nadir", (0.0, 0.0, 0.0)), ("forward", (45.0, 0.0, 0.0))])
TWO_HEIGHTS = FlightPlan([(0.0, 100.0), (180.0, 130.0), (90.0, 100.0)], exposures=4)


def errors_of(found: FlightCalibration, truth: Rig) -> tuple[Array, Array]:
    """Errors of all parameters and their covariance; rotations about the axes of each head."""
    result = found.adjustment
    errors: list[float] = []
    columns: list[int] = []
    for k, head in enumerate(found.heads):
        new, true = found.rig.cone(head), truth.cone(head)
        own = {
            "dx0": new.sensors[0].x_mm - true.sensors[0].x_mm,
            "dy0": new.sensors[0].y_mm - true.sensors[0].y_mm,
            "df": true.lens.f_mm - new.lens.f_mm,
        }
        own |= {n: getattr(new.lens, n) - getattr(true.lens, n) for n in ("k1", "k2", "p1", "p2")}
        assert set(own) == set(FREE)
        errors += own.values()
        columns += [int(result.layout.interior[k][INTERIOR.index(name)]) for name in own]
        if k:
            turn = Rotation.from_euler("XYZ", true.rotation_rad).inv()
            errors += (turn * Rotation.from_euler("XYZ", new.rotation_rad)).as_rotvec().tolist()
            columns += result.layout.head_rotation[k].tolist()
    return np.array(errors), found.variance_factor * result.cofactor[np.ix_(columns, columns)]


@pytest.mark.parametrize(
    ("rig", "seeds"),
    [(ONE_HEAD, (1, 2)), (SIDE_BY_SIDE, (1, 2)), (NADIR_OBLIQUE, (1,))],
    ids=["one", "side-by-side", "oblique"],
)
def test_errors_of_lenses_and_mountings_agree_with_their_covariance(
    rig: Rig, seeds: tuple[int, ...]
) -> None:
    squares, count, sizes = 0.0, 0, []
    for seed in seeds:
        truth = true_rig(rig, seed)
        found = calibrate_flight(rig, flown(truth, TWO_HEIGHTS, seed))
        assert found.heads == tuple(cone.name for cone in rig.cones) and not found.left_out
        assert found.sigma_px == pytest.approx(TWO_HEIGHTS.noise_px, rel=0.1)
        error, covariance = errors_of(found, truth)
        scale = np.sqrt(np.diag(covariance))
        correlation = covariance / scale[:, None] / scale
        squares += float(error / scale @ np.linalg.solve(correlation, error / scale))
        count += len(error)
        sizes += np.abs(error / scale).tolist()
        for head in found.heads:
            assert max(found.shares_of_prior(head).values()) < 0.5
            assert found.distortion_sigma_px(head) < 0.7
    # Priors are wider than the lenses drawn: the lower limit is wide.
    assert chi2.ppf(1e-4, count) < squares < chi2.ppf(1 - 1e-4, count)
    assert max(sizes) < 4.5


def test_a_level_flight_over_flat_ground_leaves_the_focal_length_open() -> None:
    truth = true_rig(ONE_HEAD, 3)
    plan = FlightPlan([(0.0, 100.0), (180.0, 100.0), (0.0, 100.0)], exposures=4, tilt_deg=0.0)
    found = calibrate_flight(ONE_HEAD, flown(truth, plan, 3, relief_m=0.0))
    level = found.sigmas("head")["df"] / F_MM
    assert level > 0.01
    assert abs(found.rig.cone("head").lens.f_mm - truth.cone("head").lens.f_mm) < 4 * level * F_MM
    # Distortion does not need a height.
    assert found.distortion_sigma_px("head") < 1.0
    higher = replace(plan, lines=[(0.0, 100.0), (180.0, 130.0), (0.0, 100.0)])
    again = calibrate_flight(ONE_HEAD, flown(truth, higher, 3, relief_m=0.0))
    assert again.sigmas("head")["df"] / F_MM < 0.6 * level


def test_one_line_does_not_calibrate() -> None:
    plan = FlightPlan([(0.0, 100.0)], exposures=6, wander_m=0.1)
    with pytest.raises(FlightCalibrationError, match="fly a second line"):
        calibrate_flight(ONE_HEAD, flown(true_rig(ONE_HEAD, 4), plan, 4))


def test_positions_of_another_flight_are_refused() -> None:
    images = flown(true_rig(ONE_HEAD, 4), TWO_HEIGHTS, 4)
    other = images.position_m.copy()
    other[:4] = other[3::-1]
    other[:4, 0] += 200.0
    with pytest.raises(FlightCalibrationError, match="contradict each other"):
        calibrate_flight(ONE_HEAD, replace(images, position_m=other))


def test_positions_worse_than_stated_are_not_believed() -> None:
    truth = true_rig(ONE_HEAD, 5)
    images = flown(truth, replace(TWO_HEIGHTS, gnss_sigma_m=0.5), 5)
    found = calibrate_flight(
        ONE_HEAD, replace(images, position_sigma_m=np.full_like(images.position_m, 0.02))
    )
    stated = found.adjustment.network.gnss.sigma_m
    assert 0.2 < stated.mean() < 1.2
    error, covariance = errors_of(found, truth)
    assert (np.abs(error) < 4.5 * np.sqrt(np.diag(covariance))).all()


def test_a_head_without_features_is_named_and_left_as_it_was() -> None:
    truth = true_rig(SIDE_BY_SIDE, 6)
    images = flown(truth, TWO_HEIGHTS, 6)
    tracks = images.tracks
    kept = images.head[tracks.image] == 0
    count = np.bincount(tracks.point[kept], minlength=tracks.points)
    kept &= count[tracks.point] >= 2
    blind = replace(
        images,
        tracks=replace(
            tracks, image=tracks.image[kept], point=tracks.point[kept], px=tracks.px[kept]
        ),
    )
    found = calibrate_flight(SIDE_BY_SIDE, blind)
    assert found.heads == ("left",)
    assert len(found.left_out) == 1 and found.left_out[0].startswith("right: 0 images")
    assert found.rig.cone("right") == SIDE_BY_SIDE.cone("right")

"""Lenses and relative orientation from a board, held against the truth of drawn cameras."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from benchmarks.board import (
    BOARD,
    SETTINGS,
    BoardSample,
    figures,
    nominal_rig,
    sample,
    views_of,
)
from processing.calibration.board.adjustment import BoardSettings, calibrate_board
from processing.calibration.board.views import BoardView, coverage_of, pose_of, same_views
from processing.matching.board_corners import BoardCorners
from processing.matching.calibration_board import BoardError, parse_board
from processing.rig import Rig
from sim_hw.laboratory import calibration_board as simulated

DRAWN = parse_board(BOARD)


@lru_cache(maxsize=1)
def calibrated() -> BoardSample:
    return sample(1)


def single(rig: Rig) -> Rig:
    return replace(rig, cones=rig.cones[:1])


def test_errors_agree_with_their_covariance_and_positions_with_a_peer() -> None:
    found = figures(range(1, 4), peers=1)
    for key in ("all", "lens", "orientation"):
        low, high = found[key]["interval"]
        assert low < found[key]["mean_square"] < high, (key, found)
    assert found["sigma_px"] == pytest.approx(0.03, rel=0.03)
    # OpenCV's polynomial distorts ideal places, ours corrects measured ones.
    assert found["peer_rms_px"] < 0.06
    assert found["peer_largest_px"] < 0.4


def test_the_rig_holds_places_and_their_standard_deviations() -> None:
    one = calibrated()
    for name in ("left", "right"):
        own, true = one.found.rig.cone(name), one.truth.rig.cone(name)
        assert own.lens.f_mm == pytest.approx(true.lens.f_mm, abs=0.01)
        assert own.lens.dx0_mm == own.lens.df_mm == 0.0
        sensor, sigma = own.sensors[0], own.sensors[0].position_sigma_um
        assert abs(sensor.x_mm - true.sensors[0].x_mm) * 1e3 < 5.0 * sigma < 50.0
        assert 0.0 < own.lens.f_sigma_ppm < 2000.0
    right = one.found.rig.cone("right")
    assert right.rotation_rad == pytest.approx(one.truth.rig.cone("right").rotation_rad, abs=1e-3)
    assert right.position_mm == pytest.approx(one.truth.rig.cone("right").position_mm, abs=1.0)
    assert one.found.is_complete and not one.found.left_out


def test_views_square_on_leave_f_and_distance_together() -> None:
    truth = simulated.true_heads(single(nominal_rig()), 1)
    views = views_of(truth, 1, tilt_deg=0.0, poses=12)
    with pytest.raises(BoardError, match="perpendicular to the axis"):
        calibrate_board(truth.nominal, DRAWN, views)


def test_one_picture_is_refused_with_the_number_needed() -> None:
    views = calibrated().views
    with pytest.raises(BoardError, match="1 usable picture of the board; 4 at least"):
        calibrate_board(nominal_rig(), DRAWN, views[:1])


def test_heads_that_never_see_the_board_together_are_named() -> None:
    apart = [replace(v, exposure=f"{v.head}-{v.exposure}") for v in calibrated().views]
    found = calibrate_board(nominal_rig(), DRAWN, apart, SETTINGS)
    assert found.relative.unconnected == ("right",) and not found.is_complete
    before, after = nominal_rig().cone("right"), found.rig.cone("right")
    assert after.rotation_rad == before.rotation_rad
    assert after.position_mm == before.position_mm
    assert after.lens.f_mm != before.lens.f_mm


def test_pictures_of_another_instant_are_left_out_by_name() -> None:
    views = list(calibrated().views)
    common = [v.exposure for v in views if v.head == "right"]
    common = [e for e in common if any(v.head == "left" and v.exposure == e for v in views)]
    first, second = common[:2]
    swap = {first: second, second: first}
    stale = [
        replace(v, exposure=swap[v.exposure]) if v.head == "right" and v.exposure in swap else v
        for v in views
    ]
    found = calibrate_board(nominal_rig(), DRAWN, stale, SETTINGS)
    text = "\n".join(found.left_out)
    assert f"exposure {first}" in text and f"exposure {second}" in text
    assert "not of one instant" in text
    true = calibrated().truth.rig.cone("right")
    assert found.rig.cone("right").rotation_rad == pytest.approx(true.rotation_rad, abs=2e-3)


def test_pictures_of_two_heads_that_are_swapped_once_are_named() -> None:
    views = list(calibrated().views)
    common = next(
        v.exposure
        for v in views
        if v.head == "left" and any(w.head == "right" and w.exposure == v.exposure for w in views)
    )
    other = {"left": "right", "right": "left"}
    swapped = [replace(v, head=other[v.head]) if v.exposure == common else v for v in views]
    found = calibrate_board(nominal_rig(), DRAWN, swapped, SETTINGS)
    assert any(common in text for text in found.left_out), found.left_out


def test_a_picture_of_another_head_is_left_out() -> None:
    rig = single(nominal_rig())
    truth = simulated.true_heads(rig, 1)
    views = list(views_of(truth, 1, poses=12))
    lens = replace(truth.rig.cones[0].lens, f_mm=8.6, k1=4e-3)
    other = replace(truth, rig=replace(truth.rig, cones=(replace(truth.rig.cones[0], lens=lens),)))
    views[4] = views_of(other, 1, poses=12)[4]
    found = calibrate_board(rig, DRAWN, views, SETTINGS)
    assert [
        t for t in found.left_out if f"picture {views[4].exposure}" in t and "another head" in t
    ]
    assert found.rig.cones[0].lens.f_mm == pytest.approx(truth.rig.cones[0].lens.f_mm, abs=0.02)


def test_the_shape_of_a_bent_board_is_found_and_adjusted() -> None:
    rig = single(nominal_rig())
    truth = simulated.true_heads(rig, 3)
    bent = simulated.drawn_board(BOARD, bow_mm=1.5)
    random = np.random.default_rng(1)
    views = []
    for k, pose in enumerate(simulated.board_poses(rig, bent, 3, 16)):
        index, px = simulated.seen_corners(truth, rig.cones[0], pose, bent)
        noisy = px + random.normal(0.0, 0.02, px.shape)
        views.append(BoardView("left", f"{k}", BoardCorners(index, noisy, 1.9)))
    flat = calibrate_board(rig, DRAWN, views)
    assert flat.sigma_px > 0.06
    shape, sigma = flat.shape_m
    height = shape[:, 2] * 1e3
    assert 0.8 < height.max() - height.min() < 2.2
    assert sigma[:, 2].max() * 1e3 < 0.3
    adjusted = calibrate_board(rig, DRAWN, views, BoardSettings(board_sigma_mm=1.0))
    assert adjusted.sigma_px == pytest.approx(0.02, rel=0.1)
    true_mm = truth.rig.cones[0].lens.f_mm
    assert abs(adjusted.rig.cones[0].lens.f_mm - true_mm) < 0.03


def test_coverage_asks_for_what_is_missing_and_then_for_nothing() -> None:
    rig = nominal_rig()
    cone, truth = rig.cones[0], calibrated().truth
    views = [v for v in calibrated().views if v.head == "left"]
    poses = [pose_of(cone, DRAWN, v.corners) for v in views]
    assert coverage_of(cone, views, poses).is_complete
    first = coverage_of(cone, views[:1], poses[:1])
    text = "; ".join(first.missing)
    for part in ("corners in", "convergent views", "by 90 degrees", "upside down", "1 of 10"):
        assert part in text
    lower = [k for k, v in enumerate(views) if v.corners.px[:, 1].min() > 150]
    part = coverage_of(cone, [views[k] for k in lower], [poses[k] for k in lower])
    assert any("the upper" in sentence for sentence in part.missing)
    assert truth.rig.cones[0].lens.f_mm != cone.lens.f_mm


def test_the_edge_that_is_asked_for_is_the_one_that_is_farther_away() -> None:
    rig = single(nominal_rig())
    exact = simulated.TrueHeads(rig, rig)
    board = simulated.drawn_board(BOARD)
    for angle, side in ((0.5, "left"), (-0.5, "right")):
        # Rotated about the vertical axis of the image; z of the board is towards the head.
        rotation = np.array(
            [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        )
        pose = simulated.BoardPose(rotation, np.array([0.0, 0.0, -0.8]))
        corners = pose.place_m + board.corners_m() @ rotation.T
        right_is_farther = corners[9, 2] < corners[0, 2]
        index, px = simulated.seen_corners(exact, rig.cones[0], pose, board)
        view = BoardView("left", "1", BoardCorners(index, px, 1.9))
        found = pose_of(rig.cones[0], DRAWN, view.corners)
        assert found.tilt_deg == pytest.approx(np.degrees(0.5), abs=0.2)
        towards = 0.0 if right_is_farther else 180.0
        assert abs(abs(found.towards_deg) - towards) < 1.0
        missing = "; ".join(coverage_of(rig.cones[0], [view], [found]).missing)
        farther = "right" if right_is_farther else "left"
        assert farther not in missing.partition("tilt the")[2].partition("edge")[0].split()
        assert side in ("left", "right")


def test_the_same_view_twice_is_found() -> None:
    views = [v for v in calibrated().views if v.head == "left"][:4]
    again = replace(views[1], exposure="again")
    assert same_views(DRAWN, [*views, again]) == [(4, 1)]

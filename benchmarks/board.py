"""Calibration from a board against truth and a peer: errors in their covariance, positions in px.

    python -m benchmarks.board --seeds 40

Corners go through the emulator's projection with noise; their measurement in pictures is tested
apart. The peer is OpenCV's `calibrateCamera` on the same corners.
"""

from __future__ import annotations

import argparse
import json
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from daemon.postflight.calibration.head_parameters import covariance_of, estimated_parameters
from processing.bundle.network import INTERIOR
from processing.calibration.board.adjustment import BoardCalibration, BoardSettings, calibrate_board
from processing.calibration.board.views import BoardView
from processing.geometry.lens import ideal_from_measured
from processing.geometry.placement import layer_mm_from_raw
from processing.geometry.rotation import rotation_matrix, vectors_from_rotations
from processing.matching.board_corners import BoardCorners
from processing.matching.calibration_board import CalibrationBoard, parse_board
from processing.rig import Rig, rig_from_mapping
from sim_hw.laboratory import calibration_board as simulated

Array = NDArray[np.float64]

BOARD = "charuco:11x8:30mm:22mm"
NOISE_PX = 0.03
POSES = 30
BOARD_SIGMA_MM = 0.1
"""How far corners of the board are off their drawn places, each coordinate, one sigma."""
SETTINGS = BoardSettings(board_sigma_mm=BOARD_SIGMA_MM)


@dataclass(frozen=True)
class BoardSample:
    """A drawn rig, the corners that its heads saw, and the calibration from them."""

    truth: simulated.TrueHeads
    views: tuple[BoardView, ...]
    found: BoardCalibration


def nominal_rig() -> Rig:
    """The uncalibrated rig of two heads that the emulator writes."""
    return rig_from_mapping(tomllib.loads(simulated.NOMINAL_RIG), "rig.toml")


@dataclass(frozen=True)
class _PrintedBoard(simulated.DrawnBoard):
    off_m: Array = field(default_factory=lambda: np.zeros((1, 3)))

    def corners_m(self) -> Array:
        return np.asarray(super().corners_m() + self.off_m)


def printed_board(text: str, random: np.random.Generator, sigma_mm: float) -> simulated.DrawnBoard:
    """A board whose corners are off their places."""
    drawn = simulated.drawn_board(text)
    off = random.normal(0.0, sigma_mm * 1e-3, drawn.corners_m().shape)
    return _PrintedBoard(**vars(drawn), off_m=off)


def views_of(
    truth: simulated.TrueHeads,
    seed: int,
    *,
    board: str = BOARD,
    poses: int = POSES,
    noise_px: float = NOISE_PX,
    board_sigma_mm: float = BOARD_SIGMA_MM,
    tilt_deg: float = 30.0,
) -> tuple[BoardView, ...]:
    """Corners of a board in many poses, with noise."""
    random = np.random.default_rng(seed)
    drawn = printed_board(board, random, board_sigma_mm)
    views = []
    for k, pose in enumerate(
        simulated.board_poses(truth.nominal, drawn, seed, poses, tilt_deg=tilt_deg)
    ):
        for cone in truth.rig.cones:
            index, px = simulated.seen_corners(truth, cone, pose, drawn)
            if len(index) >= 12:
                noisy = px + random.normal(0.0, noise_px, px.shape)
                views.append(BoardView(cone.name, f"{k:04d}", BoardCorners(index, noisy, 1.9)))
    return tuple(views)


def sample(seed: int, *, board_sigma_mm: float = BOARD_SIGMA_MM) -> BoardSample:
    """Draw a rig and calibrate it."""
    rig = nominal_rig()
    truth = simulated.true_heads(rig, seed)
    views = views_of(truth, seed, board_sigma_mm=board_sigma_mm)
    settings = BoardSettings(board_sigma_mm=board_sigma_mm)
    return BoardSample(truth, views, calibrate_board(rig, parse_board(BOARD), views, settings))


def squares_of(one: BoardSample) -> dict[str, tuple[float, int]]:
    """Squared errors in their covariance, and how many: all, each lens, each orientation."""
    found, truth = one.found, one.truth.rig
    rows = estimated_parameters(found)
    covariance = covariance_of(found, rows)
    errors: list[float] = []
    for row in rows:
        own, true = found.rig.cone(row.where), truth.cone(row.where)
        if row.unit == "rad":
            rotation = rotation_matrix(*true.rotation_rad).T @ rotation_matrix(*own.rotation_rad)
            axis = ("omega", "phi", "kappa").index(row.what)
            errors.append(float(vectors_from_rotations(rotation)[axis]))
        elif row.what in ("right", "forward", "down"):
            place = ("forward", "right", "down").index(row.what)
            errors.append(own.position_mm[place] - true.position_mm[place])
        elif row.what in ("x", "y"):
            name = f"{row.what}_mm"
            errors.append(getattr(own.sensors[0], name) - getattr(true.sensors[0], name))
        else:
            name = "f_mm" if row.what == "f" else row.what
            errors.append(row.value - getattr(true.lens, name))
    pose = ("omega", "phi", "kappa", "right", "forward", "down")
    result = {}
    for key, chosen in {
        "all": [True] * len(rows),
        **{f"lens {h}": [r.where == h and r.what not in pose for r in rows] for h in found.heads},
        **{
            f"orientation {h}": [r.where == h and r.what in pose for r in rows]
            for h in found.relative.mountings
        },
    }.items():
        at = np.flatnonzero(chosen)
        part, own_error = covariance[np.ix_(at, at)], np.array(errors)[at]
        scale = 1.0 / np.sqrt(np.diag(part))
        scaled = own_error * scale
        result[key] = (
            float(scaled @ np.linalg.solve(part * scale[:, None] * scale, scaled)),
            len(at),
        )
    return result


def peer_difference_px(one: BoardSample, head: str) -> Array:
    """Where both calibrations see the same directions: our pixel less OpenCV's, (n, 2).

    Both lenses are compared after the rotation that fits them best, which a pose takes up.
    """
    board: CalibrationBoard = one.found.board
    own = [view for view in one.views if view.head == head]
    cone = one.found.rig.cone(head)
    sensor = cone.sensors[0]
    size = (sensor.width_px, sensor.height_px)
    start = np.array(
        [
            [cone.lens.f_mm / sensor.pitch_mm, 0.0, (size[0] - 1) / 2.0],
            [0.0, cone.lens.f_mm / sensor.pitch_mm, (size[1] - 1) / 2.0],
            [0.0, 0.0, 1.0],
        ]
    )
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO
    # Computer vision has y down and z away.
    _, matrix, distortion, _, _ = cv2.calibrateCamera(
        [(board.corners_m[v.corners.index] * [1.0, -1.0, -1.0]).astype(np.float32) for v in own],
        [v.corners.px.astype(np.float32)[:, None] for v in own],
        size,
        start,
        np.zeros(5),
        flags=flags,
    )
    margin = 0.04
    column = np.linspace(margin, 1 - margin, 17) * (size[0] - 1)
    row = np.linspace(margin, 1 - margin, 13) * (size[1] - 1)
    px = np.stack(np.meshgrid(column, row), axis=-1).reshape(-1, 2)
    ideal = ideal_from_measured(cone.lens, layer_mm_from_raw(sensor, px))
    ours = np.column_stack([ideal[:, 0], -ideal[:, 1], np.full(len(px), cone.lens.f_mm)])
    ours /= np.linalg.norm(ours, axis=1, keepdims=True)
    exactly = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    theirs = cv2.undistortPoints(px[:, None], matrix, distortion, criteria=exactly)[:, 0]
    their_rays = np.column_stack([theirs, np.ones(len(theirs))])
    their_rays /= np.linalg.norm(their_rays, axis=1, keepdims=True)
    u, _, v = np.linalg.svd(their_rays.T @ ours)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    seen, _ = cv2.projectPoints(ours @ rotation.T, np.zeros(3), np.zeros(3), matrix, distortion)
    return np.asarray(px - seen[:, 0])


def figures(seeds: Sequence[int], *, peers: int = 10, verbose: bool = False) -> dict[str, Any]:
    """Pooled figures of many drawn rigs; `peers` of them, with an exact board, with OpenCV."""
    squares: dict[str, list[tuple[float, int]]] = {"all": [], "lens": [], "orientation": []}
    peer: list[Array] = []
    sigma = []
    for seed in seeds:
        one = sample(seed)
        for key, value in squares_of(one).items():
            squares[key.partition(" ")[0]].append(value)
        if len(peer) < 2 * peers:
            exact = sample(seed, board_sigma_mm=0.0)
            peer += [peer_difference_px(exact, head) for head in exact.found.heads]
        sigma.append(one.found.sigma_px)
        if verbose:
            print(seed, squares["lens"][-2:], file=sys.stderr, flush=True)
    pooled: dict[str, Any] = {"rigs": len(seeds), "noise_px": NOISE_PX}
    for key, own in squares.items():
        total, count = (float(sum(part)) for part in zip(*own, strict=True))
        low, high = (float(chi2.ppf(p, count)) / count for p in (0.0005, 0.9995))
        pooled[key] = {
            "parameters": int(count),
            "mean_square": round(total / count, 3),
            "interval": [round(low, 3), round(high, 3)],
        }
    apart = np.concatenate(peer)
    pooled["sigma_px"] = round(float(np.mean(sigma)), 4)
    pooled["peer_rms_px"] = round(float(np.sqrt(np.mean(apart**2))), 5)
    pooled["peer_largest_px"] = round(float(np.hypot(*apart.T).max()), 5)
    pooled["free"] = [*INTERIOR[:5], "p1", "p2"]
    return pooled


def main(arguments: Sequence[str] | None = None) -> int:
    line = argparse.ArgumentParser(prog="python -m benchmarks.board", description=__doc__)
    line.add_argument("--seeds", type=int, default=40, help="number of drawn rigs")
    given = line.parse_args(arguments)
    print(json.dumps(figures(range(1, given.seeds + 1), verbose=True), indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())

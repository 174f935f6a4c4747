"""The bundle adjustment of pictures of a board: cameras, poses, heads that share an instant.

What the adjustment finds becomes a rig in `adjustment`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.network import (
    INTERIOR,
    Attitudes,
    CameraModel,
    HeadMounting,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)
from processing.calibration.board.views import BoardView, ViewPose
from processing.geometry.placement import layer_mm_from_raw
from processing.geometry.rotation import rotation_matrix
from processing.matching.calibration_board import CalibrationBoard
from processing.rig import Cone

Array = NDArray[np.float64]

LENS_KEYS: Final = {
    name: f"{name}_mm" if name in ("dx0", "dy0", "df") else name for name in INTERIOR
}
FREE: Final = ("dx0", "dy0", "df", "k1", "k2", "p1", "p2")


def mounting_of(cone: Cone, reference: Cone) -> tuple[Array, Array]:
    """Rotation and offset of a head in the axes of the reference camera, by the rig file.

    Args:
        cone: the head.
        reference: the reference head.

    Returns:
        reference_from_head, shape (3, 3), and the offset, shape (3,), m.
    """
    own, other = (rotation_matrix(*c.rotation_rad) for c in (cone, reference))
    forward, right, down = np.subtract(cone.position_mm, reference.position_mm) * 1e-3
    return np.asarray(other.T @ own), np.asarray(other.T @ np.array([right, forward, -down]))


def board_network(
    cones: Sequence[Cone],
    board: CalibrationBoard,
    views: Sequence[BoardView],
    poses: Sequence[ViewPose],
    mountings: Mapping[str, tuple[Array, Array]],
    *,
    reference: str,
    free: Sequence[str],
    sigma_px: float,
    board_sigma_mm: float,
) -> Network:
    """The network of all views.

    Args:
        cones: the heads that have views.
        board: as drawn.
        views: all of them.
        poses: of the board in each view, about.
        mountings: rotation and offset, m, against the reference head, of the heads that are
            oriented relative to it; the others have a pose of their own in every view.
        reference: name of the head that poses refer to.
        free: parameters of each lens to be estimated.
        sigma_px: standard deviation of a corner's coordinate.
        board_sigma_mm: that of the board's corners against the drawing; 0: they are held.

    Returns:
        Object system: the board.
    """
    index = {cone.name: k for k, cone in enumerate(cones)}
    keys: dict[str, int] = {}
    station, attitude, of_view, head_of_view = [], [], [], []
    heads = [reference, *mountings]
    rank = {name: k for k, name in enumerate(heads)}
    # The pose of an instant comes from the reference head where it has a picture.
    order = sorted(range(len(views)), key=lambda k: rank.get(views[k].head, len(rank)))
    pose_key = {}
    for k in order:
        view, pose = views[k], poses[k]
        is_rigid = view.head in rank
        key = view.exposure if is_rigid else f"{view.exposure}/{view.head}"
        if key not in keys:
            rotation, offset = mountings.get(view.head, (np.eye(3), np.zeros(3)))
            board_from_rig = pose.rotation.T @ rotation.T
            keys[key] = len(keys)
            attitude.append(board_from_rig)
            station.append(-pose.rotation.T @ pose.place_m - board_from_rig @ offset)
        pose_key[k] = keys[key]
    for k, view in enumerate(views):
        of_view.append(pose_key[k])
        head_of_view.append(rank.get(view.head, -1))
    names = tuple(keys)
    held = np.zeros(len(names), bool)
    corner_count = len(board.corners_m)
    seen = np.zeros(corner_count, bool)
    for view in views:
        seen[view.corners.index] = True
    point_of = np.cumsum(seen) - 1
    sigma_m = np.full((int(seen.sum()), 3), board_sigma_mm * 1e-3)
    cameras = np.array([index[view.head] for view in views])
    sizes = [len(view.corners.index) for view in views]
    image = np.repeat(np.arange(len(views)), sizes)
    by_name = {cone.name: cone for cone in cones}
    xy = np.concatenate(
        [layer_mm_from_raw(by_name[v.head].sensors[0], v.corners.px) for v in views]
    )
    pitch = np.array([cone.sensors[0].pitch_mm for cone in cones])[cameras][image]
    return Network(
        cameras=tuple(_camera(cone, free) for cone in cones),
        stations=Stations(names, np.array(station), held),
        attitudes=Attitudes(names, np.array(attitude), held),
        images=Images(
            tuple(f"{view.exposure}/{view.head}" for view in views),
            station=np.array(of_view),
            attitude=np.array(of_view),
            camera=cameras,
            head=np.array(head_of_view),
        ),
        points=Points(
            tuple(f"corner {k}" for k in np.flatnonzero(seen)),
            board.corners_m[seen],
            sigma_m,
            np.zeros(len(sigma_m), bool),
        ),
        image_points=ImagePoints(
            image=image,
            point=point_of[np.concatenate([view.corners.index for view in views])],
            xy_mm=xy,
            sigma_mm=np.stack([sigma_px * pitch] * 2, axis=1),
        ),
        heads=(
            HeadMounting(reference, np.eye(3), np.zeros(3)),
            *(
                HeadMounting(name, rotation, offset, rotation_free=True, offset_free=True)
                for name, (rotation, offset) in mountings.items()
            ),
        ),
    )


def _camera(cone: Cone, free: Sequence[str]) -> CameraModel:
    interior = np.array([float(getattr(cone.lens, LENS_KEYS[name])) for name in INTERIOR])
    # About the estimated principal point: x, y and f have columns of their own kind.
    return CameraModel(
        cone.name, cone.lens.f_mm, model="centred", interior=interior, free=frozenset(free)
    )


def started(cone: Cone) -> Cone:
    """A cone whose principal point and distance are in the sensor's place and in f.

    Args:
        cone: with one sensor, its lens as in the rig file.

    Returns:
        The same with dx0 = dy0 = df = 0, to first order, and without a residual grid.
    """
    lens, sensor = cone.lens, cone.sensors[0]
    ratio = 1.0 / (1.0 + lens.df_mm / lens.f_mm)
    scaled: dict[str, Any] = {
        name: getattr(lens, name) * ratio for name in ("k1", "k2", "k3", "p1", "p2")
    }
    moved = replace(sensor, x_mm=sensor.x_mm + lens.dx0_mm, y_mm=sensor.y_mm + lens.dy0_mm)
    new = replace(
        lens,
        f_mm=lens.f_mm * ratio,
        dx0_mm=0.0,
        dy0_mm=0.0,
        df_mm=0.0,
        residual_grid=None,
        **scaled,
    )
    return replace(cone, lens=new, sensors=(moved,))


def with_lens(cone: Cone, interior: Array) -> Cone:
    """A cone whose lens has the values of an adjustment.

    The sensor moves by the principal point's shift, so that the layer has its origin there, and
    the principal distance becomes f - df.

    Args:
        cone: with one sensor.
        interior: the ten of the centred model, shape (10,).

    Returns:
        The cone with dx0 = dy0 = df = 0.
    """
    values: dict[str, Any] = {
        LENS_KEYS[name]: float(value) for name, value in zip(INTERIOR, interior, strict=True)
    }
    sensor = cone.sensors[0]
    moved = replace(
        sensor, x_mm=sensor.x_mm + values["dx0_mm"], y_mm=sensor.y_mm + values["dy0_mm"]
    )
    values["f_mm"] = cone.lens.f_mm - values["df_mm"]
    values |= {"dx0_mm": 0.0, "dy0_mm": 0.0, "df_mm": 0.0}
    return replace(cone, lens=replace(cone.lens, **values), sensors=(moved,))

"""A block of photographs without pixels: image points of a known scene, as matching finds them.

Eight photographs look down from two lines over hills. Formulas are written here.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.importers.photographs import Photograph, rig_of
from daemon.postflight.triangulation.ground_control import GroundControl
from daemon.postflight.triangulation.photograph_block import (
    PhotographBlock,
    _exteriors,
    _matched,
    provisional_camera,
)
from daemon.postflight.triangulation.triangulation import ImageBlock
from processing.bundle.incremental_orientation import OrientedBlock
from processing.geometry.rotation import rotation_matrix
from processing.matching.block_matching import BlockTiePoints
from processing.pipelines.perspective import perspective_of

Array = NDArray[np.float64]

SIZE = (400, 300)
F_PX = 330.0
HEIGHT_M = 100.0
POINTS = 250


def height_of(plan: Array) -> Array:
    """Hills of 8 m over a plane at 600 m."""
    return np.asarray(600.0 + 8.0 * np.sin(plan[:, 0] / 23.0) * np.cos(plan[:, 1] / 31.0))


def projected(station: Array, rotation: Array, xyz: Array) -> Array:
    """Columns and rows (n, 2) of points (n, 3); the axes of a camera are right, up, back."""
    x, y, z = ((xyz - station) @ rotation).T
    middle = (np.array(SIZE) - 1.0) / 2.0
    return np.column_stack([middle[0] - F_PX * x / z, middle[1] + F_PX * y / z])


def is_inside(px: Array) -> NDArray[np.bool_]:
    """Whether pixels (n, 2) are in a photograph."""
    return np.asarray(np.all((px > 2.0) & (px < np.array(SIZE) - 3.0), axis=1))


def scene(
    *, tie_sigma_px: float = 0.1, seed: int = 3, stated_f_px: float = F_PX
) -> tuple[PhotographBlock, Array, Array]:
    """The block as matching and orientation give it, and the true stations and attitudes."""
    random = np.random.default_rng(seed)
    plan = np.array([[22.0 * (k % 4) - 33.0, 36.0 * (k // 4) - 18.0] for k in range(8)])
    station = np.column_stack([plan, np.full(8, 600.0 + HEIGHT_M)]) + random.normal(0, 2, (8, 3))
    rotation = np.array([
        rotation_matrix(
            random.normal(0.0, 0.05), random.normal(0.0, 0.05), np.pi / (-2.0 if k < 4 else 2.0)
        )
        for k in range(8)
    ])  # fmt: skip
    ground = random.uniform(-75.0, 75.0, (POINTS, 2))
    xyz = np.column_stack([ground, height_of(ground)])
    seen = [projected(station[k], rotation[k], xyz) for k in range(8)]
    rows = [(k, p) for k in range(8) for p in np.flatnonzero(is_inside(seen[k])).tolist()]
    count = np.bincount([p for _, p in rows], minlength=POINTS)
    rows = [(k, p) for k, p in rows if count[p] >= 3]
    used, point = np.unique([p for _, p in rows], return_inverse=True)
    image = np.array([k for k, _ in rows], np.int64)
    px = np.array([seen[k][p] for k, p in rows]) + random.normal(0, tie_sigma_px, (len(rows), 2))
    position = station + random.normal(0.0, 1.0, (8, 3)) * [1.5, 1.5, 2.5]
    found = _block(
        image, point.astype(np.int64), px, xyz[used], station, rotation, position, stated_f_px
    )
    return found, station, rotation


def _block(
    image: NDArray[np.int64],
    point: NDArray[np.int64],
    px: Array,
    xyz: Array,
    station: Array,
    rotation: Array,
    position: Array,
    stated_f_px: float,
) -> PhotographBlock:
    rig = rig_of({"C": photograph(stated_f_px)})
    size = perspective_of(rig.cones[0])
    frame = LocalFrame(47.05, 11.4)
    oriented = OrientedBlock(
        station=station,
        rotation=rotation,
        xyz=xyz,
        interior=np.zeros((1, 10)),
        used=np.ones(len(image), bool),
        seen=np.zeros(8, np.int64),
    )
    exposures = [exposure(number) for number in range(1, 9)]
    exteriors = _exteriors(exposures, ["C"] * 8, np.arange(8), oriented, frame, "EPSG:32632")
    block = ImageBlock(
        Mission(Path("scene"), "scene"), rig, size, exteriors, "EPSG:32632", frame, station,
        rotation, float(np.median(xyz[:, 2])),
    )  # fmt: skip
    pairs = _matched(image, point)
    return PhotographBlock(
        block,
        BlockTiePoints(image, point, px, len(xyz), pairs, pairs),
        {eo.name: f"IMG_{k}.jpg" for k, eo in enumerate(exteriors, start=1)},
        (provisional_camera(rig.cones[0]),),
        (size,),
        np.zeros(8, np.int64),
        xyz,
        position,
        (),
    )


def photograph(focal_px: float = F_PX) -> Photograph:
    """What the importer finds in a file of this scene."""
    return Photograph(
        path=Path("IMG_1.jpg"),
        camera="Maker X",
        serial="1",
        width_px=SIZE[0],
        height_px=SIZE[1],
        focal_px=focal_px,
        focal_source="FocalLength",
        pitch_mm=0.01,
        f_number=4.0,
        taken="",
        exposure_time_us=None,
        position=None,
    )


def exposure(number: int) -> Exposure:
    """A record that has a number only."""
    return Exposure(
        number=number,
        frames=(),
        missing=(),
        state="complete",
        calibration_id="",
        calibration_sha256="",
        mark_gps_ns=None,
        mark_source="none",
        software="",
    )


def measured_control(
    station: Array, rotation: Array, *, sigma_px: float = 0.3, stated_px: float = 0.5
) -> GroundControl:
    """Six points in the corners and the middle, measured in every photograph that shows them."""
    random = np.random.default_rng(8)
    plan = np.array([[-50.0, -40], [45, -38], [48, 42], [-47, 40], [2, 3], [-20, 10]])
    xyz = np.column_stack([plan, height_of(plan)])
    seen = [projected(s, r, xyz) for s, r in zip(station, rotation, strict=True)]
    rows = [(k, p) for k in range(8) for p in np.flatnonzero(is_inside(seen[k])).tolist()]
    px = np.array([seen[k][p] for k, p in rows])
    return GroundControl(
        tuple(f"p{k}" for k in range(6)),
        ("control",) * 6,
        xyz,
        np.tile((0.02, 0.02, 0.03), (6, 1)),
        np.array([k for k, _ in rows]),
        np.array([p for _, p in rows]),
        px + random.normal(0.0, sigma_px, px.shape),
        np.full(len(rows), stated_px),
    )


def turned(found: PhotographBlock, orientation: list[int]) -> PhotographBlock:
    """The block with an Orientation of EXIF for each photograph."""
    return replace(found, orientation=np.array(orientation, np.int64))

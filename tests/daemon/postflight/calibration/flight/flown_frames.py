"""A mission of rendered frames of a rig that `syntopic init` wrote, flown with real lenses.

The projection is written from the definitions of the rig file; it shares no code with what it
tests.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from daemon.initialization.answers import Answers, Arrangement
from daemon.initialization.rig_text import rig_text
from daemon.orientation.local_frame import LocalFrame
from processing.rig import Cone, Rig, load_rig
from tests.daemon.initialization.heads import head
from tests.processing.calibration.flown_tracks import distortion

Array = NDArray[np.float64]

WIDTH_PX, HEIGHT_PX, F_MM, PITCH_UM = 480, 320, 6.0, 10.0
ANGLE_DEG = 20.0
GROUND_M, EPOCH_GPS_NS = 300.0, 1_447_000_000_000_000_000
FRAME = LocalFrame(48.0, 11.0)
POSITION_SIGMA_M = 0.03
TEXTURE_M, SAMPLE_M = 360.0, 0.12
LINES = ((0.0, 100.0), (180.0, 130.0), (90.0, 100.0))
"""Heading in degrees and height above ground in m."""


def new_rig(folder: Path) -> Rig:
    """Two heads side by side, as `syntopic init` writes them."""
    heads = [head(n, width_px=WIDTH_PX, height_px=HEIGHT_PX) for n in (1, 2)]
    answers = Answers(
        "pair", Arrangement.SIDE_BY_SIDE, heads, [F_MM] * 2, [PITCH_UM] * 2, ANGLE_DEG, 100.0
    )
    (folder / "rig.toml").write_text(rig_text(answers, written_by="syntopic init"))
    return load_rig(folder / "rig.toml")


def true_rig(rig: Rig) -> Rig:
    """Lenses with distortion and a longer distance, and a second head turned by half a degree."""
    left, right = rig.cones
    lenses = [
        replace(left.lens, f_mm=1.008 * F_MM, k1=1.2e-3, p1=5e-5),
        replace(right.lens, f_mm=0.993 * F_MM, k1=0.9e-3, p2=-5e-5),
    ]
    turned = Rotation.from_euler("XYZ", right.rotation_rad)
    turned = turned * Rotation.from_rotvec([0.006, -0.004, 0.005])
    omega, phi, kappa = turned.as_euler("XYZ").tolist()
    return replace(
        rig,
        cones=(
            replace(left, lens=lenses[0]),
            replace(right, lens=lenses[1], rotation_rad=(omega, phi, kappa)),
        ),
    )


def write_mission(
    folder: Path, rig_toml: bytes, truth: Rig, lines: Sequence[tuple[float, float]] = LINES
) -> Path:
    """Render the frames of a flight of the true rig; the mission holds the rig file given."""
    mission, random = folder / "mission", np.random.default_rng(1)
    mission.mkdir()
    (mission / "rig.toml").write_bytes(rig_toml)
    (mission / "service.toml").write_text("")
    texture = _texture(random)
    rays = [_rays(cone) for cone in truth.cones]
    number = 0
    for line, (heading_deg, height_m) in enumerate(lines):
        for k in range(4):
            number += 1
            along = (k - 1.5) * 0.35 * height_m * HEIGHT_PX * PITCH_UM * 1e-3 / F_MM
            heading = math.radians(heading_deg)
            east = along * math.sin(heading) + 8.0 * line + random.normal(0.0, 1.0)
            north = along * math.cos(heading) + random.normal(0.0, 1.0)
            place = np.array([east, north, height_m])
            small = np.radians(random.normal(0.0, 2.0, 3))
            attitude = Rotation.from_euler("Z", -heading) * Rotation.from_rotvec(small)
            # The master is the left head; the middle of both looks down.
            master = attitude * Rotation.from_euler("Y", ANGLE_DEG / 2.0, degrees=True)
            level0 = mission / "L0" / f"{number:06d}"
            level0.mkdir(parents=True)
            for cone, ray in zip(truth.cones, rays, strict=True):
                picture = _frame(texture, place, master, cone, truth.cones[0], ray, random)
                tifffile.imwrite(level0 / f"{cone.name}.tif", picture)
            record = _record(number, f"line {line + 1}", place, truth, random)
            (level0 / "exposure.json").write_text(json.dumps(record))
    return mission


def _texture(random: np.random.Generator) -> NDArray[np.float32]:
    side = round(TEXTURE_M / SAMPLE_M)
    picture = np.zeros((side, side), np.float32)
    for cells, weight in ((side // 3, 0.5), (side // 10, 1.0), (side // 40, 1.0), (12, 0.5)):
        noise = random.random((cells, cells)).astype(np.float32)
        picture += weight * cv2.resize(noise, (side, side), interpolation=cv2.INTER_CUBIC)
    return np.asarray(picture / picture.max(), np.float32)


def _rays(cone: Cone) -> Array:
    """Directions of all pixels in the axes of the camera, (height, width, 3)."""
    column, row = np.meshgrid(np.arange(WIDTH_PX), np.arange(HEIGHT_PX))
    x = (column - (WIDTH_PX - 1) / 2.0) * PITCH_UM * 1e-3
    y = ((HEIGHT_PX - 1) / 2.0 - row) * PITCH_UM * 1e-3
    measured = np.stack([x.ravel(), y.ravel()], axis=1)
    ideal = measured + distortion(cone.lens, measured)
    ray = np.column_stack([ideal, np.full(len(ideal), -cone.lens.f_mm)])
    return np.asarray(ray.reshape(HEIGHT_PX, WIDTH_PX, 3))


def _frame(
    texture: NDArray[np.float32],
    place: Array,
    master: Rotation,
    cone: Cone,
    base: Cone,
    ray: Array,
    random: np.random.Generator,
) -> NDArray[np.uint16]:
    own = master.as_matrix() @ Rotation.from_euler("XYZ", cone.rotation_rad).as_matrix()
    forward, right, down = np.subtract(cone.position_mm, base.position_mm) * 1e-3
    centre = place + master.as_matrix() @ np.array([right, forward, -down])
    direction = ray @ own.T
    ground = centre[:2] - direction[..., :2] * (centre[2] / direction[..., 2:])
    column = (ground[..., 0] + TEXTURE_M / 2) / SAMPLE_M
    row = (TEXTURE_M / 2 - ground[..., 1]) / SAMPLE_M
    seen = cv2.remap(
        texture, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT,
    )  # fmt: skip
    noisy = 300.0 + 3000.0 * seen + random.normal(0.0, 10.0, seen.shape)
    return np.asarray(np.clip(noisy, 0, 4095), np.uint16)


def _record(
    number: int, line: str, place: Array, rig: Rig, random: np.random.Generator
) -> dict[str, object]:
    """The position of the master's projection centre; the antenna is there."""
    position = place + random.normal(0.0, POSITION_SIGMA_M, 3)
    gps_ns = str(EPOCH_GPS_NS + number * 1_000_000_000)
    up = np.array([0.0, 0.0, GROUND_M])
    latitude, longitude, height = FRAME.to_geodetic((position + up)[None])[0].tolist()
    return {
        "number": number,
        "simulated": True,
        "mark_gps_ns": gps_ns,
        "mark_source": "event-mark",
        "line_id": line,
        "frames": [
            {"sensor": c.name, "file": f"{c.name}.tif", "mid_exposure_gps_ns": gps_ns}
            for c in rig.cones
        ],
        "navigation": {
            "gps_ns": gps_ns,
            "latitude_deg": latitude,
            "longitude_deg": longitude,
            "height_m": height,
            "horizontal_sigma_m": POSITION_SIGMA_M,
            "vertical_sigma_m": POSITION_SIGMA_M,
        },
    }

"""`python -m sim_hw.laboratory.calibration_board --out FOLDER`: a rig before an emulated board.

A ChArUco board or chessboard is held before the heads in many poses; every head takes a picture of
it at the same instant. The truth: every lens, principal point, rotation and projection centre
differs from the rig file. The board may be bent. Projection code of its own.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from scipy.special import erf

from processing.rig import Cone, Lens, Rig, Sensor, load_rig
from sim_hw.world.seeding import random_stream
from sim_hw.world.true_camera import rotation_opk, undistorted

Array = NDArray[np.float64]

F_SHARE: Final = 0.01
POINT_PX: Final = 8.0
CORNER_PX: Final = (6.0, 2.0, 0.5, 0.5)
"""What K1, K2, P1 and P2 move the corner of the image by, one sigma."""
CONE_RAD: Final = 0.006
OFFSET_MM: Final = 3.0
OPTICS_PX: Final = 0.55
NOISE_DN: Final = 1.2
DARK, BRIGHT, GROUND = 25.0, 215.0, 120.0

NOMINAL_RIG: Final = """\
# Two heads side by side as `syntopic init` writes them: nominal values, no [calibration].
format = 1
name = "two-heads"
timing = "synchronous"
frame_interval_s = 1.0
master_cone = "left"
reference_cone = "left"
""" + "".join(
    f"""
[[cone]]
name = "{name}"
role = "pan"
bands = ["pan"]
position_mm = [0.0, {right_mm}, 0.0]    # P: forward, right, down
rotation_rad = [0.0, {phi}, 0.0]        # P
probe = ""
calibration_c = 20.0

[cone.lens]
f_mm = 8.0               # P: as printed on the lens

[[cone.sensor]]
name = "{name}"
width_px = 800
height_px = 600
pitch_um = 6.0
x_mm = 0.0               # P: the sensor is centred behind the lens
y_mm = 0.0               # P
bits = 8
"""
    for name, right_mm, phi in (("left", -30.0, 0.0), ("right", 30.0, -0.35))
)
"""The file that is written where no rig is given."""


@dataclass(frozen=True)
class DrawnBoard:
    """A board as it is: squares across and down, sizes in m, `bow_m` in its middle.

    `stretch` is its height over that of the drawing, as a printer makes it.
    """

    charuco: bool
    across: int
    down: int
    square_m: float
    marker_m: float = 0.0
    dictionary: str = "DICT_4X4_50"
    bow_m: float = 0.0
    stretch: float = 1.0

    @property
    def half_m(self) -> Array:
        return np.array([self.across, self.down * self.stretch]) * self.square_m / 2.0

    def z_m(self, xy: Array) -> Array:
        """Height of the surface over its plane."""
        share = xy / self.half_m
        return np.asarray(self.bow_m * (1.0 - (share**2).sum(axis=-1)))

    def corners_m(self) -> Array:
        """Inner corners row by row from the upper left, shape (n, 3)."""
        i, j = np.meshgrid(np.arange(1, self.across), np.arange(1, self.down))
        x = i.ravel() * self.square_m - self.half_m[0]
        y = self.half_m[1] - j.ravel() * self.square_m * self.stretch
        xy = np.stack([x, y], axis=1)
        return np.column_stack([xy, self.z_m(xy)])

    def light(self, xy: Array, optics_px: float) -> Array:
        """Brightness, 0 to 255, of the places (h, w, 2) on its plane that pixels look at.

        Edges of squares are error functions as wide as pixel and optics make them, so that
        corners lie where they are to a thousandth of a pixel.
        """
        u = (xy[..., 0] + self.half_m[0]) / self.square_m
        v = (self.half_m[1] - xy[..., 1]) / (self.square_m * self.stretch)
        blur_px = math.hypot(optics_px, math.sqrt(1.0 / 12.0))
        wide = [blur_px * np.hypot(*np.gradient(w)) * math.sqrt(2.0) + 1e-9 for w in (u, v)]
        colour = _square_wave(u, wide[0]) * _square_wave(v, wide[1])
        inside = np.ones(u.shape)
        border = np.ones(u.shape)
        for w, width, count in ((u, wide[0], self.across), (v, wide[1], self.down)):
            inside *= (erf(w / width) - erf((w - count) / width)) / 2.0
            border *= (erf((w + 0.6) / width) - erf((w - count - 0.6) / width)) / 2.0
        dark = inside * (1.0 + colour) / 2.0
        if self.charuco:
            dark += gaussian_filter(self._marker_ink(u, v), optics_px)
        return np.asarray(GROUND + border * (BRIGHT - GROUND) - dark * (BRIGHT - DARK))

    def _marker_ink(self, u: Array, v: Array) -> Array:
        """How much of a pixel the dark parts of markers cover."""
        bits = self._marker_bits()
        cells, share = bits.shape[1], self.marker_m / self.square_m
        # Markers are numbered along the rows, one in every white square.
        white = np.add.outer(np.arange(self.down), np.arange(self.across)) % 2 == 1
        number = np.where(white, np.cumsum(white.ravel()).reshape(white.shape) - 1, 0)
        (u_by_row, u_by_column), (v_by_row, v_by_column) = np.gradient(u), np.gradient(v)
        ink = np.zeros(u.shape)
        for across in (-0.25, 0.25):
            for down in (-0.25, 0.25):
                a = u + across * u_by_column + down * u_by_row
                b = v + across * v_by_column + down * v_by_row
                i, j = np.floor(a).astype(np.int32), np.floor(b).astype(np.int32)
                a = np.floor(((a - i - 0.5) / share + 0.5) * cells)
                b = np.floor(((b - j - 0.5) / share + 0.5) * cells)
                on = (i >= 0) & (j >= 0) & (i < self.across) & (j < self.down)
                on &= (a >= 0) & (b >= 0) & (a < cells) & (b < cells)
                i, j = i[on], j[on]
                bit = bits[number[j, i], b[on].astype(int), a[on].astype(int)]
                ink[on] += 0.25 * (white[j, i] & ~bit)
        return ink

    def _marker_bits(self) -> NDArray[np.bool_]:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        cells = dictionary.markerSize + 2
        return np.stack(
            [
                cv2.aruco.generateImageMarker(dictionary, k, cells) > 127
                for k in range(self.across * self.down // 2)
            ]
        )


def _square_wave(place: Array, width: Array) -> Array:
    """+1 between 0 and 1, -1 between 1 and 2 and so on, its steps error functions."""
    nearest = np.round(place)
    return np.asarray((1.0 - 2.0 * (nearest % 2.0)) * erf((place - nearest) / width))


def drawn_board(text: str, *, bow_mm: float = 0.0, stretch: float = 1.0) -> DrawnBoard:
    """The board of an argument as `--board` of `calibrate board` has it, in mm."""
    found = re.fullmatch(
        r"(charuco|chessboard):(\d+)x(\d+):([\d.]+)mm(?::([\d.]+)mm)?(?::(\dx\d_\d+))?", text
    )
    if found is None:
        raise ValueError(f"{text!r} is no board; write charuco:11x8:30mm:22mm")
    charuco = found[1] == "charuco"
    more = 0 if charuco else 1
    return DrawnBoard(
        charuco,
        int(found[2]) + more,
        int(found[3]) + more,
        float(found[4]) * 1e-3,
        float(found[5] or 0.0) * 1e-3,
        f"DICT_{(found[6] or '4x4_50').upper()}",
        bow_mm * 1e-3,
        stretch,
    )


@dataclass(frozen=True)
class TrueHeads:
    """A rig as it is: true lenses, places of the sensors, rotations and projection centres."""

    rig: Rig
    nominal: Rig

    def centre_m(self, cone: Cone) -> Array:
        """Projection centre from the master's, in the axes of the master camera."""
        master = self.rig.cone(self.rig.master_cone or self.rig.cones[0].name)
        forward, right, down = np.subtract(cone.position_mm, master.position_mm)
        return np.array([right, forward, -down]) * 1e-3

    def layer(self, sensor: Sensor, px: Array) -> Array:
        """Layer coordinates, mm, of pixel positions (..., 2)."""
        pitch = sensor.pitch_um * 1e-3
        x = sensor.x_mm + (px[..., 0] - (sensor.width_px - 1) / 2) * pitch
        y = sensor.y_mm + ((sensor.height_px - 1) / 2 - px[..., 1]) * pitch
        return np.stack([x, y], axis=-1)

    def pixels(self, cone: Cone, ray: Array) -> Array:
        """Pixel positions (n, 2) of directions (n, 3) in the axes of a head."""
        sensor = cone.sensors[0]
        pitch = sensor.pitch_um * 1e-3
        ideal = -cone.lens.f_mm * ray[:, :2] / ray[:, 2:]
        px = (ideal - [sensor.x_mm, sensor.y_mm]) / pitch * [1.0, -1.0]
        px += np.array([(sensor.width_px - 1) / 2, (sensor.height_px - 1) / 2])
        for _ in range(30):
            off = ideal - undistorted(cone.lens, self.layer(sensor, px))
            px = px + off * [1.0, -1.0] / pitch
        return np.asarray(px)


@dataclass(frozen=True)
class BoardPose:
    """Where the board is: rotation (3, 3) and middle (3,), m, in the axes of the master camera."""

    rotation: Array
    place_m: Array


def true_heads(rig: Rig, seed: int) -> TrueHeads:
    """Draw what a nominal rig file does not know."""
    master = rig.master_cone or rig.cones[0].name
    cones = []
    for cone in rig.cones:
        random = random_stream(seed, "board rig", cone.name)
        sensor = cone.sensors[0]
        pitch = sensor.pitch_um * 1e-3
        r = math.hypot(sensor.width_px, sensor.height_px) * pitch / 2.0
        k1, k2, p1, p2 = random.normal(0.0, CORNER_PX) * pitch / [r**3, r**5, r**2, r**2]
        lens = replace(
            cone.lens,
            f_mm=cone.lens.f_mm * (1.0 + float(random.normal(0.0, F_SHARE))),
            k1=float(k1),
            k2=float(k2),
            p1=float(p1),
            p2=float(p2),
        )
        x, y = random.normal(0.0, POINT_PX * pitch, 2)
        rotation, place = cone.rotation_rad, cone.position_mm
        if cone.name != master:
            error = random.normal(0.0, CONE_RAD, 3)
            turned = rotation_opk(cone.rotation_rad) @ rotation_opk(
                (float(error[0]), float(error[1]), float(error[2]))
            )
            a, b, c = (float(v) for v in Rotation.from_matrix(turned).as_euler("XYZ"))
            rotation = (a, b, c)
            f, g, h = (p + float(random.normal(0.0, OFFSET_MM)) for p in cone.position_mm)
            place = (f, g, h)
        cones.append(
            replace(
                cone,
                lens=lens,
                rotation_rad=rotation,
                position_mm=place,
                sensors=(replace(sensor, x_mm=float(x), y_mm=float(y)),),
            )
        )
    return TrueHeads(replace(rig, cones=tuple(cones)), rig)


def board_poses(
    rig: Rig, board: DrawnBoard, seed: int, count: int, *, tilt_deg: float = 30.0, roll: bool = True
) -> Iterator[BoardPose]:
    """The board in all parts of the images of all heads in turn, tilted and rolled."""
    random = random_stream(seed, "board poses")
    heads = TrueHeads(rig, rig)
    for k in range(count):
        cone = rig.cones[k % len(rig.cones)]
        turn = k // len(rig.cones)
        sensor = cone.sensors[0]
        pitch, f = sensor.pitch_um * 1e-3, cone.lens.f_mm
        half = np.array([sensor.width_px, sensor.height_px]) * pitch / 2.0
        distance = f * 2.0 * board.half_m.max() / half.min() * (0.62, 0.8, 0.95)[turn % 3]
        at = np.array([(0, 0), (-1, -1), (1, 1), (1, -1), (-1, 1), (0.9, 0), (-0.9, 0)][turn % 7])
        aim = at * 0.45 * half + random.normal(0.0, 0.05, 2) * half
        ray = rotation_opk(cone.rotation_rad) @ np.array([aim[0], aim[1], -f]) / f
        if turn % 3 == 0 and turn:
            # Between this head and the next, where both see the board.
            other = rig.cones[(k + 1) % len(rig.cones)]
            axes = [rotation_opk(c.rotation_rad)[:, 2] for c in (cone, other)]
            middle = -(axes[0] + axes[1]) / 2.0
            ray = middle + 0.15 * (ray + axes[0])
        towards = math.pi / 2.0 * turn + math.pi / 8.0 + float(random.normal(0.0, 0.15))
        tilt = math.radians(tilt_deg) * float(random.uniform(0.75, 1.2)) if tilt_deg else 0.0
        axis = np.array([-math.sin(towards), math.cos(towards), 0.0])
        rolled = (turn % 4) * math.pi / 2.0 if roll else 0.0
        rotation = Rotation.from_rotvec(tilt * axis).as_matrix() @ rotation_opk(
            (0.0, 0.0, rolled + float(random.normal(0.0, 0.05)))
        )
        yield BoardPose(
            rotation_opk(cone.rotation_rad) @ rotation, heads.centre_m(cone) + ray * distance
        )


def seen_corners(
    truth: TrueHeads, cone: Cone, pose: BoardPose, board: DrawnBoard
) -> tuple[NDArray[np.int64], Array]:
    """Which corners a head sees, and where (n, 2) px."""
    own = truth.rig.cone(cone.name)
    sensor = own.sensors[0]
    master = pose.place_m + board.corners_m() @ pose.rotation.T
    ray = (master - truth.centre_m(own)) @ rotation_opk(own.rotation_rad)
    ahead = np.flatnonzero(ray[:, 2] < 0.0)
    wide = np.abs(own.lens.f_mm * ray[ahead, :2] / ray[ahead, 2:])
    reach = np.array([sensor.width_px, sensor.height_px]) * sensor.pitch_um * 1e-3 * 0.6
    ahead = ahead[(wide < reach).all(axis=1)]
    px = truth.pixels(own, ray[ahead])
    inside = ((px > 6) & (px < np.array([sensor.width_px, sensor.height_px]) - 7)).all(axis=1)
    return ahead[inside], px[inside]


def picture(
    truth: TrueHeads,
    cone: Cone,
    pose: BoardPose,
    board: DrawnBoard,
    random: np.random.Generator,
    *,
    optics_px: float = OPTICS_PX,
) -> NDArray[np.uint8]:
    """A picture of the board by one head."""
    own = truth.rig.cone(cone.name)
    sensor = own.sensors[0]
    grid = [np.arange(float(n)) for n in (sensor.width_px, sensor.height_px)]
    px = np.stack(np.meshgrid(*grid), axis=-1)
    ideal = undistorted(own.lens, truth.layer(sensor, px))
    ray = np.concatenate([ideal, np.full((*ideal.shape[:2], 1), -own.lens.f_mm)], axis=-1)
    board_from_head = pose.rotation.T @ rotation_opk(own.rotation_rad)
    start = pose.rotation.T @ (truth.centre_m(own) - pose.place_m)
    ray = ray @ board_from_head.T
    level: Any = 0.0
    for _ in range(4 if board.bow_m else 1):
        along = (level - start[2]) / ray[..., 2]
        xy = start[:2] + along[..., None] * ray[..., :2]
        level = np.clip(board.z_m(xy), -0.1, 0.1)
    mean = np.where(along > 0.0, board.light(xy, optics_px), GROUND)
    noisy = mean + random.normal(0.0, NOISE_DN, mean.shape)
    return np.asarray(np.clip(noisy + 0.5, 0, 255), np.uint8)


def write_pictures(
    rig: Rig, board: DrawnBoard, out: Path, *, seed: int, count: int, tilt_deg: float = 30.0
) -> Path:
    """Take the pictures; returns their folder, with a folder for each head."""
    truth = true_heads(rig, seed)
    random = random_stream(seed, "board pictures")
    pictures = out / "pictures"
    for k, pose in enumerate(board_poses(rig, board, seed, count, tilt_deg=tilt_deg)):
        for cone in rig.cones:
            folder = pictures / cone.name
            folder.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / f"{k + 1:04d}.png"), picture(truth, cone, pose, board, random))
        print(f"picture {k + 1} of {count}", file=sys.stderr)
    (out / "truth.json").write_text(json.dumps(truth_record(truth), indent=1))
    return pictures


def truth_record(truth: TrueHeads) -> dict[str, Any]:
    """The true values of every head, as a rig file names them."""
    named = ("f_mm", "k1", "k2", "p1", "p2")

    def lens(own: Lens) -> dict[str, float]:
        return {name: float(getattr(own, name)) for name in named}

    return {
        cone.name: {
            "x_mm": cone.sensors[0].x_mm,
            "y_mm": cone.sensors[0].y_mm,
            "rotation_rad": list(cone.rotation_rad),
            "position_mm": list(cone.position_mm),
            **lens(cone.lens),
        }
        for cone in truth.rig.cones
    }


def main(arguments: Sequence[str] | None = None) -> int:
    line = argparse.ArgumentParser(
        prog="python -m sim_hw.laboratory.calibration_board", description=__doc__
    )
    line.add_argument("--out", type=Path, required=True, help="folder for pictures and truth")
    line.add_argument("--rig", type=Path, help="rig file of single-sensor heads (default: written)")
    line.add_argument("--board", default="charuco:11x8:30mm:22mm", help="board, lengths in mm")
    line.add_argument("--pictures", type=int, default=28, help="of each head")
    line.add_argument("--seed", type=int, default=1, help="seed for all random generators")
    line.add_argument("--bow", type=float, default=0.0, help="bow of the board, mm")
    line.add_argument("--tilt", type=float, default=30.0, help="mean tilt of the board, degrees")
    given = line.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    file = given.rig
    if file is None:
        file = given.out / "rig.toml"
        file.write_text(NOMINAL_RIG)
    pictures = write_pictures(
        load_rig(file),
        drawn_board(given.board, bow_mm=given.bow),
        given.out,
        seed=given.seed,
        count=given.pictures,
        tilt_deg=given.tilt,
    )
    print(json.dumps({"pictures": str(pictures), "rig": str(file)}))
    return 0


if __name__ == "__main__":
    sys.exit(main())

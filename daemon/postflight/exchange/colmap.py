"""COLMAP's model with rigs and frames, written as text, read as text or binary.

Files of COLMAP 3.12 and later: `cameras.txt`, `rigs.txt`, `frames.txt`, `images.txt`,
`points3D.txt`, or the same with `.bin` (`colmap_records`). Its pixel centres are at 0.5, its
cameras look along +z with y down, and it stores camera_from_world.

Source: COLMAP documentation, "Output Format" and "Rig Support"; its `src/colmap/sensor/models.h`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.exchange.block import (
    VISION_FROM_CAMERA,
    Block,
    BlockCamera,
    BlockError,
    BlockImage,
    BlockPoints,
    BlockRig,
    fitted,
)
from daemon.postflight.exchange.colmap_records import has_part, is_binary, records
from daemon.postflight.exchange.completeness import (
    refuse_announced,
    refuse_other_images,
    refuse_other_tracks,
)
from processing.geometry.forward_distortion import Form, ForwardDistortion
from processing.geometry.rotation import quaternions_from_rotations, rotations_from_quaternions

Array = NDArray[np.float64]

VERSION = "3.12"
"""The oldest version that reads rigs and frames."""
FORMS: tuple[Form, ...] = ("pinhole", "opencv", "full_opencv")
CENTRE_PX = 0.5
"""Coordinates of the first pixel's centre."""
_QUATERNION_WITHIN = 1e-3
"""Largest difference of a quaternion's length from 1."""
_POSE_WITHIN = 1e-6
"""Largest difference of an image's pose from that of its frame and rig: in elements of the matrix,
and of its shift as a part of it."""
_CAMERA = "CAMERA"

_NAMES: Mapping[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": (*("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),),
}
"""Parameters of the camera models that can be carried, in COLMAP's order."""
MODEL_OF_FORM: Mapping[Form, str] = {
    "pinhole": "PINHOLE",
    "opencv": "OPENCV",
    "full_opencv": "FULL_OPENCV",
}


def colmap_texts(block: Block, rig: BlockRig | None) -> tuple[dict[str, str], dict[str, float]]:
    """The five files of a model.

    Args:
        block: with images where the rig has them (`daemon.postflight.exchange.block.with_rig`).
        rig: None writes each camera as a rig of its own.

    Returns:
        Texts by file name, and the largest residual of each camera's fit by its name, px.

    Raises:
        BlockError: a camera fits none of COLMAP's models.
    """
    cameras, residuals = [], {}
    for number, camera in enumerate(block.cameras, 1):
        form, model, worst_px = fitted(camera, FORMS)
        residuals[camera.name] = worst_px
        values = model_parameters(MODEL_OF_FORM[form], model)
        cameras.append(
            _line(number, MODEL_OF_FORM[form], camera.width_px, camera.height_px, *values)
        )
    frames = _frames(block, rig)
    seen: list[list[str]] = [[] for _ in block.images]
    tracks: list[list[str]] = [[] for _ in block.points.xyz_m]
    for image, point, (column, row) in zip(
        block.points.image, block.points.point, block.points.px.tolist(), strict=True
    ):
        tracks[point].append(f"{image + 1} {len(seen[image])}")
        seen[image].append(f"{column + CENTRE_PX!r} {row + CENTRE_PX!r} {point + 1}")
    images = [
        line
        for number, (image, of_image) in enumerate(zip(block.images, seen, strict=True), 1)
        for line in (
            _line(number, *_pose(image.rotation, image.centre_m), image.camera + 1, image.name),
            " ".join(of_image),
        )
    ]
    points = [
        _line(number, *xyz, 128, 128, 128, 0.0, *track)
        for number, (xyz, track) in enumerate(
            zip(block.points.xyz_m.tolist(), tracks, strict=True), 1
        )
    ]
    texts = {
        "cameras.txt": ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", *cameras],
        "rigs.txt": [
            "# RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, "
            "SENSORS[] as (SENSOR_TYPE, SENSOR_ID, HAS_POSE, [QW, QX, QY, QZ, TX, TY, TZ])",
            *_rigs(block, rig),
        ],
        "frames.txt": [
            "# FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW, QX, QY, QZ, TX, TY, TZ], NUM_DATA_IDS, "
            "DATA_IDS[] as (SENSOR_TYPE, SENSOR_ID, DATA_ID)",
            *frames,
        ],
        "images.txt": [
            "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
            "# POINTS2D[] as (X, Y, POINT3D_ID)",
            *images,
        ],
        "points3D.txt": [
            "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
            *points,
        ],
    }
    return {name: "\n".join(lines) + "\n" for name, lines in texts.items()}, residuals


def vision_pose(rotation: Array, centre_m: Array) -> tuple[Array, Array]:
    """Vision camera_from_world, (3, 3) and (3,), of our frame_from_camera and its centre."""
    turn = VISION_FROM_CAMERA @ rotation.T
    return np.asarray(turn), np.asarray(-turn @ centre_m)


def camera_pose(turn: Array, shift: Array) -> tuple[Array, Array]:
    """Our frame_from_camera (3, 3) and centre (3,) of vision camera_from_world."""
    return np.asarray(turn.T @ VISION_FROM_CAMERA), np.asarray(-turn.T @ shift)


def rig_pose(rig: BlockRig, camera: int) -> tuple[Array, Array]:
    """sensor_from_rig of a camera, (3, 3) and (3,), both in axes of computer vision."""
    turn = VISION_FROM_CAMERA @ rig.rotation[camera].T @ VISION_FROM_CAMERA
    return np.asarray(turn), np.asarray(-turn @ VISION_FROM_CAMERA @ rig.offset_m[camera])


def frame_groups(block: Block, rig: BlockRig | None) -> list[tuple[int, list[int]]]:
    """Frames in order: the rig's index and the indices of their images."""
    if rig is None:
        return [(image.camera, [k]) for k, image in enumerate(block.images)]
    grouped: dict[int, list[int]] = {}
    for k, image in enumerate(block.images):
        grouped.setdefault(image.frame, []).append(k)
    return [(0, members) for members in grouped.values()]


def rig_from_world(
    block: Block, rig: BlockRig | None, members: Sequence[int]
) -> tuple[Array, Array]:
    """Pose of a frame's rig, vision axes: (3, 3) and (3,)."""
    image = block.images[members[0]]
    turn, shift = vision_pose(image.rotation, image.centre_m)
    if rig is None:
        return turn, shift
    sensor_turn, sensor_shift = rig_pose(rig, image.camera)
    return np.asarray(sensor_turn.T @ turn), np.asarray(sensor_turn.T @ (shift - sensor_shift))


def _rigs(block: Block, rig: BlockRig | None) -> Iterator[str]:
    if rig is None:
        for number in range(1, len(block.cameras) + 1):
            yield _line(number, 1, "CAMERA", number)
        return
    others = [camera for camera in rig.rotation if camera != rig.reference]
    sensors: list[object] = []
    for camera in others:
        turn, shift = rig_pose(rig, camera)
        sensors += ["CAMERA", camera + 1, 1, *_pose_values(turn, shift)]
    yield _line(1, len(others) + 1, "CAMERA", rig.reference + 1, *sensors)


def _frames(block: Block, rig: BlockRig | None) -> list[str]:
    lines = []
    for number, (of_rig, members) in enumerate(frame_groups(block, rig), 1):
        turn, shift = rig_from_world(block, rig, members)
        data: list[object] = []
        for k in members:
            data += ["CAMERA", block.images[k].camera + 1, k + 1]
        pose = _pose_values(turn, shift)
        lines.append(_line(number, of_rig + 1, *pose, len(members), *data))
    return lines


def _pose(rotation: Array, centre_m: Array) -> list[float]:
    return _pose_values(*vision_pose(rotation, centre_m))


def _pose_values(rotation: Array, shift: Array) -> list[float]:
    """Quaternion w, x, y, z and translation of a rigid motion (3, 3), (3,)."""
    return [*quaternions_from_rotations(rotation).tolist(), *shift.tolist()]


def model_parameters(name: str, model: ForwardDistortion) -> list[float]:
    """Parameters of a COLMAP camera model in its order, pixel centres at 0.5."""
    values = {
        "fx": model.fx_px, "fy": model.fy_px,
        "cx": model.cx_px + CENTRE_PX, "cy": model.cy_px + CENTRE_PX,
        **{key: getattr(model, key) for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")},
    }  # fmt: skip
    return [values[key] for key in _NAMES[name]]


def _line(*values: object) -> str:
    return " ".join(repr(v) if isinstance(v, float) else str(v) for v in values)


def read_colmap(folder: Path) -> Block:
    """Read a text or binary model; with rigs the poses of frames hold, those of images without.

    Raises:
        BlockError: a file is missing or has a line that is not understood; it names the line.
    """
    cameras: dict[int, int] = {}
    found: list[BlockCamera] = []
    for place, words in records(folder, "cameras"):
        with _reading(place):
            _refuse_repeated(place, "camera", int(words[0]), cameras)
            cameras[int(words[0])] = len(found)
            found.append(_camera(place, words))
    rows = list(records(folder, "images", keeps_empty=True))
    if len(rows) % 2:
        # An image without measurements at the end, its line of measurements lost by an editor.
        place, words = rows[-1]
        rows = [*rows, (place, [])] if words else rows[:-1]
    posed = _frame_poses(folder)
    images: list[BlockImage] = []
    index: dict[int, int] = {}
    seen: list[tuple[int, int, float, float]] = []
    listed: list[tuple[int, int, int]] = []
    for (place, words), (where, measured) in zip(rows[::2], rows[1::2], strict=True):
        with _reading(place):
            number, camera = int(words[0]), int(words[8])
            if camera not in cameras:
                raise BlockError(f"{place}: camera {camera} is not in cameras.txt")
            if len(words) < 10:
                raise BlockError(f"{place}: image {number} has no name; export the model again")
            _refuse_repeated(place, "image", number, index)
            stated = _pose_of(place, words[1:8])
            frame, own = posed.get(number, (number, stated))
            _refuse_other_pose(place, number, own, stated)
            rotation, centre = camera_pose(*own)
            index[number] = len(images)
            name = " ".join(words[9:])
            images.append(BlockImage(name, cameras[camera], frame, centre, rotation))
        with _reading(where):
            rows_of_three = zip(measured[::3], measured[1::3], measured[2::3], strict=True)
            for at, (x, y, point) in enumerate(rows_of_three):
                if int(point) >= 0:
                    column, row = _finite(where, (x, y), 2)
                    seen.append((index[number], int(point), column, row))
                    listed.append((int(point), number, at))
    if not images:
        raise BlockError(f"{folder}: the model names no image; there is nothing to import")
    if not is_binary(folder):
        refuse_announced(folder / "cameras.txt", {"cameras": len(found)})
        refuse_announced(folder / "images.txt", {"images": len(images)}, len(seen))
    notes = ["COLMAP's files state neither the frame nor the scale of their coordinates"]
    if not is_binary(folder) and any(folder.glob("*.bin")):
        notes.append("the text model is read, and not the binary model that is there, too")
    refuse_other_images(folder, "frames.txt", set(posed), set(index))
    return Block(
        folder.name, tuple(found), tuple(images), points=_points(folder, seen, listed),
        notes=tuple(notes),
        is_metric=False,
    )  # fmt: skip


class _reading:  # noqa: N801
    """Turns what is wrong with a line into a sentence that names it."""

    def __init__(self, place: str) -> None:
        self.place = place

    def __enter__(self) -> None:
        """Nothing to prepare."""

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, ValueError | IndexError | KeyError) and not isinstance(
            error, BlockError
        ):
            raise BlockError(
                f"{self.place}: not a line of COLMAP's text format ({error}); export the model "
                "with `colmap model_converter --output_type TXT`"
            ) from error


def _refuse_repeated(place: str, what: str, number: int, known: Mapping[int, int]) -> None:
    if number in known:
        raise BlockError(
            f"{place}: {what} {number} is there twice; export the model again, or remove a line"
        )


def _finite(place: str, words: Sequence[str], count: int) -> list[float]:
    values = [float(word) for word in words]
    if len(values) != count or not all(map(math.isfinite, values)):
        raise BlockError(
            f"{place}: {' '.join(words)[:60]!r} where {count} finite numbers are needed; remove "
            "the line, or export the model again"
        )
    return values


def _pose_of(place: str, words: Sequence[str]) -> tuple[Array, Array]:
    """Rotation (3, 3) and translation (3,) of QW, QX, QY, QZ, TX, TY, TZ."""
    values = _finite(place, words, 7)
    length = math.hypot(*values[:4])
    if abs(length - 1.0) > _QUATERNION_WITHIN:
        raise BlockError(
            f"{place}: a quaternion of length {length:g}; a rotation has length 1: export the "
            "model again"
        )
    return rotations_from_quaternions(values[:4]), np.array(values[4:])


def _refuse_other_pose(
    place: str, number: int, own: tuple[Array, Array], stated: tuple[Array, Array]
) -> None:
    """Refuse an image whose pose is not the one of its frame and its place in the rig."""
    turn = float(np.abs(own[0] - stated[0]).max())
    shift = float(np.abs(own[1] - stated[1]).max())
    if turn > _POSE_WITHIN or shift > _POSE_WITHIN * (1.0 + float(np.abs(stated[1]).max())):
        raise BlockError(
            f"{place}: the pose of image {number} is another one than that of its frame and rig; "
            "the files are of different models: copy all files of the model again"
        )


def _camera(place: str, words: Sequence[str]) -> BlockCamera:
    name = words[1]
    if name not in _NAMES:
        raise BlockError(
            f"{place}: camera model {name} is not carried; convert it to {', '.join(_NAMES)}"
        )
    if len(words) != 4 + len(_NAMES[name]):
        raise BlockError(f"{place}: {name} has {len(_NAMES[name])} parameters")
    value = dict(zip(_NAMES[name], (float(v) for v in words[4:]), strict=True))
    focal = value.pop("f", None)
    fx, fy = (focal, focal) if focal is not None else (value.pop("fx"), value.pop("fy"))
    cx, cy = value.pop("cx") - CENTRE_PX, value.pop("cy") - CENTRE_PX
    model = ForwardDistortion(fx, fy, cx, cy, **value)
    return BlockCamera(f"camera{words[0]}", int(words[2]), int(words[3]), model)


def _frame_poses(folder: Path) -> dict[int, tuple[int, tuple[Array, Array]]]:
    """Frame number and camera_from_world of every image, from rigs and frames; empty without."""
    if not (has_part(folder, "rigs") and has_part(folder, "frames")):
        return {}
    sensors: dict[tuple[int, str, int], tuple[Array, Array]] = {}
    for place, words in records(folder, "rigs"):
        with _reading(place):
            rig, rest = int(words[0]), words[4:]
            sensors[rig, words[2], int(words[3])] = (np.eye(3), np.zeros(3))
            count = 1
            while rest:
                has_pose = int(rest[2])
                if has_pose:
                    sensors[rig, rest[0], int(rest[1])] = _pose_of(place, rest[3:10])
                rest = rest[10 if has_pose else 3 :]
                count += 1
            if count != int(words[1]):
                raise BlockError(f"{place}: {words[1]} sensors are announced, {count} are listed")
    posed = {}
    for place, words in records(folder, "frames"):
        with _reading(place):
            turn, shift = _pose_of(place, words[2:9])
            data = words[10:]
            if len(data) != 3 * int(words[9]):
                raise BlockError(f"{place}: {words[9]} images are announced, others are listed")
            for kind, sensor, image in zip(data[::3], data[1::3], data[2::3], strict=True):
                if kind != _CAMERA:
                    continue
                key = (int(words[1]), kind, int(sensor))
                if key not in sensors:
                    raise BlockError(
                        f"{place}: rig {words[1]} has no pose of camera {sensor}; the model "
                        "belongs to another rig"
                    )
                rig_turn, rig_shift = sensors[key]
                own = (rig_turn @ turn, rig_turn @ shift + rig_shift)
                posed[int(image)] = (int(words[0]), own)
    return posed


def _points(
    folder: Path,
    seen: Sequence[tuple[int, int, float, float]],
    listed: Sequence[tuple[int, int, int]],
) -> BlockPoints:
    """Points with their measurements; `listed` are point, image and place of each, by number."""
    at: dict[int, int] = {}
    xyz: list[list[float]] = []
    tracks: list[tuple[int, int, int]] = []
    for place, words in records(folder, "points3D"):
        with _reading(place):
            _refuse_repeated(place, "point", int(words[0]), at)
            at[int(words[0])] = len(xyz)
            xyz.append(_finite(place, words[1:4], 3))
            for image, index in zip(words[8::2], words[9::2], strict=True):
                tracks.append((int(words[0]), int(image), int(index)))
    if not is_binary(folder):
        refuse_announced(folder / "points3D.txt", {"points": len(xyz)}, len(seen))
    unknown = next((point for _, point, *_ in seen if point not in at), None)
    if unknown is not None:
        raise BlockError(
            f"{folder}: images.txt measures point {unknown}, which is not in points3D.txt"
        )
    refuse_other_tracks(folder, listed, tracks)
    return BlockPoints(
        np.array(xyz).reshape(-1, 3),
        tuple(str(number) for number in at),
        np.array([image for image, *_ in seen], dtype=np.int64),
        np.array([at[point] for _, point, *_ in seen], dtype=np.int64),
        np.array([(x - CENTRE_PX, y - CENTRE_PX) for *_, x, y in seen]).reshape(-1, 2),
    )

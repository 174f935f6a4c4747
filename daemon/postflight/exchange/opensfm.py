"""OpenSfM's reconstruction and OpenDroneMap's files next to images, and the way back.

OpenSfM normalizes pixels by the longer side about the middle of the image, its topocentric frame is
ours, and it stores vision camera_from_world as a rotation vector.

Source: OpenSfM documentation, "Reconstruction File Format" and "Rig Models"; OpenDroneMap
documentation, "Image Geolocation Files" and "Splitting Large Datasets".
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.exchange.block import (
    Block,
    BlockCamera,
    BlockError,
    BlockImage,
    BlockPoints,
    BlockRig,
    fitted,
)
from daemon.postflight.exchange.colmap import camera_pose, rig_pose, vision_pose
from daemon.postflight.exchange.opensfm_tracks import TRACKS_FILE, read_tracks, refuse_bare_images
from processing.geometry.forward_distortion import ForwardDistortion
from processing.geometry.orientation import BODY_FROM_CAMERA, ENU_FROM_NED
from processing.geometry.rotation import (
    roll_pitch_heading,
    rotations_from_vectors,
    vectors_from_rotations,
)

Array = NDArray[np.float64]

RECONSTRUCTION_MAX_BYTES = 2_000_000_000
_PROJECTIONS = {
    "brown": ("focal_x", "focal_y", "c_x", "c_y", "k1", "k2", "k3", "p1", "p2"),
    "perspective": ("focal", "k1", "k2"),
}
"""Camera models that are carried, and their parameters."""
_DESCRIBING = ("projection_type", "width", "height")
_AGAIN = "export the reconstruction again"
NO_PLACE = "no reference_lla: the file states neither the place nor the scale of its coordinates"


def opensfm_texts(
    block: Block, rig: BlockRig | None, suffix: str = ""
) -> tuple[dict[str, str], dict[str, float]]:
    """`reconstruction.json`, `reference_lla.json`, rigs, `geo.txt` and `image_groups.txt`.

    Args:
        block: in a known local frame, its images as the rig has them.
        rig: None writes no rig.
        suffix: of the image files' names.

    Returns:
        Texts by file name, and the largest residual of each camera's fit by its name, px.

    Raises:
        BlockError: a camera does not fit Brown's model, or the frame is not known.
    """
    reconstruction, residuals = reconstruction_of(block, suffix)
    texts: dict[str, Any] = {
        "reference_lla.json": reconstruction["reference_lla"],
        "camera_models.json": reconstruction["cameras"],
    }
    if rig is not None:
        heads, instances = _rigs(block, rig, suffix)
        reconstruction |= {"rig_cameras": heads, "rig_instances": instances}
        texts["rig_cameras.json"] = heads
        texts["rig_assignments.json"] = {
            name: [[shot, head] for shot, head in one["rig_camera_ids"].items()]
            for name, one in instances.items()
        }
    texts["reconstruction.json"] = [reconstruction]
    written = {name: json.dumps(content, indent=1) + "\n" for name, content in texts.items()}
    written["geo.txt"] = geo_text(block, suffix)
    written["image_groups.txt"] = "".join(
        f"{image.name}{suffix} {image.line.replace(' ', '-') or 'block'}\n"
        for image in block.images
    )
    return written, residuals


def reconstruction_of(block: Block, suffix: str = "") -> tuple[dict[str, Any], dict[str, float]]:
    """The object of `reconstruction.json`, without points and rigs.

    Args:
        block: in a known local frame.
        suffix: of the image files' names.

    Returns:
        The object, and the largest residual of each camera's fit by its name, px.

    Raises:
        BlockError: a camera does not fit Brown's model, or the frame is not known.
    """
    if block.frame is None:
        raise BlockError(
            "OpenSfM states the frame of its coordinates; that of this block is unknown"
        )
    cameras, residuals = {}, {}
    for camera in block.cameras:
        _, model, residuals[camera.name] = fitted(camera, ("pinhole", "brown"))
        cameras[camera.name] = _camera_json(camera, model)
    reference = {
        "latitude": block.frame.latitude_deg,
        "longitude": block.frame.longitude_deg,
        "altitude": 0.0,
    }
    return {
        "cameras": cameras,
        "shots": {image.name + suffix: _shot(block, image) for image in block.images},
        "points": {},
        "biases": {},
        "rig_cameras": {},
        "rig_instances": {},
        "reference_lla": reference,
    }, residuals


def geo_text(block: Block, suffix: str) -> str:
    """OpenDroneMap's geolocation: longitude, latitude, height, yaw, pitch, roll, accuracies.

    Angles are those of the image: pitch and roll are zero where it looks down.
    """
    lines = ["EPSG:4326"]
    for image in block.images:
        eo = image.eo
        if eo is None:
            raise BlockError(f"image {image.name} has no orientation in a coordinate system")
        yaw, pitch, roll = yaw_pitch_roll_deg(eo.enu_from_camera)
        sigma = []
        if image.sigma_m is not None:
            east, north, up = image.sigma_m
            sigma = [f"{max(east, north):.4f}", f"{up:.4f}"]
        place = f"{eo.longitude_deg:.10f} {eo.latitude_deg:.10f} {eo.height_m:.4f}"
        angles = f"{yaw:.6f} {pitch:.6f} {roll:.6f}"
        lines.append(" ".join([image.name + suffix, place, angles, *sigma]))
    return "\n".join(lines) + "\n"


def yaw_pitch_roll_deg(enu_from_camera: Array) -> tuple[float, float, float]:
    """Yaw from true north, pitch and roll of an image as of a body whose camera looks down."""
    body = ENU_FROM_NED.T @ enu_from_camera @ BODY_FROM_CAMERA.T
    roll, pitch, yaw = (math.degrees(angle) for angle in roll_pitch_heading(body))
    return yaw % 360.0, pitch, roll


def _camera_json(camera: BlockCamera, model: ForwardDistortion) -> dict[str, Any]:
    size = max(camera.width_px, camera.height_px)
    return {
        "projection_type": "brown",
        "width": camera.width_px,
        "height": camera.height_px,
        "focal_x": model.fx_px / size,
        "focal_y": model.fy_px / size,
        "c_x": (model.cx_px - (camera.width_px - 1) / 2.0) / size,
        "c_y": (model.cy_px - (camera.height_px - 1) / 2.0) / size,
        **{key: getattr(model, key) for key in ("k1", "k2", "k3", "p1", "p2")},
    }


def _shot(block: Block, image: BlockImage) -> dict[str, Any]:
    turn, shift = vision_pose(image.rotation, image.centre_m)
    shot: dict[str, Any] = {
        "rotation": vectors_from_rotations(turn).tolist(),
        "translation": shift.tolist(),
        "camera": block.cameras[image.camera].name,
        "orientation": 1,
        "gps_position": image.centre_m.tolist(),
    }
    if image.eo is not None:
        shot["capture_time"] = image.eo.gps_ns * 1e-9
    if image.sigma_m is not None:
        shot["gps_dop"] = max(image.sigma_m)
    return shot


def _rigs(block: Block, rig: BlockRig, suffix: str) -> tuple[dict[str, Any], dict[str, Any]]:
    heads, places = {}, {}
    for camera in rig.rotation:
        turn, shift = rig_pose(rig, camera)
        places[camera] = (turn, shift)
        heads[block.cameras[camera].name] = {
            "rotation": vectors_from_rotations(turn).tolist(),
            "translation": shift.tolist(),
        }
    instances: dict[str, Any] = {}
    for image in block.images:
        name = f"{image.frame:06d}"
        if name not in instances:
            turn, shift = vision_pose(image.rotation, image.centre_m)
            head_turn, head_shift = places[image.camera]
            instances[name] = {
                "rotation": vectors_from_rotations(head_turn.T @ turn).tolist(),
                "translation": (head_turn.T @ (shift - head_shift)).tolist(),
                "rig_camera_ids": {},
            }
        ids = instances[name]["rig_camera_ids"]
        ids[image.name + suffix] = block.cameras[image.camera].name
    return heads, instances


def read_opensfm(path: Path) -> Block:
    """Read the one reconstruction of a `reconstruction.json`, measurements of `tracks.csv` there.

    Raises:
        BlockError: not such a file, several reconstructions, or a camera model not carried.
    """
    file = path / "reconstruction.json" if path.is_dir() else path
    try:
        content = json.loads(read_regular_file(file, RECONSTRUCTION_MAX_BYTES))
    except (ForeignFileError, ValueError) as error:
        raise BlockError(f"{file}: {error}; give OpenSfM's reconstruction.json") from error
    if not isinstance(content, list) or len(content) != 1:
        count = len(content) if isinstance(content, list) else "no"
        raise BlockError(
            f"{file}: {count} reconstructions; one is imported: keep one in the file, others are "
            "not in the same frame"
        )
    try:
        return _block_of(file, content[0])
    except KeyError as error:
        raise BlockError(f"{file}: not OpenSfM's format: it has no {error}; {_AGAIN}") from error
    except (AttributeError, TypeError, ValueError) as error:
        raise BlockError(f"{file}: not OpenSfM's format ({error}); {_AGAIN}") from error


def _block_of(file: Path, content: Any) -> Block:
    content = _object(content, "the reconstruction")
    described = _object(content["cameras"], "cameras")
    names = list(described)
    cameras = tuple(_camera(file, name, _object(described[name], name)) for name in names)
    instances = _object(content.get("rig_instances", {}), "rig_instances")
    frames = {
        shot: k
        for k, (name, one) in enumerate(instances.items(), 1)
        for shot in _object(
            _object(one, f"rig instance {name}")["rig_camera_ids"], "rig_camera_ids"
        )
    }
    images = []
    for number, (name, one) in enumerate(_object(content["shots"], "shots").items(), 1):
        shot = _object(one, f"shot {name}")
        if shot["camera"] not in names:
            raise BlockError(
                f"{file}: shot {name} names camera {shot['camera']}, which is not there; {_AGAIN}"
            )
        turn = rotations_from_vectors(np.array(_numbers(shot["rotation"])))
        rotation, centre = camera_pose(turn, np.array(_numbers(shot["translation"])))
        camera = names.index(shot["camera"])
        images.append(BlockImage(name, camera, frames.get(name, number), centre, rotation))
    if not images:
        raise BlockError(f"{file}: the reconstruction has no shots; there is nothing to import")
    is_placed = bool(content.get("reference_lla"))
    frame, notes = _frame(file, content["reference_lla"]) if is_placed else (None, [NO_PLACE])
    tracks = file.parent / TRACKS_FILE
    points = BlockPoints()
    if tracks.exists():
        found = _object(content.get("points", {}), "points")
        points = read_tracks(tracks, found, images, cameras)
        refuse_bare_images(tracks, points, images)
    else:
        notes.append(f"no {TRACKS_FILE} next to {file.name}, which has the image measurements")
    return Block(
        file.parent.name, cameras, tuple(images), frame, points=points, notes=tuple(notes),
        is_metric=is_placed,
    )  # fmt: skip


def _frame(file: Path, reference: Any) -> tuple[LocalFrame | None, list[str]]:
    """The local frame about `reference_lla`, and a note where its heights are others."""
    lla = _object(reference, "reference_lla")
    latitude, longitude = (_number(lla, key) for key in ("latitude", "longitude"))
    altitude = _number(lla, "altitude", 0.0)
    if abs(latitude) > 90.0 or abs(longitude) > 180.0:
        raise BlockError(
            f"{file}: reference_lla has latitude {latitude:g} and longitude {longitude:g}; degrees "
            "within 90 and 180 are right: correct it"
        )
    if altitude == 0.0:
        return LocalFrame(latitude, longitude), []
    return None, [f"heights count from {altitude} m above the ellipsoid"]


def _camera(file: Path, name: str, content: Mapping[str, Any]) -> BlockCamera:
    kind = content["projection_type"]
    if kind not in _PROJECTIONS:
        raise BlockError(
            f"{file}: camera {name} is of type {kind}; {' and '.join(_PROJECTIONS)} are carried"
        )
    carried = _PROJECTIONS[kind]
    strange = [
        key
        for key, value in content.items()
        if key not in (*carried, *_DESCRIBING) and not (isinstance(value, str) or value == 0)
    ]
    if strange:
        raise BlockError(
            f"{file}: camera {name} of type {kind} has {', '.join(strange)}; {', '.join(carried)} "
            "are carried: reconstruct without these parameters"
        )
    width, height = (_number(content, key) for key in ("width", "height"))
    if (width, height) != (int(width), int(height)):
        raise BlockError(
            f"{file}: camera {name} has {width:g} x {height:g} px; whole numbers are right: "
            "correct its size"
        )
    size = max(width, height)
    fx = _number(content, "focal_x" if kind == "brown" else "focal")
    fy = _number(content, "focal_y" if kind == "brown" else "focal")
    terms = {key: _number(content, key, 0.0) for key in ("k1", "k2", "k3", "p1", "p2")}
    model = ForwardDistortion(
        fx * size,
        fy * size,
        _number(content, "c_x", 0.0) * size + (width - 1) / 2.0,
        _number(content, "c_y", 0.0) * size + (height - 1) / 2.0,
        **terms,
    )
    return BlockCamera(name, int(width), int(height), model)


def _object(value: Any, what: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        kind = "a list" if isinstance(value, list) else repr(value)[:40]
        raise ValueError(f"{what} is {kind}, and an object is right")
    return value


def _number(content: Mapping[str, Any], key: str, default: float | None = None) -> float:
    """A finite number by its key.

    Raises:
        KeyError: it is not there and has no default.
        ValueError: something else is there.
    """
    value = content[key] if default is None else content.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{key} is {value!r}, and a finite number is right")
    return float(value)


def _numbers(values: Sequence[Any]) -> list[float]:
    numbers = [float(value) for value in values]
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{values} are not three numbers")
    return numbers

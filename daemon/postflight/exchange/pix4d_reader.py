"""Pix4D's files, read back: cameras, orientations and measurements.

Source: Pix4D support, "What does the Output Params Folder contain" and "What is the bingo file".
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Final

from daemon.postflight.exchange.block import Block, BlockCamera, BlockError, BlockImage
from daemon.postflight.exchange.colmap import CENTRE_PX
from daemon.postflight.exchange.coordinate_unit import NOT_STATED, is_in_metres, stated_system
from daemon.postflight.exchange.photogrammetry import CAMERAS_FILE
from daemon.postflight.exchange.photogrammetry_reader import (
    BINGO_PATTERNS,
    angle_readings,
    bingo_measurements,
    cameras_of,
    measured_block,
    named_orientations,
    photos_of,
)
from daemon.postflight.exchange.text_lines import lines_of, numbers_of, only_file
from processing.geometry.forward_distortion import ForwardDistortion

_HEADER: Final = ("imageName", "X", "Y", "Z", "Omega", "Phi", "Kappa")
_CAM_KEYS: Final = ("F", "Px", "Py", "K1", "K2", "K3", "T1", "T2")
_SIDE_WITHIN: Final = 1e-3


def read_pix4d(folder: Path) -> Block:
    """Read `*external_camera_parameters.txt`, `cameras.txt`, `*.cam` and `*bingo*.txt`.

    Camera files and measurements may be missing: the camera then has no distortion, or the block no
    points. Without measurements, `photos.txt` names the camera of each image where there are
    several.

    Raises:
        BlockError: a file that is missing or not understood, or files that contradict each other.
    """
    cameras = {name: _with_cam(folder, one) for name, one in cameras_of(folder).items()}
    path = only_file(
        folder, ("*external_camera_parameters.txt",), "calibrated_external_camera_parameters.txt"
    )
    oriented = named_orientations(path, "XYZ", "deg", header=_HEADER)
    stated = stated_system(folder)
    is_metric = is_in_metres(folder, stated)
    system = stated.split('"')[1] if is_metric and '"' in stated else "that of the Pix4D project"
    if any(True for pattern in BINGO_PATTERNS for _ in folder.glob(pattern)):
        measurements = only_file(folder, BINGO_PATTERNS, "<name>_bingo.txt")
        measured = bingo_measurements(measurements, cameras)
        readings = angle_readings(path, "XYZ", "deg", header=_HEADER)
        return measured_block(
            folder, cameras, oriented, measured, system, {}, readings, is_metric=is_metric
        )
    names = list(cameras)
    camera_of = dict(photos_of(folder, cameras).values())
    unknown = sorted(set(oriented) - set(camera_of)) if len(names) > 1 else []
    if unknown:
        raise BlockError(
            f"{folder}: {CAMERAS_FILE} has {len(names)} cameras, and photos.txt does not name "
            f"that of {', '.join(unknown[:5])}"
        )
    images = tuple(
        BlockImage(name, names.index(camera_of.get(name, names[0])), k, one.centre_m, one.rotation)
        for k, (name, one) in enumerate(oriented.items())
    )
    notes = (*(() if is_metric else (NOT_STATED,)), f"coordinate system: {system}")
    return Block(
        folder.resolve().name,
        tuple(cameras.values()),
        images,
        notes=notes,
        is_metric=is_metric,
    )


def _with_cam(folder: Path, camera: BlockCamera) -> BlockCamera:
    """A camera with the distortion of its camera file, where there is one."""
    path = folder / f"{camera.name}.cam"
    if not path.exists():
        return camera
    pitch = camera.pitch_mm or 1.0
    found: dict[str, float] = {}
    for number, words in lines_of(path):
        if words[0].startswith("#") or words[0] == "Pix4D":
            _agrees(path, " ".join(words), camera)
            continue
        if len(words) != 2 or words[0] not in _CAM_KEYS:
            raise BlockError(f"{path}: line {number}: {' '.join(words)[:60]!r} is not carried")
        (found[words[0]],) = numbers_of(path, number, words[1:])
    missing = [key for key in _CAM_KEYS if key not in found]
    if missing:
        raise BlockError(f"{path}: has no {', '.join(missing)}")
    f_px = found["F"] / pitch
    if f_px <= 0.0:
        raise BlockError(f"{path}: F is {found['F']:g}; it is positive")
    model = ForwardDistortion(
        f_px,
        f_px,
        found["Px"] / pitch - CENTRE_PX,
        found["Py"] / pitch - CENTRE_PX,
        k1=found["K1"],
        k2=found["K2"],
        k3=found["K3"],
        p1=found["T1"],
        p2=found["T2"],
    )
    return replace(camera, model=model)


def _agrees(path: Path, remark: str, camera: BlockCamera) -> None:
    """Whether the sensor's size in a remark is that of `cameras.txt`."""
    stated = re.search(r"sensor width of ([0-9.eE+-]+)x([0-9.eE+-]+)mm", remark)
    if stated is None:
        return
    own = [side * (camera.pitch_mm or 1.0) for side in (camera.width_px, camera.height_px)]
    sides = numbers_of(path, 1, [stated[1], stated[2]])
    if any(abs(a - b) > _SIDE_WITHIN * b for a, b in zip(sides, own, strict=True)):
        raise BlockError(
            f"{path}: a sensor of {sides[0]:g} x {sides[1]:g} mm; {CAMERAS_FILE} has "
            f"{own[0]:g} x {own[1]:g} mm"
        )

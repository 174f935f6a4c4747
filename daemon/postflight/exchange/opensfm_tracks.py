"""OpenSfM's `tracks.csv`: image measurements of the points of a reconstruction.

Source: OpenSfM, `opensfm/tracking.py` and `opensfm/src/map/src/tracks_manager.cc`: versions 0 to 2.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.postflight.exchange.block import BlockCamera, BlockError, BlockImage, BlockPoints

TRACKS_FILE: Final = "tracks.csv"
TRACKS_MAX_BYTES: Final = 2_000_000_000
_NAMED: Final = 5
_VERSION: Final = "OPENSFM_TRACKS_VERSION_v"
_COLUMNS: Final = {0: (8,), 1: (9,), 2: (11,)}
"""Columns of each version: image, track, feature, x, y, then scale from version 1 on, colour, and
segmentation and instance from version 2 on."""


def read_tracks(
    path: Path,
    points: Mapping[str, Any],
    images: Sequence[BlockImage],
    cameras: Sequence[BlockCamera],
) -> BlockPoints:
    """Points of a reconstruction with their measurements in its images.

    Tracks without a point, and images that are not in the reconstruction, are left out.

    Args:
        path: the file.
        points: `points` of the reconstruction, `coordinates` by the number of the track.
        images: of the reconstruction.
        cameras: of these images.

    Returns:
        Points in the frame of the reconstruction, measurements in px.

    Raises:
        BlockError: a file of another format; it names the line.
    """
    try:
        lines = read_regular_file(path, TRACKS_MAX_BYTES).decode("utf-8").splitlines()
    except (ForeignFileError, UnicodeDecodeError) as error:
        raise BlockError(f"{path}: {error}; give the tracks.csv of OpenSfM") from error
    version = 0
    if lines and lines[0].startswith(_VERSION):
        stated = lines[0].removeprefix(_VERSION).strip()
        if not stated.isdigit() or int(stated) not in _COLUMNS:
            raise BlockError(f"{path}: tracks of version {stated}; 0, 1 and 2 are read")
        version = int(stated)
    index = {image.name: k for k, image in enumerate(images)}
    number = {track: k for k, track in enumerate(points)}
    image_of, point_of, px = [], [], []
    for n, line in enumerate(lines[version > 0 :], 1 + (version > 0)):
        if not line.strip():
            continue
        words = line.split("\t")
        try:
            if len(words) not in _COLUMNS[version]:
                raise ValueError(f"{len(words)} columns")
            x, y = float(words[3]), float(words[4])
            if not (abs(x) < 10.0 and abs(y) < 10.0):
                raise ValueError("coordinates are shares of the longer side")
        except ValueError as error:
            raise BlockError(f"{path}, line {n}: no line of OpenSfM's tracks ({error})") from error
        at, point = index.get(words[0]), number.get(words[1])
        if at is None or point is None:
            continue
        camera = cameras[images[at].camera]
        size = max(camera.width_px, camera.height_px)
        image_of.append(at)
        point_of.append(point)
        px.append((x * size + (camera.width_px - 1) / 2, y * size + (camera.height_px - 1) / 2))
    xyz = np.array([points[track]["coordinates"] for track in points], float).reshape(-1, 3)
    if not np.isfinite(xyz).all():
        raise ValueError("coordinates of points that are not finite")
    return BlockPoints(
        xyz,
        tuple(points),
        np.array(image_of, np.int64),
        np.array(point_of, np.int64),
        np.array(px, float).reshape(-1, 2),
    )


def refuse_bare_images(path: Path, points: BlockPoints, images: Sequence[BlockImage]) -> None:
    """Refuse tracks without any measurement of an image that the reconstruction has oriented.

    Images of a rig are oriented by each other, and one of them may have none.

    Raises:
        BlockError: such images, by name.
    """
    count = np.bincount(points.image, minlength=len(images))
    frames = Counter(image.frame for image in images)
    bare = [
        image.name
        for image, measured in zip(images, count, strict=True)
        if not measured and frames[image.frame] == 1
    ]
    if bare:
        raise BlockError(
            f"{path}: has no measurement of {len(bare)} of {len(images)} images of the "
            f"reconstruction ({', '.join(bare[:_NAMED])}{', ...' if len(bare) > _NAMED else ''}); "
            "it was cut, or is of another reconstruction: copy it again"
        )

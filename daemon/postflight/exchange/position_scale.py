"""Whether the coordinates of an imported block are in metres, by positions in EXIF of its images.

A file in feet, or in a unit of its own, fits itself: points and projection centres have one
factor. Only places from elsewhere show it. Rotation and shift of the block may be any.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.orientation.antimeridian import mean_longitude
from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.exchange.block import Block, BlockError
from daemon.postflight.importers.exif_tags import TagsError, position_of, read_tags

Array = NDArray[np.float64]

PHOTOGRAPHS_MAX: Final = 100
"""Photographs of which positions are read, spread over the block."""
_SUFFIXES: Final = frozenset({".jpg", ".jpeg", ".tif", ".tiff"})
_POSITION_M: Final = 5.0
"""What positions of EXIF err by, between photographs of one flight."""
_SHARE: Final = 0.05
"""Difference of a factor from 1 that is no error of positions."""
_SHARE_MAX: Final = 0.3
"""Positions that do not determine the factor to this, show nothing."""
_UNITS_M: Final = {
    "feet": 0.3048,
    "yards": 0.9144,
    "inches": 0.0254,
    "centimetres": 0.01,
    "millimetres": 0.001,
    "kilometres": 1000.0,
}


@dataclass(frozen=True)
class PositionScale:
    """Metres of one unit of coordinates, to a share of it, by positions of some photographs."""

    metres: float
    share: float
    photographs: int

    @property
    def unit(self) -> str:
        """The unit of this length, or the factor."""
        for name, metres in _UNITS_M.items():
            if abs(self.metres / metres - 1.0) < self.share:
                return f"{name} (a factor of {self.metres:.4g})"
        return f"units of {self.metres:.4g} m"


def scale_by_photographs(folder: Path, block: Block) -> PositionScale | None:
    """Metres of a unit of coordinates, from photographs of the same names.

    Args:
        folder: with photographs, also in folders below.
        block: as read.

    Returns:
        None where positions of EXIF do not determine it: fewer than three, or too near.

    Raises:
        BlockError: no photograph of the folder has the name of an image.
    """
    files = _photographs(folder)
    named = [
        (image.centre_m, files[key])
        for image in block.images
        for key in (_stem(image.name),)
        if key in files
    ]
    if not named:
        raise BlockError(
            f"{folder}: no photograph has the name of one of {len(block.images)} images, such as "
            f"{block.images[0].name}; give the folder of the photographs of this block"
        )
    step = 1 + (len(named) - 1) // PHOTOGRAPHS_MAX
    found = [(centre, place) for centre, path in named[::step] if (place := _position(path))]
    if len(found) < 3:
        return None
    places = np.array([place for _, place in found])
    height = np.where(np.isfinite(places[:, 2]), places[:, 2], 0.0)
    frame = LocalFrame(float(places[:, 0].mean()), mean_longitude(places[:, 1].tolist()))
    return _scale(
        np.array([centre for centre, _ in found]),
        frame.from_geodetic(places[:, 0], places[:, 1], height),
    )


def _scale(centre: Array, place_m: Array) -> PositionScale | None:
    """Median ratio of distances, of pairs that are far from each other in the block."""
    first, second = np.triu_indices(len(centre), 1)
    own = np.linalg.norm(centre[first] - centre[second], axis=1)
    is_far = own > 0.5 * float(np.percentile(own, 90))
    if not is_far.any():
        return None
    true_m = np.linalg.norm(place_m[first] - place_m[second], axis=1)[is_far]
    apart_m = float(np.median(true_m))
    share = max(_SHARE, _POSITION_M / apart_m) if apart_m > 0.0 else np.inf
    if share > _SHARE_MAX:
        return None
    return PositionScale(float(np.median(true_m / own[is_far])), share, len(centre))


def scale_notes(path: Path, scale: PositionScale, *, is_metric: bool) -> tuple[str, ...]:
    """What the factor shows.

    Args:
        path: of the block, for the message.
        scale: by photographs.
        is_metric: the files or the caller state metres.

    Raises:
        BlockError: coordinates that are stated to be in metres are not.
    """
    by = f"by the positions in EXIF of {scale.photographs} photographs"
    is_one = abs(scale.metres - 1.0) < scale.share
    if is_one:
        return (f"coordinates are in metres {by} (a factor of {scale.metres:.3f})",)
    if is_metric:
        raise BlockError(
            f"{path}: its coordinates are stated to be in metres, and {by} they are in "
            f"{scale.unit}; convert positions and points to metres in the other program, or give "
            "the photographs of this block"
        )
    return (
        f"coordinates are in {scale.unit} {by}; the project has this scale, and --position-sigma "
        "would need metres",
    )


def _photographs(folder: Path) -> dict[str, Path]:
    """Files by the stems of their names; those of two files with one stem are left out."""
    try:
        paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in _SUFFIXES)
    except OSError as error:
        raise BlockError(f"{folder}: cannot be read ({error.strerror})") from error
    found: dict[str, Path] = {}
    twice: set[str] = set()
    for path in paths:
        twice |= {path.stem} & found.keys()
        found[path.stem] = path
    return {stem: path for stem, path in found.items() if stem not in twice}


def _stem(name: str) -> str:
    """The name of an image as that of its file: without folders and a known suffix."""
    file = Path(name.replace("\\", "/"))
    return file.stem if file.suffix.lower() in _SUFFIXES else file.name


def _position(path: Path) -> Sequence[float] | None:
    try:
        return position_of(read_tags(path))
    except TagsError:
        return None

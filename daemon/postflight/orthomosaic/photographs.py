"""Photographs as images of an orthomosaic: undistorted by the adjusted interior orientation.

Values are those of the file, encoded as the camera encoded them: of 16 bits as they are, of 8 bits
times 256. PAN is their luma.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.mission.layout import Mission
from daemon.mission.store.level0 import RasterError
from daemon.orientation.exterior_orientation import sealed_exposure
from daemon.postflight.triangulation.photograph_matching import original_pixels
from processing.image.kernels import DEFAULT_INTERPOLATION
from processing.image.lattice import OUTSIDE
from processing.image.resampling import SUPPORT_MARGIN_PX, WEIGHT_UNIT, resample
from processing.pipelines.perspective import perspective_of, raw_of_perspective
from processing.rig import Cone, load_rig

Array = NDArray[Any]

BANDS: Final = ("red", "green", "blue")
RIG_FILE: Final = "adjusted-rig.toml"
"""In the folder of a triangulation of photographs."""
_LUMA: Final = {"red": 0.299, "green": 0.587, "blue": 0.114}
"""Source: ITU-R BT.601, luma of gamma-encoded components; JPEG uses it."""
_CELL_PX: Final = 16
_DECODED_MAX: Final = 4
_WORD_MAX: Final = 65534


def adjusted_heads(folder: Path) -> tuple[Cone, ...]:
    """The heads with the interior orientations that a triangulation adjusted.

    Args:
        folder: of the triangulation.

    Raises:
        RigError: the file is missing or cannot be read.
    """
    return load_rig(folder / RIG_FILE).cones


def source_of(mission: Mission, number: int) -> Path:
    """The file of a photograph.

    Raises:
        RasterError: the exposure has no frame.
    """
    exposure = sealed_exposure(mission, number)
    if exposure is None or not exposure.frames:
        raise RasterError(f"{mission.level0(number)}: it holds no photograph")
    return mission.level0(number) / exposure.frames[0].file


def check_photograph(mission: Mission, number: int, head: Cone) -> None:
    """Whether a photograph can be decoded.

    Raises:
        RasterError: no image, damaged, or of another size.
    """
    _decoded(mission, number, head, source_of(mission, number).stat().st_mtime_ns)


def photograph_pixels(
    mission: Mission,
    number: int,
    head: Cone,
    bands: tuple[str, ...],
    window: tuple[int, int, int, int],
) -> Array:
    """Bands of a photograph in strict perspective.

    Args:
        mission: of the photograph.
        number: of its exposure.
        head: with the adjusted interior orientation.
        bands: "pan" first, then colour bands.
        window: first column and row, columns, rows.

    Returns:
        (bands, rows, columns) uint16; 0 is no data.

    Raises:
        RasterError: no image, damaged, or of another size.
    """
    decoded = _decoded(mission, number, head, source_of(mission, number).stat().st_mtime_ns)
    c, r, width, height = window
    first = (r // _CELL_PX, c // _CELL_PX)
    last = (-(-(r + height) // _CELL_PX), -(-(c + width) // _CELL_PX))
    lattice = np.ascontiguousarray(_lattice(head)[first[0] : last[0] + 1, first[1] : last[1] + 1])
    planes = {}
    for k, band in enumerate(BANDS):
        words = np.asarray(decoded[..., k], np.uint16)
        if decoded.dtype == np.uint8:
            words = words * 256 + 128
        whole = _resampled(words, lattice)
        r0, c0 = r - first[0] * _CELL_PX, c - first[1] * _CELL_PX
        planes[band] = whole[r0 : r0 + height, c0 : c0 + width]
    luma = sum(weight * planes[band] for band, weight in _LUMA.items())
    is_seen = np.all([planes[band] > 0 for band in BANDS], axis=0)
    planes["pan"] = np.where(is_seen, np.clip(np.rint(luma), 1, _WORD_MAX), 0).astype(np.uint16)
    return np.stack([np.where(is_seen, planes[band], 0).astype(np.uint16) for band in bands])


@lru_cache(maxsize=_DECODED_MAX)
def _decoded(
    mission: Mission, number: int, head: Cone, _mtime_ns: int
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    exposure = sealed_exposure(mission, number)
    if exposure is None:
        raise RasterError(f"{mission.level0(number)}: it is not sealed")
    return original_pixels(mission, exposure, perspective_of(head), grey=False)


@lru_cache(maxsize=8)
def _lattice(head: Cone) -> Array:
    """Column and row in the file at every `_CELL_PX`-th pixel, beyond the last pixel too."""
    image = perspective_of(head)
    columns = np.arange(-(-image.width_px // _CELL_PX) + 1) * float(_CELL_PX)
    rows = np.arange(-(-image.height_px // _CELL_PX) + 1) * float(_CELL_PX)
    c, r = np.meshgrid(columns, rows)
    raw = raw_of_perspective(head, {}, np.stack([c.ravel(), r.ravel()], axis=1))
    raw[~np.isfinite(raw).all(axis=1)] = OUTSIDE
    return np.asarray(raw.reshape(*c.shape, 2))


def _resampled(plane: NDArray[np.uint16], lattice: Array) -> NDArray[np.uint16]:
    """The part of a plane that a lattice covers, resampled once."""
    rows, columns = plane.shape
    height, width = ((n - 1) * _CELL_PX for n in lattice.shape[:2])
    value = np.empty((height, width), np.uint16)
    source = np.empty((height, width), np.uint8)
    edge = float(SUPPORT_MARGIN_PX)
    resample(
        np.ascontiguousarray(plane)[None],
        np.array([[edge, columns - 1 - edge - 1e-3, edge, rows - 1 - edge - 1e-3]]),
        lattice[None],
        _CELL_PX,
        np.full((1, *(2 * (n - 1) + 1 for n in lattice.shape[:2])), WEIGHT_UNIT, np.uint8),
        np.ones(1, np.float32),
        interpolation=DEFAULT_INTERPOLATION,
        out=value,
        source=source,
    )
    value = np.clip(value, 1, _WORD_MAX)
    value[source == 0] = 0
    return np.asarray(value, np.uint16)

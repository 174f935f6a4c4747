"""Frames of no flight: a texture every sensor sees, so that each step can be exercised beforehand.

Only for compiling and warming up; nothing is measured with them.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import nominal_placements, vip_mm_from_raw, vip_px_from_mm
from processing.radiometry.calibration import RadiometricCalibration, neutral_radiometry
from processing.rig import Rig, Sensor

Array = NDArray[Any]

_TILE_PX: Final = 256
_LATTICE: Final = 65
"""Nodes along each axis of a frame between which the placement is interpolated."""
_SEED: Final = 20


def synthetic_frames(rig: Rig) -> dict[str, Array]:
    """Frames of one plane texture in the nominal placement.

    The frames agree to a tenth of a pixel. The search for shifted bands thus ends in its first
    round.

    Args:
        rig: the camera.

    Returns:
        Level-0 frames by sensor, (h, w) uint16; empty without a virtual image.
    """
    image = rig.virtual_image
    if image is None:
        return {}
    tile = _tile()
    placements = nominal_placements(rig, {}, {})
    frames = {}
    for sensor in rig.sensors:
        columns = np.linspace(0.0, sensor.width_px - 1.0, _LATTICE)
        rows = np.linspace(0.0, sensor.height_px - 1.0, _LATTICE)
        nodes = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        px = vip_px_from_mm(image, vip_mm_from_raw(placements[sensor.name], nodes))
        words = sensor.black_dn + tile * (sensor.full_scale_dn - sensor.black_dn)
        nodes_px = px.reshape(_LATTICE, _LATTICE, 2)
        frames[sensor.name] = _seen(words.astype(np.uint16), nodes_px, sensor)
    return frames


def synthetic_head_frames(rig: Rig) -> dict[str, Array]:
    """Frames of a texture for rigs whose images lie in no common plane.

    Args:
        rig: the camera.

    Returns:
        Level-0 frames by sensor, (h, w) uint16.
    """
    tile = _tile()
    frames = {}
    for sensor in rig.sensors:
        rows, columns = np.arange(sensor.height_px) * 0.5, np.arange(sensor.width_px) * 0.5
        signal = _periodic(tile, rows, columns) * (sensor.full_scale_dn - sensor.black_dn)
        raw = (sensor.black_dn + signal) * sensor.raw_units_per_dn
        frames[sensor.name] = raw.astype(np.uint16)
    return frames


def synthetic_radiometry(sensor: Sensor) -> RadiometricCalibration:
    """A calibration with maps and a defect, for a sensor of no flight.

    Args:
        sensor: its size counts.

    Returns:
        A gain of one but for the first row, and one defective pixel.
    """
    shape = (sensor.height_px, sensor.width_px)
    gain = np.ones(shape, np.float32)
    gain[0] = 1.01
    defect = np.zeros(shape, np.uint8)
    defect[shape[0] // 2, shape[1] // 2] = 1
    return replace(neutral_radiometry(sensor), gain=gain, defect=defect)


def _tile() -> Array:
    """Periodic noise between 0.2 and 0.8, smooth over two pixels of the colour raster."""
    noise = np.random.default_rng(_SEED).standard_normal((_TILE_PX, _TILE_PX))
    f = np.hypot(np.fft.fftfreq(_TILE_PX)[:, None], np.fft.fftfreq(_TILE_PX)[None, :])
    smooth = np.fft.ifft2(np.fft.fft2(noise) * np.exp(-((f / 0.08) ** 2))).real
    low, high = smooth.min(), smooth.max()
    tile: Array = (0.2 + 0.6 * (smooth - low) / (high - low)).astype(np.float32)
    return tile


def _seen(words: Array, nodes_px: Array, sensor: Sensor) -> Array:
    """The repeated tile as a sensor sees it, (h, w) uint16.

    Args:
        words: the tile, (n, n) uint16.
        nodes_px: (k, k, 2), virtual image coordinates (column, row) of a lattice over the frame.
        sensor: its frame has the size of the result.
    """
    # Modulo the tile's size: float32 keeps 1e-3 px over a frame of 10,000 px.
    nodes = (nodes_px - nodes_px.min(axis=(0, 1)) // _TILE_PX * _TILE_PX).astype(np.float32)
    rows, row_shares = _between_nodes(sensor.height_px)
    columns, column_shares = _between_nodes(sensor.width_px)
    firsts = np.searchsorted(columns, np.arange(_LATTICE))
    lines = nodes[rows] + (nodes[rows + 1] - nodes[rows]) * row_shares[:, None, None]
    at = np.empty((2, sensor.height_px, sensor.width_px), np.float32)
    for k, (first, end) in enumerate(itertools.pairwise(firsts)):
        for plane, line in zip(at, lines.transpose(2, 0, 1), strict=True):
            left, right = line[:, k, None], line[:, k + 1, None]
            np.multiply(right - left, column_shares[first:end], out=plane[:, first:end])
            plane[:, first:end] += left
    # OpenCV's own wrapping takes five times as long.
    wide, high = nodes.max(axis=(0, 1)).astype(np.intp) // _TILE_PX + 2
    seen: Array = cv2.remap(np.tile(words, (high, wide)), at[0], at[1], cv2.INTER_LINEAR)
    return seen


def _between_nodes(pixels: int) -> tuple[Array, Array]:
    """The node of the lattice before each pixel of a line, and how far past it the pixel is.

    OpenCV would interpolate in steps of a 32nd of the distance of nodes, which is pixels.
    """
    at = np.linspace(0.0, _LATTICE - 1.0, pixels)
    node = np.minimum(at.astype(np.intp), _LATTICE - 2)
    return node, (at - node).astype(np.float32)


def _periodic(tile: Array, rows: Array, columns: Array) -> Array:
    """The tile's value at every row and column, linear, repeated without end."""
    r, c = np.floor(rows).astype(np.intp), np.floor(columns).astype(np.intp)
    fr = (rows - r).astype(np.float32)[:, None]
    fc = (columns - c).astype(np.float32)[None, :]
    r0, r1, c0, c1 = r % _TILE_PX, (r + 1) % _TILE_PX, c % _TILE_PX, (c + 1) % _TILE_PX
    upper = tile[np.ix_(r0, c0)] * (1 - fc) + tile[np.ix_(r0, c1)] * fc
    lower = tile[np.ix_(r1, c0)] * (1 - fc) + tile[np.ix_(r1, c1)] * fc
    value: Array = upper * (1 - fr) + lower * fr
    return value

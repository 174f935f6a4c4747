"""Small windows of every frame on the same ground: their signal and their fine detail.

PAN heads share strips only, but each place is seen by all colour heads too. PAN is reduced to the
size of colour pixels. What follows for a head is in `processing.quality.local_sharpness` and
`processing.quality.band_levels`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numba import prange
from numpy.typing import NDArray

from processing.geometry.placement import (
    SensorPlacement,
    vip_mm_from_px,
    vip_mm_from_raw,
)
from processing.geometry.topology import exact_colour_ratio
from processing.image.compiled_kernel import compiled_kernel
from processing.matching.prefetch import fetch_ahead
from processing.radiometry.level1 import exposed_rows, level1_counts_per_dn
from processing.rig import Rig, Sensor, VirtualImage

Array = NDArray[Any]

WINDOWS: Final = (56, 36)
"""Columns and rows of windows in the virtual image."""
WINDOW_PX: Final = 16
"""Side of a window, colour pixels."""
_COLUMNS: Final = 10
_BORDER_SHARE: Final = 0.04
"""Of half its sides by which the rectangle around a frame is widened: the lens bends the border."""
_ORDER: Final = 4
_LATTICE: Final = np.stack(
    [share.ravel() for share in np.meshgrid(np.linspace(0.0, 1.0, 7), np.linspace(0.0, 1.0, 7))],
    axis=1,
)
"""Places (49, 2) as shares of a frame."""
_NO_DATA_LESS_ONE: Final = np.uint32(1 << 31)
_PART: Final = 64
"""Windows that one thread measures in a row; the next one is fetched meanwhile."""


@dataclass(frozen=True)
class CommonWindows:
    """Windows (n) of all frames (f) on the same ground; NaN where a frame does not show one whole.

    `names` are the frames, `pan` (f,) marks those of PAN heads. `place` (f, n, 2) is the centre
    of a window as a share of its frame's width and height, `mean` (f, n) its signal in Level-1
    counts, `noise` (f, n) the variance of a pixel that light and read-out explain. The rest is
    along columns and along rows, (f, n, 2): `near` and `far` the mean squared differences of pixels
    one and two apart, `curved` the mean square of the second difference, all three in pixels of
    colour and less noise; `fine` that of neighbouring pixels of the frame itself. One of
    `every` windows of the grid is measured; `finer` measures all.
    """

    names: tuple[str, ...]
    pan: Array
    place: Array
    mean: Array
    noise: Array
    noise_reduced: Array
    near: Array
    far: Array
    curved: Array
    fine: Array
    every: int
    finer: Callable[[], CommonWindows]


def measure_common_windows(
    rig: Rig, placements: Mapping[str, SensorPlacement], frames: Mapping[str, Array]
) -> CommonWindows | None:
    """Measure all frames in every fourth window of an even grid of the virtual image.

    Args:
        rig: the camera.
        placements: of the sensors, by name.
        frames: Level-1 words by sensor name, (h, w) uint16. Those behind a colour filter array are
            left out.

    Returns:
        None for a rig without a virtual image.
    """
    image = rig.virtual_image
    return None if image is None else _measured(rig, image, placements, frames, every=4)


def _measured(
    rig: Rig,
    image: VirtualImage,
    placements: Mapping[str, SensorPlacement],
    frames: Mapping[str, Array],
    *,
    every: int,
) -> CommonWindows:
    """All frames in every window of the grid, or in one of so many, along diagonals."""
    vip_mm = vip_mm_from_px(image, _centres(image, every))
    ratio = max(round(exact_colour_ratio(rig) or 1.0), 1)
    pan = {s.name for cone in rig.pan_cones for s in cone.sensors}
    sensors = [s for s in rig.sensors if s.name in frames and s.colour_filter_array == "none"]
    measured = np.full((len(sensors), len(vip_mm), _COLUMNS), np.nan)
    noise = np.full((len(sensors), len(vip_mm)), np.nan)
    place = np.full((len(sensors), len(vip_mm), 2), np.nan)
    steps = np.array([ratio if s.name in pan else 1 for s in sensors])
    for k, sensor in enumerate(sensors):
        at, inside = _inside(placements[sensor.name], vip_mm, steps[k] * WINDOW_PX // 2)
        place[k, inside] = at / (sensor.width_px, sensor.height_px)
        sums = np.empty((len(at), _COLUMNS))
        corners = np.rint(at).astype(np.int64) - steps[k] * WINDOW_PX // 2
        _window_sums(frames[sensor.name], corners, steps[k], WINDOW_PX, sums)
        sums[sums[:, 9] == 0.0] = np.nan
        measured[k, inside] = sums
        noise[k, inside] = _variance(sensor, sums[:, 8])
    reduced = noise / steps[:, None] ** 2
    return CommonWindows(
        names=tuple(s.name for s in sensors),
        pan=np.array([s.name in pan for s in sensors], dtype=np.bool_),
        place=place,
        mean=measured[..., 8],
        noise=noise,
        noise_reduced=reduced,
        near=measured[..., 0:2] - 2.0 * reduced[..., None],
        far=measured[..., 2:4] - 2.0 * reduced[..., None],
        curved=measured[..., 4:6] - 6.0 * reduced[..., None],
        fine=measured[..., 6:8] - 2.0 * noise[..., None],
        every=every,
        finer=lambda: _measured(rig, image, placements, frames, every=1),
    )


def _centres(image: VirtualImage, every: int) -> Array:
    """Centres (n, 2) of the windows, pixels of the virtual image."""
    columns, rows = np.meshgrid(*(np.arange(count) for count in WINDOWS))
    used = (columns + rows) % every == 0
    share = (np.stack([columns[used], rows[used]], axis=1) + 0.5) / WINDOWS
    return np.asarray(share * (image.width_px, image.height_px))


def _inside(placement: SensorPlacement, vip_mm: Array, half_px: int) -> tuple[Array, Array]:
    """Raw places (m, 2) of the windows that lie whole in a frame, and which (n,) those are.

    A polynomial through places of a lattice of the frame suffices: windows begin at whole pixels.
    """
    sensor = placement.sensor
    first, last = exposed_rows(sensor, placement.tdi_shifts)
    size = np.array([sensor.width_px - 1.0, sensor.height_px - 1.0])
    lattice_mm = vip_mm_from_raw(placement, _LATTICE * size)
    low, high = lattice_mm.min(axis=0), lattice_mm.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    terms = _terms((lattice_mm - middle) / half)
    coefficients = np.linalg.solve(terms.T @ terms, terms.T @ (_LATTICE * size))
    at = np.full((len(vip_mm), 2), np.nan)
    near = np.flatnonzero(np.all(np.abs(vip_mm - middle) < (1.0 + _BORDER_SHARE) * half, axis=1))
    at[near] = _terms((vip_mm[near] - middle) / half) @ coefficients
    least, most = (half_px, first + half_px), (sensor.width_px - half_px - 1, last - half_px)
    inside: Array = np.all((at > least) & (at < most), axis=1)
    return at[inside], inside


@compiled_kernel()
def _terms(places: Array) -> Array:
    """Terms of a polynomial of order `_ORDER` in two coordinates (n, 2) within -1 to 1."""
    terms = np.empty((len(places), (_ORDER + 1) * (_ORDER + 2) // 2))
    for n in range(len(places)):
        x, y = places[n]
        last, power = 0, 1.0
        terms[n, 0] = 1.0
        for k in range(1, _ORDER + 1):
            # Those of the order before times y, and the last of them times x.
            first, power = last + 1, power * x
            for i in range(k):
                terms[n, first + i] = terms[n, last - k + 1 + i] * y
            last += k + 1
            terms[n, last] = power
    return terms


def _variance(sensor: Sensor, signal: Array) -> Array:
    """Variance of a pixel by photons and read-out, Level-1 counts squared."""
    counts = level1_counts_per_dn(sensor.bits)
    electrons = np.maximum(signal / counts, 0.0) * sensor.electrons_per_dn
    variance: Array = (electrons + sensor.read_noise_e**2) * (counts / sensor.electrons_per_dn) ** 2
    return variance


@compiled_kernel(parallel=True, fastmath={"reassoc", "contract"})
def _window_sums(frame, corners, step, size, out):
    """Rows of `out`: near, far, curved, fine (each along columns and along rows), the mean, and 1
    where all pixels are good."""
    side = step * size
    for part in prange((len(corners) + _PART - 1) // _PART):
        window = np.zeros((size, size), np.float32)
        # Elements of arrays stay 32 bits wide; numba's scalars would be of 64.
        column = np.zeros(side, np.uint32)
        union = np.zeros(side, np.uint32)
        last = min((part + 1) * _PART, len(corners))
        for i in range(part * _PART, last):
            left, top = corners[i, 0], corners[i, 1]
            if i + 1 < last:
                fetch_ahead(frame, corners[i + 1, 0], corners[i + 1, 1], side + 1, side + 1)
            union[:] = 0
            fine_y = fine_x = np.float32(0.0)
            for y in range(size):
                column[:] = 0
                for r in range(top + y * step, top + (y + 1) * step):
                    line = frame[r, left : left + side + 1]
                    after = frame[r + 1, left : left + side]
                    for j in range(side):
                        word = np.uint32(line[j])
                        column[j] += word
                        # The lowest bit of a saturated word, the highest one of no data less one.
                        union[j] |= word | ((word - np.uint32(1)) & _NO_DATA_LESS_ONE)
                    for j in range(side):
                        here = np.float32(line[j])
                        down = np.float32(after[j]) - here
                        right = np.float32(line[j + 1]) - here
                        fine_y += down * down
                        fine_x += right * right
                into = window[y]
                for x in range(size):
                    total = np.uint32(0)
                    for j in range(x * step, (x + 1) * step):
                        total += column[j]
                    into[x] = np.float32(total)
            near_y = near_x = far_y = far_x = curved_y = curved_x = mean = np.float32(0.0)
            for y in range(size - 2):
                here, below, under = window[y], window[y + 1], window[y + 2]
                for x in range(size - 2):
                    value = here[x]
                    mean += value
                    one, two = below[x] - value, under[x] - value
                    near_y += one * one
                    far_y += two * two
                    curved_y += (two - one - one) * (two - one - one)
                    one, two = here[x + 1] - value, here[x + 2] - value
                    near_x += one * one
                    far_x += two * two
                    curved_x += (two - one - one) * (two - one - one)
            good = True
            for j in range(side):
                good &= (union[j] & (_NO_DATA_LESS_ONE | np.uint32(1))) == 0
            inner = np.float64((size - 2) * (size - 2))
            pixel = np.float64(step * step)
            square = 1.0 / (inner * pixel * pixel)
            out[i, 0], out[i, 1] = near_y * square, near_x * square
            out[i, 2], out[i, 3] = far_y * square, far_x * square
            out[i, 4], out[i, 5] = curved_y * square, curved_x * square
            pixels = np.float64(size * size) * pixel
            out[i, 6], out[i, 7] = fine_y / pixels, fine_x / pixels
            out[i, 8] = mean / (inner * pixel)
            out[i, 9] = 1.0 if good else 0.0

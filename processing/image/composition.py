"""Composing rasters from corrected frames: PAN of many sensors, colour of one sensor each band.

Holds the buffers, which are allocated once and used again for every exposure. Placements
give the positions of sensors.
"""

from __future__ import annotations

import math
import mmap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import (
    SensorPlacement,
    nominal_placements,
    vip_mm_from_raw,
    vip_px_from_mm,
)
from processing.image.accelerator.pixel_kernels import Resample
from processing.image.balance import Balance, balance_gains, node_means
from processing.image.colour import ColourHead
from processing.image.kernels import Interpolation
from processing.image.lattice import (
    OUTSIDE,
    colour_raster,
    fill_lattice,
    interpolate_lattice,
    lattice_shape,
    pan_raster,
)
from processing.image.resampling import (
    WEIGHT_STEP_PX,
    WEIGHT_UNIT,
    resample,
    usable_area,
)
from processing.image.seams import seam_labels, seam_weights
from processing.radiometry.demosaic import BAYER_BANDS, demosaic, is_bayer
from processing.radiometry.level1 import exposed_rows
from processing.radiometry.unclean_blocks import unknown_blocks
from processing.rig import Rig, Sensor, VirtualImage

Array = NDArray[Any]

PAN_CELL_PX: Final = 64
COLOUR_CELL_PX: Final = 32
"""Spacing of the lattices of inverse mapping; a short lens bends its pixels faster. Linear
interpolation between nodes is good to 0.003 px of PAN, 0.005 px of colour on every rig."""

LATTICE_ERROR_PX: Final = 0.008
"""Both ways together, at the worst place."""

_OUTSIDE_LATTICE: Final = (1.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True)
class Composition:
    """The PAN image: `pan` (H, W) uint16, 0 no data; `source` (H, W) uint8 as in
    `processing.image.resampling.resample`, an index into the composer's sensors."""

    pan: Array
    source: Array
    balance: Balance


def pan_cell_px(rig: Rig) -> int:
    """The widest lattice of `PAN_CELL_PX`, its half, its quarter that follows every PAN sensor.

    A head that is tilted bends straight lines of the virtual image faster.

    Args:
        rig: the camera.

    Returns:
        Lattice spacing, target pixels.

    Raises:
        ValueError: the rig has no virtual image.
    """
    placements = nominal_placements(rig, {}, {})
    sensors = [sensor for cone in rig.pan_cones for sensor in cone.sensors]
    image = rig.virtual_image
    if image is None:
        raise ValueError(f"rig {rig.name} has no [virtual_image]; there is nothing to compose")
    bend = 0.0
    rows, columns = lattice_shape(pan_raster(image), PAN_CELL_PX)
    for sensor in sensors:
        lattice = np.full((rows, columns, 2), OUTSIDE)
        fill_lattice(image, pan_raster(image), placements[sensor.name], PAN_CELL_PX, lattice)
        lattice[lattice == OUTSIDE] = np.nan
        for axis in (0, 1):
            steps = np.abs(np.diff(lattice, 2, axis=axis))
            bend = max(bend, float(np.nanmax(steps, initial=0.0)))
    # A line between nodes is off by an eighth of the second difference; both ways add up.
    cell = PAN_CELL_PX
    while bend / 4.0 > LATTICE_ERROR_PX and cell > PAN_CELL_PX // 4:
        cell, bend = cell // 2, bend / 4.0
    return cell


class PanComposer:
    """Level-1 frames of the PAN sensors and what is needed to make one image of them."""

    def __init__(
        self,
        image: VirtualImage,
        sensors: Collection[Sensor],
        *,
        cell_px: int = PAN_CELL_PX,
        resample: Resample = resample,
    ) -> None:
        self.image = image
        self.resample = resample
        self.cell_px = cell_px
        self.sensors = tuple(sensors)
        self.names = tuple(sensor.name for sensor in self.sensors)
        count = len(self.sensors)
        raster = pan_raster(image)
        rows, columns = lattice_shape(raster, self.cell_px)
        per_cell = self.cell_px // WEIGHT_STEP_PX
        nodes = ((rows - 1) * per_cell + 1, (columns - 1) * per_cell + 1)
        self._frames = _stack(self.sensors)
        one = unknown_blocks(*self._frames.shape[1:])
        self._unclean = np.ones((count, *one.shape), np.uint8)
        self._lattices = np.full((count, rows, columns, 2), OUTSIDE)
        self._spare = np.full((rows, columns, 2), OUTSIDE)
        self._valid = np.tile(np.array(_OUTSIDE_LATTICE), (count, 1))
        self._weights = np.zeros((count, *nodes), np.uint8)
        self._pan = _paged((image.height_px, image.width_px))
        # Not needed any more once the image is written.
        self._means = _in_memory_of(self._pan, (count, *nodes))
        self._source = np.zeros((image.height_px, image.width_px), np.uint8)

    def frame(self, name: str) -> Array:
        """Where the Level-1 frame of a sensor is to be written.

        Args:
            name: name of the sensor.

        Returns:
            View of the buffer, (h, w) uint16.
        """
        index = self.names.index(name)
        sensor = self.sensors[index]
        view: Array = self._frames[index, : sensor.height_px, : sensor.width_px]
        return view

    def unclean(self, name: str) -> Array:
        """Where the blocks of a sensor's frame that hold saturated pixels or holes may be marked.

        Every block counts as such until it is written, and again after each image.

        Args:
            name: name of the sensor.

        Returns:
            View of the marks (`processing.radiometry.unclean_blocks`), (rows, columns) uint8.
        """
        sensor = self.sensors[self.names.index(name)]
        rows, columns = unknown_blocks(sensor.height_px, sensor.width_px).shape
        view: Array = self._unclean[self.names.index(name), :rows, :columns]
        return view

    def compose(
        self,
        placements: Mapping[str, SensorPlacement],
        present: Collection[str],
        *,
        feather_px: int,
        interpolation: Interpolation,
    ) -> Composition:
        """Balance, seams and the one resampling, of the frames written before.

        Args:
            placements: by sensor name, adjusted.
            present: sensors whose frames are there; the others leave holes.
            feather_px: width over which one sensor fades into the next, VIP pixels.
            interpolation: name of the kernel.

        Returns:
            Views of the composer's buffers, overwritten by the next call, and the balance.
        """
        raster = pan_raster(self.image)
        for k, name in enumerate(self.names):
            if name in present:
                fill_lattice(self.image, raster, placements[name], self.cell_px, self._lattices[k])
                self._valid[k] = _usable(placements[name])
            else:
                self._lattices[k] = OUTSIDE
                self._valid[k] = _OUTSIDE_LATTICE
        node_means(self._frames, self._valid, self._lattices, self.cell_px, self._means)
        balance = balance_gains(self.names, self._means)
        gains = np.array([balance.gains[name] for name in self.names], np.float32)
        offsets = np.array([balance.offsets.get(name, 0.0) for name in self.names], np.float32)
        labels = seam_labels(self._middles(placements), self._means, gains, feather_px)
        seam_weights(labels, feather_px, self._weights)
        self.resample(
            self._frames,
            self._valid,
            self._lattices,
            self.cell_px,
            self._weights,
            gains,
            offsets=offsets,
            interpolation=interpolation,
            out=self._pan,
            source=self._source,
            unclean=self._unclean,
        )
        self._unclean[:] = 1
        return Composition(self._pan, self._source, balance)

    def geometry(self, placements: Mapping[str, SensorPlacement] | None = None) -> dict[str, Array]:
        """Which raw pixel serves which VIP pixel, on every `WEIGHT_STEP_PX`-th VIP pixel.

        Args:
            placements: None uses those of the last image. Others return where the same VIP pixels
                would be fetched with these placements.

        Returns:
            For each sensor that contributes: `<sensor>.vip` (n, 2) VIP pixels, `<sensor>.raw` (n,
            2) raw pixels, column and row, `<sensor>.weight` (n,) above zero, at most one.
        """
        result: dict[str, Array] = {}
        for k, name in enumerate(self.names):
            lattice = self._lattices[k]
            used = lattice
            i, j = np.nonzero(self._weights[k])
            vip = np.stack([j, i], axis=1) * float(WEIGHT_STEP_PX)
            inside = (vip[:, 0] < self.image.width_px) & (vip[:, 1] < self.image.height_px)
            raw = interpolate_lattice(lattice, self.cell_px, vip)
            first_c, last_c, first_r, last_r = self._valid[k]
            with np.errstate(invalid="ignore"):
                inside &= (raw[:, 0] >= first_c) & (raw[:, 0] <= last_c)
                inside &= (raw[:, 1] >= first_r) & (raw[:, 1] <= last_r)
            if not inside.any():
                continue
            vip, raw = vip[inside], raw[inside]
            if placements is not None:
                used = self._spare
                fill_lattice(
                    self.image, pan_raster(self.image), placements[name], self.cell_px, used
                )
                raw = interpolate_lattice(used, self.cell_px, vip)
            known = np.isfinite(raw[:, 0])
            weights = self._weights[k][i[inside], j[inside]] / np.float32(WEIGHT_UNIT)
            result[f"{name}.vip"] = vip[known]
            result[f"{name}.raw"] = raw[known]
            result[f"{name}.weight"] = weights[known]
        return result

    def _middles(self, placements: Mapping[str, SensorPlacement]) -> Array:
        middles = []
        for sensor in self.sensors:
            middle = np.array([[(sensor.width_px - 1) / 2.0, (sensor.height_px - 1) / 2.0]])
            xy = vip_mm_from_raw(placements[sensor.name], middle)
            middles.append(vip_px_from_mm(self.image, xy)[0])
        return np.array(middles)


class ColourComposer:
    """Level-1 frames of the colour sensors and the rasters of their bands."""

    def __init__(
        self, image: VirtualImage, heads: Sequence[ColourHead], *, resample: Resample = resample
    ) -> None:
        self.image = image
        self.resample = resample
        self.heads = tuple(heads)
        raster = colour_raster(image)
        rows, columns = lattice_shape(raster, COLOUR_CELL_PX)
        per_cell = COLOUR_CELL_PX // WEIGHT_STEP_PX
        nodes = ((rows - 1) * per_cell + 1, (columns - 1) * per_cell + 1)
        shape = (raster.height_px, raster.width_px)
        self._raw: dict[str, Array] = {}
        self._planes: dict[str, Array] = {}
        self._frames: dict[str, Array] = {}
        self._unclean: dict[str, Array] = {}
        for head in self.heads:
            one = _stack([head.sensor])
            name = head.sensor.name
            self._raw[name] = one[0]
            self._unclean[name] = unknown_blocks(*one.shape[1:])[None]
            self._planes[name] = one
            if is_bayer(head.sensor):
                self._planes[name] = _stack([head.sensor] * len(BAYER_BANDS))
            for band in head.bands:
                k = BAYER_BANDS.index(band) if is_bayer(head.sensor) else 0
                self._frames[band] = self._planes[name][k : k + 1]
        self._lattice = np.full((1, rows, columns, 2), OUTSIDE)
        self._weights = np.full((1, *nodes), WEIGHT_UNIT, np.uint8)
        self._bands = {band: _paged(shape) for band in self._frames}
        self._source = np.zeros(shape, np.uint8)

    def frame(self, head: ColourHead) -> Array:
        """Where the Level-1 frame of a head is to be written.

        Args:
            head: one of the composer's heads.

        Returns:
            The buffer, (h, w) uint16.
        """
        return self._raw[head.sensor.name]

    def unclean(self, head: ColourHead) -> Array:
        """Where the blocks of a head's frame that hold saturated pixels or holes may be marked.

        They do not count for a Bayer head. Every block counts as such until it is written, and
        again after each image.

        Args:
            head: one of the composer's heads.

        Returns:
            The marks (`processing.radiometry.unclean_blocks`), (rows, columns) uint8.
        """
        marks: Array = self._unclean[head.sensor.name][0]
        return marks

    def leading(self, head: ColourHead) -> Array:
        """The frame of the band that a head is matched by, once its own frame is written.

        Of a Bayer head all bands are made here.

        Args:
            head: one of the composer's heads.

        Returns:
            Level-1 words, (h, w) uint16.
        """
        planes = self._planes[head.sensor.name]
        if not is_bayer(head.sensor):
            return self._raw[head.sensor.name]
        demosaic(self._raw[head.sensor.name], head.sensor.colour_filter_array, out=planes)
        leading: Array = planes[BAYER_BANDS.index(head.leading)]
        return leading

    def compose(
        self,
        band: str,
        placement: SensorPlacement,
        source_from_target_mm: Array | None,
        *,
        interpolation: Interpolation,
    ) -> Array:
        """Resample one band onto the colour raster.

        Args:
            band: name of the band, whose frame was written.
            placement: of the band's sensor.
            source_from_target_mm: see `fill_lattice`.
            interpolation: name of the kernel.

        Returns:
            The composer's buffer of the band, (h, w) uint16, 0 no data.
        """
        raster = colour_raster(self.image)
        fill_lattice(
            self.image,
            raster,
            placement,
            COLOUR_CELL_PX,
            self._lattice[0],
            source_from_target_mm=source_from_target_mm,
        )
        self.resample(
            self._frames[band],
            np.array([_usable(placement)]),
            self._lattice,
            COLOUR_CELL_PX,
            self._weights,
            np.ones(1, np.float32),
            interpolation=interpolation,
            out=self._bands[band],
            source=self._source,
            unclean=None if is_bayer(placement.sensor) else self._unclean[placement.sensor.name],
        )
        self._unclean[placement.sensor.name][:] = 1
        return self._bands[band]

    @property
    def source(self) -> Array:
        """Where the last composed band has data, (h, w) uint8, as in
        `processing.image.resampling.resample`."""
        return self._source

    def planes(self, head: ColourHead) -> tuple[Array, ...]:
        """The frames that the bands of a head are made of, once `leading` was called.

        Args:
            head: one of the composer's heads.

        Returns:
            Level-1 words, (h, w) uint16 each.
        """
        return tuple(self._planes[head.sensor.name])

    def empty(self, band: str) -> Array:
        """The raster of a band whose frame is missing.

        Args:
            band: name of the band.

        Returns:
            The composer's buffer of the band, (h, w) uint16, all 0: no data.
        """
        self._bands[band][:] = 0
        return self._bands[band]


def _stack(sensors: Collection[Sensor]) -> Array:
    height = max(sensor.height_px for sensor in sensors)
    width = max(sensor.width_px for sensor in sensors)
    return np.zeros((len(sensors), height, width), np.uint16)


def _paged(shape: tuple[int, int]) -> Array:
    """Zeros of uint16 that begin on a page of memory, from where a disk takes them uncopied."""
    value_count = shape[0] * shape[1]
    memory = np.zeros(value_count + mmap.PAGESIZE // 2, np.uint16)
    first = -memory.ctypes.data % mmap.PAGESIZE // 2
    return memory[first : first + value_count].reshape(shape)


def _in_memory_of(raster: Array, shape: tuple[int, ...]) -> Array:
    """Values of float32 in a raster's memory, or in their own where that is too small."""
    word_count = 2 * math.prod(shape)
    if word_count > raster.size:
        return np.zeros(shape, np.float32)
    view: Array = raster.reshape(-1)[:word_count].view(np.float32).reshape(shape)
    return view


def _usable(placement: SensorPlacement) -> tuple[float, ...]:
    return tuple(usable_area(placement, exposed_rows(placement.sensor, placement.tdi_shifts)))

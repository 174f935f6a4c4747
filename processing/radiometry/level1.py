"""Level-0 to Level-1: raw counts to linear signal in one fused pass over the pixels.

Defects are interpolated here too; what the calibration is and where it comes from is in
`processing.radiometry.calibration`.

A Level-1 word is uint16. 0 means no data: partly exposed TDI rows, and defects without a good
neighbour in reach. Any other word is linear signal above black in units of 1 /
`level1_counts_per_dn` DN (8 counts to the DN for 12 bits, so rounding stays far below the read
noise); its lowest bit marks that the pixel was saturated before it was scaled. Signal at or below
black is held at `LEVEL1_FLOOR`.

Source: docs/mathematics/radiometry.md#offset-and-gain, #tdi and #defects; Heier et al. (2002), 5.2.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from processing.radiometry.calibration import (
    RadiometricCalibration,
    check_radiometry,
    neutral_radiometry,
)
from processing.rig import Sensor

Array = NDArray[Any]

LEVEL1_NO_DATA: Final = 0
LEVEL1_FLOOR: Final = 2
LEVEL1_CEILING: Final = 65534
SATURATED_BIT: Final = 1

_RESPONSE_UNIT: Final = 16384
"""Fixed-point word of a response of one. Integer running sums are exact, so the result does not
depend on how many threads shared the rows."""
_BIAS_STEP_DN: Final = 1.0 / 32.0
_DARK_STEP_DN_PER_S: Final = 0.5
"""Steps of the maps: rounded to at most a sixty-fourth of a DN, where a Level-1 word is a quarter
(12 bits); dark signal to as much in a sixteenth of a second."""
_BAND_ROWS: Final = 128
_MATHEMATICS: Final = {"contract", "nnan", "ninf", "nsz"}
"""No approximate reciprocals: compilers take them or not as loops happen to vectorise, and the same
bytes must give the same pixels wherever the kernels were compiled."""
_DEFECT_REACH_PX: Final = 8
_NEAR_TAP: Final = 0.65
"""Weight of each of the two nearest pixels; those behind them have a half less that."""
_DIAGONAL: Final = 2**0.5
_EVEN_COUNTS: Final = 32.0
"""Level-1 counts (4 DN of 12 bits), a half of the noise: gradients this small are alike."""


@dataclass(frozen=True)
class FrameStatistics:
    """What the pass saw of the exposed pixels: mean signal in DN, share of saturated ones."""

    mean_dn: float
    saturated_fraction: float


@dataclass(frozen=True)
class Corrector:
    """A calibration made ready for the pass: maps as fixed point of 8 or 16 bits, scalars where it
    is flat.

    `bias` and `dark` count in units above their least value, `response` is one over gain; they are
    None together, where the calibration is the same for all pixels. `defects_by_shifts` keeps the
    defect map as spread by so many TDI shifts.
    """

    sensor: Sensor
    bias: Array | None
    dark: Array | None
    response: Array | None
    bias_unit_dn: float
    dark_unit_dn_per_s: float
    min_bias_dn: float
    min_dark_dn_per_s: float
    flat_gain: float
    doubling_k: float
    reference_c: float
    response_per_k: float
    defect: Array | None
    defects_by_shifts: dict[int, tuple[Array, Array]] = field(default_factory=dict)


def level1_counts_per_dn(bits: int) -> float:
    """Level-1 counts of one DN for a sensor of so many bits: full scale is half of the range."""
    return float(2.0 ** (15 - bits))


def corrector_for(sensor: Sensor, calibration: RadiometricCalibration | None) -> Corrector:
    """Make a calibration ready for the pass; None takes the neutral one.

    Raises:
        CalibrationError: the maps are not of the sensor's size, or out of range.
    """
    calibration = calibration or neutral_radiometry(sensor)
    check_radiometry(f"radiometry of {sensor.name}", calibration, sensor=sensor)
    maps = (calibration.bias_dn, calibration.dark_dn_per_s, calibration.gain)
    flat = all(float(np.min(m)) == float(np.max(m)) for m in maps)
    bias = dark = response = None
    least_bias, bias_unit = float(calibration.bias_dn.flat[0]), 0.0
    least_dark, dark_unit = float(calibration.dark_dn_per_s.flat[0]), 0.0
    if not flat:
        good = calibration.defect == 0
        bias, least_bias, bias_unit = _quantised(calibration.bias_dn, good, _BIAS_STEP_DN)
        dark, least_dark, dark_unit = _quantised(
            calibration.dark_dn_per_s, good, _DARK_STEP_DN_PER_S
        )
        response = _fixed_point(1.0 / calibration.gain, 1.0 / _RESPONSE_UNIT)
    return Corrector(
        sensor=sensor,
        bias=bias,
        dark=dark,
        response=response,
        bias_unit_dn=bias_unit,
        dark_unit_dn_per_s=dark_unit,
        min_bias_dn=least_bias,
        min_dark_dn_per_s=least_dark,
        flat_gain=float(calibration.gain.flat[0]),
        doubling_k=calibration.doubling_k,
        reference_c=calibration.reference_c,
        response_per_k=calibration.response_per_k,
        defect=(calibration.defect != 0).astype(np.uint8) if np.any(calibration.defect) else None,
    )


def level1_from_level0(
    corrector: Corrector,
    raw: Array,
    *,
    temperature_c: float | None,
    exposure_time_s: float,
    tdi_shifts: int,
    out: Array,
    scale: float = 1.0,
) -> FrameStatistics:
    """Fill `out` with the Level-1 words of a raw frame.

    With N TDI shifts the charge of a pixel visited N + 1 pixels of its column, so its dark signal
    and its response are their means; the N rows at the entering side (low rows for `tdi_row_sign`
    +1) are partly exposed and become no data, and a defect spoils N more rows.

    Args:
        raw: the frame, (height, width) uint16, DN.
        temperature_c: of the sensor; None takes the calibration's reference temperature.
        out: (height, width) uint16, contiguous; overwritten.
        scale: multiplies the signal, after the offset was taken off. What it carries beyond the
            range of words counts as saturated.

    Raises:
        ValueError: `raw` or `out` is not a uint16 frame of the sensor's size.
    """
    sensor = corrector.sensor
    shape = (sensor.height_px, sensor.width_px)
    for name, array in (("raw", raw), ("out", out)):
        if array.shape != shape or array.dtype != np.uint16:
            raise ValueError(
                f"{name} of {sensor.name} is {array.shape} {array.dtype}; it is {shape} uint16"
            )
    shifts = min(max(int(tdi_shifts), 0), sensor.height_px)
    warmth = 0.0 if temperature_c is None else temperature_c - corrector.reference_c
    dark_time_s = exposure_time_s * 2.0 ** min(max(warmth / corrector.doubling_k, -30.0), 30.0)
    offset_dn = corrector.min_bias_dn + corrector.min_dark_dn_per_s * dark_time_s
    counts = level1_counts_per_dn(sensor.bits)
    by_gain = scale * 0.5 * counts / max(1.0 + corrector.response_per_k * warmth, 0.5)
    bands = (sensor.height_px + _BAND_ROWS - 1) // _BAND_ROWS
    sums = np.zeros((bands, 2), np.float64)
    if corrector.bias is None or corrector.dark is None or corrector.response is None:
        _flat_pass(
            raw,
            np.float32(offset_dn),
            np.float32(by_gain * corrector.flat_gain),
            shifts,
            sensor.tdi_row_sign,
            sensor.full_scale_dn,
            out,
            sums,
        )
    else:
        _map_pass(
            raw,
            corrector.bias,
            corrector.dark,
            corrector.response,
            np.float32(corrector.bias_unit_dn),
            np.float32(corrector.dark_unit_dn_per_s * dark_time_s / (shifts + 1)),
            np.float32(offset_dn),
            np.float32(by_gain * _RESPONSE_UNIT * (shifts + 1)),
            shifts,
            sensor.tdi_row_sign,
            sensor.full_scale_dn,
            out,
            sums,
        )
    if corrector.defect is not None:
        if shifts not in corrector.defects_by_shifts:
            corrector.defects_by_shifts[shifts] = _spread(
                corrector.defect, shifts, sensor.tdi_row_sign
            )
        mask, places = corrector.defects_by_shifts[shifts]
        _interpolate_defects(out, mask, places, 1 if sensor.colour_filter_array == "none" else 2)
    exposed = max((sensor.height_px - shifts) * sensor.width_px, 1)
    total, saturated = sums.sum(axis=0)
    return FrameStatistics(float(total) / counts / exposed, float(saturated) / exposed)


def exposed_rows(sensor: Sensor, tdi_shifts: int) -> tuple[int, int]:
    """First and last raw row that is fully exposed after so many TDI shifts."""
    shifts = max(int(tdi_shifts), 0)
    if sensor.tdi_row_sign > 0:
        return shifts, sensor.height_px - 1
    return 0, sensor.height_px - 1 - shifts


def _fixed_point(
    values: Array, unit: float, kind: type[np.unsignedinteger[Any]] = np.uint16
) -> Array:
    quantised: Array = np.clip(
        np.rint(np.asarray(values) / np.float32(unit)), 0, np.iinfo(kind).max
    )
    return np.ascontiguousarray(quantised.astype(kind))


def _quantised(values: Array, good: Array, coarsest: float) -> tuple[Array, float, float]:
    """A map as words above its least value, in 8 bits where steps stay below the coarsest allowed.

    Half the bytes are half the time: the pass waits for memory. Words of defects, which are not
    read, are cut off to the range of good pixels.

    Returns:
        The words, the least value, the unit of a word.
    """
    of_good = values[good] if good.any() else values
    least, most = float(np.min(of_good)), float(np.max(of_good))
    kind = np.uint8 if most - least <= coarsest * np.iinfo(np.uint8).max else np.uint16
    unit = max(most - least, 1e-6) / np.iinfo(kind).max
    return _fixed_point(values - np.float32(least), unit, kind), least, unit


def _spread(defect: Array, shifts: int, sign: int) -> tuple[Array, Array]:
    mask = defect.copy()
    for k in range(1, shifts + 1):
        if sign > 0:
            mask[k:] |= defect[:-k]
        else:
            mask[:-k] |= defect[k:]
    return mask, np.argwhere(mask).astype(np.int32)


@njit(cache=True, parallel=True, fastmath=_MATHEMATICS, nogil=True)
def _flat_pass(raw, offset, factor, shifts, sign, full_scale, out, sums):
    """The pass where one offset and one gain hold for all pixels."""
    height, width = raw.shape
    # Sums and limits stay 32 bits wide, so that vectors hold eight pixels and not four.
    ceiling = np.int32(full_scale)
    for band in prange(sums.shape[0]):
        total = np.int64(0)
        saturated = np.int64(0)
        for row in range(band * _BAND_ROWS, min((band + 1) * _BAND_ROWS, height)):
            source = raw[row]
            target = out[row]
            if (sign > 0 and row < shifts) or (sign < 0 and row >= height - shifts):
                target[:] = 0
                continue
            row_total = np.int32(0)
            row_saturated = np.int32(0)
            for k in range(width):
                dn = np.int32(source[k])
                half = np.int32((np.float32(dn) - offset) * factor + np.float32(0.5))
                half = min(max(half, np.int32(1)), np.int32(32767))
                full = np.int32((dn >= ceiling) | (half >= 32767))
                target[k] = np.uint16(2 * half + full)
                row_total = np.int32(row_total + half)
                row_saturated = np.int32(row_saturated + full)
            total += row_total
            saturated += row_saturated
        sums[band, 0] = 2.0 * total
        sums[band, 1] = saturated


@njit(cache=True, parallel=True, fastmath=_MATHEMATICS, nogil=True)
def _map_pass(
    raw,
    bias,
    dark,
    response,
    bias_unit,
    dark_unit,
    base,
    factor,
    shifts,
    sign,
    full_scale,
    out,
    sums,
):
    """The pass with maps; running sums along the column give the means over the pixels visited."""
    height, width = raw.shape
    ceiling = np.int32(full_scale)
    for band in prange(sums.shape[0]):
        first = band * _BAND_ROWS
        last = min(first + _BAND_ROWS, height)
        dark_sum = np.zeros(width, np.int32)
        response_sum = np.zeros(width, np.int32)
        low = first - shifts if sign > 0 else first
        for visited in range(max(low, 0), min(low + shifts + 1, height)):
            dark_row = dark[visited]
            response_row = response[visited]
            for k in range(width):
                dark_sum[k] += np.int32(dark_row[k])
                response_sum[k] += np.int32(response_row[k])
        total = np.int64(0)
        saturated = np.int64(0)
        for row in range(first, last):
            low = row - shifts if sign > 0 else row
            source = raw[row]
            target = out[row]
            if low < 0 or low + shifts >= height:
                target[:] = 0
            else:
                bias_row = bias[row]
                row_total = np.int32(0)
                row_saturated = np.int32(0)
                for k in range(width):
                    dn = np.int32(source[k])
                    offset = base + np.float32(bias_row[k]) * bias_unit
                    offset += np.float32(dark_sum[k]) * dark_unit
                    signal = (np.float32(dn) - offset) * (factor / np.float32(response_sum[k]))
                    half = np.int32(signal + np.float32(0.5))
                    half = min(max(half, np.int32(1)), np.int32(32767))
                    full = np.int32((dn >= ceiling) | (half >= 32767))
                    target[k] = np.uint16(2 * half + full)
                    row_total = np.int32(row_total + half)
                    row_saturated = np.int32(row_saturated + full)
                total += row_total
                saturated += row_saturated
            coming = low + shifts + 1
            if row + 1 == last:
                continue
            if low >= 0 and coming < height:
                _slide(dark_sum, dark[low], dark[coming])
                _slide(response_sum, response[low], response[coming])
            elif coming < height:
                for k in range(width):
                    dark_sum[k] += np.int32(dark[coming, k])
                    response_sum[k] += np.int32(response[coming, k])
            elif low >= 0:
                for k in range(width):
                    dark_sum[k] -= np.int32(dark[low, k])
                    response_sum[k] -= np.int32(response[low, k])
        sums[band, 0] = 2.0 * total
        sums[band, 1] = saturated


@njit(cache=True, nogil=True)
def _slide(sums, leaving, coming):
    """Move running sums on by one row."""
    for k in range(len(sums)):
        sums[k] += np.int32(coming[k]) - np.int32(leaving[k])


@njit(cache=True, parallel=True, nogil=True)
def _interpolate_defects(level1, mask, places, period):
    """Fill each defect from the nearest good pixels on both sides, along the least gradient.

    Directions of nearly the least gradient share, for their noise is not the same. Where two good
    pixels lie on either side, all four are taken: a line through two cuts off every crest.

    Pixels `period` apart in row or column are of one colour; no others are compared.

    The gradient of a direction is the mean of what the pixels of a 5 x 5 neighbourhood differ from
    their neighbour in that direction, good ones only: many chords, so that noise does not choose.
    Only good pixels are read, so the order of the work does not matter.
    """
    height, width = level1.shape
    for index in prange(places.shape[0]):
        row = places[index, 0]
        column = places[index, 1]
        best = 1e30
        marked = 0
        total = weights = 0.0
        for direction in range(4):
            step_row = np.int64(0) if direction == 0 else np.int64(period)
            step_column = np.int64(period)
            if direction == 1:
                step_column = np.int64(0)
            elif direction == 3:
                step_column = np.int64(-period)
            # Two numbers each: an array would be asked of the heap for every defect.
            before = after = 0.0
            to_before = to_after = 0.0
            saturated = 0
            for side in range(2):
                way = 2 * side - 1
                for reach in range(1, _DEFECT_REACH_PX + 1):
                    r = row + way * reach * step_row
                    c = column + way * reach * step_column
                    if r < 0 or c < 0 or r >= height or c >= width:
                        break
                    if mask[r, c] == 0 and level1[r, c] != 0:
                        value = np.float64(level1[r, c] & 0xFFFE)
                        saturated |= level1[r, c] & 1
                        if side == 0:
                            before, to_before = value, np.float64(reach)
                        else:
                            after, to_after = value, np.float64(reach)
                        break
            if to_before == 0.0 or to_after == 0.0:
                continue
            gradient = abs(after - before) / (to_before + to_after)
            chords = 1
            for r in range(max(row - 2, 0), min(row + 3, height)):
                for c in range(max(column - 2, 0), min(column + 3, width)):
                    r2 = r + step_row
                    c2 = c + step_column
                    if r2 >= height or c2 < 0 or c2 >= width:
                        continue
                    if mask[r, c] or mask[r2, c2] or level1[r, c] == 0 or level1[r2, c2] == 0:
                        continue
                    gradient += abs(np.float64(level1[r, c]) - np.float64(level1[r2, c2]))
                    chords += 1
            error = gradient / chords * (to_before + to_after)
            if step_row != 0 and step_column != 0:
                error *= _DIAGONAL
            filled = before + (after - before) * to_before / (to_before + to_after)
            r, c = row - 2 * step_row, column - 2 * step_column
            r2, c2 = row + 2 * step_row, column + 2 * step_column
            if (
                to_before + to_after == 2.0
                and r >= 0
                and r2 < height
                and min(c, c2) >= 0
                and max(c, c2) < width
                and not (mask[r, c] or mask[r2, c2] or level1[r, c] == 0 or level1[r2, c2] == 0)
            ):
                outer = np.float64(level1[r, c] & 0xFFFE) + np.float64(level1[r2, c2] & 0xFFFE)
                filled = _NEAR_TAP * (before + after) + (0.5 - _NEAR_TAP) * outer
            share = 1.0 / (error + _EVEN_COUNTS) ** 4
            total += share * filled
            weights += share
            if error < best:
                best = error
                marked = saturated
        found = 0
        if weights > 0.0:
            # Half of the word and its doubling leave the lowest bit to the saturation mark.
            half = int(0.5 * total / weights + 0.5)
            found = 2 * min(max(half, 1), 32767) + marked
        level1[row, column] = found

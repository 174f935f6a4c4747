"""Level-0 to Level-1: raw counts to linear signal in one fused pass over the pixels.

The pass also takes what tests of the frame need of every pixel or line, so that no step reads the
frame for it again. What the calibration is and where it comes from is in
`processing.radiometry.calibration`, how it is made ready for the pass in
`processing.radiometry.corrector`, how defects are filled in `processing.radiometry.defects`.

A Level-1 word is uint16. 0 means no data: partly exposed TDI rows, and defects without a good
neighbour in reach. Any other word is linear signal above black in units of 1 /
`level1_counts_per_dn` DN (8 counts to the DN for 12 bits, so rounding stays far below the read
noise); its lowest bit marks that the pixel was saturated before it was scaled. Signal at or below
black is held at `LEVEL1_FLOOR`.

Source: docs/explanation/mathematics/radiometry.md#offset-and-gain, #tdi and #defects; Heier et al.
(2002), 5.2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numba import prange
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel
from processing.image.line_means import (
    LineMeans,
    add_changes,
    add_line,
    line_buffers,
    means_of,
)
from processing.radiometry.corrector import RESPONSE_UNIT, Corrector
from processing.radiometry.defects import interpolate_defects
from processing.radiometry.unclean_blocks import begin_marks, mark_line, mark_pixels
from processing.rig import Sensor

Array = NDArray[Any]

LEVEL1_FLOOR: Final = 2
LEVEL1_CEILING: Final = 65534
SATURATED_BIT: Final = 1

_BANDS: Final = 39
"""Parts of a frame that threads share."""
_UNREAD_NOISES: Final = 10.0
UNREAD_STEP_PX: Final = 256
"""Of every line so many columns apart are compared with black; a lost packet is longer."""
_MATHEMATICS: Final = {"contract", "nnan", "ninf", "nsz"}
"""No approximate reciprocals: compilers take them or not as loops happen to vectorise, and the same
bytes must give the same pixels wherever the kernels were compiled."""


@dataclass(frozen=True)
class RadiometricPasses:
    """The loops over the pixels of a frame, compiled for one device.

    `flat` takes the arguments of `_flat_pass`, `maps` those of `_map_pass`.
    """

    flat: Callable[..., None]
    maps: Callable[..., None]


@dataclass(frozen=True)
class FrameStatistics:
    """What the pass saw of a frame.

    `mean_dn` is the mean signal of the exposed pixels, `saturated_fraction` their saturated share,
    `unread_fraction` the share of words far below black among those compared (None where black is
    not above the noise), `lines` the means of bundles of Level-1 words where they were asked for.
    """

    mean_dn: float
    saturated_fraction: float
    unread_fraction: float | None
    lines: LineMeans | None = None


def level1_counts_per_dn(bits: int) -> float:
    """Level-1 counts of one DN: full scale is half of the range of words.

    Args:
        bits: of the sensor's converter, 1 to 16.

    Returns:
        2^(15 - bits).

    Example:
        >>> level1_counts_per_dn(12), level1_counts_per_dn(16)
        (8.0, 0.5)
    """
    return float(2.0 ** (15 - bits))


def level1_from_level0(
    corrector: Corrector,
    raw: Array,
    *,
    temperature_c: float | None,
    exposure_time_s: float,
    tdi_shifts: int,
    out: Array,
    scale: float = 1.0,
    measure_lines: bool = False,
    unclean: Array | None = None,
    passes: RadiometricPasses | None = None,
) -> FrameStatistics:
    """Fill `out` with the Level-1 words of a raw frame.

    With N TDI shifts the charge of a pixel visited N + 1 pixels of its column, so its dark signal
    and its response are their means; the N rows at the entering side (low rows for `tdi_row_sign`
    +1) are partly exposed and become no data, and a defect spoils N more rows.

    Args:
        corrector: from `processing.radiometry.corrector.corrector_for`.
        raw: the frame, shape (height, width), uint16, DN.
        temperature_c: of the sensor; None takes the calibration's reference temperature.
        exposure_time_s: of the frame; the dark signal grows with it.
        tdi_shifts: N of the frame.
        out: shape (height, width), uint16, contiguous; overwritten.
        scale: multiplies the signal, after the offset was taken off. What it carries beyond the
            range of words counts as saturated.
        measure_lines: whether the means of bundles along lines are wanted.
        unclean: marks as of `processing.radiometry.unclean_blocks.unknown_blocks`, overwritten.
        passes: the compiled loops; None takes those of the processor. All have the same bits.

    Returns:
        What the pass saw of the frame.

    Raises:
        ValueError: `raw` or `out` is not a uint16 frame of the sensor's size.

    Source: docs/explanation/mathematics/radiometry.md#offset-and-gain and #tdi.

    Example:
        12 bits, black 64 DN, gain 1.25: 164 DN become (164 - 64) * 1.25 * 8 = 1000 counts.

        >>> from dataclasses import replace
        >>> from processing.radiometry.calibration import neutral_radiometry
        >>> from processing.radiometry.corrector import corrector_for
        >>> from processing.rig import find_rig
        >>> sensor = replace(find_rig("ultracam-x-mini").sensor("SU00"), width_px=64, height_px=48)
        >>> neutral = neutral_radiometry(sensor)
        >>> calibration = replace(neutral, gain=np.full((48, 64), 1.25, np.float32))
        >>> out = np.zeros((48, 64), np.uint16)
        >>> seen = level1_from_level0(
        ...     corrector_for(sensor, calibration), np.full((48, 64), 164, np.uint16),
        ...     temperature_c=20.0, exposure_time_s=0.002, tdi_shifts=0, out=out,
        ... )
        >>> int(out[10, 10]), seen.mean_dn
        (1000, 125.0)
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
    exposed = exposed_rows(sensor, shifts)
    first, end = exposed[0], exposed[1] + 1
    by_row, by_column = line_buffers(end - first, sensor.width_px)
    if not measure_lines or not by_row.size or not by_column.size:
        by_row, by_column = (np.zeros(size, np.float32) for size in ((end - first, 0), (_BANDS, 0)))
    sums = np.zeros((len(by_column), 3), np.int64)
    least = min_raw_value(sensor)
    out[:first] = 0
    out[end:] = 0
    marks = np.zeros((0, 0), np.uint8) if unclean is None else unclean
    begin_marks(marks, sensor.height_px, exposed)
    passes = passes or CPU_PASSES
    if corrector.bias is None or corrector.dark is None or corrector.response is None:
        passes.flat(
            raw,
            np.float32(offset_dn),
            np.float32(by_gain * corrector.flat_gain),
            sensor.full_scale_dn,
            least,
            first,
            out,
            sums,
            by_row,
            by_column,
            marks,
        )
    else:
        passes.maps(
            raw,
            corrector.bias,
            corrector.dark,
            corrector.response,
            np.float32(corrector.bias_unit_dn),
            np.float32(corrector.dark_unit_dn_per_s * dark_time_s / (shifts + 1)),
            np.float32(offset_dn),
            np.float32(by_gain * RESPONSE_UNIT * (shifts + 1)),
            shifts,
            0 if sensor.tdi_row_sign < 0 else shifts,
            sensor.full_scale_dn,
            least,
            first,
            out,
            sums,
            by_row,
            by_column,
            marks,
        )
    if len(corrector.defects):
        mask, places = corrector.spread_defects(shifts)
        period = 1 if sensor.colour_filter_array == "none" else 2
        changes = np.empty(len(places), np.int32)
        interpolate_defects(out, mask, places, period, changes)
        add_changes(changes, places, sensor.width_px, first, by_row, by_column)
        if unclean is not None:
            mark_pixels(out, places, unclean)
    pixels = max((end - first) * sensor.width_px, 1)
    total, saturated, unread = (int(value) for value in sums.sum(axis=0))
    for rows in (raw[:first], raw[end:]):
        unread += int(np.count_nonzero(rows[:, ::UNREAD_STEP_PX] < max(least, 0)))
    compared = sensor.height_px * -(-sensor.width_px // UNREAD_STEP_PX)
    return FrameStatistics(
        2.0 * total / counts / pixels,
        saturated / pixels,
        unread / compared if least > 0 else None,
        means_of(by_row, by_column, first) if by_row.size else None,
    )


def min_raw_value(sensor: Sensor) -> int:
    """The raw word below which a pixel was not read out: without light it shows its black level.

    Args:
        sensor: black level, read noise and format of its words are used.

    Returns:
        The word; zero or less where black is not above the noise.

    Example:
        Black 64 DN, read noise 30 e / 20 e per DN = 1.5 DN: ten times that below black.

        >>> from processing.rig import find_rig
        >>> min_raw_value(find_rig("ultracam-x-mini").sensor("SU00"))
        49
    """
    noise_dn = sensor.read_noise_e / sensor.electrons_per_dn
    least_dn = int(sensor.black_dn - _UNREAD_NOISES * max(noise_dn, 1.0))
    return least_dn * sensor.raw_units_per_dn


def unread_fraction(sensor: Sensor, raw: Array) -> float | None:
    """Share of words far below black, of a frame that was not corrected here.

    Args:
        sensor: black level, read noise and format of its words are used.
        raw: the frame, shape (h, w), uint16; every 256th column is compared.

    Returns:
        0 to 1; None where black is not above the noise.
    """
    least = min_raw_value(sensor)
    if least <= 0:
        return None
    seen = raw[:, ::UNREAD_STEP_PX]
    return float(np.count_nonzero(seen < least)) / seen.size


def exposed_rows(sensor: Sensor, tdi_shifts: int) -> tuple[int, int]:
    """First and last raw row that is fully exposed.

    Args:
        sensor: height and `tdi_row_sign` are used.
        tdi_shifts: N of the frame; below zero counts as zero.

    Returns:
        (first, last), both included: (N, height - 1), or (0, height - 1 - N) where charge moves to
        lower rows.
    """
    shifts = max(int(tdi_shifts), 0)
    if sensor.tdi_row_sign > 0:
        return shifts, sensor.height_px - 1
    return 0, sensor.height_px - 1 - shifts


@compiled_kernel(fastmath=_MATHEMATICS, inline="always")
def _halved_word(signal):
    """Half a word, rounded, within its range; limited first, since int32 has no place for all."""
    limited = min(max(signal + np.float32(0.5), np.float32(1.0)), np.float32(32767.0))
    return np.int32(limited)


@compiled_kernel(parallel=True, fastmath=_MATHEMATICS)
def _flat_pass(
    raw, offset, factor, full_scale, least, first_row, out, sums, by_row, by_column, unclean
):
    """The pass where one offset and one gain hold for all pixels.

    Corrects as many rows from `first_row` on as `by_row` has, in as many bands as `by_column`.
    `sums` (bands, 3) takes half the Level-1 words, saturated and unread pixels.
    """
    width = raw.shape[1]
    bands, height = len(by_column), len(by_row)
    tall = height // bands
    # Sums and limits stay 32 bits wide, so that vectors hold eight pixels and not four.
    ceiling = np.int32(full_scale)
    for band in prange(bands):
        total = np.int64(0)
        saturated = np.int64(0)
        unread = np.int64(0)
        begin = first_row + band * tall
        end = first_row + height if band == bands - 1 else begin + tall
        for row in range(begin, end):
            source = raw[row]
            target = out[row]
            row_total = np.int32(0)
            row_saturated = np.int32(0)
            for k in range(width):
                dn = np.int32(source[k])
                half = _halved_word((np.float32(dn) - offset) * factor)
                full = np.int32((dn >= ceiling) | (half >= 32767))
                target[k] = np.uint16(2 * half + full)
                row_total = np.int32(row_total + half)
                row_saturated = np.int32(row_saturated + full)
            total += row_total
            saturated += row_saturated
            unread += _unread(source, least)
            add_line(out, row, row - begin, by_row[row - first_row], by_column[band])
            if row_saturated > 0:
                mark_line(target, row, unclean)
        sums[band, 0], sums[band, 1], sums[band, 2] = total, saturated, unread


@compiled_kernel(parallel=True, fastmath=_MATHEMATICS)
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
    back,
    full_scale,
    least,
    first_row,
    out,
    sums,
    by_row,
    by_column,
    unclean,
):
    """The pass with maps; running sums along the column give the means over the pixels visited.

    The charge of a row visited `shifts` + 1 rows, the first of them `back` rows before it. The rest
    is as in `_flat_pass`.
    """
    width = raw.shape[1]
    bands, height = len(by_column), len(by_row)
    tall = height // bands
    ceiling = np.int32(full_scale)
    for band in prange(bands):
        begin = first_row + band * tall
        end = first_row + height if band == bands - 1 else begin + tall
        dark_sum = np.zeros(width, np.int32)
        response_sum = np.zeros(width, np.int32)
        no_dark = np.zeros(width, dark.dtype)
        no_response = np.zeros(width, response.dtype)
        if begin < end:
            for visited in range(begin - back, begin - back + shifts + 1):
                dark_row = dark[visited]
                response_row = response[visited]
                for k in range(width):
                    dark_sum[k] += np.int32(dark_row[k])
                    response_sum[k] += np.int32(response_row[k])
        total = np.int64(0)
        saturated = np.int64(0)
        unread = np.int64(0)
        for row in range(begin, end):
            source = raw[row]
            target = out[row]
            bias_row = bias[row]
            # Sums move on by a row before they are used; nothing leaves or comes in the first row.
            leaving = row - 1 - back
            dark_leaving = no_dark if row == begin else dark[leaving]
            dark_coming = no_dark if row == begin else dark[leaving + shifts + 1]
            response_leaving = no_response if row == begin else response[leaving]
            response_coming = no_response if row == begin else response[leaving + shifts + 1]
            row_total = np.int32(0)
            row_saturated = np.int32(0)
            for k in range(width):
                darkness = dark_sum[k] + (np.int32(dark_coming[k]) - np.int32(dark_leaving[k]))
                responses = response_sum[k] + (
                    np.int32(response_coming[k]) - np.int32(response_leaving[k])
                )
                darkness, responses = np.int32(darkness), np.int32(responses)
                dark_sum[k] = darkness
                response_sum[k] = responses
                dn = np.int32(source[k])
                offset = base + np.float32(bias_row[k]) * bias_unit
                offset += np.float32(darkness) * dark_unit
                signal = (np.float32(dn) - offset) * (factor / np.float32(responses))
                half = _halved_word(signal)
                full = np.int32((dn >= ceiling) | (half >= 32767))
                target[k] = np.uint16(2 * half + full)
                row_total = np.int32(row_total + half)
                row_saturated = np.int32(row_saturated + full)
            total += row_total
            saturated += row_saturated
            unread += _unread(source, least)
            add_line(out, row, row - begin, by_row[row - first_row], by_column[band])
            if row_saturated > 0:
                mark_line(target, row, unclean)
        sums[band, 0], sums[band, 1], sums[band, 2] = total, saturated, unread


@compiled_kernel()
def _unread(line, least):
    """How many of the words compared are below the least one of a pixel that was read out."""
    count = 0
    for k in range(0, len(line), UNREAD_STEP_PX):
        count += line[k] < least
    return count


CPU_PASSES: Final = RadiometricPasses(_flat_pass, _map_pass)
"""Those of the processor."""

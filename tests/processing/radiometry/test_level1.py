"""Level-0 to Level-1: the pass against signals whose charges were counted by hand."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from processing.image.line_means import line_means
from processing.radiometry.calibration import RadiometricCalibration, neutral_radiometry
from processing.radiometry.corrector import corrector_for
from processing.radiometry.defects import spread_defects
from processing.radiometry.level1 import (
    LEVEL1_FLOOR,
    exposed_rows,
    level1_counts_per_dn,
    level1_from_level0,
    unread_fraction,
)
from processing.rig import Sensor, find_rig

SHAPE = (96, 140)
COUNTS = 8.0


@pytest.fixture
def sensor() -> Sensor:
    return replace(
        find_rig("ultracam-x-mini").sensor("SU00"), width_px=SHAPE[1], height_px=SHAPE[0]
    )


@pytest.fixture
def calibration() -> RadiometricCalibration:
    rng = np.random.default_rng(3)
    return RadiometricCalibration(
        bias_dn=(64 + rng.normal(0, 2, SHAPE)).astype(np.float32),
        dark_dn_per_s=rng.uniform(-30, 400, SHAPE).astype(np.float32),
        doubling_k=6.5,
        reference_c=20.0,
        gain=(1 + rng.normal(0, 0.02, SHAPE)).astype(np.float32),
        defect=np.zeros(SHAPE, np.uint8),
    )


def expose(
    calibration: RadiometricCalibration,
    signal: NDArray[np.float64],
    *,
    temperature_c: float = 20.0,
    exposure_time_s: float = 0.01,
    tdi_shifts: int = 0,
    sign: int = 1,
) -> NDArray[np.float64]:
    """DN of a signal that stands still in the raw frame: charge visits N + 1 pixels of its column,
    one after the other, and collects each one's response and dark current for its share of time."""
    height = signal.shape[0]
    dark = calibration.dark_dn_per_s * exposure_time_s
    dark = dark * 2 ** ((temperature_c - calibration.reference_c) / calibration.doubling_k)
    dn = np.array(calibration.bias_dn, np.float64)
    for row in range(height):
        for shift in range(tdi_shifts + 1):
            visited = row - sign * shift
            if 0 <= visited < height:
                share = signal[row] / calibration.gain[visited] + dark[visited]
                dn[row] += share / (tdi_shifts + 1)
    return dn


def signal_of(level1: NDArray[np.uint16]) -> NDArray[np.float64]:
    return (level1 & 0xFFFE) / COUNTS


def as_words(dn: NDArray[np.float64]) -> NDArray[np.uint16]:
    return np.clip(np.rint(dn), 0, 4095).astype(np.uint16)


@pytest.mark.parametrize("flat", [False, True])
def test_a_response_that_grows_with_temperature_is_taken_off(
    sensor: Sensor, calibration: RadiometricCalibration, flat: bool
) -> None:
    if flat:
        calibration = neutral_radiometry(sensor)
    warming = replace(calibration, response_per_k=1e-3)
    warmth = 35.0 - calibration.reference_c
    light = np.full(SHAPE, 1000.0)
    raw = as_words(expose(calibration, light * (1.0 + 1e-3 * warmth), temperature_c=35.0))
    out = np.empty(SHAPE, np.uint16)
    level1_from_level0(
        corrector_for(sensor, warming),
        raw,
        temperature_c=35.0,
        exposure_time_s=0.01,
        tdi_shifts=0,
        out=out,
    )
    assert float(np.mean(signal_of(out))) == pytest.approx(1000.0, abs=0.1)


@pytest.mark.parametrize("temperature_c", [8.0, 20.0, 33.0])
def test_signal_comes_back_through_bias_dark_and_gain(
    sensor: Sensor, calibration: RadiometricCalibration, temperature_c: float
) -> None:
    signal = np.random.default_rng(1).uniform(200, 3000, SHAPE)
    raw = as_words(expose(calibration, signal, temperature_c=temperature_c, exposure_time_s=0.02))
    out = np.zeros(SHAPE, np.uint16)
    level1_from_level0(
        corrector_for(sensor, calibration),
        raw,
        temperature_c=temperature_c,
        exposure_time_s=0.02,
        tdi_shifts=0,
        out=out,
    )
    # Half a DN of the head's own rounding, a quarter of ours, gain up to 1.08.
    assert np.abs(signal_of(out) - signal).max() < 0.75
    assert abs(np.mean(signal_of(out) - signal)) < 0.02


@pytest.mark.parametrize("sign", [1, -1])
def test_tdi_takes_the_means_over_the_pixels_the_charge_visited(
    sensor: Sensor, calibration: RadiometricCalibration, sign: int
) -> None:
    shifts = 7
    sensor = replace(sensor, tdi_row_sign=sign)
    signal = np.random.default_rng(1).uniform(200, 3000, SHAPE)
    raw = as_words(expose(calibration, signal, temperature_c=31.0, tdi_shifts=shifts, sign=sign))
    out = np.zeros(SHAPE, np.uint16)
    level1_from_level0(
        corrector_for(sensor, calibration),
        raw,
        temperature_c=31.0,
        exposure_time_s=0.01,
        tdi_shifts=shifts,
        out=out,
    )
    first, last = exposed_rows(sensor, shifts)
    assert (first, last) == ((shifts, 95) if sign > 0 else (0, 95 - shifts))
    exposed = np.zeros(SHAPE[0], bool)
    exposed[first : last + 1] = True
    assert not out[~exposed].any()
    assert np.abs(signal_of(out) - signal)[exposed].max() < 0.75


def test_saturation_is_marked_before_the_gain_hides_it(sensor: Sensor) -> None:
    dim = replace(neutral_radiometry(sensor), gain=np.broadcast_to(np.float32(0.8), SHAPE))
    raw = np.full(SHAPE, 1000, np.uint16)
    raw[5, 6] = 4095
    raw[7, 8] = 4094
    out = np.zeros(SHAPE, np.uint16)
    statistics = level1_from_level0(
        corrector_for(sensor, dim),
        raw,
        temperature_c=None,
        exposure_time_s=0.01,
        tdi_shifts=0,
        out=out,
    )
    assert out[5, 6] & 1 and not out[7, 8] & 1
    assert np.count_nonzero(out & 1) == 1
    assert signal_of(out)[5, 6] == pytest.approx(0.8 * (4095 - 64), abs=0.2)
    assert statistics.saturated_fraction == pytest.approx(1 / raw.size)
    assert statistics.mean_dn == pytest.approx(0.8 * (1000 - 64), rel=1e-3)


@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("scale", [1.3e5, 2e5, 1e9, 1e30])
def test_what_any_scale_carries_beyond_the_range_of_words_is_saturated(
    sensor: Sensor, calibration: RadiometricCalibration, flat: bool, scale: float
) -> None:
    raw = np.full(SHAPE, 4000, np.uint16)
    raw[::2] = 30
    out = np.zeros(SHAPE, np.uint16)
    statistics = level1_from_level0(
        corrector_for(sensor, neutral_radiometry(sensor) if flat else calibration),
        raw,
        temperature_c=None,
        exposure_time_s=0.001,
        tdi_shifts=0,
        out=out,
        scale=scale,
    )
    assert set(out[1::2].ravel().tolist()) == {65535}
    assert set(out[::2].ravel().tolist()) == {LEVEL1_FLOOR}
    assert statistics.saturated_fraction == 0.5


def test_the_result_does_not_depend_on_the_number_of_threads(
    sensor: Sensor, calibration: RadiometricCalibration
) -> None:
    raw = np.random.default_rng(1).integers(100, 4000, SHAPE).astype(np.uint16)
    corrector = corrector_for(sensor, calibration)
    results = []
    before = numba.get_num_threads()
    try:
        for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
            numba.set_num_threads(threads)
            out = np.zeros(SHAPE, np.uint16)
            statistics = level1_from_level0(
                corrector,
                raw,
                temperature_c=25.0,
                exposure_time_s=0.01,
                tdi_shifts=9,
                out=out,
            )
            results.append((out, statistics))
    finally:
        numba.set_num_threads(before)
    assert np.array_equal(results[0][0], results[1][0])
    assert results[0][1] == results[1][1]


@pytest.mark.parametrize(("sign", "shifts"), [(1, 0), (1, 9), (-1, 9), (1, 70)])
@pytest.mark.parametrize("flat", [True, False])
def test_lines_and_unread_words_are_those_of_the_finished_frame(
    sensor: Sensor, calibration: RadiometricCalibration, flat: bool, sign: int, shifts: int
) -> None:
    random = np.random.default_rng(4)
    sensor = replace(sensor, tdi_row_sign=sign)
    raw = random.integers(100, 4096, SHAPE).astype(np.uint16)
    raw[:12] = 0
    raw[-7:-3] = 0
    defect = (random.uniform(size=SHAPE) < 0.02).astype(np.uint8)
    defect[:, 33] = 1
    made = replace(neutral_radiometry(sensor) if flat else calibration, defect=defect)
    out = np.full(SHAPE, 77, np.uint16)
    seen = level1_from_level0(
        corrector_for(sensor, made),
        raw,
        temperature_c=25.0,
        exposure_time_s=0.01,
        tdi_shifts=shifts,
        out=out,
        measure_lines=True,
    )
    assert seen.unread_fraction == unread_fraction(sensor, raw) == 16 / SHAPE[0]
    expected = line_means(out, exposed_rows(sensor, shifts))
    if not expected.by_column.size:
        assert seen.lines is None
        return
    assert seen.lines is not None and expected.by_row.any() and expected.by_column.any()
    assert seen.lines.first_row == expected.first_row
    assert np.array_equal(seen.lines.by_row, expected.by_row)
    assert np.array_equal(seen.lines.by_column, expected.by_column)


def test_signal_below_black_is_held_above_no_data(sensor: Sensor) -> None:
    out = np.zeros(SHAPE, np.uint16)
    level1_from_level0(
        corrector_for(sensor, None),
        np.zeros(SHAPE, np.uint16),
        temperature_c=20.0,
        exposure_time_s=0.01,
        tdi_shifts=0,
        out=out,
    )
    assert np.all(out == LEVEL1_FLOOR)


def test_full_scale_of_any_depth_fills_half_of_the_range() -> None:
    for bits in (8, 10, 12, 14, 16):
        assert level1_counts_per_dn(bits) * 2**bits == 32768


def defective(
    sensor: Sensor, image: NDArray[np.float64], defect: NDArray[np.uint8], tdi_shifts: int = 0
) -> NDArray[np.float64]:
    """Correct an image whose defect pixels hold nonsense; returns signal, DN."""
    raw = as_words(image + 64)
    raw[defect != 0] = 4095
    out = np.zeros(SHAPE, np.uint16)
    level1_from_level0(
        corrector_for(sensor, replace(neutral_radiometry(sensor), defect=defect)),
        raw,
        temperature_c=20.0,
        exposure_time_s=0.01,
        tdi_shifts=tdi_shifts,
        out=out,
    )
    return signal_of(out)


def test_defects_are_filled_along_the_least_gradient(sensor: Sensor) -> None:
    rows, columns = np.indices(SHAPE)
    defect = np.zeros(SHAPE, np.uint8)
    defect[:, 70] = 1
    defect[20:23, 30:33] = 1
    defect[50, 50] = 1
    for image in (
        np.where(rows + columns < 100, 500.0, 2500.0),
        np.where(rows - columns < -10, 500.0, 2500.0),
        np.where(rows < 51, 500.0, 2500.0),
        1000.0 + 5.0 * columns + 3.0 * rows,
    ):
        filled = defective(sensor, image, defect)
        bad = defect != 0
        assert np.mean(np.abs(filled - image)[bad] > 60) < 0.04
        assert np.abs(filled - image)[~bad].max() < 0.3


def test_a_filled_defect_is_no_saturated_pixel(sensor: Sensor) -> None:
    defect = np.zeros(SHAPE, np.uint8)
    defect[10, 10] = 1
    filled = defective(sensor, np.full(SHAPE, 800.0), defect)
    assert filled[10, 10] == pytest.approx(800.0, abs=0.3)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("shifts", [0, 1, 7, 120])
def test_the_map_of_bits_and_the_places_are_the_defects_over_their_path(
    shifts: int, sign: int
) -> None:
    defect = np.random.default_rng(5).uniform(size=SHAPE) < 0.03
    expected = np.zeros(SHAPE, np.bool_)
    for row, column in np.argwhere(defect):
        end = row + sign * shifts
        expected[max(min(row, end), 0) : max(row, end) + 1, column] = True
    mask, places = spread_defects(np.argwhere(defect), SHAPE, shifts, sign)
    bits = np.unpackbits(mask, axis=1, bitorder="little")
    assert np.array_equal(bits[:, : SHAPE[1]], expected) and not bits[:, SHAPE[1] :].any()
    assert np.array_equal(places, np.argwhere(expected)) and places.dtype == np.int32


def test_maps_of_few_numbers_of_shifts_are_kept_and_pixels_do_not_depend_on_it(
    sensor: Sensor, calibration: RadiometricCalibration
) -> None:
    defect = (np.random.default_rng(6).uniform(size=SHAPE) < 0.02).astype(np.uint8)
    corrector = corrector_for(sensor, replace(calibration, defect=defect))
    raw = np.random.default_rng(7).integers(100, 3000, SHAPE).astype(np.uint16)

    def words(shifts: int) -> NDArray[np.uint16]:
        out = np.zeros(SHAPE, np.uint16)
        level1_from_level0(
            corrector,
            raw,
            temperature_c=20.0,
            exposure_time_s=0.01,
            tdi_shifts=shifts,
            out=out,
        )
        return out

    first = [words(shifts) for shifts in range(20)]
    assert len(corrector.defects_by_shifts) <= 8
    assert all(np.array_equal(words(k), one) for k, one in enumerate(first))


def test_a_defect_spoils_as_many_rows_more_as_there_were_tdi_shifts(sensor: Sensor) -> None:
    shifts = 4
    rows, columns = np.indices(SHAPE)
    image = 900.0 + 4.0 * columns + 2.0 * rows
    defect = np.zeros(SHAPE, np.uint8)
    defect[40, 60] = 1
    raw = as_words(image + 64)
    raw[40 : 40 + shifts + 1, 60] = 300
    out = np.zeros(SHAPE, np.uint16)
    level1_from_level0(
        corrector_for(sensor, replace(neutral_radiometry(sensor), defect=defect)),
        raw,
        temperature_c=20.0,
        exposure_time_s=0.01,
        tdi_shifts=shifts,
        out=out,
    )
    assert np.abs(signal_of(out) - image)[shifts:].max() < 1.0


def test_a_cluster_without_neighbours_in_reach_stays_a_hole(sensor: Sensor) -> None:
    defect = np.zeros(SHAPE, np.uint8)
    defect[30:60, 40:80] = 1
    filled = defective(sensor, np.full(SHAPE, 800.0), defect)
    assert filled[45, 60] == 0.0


def test_a_frame_of_another_size_is_refused_with_its_shape(sensor: Sensor) -> None:
    with pytest.raises(ValueError, match=r"raw of SU00 is \(5, 6\) uint16; it is \(96, 140\)"):
        level1_from_level0(
            corrector_for(sensor, None),
            np.zeros((5, 6), np.uint16),
            temperature_c=None,
            exposure_time_s=0.0,
            tdi_shifts=0,
            out=np.zeros(SHAPE, np.uint16),
        )


def test_maps_of_a_narrow_range_take_eight_bits_and_wide_ones_keep_sixteen(
    sensor: Sensor, calibration: RadiometricCalibration
) -> None:
    random = np.random.default_rng(5)
    spread = random.uniform(0.0, 7.0, SHAPE).astype(np.float32)
    spread[3, 5] = 4000.0
    defect = np.zeros(SHAPE, np.uint8)
    defect[3, 5] = 1
    narrow = replace(calibration, bias_dn=60.0 + spread, dark_dn_per_s=spread, defect=defect)
    wide = replace(narrow, defect=np.zeros_like(defect))
    narrow_corrector, wide_corrector = corrector_for(sensor, narrow), corrector_for(sensor, wide)
    assert narrow_corrector.bias is not None and narrow_corrector.bias.dtype == np.uint8
    assert narrow_corrector.dark is not None and narrow_corrector.dark.dtype == np.uint8
    assert wide_corrector.bias is not None and wide_corrector.bias.dtype == np.uint16
    good = defect == 0
    bias_dn_of = (
        narrow_corrector.min_bias_dn + narrow_corrector.bias * narrow_corrector.bias_unit_dn
    )
    assert np.abs(bias_dn_of - narrow.bias_dn)[good].max() < 1.0 / 64.0

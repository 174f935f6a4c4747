"""One tone curve for a mission: it follows from all exposures and is the same in each."""

from __future__ import annotations

import numpy as np
import pytest

from processing.radiometry.tone_curve import (
    ToneCurve,
    histogram,
    lookup_table,
    mission_curve,
    scaled_value_table,
)

RNG = np.random.default_rng(8)


def bands(level, size=40_000):
    return {
        name: np.clip(RNG.gamma(4.0, level * k / 4.0, size) + 200.0, 1, 65535).astype(np.uint16)
        for name, k in (("red", 1.0), ("green", 1.2), ("blue", 0.7), ("nir", 2.0))
    }


def test_low_high_and_median_of_the_mission_take_their_places():
    exposures = [bands(2000.0), bands(5000.0)]
    sums = {name: sum(histogram(e[name]) for e in exposures) for name in exposures[0]}
    curve = mission_curve(sums)
    values = []
    for name in ("red", "green", "blue"):
        pixels = np.concatenate([e[name] for e in exposures])
        table = lookup_table(curve, name)
        assert np.mean(table[pixels] == 1) == pytest.approx(0.001, abs=0.0015)
        assert np.mean(table[pixels] == 255) == pytest.approx(0.003, abs=0.0015)
        assert np.all(np.diff(table[1:].astype(int)) >= 0)
        values.append(np.median(table[pixels]))
    assert np.mean(values) == pytest.approx(255 * 0.40, abs=6)
    assert np.ptp(values) < 20


def test_no_data_stay_no_data_and_data_never_become_it():
    counts = histogram(np.array([[0, 0, 5], [7, 65535, 5]], np.uint16))
    assert counts[0] == 0 and counts[5] == 2 and counts.sum() == 4
    table = lookup_table(ToneCurve({"red": 100.0}, {"red": 200.0}, 0.5), "red")
    assert table[0] == 0 and table[1] == 1 and table[150] == 1 + round(254 * 0.5**0.5)
    assert table[65535] == 255


def test_half_the_exposure_time_is_compensated():
    bright = bands(3000.0)
    dark = {name: np.maximum(band // 2, 1).astype(np.uint16) for name, band in bright.items()}
    summed = {n: histogram(bright[n]) + histogram(dark[n], 2.0) for n in bright}
    curve = mission_curve(summed)
    single_curve = mission_curve({name: histogram(band) for name, band in bright.items()})
    assert curve.high["red"] == pytest.approx(single_curve.high["red"], rel=0.01)
    for name, band in bright.items():
        difference = lookup_table(curve, name)[band].astype(int) - lookup_table(curve, name, 2.0)[
            dark[name]
        ].astype(int)
        assert np.abs(difference).max() <= 2, name


def test_scaled_values_separate_data_from_no_data_and_do_not_wrap():
    value_table = scaled_value_table(0.1)
    assert value_table[0] == 0 and value_table[1] == 1 and value_table[1000] == 100
    assert scaled_value_table(3.0)[65535] == 65535
    with pytest.raises(ValueError, match="positive"):
        scaled_value_table(0.0)


def test_a_band_without_data_has_no_curve_and_a_mission_without_colour_is_refused():
    empty = np.zeros(65536, np.int64)
    curve = mission_curve({"red": histogram(np.array([[10, 20]], np.uint16)), "nir": empty})
    assert set(curve.low) == {"red"}
    with pytest.raises(ValueError, match="no exposure holds colour"):
        mission_curve({"red": empty})

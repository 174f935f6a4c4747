"""Radiance from counts, by hand calculation, and the file that holds the calibration."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from processing.radiometry.calibration import CalibrationError
from processing.radiometry.radiance import (
    RadianceCalibration,
    load_radiance,
    radiance_as_json,
    radiance_from_raw,
    saturated_pixels,
)
from processing.rig import find_rig

SENSOR = replace(find_rig("rededge").sensor("B"), width_px=8, height_px=6)
CALIBRATION = RadianceCalibration(
    a1=2e-4,
    a2=1e-7,
    a3=3e-6,
    vignetting_centre_px=(3.0, 2.0),
    vignetting=(-1e-3, 2e-4, 0.0, 0.0, 0.0, 0.0),
    wavelength_nm=475.0,
    bandwidth_nm=20.0,
)


def test_radiance_follows_the_maker_s_formula_pixel_by_pixel():
    raw = np.arange(48, dtype=np.uint16).reshape(6, 8) * 640 + 6000
    found = radiance_from_raw(
        SENSOR, CALIBRATION, raw, exposure_time_s=0.002, gain=2.0, black=4700.0
    )
    column, row = 7, 5
    r = np.hypot(column - 3.0, row - 2.0)
    v = 1.0 / (1.0 - 1e-3 * r + 2e-4 * r**2)
    rows = 1.0 / (1.0 + 1e-7 * row / 0.002 - 3e-6 * row)
    raw_value = float(raw[row, column])
    expected = v * rows * (raw_value - 4700.0) * 2e-4 / (2.0 * 0.002 * 65536.0)
    assert found[row, column] == pytest.approx(expected, rel=1e-6)
    assert found.dtype == np.float32


def test_vignetting_in_two_dimensions_follows_the_formula_pixel_by_pixel(tmp_path):
    """RedEdge-P and Altum-PT: coefficients of powers of column and row."""
    powers = ((0, 0), (1, 0), (0, 2), (2, 1))
    flat = replace(
        CALIBRATION, vignetting=(0.9, 0.2, -0.3, 0.15), vignetting_powers=powers,
        vignetting_centre_px=(0.0, 0.0),
    )  # fmt: skip
    raw = np.full((6, 8), 20000, np.uint16)
    found = radiance_from_raw(SENSOR, flat, raw, exposure_time_s=0.002, gain=1.0, black=4700.0)
    x, y, row = 5 / 8, 4 / 6, 4
    v = 1.0 / (0.9 + 0.2 * x - 0.3 * y**2 + 0.15 * x**2 * y)
    rows = 1.0 / (1.0 + 1e-7 * row / 0.002 - 3e-6 * row)
    expected = v * rows * (20000.0 - 4700.0) * 2e-4 / (0.002 * 65536.0)
    assert found[4, 5] == pytest.approx(expected, rel=1e-6)
    path = tmp_path / "B.json"
    path.write_text(json.dumps(radiance_as_json(flat)))
    assert load_radiance(path) == flat
    for powers, sentence in (
        ([[0, 0]], "with a pair for each k"),
        ([[0, 0], [1, 0], [0, 2], [2, 99]], "from 0 to 8"),
        ([[0, 0], [1, 0], [0, 2], [2, True]], "two whole numbers"),
    ):
        path.write_text(json.dumps({**radiance_as_json(flat), "vignetting_powers": powers}))
        with pytest.raises(CalibrationError, match=sentence):
            load_radiance(path)


def test_right_justified_values_of_the_same_light_have_the_same_radiance():
    left = np.full((6, 8), 16 * 1234, np.uint16)
    right = np.full((6, 8), 1234, np.uint16)
    plain = replace(SENSOR, justified="right")
    a = radiance_from_raw(SENSOR, CALIBRATION, left, exposure_time_s=0.001)
    b = radiance_from_raw(plain, CALIBRATION, right, exposure_time_s=0.001)
    assert np.allclose(a, b, rtol=1e-6)
    assert saturated_pixels(SENSOR, np.array([65519, 65520], np.uint16)).tolist() == [False, True]
    assert saturated_pixels(plain, np.array([4094, 4095], np.uint16)).tolist() == [False, True]


def test_a_frame_that_does_not_fit_and_a_missing_exposure_time_are_refused():
    with pytest.raises(ValueError, match="uint16 of"):
        radiance_from_raw(SENSOR, CALIBRATION, np.zeros((6, 7), np.uint16), exposure_time_s=1.0)
    with pytest.raises(ValueError, match="exposure time 0 s"):
        radiance_from_raw(SENSOR, CALIBRATION, np.zeros((6, 8), np.uint16), exposure_time_s=0.0)


def test_a_calibration_survives_its_file_and_a_wrong_one_is_refused(tmp_path):
    path = tmp_path / "B.json"
    content = radiance_as_json(CALIBRATION)
    path.write_text(json.dumps(content))
    assert load_radiance(path) == CALIBRATION
    for change, sentence in (
        ({"a1": 0.0}, "a1 is 0; it is positive"),
        ({"a2": "x"}, "a2 is 'x'; a finite number"),
        ({"vignetting_centre_px": [1.0]}, "two numbers"),
        ({"more": 1}, "other keys"),
    ):
        path.write_text(json.dumps({**content, **change}))
        with pytest.raises(CalibrationError, match=sentence):
            load_radiance(path)
    path.write_text("{")
    with pytest.raises(CalibrationError, match="not valid JSON"):
        load_radiance(path)
    with pytest.raises(CalibrationError, match="cannot be read"):
        load_radiance(tmp_path / "none.json")

"""Registration of colours to green: the projective fit, and a whole band."""

from __future__ import annotations

import numpy as np
import pytest

from processing.geometry.placement import nominal_placements, raw_from_vip_mm, vip_mm_from_raw
from processing.geometry.projective import apply_projective
from processing.image.colour import (
    ColourSettings,
    fit_projective,
    green_positions,
    nominal_registration,
    register_band,
)
from processing.radiometry.corrector import corrector_for
from processing.radiometry.level1 import level1_from_level0
from processing.rig import find_rig
from tests.processing.synthetic_exposure import Exposure, expose

TRUTH = np.array([[1.0004, -0.0003, 0.02], [0.0002, 0.9997, -0.03], [4e-6, -7e-6, 1.0]], np.float64)


def test_a_projective_transformation_comes_back_exactly() -> None:
    source = np.random.default_rng(1).uniform(-12, 12, (60, 2))
    found, rms, used = fit_projective(source, apply_projective(TRUTH, source), np.full(60, 1e-3))
    assert np.abs(found - TRUTH).max() < 1e-10
    assert rms < 1e-9 and used == 60


def test_a_quarter_of_false_matches_does_not_pull_it() -> None:
    rng = np.random.default_rng(2)
    source = rng.uniform(-12, 12, (400, 2))
    target = apply_projective(TRUTH, source) + rng.normal(0, 0.002, source.shape)
    target[:100] += rng.uniform(-0.1, 0.1, (100, 2)) + 0.05
    found, rms, used = fit_projective(source, target, np.full(400, 0.002))
    corners = np.array([[-12.0, -8.0], [12.0, -8.0], [-12.0, 8.0], [12.0, 8.0]])
    off = apply_projective(found, corners) - apply_projective(TRUTH, corners)
    assert np.abs(off).max() < 0.0015
    assert 280 <= used <= 320 and rms == pytest.approx(0.002 * np.sqrt(2), rel=0.15)


@pytest.fixture(scope="module")
def exposure() -> Exposure:
    rig = find_rig("ultracam-x-mini")
    return expose(rig, displaced={"R": (1.3, -0.8), "N": (-0.7, 1.1)})


@pytest.mark.parametrize(("band", "sensor", "bar"), [("red", "R", 0.02), ("nir", "N", 0.04)])
def test_a_displaced_colour_head_is_brought_back_onto_green(
    exposure: Exposure, band: str, sensor: str, bar: float
) -> None:
    rig = find_rig("ultracam-x-mini")
    start = nominal_placements(rig, {}, {})
    truth = nominal_placements(exposure.true_rig, {}, {})
    level1 = {}
    for name in ("G", sensor):
        level1[name] = np.zeros_like(exposure.frames[name])
        level1_from_level0(
            corrector_for(rig.sensor(name), None),
            exposure.frames[name],
            temperature_c=20.0,
            exposure_time_s=0.0,
            tdi_shifts=0,
            out=level1[name],
        )
    found = register_band(
        band,
        start["G"],
        start[sensor],
        level1["G"],
        level1[sensor],
        positions=green_positions(start["G"], level1["G"], ColourSettings()),
        settings=ColourSettings(),
    )
    assert found.registered and found.points > 400
    x, y = np.meshgrid(np.arange(40.0, 1210, 90), np.arange(40.0, 790, 90))
    green_raw = np.stack([x.ravel(), y.ravel()], axis=1)
    ground = vip_mm_from_raw(truth["G"], green_raw)
    fetched = raw_from_vip_mm(
        start[sensor],
        apply_projective(found.band_from_green, vip_mm_from_raw(start["G"], green_raw)),
    )
    off = fetched - raw_from_vip_mm(truth[sensor], ground)
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < bar


def test_a_band_without_texture_lies_as_calibrated_and_reports_it() -> None:
    rig = find_rig("ultracam-x-mini")
    start = nominal_placements(rig, {}, {})
    rng = np.random.default_rng(1)
    noise = {n: (rng.integers(2000, 2100, (832, 1248)) * 2).astype(np.uint16) for n in "GB"}
    found = register_band(
        "blue",
        start["G"],
        start["B"],
        noise["G"],
        noise["B"],
        positions=green_positions(start["G"], noise["G"], ColourSettings()),
        settings=ColourSettings(),
    )
    assert not found.registered
    assert np.array_equal(found.band_from_green, nominal_registration("b", "B").band_from_green)

"""Bands of a made-up five-head camera, rendered from one texture: registered to the truth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from processing.geometry.brown import Brown, lens_from_brown, measured_from_ideal_brown
from processing.geometry.conditions import Conditions
from processing.geometry.lens import measured_from_ideal
from processing.geometry.placement import (
    raw_from_vip_mm,
    vip_mm_from_px,
    vip_mm_from_raw,
    vip_px_from_mm,
)
from processing.geometry.projective import apply_projective, rotation_homography
from processing.geometry.rotation import rotation_matrix
from processing.image.band_registration import (
    BandSettings,
    band_placements,
    raw_of_reference_pixels,
    reference_image,
    register_to_reference,
)
from processing.pipelines.bands import SATURATED, SIGNAL_UNIT, VALID, BandPipeline
from processing.quality.figures.image import SaturationFigures
from processing.quality.report import Flag
from processing.rig import find_rig
from tests.processing.textures import Texture

WIDTH, HEIGHT = 512, 384
ROTATION = rotation_matrix(0.012, -0.021, 0.009)


def small_rig():
    """The RedEdge with fewer pixels and unlike lenses."""
    rig = find_rig("rededge")
    cones = []
    for k, cone in enumerate(rig.cones):
        sensor = replace(cone.sensors[0], width_px=WIDTH, height_px=HEIGHT, x_mm=0.01 * k)
        lens = replace(cone.lens, f_mm=2.2 + 0.004 * k, k1=0.02 + 0.002 * k)
        cones.append(replace(cone, lens=lens, sensors=(sensor,)))
    return replace(rig, cones=tuple(cones))


RIG = small_rig()
TRUE = rotation_homography(ROTATION, 2.2, 2.2)
"""True rotation of a band against its calibration; the rig file does not contain it."""


def rendered(rig, name, true, texture, contrast=1.0):
    """A frame of one head, DN above black: the texture lies in the reference band's image plane."""
    placement = band_placements(rig, {})[name]
    image = reference_image(rig)
    grid = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1).reshape(-1, 2)
    there = apply_projective(np.linalg.inv(true), vip_mm_from_raw(placement, grid.astype(float)))
    at = vip_px_from_mm(image, there).reshape(HEIGHT, WIDTH, 2).astype(np.float32)
    big = texture.astype(np.float32)
    fetched = cv2.remap(big, at + np.float32(64.0), None, cv2.INTER_LANCZOS4)
    return (600.0 + contrast * (fetched - 2000.0)).astype(np.float32)


@pytest.fixture(scope="module")
def scene():
    return Texture(640, np.random.default_rng(5), cutoff=0.12).moved(0.0, 0.0)


def test_a_rotated_band_is_found_to_a_twentieth_of_a_pixel_over_many_pixels(scene):
    placements = band_placements(RIG, {})
    green = rendered(RIG, "G", np.eye(3), scene)
    other = rendered(RIG, "R", TRUE, scene, contrast=0.5)
    noise = np.random.default_rng(1)
    green += noise.normal(0.0, 2.0, green.shape).astype(np.float32)
    other += noise.normal(0.0, 2.0, other.shape).astype(np.float32)
    found = register_to_reference(
        "red", placements["G"], placements["R"], green, other,
        settings=BandSettings(points=800),
    )  # fmt: skip
    assert found.registered and found.points > 400
    assert found.largest_shift_px > 8.0
    assert found.rms_px < 0.1
    corners = np.array([[x, y] for x in (-0.8, 0.0, 0.8) for y in (-0.6, 0.0, 0.6)])
    error = apply_projective(found.band_from_reference, corners) - apply_projective(TRUE, corners)
    assert np.abs(error).max() / placements["R"].sensor.pitch_mm < 0.05


def test_bands_of_different_scenes_are_not_forced_onto_each_other(scene):
    placements = band_placements(RIG, {})
    other = Texture(640, np.random.default_rng(77), cutoff=0.12).moved(0.0, 0.0)
    found = register_to_reference(
        "red",
        placements["G"],
        placements["R"],
        rendered(RIG, "G", np.eye(3), scene),
        rendered(RIG, "R", np.eye(3), other),
        settings=BandSettings(points=400),
    )
    assert not found.registered and np.array_equal(found.band_from_reference, np.eye(3))


def test_the_lattice_gives_raw_pixels_to_a_hundredth_of_a_pixel():
    image, placement = reference_image(RIG), band_placements(RIG, {})["E"]
    dense = raw_of_reference_pixels(image, placement, TRUE)
    grid = np.stack(np.meshgrid(np.arange(3, WIDTH, 37), np.arange(5, HEIGHT, 31)), -1)
    px = grid.reshape(-1, 2).astype(np.float64)
    exact = raw_from_vip_mm(placement, apply_projective(TRUE, vip_mm_from_px(image, px)))
    assert np.abs(dense[grid[..., 1], grid[..., 0]].reshape(-1, 2) - exact).max() < 0.01


def test_signal_saturation_and_the_verdict_of_heads_without_absolute_calibration(scene):
    frames = {
        name: (16 * np.rint(rendered(RIG, name, np.eye(3), scene) + 300.0)).astype(np.uint16)
        for name in "GR"
    }
    frames["R"][100:140, 200:260] = 4095 * 16
    product = BandPipeline(RIG).process(frames, Conditions())
    assert set(product.bands) == {"green", "red"} and product.units["red"] == SIGNAL_UNIT
    middle = np.s_[60:-60, 60:-60]
    assert np.median(product.bands["green"][middle]) == pytest.approx(600.0, rel=0.05)
    difference = np.abs(product.bands["green"] - product.bands["red"])[middle]
    clear = product.masks["red"][middle] == VALID
    assert np.nanpercentile(difference[clear], 95) < 6.0
    share = 40 * 60 / (WIDTH * HEIGHT)
    assert product.report.figures.of(SaturationFigures).saturated_fraction == pytest.approx(share)
    assert np.mean(product.masks["red"] & SATURATED != 0) == pytest.approx(share, rel=0.1)
    assert {Flag.OVEREXPOSED, Flag.FRAME_MISSING} <= set(Flag(product.report.flags))


def test_a_rig_with_several_sensors_in_a_cone_is_refused():
    with pytest.raises(ValueError, match="each cone has one sensor"):
        BandPipeline(replace(find_rig("ultracam-x-mini"), virtual_image=None))


def test_brown_s_distortion_is_carried_into_the_correction_of_eq_5_1():
    brown = Brown(1449.36, (627.6, 479.9), -0.0968, 0.1404, -0.023, 0.000276, 0.00066)
    lens, worst_px = lens_from_brown(
        brown, width_px=1280, height_px=960, pitch_mm=0.00375, f_number=2.8, serial="1"
    )
    assert worst_px < 0.03
    ideal = np.random.default_rng(3).uniform(-0.38, 0.38, (400, 2)) * [1.0, 0.75]
    theirs = measured_from_ideal_brown(brown, ideal) * brown.f_px
    ours = measured_from_ideal(lens, ideal * [lens.f_mm, -lens.f_mm]) / 0.00375 * [1, -1]
    assert np.abs(ours - theirs).max() < 0.03
    with pytest.raises(ValueError, match="cannot be undone"):
        lens_from_brown(
            replace(brown, k1=-3.0), width_px=1280, height_px=960, pitch_mm=0.00375,
            f_number=2.8, serial="1",
        )  # fmt: skip

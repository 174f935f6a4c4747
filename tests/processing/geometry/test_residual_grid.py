"""What a lens does beyond the ten parameters: planted in the emulator, calibrated, taken out."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import numpy as np
import pytest

from daemon.postflight.calibration.rig_writer import rig_toml
from processing.geometry.lens import ideal_from_measured, measured_from_ideal
from processing.geometry.placement import vip_mm_from_px
from processing.geometry.residual_grid import (
    ResidualGrid,
    cross_validation_residuals,
    fit_residual_grid,
    grid_of_lens,
)
from processing.pipelines.perspective import perspective_of, raw_of_perspective
from processing.rig import Cone, LensGrid, Rig, RigError, find_rig, rig_from_mapping
from sim_hw.world.true_camera import true_camera, undistorted

NOISE_UM = 0.1
HALF_MM = (4.6, 3.1)


def ripple_mm(xy_mm: np.ndarray) -> np.ndarray:
    """Up to 2 um that no polynomial of the ten describes."""
    x, y = xy_mm[..., 0], xy_mm[..., 1]
    dx = np.sin(1.1 * x + 0.4) * np.cos(0.9 * y)
    dy = np.cos(0.8 * x) * np.sin(1.3 * y - 0.7)
    return 2e-3 * np.stack([dx, dy], axis=-1)


def planted() -> LensGrid:
    """The ripple in so many nodes that between them it is true to a nanometre or so."""
    x, y = np.linspace(-4.7, 4.7, 95), np.linspace(-3.2, 3.2, 65)
    return ResidualGrid(x, y, ripple_mm(np.stack(np.meshgrid(x, y), axis=-1))).as_lens_grid()


def calibrated() -> LensGrid:
    """What a collimator would find of it at 400 targets."""
    random = np.random.default_rng(4)
    at = random.uniform(-1.0, 1.0, (400, 2)) * HALF_MM
    seen = ripple_mm(at) + random.normal(0.0, NOISE_UM * 1e-3, (400, 2))
    return fit_residual_grid(at, seen, half_mm=HALF_MM, nodes=(17, 13)).as_lens_grid()


def with_grid(rig: Rig, grid: LensGrid | None) -> Cone:
    cone = rig.cone("nadir")
    return replace(cone, lens=replace(cone.lens, k1=-4e-5, residual_grid=grid))


def errors_px(known: LensGrid | None) -> np.ndarray:
    """Where the emulator's lens sees what is put at places of the perspective, less the places."""
    rig = find_rig("midas-mini")
    flown, true = with_grid(rig, known), with_grid(rig, planted())
    image = perspective_of(flown)
    c, r = np.meshgrid(np.linspace(20, image.width_px - 21, 60), np.linspace(20, 811, 40))
    at = np.stack([c.ravel(), r.ravel()], axis=1)
    raw = raw_of_perspective(flown, {}, at)
    camera = true_camera(rig, 1, displaced_px={})
    exact = replace(camera, place_error_mm=dict.fromkeys(camera.place_error_mm, (0.0, 0.0)))
    layer = exact.layer_from_pixel(true.sensors[0], raw[:, 0], raw[:, 1], temperature_c=20.0)
    return (undistorted(true.lens, layer) - vip_mm_from_px(image, at)) / image.pitch_mm


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def test_images_are_truer_with_the_grid_than_without() -> None:
    without, with_it = rms(errors_px(None)), rms(errors_px(calibrated()))
    # 2 um of ripple are 0.19 px RMS; targets of 0.1 um leave hundredths.
    assert without == pytest.approx(0.19, abs=0.03)
    assert with_it < 0.015
    assert rms(errors_px(planted())) < 1e-4, "the same grid, read by two programs"


def test_the_way_back_through_lens_and_grid_is_exact() -> None:
    lens = with_grid(find_rig("midas-mini"), calibrated()).lens
    measured = np.random.default_rng(1).uniform(-1.0, 1.0, (500, 2)) * HALF_MM
    back = measured_from_ideal(lens, ideal_from_measured(lens, measured))
    assert np.abs(back - measured).max() < 1e-9
    grid = grid_of_lens(calibrated())
    far = grid.correction_to_ideal(np.array([[100.0, 0.0], [grid.x_mm[-1], 0.0]]))
    assert far[0] == pytest.approx(far[1]), "beyond the grid its border holds"


def test_a_rig_file_holds_the_grid_and_names_what_is_wrong_in_one() -> None:
    rig = find_rig("midas-mini")
    cones = tuple(with_grid(rig, calibrated()) if c.name == "nadir" else c for c in rig.cones)
    text = rig_toml(replace(rig, cones=cones)).decode()
    assert rig_from_mapping(tomllib.loads(text), "rig.toml") == replace(rig, cones=cones)
    content = tomllib.loads(text)
    grid = content["cone"][0]["lens"]["residual_grid"]
    complete = grid["dy_um"][2]
    grid["dy_um"][2] = complete[:-1]
    with pytest.raises(RigError, match=r"lens cannot be used; residual_grid\.dy_um needs 13 lists"):
        rig_from_mapping(content, "rig.toml")
    grid["dy_um"][2] = complete
    grid["x_mm"][3] += 0.01
    with pytest.raises(RigError, match=r"lens\.residual_grid\.x_mm is .* by equal steps"):
        rig_from_mapping(content, "rig.toml")


def test_halves_that_differ_leave_their_difference() -> None:
    """Every other residual is 1 um, the others -1 um: either half is independent of the other."""
    at = np.random.default_rng(1).uniform(-1.0, 1.0, (200, 2)) * HALF_MM
    sign = np.where(np.arange(200) % 2, -1.0, 1.0)
    residual = sign[:, None] * [1e-3, -5e-4]
    left = cross_validation_residuals(at, residual, half_mm=HALF_MM, nodes=(5, 4))
    np.testing.assert_allclose(left, 2.0 * residual, atol=1e-7)

"""Four converging heads over real imagery; renderer and judge share no code with the pipeline."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from benchmarks import rendered
from processing.pipelines.stitched import Conditions, Pipeline
from processing.quality.figures.circumstances import ProjectionFigures
from processing.quality.figures.image import ValidFigures
from processing.quality.figures.stitching import GreenFigures, PlatformFigures, TiePointFigures
from processing.quality.report import Flag, Verdict
from processing.rig import Rig
from sim_hw.world.snapshots import RigElectronics
from sim_hw.world.world import World

SEED = 5


@dataclass
class Flown:
    exposure: rendered.RenderedExposure
    heads: RigElectronics
    pipeline: Pipeline
    conditions: Conditions

    @property
    def frames(self) -> dict[str, np.ndarray]:
        return self.heads.frames(self.exposure.world, self.exposure.snapshot, seed=SEED)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    world = World(rendered.world_settings("dmc-mini", SEED, dc_k=12.0))
    exposure = rendered.take(world, tmp_path_factory.mktemp("scenes"))
    heads = RigElectronics(world, seed=SEED)
    pipeline = Pipeline(world.rig, rendered.radiometry_of(heads))
    return Flown(exposure, heads, pipeline, rendered.conditions_of(exposure, seed=SEED))


def test_the_virtual_image_is_within_the_accuracy_limits(flown: Flown) -> None:
    product = flown.pipeline.process(flown.frames, flown.conditions)
    figures = product.report.figures
    inner = rendered.errors_of(product.geometry["free"], flown.exposure.snapshot)
    assert inner["inner_rms_px"] < 0.05 and inner["inner_max_px"] < 0.15
    assert product.report.verdict is Verdict.GOOD and not product.report.flags
    assert figures.of(ValidFigures).valid_fraction == 1.0
    assert figures.of(ProjectionFigures).projection_height_m == 3000.0
    assert product.ground is not None
    assert product.platform is not None and not product.platform.is_expired
    assert (figures.of(TiePointFigures).tie_points_pp or 0) > 800
    assert all(band.registered for band in product.bands)
    green_rms_px = figures.of(GreenFigures).green_rms_px
    assert green_rms_px is not None and green_rms_px < 0.2
    assert set(product.colour) == {"red", "green", "blue", "nir"}
    assert all(band.shape == (380, 700) for band in product.colour.values())
    assert product.balance.spread < 0.01


def test_a_platform_that_has_rotated_is_reported_as_expired_and_corrected(flown: Flown) -> None:
    pipeline = Pipeline(
        _with_rotated_head(flown.pipeline.rig, "3", 250e-6), rendered.radiometry_of(flown.heads)
    )
    product = pipeline.process(flown.frames, flown.conditions)
    assert product.report.flags == Flag.CALIBRATION_EXPIRED
    assert product.report.verdict is Verdict.USABLE
    assert product.report.figures.of(PlatformFigures).platform_shift_head == "3"
    inner = rendered.errors_of(product.geometry["free"], flown.exposure.snapshot)
    assert inner["inner_rms_px"] < 0.05 and inner["inner_max_px"] < 0.15


def test_without_one_head_three_quarters_of_the_image_remain(flown: Flown) -> None:
    frames = {name: frame for name, frame in flown.frames.items() if name != "P3"}
    product = flown.pipeline.process(frames, flown.conditions)
    assert Flag.FRAME_MISSING in product.report.flags
    valid = product.report.figures.of(ValidFigures).valid_fraction
    assert isinstance(valid, float) and 0.7 < valid < 0.85
    assert not (product.valid[-100:, :100]).any()
    inner = rendered.errors_of(product.geometry["free"], flown.exposure.snapshot)
    assert inner["inner_rms_px"] < 0.05 and inner["inner_max_px"] < 0.15


def _with_rotated_head(rig: Rig, name: str, phi_rad: float) -> Rig:
    cones = []
    for cone in rig.cones:
        if cone.name == name:
            omega, phi, kappa = cone.rotation_rad
            cone = replace(cone, rotation_rad=(omega, phi + phi_rad, kappa))
        cones.append(cone)
    return replace(rig, cones=tuple(cones))

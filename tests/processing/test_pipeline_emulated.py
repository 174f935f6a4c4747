"""The whole pipeline on an emulated exposure over real imagery, against the emulator's truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from processing.pipelines.stitched import Pipeline, PipelineSettings, Product
from processing.quality.figures.stitching import DisplacedSensorFigures, DisplacementFigures
from processing.quality.report import Flag, Verdict
from processing.radiometry.calibration import load_radiometry
from sim_hw.world import sensor_calibration
from tests.processing.emulated_exposure import SEED, Array, EmulatedExposure, expose, rms

DISPLACED = (1.0, -0.6)


@dataclass(frozen=True)
class Flown:
    """An emulated exposure, and what the pipeline made of it."""

    emulated: EmulatedExposure
    product: Product

    def errors_px(self, method: str) -> tuple[Array, Array]:
        return self.emulated.errors_px(self.product.geometry[method])


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    folder = tmp_path_factory.mktemp("emulated")
    emulated = expose("ultracam-x-mini", folder, height_px=3200, displaced_px={"SU02": DISPLACED})
    rig, radiometry = emulated.world.rig, {}
    for sensor in rig.sensors:
        measured = sensor_calibration.measure(sensor, emulated.sensors[sensor.name], SEED)
        sensor_calibration.write_radiometry(folder, sensor, measured)
        radiometry[sensor.name] = load_radiometry(folder / "radiometry" / f"{sensor.name}.npz")
    pipeline = Pipeline(rig, radiometry, PipelineSettings(baselines=True))
    return Flown(emulated, pipeline.process(emulated.frames, emulated.conditions))


def test_the_stitched_geometry_is_within_the_accuracy_limits(flown: Flown) -> None:
    absolute, inner = flown.errors_px("free")
    assert rms(inner) < 0.05 and np.hypot(*inner.T).max() < 0.15
    assert rms(absolute) < 0.05 and np.hypot(*absolute.T).max() < 0.15


def test_the_earlier_method_is_far_worse_and_without_tdm_worse_still(flown: Flown) -> None:
    free, fixed, no_tdm = (
        rms(flown.errors_px(method)[1]) for method in ("free", "fixed", "fixed-no-tdm")
    )
    assert fixed > 10 * free and no_tdm > 1.2 * fixed


def test_the_displaced_sensor_is_named_over_real_imagery(flown: Flown) -> None:
    report = flown.product.report
    assert report.figures.of(DisplacedSensorFigures).displaced_sensor == "SU02"
    moved = report.figures.of(DisplacementFigures)
    x, y = moved.displacement_x_px, moved.displacement_y_px
    assert x is not None and y is not None
    assert np.hypot(x - DISPLACED[0], y - DISPLACED[1]) < 0.12
    assert report.flags == Flag.DISPLACED_SENSOR and report.verdict is Verdict.USABLE


def test_the_heads_agree_after_the_laboratorys_radiometry(flown: Flown) -> None:
    assert flown.product.balance.spread < 0.01


def test_all_colours_are_registered(flown: Flown) -> None:
    assert [band.registered for band in flown.product.bands] == [True, True, True]

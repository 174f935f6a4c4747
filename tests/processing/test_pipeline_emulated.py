"""An emulated exposure over real imagery: rendered by code that shares nothing with the pipeline.

Relief, syntopic firing, attitude that changes between the cones, lens, drift, TDI, PRNU, dark
signal, defects, vignetting and noise are the emulator's; so is the truth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.pipeline import Conditions, Pipeline, Product, Settings
from processing.quality.report import Flag, Verdict
from processing.radiometry.calibration import load_radiometry
from processing.rig import shipped_rigs
from sim_hw.seeding import random_stream
from sim_hw.world import laboratory
from sim_hw.world.electronics import Electronics, true_sensor
from sim_hw.world.flight import Flight
from sim_hw.world.rendering import Look, light_on_sensor
from sim_hw.world.scene import open_scene
from sim_hw.world.truth import true_vip
from sim_hw.world.world import World, WorldSettings

EPOCH = 1_400_000_000_000_000_000
DISPLACED = (1.0, -0.6)


@dataclass(frozen=True)
class Flown:
    """A processed exposure beside the world it was taken of."""

    product: Product
    world: World
    flight: Flight
    looks: Mapping[str, Look]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    seed = 3
    settings = WorldSettings(
        rig_file=str(shipped_rigs()["ultracam-x-mini"]),
        seed=seed,
        epoch_gps_ns=EPOCH,
        dc_k=12.0,
        displaced_px={"SU02": DISPLACED},
    )
    world = World(settings)
    folder = tmp_path_factory.mktemp("emulated")
    scene = open_scene(replace(world.scene_settings, height_px=3200), folder / "scene")
    flight = world.flight.beginning_first_line_at(1100.0)
    rig, plan = world.rig, world.plan
    reference_ns = EPOCH + 20_000_000_000
    reference_mm = rig.cone(rig.reference_cone).position_mm[0]
    frames, looks = {}, {}
    for cone in rig.cones:
        ahead_m = (cone.position_mm[0] - reference_mm) * 1e-3
        look = Look(
            mid_gps_ns=reference_ns - round(ahead_m / plan.ground_speed_mps * 1e9),
            exposure_time_us=plan.exposure_time_us[cone.name],
            tdi_shifts=plan.tdi_shifts[cone.name],
        )
        for sensor in cone.sensors:
            truth = true_sensor(cone, sensor, seed, field_radius_mm=world.field_radius_mm(cone))
            head = Electronics(sensor, truth, world.electrons_per_radiance_s(cone))
            frames[sensor.name] = head.frame(
                light_on_sensor(world, scene, flight, cone, sensor, look),
                exposure_time_us=look.exposure_time_us,
                tdi_shifts=look.tdi_shifts,
                gain_db=0.0,
                temperature_c=world.temperature_c(sensor.probe, look.mid_gps_ns),
                random=random_stream(seed, "noise", sensor.name, 1),
            )
            looks[sensor.name] = look
            measured = laboratory.measure(sensor, truth, seed)
            laboratory.write_radiometry(folder, sensor, measured)
    radiometry = {
        sensor.name: load_radiometry(folder / "radiometry" / f"{sensor.name}.npz")
        for sensor in rig.sensors
    }
    noise = np.random.default_rng(1)
    product = Pipeline(rig, radiometry, Settings(baselines=True)).process(
        frames,
        Conditions(
            temperatures_c={
                probe: world.temperature_c(probe, reference_ns) + noise.normal(0, 0.1)
                for probe in rig.probes
            },
            exposure_time_s={name: t * 1e-6 for name, t in plan.exposure_time_us.items()},
            tdi_shifts=plan.tdi_shifts,
            ground_speed_mps=plan.ground_speed_mps,
            height_above_ground_m=plan.height_above_ground_m,
        ),
    )
    return Flown(product, world, flight, looks)


def errors_px(flown: Flown, method: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Error of every VIP node: absolute, and after the best similarity (lengths, px)."""
    geometry = flown.product.geometry[method]
    put, seen = [], []
    for name in flown.product.sensors:
        raw = geometry[f"{name}.raw"]
        column, row = true_vip(
            flown.world,
            flown.flight,
            name,
            flown.looks[name],
            columns=raw[:, 0],
            rows=raw[:, 1],
            master_mid_gps_ns=flown.looks["SU00"].mid_gps_ns,
        )
        seen.append(column + 1j * row)
        put.append(geometry[f"{name}.vip"] @ [1, 1j])
    a, b = np.concatenate(seen), np.concatenate(put)
    ac, bc = a - a.mean(), b - b.mean()
    return np.abs(a - b), np.abs(ac - np.vdot(bc, ac) / np.vdot(bc, bc) * bc)


def rms(lengths: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(lengths**2)))


def test_the_stitched_geometry_is_within_the_bars_of_the_house(flown: Flown) -> None:
    absolute, inner = errors_px(flown, "free")
    assert rms(inner) < 0.05 and inner.max() < 0.15
    assert rms(absolute) < 0.05 and absolute.max() < 0.15


def test_the_earlier_method_is_far_worse_and_without_tdm_worse_still(flown: Flown) -> None:
    free, fixed, no_tdm = (
        rms(errors_px(flown, method)[1]) for method in ("free", "fixed", "fixed-no-tdm")
    )
    assert fixed > 10 * free and no_tdm > 1.2 * fixed


def test_the_displaced_sensor_is_named_over_real_imagery(flown: Flown) -> None:
    report = flown.product.report
    assert report.figures["displaced_sensor"] == "SU02"
    x, y = report.figures["displacement_x_px"], report.figures["displacement_y_px"]
    assert isinstance(x, float) and isinstance(y, float)
    assert np.hypot(x - DISPLACED[0], y - DISPLACED[1]) < 0.12
    assert report.flags == Flag.DISPLACED_SENSOR and report.verdict is Verdict.USABLE


def test_the_heads_agree_after_the_laboratorys_radiometry(flown: Flown) -> None:
    assert flown.product.balance.spread < 0.01


def test_all_colours_are_registered(flown: Flown) -> None:
    assert [band.registered for band in flown.product.bands] == [True, True, True]

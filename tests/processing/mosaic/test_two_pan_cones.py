"""A camera of two PAN cones and a Bayer head (ultracam-l), over real imagery of the emulator.

One overlap between two single sensors: a projective layer holds only thanks to green, and green
comes out of a Bayer head. The earlier experiment without either stands beside it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.geometry.placement import nominal_placements, vip_mm_from_raw, vip_px_from_mm
from processing.geometry.projective import apply_projective
from processing.mosaic.free import free_mosaic
from processing.mosaic.pan_only import pan_only_mosaic
from processing.pipeline import Conditions, Pipeline, Product, Settings
from processing.quality.report import Flag, Verdict
from processing.rig import Rig, find_rig, shipped_rigs
from sim_hw.seeding import random_stream
from sim_hw.world.electronics import Electronics, true_sensor
from sim_hw.world.flight import Flight
from sim_hw.world.rendering import Look, light_on_sensor
from sim_hw.world.scene import open_scene
from sim_hw.world.truth import true_vip
from sim_hw.world.world import World, WorldSettings
from tests.processing.synthetic import make_truth, tie_points_of

Array = NDArray[np.float64]

EPOCH = 1_400_000_000_000_000_000


@dataclass(frozen=True)
class Flown:
    """A processed exposure beside the world it was taken of."""

    pipeline: Pipeline
    frames: Mapping[str, NDArray[np.uint16]]
    conditions: Conditions
    product: Product
    world: World
    flight: Flight
    looks: Mapping[str, Look]

    def errors_px(self, name: str, raw: Array, vip: Array) -> Array:
        """Where the ideal master camera sees raw pixels less where they were put, (n, 2)."""
        column, row = true_vip(
            self.world,
            self.flight,
            name,
            self.looks[name],
            columns=raw[:, 0],
            rows=raw[:, 1],
            master_mid_gps_ns=self.looks["SU00"].mid_gps_ns,
        )
        return np.stack([column, row], axis=1) - vip


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    seed = 3
    world = World(
        WorldSettings(
            rig_file=str(shipped_rigs()["ultracam-l-mini"]),
            seed=seed,
            epoch_gps_ns=EPOCH,
            dc_k=12.0,
        )
    )
    rig, plan = world.rig, world.plan
    folder = tmp_path_factory.mktemp("emulated")
    scene = open_scene(replace(world.scene_settings, height_px=2300), folder / "scene")
    flight = world.flight.beginning_first_line_at(1100.0)
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
        (sensor,) = cone.sensors
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
    noise = np.random.default_rng(1)
    conditions = Conditions(
        temperatures_c={
            probe: world.temperature_c(probe, reference_ns) + noise.normal(0, 0.1)
            for probe in rig.probes
        },
        exposure_time_s={name: t * 1e-6 for name, t in plan.exposure_time_us.items()},
        tdi_shifts=plan.tdi_shifts,
        ground_speed_mps=plan.ground_speed_mps,
        height_above_ground_m=plan.height_above_ground_m,
    )
    pipeline = Pipeline(rig, None, Settings())
    product = pipeline.process(frames, conditions)
    colour = {name: band.copy() for name, band in product.colour.items()}
    kept = replace(product, pan=product.pan.copy(), valid=product.valid.copy(), colour=colour)
    return Flown(pipeline, frames, conditions, kept, world, flight, looks)


def rms(vectors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def after_similarity(vip: Array, errors: Array) -> Array:
    a = (vip + errors) @ [1, 1j]
    b = vip @ [1, 1j]
    a, b = a - a.mean(), b - b.mean()
    left = a - np.vdot(b, a) / np.vdot(b, b) * b
    return np.stack([left.real, left.imag], axis=1)


def errors_of(flown: Flown, geometry: Mapping[str, Array]) -> tuple[Array, Array]:
    """Absolute and inner errors of all VIP nodes, (n, 2) px."""
    names = [name for name in ("SU00", "SU10") if f"{name}.vip" in geometry]
    vip = np.concatenate([geometry[f"{name}.vip"] for name in names])
    errors = np.concatenate(
        [flown.errors_px(n, geometry[f"{n}.raw"], geometry[f"{n}.vip"]) for n in names]
    )
    return errors, after_similarity(vip, errors)


def test_the_stitched_geometry_is_within_its_bars(flown: Flown) -> None:
    errors, inner = errors_of(flown, flown.product.geometry["free"])
    assert rms(inner) < 0.02 and np.hypot(*inner.T).max() < 0.06
    assert rms(errors) < 0.1 and np.hypot(*errors.T).max() < 0.3


def test_sixteen_unknowns_and_none_of_them_undetermined(flown: Flown) -> None:
    mosaic = flown.product.mosaic
    assert (mosaic.rank, mosaic.constraints, len(mosaic.values)) == (16, 0, 16)
    assert mosaic.undetermined == ()
    counts = flown.product.tie_points.counts()
    assert counts["SU00", "SU10"] > 200
    assert counts["SU00", "RGB"] > 1200 and counts["SU10", "RGB"] > 1200
    assert flown.product.report.verdict is Verdict.GOOD


def test_nothing_is_said_of_a_displacement_that_cannot_be_seen(flown: Flown) -> None:
    validity = flown.product.validity
    assert validity is not None and validity.displaced is None and not validity.relative
    assert set(validity.observability.values()) == {"unobservable"}
    assert flown.product.report.figures["displaced_sensor"] is None


def test_the_bayer_heads_colours_share_greens_place_and_nir_comes_to_it(flown: Flown) -> None:
    product = flown.product
    assert list(product.colour) == ["red", "green", "blue", "nir"]
    assert [(b.band, b.registered) for b in product.bands] == [("nir", True)]
    image = flown.world.image
    for name, bar in (("RGB", 0.1), ("N", 0.2)):
        sensor = flown.world.rig.sensor(name)
        c, r = np.meshgrid(
            np.linspace(40, sensor.width_px - 40, 15), np.linspace(20, sensor.height_px - 20, 11)
        )
        raw = np.stack([c.ravel(), r.ravel()], axis=1)
        xy = vip_mm_from_raw(product.mosaic.placements[name], raw)
        if name == "N":
            (nir,) = product.bands
            xy = apply_projective(np.linalg.inv(nir.band_from_green), xy)
        assert rms(flown.errors_px(name, raw, vip_px_from_mm(image, xy))) < bar * 2  # PAN px


def test_all_bands_have_the_light_of_the_ground(flown: Flown) -> None:
    colour = flown.product.colour
    shape = (flown.world.image.colour_height_px, flown.world.image.colour_width_px)
    for band in colour.values():
        assert band.shape == shape
        assert (band[4:-4, 4:-4] > 0).mean() > 0.99
    inner = {name: band[50:-50, 50:-50].astype(float).ravel() for name, band in colour.items()}
    # Neighbouring bands look alike, and yet they are not copies of each other.
    assert 0.7 < np.corrcoef(inner["red"], inner["green"])[0, 1] < 0.9999
    assert 0.7 < np.corrcoef(inner["blue"], inner["green"])[0, 1] < 0.9999


@pytest.fixture(scope="module")
def full_size() -> Rig:
    return find_rig("ultracam-l")


def misfit_px(rig: Rig, placements: Mapping[str, object], truth: Mapping[str, object]) -> float:
    """RMS of how the right sensor lies against the left, after a similarity of the whole, px."""
    image = rig.virtual_image
    assert image is not None
    put, belongs = [], []
    for name in ("SU00", "SU10"):
        sensor = rig.sensor(name)
        c, r = np.meshgrid(
            np.linspace(0, sensor.width_px - 1, 12), np.linspace(0, sensor.height_px - 1, 15)
        )
        raw = np.stack([c.ravel(), r.ravel()], axis=1)
        put.append(vip_px_from_mm(image, vip_mm_from_raw(placements[name], raw)))  # type: ignore[arg-type]
        belongs.append(vip_px_from_mm(image, vip_mm_from_raw(truth[name], raw)))  # type: ignore[arg-type]
    vip = np.concatenate(put)
    return rms(after_similarity(vip, np.concatenate(belongs) - vip))


def test_without_green_and_precorrection_the_right_half_is_bent(full_size: Rig) -> None:
    rng = np.random.default_rng(1)
    truth = make_truth(full_size, rng, layer_px=0.0, sensor_px=0.0)
    points = tie_points_of(truth, rng, per_overlap=800, per_sensor=1900)
    start = nominal_placements(full_size, dict.fromkeys(full_size.probes, 30.0), {})
    regular = free_mosaic(full_size, start, points)
    experiment = pan_only_mosaic(full_size, start, points)
    assert experiment.rank == 4 + 4 and experiment.constraints == 4
    assert misfit_px(full_size, regular.placements, truth.placements) < 0.03
    assert misfit_px(full_size, experiment.placements, truth.placements) > 0.08


def test_the_layer_of_the_experiment_is_a_similarity(full_size: Rig) -> None:
    rng = np.random.default_rng(2)
    truth = make_truth(full_size, rng)
    points = tie_points_of(truth, rng, per_overlap=400, per_sensor=10)
    found = pan_only_mosaic(full_size, truth.start, points).placements["SU10"].layer
    f = full_size.cone("1").lens.f_mm
    layer = found / found[2, 2]
    assert layer[0, 0] == pytest.approx(layer[1, 1], abs=1e-9)
    assert layer[0, 1] == pytest.approx(-layer[1, 0], abs=1e-9)
    assert np.abs(layer[2, :2]).max() * f < 1e-9


@pytest.mark.parametrize(
    ("missing", "bar", "pan"),
    [("RGB", 0.05, 0.99), ("N", 0.02, 0.99), ("SU10", 0.01, 0.5), ("SU00", 0.05, 0.5)],
)
def test_a_missing_frame_leaves_an_image_of_what_is_there(
    flown: Flown, missing: str, bar: float, pan: float
) -> None:
    frames = {name: frame for name, frame in flown.frames.items() if name != missing}
    product = flown.pipeline.process(frames, flown.conditions)
    errors, inner = errors_of(flown, product.geometry["free"])
    assert rms(inner) < bar
    assert (product.valid > 0).mean() == pytest.approx(pan, abs=0.06)
    assert Flag.FRAME_MISSING in product.report.flags
    stated = product.report.figures["stitched_sigma_px"]
    assert isinstance(stated, float) and rms(errors) < np.sqrt(2.0) * stated

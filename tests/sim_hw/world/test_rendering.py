"""Frames show what the true camera sees, moved by nothing but the truth, with the right noise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from processing.rig import shipped_rigs
from sim_hw.world import rendering, sensor_calibration, spline, true_camera
from sim_hw.world.electronics import Electronics, SensorTruth, over_tdi_path, true_sensor
from sim_hw.world.rendering import GRID_PX, ExposureParameters
from sim_hw.world.scene import Scene, SceneSettings, open_scene
from sim_hw.world.truth import true_vip
from sim_hw.world.world import World, WorldSettings

EPOCH = 1_400_000_000_000_000_000
RIG = shipped_rigs()["ultracam-x-mini"]
SETTINGS = WorldSettings(
    rig_file=str(RIG), seed=3, epoch_gps_ns=EPOCH, dc_k=12.0, displaced_px={"SU02": (1.0, -0.6)}
)
LOOK = ExposureParameters(EPOCH + 20_000_000_000, 3907.7, tdi_shifts=1)


@pytest.fixture(scope="module")
def world() -> World:
    return World(SETTINGS)


@pytest.fixture(scope="module")
def scene(world: World, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    small = replace(world.scene_settings, height_px=3200)
    yield open_scene(small, tmp_path_factory.mktemp("scene"))


def plain_scene(picture: np.ndarray) -> Scene:
    height, width = picture.shape
    settings = SceneSettings(0, width, height, 0.2, 3)
    bands = {"pan": spline.stored(spline.coefficients(picture.astype(np.float32)))}
    return Scene(settings=settings, bands=bands, patches=0, reused_patches=0)


def test_the_coarse_mapping_is_exact_to_a_thousandth_of_a_pixel(world: World, scene: Scene) -> None:
    flight = world.flight.beginning_first_line_at(1100.0)
    pose = flight.pose(LOOK.mid_gps_ns)
    for name in ("SU00", "SU30", "G"):
        cone, sensor = world.rig.cone_of(name), world.rig.sensor(name)

        def at(c: np.ndarray, r: np.ndarray) -> np.ndarray:
            ground = rendering.ground_points(world, cone, sensor, c, r, LOOK, pose)  # noqa: B023 - called in the same turn
            return rendering.scene_positions(world, scene, flight, ground)

        columns, rows = np.meshgrid(np.arange(0.0, 1240, GRID_PX), np.arange(0.0, 824, GRID_PX))
        corners = [at(columns + i, rows + j) for i in (0, GRID_PX) for j in (0, GRID_PX)]
        middle = at(columns + GRID_PX / 2, rows + GRID_PX / 2)
        samples_per_px = np.linalg.norm(at(columns + 1, rows) - at(columns, rows), axis=-1).mean()
        error = np.linalg.norm(np.mean(corners, axis=0) - middle, axis=-1) / samples_per_px
        assert error.max() < 1e-3


def test_a_ray_cast_by_hand_meets_the_same_ground_and_the_same_virtual_pixel(world: World) -> None:
    flight = world.flight.beginning_first_line_at(1100.0)
    name, column, row = "SU21", 1000.0, 77.0
    cone, sensor = world.rig.cone_of(name), world.rig.sensor(name)
    pose = flight.pose(LOOK.mid_gps_ns)
    sensor_c, f_c = (world.temperature_c(p, LOOK.mid_gps_ns) for p in (sensor.probe, cone.probe))
    dc = sensor_c - 20.0
    u = np.array([(column - 623.5) * 0.0072, (415.5 - (row - 0.5)) * 0.0072])
    rotation = sensor.rotation_rad + sensor.drift.rotation_urad_per_k * 1e-6 * dc
    grow = 1 + sensor.drift.scale_ppm_per_k * 1e-6 * dc
    rotation_2d = np.array(
        [[np.cos(rotation), -np.sin(rotation)], [np.sin(rotation), np.cos(rotation)]]
    )
    error = np.array(world.camera.place_error_mm[name])
    drift = np.array([sensor.drift.x_um_per_k, sensor.drift.y_um_per_k]) * 1e-3 * dc
    p = np.array([sensor.x_mm, sensor.y_mm]) + error + drift + grow * rotation_2d @ u
    ideal = true_camera.undistorted(cone.lens, p[None])[0]
    f = cone.lens.f_mm * (1 + cone.lens.f_ppm_per_k * 1e-6 * (f_c - 20.0))
    ray = world.camera.master_from_cone(cone) @ np.array([ideal[0], ideal[1], -f])
    forward_right_down = np.array([ray[1], ray[0], -ray[2]])
    ray = pose.enu_from_body @ forward_right_down
    start = pose.position_enu_m + pose.enu_from_body @ np.array(cone.position_mm) / 1000
    low, high = 2900.0, 3200.0
    for _ in range(80):
        middle = (low + high) / 2
        point = start + ray / -ray[2] * middle
        above = point[2] > world.terrain.height_m(point[0], point[1])
        low, high = (middle, high) if above else (low, middle)
    arrays = (np.array([column]), np.array([row]))
    ground = rendering.ground_points(world, cone, sensor, *arrays, LOOK, pose)[0]
    assert ground == pytest.approx(point, abs=1e-6)
    flat = start + ray * (start[2] / -ray[2])
    master_ns = LOOK.mid_gps_ns - 1_454_545
    stands = flight.pose(master_ns)
    centre = stands.position_enu_m + stands.enu_from_body @ np.array([0.040, 0, 0])
    seen = stands.enu_from_body.T @ (flat - centre)
    expected = (
        1739.5 + seen[1] / seen[2] * 100.5 / 0.0072,
        1112.5 - seen[0] / seen[2] * 100.5 / 0.0072,
    )
    vip = true_vip(
        world, flight, name, LOOK, columns=arrays[0], rows=arrays[1], master_mid_gps_ns=master_ns
    )
    assert (vip[0][0], vip[1][0]) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("wavelength_px", [60.0, 20.0, 7.3, 5.0, 4.0])
def test_sampling_moves_no_wave_at_any_phase(wavelength_px: float) -> None:
    x = np.arange(400)[None, :] + np.zeros((400, 1))
    wave = 2 * np.pi / wavelength_px
    scene = plain_scene(0.5 + 0.2 * np.cos(wave * x))
    for phase in np.linspace(0, 1, 23):
        c, r = np.meshgrid(np.arange(0, 257, 8.0), np.arange(0, 257, 8.0))
        grid = np.stack([c + 50 + phase, r + 50 + phase], axis=-1)
        seen = rendering.sample_scene(scene, "pan", grid, (256, 256)).mean(axis=0)
        angle = wave * (np.arange(256) + 50 + phase)
        design = np.column_stack([np.ones(256), np.cos(angle), -np.sin(angle)])
        _, amplitude, quadrature = np.linalg.lstsq(design, seen, rcond=None)[0]
        assert abs(quadrature / (amplitude * wave)) < 1e-3
        assert amplitude == pytest.approx(0.2, rel=5e-3)


@pytest.mark.parametrize("columns", [400, 401])
def test_beyond_the_scene_all_bands_are_mirrored_at_one_line(columns: int) -> None:
    settings = SceneSettings(seed=1, width_px=columns, height_px=128, sample_m=0.1, colour_ratio=3)
    x = np.arange(columns)
    wave = np.broadcast_to(0.5 + 0.2 * np.sin(x / 17.0), (128, columns))
    bands = {
        name: spline.stored(spline.coefficients(wave[::step, ::step].astype(np.float32)))
        for name, step in (("pan", 1), ("red", 2))
    }
    scene = Scene(settings=settings, bands=bands, patches=0, reused_patches=0)
    assert scene.step("red") == 2
    nodes = np.arange(0, 64 + GRID_PX, GRID_PX, dtype=float)
    grid = np.empty((len(nodes), len(nodes), 2))
    grid[..., 0], grid[..., 1] = columns + 20.0 + nodes[None, :], 30.0 + nodes[:, None]
    seen = {band: rendering.sample_scene(scene, band, grid, (64, 64)) for band in ("pan", "red")}
    assert float(np.ptp(seen["pan"][0])) > 0.2
    assert seen["red"] == pytest.approx(seen["pan"], abs=2e-3)


def test_overlapping_frames_agree_with_the_ideal_image_where_the_truth_puts_them(
    world: World, scene: Scene
) -> None:
    flight = world.flight.beginning_first_line_at(1100.0)
    master_ns = EPOCH + 20_000_000_000
    ideal = rendering.render_ideal(world, scene, flight, master_ns)
    for name, behind_m in (("SU02", 0.0), ("SU11", 0.08), ("SU30", -0.16)):
        cone, sensor = world.rig.cone_of(name), world.rig.sensor(name)
        look = replace(LOOK, mid_gps_ns=master_ns - round(behind_m / 55.0 * 1e9), tdi_shifts=2)
        look = replace(look, exposure_time_us=2 * 3907.7)
        light = rendering.light_on_sensor(world, scene, flight, cone, sensor, look)
        columns, rows = np.meshgrid(np.arange(300.0, 900, 3), np.arange(200.0, 600, 3))
        vip = true_vip(
            world, flight, name, look, columns=columns, rows=rows, master_mid_gps_ns=master_ns
        )
        seen = light[200:600:3, 300:900:3]
        gy, gx = np.gradient(ideal)
        found = _interpolated(ideal, vip)
        slopes = np.column_stack([_interpolated(g, vip).ravel() for g in (gx, gy)])
        shift, *_ = np.linalg.lstsq(slopes, (seen - found).ravel(), rcond=None)
        # Smear and relief leave grey values a little apart, but nothing is shifted.
        assert np.abs(shift).max() < 0.03


def _interpolated(picture: np.ndarray, at: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    from scipy.ndimage import map_coordinates

    return np.asarray(map_coordinates(picture, [at[1], at[0]], order=3))


def test_tdi_that_fits_the_flight_leaves_only_the_crab_and_the_tremor(world: World) -> None:
    calm = replace(
        world.flight.plan, attitude_rms_deg=0.0, rate_rms_dps=0.0, track_deviation_rms_m=0.0
    )
    flight = replace(world.flight, plan=calm)
    cone, sensor = world.rig.cone_of("SU30"), world.rig.sensor("SU30")
    crab = np.arctan2(4.0, 55.0) * 0.2
    columns, rows = rendering.residual_smear_px(world, flight, cone, sensor, LOOK)
    # Against the wind the image creeps sideways by v t / GSD times the sine of the crab.
    assert columns == pytest.approx(-np.sin(crab), abs=0.004)
    assert rows == pytest.approx(0.0, abs=0.005)
    plain = replace(LOOK, tdi_shifts=0)
    assert rendering.residual_smear_px(world, flight, cone, sensor, plain)[1] == pytest.approx(
        1.0, abs=0.005
    )


def test_smear_is_a_box_as_long_as_the_motion() -> None:
    point = np.zeros((41, 41), dtype=np.float32)
    point[20, 20] = 1.0
    spread = rendering.smeared(point, (0.8, -3.0))
    x = np.arange(41) - 20.0
    assert spread.sum() == pytest.approx(1.0, abs=1e-5)
    assert spread.sum(0) @ x**2 == pytest.approx(0.8**2 / 12, abs=2e-3)
    assert spread.sum(1) @ x**2 == pytest.approx(3.0**2 / 12, abs=2e-2)
    assert x @ spread @ x == pytest.approx(-0.8 * 3.0 / 12, abs=1e-2)


def test_noise_follows_the_photon_transfer_curve(world: World) -> None:
    sensor = world.rig.sensor("SU30")
    shape = (sensor.height_px, sensor.width_px)
    flat = SensorTruth(
        response=np.ones(shape, "f4"),
        dark_e_per_s=np.zeros(shape, "f4"),
        bias_dn=np.full(shape, 64.0, "f4"),
        defect=np.zeros(shape, "u1"),
    )
    electronics = Electronics(sensor, flat, electrons_per_radiance_s=1e7)
    signal, variance = [], []
    for number, level in enumerate((0.005, 0.05, 0.2, 0.5, 0.9, 1.4)):
        frame = electronics.frame(
            np.full(shape, level, "f4"),
            exposure_time_us=4000.0,
            tdi_shifts=0,
            gain_db=0.0,
            temperature_c=20.0,
            random=np.random.default_rng(number),
        )
        assert frame.mean() - 64 == pytest.approx(level * 2000, rel=2e-3, abs=0.02)
        signal.append(frame.mean() - 64)
        variance.append(frame.var())
    slope, offset = np.polyfit(signal, variance, 1)
    assert 1 / slope == pytest.approx(sensor.electrons_per_dn, rel=0.01)
    read_dn2 = (sensor.read_noise_e / sensor.electrons_per_dn) ** 2
    assert offset == pytest.approx(read_dn2 + 1 / 12, rel=0.15)


def test_light_beyond_the_range_is_clipped_at_twelve_bits(world: World) -> None:
    sensor, cone = world.rig.sensor("SU30"), world.rig.cone_of("SU30")
    truth = true_sensor(cone, sensor, 1, field_radius_mm=15.0)
    electronics = Electronics(sensor, truth, electrons_per_radiance_s=1e9)
    frame = electronics.frame(
        np.ones(truth.response.shape, "f4"),
        exposure_time_us=4000.0,
        tdi_shifts=1,
        gain_db=0.0,
        temperature_c=20.0,
        random=np.random.default_rng(0),
    )
    assert frame.dtype == np.uint16
    assert frame.max() == 4095


def test_with_tdi_a_pixel_is_the_mean_of_those_its_charge_visits() -> None:
    values = np.arange(5, dtype=np.float32)[:, None] + 1
    down = over_tdi_path(values, shifts=2, row_sign=1)
    assert down[:, 0] == pytest.approx([1 / 3, 3 / 3, 6 / 3, 9 / 3, 12 / 3])
    up = over_tdi_path(values, shifts=2, row_sign=-1)
    assert up[:, 0] == pytest.approx([6 / 3, 9 / 3, 12 / 3, 9 / 3, 5 / 3])


def test_the_laboratory_finds_the_sensor_within_the_noise_of_its_series(
    world: World, tmp_path: Path
) -> None:
    cone, sensor = world.rig.cone_of("SU00"), world.rig.sensor("SU00")
    truth = true_sensor(cone, sensor, 3, field_radius_mm=world.field_radius_mm(cone))
    found = sensor_calibration.measure(sensor, truth, 3)
    good = truth.defect == 0
    residual = found.gain[good] * truth.response[good] - 1
    light_e = 0.5 * 4095 * 20
    expected = np.sqrt((light_e + 900) / 100) / light_e
    assert residual.std() == pytest.approx(expected, rel=0.25)
    assert abs(residual.mean()) < 1e-4
    assert (found.bias_dn - truth.bias_dn).std() == pytest.approx(1.5 / 8, rel=0.05)
    assert found.dark_dn_per_s[good].mean(dtype=float) == pytest.approx(150 * 1.02 / 20, rel=0.02)
    assert np.isfinite(found.gain).all()
    assert found.gain.max() < 2.5
    assert 1000 * 0.5 < found.defect.sum() < 5000
    sensor_calibration.write_radiometry(tmp_path, sensor, found)
    with np.load(tmp_path / "radiometry" / "SU00.npz") as stored:
        assert set(stored.files) == {
            "bias_dn",
            "dark_dn_per_s",
            "reference_c",
            "doubling_k",
            "gain",
            "defect",
        }
        assert stored["dark_dn_per_s"].dtype == np.float16


@pytest.mark.parametrize("electrons_per_dn", [20.0, 1.0])
def test_the_dark_signal_of_a_hot_pixel_ends_at_the_converters_range(
    world: World, electrons_per_dn: float
) -> None:
    cone = world.rig.cone_of("SU00")
    sensor = replace(world.rig.sensor("SU00"), electrons_per_dn=electrons_per_dn)
    truth = true_sensor(cone, sensor, 3, field_radius_mm=world.field_radius_mm(cone))
    found = sensor_calibration.measure(sensor, truth, 3)
    limit = (sensor.full_scale_dn - truth.bias_dn) / sensor_calibration.DARK_EXPOSURE_S
    assert truth.dark_e_per_s.max() / electrons_per_dn > limit.max()
    assert np.isfinite(found.dark_dn_per_s).all()
    assert found.dark_dn_per_s.max() == pytest.approx(limit.max(), rel=0.01)


def test_calibrated_frames_give_the_light_back(world: World, scene: Scene) -> None:
    flight = world.flight.beginning_first_line_at(1100.0)
    cone, sensor = world.rig.cone_of("SU00"), world.rig.sensor("SU00")
    truth = true_sensor(cone, sensor, 3, field_radius_mm=world.field_radius_mm(cone))
    found = sensor_calibration.measure(sensor, truth, 3)
    electronics = Electronics(sensor, truth, world.electrons_per_radiance_s(cone))
    look = replace(LOOK, tdi_shifts=0)
    light = rendering.light_on_sensor(world, scene, flight, cone, sensor, look)
    frame = electronics.frame(
        light,
        exposure_time_us=look.exposure_time_us,
        tdi_shifts=0,
        gain_db=0.0,
        temperature_c=32.0,
        random=np.random.default_rng(0),
    )
    warm = 2.0 ** ((32.0 - found.reference_c) / found.doubling_k)
    dark = found.dark_dn_per_s.astype(float) * look.exposure_time_us * 1e-6 * warm
    linear = (frame - found.bias_dn - dark) * found.gain
    expected = electronics.linear_dn(light, look.exposure_time_us)
    good = (found.defect == 0) & (frame < 4095)
    sigma = np.sqrt(expected / found.gain / 20 + (30 / 20) ** 2 + 1 / 12) * found.gain
    normalised = ((linear - expected) / sigma)[good]
    assert abs(normalised.mean()) < 0.02
    assert normalised.std() == pytest.approx(1.0, abs=0.03)

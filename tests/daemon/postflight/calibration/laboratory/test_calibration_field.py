"""`calibrate lab` before the emulated 3D test field, held against its truth."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2
from typer.testing import CliRunner

from benchmarks.laboratory_field import calibrate_sample, errors_of, pooled
from daemon.cli.calibrate import app
from daemon.postflight.calibration.laboratory.calibration_field import RigCalibration
from daemon.postflight.calibration.laboratory.field_network import LENS_FREE
from daemon.postflight.calibration.laboratory.field_report import covariance_of
from daemon.postflight.calibration.rig_writer import rig_toml
from processing.geometry.placement import nominal_placements, raw_from_vip_mm, vip_mm_from_raw
from processing.geometry.similarity import apply_similarity, fit_similarity
from processing.geometry.topology import overlaps
from processing.matching.disc_targets import disc_positions, identify_targets
from processing.matching.tie_points import PAN_TO_PAN, TiePoints
from processing.mosaic.free_mosaic import free_mosaic
from processing.rig import Rig, Sensor, find_rig, load_rig, shipped_rigs
from sim_hw.laboratory import calibration_field
from sim_hw.world.true_camera import TrueCamera

Array = NDArray[np.float64]

RIG = "ultracam-l-mini"
FOUR_CONES = "ultracam-x-mini"
PAN = ("0", "1")


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Frames of the two PAN cones only, which keeps the room small."""
    root = tmp_path_factory.mktemp("field")
    rig = find_rig(RIG)
    plan = replace(calibration_field.plan_for(rig, 7), count=(19, 19))
    pan = replace(rig, cones=rig.pan_cones)
    file = shipped_rigs()[RIG]
    for take in (1, 2):
        calibration_field.write_series(pan, file, root / str(take), seed=1, take=take, plan=plan)
    yield root


def _calibrated(*arguments: str) -> dict[str, Any]:
    run = CliRunner().invoke(app, ["lab", *arguments, "--json"])
    assert run.exit_code == 0, run.output
    output: dict[str, Any] = json.loads(run.stdout)
    return output


def test_frames_of_the_field_give_the_true_places_within_their_sigmas(laboratory: Path) -> None:
    output = _calibrated(str(laboratory / "1" / "series"), "--out", str(laboratory / "a"))
    truth = calibration_field.true_rig(replace(find_rig(RIG), cones=find_rig(RIG).pan_cones), 1)
    before, rig = find_rig(RIG), load_rig(laboratory / "a" / "rig.toml")
    assert output["figures"]["sigma_px"] < 0.02
    assert output["figures"]["image_points"] > 800
    sigma = {(q["where"], q["what"]): q["sigma"] for q in output["quantities"]}
    for name in ("SU00", "SU10"):
        new, old, true = rig.sensor(name), before.sensor(name), truth.sensors[name]
        for what, error_um in (
            ("x", 1e3 * (new.x_mm - old.x_mm - true.shift[0])),
            ("y", 1e3 * (new.y_mm - old.y_mm - true.shift[1])),
            ("scale", 1e6 * (new.scale / old.scale - 1 - true.scale)),
        ):
            assert abs(error_um) < 4.0 * sigma[name, what], (name, what, error_um)
        assert sigma[name, "x"] < 10.0
        # The datum: the only CCD of a cone is not turned, f and the principal point stay.
        assert new.rotation_rad == old.rotation_rad
        assert rig.cone_of(name).lens.f_mm == before.cone_of(name).lens.f_mm
        assert rig.cone_of(name).calibration_c == pytest.approx(22.0, abs=0.1)
    # Colour cones were not looked at and are as they were, probes apart.
    assert rig.cone("N").lens == before.cone("N").lens
    with np.load(laboratory / "a" / "covariance.npz") as covariance:
        assert covariance["covariance"].shape == (len(covariance["names"]),) * 2


def test_calibrated_again_nothing_has_changed(laboratory: Path, tmp_path: Path) -> None:
    if not (laboratory / "a").exists():
        _calibrated(str(laboratory / "1" / "series"), "--out", str(laboratory / "a"))
    again = _calibrated(
        *(str(laboratory / "2" / "series"), "--out", str(tmp_path / "b")),
        *("--previous", str(laboratory / "a")),
    )
    assert len(again["changes"]) > 15
    assert not [c for c in again["changes"] if c["significant"]]


def test_errors_of_rig_parameters_agree_with_their_covariance() -> None:
    found = pooled(find_rig(RIG), range(1, 5), exposures=12, targets=(16, 16))
    low, high = found.interval
    assert low < found.mean < high
    size = np.abs(found.standardised)
    assert float(np.mean(size <= 3.0)) >= 0.98
    assert float(size.max()) < 5.0


@pytest.fixture(scope="module")
def skewed() -> Iterator[tuple[RigCalibration, calibration_field.TrueRig]]:
    """CCDs so small are skewed twenty times as much as large ones: some um at the corner."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibration_field, "SKEW_PER_MM", 60e-6)
        yield calibrate_sample(find_rig(FOUR_CONES), 1, exposures=12, targets=(16, 16))


def test_every_ccd_has_its_place_scale_and_skew_and_all_but_one_of_a_cone_its_rotation(
    skewed: tuple[RigCalibration, calibration_field.TrueRig],
) -> None:
    rig = find_rig(FOUR_CONES)
    found, truth = skewed
    rows, error = errors_of(found, truth)
    covariance = covariance_of(found, rows)
    scale = 1.0 / np.sqrt(np.diag(covariance))
    squares = (error * scale) @ np.linalg.solve(covariance * scale[:, None] * scale, error * scale)
    assert chi2.ppf(0.0005, len(rows)) < squares < chi2.ppf(0.9995, len(rows))
    kinds = [r.what for r in rows]
    assert kinds.count("x") == kinds.count("scale") == kinds.count("skew x") == 13
    assert kinds.count("rotation") == 13 - len(rig.cones)
    assert kinds.count("omega") == len(rig.cones) - 1
    assert kinds.count("k1") == len(rig.cones)
    assert len(rows) == len(error) == 13 * 5 + 5 + 3 * 7 + len(LENS_FREE) * 8
    assert [r.where for r in rows if r.what == "rotation"] == [
        *("SU01", "SU02", "SU03", "SU11", "SU21")
    ]


def test_the_stitched_image_is_right_with_the_skew_that_was_found_and_wrong_without(
    skewed: tuple[RigCalibration, calibration_field.TrueRig], tmp_path: Path
) -> None:
    found, truth = skewed
    corner_um = [
        1e3 * np.hypot(u, v) * (abs(truth.sensors[s.name].skew[0]) * u + abs(k) * v)
        for s in found.rig.master_sensors
        for k in [truth.sensors[s.name].skew[1]]
        for u, v in [(s.width_px * s.pitch_mm / 2, s.height_px * s.pitch_mm / 2)]
    ]
    assert 1.0 < max(corner_um) < 6.0
    file = tmp_path / "rig.toml"
    file.write_bytes(rig_toml(found.rig))
    assert inner_error_px(load_rig(file), truth) < 0.05
    straight = {"skew_x_ppm_per_mm": 0.0, "skew_y_ppm_per_mm": 0.0}
    assert inner_error_px(with_sensors(found.rig, lambda _: straight), truth) > 0.12


def with_sensors(rig: Rig, changes: Callable[[Sensor], Mapping[str, Any]]) -> Rig:
    cones = (
        replace(c, sensors=tuple(replace(s, **changes(s)) for s in c.sensors)) for c in rig.cones
    )
    return replace(rig, cones=tuple(cones))


def inner_error_px(rig: Rig, truth: calibration_field.TrueRig) -> float:
    """RMS of where a rig's stitching puts pixels, less where the emulated camera really looks,
    after the best similarity. Tie points are the emulator's too, with 0.02 px of noise."""

    def lies(sensor: Sensor) -> dict[str, float]:
        true = truth.sensors[sensor.name]
        return {
            "x_mm": sensor.x_mm + true.shift[0],
            "y_mm": sensor.y_mm + true.shift[1],
            "rotation_rad": sensor.rotation_rad + true.rotation,
            "scale": sensor.scale * (1 + true.scale),
            "skew_x_ppm_per_mm": 1e6 * true.skew[0],
            "skew_y_ppm_per_mm": 1e6 * true.skew[1],
        }

    exact = with_sensors(truth.rig, lies)
    camera = TrueCamera(exact, {s.name: (0.0, 0.0) for s in exact.sensors}, truth.rotation_rad)
    random = np.random.default_rng(1)
    areas, count = overlaps(rig), 100
    start = nominal_placements(rig, {}, {}, use_drift=False)

    def seen_mm(name: str, raw: Array) -> Array:
        cone, sensor = exact.cone_of(name), exact.sensor(name)
        cold = {"sensor_c": sensor.calibration_c, "cone_c": cone.calibration_c}
        ray = camera.directions(cone, sensor, raw[:, 0], raw[:, 1], **cold)
        return np.asarray(-cone.lens.f_mm * ray[:, :2] / ray[:, 2:])

    def seeing(name: str, xy_mm: Array) -> Array:
        raw = raw_from_vip_mm(start[name], xy_mm)
        for _ in range(4):
            off = xy_mm - seen_mm(name, raw)
            raw = raw + off * np.array([1.0, -1.0]) / exact.sensor(name).pitch_mm
        return raw + random.normal(0, 0.02, raw.shape)

    places = [
        random.uniform((r.x_min_mm, r.y_min_mm), (r.x_max_mm, r.y_max_mm), (count, 2))
        for r in (area.rectangle for area in areas)
    ]
    names = tuple(s.name for s in rig.sensors)
    ties = TiePoints(
        names=names,
        pairs=tuple((o.sensor_a, o.sensor_b) for o in areas),
        attempted=(count,) * len(areas),
        sensor_a=np.repeat([names.index(o.sensor_a) for o in areas], count),
        sensor_b=np.repeat([names.index(o.sensor_b) for o in areas], count),
        raw_a=np.concatenate([seeing(o.sensor_a, p) for o, p in zip(areas, places, strict=True)]),
        raw_b=np.concatenate([seeing(o.sensor_b, p) for o, p in zip(areas, places, strict=True)]),
        sigma_px=np.full(count * len(areas), 0.03),
        correlation=np.ones(count * len(areas)),
        kind=np.full(count * len(areas), PAN_TO_PAN),
        overlap=np.repeat(np.arange(len(areas)), count),
    )
    stitched = free_mosaic(rig, start, ties).placements
    put, true = [], []
    for sensor in (s for cone in rig.pan_cones for s in cone.sensors):
        axes = (np.linspace(0, n - 1, 12) for n in (sensor.width_px, sensor.height_px))
        raw = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        put.append(vip_mm_from_raw(stitched[sensor.name], raw))
        true.append(seen_mm(sensor.name, raw))
    placed, truth_px = np.concatenate(put), np.concatenate(true)
    off = apply_similarity(fit_similarity(placed, truth_px), placed) - truth_px
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1)))) / rig.sensors[0].pitch_mm


def test_discs_are_measured_without_bias_and_touching_ones_left_out() -> None:
    random = np.random.default_rng(1)
    sensor = find_rig(RIG).sensors[0]
    row, column = np.mgrid[100:1600:90, 100:1200:90]
    true = np.stack([column.ravel(), row.ravel()], axis=1) + random.uniform(0, 1, (row.size, 2))
    pair = np.array([[300.0, 60.0], [309.0, 60.0]])
    pixels = calibration_field.frame(sensor, np.vstack([true, pair]), random)
    found = disc_positions(pixels)
    assert len(found) == len(true)
    distance = np.hypot(*(found[:, None] - true[None]).transpose(2, 0, 1))
    error = found - true[np.argmin(distance, axis=1)]
    assert float(np.sqrt(np.mean(error**2))) < 0.01
    assert float(np.abs(error.mean(axis=0)).max()) < 0.002


def test_targets_are_identified_although_the_holder_is_off_by_tens_of_pixels() -> None:
    random = np.random.default_rng(2)
    predicted = random.uniform(0, 1200, (120, 2))
    transform = np.array([[1.0, 0.004], [-0.004, 1.002]])
    found = predicted @ transform.T + np.array([47.0, -61.0]) + random.normal(0, 0.3, (120, 2))
    shuffled = random.permutation(120)[:90]
    spurious = random.uniform(0, 1200, (25, 2))
    a, b = identify_targets(predicted, np.vstack([found[shuffled], spurious]), reach_px=120.0)
    right = b < 90
    assert right.sum() > 80
    assert (shuffled[b[right]] == a[right]).all()
    assert (~right).sum() <= 1

"""`calibrate flight`: a rig that `syntopic init` wrote is calibrated from its first flight."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from daemon.cli.calibrate import app
from daemon.postflight.calibration.flight import frames
from processing.geometry.lens import ideal_from_measured
from processing.geometry.placement import layer_mm_from_raw
from processing.rig import Rig, load_rig
from tests.daemon.postflight.calibration.flight.flown_frames import (
    PITCH_UM,
    new_rig,
    true_rig,
    write_mission,
)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Rig, Rig]:
    folder = tmp_path_factory.mktemp("flight")
    rig = new_rig(folder)
    truth = true_rig(rig)
    return write_mission(folder, (folder / "rig.toml").read_bytes(), truth), rig, truth


def run(*arguments: str) -> dict[str, Any]:
    done = CliRunner().invoke(app, ["flight", *arguments, "--json"])
    assert done.exit_code == 0, f"{done.output} {done.exception}"
    output: dict[str, Any] = json.loads(done.stdout)
    return output


def refusal(*arguments: str) -> str:
    done = CliRunner().invoke(app, ["flight", *arguments])
    assert done.exit_code != 0
    return str(done.exception)


@pytest.fixture(scope="module")
def calibrated(
    flown: tuple[Path, Rig, Rig], tmp_path_factory: pytest.TempPathFactory
) -> tuple[dict[str, Any], Path]:
    folder = tmp_path_factory.mktemp("calibrated") / "new"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frames, "FEATURES_MAX", 1000)
        return run(str(flown[0]), "--out", str(folder)), folder


def test_the_first_flight_calibrates_a_new_rig(
    flown: tuple[Path, Rig, Rig], calibrated: tuple[dict[str, Any], Path]
) -> None:
    _, before, truth = flown
    output, folder = calibrated
    assert not before.is_calibrated
    figures = output["figures"]
    assert figures["exposures"] == 12 and figures["sigma_px"] < 1.0
    assert not figures["stays_uncalibrated"], output["warnings"]
    assert figures["common_points"]["left right"] > 50
    rig = load_rig(folder / "rig.toml")
    assert rig.is_calibrated and rig.calibration_id == output["calibration_id"]
    sigma = {(q["where"], q["what"]): q["sigma"] for q in output["quantities"]}
    for name in ("left", "right"):
        new, true = rig.cone(name), truth.cone(name)
        assert abs(new.lens.f_mm - true.lens.f_mm) < 4.0 * sigma[name, "f"]
        assert sigma[name, "f"] < 0.005 * true.lens.f_mm
        for key in ("k1", "p1", "p2"):
            assert abs(getattr(new.lens, key) - getattr(true.lens, key)) < 4.0 * sigma[name, key]
        assert new.lens.f_sigma_ppm == pytest.approx(1e6 * sigma[name, "f"] / new.lens.f_mm, 0.01)
    turned, true_turn = (
        Rotation.from_euler("XYZ", r.cone("right").rotation_rad) for r in (rig, truth)
    )
    error = (true_turn.inv() * turned).as_rotvec()
    assert (np.abs(error) < 4e-6 * 2.0 * rig.cone("right").rotation_sigma_urad).all()
    assert rig.cone("left").rotation_rad == before.cone("left").rotation_rad
    assert (folder / "report.html").exists() and (folder / "covariance.npz").exists()


def test_what_is_common_to_both_heads_lands_on_one_place(
    flown: tuple[Path, Rig, Rig], calibrated: tuple[dict[str, Any], Path]
) -> None:
    """Directions of the overlap, by the calibrated rig, against those of the true one."""
    _, before, truth = flown
    rig = load_rig(calibrated[1] / "rig.toml")
    assert _misfit_px(before, truth) > 3.0
    assert _misfit_px(rig, truth) < 0.5


def _misfit_px(rig: Rig, truth: Rig) -> float:
    """Where the right head's pixels of the overlap come to lie in the left head, RMS px."""
    px = np.stack(np.meshgrid(np.linspace(10, 200, 8), np.linspace(20, 300, 8)), -1)
    px = px.reshape(-1, 2)

    def in_left(one: Rig) -> np.ndarray[Any, Any]:
        left, right = one.cone("left"), one.cone("right")
        ideal = ideal_from_measured(right.lens, layer_mm_from_raw(right.sensors[0], px))
        turn = Rotation.from_euler("XYZ", left.rotation_rad).inv()
        turn = turn * Rotation.from_euler("XYZ", right.rotation_rad)
        ray = turn.apply(np.column_stack([ideal, np.full(len(ideal), -right.lens.f_mm)]))
        return np.asarray(-left.lens.f_mm * ray[:, :2] / ray[:, 2:])

    def raw(one: Rig, ideal: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        left, measured = one.cone("left"), ideal
        for _ in range(20):
            measured = measured + ideal - ideal_from_measured(left.lens, measured)
        sensor = left.sensors[0]
        return np.asarray(measured - [sensor.x_mm, sensor.y_mm])

    away = raw(rig, in_left(rig)) - raw(truth, in_left(truth))
    return float(np.sqrt(np.mean(np.sum(away**2, axis=1)))) / (PITCH_UM * 1e-3)


def test_positions_come_from_a_post_processed_trajectory(
    flown: tuple[Path, Rig, Rig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frames, "FEATURES_MAX", 40)
    in_flight = frames.read_flight([flown[0]])
    mission = Path(shutil.copytree(flown[0], tmp_path / "mission"))
    rows = ["gps_ns,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg"]
    for path in sorted((mission / "L0").glob("*/exposure.json")):
        record = json.loads(path.read_text())
        own = record.pop("navigation")
        path.write_text(json.dumps(record))
        place = f"{own['latitude_deg']:.12f},{own['longitude_deg']:.12f},{own['height_m'] + 5.0}"
        rows.append(f"{own['gps_ns']},{place},0,0,0")
    (tmp_path / "ppk.csv").write_text("\n".join(rows) + "\n")
    found = frames.read_flight([mission], trajectory_file=tmp_path / "ppk.csv")
    moved = found.images.position_m - in_flight.images.position_m
    assert np.abs(moved - [0.0, 0.0, 5.0]).max() < 1e-3
    assert found.without_sigma == 12
    assert found.images.position_sigma_m[0].tolist() == [0.05, 0.05, 0.08]


def test_pairs_that_contradict_the_positions_are_left_out_and_counted(
    flown: tuple[Path, Rig, Rig], monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[Any] = []

    def contradicting(*arguments: Any) -> set[tuple[int, int]]:
        given.extend(arguments)
        return {pair for pair in arguments[-1] if pair[0] == 0}

    monkeypatch.setattr(frames, "FEATURES_MAX", 300)
    monkeypatch.setattr(frames, "contradicting_pairs", contradicting)
    found = frames.read_flight([flown[0]])
    _, head, exposure, position_m, px, pairs = given
    assert found.contradicting == 0 and 0 in found.images.tracks.image
    assert found.plausible is not None
    found = found.without_contradicting(found.plausible)
    assert 0 < found.contradicting < found.matched == len(pairs)
    assert 0 not in found.images.tracks.image
    assert len(head) == len(exposure) == len(px) and len(position_m) == found.exposures


def test_flights_that_cannot_calibrate_are_refused(
    flown: tuple[Path, Rig, Rig], tmp_path: Path
) -> None:
    mission = Path(shutil.copytree(flown[0], tmp_path / "mission"))
    for number in range(5, 13):
        shutil.rmtree(mission / "L0" / f"{number:06d}")
    assert "4 sealed exposures with frames and a position" in refusal(str(mission))
    text = (mission / "rig.toml").read_text()
    (mission / "rig.toml").write_text(text.replace('"synchronous"', '"syntopic"'))
    assert "fire one after the other" in refusal(str(mission))


def test_frames_without_texture_are_refused(flown: tuple[Path, Rig, Rig], tmp_path: Path) -> None:
    mission = Path(shutil.copytree(flown[0], tmp_path / "mission"))
    for path in (mission / "L0").glob("*/*.tif"):
        tifffile.imwrite(path, np.full((320, 480), 500, np.uint16))
    assert "images hang together" in refusal(str(mission))

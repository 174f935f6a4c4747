"""Mountings from many exposures become a dated rig file next to the old one, never over it."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from benchmarks import dmc_platform, ultracam_platform
from daemon.cli import app
from daemon.mission.layout import Mission
from processing.calibration.platform import calibrate_platform, calibrated_rig
from processing.geometry.placement import nominal_placements
from processing.geometry.rotation import omega_phi_kappa, rotation_matrix, rotations_from_vectors
from processing.mosaic.free_mosaic import free_mosaic
from processing.mosaic.stitch_record import StitchRecord, stitch_record, stitch_record_json
from processing.rig import Rig, find_rig, load_rig, shipped_rigs
from tests.processing.synthetic import make_truth, tie_points_of

Array = NDArray[np.float64]

DMC_TURNS = {"1": (30e-6, -10e-6, 5e-6), "2": (-20e-6, 40e-6, 0.0), "3": (-10e-6, -30e-6, -5e-6)}
UCX_TURNS = {"1": (60e-6, 0.0, 20e-6), "2": (0.0, -50e-6, 0.0), "3": (20e-6, 20e-6, -60e-6)}
L_TURNS = {"1": (40e-6, -30e-6, 20e-6)}

HIGH_M = 1e12
"""So high that a cone off the flight axis sees as the others do: the points are drawn so."""


def with_rotations(rig: Rig, corrections: dict[str, tuple[float, float, float]]) -> Rig:
    """The rig as it really is: some cones turned about the axes of the virtual image."""
    cones = []
    for cone in rig.cones:
        turn = np.array(corrections.get(cone.name, (0.0, 0.0, 0.0)))
        rotation = rotations_from_vectors(turn) @ rotation_matrix(*cone.rotation_rad)
        omega, phi, kappa = (float(v) for v in omega_phi_kappa(rotation))
        cones.append(replace(cone, rotation_rad=(omega, phi, kappa)))
    return replace(rig, cones=tuple(cones))


def flight(
    rig: Rig, corrections: dict[str, tuple[float, float, float]], exposures: int
) -> list[StitchRecord]:
    rng = np.random.default_rng(7)
    start = nominal_placements(rig, {}, {})
    still = make_truth(rig, rng, sensor_px=0.0, layer_px=0.0)
    truth = replace(
        still, start=start, placements=nominal_placements(with_rotations(rig, corrections), {}, {})
    )
    records = []
    for _ in range(exposures):
        points = tie_points_of(truth, rng, sigma_pp_px=0.05, sigma_pc_px=0.15)
        records.append(stitch_record(rig, free_mosaic(rig, start, points), {}, {}, height_m=HIGH_M))
    return records


@pytest.mark.parametrize(
    ("name", "corrections"), [("dmc-mini", DMC_TURNS), ("ultracam-x-mini", UCX_TURNS)]
)
def test_turns_of_all_cones_are_found_as_well_as_stated(
    name: str, corrections: dict[str, tuple[float, float, float]]
) -> None:
    rig = find_rig(name)
    found = calibrate_platform(rig, flight(rig, corrections, 12))
    heads = [c.name for c in rig.pan_cones if c.name != rig.master_cone]
    assert [c.cone for c in found.cones] == [*heads, "G"]
    assert set(found.missing) == {"R", "B", "N"}
    mean = np.mean([corrections.get(h, (0, 0, 0)) for h in heads], axis=0)
    datum = mean if rig.has_virtual_camera else np.zeros(3)
    for cone in found.cones:
        error = cone.correction_rad - (
            np.array(corrections.get(cone.cone, (0.0, 0.0, 0.0))) - datum
        )
        assert (np.abs(error) < 4.0 * cone.correction_sigma_rad).all(), (cone.cone, error)
        assert (cone.correction_sigma_rad < 8e-6).all()
    if rig.timing == "syntopic":
        assert not calibrate_platform(rig, flight(rig, corrections, 3)).cones
    better = calibrated_rig(rig, found, calibration_id="new", date="2026-11-21")
    for cone in found.cones:
        turn = rotation_matrix(*better.cone(cone.cone).rotation_rad) @ (
            rotation_matrix(*rig.cone(cone.cone).rotation_rad).T
        )
        assert turn == pytest.approx(
            rotations_from_vectors(cone.correction_rad[None])[0], abs=1e-12
        )


def test_an_exposure_without_one_head_does_not_move_the_datum_of_the_others() -> None:
    rig = find_rig("dmc-mini")
    records = flight(rig, DMC_TURNS, 4)
    lame = records[0]
    chosen = [i for i, n in enumerate(lame.names) if not n.startswith("4.")]
    lame = replace(
        lame,
        names=tuple(lame.names[i] for i in chosen),
        values=lame.values[chosen] + 50.0,
        covariance=lame.covariance[np.ix_(chosen, chosen)],
    )
    found = {c.cone: c for c in calibrate_platform(rig, [lame, *records[1:]]).cones}
    assert len(found["1"].corrections) == 3 and found["1"].used == (1, 2, 3)
    with pytest.raises(ValueError, match="does not belong"):
        calibrate_platform(find_rig("dmc"), records)


def test_a_base_off_the_flight_axis_is_no_rotation() -> None:
    rig = find_rig("ultracam-l-mini")
    records = flight(rig, L_TURNS, 12)
    low = [replace(r, height_m=1000.0) for r in records]
    high = {c.cone: c.correction_rad for c in calibrate_platform(rig, records).cones}
    near = {c.cone: c.correction_rad for c in calibrate_platform(rig, low).cones}
    # Green sees from 80 mm to the right; at 1000 m all lies 80 urad farther left.
    assert near["RGB"] - high["RGB"] == pytest.approx([0.0, 80e-6, 0.0], abs=1e-9)
    assert near["1"] == pytest.approx(high["1"])
    unknown = calibrate_platform(rig, [replace(r, height_m=None) for r in records])
    assert "RGB" in unknown.missing and "1" not in unknown.missing


def test_rotations_found_in_complete_flights_are_as_accurate_as_stated() -> None:
    found = ultracam_platform.evaluate("ultracam-l-mini", 4, 6)
    assert set(found) == {"1", "RGB"}
    for figures in found.values():
        low, high = figures["bounds"]
        assert low < figures["squares_per_rank"] < high and figures["largest"] < 5.0
        # No axis is stated three times as loosely as it is known.
        assert (np.divide(figures["rms_sigma_urad"], figures["rms_error_urad"]) < 3.0).all()


def test_a_blurred_exposure_is_left_out_and_reported(tmp_path: Path) -> None:
    rig = find_rig("dmc-mini")
    records = flight(rig, DMC_TURNS, 6)
    off = replace(records[2], values=records[2].values + 900.0)
    found = calibrate_platform(rig, [*records[:2], off, *records[3:]])
    assert all(cone.left_out == 1 and 2 not in cone.used for cone in found.cones)


def flown(root: Path, correction_rad: float) -> Mission:
    """A mission of four exposures with one head turned."""
    mission = Mission.create(
        root,
        "dmc-mini",
        rig_toml=shipped_rigs()["dmc-mini"].read_bytes(),
        service_toml=b"",
        started_utc=datetime(2026, 11, 21, 10, 15, tzinfo=UTC),
    )
    mission.close()
    with_rotations = {"2": (0.0, correction_rad, 0.0)}
    for k, record in enumerate(flight(find_rig("dmc-mini"), with_rotations, 4)):
        mission.level0(k + 1).mkdir(parents=True)
        mission.level2(k + 1).mkdir(parents=True)
        text = json.dumps(stitch_record_json(record))
        (mission.level2(k + 1) / "mosaic.json").write_text(text)
    return mission


def test_the_command_writes_a_new_folder_and_compares(tmp_path: Path) -> None:
    rig = find_rig("dmc-mini")
    mission = flown(tmp_path, 400e-6)
    out = tmp_path / "dmc-mini-platform"
    line = ["calibrate", "platform", str(mission.path), "--out", str(out), "--json"]
    result = CliRunner().invoke(app, line)
    assert result.exit_code == 0, result.output
    output = json.loads(result.stdout)
    assert output["kind"] == "platform" and output["previous"] == rig.calibration_id
    assert ("2", "phi") in {(c["where"], c["what"]) for c in output["changes"] if c["significant"]}
    new_rig = load_rig(out / "rig.toml")
    assert new_rig.calibration_id == output["calibration_id"]
    assert new_rig.calibration_id.startswith("dmc-mini-platform-")
    moved = new_rig.cone("2").rotation_rad[1] - rig.cone("2").rotation_rad[1]
    # A quarter of the turn is the mean of the four, which is the datum.
    assert moved == pytest.approx(300e-6, abs=3e-6)
    assert "svg" in (out / "report.html").read_text()
    again = CliRunner().invoke(app, line)
    assert again.exit_code != 0 and load_rig(out / "rig.toml") == new_rig


def test_calibrations_of_one_day_have_the_ids_of_their_content_wherever_they_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    new_rig = []
    for name, turn in (("a", 400e-6), ("b", 300e-6)):
        mission = flown(tmp_path / name, turn)
        (tmp_path / name / "elsewhere").mkdir()
        monkeypatch.chdir(tmp_path / name / "elsewhere")
        done = CliRunner().invoke(app, ["calibrate", "platform", str(mission.path), "--json"])
        assert done.exit_code == 0, done.output
        written = Path(json.loads(done.stdout)["written"])
        assert written.parent == tmp_path / name and not list(Path.cwd().iterdir())
        assert load_rig(written / "rig.toml").calibration_id == written.name
        new_rig.append(written.name)
    assert new_rig[0] != new_rig[1] and all(
        one.startswith("dmc-mini-platform-20") for one in new_rig
    )


def test_the_nine_angles_are_as_good_as_stated_against_the_emulators_truth() -> None:
    figures = dmc_platform.pooled(
        [dmc_platform.sample_platform("dmc-mini", 1 + k) for k in range(16)]
    )
    assert figures["rank"] == 9 * 16
    assert figures["low"] < figures["mean_square"] < figures["high"]
    assert figures["inside_3_sigma"] > 0.98 and figures["largest"] < 5.0

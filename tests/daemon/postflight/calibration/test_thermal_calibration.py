"""Flown missions become a proposed calibration: gathered, evaluated, written as a new file."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.exposure import Exposure, TemperatureRecord, exposure_bytes
from daemon.mission.layout import Mission
from daemon.postflight.calibration.thermal_calibration import (
    ThermalCalibrationError,
    faulty_probes,
    read_thermal_records,
    write_rig,
)
from processing.mosaic.stitch_record import StitchRecord, stitch_record_json
from processing.quality.probe_health import ProbeState
from processing.rig import Rig, find_rig, load_rig, shipped_rigs
from tests.processing.calibration.test_thermal_learning import aged, flight

SECOND = 1_000_000_000
DC_K = (-12.0, -4.0, 4.0, 12.0)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return find_rig("ultracam-x-mini")


@pytest.fixture(scope="module")
def records(rig: Rig) -> list[StitchRecord]:
    return flight(rig, aged(rig), DC_K)


def readings(rig: Rig, dc_k: float) -> tuple[TemperatureRecord, ...]:
    return tuple(TemperatureRecord(probe, 20.0 + dc_k, 0) for probe in rig.probes)


def flown(root: Path, records: list[StitchRecord], *, rig_bytes: bytes | None = None) -> Mission:
    """A mission of one exposure per record, a quarter of an hour apart."""
    rig_file = shipped_rigs()["ultracam-x-mini"]
    mission = Mission.create(
        root,
        "ultracam-x-mini",
        rig_toml=rig_bytes or rig_file.read_bytes(),
        service_toml=b"",
        started_utc=datetime(2026, 11, 21, 10, 15, tzinfo=UTC),
    )
    mission.close()
    rig = load_rig(rig_file)
    for k, record in enumerate(records):
        folder = mission.level0(k + 1)
        folder.mkdir(parents=True)
        exposure = Exposure(
            number=k + 1,
            boot_id="one",
            trigger_mono_ns=(k + 1) * 900 * SECOND,
            temperatures=readings(rig, record.dc_k["SU00"]),
        )
        (folder / "exposure.json").write_bytes(exposure_bytes(exposure))
        products = mission.level2(k + 1)
        products.mkdir(parents=True)
        (products / "mosaic.json").write_text(json.dumps(stitch_record_json(record)))
    return mission


def test_a_mission_given_twice_is_refused_for_it_would_count_twice(
    tmp_path: Path, records: list[StitchRecord]
) -> None:
    path = flown(tmp_path, records).path
    with pytest.raises(ThermalCalibrationError, match="given twice"):
        read_thermal_records([path, path.parent / "." / path.name])


def test_the_command_writes_a_new_dated_rig_and_shows_old_against_new(
    tmp_path: Path, rig: Rig, records: list[StitchRecord]
) -> None:
    mission = flown(tmp_path, records)
    out = tmp_path / "new.toml"
    result = CliRunner().invoke(
        app, ["calibrate", "thermal", str(mission.path), "--out", str(out), "--json"]
    )
    assert result.exit_code == 0, result.output
    output = json.loads(result.stdout)
    proposal = load_rig(out)
    assert output["written"] == str(out) and output["exposures"] == len(DC_K)
    assert re.fullmatch(
        rf"{rig.calibration_id}-thermal-[-\d]+-[0-9a-f]{{8}}", proposal.calibration_id
    )
    assert proposal.calibration_date == f"{datetime.now(UTC):%Y-%m-%d}"
    changes = {(c["where"], c["what"]): c for c in output["changes"]}
    change = changes["SU00", "x_um_per_k"]
    assert change["old"] == rig.sensor("SU00").drift.x_um_per_k
    assert change["new"] == proposal.sensor("SU00").drift.x_um_per_k != change["old"]
    assert 0.0 < change["sigma"] < 0.05 and change["effect_px"] > 0.0
    # What is common to the sensors of a cone, and the master's lens, cannot be learned.
    for key in ("x_um_per_k", "y_um_per_k", "rotation_urad_per_k", "scale_ppm_per_k"):
        sums = [sum(getattr(s.drift, key) for s in r.cone("0").sensors) for r in (rig, proposal)]
        assert sums[0] == pytest.approx(sums[1], abs=1e-9)
    assert proposal.cone("0").lens == rig.cone("0").lens
    assert proposal.sensor("SU30") == rig.sensor("SU30")
    assert any(not o["observable"] for o in output["observability"])
    # What flew is as it was.
    assert mission.rig_path.read_bytes() == shipped_rigs()["ultracam-x-mini"].read_bytes()


def test_a_proposal_fits_the_flight_better_than_what_was_flown(
    tmp_path: Path, rig: Rig, records: list[StitchRecord]
) -> None:
    out = tmp_path / "new.toml"
    mission = flown(tmp_path, records)
    assert (
        CliRunner()
        .invoke(app, ["calibrate", "thermal", str(mission.path), "--out", str(out)])
        .exit_code
        == 0
    )
    better = flight(load_rig(out), aged(rig), (12.0,), seed=9)[0]
    worse = flight(rig, aged(rig), (12.0,), seed=9)[0]

    def shifts(record: StitchRecord) -> float:
        return max(
            abs(float(v))
            for name, v in zip(record.names, record.values, strict=True)
            if name.startswith("SU1") and name.endswith("_um")
        )

    assert shifts(worse) > 0.6 and shifts(better) < 0.5 * shifts(worse)


def test_an_existing_file_is_never_overwritten(
    tmp_path: Path, rig: Rig, records: list[StitchRecord]
) -> None:
    out = tmp_path / "rig.toml"
    out.write_text("mine\n")
    with pytest.raises(ThermalCalibrationError, match="never overwritten"):
        write_rig(rig, out, remark="")
    mission = flown(tmp_path, records)
    result = CliRunner().invoke(app, ["calibrate", "thermal", str(mission.path), "--out", str(out)])
    assert result.exit_code != 0 and out.read_text() == "mine\n"


def test_without_a_name_the_proposal_is_written_next_to_the_mission(
    tmp_path: Path, records: list[StitchRecord], monkeypatch: pytest.MonkeyPatch
) -> None:
    mission = flown(tmp_path, records)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    result = CliRunner().invoke(app, ["calibrate", "thermal", str(mission.path), "--json"])
    written = Path(json.loads(result.stdout)["written"])
    assert written.parent == tmp_path and not list(Path.cwd().iterdir())
    assert load_rig(written).calibration_id[-8:] == written.stem[-8:]


def test_too_little_spread_writes_nothing(tmp_path: Path, records: list[StitchRecord]) -> None:
    mission = flown(tmp_path, records[:1])
    out = tmp_path / "new.toml"
    result = CliRunner().invoke(app, ["calibrate", "thermal", str(mission.path), "--out", str(out)])
    assert result.exit_code == 1 and "nothing learned" in result.output and not out.exists()


def test_missions_of_different_calibrations_are_not_mixed(
    tmp_path: Path, records: list[StitchRecord]
) -> None:
    text = shipped_rigs()["ultracam-x-mini"].read_text()
    other = text.replace("ultracam-x-mini-example-1", "another").encode()
    first = flown(tmp_path / "a", records[:1])
    second = flown(tmp_path / "b", records[:1], rig_bytes=other)
    with pytest.raises(ThermalCalibrationError, match="one rig file"):
        read_thermal_records([first.path, second.path])


def test_an_exposure_without_a_usable_record_is_skipped_and_reported(
    tmp_path: Path, records: list[StitchRecord]
) -> None:
    mission = flown(tmp_path, records)
    (mission.level2(2) / "mosaic.json").unlink()
    (mission.level2(3) / "mosaic.json").write_text("{")
    thermal_records = read_thermal_records([mission.path])
    assert thermal_records.exposures == 2 and len(thermal_records.skipped) == 2
    assert "no mosaic.json" in thermal_records.skipped[0]


def test_a_cone_whose_probe_is_not_believed_does_not_count(
    tmp_path: Path, rig: Rig, records: list[StitchRecord]
) -> None:
    mission = flown(tmp_path, records)
    path = mission.level0(2) / "exposure.json"
    content = json.loads(path.read_bytes())
    for reading in content["temperatures"]:
        if reading["probe"] == "2":
            reading["value_c"] = None
    path.write_text(json.dumps(content))
    thermal_records = read_thermal_records([mission.path])
    assert thermal_records.state.places["2"].exposures == len(DC_K) - 1
    assert thermal_records.state.places["1"].exposures == len(DC_K)
    assert "2 open" in thermal_records.skipped[0]


def test_a_stuck_probe_is_found_in_the_records_of_a_flight(rig: Rig) -> None:
    def exposure(k: int, stuck_from: int) -> Exposure:
        output = [
            replace(t, value_c=25.0 - 0.5 * min(k, stuck_from if t.probe == "1" else k))
            for t in readings(rig, 0.0)
        ]
        return Exposure(
            number=k + 1,
            boot_id="one",
            trigger_mono_ns=(k + 1) * 60 * SECOND,
            temperatures=tuple(output),
        )

    assert faulty_probes(rig, [exposure(k, 99) for k in range(30)]) == {}
    found = faulty_probes(rig, [exposure(k, 8) for k in range(30)])
    assert set(found) == set(range(19, 31))
    assert all(states == {"1": ProbeState.STUCK} for states in found.values())

"""Verification: each file of a mission altered, removed, exchanged or added in turn."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sqlite3
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.canonical_json import canonical_bytes
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import FlightLog
from daemon.mission.log.log_seals import close_run, seal_logs
from daemon.mission.store import durable
from daemon.mission.store.file_tree import BLOCK_BYTES, _sha256
from daemon.mission.store.level0_folder import hash_file
from daemon.mission.store.level2 import write_level2
from daemon.mission.store.store import Level0Writer
from daemon.mission.verification.verification import VerifyReport, verify
from tests.daemon.small_camera import RIG_TOML, SENSORS, final_record, fly, store_one

pytestmark = pytest.mark.trust

LOG = "log/20261121T101500.000000Z.mcap"
FRAMES = [f"L0/00000{n}/{sensor}.tif" for n in (1, 2, 3) for sensor in SENSORS]
RECORDS = [f"L0/00000{n}/{kind}.json" for n in (1, 2, 3) for kind in ("exposure", "capture")]
CONFIGURED = ["mission.json", "rig.toml", "service.toml", "plan.geojson"]
HASHED = [*FRAMES, *RECORDS, *CONFIGURED, LOG, "chain.jsonl", "overrides.json"]
WITHOUT_HASH = ["L2/000001/pan.tif", "L2/000001/quality.json", "export/notes.txt", "mission.db"]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mission that landed in good order, with everything a mission may hold."""
    root = tmp_path_factory.mktemp("flown")
    mission = Mission.create(
        root,
        "small",
        rig_toml=RIG_TOML.encode(),
        service_toml=b"# flown by a test\n",
        plan=(".geojson", b'{"type":"FeatureCollection","features":[]}\n'),
        started_utc=datetime(2026, 11, 21, 10, 15, tzinfo=UTC),
    )
    (mission.path / LOG).parent.mkdir(exist_ok=True)
    log = FlightLog(mission.path / LOG, boot_id="test")
    log.append("raw/gnss", 1, b"bytes" * 100)
    log.close()
    fly(mission, [1, 2, 3])
    write_level2(
        mission,
        1,
        report_json={"verdict": "good"},
        pan=np.ones((4, 6), np.uint16),
        colour={},
        quicklook=None,
    )
    (mission.export_dir / "notes.txt").write_text("written by hand")
    durable.replace_file(mission.path / "overrides.json", b'{"overrides":[]}\n')
    chain = mission.open_chain()
    seal_logs(mission, chain)
    close_run(mission, chain, "landing")
    chain.close()
    mission.close()
    return mission.path


@pytest.fixture
def mission(flown: Path, tmp_path: Path) -> Mission:
    shutil.copytree(flown, tmp_path / flown.name)
    return Mission.open(tmp_path / flown.name)


def uncovered(report: VerifyReport) -> set[str]:
    return {name for one in report.not_covered for name in one.files}


def names_it(report: VerifyReport, file: str) -> bool:
    """Whether a problem names a file, or the exposure and the kind of file."""
    path = Path(file)
    if path.name == "exposure.json":
        number = int(path.parent.name)
        starts = (f"exposure {number}: its record", f"exposure {number}: was sealed but its record")
        return any(p.startswith((*starts, f"{number:06d}/exposure.json")) for p in report.problems)
    if path.name == "capture.json":
        return any(str(int(path.parent.name)) in p and "capture.json" in p for p in report.problems)
    if file.startswith("L0/"):
        return any(f"exposure {path.parent.name}, {path.name}" in p for p in report.problems)
    return any(path.name in p for p in report.problems)


def repair(mission: Mission) -> None:
    CliRunner().invoke(app, ["repair", str(mission.path), "--rebuild"])


def test_a_mission_that_landed_has_nothing_wrong_and_every_file_is_accounted_for(
    mission: Mission,
) -> None:
    there = {str(p.relative_to(mission.path)) for p in mission.path.rglob("*") if p.is_file()}
    assert there == {*HASHED, *WITHOUT_HASH}
    report = verify(mission)
    assert (report.problems, report.remarks, report.state) == ((), (), "ended")
    assert uncovered(report) == set(WITHOUT_HASH)
    assert sum(covered.files for covered in report.covered) == len(HASHED)


@pytest.mark.parametrize("file", [*HASHED, *WITHOUT_HASH])
def test_a_file_with_one_altered_byte_is_named(mission: Mission, file: str) -> None:
    path = mission.path / file
    data = bytearray(path.read_bytes())
    for place in sorted({0, len(data) // 3, len(data) - 1}):
        altered = data.copy()
        altered[place] ^= 1
        path.chmod(0o644)
        path.write_bytes(altered)
        report = verify(mission)
        assert names_it(report, file) or (file in WITHOUT_HASH and file in uncovered(report)), place


@pytest.mark.parametrize("file", [*HASHED, *WITHOUT_HASH])
def test_a_removed_file_is_named(mission: Mission, file: str) -> None:
    (mission.path / file).unlink()
    report = verify(mission)
    if file in HASHED or file == "mission.db":
        assert names_it(report, file)
    else:
        assert file not in uncovered(report)


@pytest.mark.parametrize("rebuilt", [False, True], ids=["index as it was", "index built again"])
@pytest.mark.parametrize("what", ["record", "folder"])
def test_the_removal_of_the_newest_record_is_noticed(
    mission: Mission, what: str, rebuilt: bool
) -> None:
    folder = mission.level0(3)
    if what == "record":
        (folder / "exposure.json").unlink()
    else:
        durable.remove_tree(folder)
    if rebuilt:
        repair(mission)
        repair(mission)
    problems = verify(mission).problems
    if what == "folder":
        evidence = "chain.jsonl" if rebuilt else "chain.jsonl and the index"
        assert f"exposure 3: is in {evidence} but its folder is gone" in problems
    elif rebuilt:
        assert any("exposure 3: was sealed more than once" in p for p in problems)
    else:
        assert "exposure 3: was sealed but its record is gone" in problems


def test_repair_does_not_record_a_removed_exposure_as_lost(mission: Mission) -> None:
    durable.remove_tree(mission.level0(2))
    repair(mission)
    assert not mission.level0(2).exists()
    assert any("exposure 2: is in chain.jsonl" in p for p in verify(mission).problems)


@pytest.mark.parametrize("lines", range(1, 11))
def test_a_chain_file_cut_at_any_line_is_noticed(mission: Mission, lines: int) -> None:
    intact = mission.chain_path.read_bytes().splitlines(keepends=True)
    mission.chain_path.write_bytes(b"".join(intact[: len(intact) - lines]))
    report = verify(mission)
    if lines <= 2:  # the same as after a kill: what these lines cover is listed as not covered
        assert any("chain.jsonl is open" in remark for remark in report.remarks)
        assert {"overrides.json", LOG if lines == 2 else "mission.db"} < uncovered(report)
    else:
        assert any("chain.jsonl" in problem for problem in report.problems)


def test_a_chain_file_rewritten_by_repair_states_so_permanently(mission: Mission) -> None:
    mission.chain_path.unlink()
    repair(mission)
    repair(mission)
    problems = verify(mission).problems
    assert len(problems) == 1 and "chain.jsonl: was missing and was written again" in problems[0]


def test_a_removed_line_of_the_chain_file_is_noticed(mission: Mission) -> None:
    intact = mission.chain_path.read_bytes().splitlines(keepends=True)
    for line in range(len(intact)):
        mission.chain_path.write_bytes(b"".join(intact[:line] + intact[line + 1 :]))
        report = verify(mission)
        assert report.problems or any("is open" in remark for remark in report.remarks), line


def test_exchanged_records_and_frames_are_named(mission: Mission) -> None:
    exchange(mission.level0(1) / "exposure.json", mission.level0(2) / "exposure.json")
    exchange(mission.level0(3) / "SU00.tif", mission.level0(3) / "SU01.tif")
    report = verify(mission)
    assert names_it(report, "L0/000001/exposure.json")
    assert names_it(report, "L0/000002/exposure.json")
    assert names_it(report, "L0/000003/SU00.tif")
    assert names_it(report, "L0/000003/SU01.tif")
    assert report.frames == 9  # the frames of a damaged record are checked by the capture's


@pytest.mark.parametrize(
    "name", ["L0/000000", "L0/0000001", "L0/1", "L0/[red]", "L0/\udcff", "L0/000004.part", "L0/-"]
)
@pytest.mark.parametrize("make", [Path.mkdir, Path.touch], ids=["folder", "file"])
def test_odd_names_in_level0_are_named_and_stop_nothing(
    mission: Mission, name: str, make: Callable[[Path], None]
) -> None:
    make(mission.path / name)
    (mission.level0(2) / "SU01.tif").unlink()
    report = verify(mission)
    assert (
        f"{name}: is no exposure; recovery on start sees to what is unfinished" in report.problems
    )
    assert names_it(report, "L0/000002/SU01.tif")
    result = CliRunner().invoke(app, ["verify", str(mission.path)])
    assert result.exit_code == 1 and "2 problems" in result.output, result.output


@pytest.mark.parametrize("name", ["log/x.mcap", "L0/000002/SU99.tif", "L0/000002/sub"])
def test_files_added_among_hashed_ones_are_named(mission: Mission, name: str) -> None:
    (mission.path / name).touch() if "." in name else (mission.path / name).mkdir()
    (problem,) = verify(mission).problems
    assert Path(name).name in problem


def test_other_added_files_are_listed_as_not_covered(mission: Mission) -> None:
    for name in ("readme.txt", "log/notes", "L2/000001/x", "plan.kml"):
        (mission.path / name).write_text("x")
    report = verify(mission)
    assert report.problems == ()
    assert {"readme.txt", "log/notes", "L2/000001/x", "plan.kml"} < uncovered(report)


@pytest.mark.parametrize(
    "name", ["export/link", "L0/000002/SU01.tif", "L0/000002/exposure.json", "L0/000004", LOG]
)
@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_links_and_pipes_are_named_and_not_opened(mission: Mission, name: str, kind: str) -> None:
    path = mission.path / name
    path.unlink(missing_ok=True)
    path.symlink_to("/dev/zero") if kind == "link" else os.mkfifo(path)
    report = verify(mission)
    assert any(p.startswith(f"{name}: is a link, a pipe or a device") for p in report.problems)


def test_an_unreadable_folder_is_named_and_the_rest_is_checked(
    mission: Mission, monkeypatch: pytest.MonkeyPatch
) -> None:
    scandir = os.scandir

    def refused(path: Path) -> object:
        if path == mission.level0(1):
            raise PermissionError(13, "Permission denied")
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refused)
    (mission.level0(2) / "SU01.tif").unlink()
    report = verify(mission)
    assert "L0/000001: cannot be read (Permission denied)" in report.problems
    assert names_it(report, "L0/000002/SU01.tif")


def test_an_altered_row_of_the_index_is_noticed(mission: Mission) -> None:
    with sqlite3.connect(mission.catalog_path) as connection:
        connection.execute("UPDATE exposures SET record_sha256 = ? WHERE number = 2", ("0" * 64,))
    connection.close()
    assert verify(mission).problems == ("exposure 2: the index names another record",)


def test_a_mission_of_format_1_is_verified_with_what_it_has(mission: Mission) -> None:
    make_old(mission)
    report = verify(mission)
    assert report.problems == ()
    assert {"plan.geojson", "L0/000001/capture.json", "log/seals.json"} < uncovered(report)
    assert any("format 1" in remark for remark in report.remarks)
    before = {p: p.read_bytes() for p in mission.level0_root.rglob("*.json")}
    repair(mission)  # gets a chain file; no record is written again
    assert {p: p.read_bytes() for p in mission.level0_root.rglob("*.json")} == before
    report = verify(mission)
    assert report.problems == ()
    assert "L0/000001/capture.json" not in uncovered(report)
    (mission.path / "service.toml").chmod(0o644)
    (mission.path / "service.toml").write_text("# other\n")
    os.truncate(mission.path / LOG, 10)
    durable.remove_tree(mission.level0(3))
    found = verify(mission)
    assert all(names_it(found, name) for name in ("service.toml", LOG))
    assert any("exposure 3: is in chain.jsonl" in problem for problem in found.problems)


def test_a_damaged_log_of_format_1_is_not_sealed_again_as_it_is(mission: Mission) -> None:
    make_old(mission)
    os.truncate(mission.path / LOG, 10)
    repair(mission)
    assert names_it(verify(mission), LOG)


def test_the_command_lists_what_is_covered_and_what_is_not(mission: Mission) -> None:
    result = CliRunner().invoke(app, ["verify", str(mission.path)], env={"COLUMNS": "160"})
    assert result.exit_code == 0, result.output
    assert "exposure records" in result.output and "Not covered" in result.output
    assert "3 exposures, 9 frames: nothing is wrong" in result.output
    result = CliRunner().invoke(app, ["verify", str(mission.path), "--json"])
    output = json.loads(result.stdout)
    assert {"problems", "covered", "not_covered", "remarks", "state"} < output.keys()
    assert {"reason", "files"} == output["not_covered"][0].keys()
    assert CliRunner().invoke(app, ["verify"]).exit_code == 2


def test_what_is_unfinished_is_wrong_only_after_the_flight(mission: Mission) -> None:
    writer = Level0Writer(mission)
    writer.seal(final_record(store_one(writer, 4)))
    writer.close()
    lines = mission.chain_path.read_bytes().splitlines(keepends=True)
    mission.chain_path.write_bytes(b"".join(lines[:-2]) + b'{"entry":{"kind":"st')
    (mission.level0_root / "000005.part").mkdir()
    (mission.level0_root / "000005.part" / "SU00.tif").touch()
    (mission.level0(4) / ".exposure.json.0123abcd.part").touch()
    problems = " ".join(verify(mission).problems)
    assert "L0/000005.part" in problems
    assert "chain.jsonl: its last line is not whole" in problems
    assert "exposure 4: its record is not in chain.jsonl" in problems
    marker = mission.root / "current-mission.json"
    marker.write_text(json.dumps({"mission": mission.id}))
    report = verify(mission)
    assert (report.problems, report.state) == ((), "flown")
    assert "L0/000005.part/SU00.tif" in uncovered(report)
    assert "L0/000004/exposure.json" in uncovered(report)
    marker.unlink()
    repair(mission)
    assert verify(mission).problems == ()


def exchange(a: Path, b: Path) -> None:
    parked = a.with_name("keep")
    a.rename(parked)
    b.rename(a)
    parked.rename(b)


def make_old(mission: Mission) -> None:
    """What the version before the chain file left of the same flight."""
    log = mission.path / LOG
    seals = {log.name: {"nbytes": log.stat().st_size, "sha256": hash_file(log)}}
    mission.chain_path.unlink()
    durable.remove_tree(mission.level0_root)
    mission.level0_root.mkdir()
    mission.catalog_path.unlink()
    about = mission.about()
    del about["plan"]
    durable.replace_file(mission.path / "mission.json", canonical_bytes({**about, "format": 1}))
    fly(mission, [1, 2, 3])
    mission.chain_path.unlink()
    durable.create_file(
        mission.log_dir / "seals.json", [canonical_bytes({"format": 1, "logs": seals})]
    )


def test_a_broken_chain_of_hashes_is_named_in_flight_without_a_chain_file(mission: Mission) -> None:
    make_old(mission)
    marker = mission.root / "current-mission.json"
    marker.write_text(json.dumps({"mission": mission.id}))
    assert verify(mission).state == "flown"
    assert verify(mission).problems == ()
    record = mission.level0(2) / "exposure.json"
    content = json.loads(record.read_bytes())
    content["previous_sha256"] = "0" * 64
    record.chmod(0o644)
    record.write_bytes(canonical_bytes(content))
    problems = verify(mission).problems
    assert any("chain is broken before exposure 2" in one for one in problems), problems


def test_a_mission_without_mission_json_is_laid_out_by_hand_only_without_chain_and_index(
    mission: Mission,
) -> None:
    (mission.path / "mission.json").unlink()
    missing = "mission.json: is missing; the chain of records begins with it"
    assert missing in verify(mission).problems
    mission.chain_path.unlink()
    assert missing in verify(mission).problems, "the index names the mission's records"
    mission.catalog_path.unlink()
    by_hand = verify(mission)
    assert missing not in by_hand.problems
    reasons = [one.reason for one in by_hand.not_covered if "rig.toml" in one.files]
    assert reasons == ["mission laid out by hand: no mission.json has a hash of it"]


def test_what_is_appended_while_a_file_is_hashed_is_not_hashed(tmp_path: Path) -> None:
    path, begun = tmp_path / "log", os.urandom(2 * BLOCK_BYTES)
    path.write_bytes(begun)
    read: list[int] = []

    def grow(nbytes: int) -> None:
        read.append(nbytes)
        if len(read) < 5:
            with path.open("ab") as file:
                file.write(bytes(BLOCK_BYTES))

    descriptor = os.open(path, os.O_RDONLY)
    try:
        assert _sha256(descriptor, grow) == hashlib.sha256(begun).hexdigest()
    finally:
        os.close(descriptor)
    assert read == [BLOCK_BYTES, BLOCK_BYTES]

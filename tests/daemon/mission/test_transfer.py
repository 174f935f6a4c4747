"""A mission arrives whole on another disk, however often it is interrupted, or the source stays."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from daemon.mission.layout import Mission, MissionError
from daemon.mission.log.flight_log import FlightLog
from daemon.mission.log.log_seals import seal_logs
from daemon.mission.store import durable
from daemon.mission.store.file_tree import FileTree, TreeError
from daemon.mission.transfer import transfer
from daemon.mission.verification.verification import verify
from tests.daemon.small_camera import fly, new_mission


@pytest.fixture
def mission(tmp_path: Path) -> Mission:
    mission = new_mission(tmp_path / "flown")
    fly(mission, [1, 2, 3])
    log = FlightLog.create(mission.log_dir)
    log.append("raw/gnss", 1, b"bytes" * 100)
    log.close()
    seal_logs(mission)
    return mission


def files_below(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in transfer.EXCLUDED_FILES
    }


def test_every_byte_arrives_and_the_copy_verifies(mission: Mission, tmp_path: Path) -> None:
    reported: list[tuple[int, int]] = []
    report = transfer.transfer(mission, tmp_path / "disk", progress=lambda *at: reported.append(at))
    assert report.target == tmp_path / "disk" / mission.id
    assert files_below(report.target) == files_below(mission.path)
    assert report.already_present == 0
    assert (report.verified.exposures, report.verified.frames) == (3, 9)
    assert reported[0] == (0, 2 * report.nbytes)
    assert reported[-1] == (2 * report.nbytes, 2 * report.nbytes)
    frame = report.target / "L0/000001/SU00.tif"
    assert frame.stat().st_mode & 0o777 == 0o444
    assert mission.path.exists()


def test_interrupted_at_any_file_it_goes_on_where_it_stopped(
    mission: Mission, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = FileTree.copy_from
    count = 0

    def copy_three_and_fail(*arguments: Any) -> str:
        nonlocal count
        count += 1
        if count % 4 == 0:
            raise OSError(5, "Input/output error")
        return real(*arguments)

    monkeypatch.setattr(FileTree, "copy_from", copy_three_and_fail)
    attempts = 0
    while True:
        attempts += 1
        try:
            report = transfer.transfer(mission, tmp_path / "disk")
            break
        except OSError:
            assert attempts < 20
    assert attempts > 3
    assert report.copied <= 3
    assert report.already_present >= 9
    assert files_below(report.target) == files_below(mission.path)


def test_what_changed_since_is_copied_again_and_what_is_gone_is_removed(
    mission: Mission, tmp_path: Path
) -> None:
    (mission.export_dir / "report.html").write_text("early")
    (mission.export_dir / "old.csv").write_text("old")
    transfer.transfer(mission, tmp_path / "disk")
    (mission.export_dir / "report.html").write_text("later")
    (mission.export_dir / "old.csv").unlink()
    report = transfer.transfer(mission, tmp_path / "disk")
    assert files_below(report.target) == files_below(mission.path)
    assert report.copied <= 2  # the report, and the index if it was touched


def test_the_source_goes_only_after_all_of_it_is_verified(
    mission: Mission, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(FileTree, "sha256", lambda *a, **k: "0" * 64)
        with pytest.raises(TreeError, match="do not use this disk"):
            transfer.transfer(mission, tmp_path / "disk", remove_source=True)
    assert verify(mission).is_intact
    assert not list((tmp_path / "disk").rglob("*.part"))
    frame = mission.level0(2) / "SU00.tif"
    frame.chmod(0o644)
    data = bytearray(frame.read_bytes())
    data[6000] ^= 4
    frame.write_bytes(data)
    with pytest.raises(transfer.TransferError, match="was altered"):
        transfer.transfer(mission, tmp_path / "disk", remove_source=True)
    assert frame.exists()
    data[6000] ^= 4
    frame.write_bytes(data)
    report = transfer.transfer(mission, tmp_path / "disk", remove_source=True)
    assert report.source_removed
    assert not mission.path.exists()
    assert verify(Mission.open(report.target)).is_intact


def test_a_mission_that_is_being_flown_is_not_copied(mission: Mission, tmp_path: Path) -> None:
    with mission.held(), pytest.raises(MissionError, match="held by another process"):
        transfer.transfer(mission, tmp_path / "disk")


def test_links_and_unknown_files_are_refused(mission: Mission, tmp_path: Path) -> None:
    (mission.export_dir / "link").symlink_to("/etc/passwd")
    with pytest.raises(TreeError, match="not a plain file"):
        transfer.transfer(mission, tmp_path / "disk")
    (mission.export_dir / "link").unlink()
    other = tmp_path / "other" / mission.id
    other.mkdir(parents=True)
    (other / "thesis.doc").write_text("mine")
    with pytest.raises(transfer.TransferError, match="was not made by a transfer"):
        transfer.transfer(mission, tmp_path / "other")
    assert (other / "thesis.doc").read_text() == "mine"
    with pytest.raises(transfer.TransferError, match="where the mission is"):
        transfer.transfer(mission, mission.root)


def test_a_disk_without_room_is_refused_before_anything_is_copied(
    mission: Mission, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(durable, "free_bytes", lambda path: 1000)
    with pytest.raises(transfer.TransferError, match=r"are to be copied and 0\.0 GB are free"):
        transfer.transfer(mission, tmp_path / "disk")
    assert [p.name for p in (tmp_path / "disk" / mission.id).iterdir()] == [".held"]


def test_a_truncated_or_altered_log_is_found(mission: Mission) -> None:
    assert verify(mission).is_intact
    log = next(mission.log_dir.glob("*.mcap"))
    intact = log.read_bytes()
    os.truncate(log, len(intact) - 10)
    assert verify(mission).problems == (f"log {log.name}: was truncated; 10 bytes are missing",)
    log.write_bytes(intact[:-20] + bytes(20))
    assert verify(mission).problems == (f"log {log.name}: was altered after it was sealed",)
    log.unlink()
    assert verify(mission).problems == (f"log {log.name}: is missing",)


def test_swapped_frames_are_found(mission: Mission) -> None:
    a, b = mission.level0(1) / "SU00.tif", mission.level0(2) / "SU00.tif"
    parked = a.with_name("keep")
    a.rename(parked)
    b.rename(a)
    parked.rename(b)
    assert [p.split(":")[0] for p in verify(mission).problems] == [
        "exposure 000001, SU00.tif",
        "exposure 000002, SU00.tif",
    ]


def test_the_index_is_built_again_by_repair(mission: Mission) -> None:
    from typer.testing import CliRunner

    from daemon.cli import app

    mission.catalog_path.unlink()
    assert not verify(mission).is_intact
    result = CliRunner().invoke(app, ["repair", str(mission.path), "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["exposures"] == 3
    assert verify(mission).is_intact
    result = CliRunner().invoke(app, ["repair", str(mission.path), "--rebuild"])
    assert result.exit_code == 0, result.output
    assert verify(mission).is_intact

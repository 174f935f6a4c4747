"""After a crash: every state the disk can be in, and what recovery makes of it."""

from __future__ import annotations

import os
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import pytest

from daemon.mission.catalog.catalog import Catalog
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import FlightLog
from daemon.mission.log.log_records import LoggedTrigger, message_of
from daemon.mission.store import durable
from daemon.mission.store.level0_folder import read_capture, read_sealed
from daemon.mission.store.store import Level0Writer, verify
from daemon.mission.verification.recovery import recover
from daemon.onboard.flight.ledger import Ledger
from drivers.contract import TemperatureSample, TriggerPulse
from tests.daemon.small_camera import (
    BOOT_ID,
    SENSORS,
    complete_from_log,
    cut_chain_before,
    final_record,
    fly,
    mark_of,
    new_mission,
    store_one,
)


@pytest.fixture
def mission(tmp_path):
    return new_mission(tmp_path)


def store_unsealed(mission, number):
    writer = Level0Writer(mission)
    store_one(writer, number)
    writer.close()


def forget(mission, number):
    """Chain file and index as they were before an exposure was committed."""
    cut_chain_before(mission, number)
    with sqlite3.connect(mission.catalog_path) as connection:
        for table in ("frames", "exposures"):
            connection.execute(f"DELETE FROM {table} WHERE number = ?", (number,))
    connection.close()


def log_of(mission, numbers, *, boot_id=BOOT_ID, marks=True):
    log = FlightLog.create(mission.log_dir, boot_id=boot_id)
    for number in numbers:
        pulse = TriggerPulse(number, number * 1_000_000_000, 200_000, number)
        log.write(message_of(LoggedTrigger(number, pulse)))
        if marks:
            log.write(message_of(mark_of(number)))
        temperature = TemperatureSample("0", 20.0 + number, number * 1_000_000_000 - 5)
        log.write(message_of(temperature))
    return log


def assert_in_order(mission):
    assert verify(mission).problems == ()
    again = recover(mission, complete_from_log)
    assert again.done == () and again.problems == () and again.sealed == ()


def test_a_mission_in_order_is_left_as_it_is(mission):
    fly(mission, [1, 2, 3])
    report = recover(mission, complete_from_log)
    assert report.sentences == ()
    assert report.next_number == 4
    assert [e.number for e in report.finalized] == [1, 2, 3]
    assert Ledger.resume(report.finalized).sheet().is_balanced
    assert_in_order(mission)


def test_what_was_stored_but_unsealed_is_sealed_from_the_log(mission):
    fly(mission, [1, 2])
    for number in (3, 4):
        store_unsealed(mission, number)
    log_of(mission, [3, 4]).close()
    report = recover(mission, complete_from_log)
    assert report.sealed == (3, 4)
    assert "exposure 3: was stored but not sealed; sealed from the log (event-mark)" in report.done
    sealed = read_sealed(mission.level0(4)).exposure
    assert sealed.mark_gps_ns == mark_of(4).gps_ns
    assert sealed.temperatures[0].value_c == 24.0
    assert sealed.previous_sha256 == read_sealed(mission.level0(3)).sha256
    assert_in_order(mission)


def test_a_mark_of_another_boot_never_seals_an_exposure(mission):
    store_unsealed(mission, 1)
    log_of(mission, [1], boot_id="another boot").close()
    recover(mission, complete_from_log)
    assert read_sealed(mission.level0(1)).exposure.mark_source == "none"
    assert_in_order(mission)


def test_a_torn_log_seals_with_what_it_still_has(mission):
    for number in (1, 2):
        store_unsealed(mission, number)
    log = log_of(mission, [1, 2])
    size = log.path.stat().st_size
    os.truncate(log.path, size - 20)
    report = recover(mission, complete_from_log)
    assert report.log_bytes_cut > 0
    assert any("ends in the middle of a message" in sentence for sentence in report.notices)
    assert read_sealed(mission.level0(2)).exposure.mark_gps_ns == mark_of(2).gps_ns
    log.close()


def test_a_complete_folder_that_was_only_not_renamed_is_kept(mission):
    fly(mission, [1])
    store_unsealed(mission, 2)
    forget(mission, 2)
    mission.level0(2).rename(mission.level0_root / "000002.part")
    report = recover(mission, complete_from_log)
    assert report.done[0] == "exposure 000002: was whole but unnamed; kept as stored"
    assert report.sealed == (2,)
    assert_in_order(mission)


@pytest.mark.parametrize("damage", ["torn frame", "no record", "missing frame", "empty"])
def test_an_incomplete_folder_is_discarded_and_never_reported_as_stored(mission, damage):
    fly(mission, [1])
    store_unsealed(mission, 2)
    forget(mission, 2)
    part = mission.level0_root / "000002.part"
    mission.level0(2).rename(part)
    if damage == "torn frame":
        (part / "SU01.tif").chmod(0o644)
        os.truncate(part / "SU01.tif", 6000)
    elif damage == "no record":
        (part / "capture.json").unlink()
    elif damage == "missing frame":
        (part / "SU00.tif").unlink()
    else:
        durable.remove_tree(part)
        part.mkdir()
    report = recover(mission, complete_from_log)
    assert "never called stored" in report.done[0]
    assert (mission.level0_root / ".discarded" / "000002-1").is_dir()
    assert report.next_number == 3
    assert mission.numbers() == [1]
    assert_in_order(mission)


def test_a_folder_without_a_row_gets_one(mission):
    fly(mission, [1, 2])
    forget(mission, 2)
    report = recover(mission, complete_from_log)
    assert "exposure 2: is sealed; noted in the index" in report.done
    assert_in_order(mission)


def test_a_row_without_a_folder_is_reported_as_a_problem(mission):
    fly(mission, [1, 2])
    shutil.rmtree(mission.level0(2))
    report = recover(mission, complete_from_log)
    assert report.problems == (
        "exposure 2: was stored but its folder is gone; it was removed by others",
    )
    assert report.next_number == 3
    assert recover(mission, complete_from_log).problems == report.problems


@pytest.mark.parametrize("loss", ["missing", "garbage", "empty"])
def test_a_lost_index_is_built_again_from_the_records(mission, loss):
    fly(mission, [2, 1, 3])
    store_unsealed(mission, 4)
    path = mission.catalog_path
    before = Catalog.read(path).exposures()[:3]
    mission.level2(2).mkdir()
    (mission.level2(2) / "quality.json").write_bytes(b'{"verdict":"usable"}\n')
    path.unlink()
    if loss != "missing":
        path.write_bytes(b"" if loss == "empty" else b"not a database" * 500)
    report = recover(mission, complete_from_log)
    assert report.sealed == (4,)
    rows = Catalog.read(path).exposures()
    assert rows[:3] == before
    assert Catalog.read(path).last_record_sha256() == read_sealed(mission.level0(4)).sha256
    assert Catalog.read(path).verdicts() == {2: "usable"}
    assert path.with_name("mission.db.damaged").exists() == (loss == "garbage")
    assert_in_order(mission)


def test_a_record_written_half_is_written_again(mission):
    store_unsealed(mission, 1)
    (mission.level0(1) / ".exposure.json.part").write_bytes(b'{"form')
    report = recover(mission, complete_from_log)
    assert "a record written half was removed" in report.done[0]
    assert report.sealed == (1,)
    assert_in_order(mission)


def test_a_record_that_was_not_committed_yet_is_the_head_of_the_chain(mission):
    fly(mission, [1, 2])
    with sqlite3.connect(mission.catalog_path) as connection:
        connection.execute(
            "UPDATE exposures SET is_sealed = 0, record_sha256 = NULL, seal_order = NULL"
            " WHERE number = 2"
        )
    connection.close()
    recover(mission, complete_from_log)
    fly(mission, [3])
    assert_in_order(mission)


def test_a_trigger_that_left_nothing_is_recorded_as_lost(mission):
    fly(mission, [1])
    log_of(mission, [1, 2]).close()
    report = recover(mission, complete_from_log)
    assert report.lost == (2,) and report.next_number == 3
    lost = read_sealed(mission.level0(2)).exposure
    assert lost.state == "lost" and [sensor for sensor, _ in lost.missing] == list(SENSORS)
    assert lost.mark_gps_ns == mark_of(2).gps_ns
    sheet = Ledger.resume(report.finalized).sheet()
    assert (sheet.triggers, sheet.complete, sheet.lost) == (2, 1, 1)
    assert sheet.is_balanced
    assert_in_order(mission)


def test_the_last_sheet_of_the_ledger_is_handed_on(mission):
    log = log_of(mission, [])
    for late in (1, 2):
        log.append("ledger", 5, {"heads": [{"name": "SU00", "late": late}]})
    log.close()
    report = recover(mission, complete_from_log)
    ledger = Ledger.resume(report.finalized, sheet=report.ledger_sheet)
    assert ledger.sheet().frames.late == 2


def test_an_altered_record_and_a_break_in_the_chain_are_reported(mission):
    fly(mission, [1, 2, 3])
    path = mission.level0(2) / "exposure.json"
    path.chmod(0o644)
    path.write_bytes(path.read_bytes().replace(b'"line-1"', b'"line-2"'))
    report = recover(mission, complete_from_log)
    assert any("chain is broken before exposure 3" in problem for problem in report.problems)
    assert "exposure 2: its record was altered since it was sealed" in report.problems
    fly(mission, [4])
    assert read_sealed(mission.level0(4)).exposure.previous_sha256 == (
        read_sealed(mission.level0(3)).sha256
    )


def test_a_damaged_record_is_reported_and_stops_nothing(mission):
    fly(mission, [1, 2])
    path = mission.level0(1) / "exposure.json"
    path.chmod(0o644)
    path.write_bytes(b"\x00" * 100)
    report = recover(mission, complete_from_log)
    assert any(
        problem.startswith("000001/exposure.json: not a JSON") for problem in report.problems
    )
    assert report.next_number == 3


class PowerCut(BaseException):
    """Everything stops here; nothing that follows in the program is done."""


def test_a_stop_at_every_single_step_of_store_and_seal_is_recovered(tmp_path, monkeypatch):
    """Not by chance like kill -9: the program is stopped before each of its disk operations."""
    steps = 0
    stop_at = 0

    def stopping(real):
        def call(*arguments, **named):
            nonlocal steps
            steps += 1
            if steps == stop_at:
                raise PowerCut
            return real(*arguments, **named)

        return call

    real = {
        (os, "writev"): os.writev,
        (os, "fsync"): os.fsync,
        (Path, "rename"): Path.rename,
        (Path, "mkdir"): Path.mkdir,
        (Catalog, "add_stored"): Catalog.add_stored,
        (Catalog, "add_sealed"): Catalog.add_sealed,
    }
    outcomes = set()
    while True:
        stop_at += 1
        folder = tmp_path / str(stop_at)
        mission = new_mission(folder)
        fly(mission, [1])
        writer = Level0Writer(mission, threads=1)
        acknowledged = []
        steps = 0
        with monkeypatch.context() as patch:
            for (owner, name), function in real.items():
                patch.setattr(owner, name, stopping(function))
            try:
                stored = store_one(writer, 2)
                acknowledged.append("stored")
                writer.seal(final_record(stored))
                acknowledged.append("sealed")
            except PowerCut:
                pass
        writer.close()
        report = recover(mission, complete_from_log)
        assert report.problems == ()
        present = 2 in mission.numbers()
        assert present or "stored" not in acknowledged
        if present:
            assert read_capture(mission.level0(2)) is not None
        outcomes.add((tuple(acknowledged), present))
        writer = Level0Writer(mission)
        writer.seal(final_record(store_one(writer, report.next_number)))
        writer.close()
        assert_in_order(mission)
        if acknowledged == ["stored", "sealed"]:
            break
    assert stop_at > 15
    assert outcomes == {((), False), ((), True), (("stored",), True), (("stored", "sealed"), True)}


def test_a_flight_is_continued_in_the_same_mission_after_recovery(mission):
    fly(mission, [1, 2])
    store_unsealed(mission, 3)
    again = Mission.current(mission.root)
    report = recover(again, complete_from_log)
    writer = Level0Writer(again)
    stored = store_one(writer, report.next_number)
    writer.seal(replace(final_record(stored), previous_sha256=writer.head_sha256))
    writer.close()
    assert again.numbers() == [1, 2, 3, 4]
    assert_in_order(again)

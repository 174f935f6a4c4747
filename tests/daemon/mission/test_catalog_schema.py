"""Older indexes: brought to the present schema whole or not at all, and read while being flown."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from daemon.mission.catalog import catalog_schema
from daemon.mission.catalog.catalog import Catalog, CatalogError
from daemon.mission.store.store import Level0Writer, verify
from daemon.mission.verification.recovery import recover
from tests.daemon.small_camera import complete_from_log, fly, new_mission, store_one

OLDEST = Path(__file__).with_name("schema_1.sql")
"""The first schema that was released, as it was."""


def make_old(path: Path) -> None:
    """Turn an index into what version 1 would have written."""
    new = sqlite3.connect(path)
    tables = ("exposures", "frames", "products", "events")
    old = sqlite3.connect(path.with_name("old.db"))
    old.executescript(OLDEST.read_text())
    for table in tables:
        names = ", ".join(row[1] for row in old.execute(f"PRAGMA table_info({table})"))
        rows = new.execute(f"SELECT {names} FROM {table}").fetchall()
        places = ", ".join("?" * (names.count(",") + 1))
        old.executemany(f"INSERT INTO {table} ({names}) VALUES ({places})", rows)
    old.execute("PRAGMA user_version = 1")
    old.commit()
    for connection in (old, new):
        connection.close()
    path.with_name("old.db").rename(path)


def columns(path: Path) -> dict[str, set[tuple[str, str, int]]]:
    connection = sqlite3.connect(path)
    tables = [n for (n,) in connection.execute("SELECT name FROM sqlite_schema WHERE type='table'")]
    found = {
        table: {(r[1], r[2], r[3]) for r in connection.execute(f"PRAGMA table_info({table})")}
        for table in tables
    }
    connection.close()
    return found


@pytest.fixture
def mission(tmp_path):
    return new_mission(tmp_path)


def test_an_index_of_the_first_schema_becomes_one_of_the_present(mission):
    fly(mission, [1, 2])
    rows = Catalog.read(mission.catalog_path).exposures()
    current = columns(mission.catalog_path)
    make_old(mission.catalog_path)
    assert columns(mission.catalog_path) != current
    Catalog.open(mission.catalog_path).close()
    assert columns(mission.catalog_path) == current
    assert Catalog.read(mission.catalog_path).exposures() == rows


def test_a_flight_goes_on_with_an_index_of_the_first_schema(mission):
    fly(mission, [1, 2])
    make_old(mission.catalog_path)
    report = recover(mission, complete_from_log)
    assert report.sentences == () and report.next_number == 3
    fly(mission, [3])
    assert verify(mission).problems == ()
    assert not list(mission.path.glob("*.damaged*"))


def test_an_old_index_is_read_from_any_thread(mission):
    fly(mission, [1, 2])
    make_old(mission.catalog_path)
    reader = Catalog.read(mission.catalog_path)
    numbers: list[int] = []
    thread = threading.Thread(target=lambda: numbers.extend(r.number for r in reader.exposures()))
    thread.start()
    thread.join(timeout=10)
    assert numbers == [1, 2]
    reader.close()


def test_an_old_index_is_read_without_being_changed(mission):
    fly(mission, [1, 2])
    make_old(mission.catalog_path)
    before = mission.catalog_path.read_bytes()
    reader = Catalog.read(mission.catalog_path)
    assert [row.number for row in reader.exposures()] == [1, 2]
    reader.close()
    assert verify(mission).problems == ()
    assert mission.catalog_path.read_bytes() == before


def test_a_step_that_fails_changes_nothing(mission, monkeypatch):
    fly(mission, [1])
    make_old(mission.catalog_path)
    before = columns(mission.catalog_path)
    steps = {1: (*catalog_schema._STEPS[1], "ALTER TABLE nowhere ADD COLUMN x")}
    monkeypatch.setattr(catalog_schema, "_STEPS", steps)
    with pytest.raises(CatalogError, match="nowhere"):
        Catalog.open(mission.catalog_path)
    monkeypatch.undo()
    assert columns(mission.catalog_path) == before
    Catalog.open(mission.catalog_path).close()
    assert verify(mission).problems == ()


def test_every_version_has_its_step_to_the_next():
    assert set(catalog_schema._STEPS) == set(range(1, catalog_schema.SCHEMA_VERSION))


def test_the_index_is_read_by_another_process_while_it_is_written(mission):
    """WAL: a plain SQLite of somebody else, as in the manual, never waits and never disturbs."""
    program = (
        "import sqlite3, sys\n"
        f"path = {str(mission.catalog_path)!r}\n"
        "db = sqlite3.connect(f'file:{path}?mode=ro', uri=True, timeout=0)\n"
        "seen = [db.execute('SELECT COUNT(*) FROM exposures').fetchone()[0] for _ in range(2000)]\n"
        "print(seen[0], seen[-1], seen == sorted(seen))\n"
    )
    writer = Level0Writer(mission)
    store_one(writer, 1)
    flying = threading.Event()
    numbers = []

    def write() -> None:
        number = 2
        while not flying.is_set():
            store_one(writer, number)
            numbers.append(number)
            number += 1

    thread = threading.Thread(target=write)
    thread.start()
    try:
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
        )
    finally:
        flying.set()
        thread.join(30)
        writer.close()
    first, last, is_growing = done.stdout.split()
    assert is_growing == "True" and int(first) >= 1 and int(last) <= 1 + len(numbers)
    assert verify(mission).exposures == 1 + len(numbers)

"""The index: readable beside its writer, refused when damaged, never in the way of another."""

from __future__ import annotations

import sqlite3
import threading

import pytest

from daemon.disk.catalog import Catalog, CatalogError
from tests.daemon.small_camera import capture_of, final_record


@pytest.fixture
def path(tmp_path):
    return tmp_path / "mission.db"


def test_a_reader_sees_what_was_committed_while_the_writer_goes_on(path):
    writer = Catalog.open(path)
    writer.add_stored(capture_of(1))
    reader = Catalog.read(path)
    writer.add_sealed(final_record(capture_of(1)), "a" * 64)
    writer.add_stored(capture_of(2))
    rows = reader.exposures()
    assert [(r.number, r.state, r.is_sealed) for r in rows] == [
        (1, "complete", True),
        (2, "stored", False),
    ]
    assert rows[0].mark_gps_ns == 1_447_000_001_000_000_000
    with pytest.raises(sqlite3.OperationalError):
        reader.add_stored(capture_of(3))
    reader.close()
    writer.close()


def test_the_last_record_is_the_one_sealed_last_whatever_its_number(path):
    catalog = Catalog.open(path)
    assert catalog.last_record_sha256() == ""
    for number in (2, 1):
        catalog.add_stored(capture_of(number))
        catalog.add_sealed(final_record(capture_of(number)), f"{number:064d}")
    assert catalog.last_record_sha256() == f"{1:064d}"
    catalog.close()


def test_two_that_open_at_once_share_one_schema(path):
    problems = []
    start = threading.Barrier(4)

    def open_and_write(number):
        start.wait(timeout=10)
        try:
            catalog = Catalog.open(path)
            catalog.add_stored(capture_of(number))
            catalog.close()
        except (CatalogError, sqlite3.Error) as error:
            problems.append(error)

    threads = [threading.Thread(target=open_and_write, args=(n,)) for n in (1, 2, 3, 4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=30)
    assert problems == []
    assert [row.number for row in Catalog.read(path).exposures()] == [1, 2, 3, 4]


def test_products_replace_earlier_ones_and_give_the_verdict(path):
    catalog = Catalog.open(path)
    catalog.add_products(1, {"pan.tif": 10, "quality.json": 2}, "refly")
    catalog.add_products(1, {"quality.json": 2}, "good")
    assert catalog.verdicts() == {1: "good"}
    catalog.close()


def test_an_index_that_is_read_only_all_around_is_read(path):
    writer = Catalog.open(path)
    writer.add_stored(capture_of(1))
    writer.close()
    path.chmod(0o444)
    path.parent.chmod(0o555)
    try:
        reader = Catalog.read(path)
        assert [row.number for row in reader.exposures()] == [1]
        reader.close()
    finally:
        path.parent.chmod(0o755)


@pytest.mark.parametrize("content", [b"garbage" * 1000, b"SQLite format 3\0" + b"\xff" * 4080])
def test_a_damaged_index_is_refused_with_what_will_be_done(path, content):
    path.write_bytes(content)
    with pytest.raises(CatalogError, match="rebuilds it from the records"):
        Catalog.open(path)


def test_an_index_of_another_version_is_refused(path):
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA user_version = 99")
    connection.close()
    for attempt in (Catalog.open, Catalog.read):
        with pytest.raises(CatalogError, match="schema 99; this version reads 2 at most"):
            attempt(path)

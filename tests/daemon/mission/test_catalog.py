"""The index: readable during writing, refused when damaged, never blocking another."""

from __future__ import annotations

import contextlib
import sqlite3
import threading
from types import SimpleNamespace

import pytest

from daemon.mission.catalog import catalog as catalog_module
from daemon.mission.catalog.catalog import Catalog, CatalogBusyError, CatalogError, IndexedExposure
from tests.daemon.small_camera import SENSORS, capture_of, final_record


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


def in_another_thread(function):
    results = []
    thread = threading.Thread(target=lambda: results.append(function()))
    thread.start()
    thread.join(timeout=10)
    return results


def one_exposure(path):
    catalog = Catalog.open(path)
    catalog.add_stored(capture_of(1))
    catalog.close()


def test_a_connection_serves_every_thread_and_waits_10_s_for_another_process(path):
    writer = Catalog.open(path)
    assert in_another_thread(lambda: writer.add_stored(capture_of(1))) == [None]
    reader = Catalog.read(path)
    for catalog in (writer, reader):
        assert [[row.number for row in rows] for rows in in_another_thread(catalog.exposures)] == [
            [1]
        ]
        assert catalog._connection.execute("PRAGMA busy_timeout").fetchone() == (10_000,)
        catalog.close()


def test_a_reader_follows_later_commits_unless_the_index_is_immutable(path):
    one_exposure(path)
    reader = Catalog.read(path)
    writer = Catalog.open(path)
    writer.add_stored(capture_of(2))
    assert [row.number for row in reader.exposures()] == [1, 2]
    reader.close()
    writer.close()


def test_an_immutable_index_is_read_without_further_files(path):
    one_exposure(path)
    reader = Catalog.read(path, is_immutable=True)
    assert [row.number for row in reader.exposures()] == [1]
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    reader.close()


def test_an_immutable_index_with_a_log_is_read_with_the_content_of_the_log(path):
    writer = Catalog.open(path)
    writer.add_stored(capture_of(1))
    reader = Catalog.read(path, is_immutable=True)
    assert [row.number for row in reader.exposures()] == [1]
    reader.close()
    writer.close()


def test_an_index_whose_log_cannot_be_joined_is_read_as_one_file(path, monkeypatch):
    """As on a medium that is read-only: the index is opened as an address, for every thread."""
    one_exposure(path)
    connect, addresses = sqlite3.connect, []

    def cannot_join(*_arguments, **_options):
        raise sqlite3.OperationalError("unable to open database file")

    def stand_in(address, **options):
        addresses.append((address.rsplit("?")[1], options["uri"]))
        if "mode=ro" not in address:
            return connect(address, **options)
        return SimpleNamespace(execute=cannot_join, close=lambda: None)

    monkeypatch.setattr(sqlite3, "connect", stand_in)
    reader = Catalog.read(path)
    assert addresses == [("mode=ro", True), ("immutable=1", True)]
    assert [[r.number for r in rows] for rows in in_another_thread(reader.exposures)] == [[1]]
    reader.close()


def test_an_empty_file_is_no_index(path):
    path.touch()
    with pytest.raises(CatalogError, match="schema 0; this version reads 2 at most"):
        Catalog.read(path)


def test_a_snapshot_names_the_record_and_the_frames_of_every_exposure(path):
    catalog = Catalog.open(path)
    for number in (1, 2):
        catalog.add_stored(capture_of(number))
    catalog.add_sealed(final_record(capture_of(1)), "a" * 64)
    snapshot = catalog.snapshot()
    assert {n: one.record_sha256 for n, one in snapshot.items()} == {1: "a" * 64, 2: ""}
    assert {tuple(sorted(one.frames)) for one in snapshot.values()} == {tuple(sorted(SENSORS))}
    assert snapshot[2] == IndexedExposure("", catalog.frames(2))
    catalog.close()


class HeldIndex:
    """A connection that answers with one error, and the clock by which its opener waits."""

    def __init__(self, code):
        self.error = sqlite3.OperationalError("database is locked")
        if code is not None:
            self.error.sqlite_errorcode = code
        self.now_ms = 50_000
        self.attempts = 0

    def execute(self, _statement):
        self.attempts += 1
        raise self.error

    def close(self):
        pass

    def monotonic(self):
        return self.now_ms / 1000

    def sleep(self, seconds):
        self.now_ms += round(1000 * seconds)


SQLITE_BUSY_SNAPSHOT, SQLITE_LOCKED_SHAREDCACHE = 517, 262


@pytest.mark.parametrize(
    "code",
    [sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, SQLITE_BUSY_SNAPSHOT, SQLITE_LOCKED_SHAREDCACHE],
)
def test_a_held_index_is_asked_again_every_10_ms_until_more_than_10_s_are_over(
    path, monkeypatch, code
):
    held = HeldIndex(code)
    monkeypatch.setattr(sqlite3, "connect", lambda *_, **__: held)
    monkeypatch.setattr(catalog_module, "time", held)
    with pytest.raises(CatalogBusyError, match="held by another process for 10 s"):
        Catalog.open(path)
    assert (held.now_ms, held.attempts) == (60_010, 1002)


@pytest.mark.parametrize("code", [sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CORRUPT, 0, None])
def test_an_index_that_fails_otherwise_is_damaged_at_once(path, monkeypatch, code):
    held = HeldIndex(code)
    monkeypatch.setattr(sqlite3, "connect", lambda *_, **__: held)
    monkeypatch.setattr(catalog_module, "time", held)
    with pytest.raises(CatalogError, match="damaged"):
        Catalog.open(path)
    assert (held.now_ms, held.attempts) == (50_000, 1)


@pytest.mark.trust
@pytest.mark.parametrize(
    "statement", [b"CREATE \xa0\xa0BLE ex", b"C\xa0EATE TABLE ex", b"CREATE TABLE (\xa0"]
)
def test_a_damaged_schema_is_reported_and_never_another_error(tmp_path, statement):
    path = tmp_path / "mission.db"
    Catalog.open(path).close()
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
    connection.close()
    data = path.read_bytes()
    assert b"CREATE TABLE ex" in data and len(statement) == 15
    path.write_bytes(data.replace(b"CREATE TABLE ex", statement))
    for call in (Catalog.read, Catalog.open):
        with pytest.raises(CatalogError, match=r"mission\.db"):
            call(path)


@pytest.mark.trust
@pytest.mark.parametrize("page", range(8))
def test_a_damaged_page_is_reported_and_never_another_error(tmp_path, page):
    path = tmp_path / "mission.db"
    catalog = Catalog.open(path)
    catalog.add_event("SU00", "lost", "A.", is_fault=True, mono_ns=1, boot_id="b")
    catalog.close()
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
        nbytes = connection.execute("PRAGMA page_size").fetchone()[0]
    connection.close()
    data = bytearray(path.read_bytes())
    begin = max(page * nbytes, 100)
    data[begin : begin + 64] = b"\xff" * 64
    path.write_bytes(data)
    with contextlib.suppress(CatalogError):
        opened = Catalog.read(path)
        try:
            opened.events(), opened.exposures(), opened.verdicts(), opened.snapshot()
        finally:
            opened.close()
    with contextlib.suppress(CatalogError):
        Catalog.open(path).close()

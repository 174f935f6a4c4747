"""The index of a mission: SQLite in WAL mode, always derivable from the records on disk.

It answers questions quickly and is never the only place where a fact is written. Bringing it
together with the disk after a crash is done in `daemon.mission.verification.recovery`.
"""

from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daemon import DaemonError
from daemon.mission.catalog.catalog_schema import (
    DATABASE_ERRORS,
    SCHEMA_VERSION,
    create,
    has_only_tables,
    migrate,
)
from daemon.mission.exposure import CaptureRecord, Exposure, FrameRecord

BUSY_TIMEOUT_S = 10.0
"""How long a writer waits while another process commits."""

BUSY_RETRY_S = 0.01


class CatalogError(DaemonError):
    """An index that cannot be used; the message states what to do."""


class CatalogBusyError(DaemonError):
    """An intact index held by another process; nothing is to be repaired."""


@dataclass(frozen=True)
class Row:
    """Index entry of an exposure. `state` is "stored" until it is sealed."""

    number: int
    state: str
    is_sealed: bool
    record_sha256: str | None
    previous_sha256: str | None
    mark_gps_ns: int | None
    flags: int


@dataclass(frozen=True)
class IndexedExposure:
    """Index entry of an exposure's files: hash of its record, and of its frames by sensor.

    `record_sha256` is empty until the exposure is sealed.
    """

    record_sha256: str
    frames: Mapping[str, str]


class Catalog:
    """A connection to `mission.db`. Safe to use from several threads, one statement at a time.

    Several processes may have it open; SQLite lets one commit at a time. A committed transaction
    survives a power cut.
    """

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection
        self._lock = threading.Lock()

    @classmethod
    def open(cls, path: Path) -> Catalog:
        """Open for writing; the file is created with an empty schema where it is not there.

        One of an older schema is brought to this version's in one transaction.

        Raises:
            CatalogError: damaged, or of a newer schema version.
            CatalogBusyError: another process holds it and does not let go.
        """
        try:
            connection = sqlite3.connect(
                path, timeout=BUSY_TIMEOUT_S, isolation_level=None, check_same_thread=False
            )
        except DATABASE_ERRORS as error:
            raise CatalogError(f"{path}: cannot be opened ({error})") from error
        try:
            _enter_wal(connection)
            connection.execute("PRAGMA synchronous = FULL")
            connection.execute("PRAGMA foreign_keys = ON")
            _prepare(connection, path)
        except DATABASE_ERRORS as error:
            connection.close()
            if _is_busy(error):
                raise CatalogBusyError(
                    f"{path}: held by another process for {BUSY_TIMEOUT_S:g} s; end that process"
                ) from error
            raise CatalogError(_damaged(path, error)) from error
        except CatalogError:
            connection.close()
            raise
        return cls(connection)

    @classmethod
    def read(cls, path: Path, *, is_immutable: bool = False) -> Catalog:
        """Open for reading only, while another process writes or on a medium that is read-only.

        One of an older schema is read through a copy in memory, and left as it is.

        Args:
            path: the index.
            is_immutable: no process writes it, so that no files are needed in its folder to share
                it.

        Raises:
            CatalogError: not there, damaged, or of a newer schema version.
        """
        if not path.is_file():
            raise CatalogError(f"{path}: no such index; syntopic repair builds it again")
        address = path.resolve().as_uri()
        is_one_file = is_immutable and not path.with_name(f"{path.name}-wal").exists()
        try:
            connection = sqlite3.connect(
                f"{address}?immutable=1" if is_one_file else f"{address}?mode=ro",
                uri=True,
                timeout=BUSY_TIMEOUT_S,
                isolation_level=None,
                check_same_thread=False,
            )
            try:
                version = connection.execute("PRAGMA user_version").fetchone()[0]
            except sqlite3.OperationalError:
                # WAL cannot be joined where its files cannot be made; no process writes there
                # either.
                connection.close()
                connection = sqlite3.connect(
                    f"{address}?immutable=1", uri=True, check_same_thread=False
                )
                version = connection.execute("PRAGMA user_version").fetchone()[0]
            if 0 < version < SCHEMA_VERSION:
                connection = _migrated_copy(connection)
                version = SCHEMA_VERSION
            is_ours = has_only_tables(connection)
        except DATABASE_ERRORS as error:
            raise CatalogError(_damaged(path, error)) from error
        if version != SCHEMA_VERSION:
            connection.close()
            raise CatalogError(_wrong_version(path, version))
        if not is_ours:
            connection.close()
            raise CatalogError(_damaged(path, "it holds views or triggers; ours has none"))
        return cls(connection)

    def close(self) -> None:
        """Fold the log into the file and let go of it; may be called twice."""
        with self._lock:
            with suppress(sqlite3.Error):
                self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            self._connection.close()

    def add_stored(self, capture: CaptureRecord) -> None:
        """Commit that an exposure's pixels are durable."""
        with self._lock:
            self._begin()
            try:
                self._insert(capture, "stored")
                self._insert_frames(capture.number, capture.frames)
                self._connection.execute("COMMIT")
            except sqlite3.Error:
                self._rollback()
                raise

    def add_sealed(self, exposure: Exposure, record_sha256: str) -> None:
        """Commit that an exposure's record is durable; its order follows the one sealed last."""
        place = exposure.navigation
        with self._lock:
            self._begin()
            try:
                self._insert(exposure, exposure.state)
                self._connection.execute(
                    "UPDATE exposures SET is_sealed = 1, mark_gps_ns = ?, mark_sigma_ns = ?,"
                    " mark_source = ?, latitude_deg = ?, longitude_deg = ?, height_m = ?,"
                    " record_sha256 = ?, previous_sha256 = ?,"
                    " seal_order = (SELECT COALESCE(MAX(seal_order), 0) + 1 FROM exposures)"
                    " WHERE number = ?",
                    (
                        exposure.mark_gps_ns,
                        exposure.mark_sigma_ns,
                        exposure.mark_source,
                        place.latitude_deg if place else None,
                        place.longitude_deg if place else None,
                        place.height_m if place else None,
                        record_sha256,
                        exposure.previous_sha256,
                        exposure.number,
                    ),
                )
                self._insert_frames(exposure.number, exposure.frames)
                self._connection.execute("COMMIT")
            except sqlite3.Error:
                self._rollback()
                raise

    def add_products(self, number: int, files: Mapping[str, int], verdict: str | None) -> None:
        """Note the products of an exposure, name to size in bytes, in place of earlier ones."""
        with self._lock:
            self._begin()
            try:
                self._connection.execute("DELETE FROM products WHERE number = ?", (number,))
                self._connection.executemany(
                    "INSERT INTO products (number, file, nbytes, verdict) VALUES (?, ?, ?, ?)",
                    [(number, file, nbytes, verdict) for file, nbytes in files.items()],
                )
                self._connection.execute("COMMIT")
            except sqlite3.Error:
                self._rollback()
                raise

    def add_event(
        self, source: str, name: str, sentence: str, *, is_fault: bool, mono_ns: int, boot_id: str
    ) -> None:
        """Note something the crew may want to read after landing."""
        self._write(
            "INSERT INTO events (boot_id, mono_ns, source, name, is_fault, sentence)"
            " VALUES (?, ?, ?, ?, ?, ?)",
            (boot_id, mono_ns, source, name, int(is_fault), sentence),
        )

    def exposures(self) -> list[Row]:
        """All exposures of the index by number."""
        rows = self._read(
            "SELECT number, state, is_sealed, record_sha256, previous_sha256, mark_gps_ns, flags"
            " FROM exposures ORDER BY number"
        )
        return [
            Row(number, state, bool(sealed), record, previous, mark, flags)
            for number, state, sealed, record, previous, mark, flags in rows
        ]

    def frames(self, number: int) -> dict[str, str]:
        """Sensor to SHA-256 of an exposure's frames."""
        return dict(self._read("SELECT sensor, sha256 FROM frames WHERE number = ?", (number,)))

    def snapshot(self) -> dict[int, IndexedExposure]:
        """All exposures by number as of one instant, while another process writes.

        Raises:
            CatalogError: damaged.
        """
        with self._lock:
            try:
                self._connection.execute("BEGIN")
                exposures = self._connection.execute(
                    "SELECT number, record_sha256 FROM exposures"
                ).fetchall()
                frames = self._connection.execute(
                    "SELECT number, sensor, sha256 FROM frames"
                ).fetchall()
                self._connection.execute("COMMIT")
            except DATABASE_ERRORS as error:
                raise CatalogError(f"mission.db: damaged ({error}); syntopic repair") from error
        by_number: dict[int, dict[str, str]] = {number: {} for number, _ in exposures}
        for number, sensor, sha256 in frames:
            by_number.setdefault(number, {})[sensor] = sha256
        return {
            number: IndexedExposure(record_sha256 or "", by_number[number])
            for number, record_sha256 in exposures
        }

    def events(self) -> list[tuple[str, str, str]]:
        """Source, name and message of all events, in order.

        Raises:
            CatalogError: damaged.
        """
        rows = self._read("SELECT source, name, sentence FROM events ORDER BY id")
        return [(str(source), str(name), str(sentence)) for source, name, sentence in rows]

    def verdicts(self) -> dict[int, str]:
        """Verdict of every exposure that has products."""
        return dict(
            self._read("SELECT DISTINCT number, verdict FROM products WHERE verdict IS NOT NULL")
        )

    def processed_numbers(self) -> set[int]:
        """Exposures whose products the index knows."""
        return {number for (number,) in self._read("SELECT DISTINCT number FROM products")}

    def last_record_sha256(self) -> str:
        """Hash of the record sealed last, empty where none is."""
        rows = self._read(
            "SELECT record_sha256 FROM exposures WHERE is_sealed = 1"
            " ORDER BY seal_order DESC LIMIT 1"
        )
        return str(rows[0][0]) if rows else ""

    def _insert(self, record: CaptureRecord | Exposure, state: str) -> None:
        self._connection.execute(
            "INSERT INTO exposures (number, state, is_sealed, trigger_sequence, trigger_mono_ns,"
            " boot_id, line_id, strip_id, flags, is_simulated)"
            " VALUES (?, ?, 0, ?, ?, ?, ?, ?, ?, ?)"
            " ON CONFLICT (number) DO UPDATE SET state = excluded.state, flags = excluded.flags",
            (
                record.number,
                state,
                record.trigger_sequence,
                record.trigger_mono_ns,
                record.boot_id,
                record.line_id,
                record.strip_id,
                int(record.flags),
                int(record.simulated),
            ),
        )

    def _insert_frames(self, number: int, frames: Iterable[FrameRecord]) -> None:
        self._connection.execute("DELETE FROM frames WHERE number = ?", (number,))
        self._connection.executemany(
            "INSERT INTO frames (number, sensor, file, sha256, mid_exposure_gps_ns)"
            " VALUES (?, ?, ?, ?, ?)",
            [(number, f.sensor, f.file, f.sha256, f.mid_exposure_gps_ns) for f in frames],
        )

    def _begin(self) -> None:
        self._connection.execute("BEGIN IMMEDIATE")

    def _rollback(self) -> None:
        with suppress(sqlite3.Error):
            self._connection.execute("ROLLBACK")

    def _write(self, statement: str, values: tuple[Any, ...]) -> None:
        with self._lock:
            self._connection.execute(statement, values)

    def _read(self, statement: str, values: tuple[Any, ...] = ()) -> list[Any]:
        try:
            with self._lock:
                return self._connection.execute(statement, values).fetchall()
        except DATABASE_ERRORS as error:
            raise CatalogError(f"mission.db: damaged ({error}); syntopic repair") from error


def _prepare(connection: sqlite3.Connection, path: Path) -> None:
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if not has_only_tables(connection):
        raise CatalogError(_damaged(path, "it holds views or triggers; ours has none"))
    if version == SCHEMA_VERSION:
        verdict = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
        if verdict != "ok":
            raise CatalogError(_damaged(path, verdict))
    elif version == 0:
        create(connection)
    elif version < SCHEMA_VERSION:
        migrate(connection)
    else:
        raise CatalogError(_wrong_version(path, version))


def _migrated_copy(old: sqlite3.Connection) -> sqlite3.Connection:
    """The index in memory, in the schema of this version."""
    copy = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
    old.backup(copy)
    old.close()
    migrate(copy)
    return copy


def _enter_wal(connection: sqlite3.Connection) -> None:
    """Switch to WAL. SQLite answers at once, without its busy time-out, when two do so together."""
    deadline = time.monotonic() + BUSY_TIMEOUT_S
    while True:
        try:
            connection.execute("PRAGMA journal_mode = WAL")
        except sqlite3.OperationalError as error:
            if not _is_busy(error) or time.monotonic() > deadline:
                raise
            time.sleep(BUSY_RETRY_S)
        else:
            return


def _is_busy(error: Exception) -> bool:
    # The low byte is the primary result code; the others say more about it.
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    return code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)


def _damaged(path: Path, finding: object) -> str:
    return f"{path}: damaged ({finding}); recovery sets it aside and rebuilds it from the records"


def _wrong_version(path: Path, version: int) -> str:
    return (
        f"{path}: schema {version}; this version reads {SCHEMA_VERSION} at most (syntopic repair)"
    )

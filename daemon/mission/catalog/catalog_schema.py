"""The schema of a mission's index: how it is created, and how an older one becomes this one.

A schema that was ever released keeps its way to the present: each step is in `_STEPS`, and a step
is never changed once it was released. The records on disk stay what counts.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from typing import Final

SCHEMA_VERSION = 2

DATABASE_ERRORS: Final = (sqlite3.Error, UnicodeDecodeError)
"""What a damaged index raises. SQLite quotes damaged names in its messages, which need not be
UTF-8."""

_SCHEMA = """
CREATE TABLE exposures (
    number INTEGER PRIMARY KEY,
    state TEXT NOT NULL CHECK (state IN ('stored', 'complete', 'degraded', 'lost')),
    is_sealed INTEGER NOT NULL CHECK (is_sealed IN (0, 1)),
    trigger_sequence INTEGER NOT NULL,
    trigger_mono_ns INTEGER NOT NULL,
    boot_id TEXT NOT NULL,
    mark_gps_ns INTEGER,
    mark_sigma_ns INTEGER,
    mark_source TEXT NOT NULL DEFAULT 'none',
    latitude_deg REAL,
    longitude_deg REAL,
    height_m REAL,
    line_id TEXT NOT NULL,
    strip_id TEXT NOT NULL,
    flags INTEGER NOT NULL,
    is_simulated INTEGER NOT NULL,
    record_sha256 TEXT,
    previous_sha256 TEXT,
    seal_order INTEGER UNIQUE
) STRICT;
CREATE TABLE frames (
    number INTEGER NOT NULL REFERENCES exposures (number) ON DELETE CASCADE,
    sensor TEXT NOT NULL,
    file TEXT NOT NULL,
    sha256 TEXT NOT NULL,
    mid_exposure_gps_ns INTEGER,
    PRIMARY KEY (number, sensor)
) STRICT;
CREATE TABLE products (
    number INTEGER NOT NULL,
    file TEXT NOT NULL,
    nbytes INTEGER NOT NULL,
    verdict TEXT,
    PRIMARY KEY (number, file)
) STRICT;
CREATE TABLE events (
    id INTEGER PRIMARY KEY,
    boot_id TEXT NOT NULL,
    mono_ns INTEGER NOT NULL,
    source TEXT NOT NULL,
    name TEXT NOT NULL,
    is_fault INTEGER NOT NULL,
    sentence TEXT NOT NULL
) STRICT;
"""

_STEPS: Mapping[int, tuple[str, ...]] = {
    1: ("ALTER TABLE exposures ADD COLUMN strip_id TEXT NOT NULL DEFAULT ''",),
}
"""From a version to the next one."""


def create(connection: sqlite3.Connection) -> None:
    """Lay the tables out in an empty file; nothing happens where another process was first."""
    connection.execute("BEGIN IMMEDIATE")
    if _version(connection) == 0:
        for statement in filter(str.strip, _SCHEMA.split(";")):
            connection.execute(statement)
        connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
    connection.execute("COMMIT")


def migrate(connection: sqlite3.Connection) -> None:
    """Bring an older schema to this version: all of it or, where it is interrupted, nothing.

    Raises:
        sqlite3.Error: the schema does not match its version; nothing was changed.
    """
    connection.execute("BEGIN IMMEDIATE")
    try:
        # Another process may have been first while this one waited for the lock.
        for version in range(_version(connection), SCHEMA_VERSION):
            for statement in _STEPS[version]:
                connection.execute(statement)
        connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        connection.execute("COMMIT")
    except DATABASE_ERRORS:
        connection.execute("ROLLBACK")
        raise


def has_only_tables(connection: sqlite3.Connection) -> bool:
    """Whether there are tables and indexes only: a foreign view or trigger would run code."""
    kinds = connection.execute("SELECT DISTINCT type FROM sqlite_schema").fetchall()
    return {kind for (kind,) in kinds} <= {"table", "index"}


def _version(connection: sqlite3.Connection) -> int:
    version: int = connection.execute("PRAGMA user_version").fetchone()[0]
    return version

"""`chain.jsonl`: what a mission holds, one line for each file or record as it became durable.

Every line carries a hash over the line before it and itself. A line is written after the file that
it names is durable, so a file that a line names and that is not there was removed. Comparing the
lines with the disk is in `daemon.mission.verification.verification`, completing them after a crash
in `daemon.mission.verification.recovery`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, model_validator

from daemon.mission.canonical_json import (
    RecordError,
    canonical_bytes,
    parse_record,
    sha256_hex,
)
from daemon.mission.record_types import Count, LongText, Ordinal, Sha256, read_record
from daemon.mission.store import durable
from processing.rig.value_types import Name

CHAIN_FILE = "chain.jsonl"
CHAIN_FORMAT: Literal[1] = 1
LINE_MAX_BYTES = 1_000_000
"""No line of ours comes near this; a longer one counts as damaged."""

_KEYS_OF_KINDS = {
    "number": ("stored", "sealed"),
    "log": ("log", "log-sealed"),
    "nbytes": ("log-sealed",),
}
"""Keys that a line of these kinds cannot be without."""
_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class LogSeal:
    """Size and hash of a log that nothing is added to any more."""

    nbytes: Count
    sha256: Sha256 = ""


class _Entry(BaseModel):
    """The keys of a line, apart from its hash."""

    format: Literal[1] = CHAIN_FORMAT
    kind: Literal["begun", "stored", "sealed", "log", "log-sealed", "closed"]
    number: Ordinal | None = None
    log: Name | None = None
    sha256: Sha256 = ""
    nbytes: Count | None = None
    mission_sha256: Sha256 = ""
    rebuilt_utc: LongText = ""

    @model_validator(mode="after")
    def _has_the_keys_of_its_kind(self) -> _Entry:
        for key, kinds in _KEYS_OF_KINDS.items():
            if self.kind in kinds and getattr(self, key) is None:
                raise ValueError(f"{key} is missing; it is needed")
        return self


@dataclass(frozen=True)
class History:
    """Content of a chain file, up to the moment it was read.

    Attributes:
        exists: False where there is no chain file.
        genesis_sha256: hash of mission.json when the file was begun.
        rebuilt_utc: when the file was begun in place of a missing one; empty if it never was.
        stored: by exposure, SHA-256 of capture.json.
        sealed: by exposure, SHA-256 of every exposure.json that was sealed under its number.
        logs: by name, the seal of a log; None while it may still grow.
        closing: content of the closing line, if no line follows it.
        problems: one sentence for each line that is damaged or missing.
        torn_nbytes: bytes after the last whole line.
        nbytes: bytes of all whole lines.
        head_sha256: what the hash of the next line includes.
    """

    exists: bool = False
    genesis_sha256: str = ""
    rebuilt_utc: str = ""
    stored: Mapping[int, str] = field(default_factory=dict)
    sealed: Mapping[int, tuple[str, ...]] = field(default_factory=dict)
    logs: Mapping[str, LogSeal | None] = field(default_factory=dict)
    closing: Mapping[str, Any] | None = None
    problems: tuple[str, ...] = ()
    torn_nbytes: int = 0
    nbytes: int = 0
    head_sha256: str = ""

    @property
    def numbers(self) -> set[int]:
        """Exposures that a line names."""
        return {*self.stored, *self.sealed}


def read_history(path: Path) -> History:
    """Read a chain file that may be damaged, or be appended to at the same time.

    Args:
        path: the chain file.

    Raises:
        OSError: the disk does not give it.
    """
    reader = _Reader()
    try:
        with path.open("rb") as file:
            for line in iter(lambda: file.readline(LINE_MAX_BYTES), b""):
                if not line.endswith(b"\n") and len(line) < LINE_MAX_BYTES:
                    reader.torn_nbytes = len(line)
                    break
                reader.read_line(line)
    except FileNotFoundError:
        return History()
    return reader.history()


def first_line(genesis_sha256: str, *, rebuilt_utc: str = "") -> bytes:
    """The line that a chain file begins with.

    Args:
        genesis_sha256: hash of mission.json.
        rebuilt_utc: given where it replaces a lost file.
    """
    entry: dict[str, Any] = {
        "kind": "begun",
        "format": CHAIN_FORMAT,
        "mission_sha256": genesis_sha256,
    }
    if rebuilt_utc:
        entry["rebuilt_utc"] = rebuilt_utc
    return _line(entry, "")[0]


class ChainFile:
    """Appends to the chain file of a mission; for the one process that holds the mission.

    A line is durable on return. What is in the file already is not written again. A mission laid
    out by hand has no chain file and does not get one.

    Args:
        mission_path: the mission's folder.
        genesis_sha256: hash of its mission.json; empty for a mission laid out by hand.
        is_expected: whether the mission was created with a chain file, so that a missing one was
            removed.

    Raises:
        OSError: the disk refused.
    """

    def __init__(self, mission_path: Path, genesis_sha256: str, *, is_expected: bool) -> None:
        self.sealed_logs: set[str] = set()
        self._descriptor: int | None = None
        self._known: set[bytes] = set()
        self.history = History()
        self.cut_nbytes = 0
        self.is_new = False
        if not genesis_sha256:
            return
        path = mission_path / CHAIN_FILE
        self.history = read_history(path)
        self.is_new = not self.history.exists or not self.history.nbytes
        if self.is_new:
            rebuilt_utc = utc_now_text() if is_expected else ""
            durable.replace_file(path, first_line(genesis_sha256, rebuilt_utc=rebuilt_utc))
            self.history = read_history(path)
        self._descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        self._offset = self.history.nbytes
        self._head_sha256 = self.history.head_sha256
        self.cut_nbytes = self.history.torn_nbytes
        if self.cut_nbytes:
            os.ftruncate(self._descriptor, self._offset)
            os.fdatasync(self._descriptor)
        self._known = set(_entries_of(self.history))
        self.sealed_logs = {name for name, seal in self.history.logs.items() if seal is not None}

    def stored(self, number: int, sha256: str) -> None:
        """Note that an exposure's folder is durable; `sha256` is that of its capture.json."""
        self._append({"kind": "stored", "number": number, "sha256": sha256})

    def sealed(self, number: int, sha256: str) -> None:
        """Note that an exposure's record is durable; `sha256` is that of its exposure.json."""
        self._append({"kind": "sealed", "number": number, "sha256": sha256})

    def log_begun(self, name: str) -> None:
        """Note that a flight log exists."""
        self._append({"kind": "log", "log": name})

    def log_sealed(self, name: str, seal: LogSeal) -> None:
        """Note that nothing is added to a flight log any more."""
        content = {"log": name, "nbytes": seal.nbytes, "sha256": seal.sha256}
        self._append({"kind": "log-sealed", **content})
        self.sealed_logs.add(name)

    def close_run(self, by: str, files: Mapping[str, str]) -> bool:
        """Note that a run ended; nothing happens where the last line already records it.

        Args:
            by: "landing" or "repair".
            files: SHA-256 by name of files that could change until now.

        Returns:
            Whether a line was written.
        """
        self.history = self._reread()
        if self._descriptor is None or self.history.closing is not None:
            return False
        content = {"by": by, "utc": utc_now_text(), "files": dict(files)}
        self._append({"kind": "closed", "sealed": len(self.history.sealed), **content})
        return True

    def close(self) -> None:
        """Close the file; may be called twice."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def _reread(self) -> History:
        if self._descriptor is None:
            return self.history
        return read_history(Path(f"/proc/self/fd/{self._descriptor}"))

    def _append(self, entry: Mapping[str, Any]) -> None:
        key = canonical_bytes(entry)
        if self._descriptor is None or key in self._known:
            return
        line, sha256 = _line(entry, self._head_sha256)
        try:
            written = 0
            while written < len(line):
                written += os.pwrite(self._descriptor, line[written:], self._offset + written)
            os.fdatasync(self._descriptor)
        except OSError:
            # The next attempt writes the same line at the same place.
            with suppress(OSError):
                os.ftruncate(self._descriptor, self._offset)
            raise
        self._offset += len(line)
        self._head_sha256 = sha256
        self._known.add(key)


def utc_now_text() -> str:
    """The present UTC, to the second."""
    return f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}"


def _line(entry: Mapping[str, Any], previous_sha256: str) -> tuple[bytes, str]:
    """A line and its hash, which covers the hash of the line before it and the entry."""
    sha256 = sha256_hex(previous_sha256.encode("ascii") + canonical_bytes(entry))
    return canonical_bytes({"entry": entry, "sha256": sha256}), sha256


def _entries_of(history: History) -> Iterator[bytes]:
    """The entries that are not to be written a second time."""
    for number, sha256 in history.stored.items():
        yield canonical_bytes({"kind": "stored", "number": number, "sha256": sha256})
    for number, hashes in history.sealed.items():
        for sha256 in hashes:
            yield canonical_bytes({"kind": "sealed", "number": number, "sha256": sha256})
    for name, seal in history.logs.items():
        yield canonical_bytes({"kind": "log", "log": name})
        if seal is not None:
            content = {"log": name, "nbytes": seal.nbytes, "sha256": seal.sha256}
            yield canonical_bytes({"kind": "log-sealed", **content})


class _Reader:
    """Takes line after line and goes on behind a damaged one."""

    def __init__(self) -> None:
        self.torn_nbytes = 0
        self._genesis_sha256 = ""
        self._rebuilt_utc = ""
        self._stored: dict[int, str] = {}
        self._sealed: dict[int, tuple[str, ...]] = {}
        self._logs: dict[str, LogSeal | None] = {}
        self._closing: Mapping[str, Any] | None = None
        self._problems: list[str] = []
        self._head_sha256 = ""
        self._count = 0
        self._nbytes = 0

    def read_line(self, line: bytes) -> None:
        self._count += 1
        self._nbytes += len(line)
        name = f"{CHAIN_FILE}, line {self._count}"
        try:
            content = parse_record(line, name)
        except RecordError:
            content = {}
        entry, claimed = content.get("entry"), content.get("sha256")
        is_ours = (
            isinstance(entry, dict) and isinstance(claimed, str) and _SHA256.fullmatch(claimed)
        )
        if not is_ours or not isinstance(entry, dict):
            self._problems.append(f"{name}: was altered; it is no line of a chain")
            self._head_sha256 = sha256_hex(line)
            return
        expected, sha256 = _expected(entry, self._head_sha256)
        if line != expected:
            damage = "was altered, or lines before it were removed"
            self._problems.append(f"{name}: {damage}; its hash does not fit")
        self._head_sha256 = str(claimed) if line != expected else sha256
        self._closing = None
        self._note(entry, name)

    def history(self) -> History:
        if not self._genesis_sha256:
            self._problems.append(f"{CHAIN_FILE}: its first line is missing")
        return History(
            exists=True,
            genesis_sha256=self._genesis_sha256,
            rebuilt_utc=self._rebuilt_utc,
            stored=self._stored,
            sealed=self._sealed,
            logs=self._logs,
            closing=self._closing,
            problems=tuple(self._problems),
            torn_nbytes=self.torn_nbytes,
            nbytes=self._nbytes,
            head_sha256=self._head_sha256,
        )

    def _note(self, entry: Mapping[str, Any], name: str) -> None:
        try:
            line = read_record(_Entry, entry, name)
        except RecordError as error:
            self._problems += error.problems
            return
        if line.kind == "begun":
            self._genesis_sha256 = line.mission_sha256
            self._rebuilt_utc = line.rebuilt_utc
        elif line.kind == "closed":
            self._closing = entry
        elif line.kind == "stored" and line.number:
            self._stored[line.number] = line.sha256
        elif line.kind == "sealed" and line.number:
            self._sealed[line.number] = (*self._sealed.get(line.number, ()), line.sha256)
        elif line.log:
            seal = None if line.nbytes is None else LogSeal(line.nbytes, line.sha256)
            self._logs[line.log] = seal if line.kind == "log-sealed" else None


def _expected(entry: Mapping[str, Any], previous_sha256: str) -> tuple[bytes, str]:
    try:
        return _line(entry, previous_sha256)
    except RecordError:
        return b"", ""

"""One exposure's folder checked against chain file, index and its own record.

Every exposure is checked on its own: a damaged one does not block others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from daemon.mission.canonical_json import RecordError
from daemon.mission.catalog.catalog import IndexedExposure
from daemon.mission.exposure import FrameRecord
from daemon.mission.store import durable
from daemon.mission.store.level0_folder import (
    CAPTURE_FILE,
    EXPOSURE_FILE,
    hash_file,
    read_capture,
    read_sealed,
)
from daemon.mission.verification.chain_file import CHAIN_FILE
from daemon.mission.verification.inventory import UNFINISHED

ByteProgress = Callable[[int], None]


@dataclass(frozen=True)
class ExpectedExposure:
    """Expected state of an exposure, before its folder is read.

    `names` are the plain files and folders in it, `odd` links and pipes, which are not opened;
    `record_sha256` are the hashes of all records that were sealed under its number; `is_chained`
    is False for a mission laid out by hand.
    """

    number: int
    folder: Path
    names: Sequence[str]
    is_there: bool
    special_files: Sequence[str]
    capture_sha256: str
    record_sha256: tuple[str, ...]
    indexed: IndexedExposure | None
    has_chain_file: bool
    is_chained: bool
    is_flown: bool


@dataclass
class FoundExposure:
    """Content of its folder. `covered` names files by their kind and the place of their hash."""

    number: int
    name: str
    is_there: bool = True
    is_readable: bool = True
    record_sha256: str = ""
    previous_sha256: str = ""
    frames: dict[str, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    covered: dict[tuple[str, str], list[str]] = field(default_factory=dict)
    not_covered: dict[str, str] = field(default_factory=dict)

    def add_problem(self, sentence: str) -> None:
        self.problems.append(f"exposure {self.number}: {sentence}")


def check_exposure(expected: ExpectedExposure, step: ByteProgress) -> FoundExposure:
    """Compare a folder; `step` is called with the number of bytes read."""
    found = FoundExposure(expected.number, expected.folder.name)
    if not expected.is_there:
        return _check_missing_folder(expected, found)
    frames = _read_records(expected, found)
    _check_record(expected, found)
    _check_capture(expected, found)
    _check_frames(expected, found, frames, step)
    _check_names(expected, found, frames)
    return found


def _check_missing_folder(expected: ExpectedExposure, found: FoundExposure) -> FoundExposure:
    found.is_there = False
    in_chain = expected.capture_sha256 or expected.record_sha256
    evidence = [CHAIN_FILE] * bool(in_chain) + ["the index"] * (expected.indexed is not None)
    if evidence:
        found.add_problem(f"is in {' and '.join(evidence)} but its folder is gone")
    return found


def _read_records(expected: ExpectedExposure, found: FoundExposure) -> tuple[FrameRecord, ...]:
    """The frames that the record names or, where it is not there or unusable, the capture."""
    frames: tuple[FrameRecord, ...] = ()
    if {EXPOSURE_FILE, CAPTURE_FILE}.intersection(expected.special_files):
        found.is_readable = False
        return frames
    try:
        record = read_sealed(expected.folder)
        if record is not None:
            found.record_sha256 = record.sha256
            found.previous_sha256 = record.exposure.previous_sha256
            frames = record.exposure.frames
    except RecordError as error:
        record = None
        found.is_readable = False
        found.problems += error.problems
    try:
        capture = read_capture(expected.folder)
        if record is None and capture is not None:
            frames = capture.frames
    except RecordError as error:
        found.problems += error.problems
        found.is_readable = found.is_readable and record is not None
    found.frames = {frame.sensor: frame.sha256 for frame in frames}
    return frames


def _check_record(expected: ExpectedExposure, found: FoundExposure) -> None:
    is_there = EXPOSURE_FILE in expected.names
    sealed = list(expected.record_sha256)
    if not sealed and expected.indexed is not None and expected.indexed.record_sha256:
        sealed = [expected.indexed.record_sha256]
    if len(set(sealed)) > 1:
        found.add_problem(
            "was sealed more than once; the record sealed first was removed or altered"
        )
    if sealed and not is_there:
        found.add_problem("was sealed but its record is gone")
    if not is_there:
        return
    by = CHAIN_FILE if expected.record_sha256 else "the next record, the last one: the index"
    if not expected.is_chained:
        found.not_covered[EXPOSURE_FILE] = "record of a mission laid out by hand, without a chain"
    elif not expected.record_sha256 and expected.has_chain_file:
        found.not_covered[EXPOSURE_FILE] = UNFINISHED
        if not expected.is_flown:
            found.add_problem(
                f"its record is not in {CHAIN_FILE}; one of them was altered by others"
            )
    else:
        found.covered["exposure records", by] = [EXPOSURE_FILE]
    if sealed and found.record_sha256 and found.record_sha256 not in sealed:
        found.add_problem("its record differs from what was sealed")


def _check_capture(expected: ExpectedExposure, found: FoundExposure) -> None:
    is_there = CAPTURE_FILE in expected.names
    if expected.capture_sha256:
        if not is_there:
            found.add_problem(f"{CAPTURE_FILE} is missing")
            return
        found.covered["capture records", CHAIN_FILE] = [CAPTURE_FILE]
        try:
            if hash_file(expected.folder / CAPTURE_FILE) != expected.capture_sha256:
                found.add_problem(f"{CAPTURE_FILE} differs from what was stored")
        except OSError as error:
            found.add_problem(f"{CAPTURE_FILE} cannot be read ({error.strerror})")
    elif is_there and expected.has_chain_file:
        found.not_covered[CAPTURE_FILE] = UNFINISHED
        if not expected.is_flown:
            found.add_problem(f"is not in {CHAIN_FILE}; one of them was altered by others")
    elif is_there:
        found.not_covered[CAPTURE_FILE] = "capture record of format 1, without a hash"


def _check_frames(
    expected: ExpectedExposure,
    found: FoundExposure,
    frames: Sequence[FrameRecord],
    step: ByteProgress,
) -> None:
    by = EXPOSURE_FILE if found.record_sha256 else CAPTURE_FILE
    for frame in frames:
        path = expected.folder / (frame.file or f"{frame.sensor}.tif")
        where = f"exposure {expected.folder.name}, {path.name}"
        if path.name not in expected.names:
            found.problems.append(f"{where}: is missing; according to its record it was stored")
            continue
        try:
            sha256 = hash_file(path, step)
        except OSError as error:
            found.problems.append(f"{where}: cannot be read ({error.strerror})")
            continue
        if not frame.sha256:
            found.not_covered[path.name] = "frame without a hash in its record"
            continue
        found.covered.setdefault(("frames", by), []).append(path.name)
        if sha256 != frame.sha256:
            found.problems.append(f"{where}: was altered; its hash differs from the record's")


def _check_names(
    expected: ExpectedExposure, found: FoundExposure, frames: Sequence[FrameRecord]
) -> None:
    """Level-0 is immutable: what no record names was added later."""
    named = {EXPOSURE_FILE, CAPTURE_FILE}
    named |= {frame.file or f"{frame.sensor}.tif" for frame in frames}
    for name in expected.names:
        if name in named:
            continue
        if durable.is_part_of(name, EXPOSURE_FILE) and expected.is_flown:
            found.not_covered[name] = UNFINISHED
        elif not expected.is_chained and not frames:
            found.not_covered[name] = "frame without a hash in its record"
        elif found.is_readable:
            found.problems.append(
                f"exposure {expected.folder.name}, {name}: is not in the record; Level-0 is "
                "immutable"
            )

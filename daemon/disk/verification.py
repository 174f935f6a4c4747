"""Is what a mission folder holds still what was stored: hashes, chain of records, index, logs.

Hashes several exposures at a time, and reads only. What it finds is told in sentences; putting
things right is in `daemon.disk.recovery`.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from daemon.disk.catalog import Catalog, CatalogError
from daemon.disk.chain import Link, follow_chain
from daemon.disk.level0_folder import (
    CAPTURE_FILE,
    EXPOSURE_FILE,
    SealedRecord,
    hash_file,
    read_capture,
    read_sealed,
)
from daemon.disk.log_seals import check_logs
from daemon.disk.mission import DISCARDED, Mission
from daemon.disk.records import RecordError
from daemon.exposure import FrameRecord

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class VerifyReport:
    """What was checked, and one sentence for everything that is not as it was stored."""

    exposures: int
    frames: int
    nbytes: int
    problems: tuple[str, ...]

    @property
    def is_well(self) -> bool:
        return not self.problems


def verify(mission: Mission, progress: Progress = lambda done, total: None) -> VerifyReport:
    """Check every frame and record of a mission.

    A mission laid out by hand has no index and no chain; there only hashes that are given count.

    Args:
        mission: it may be flown at the same time; what is not sealed yet is checked as stored.
        progress: told bytes done and bytes in total.
    """
    numbers = mission.numbers()
    total = sum(_folder_nbytes(mission.level0(number)) for number in numbers)
    done = 0
    counting = threading.Lock()

    def step(count: int) -> None:
        nonlocal done
        with counting:
            done += count
            progress(done, max(total, done))

    problems = _odd_entries(mission)
    sealed: dict[int, SealedRecord] = {}
    frames: dict[int, tuple[FrameRecord, ...]] = {}
    for number in numbers:
        try:
            record = read_sealed(mission.level0(number))
            capture = read_capture(mission.level0(number))
        except RecordError as error:
            problems += error.problems
            continue
        if record is not None:
            sealed[number] = record
        frames[number] = record.exposure.frames if record else capture.frames if capture else ()
    # Hashing lets go of the interpreter, so that threads are enough to use every core.
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        folders = [mission.level0(number) for number in frames]
        for found in pool.map(lambda f, n: _check_folder(f, n, step), folders, frames.values()):
            problems += found
    problems += check_logs(mission, step)
    genesis = mission.genesis_sha256()
    if genesis:
        links = [Link(n, r.sha256, r.exposure.previous_sha256) for n, r in sealed.items()]
        problems += follow_chain(links, genesis).problems
        problems += _check_index(mission, sealed, frames)
    count = sum(len(named) for named in frames.values())
    return VerifyReport(len(numbers), count, done, tuple(problems))


def _check_folder(
    folder: Path, frames: tuple[FrameRecord, ...], step: Callable[[int], None]
) -> list[str]:
    problems = []
    expected = {EXPOSURE_FILE, CAPTURE_FILE}
    for frame in frames:
        path = folder / (frame.file or f"{frame.sensor}.tif")
        expected.add(path.name)
        where = f"exposure {folder.name}, {path.name}"
        try:
            found = hash_file(path, step)
        except FileNotFoundError:
            problems.append(f"{where}: is missing; its record says it was stored")
        except OSError as error:
            problems.append(f"{where}: cannot be read ({error.strerror})")
        else:
            if frame.sha256 and found != frame.sha256:
                problems.append(f"{where}: was altered; its hash differs from the record's")
    if frames:
        extra = sorted(entry.name for entry in os.scandir(folder) if entry.name not in expected)
        problems += [
            f"exposure {folder.name}, {name}: is not in the record; Level-0 is immutable"
            for name in extra
        ]
    return problems


def _check_index(
    mission: Mission,
    sealed: dict[int, SealedRecord],
    frames: dict[int, tuple[FrameRecord, ...]],
) -> list[str]:
    try:
        catalog = Catalog.read(mission.catalog_path)
    except CatalogError as error:
        return [str(error)]
    try:
        rows = {row.number: row for row in catalog.exposures()}
        problems = [
            f"exposure {number}: is in the index but its folder is gone"
            for number in rows
            if not mission.level0(number).is_dir()
        ]
        for number, named in frames.items():
            row = rows.get(number)
            record = sealed.get(number)
            if row is None:
                problems.append(f"exposure {number}: has a folder but no row in the index")
            elif record is not None and row.record_sha256 != record.sha256:
                problems.append(f"exposure {number}: its record differs from what was sealed")
            elif record is None and row.is_sealed:
                problems.append(f"exposure {number}: was sealed but its record is gone")
            elif catalog.frames(number) != {f.sensor: f.sha256 for f in named}:
                problems.append(f"exposure {number}: index and record name different frames")
        return problems
    finally:
        catalog.close()


def _odd_entries(mission: Mission) -> list[str]:
    known = {mission.level0(number).name for number in mission.numbers()} | {DISCARDED}
    odd = sorted(e.name for e in os.scandir(mission.level0_root) if e.name not in known)
    return [
        f"L0/{name}: is no exposure; recovery on start sees to what is unfinished" for name in odd
    ]


def _folder_nbytes(folder: Path) -> int:
    return sum(entry.stat().st_size for entry in os.scandir(folder) if entry.name.endswith(".tif"))

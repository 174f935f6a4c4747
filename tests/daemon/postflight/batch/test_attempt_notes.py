"""What the benchmark of killed workers concludes from its notes."""

from __future__ import annotations

from pathlib import Path

from benchmarks.attempt_notes import (
    BEGUN,
    COMMITTED,
    SCHEDULER_KILLED,
    STOPPED,
    WORKER_KILLED,
    WRITE_FAILED,
    NoteFile,
    attempts_of,
    read_notes,
    repeated,
    violations,
)


def noted(path: Path, *lines: tuple[int, int, str]) -> Path:
    notes = NoteFile(path)
    for number, process, event in lines:
        notes.add(number, event, process)
    return path


def test_each_repeated_computation_is_explained_by_its_own_kill_or_failed_write(
    tmp_path: Path,
) -> None:
    path = noted(
        tmp_path / "notes",
        (1, 10, BEGUN), (2, 11, BEGUN), (0, 10, WORKER_KILLED), (2, 11, WRITE_FAILED),
        (1, 12, BEGUN), (1, 12, COMMITTED), (2, 11, BEGUN), (2, 11, COMMITTED),
        (3, 12, BEGUN), (3, 12, "recognized"), (4, 12, BEGUN), (0, 9, SCHEDULER_KILLED),
        (4, 11, BEGUN), (4, 11, COMMITTED), (5, 13, BEGUN), (0, 1, STOPPED),
        (5, 11, BEGUN), (5, 11, COMMITTED),
    )  # fmt: skip
    attempts = attempts_of(read_notes(path))
    ends = {number: [one.end for one in them] for number, them in repeated(attempts).items()}
    assert ends == {
        1: [WORKER_KILLED, COMMITTED],
        2: [WRITE_FAILED, COMMITTED],
        4: [SCHEDULER_KILLED, COMMITTED],
        5: [STOPPED, COMMITTED],
    }
    assert violations(attempts) == []


def test_what_no_kill_explains_is_named(tmp_path: Path) -> None:
    path = noted(
        tmp_path / "notes",
        (1, 10, BEGUN), (1, 11, BEGUN), (1, 11, COMMITTED),
        (2, 11, BEGUN), (2, 11, COMMITTED), (2, 12, BEGUN), (2, 12, COMMITTED),
        (3, 13, BEGUN), (4, 13, BEGUN), (0, 13, WORKER_KILLED),
    )  # fmt: skip
    assert violations(attempts_of(read_notes(path))) == [
        "exposure 1: computed again after an attempt that ended: unexplained",
        "exposure 2: committed 2 times",
        "exposure 2: computed again after an attempt that ended: committed",
        "process 13: its kill cost 2 exposures",
    ]

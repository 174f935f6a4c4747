"""What the benchmark of killed workers concludes from its notes."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

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
from tests.daemon.diverging_camera import ROOT


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
    assert violations(attempts, 2) == []


def test_what_no_kill_explains_is_named(tmp_path: Path) -> None:
    path = noted(
        tmp_path / "notes",
        (1, 10, BEGUN), (1, 11, BEGUN), (1, 11, COMMITTED),
        (2, 11, BEGUN), (2, 11, COMMITTED), (2, 12, BEGUN), (2, 12, COMMITTED),
        (3, 13, BEGUN), (4, 13, BEGUN), (0, 13, WORKER_KILLED),
    )  # fmt: skip
    assert violations(attempts_of(read_notes(path)), 2) == [
        "exposure 1: computed again after an attempt that ended: unexplained",
        "exposure 2: committed 2 times",
        "exposure 2: computed again after an attempt that ended: committed",
        "process 13: its kill cost 2 exposures",
    ]


def test_a_scheduler_kill_explains_no_attempt_that_its_process_had_left(tmp_path: Path) -> None:
    path = noted(
        tmp_path / "notes",
        (1, 10, BEGUN), (2, 10, BEGUN), (0, 9, SCHEDULER_KILLED),
        (1, 11, BEGUN), (1, 11, COMMITTED), (2, 11, BEGUN), (2, 11, COMMITTED),
        (3, 12, BEGUN), (3, 12, COMMITTED), (3, 11, BEGUN), (3, 11, COMMITTED),
        (4, 13, BEGUN), (4, 11, BEGUN), (4, 11, COMMITTED),
    )  # fmt: skip
    assert violations(attempts_of(read_notes(path)), 8) == [
        "exposure 1: computed again after an attempt that ended: unexplained",
        "exposure 3: committed 2 times",
        "exposure 3: computed again after an attempt that ended: committed",
        "exposure 4: computed again after an attempt that ended: unexplained",
    ]


def test_a_scheduler_kill_explains_as_many_attempts_as_there_are_workers(tmp_path: Path) -> None:
    lost = [(number, 10 + number, BEGUN) for number in (1, 2, 3)]
    again = [(n, 20, event) for n in (1, 2, 3) for event in (BEGUN, COMMITTED)]
    path = noted(tmp_path / "notes", *lost, (0, 9, SCHEDULER_KILLED), *again)
    attempts = attempts_of(read_notes(path))
    assert violations(attempts, 3) == []
    assert violations(attempts, 2) == [
        "scheduler killed, note 3: cost 3 exposures; 2 workers had at most 2"
    ]
    # Of two kills, each explains those that were in work at its time.
    path = noted(
        tmp_path / "two",
        (1, 11, BEGUN), (2, 12, BEGUN), (0, 9, SCHEDULER_KILLED),
        (3, 13, BEGUN), (4, 14, BEGUN), (0, 9, SCHEDULER_KILLED),
        *[(n, 20, event) for n in (1, 2, 3, 4) for event in (BEGUN, COMMITTED)],
    )  # fmt: skip
    assert violations(attempts_of(read_notes(path)), 2) == []


def test_what_was_measured_or_planned_and_does_not_hold_is_a_problem() -> None:
    killed_workers = pytest.importorskip("benchmarks.killed_workers")
    calm = {"ratio": 1.18, "bound": 1.18}
    killed = {"worker_kills": 5, "scheduler_kills": 2, "failures": []}
    planned = {"worker_kills": 5, "scheduler_kills": 2}
    assert killed_workers.shortfalls(calm, killed, planned) == []
    slow = killed_workers.shortfalls({**calm, "ratio": 1.19}, killed, planned)
    fewer = killed_workers.shortfalls(calm, {**killed, "worker_kills": 4}, planned)
    failed = killed_workers.shortfalls(calm, {**killed, "failures": ["no answer"]}, planned)
    assert len(slow) == 1 and "1.19" in slow[0]
    assert fewer == ["worker_kills: 4 of 5 planned"]
    assert failed == ["1 exposures failed: no answer"]


def test_the_command_of_the_record_has_only_options_there_are() -> None:
    pytest.importorskip("distributed")
    record = json.loads((ROOT / "benchmarks/records/killed-workers.json").read_text())
    words = shlex.split(record["command"])
    help_command = [sys.executable, *words[1:3], "--help"]
    done = subprocess.run(help_command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert [word for word in words if word.startswith("--") and word not in done.stdout] == []

"""Notes of a run whose parts are killed: what became of each attempt at an exposure.

Worker processes and the program that kills them add lines to one file: number of the exposure,
event, process. A line is one write(2) with O_APPEND, so that lines of many processes do not mix.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

BEGUN: Final = "begun"
COMMITTED: Final = "committed"
WRITE_FAILED: Final = "write failed"
NOT_COMPUTED: Final = frozenset({"recognized", "claimed elsewhere", "read failed"})
"""Ends of an attempt in which nothing was computed."""
ENDS: Final = NOT_COMPUTED | {COMMITTED, "committed before", WRITE_FAILED, "failed"}
WORKER_KILLED: Final = "worker killed"
SCHEDULER_KILLED: Final = "scheduler killed"
STOPPED: Final = "stopped"
"""The command was interrupted, to be continued."""


@dataclass(frozen=True)
class Note:
    """One line; `number` is 0 where no exposure is concerned."""

    number: int
    event: str
    process: int


@dataclass(frozen=True)
class Attempt:
    """One computation of an exposure by a process, and how it ended.

    `cause` is the index of the note that explains the end, where it is not of the process.
    """

    number: int
    process: int
    end: str
    cause: int = -1


class NoteFile:
    """Adds lines to the file of a run.

    Args:
        path: of the file; it is created.
    """

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)

    def add(self, number: int, event: str, process: int | None = None) -> None:
        """Add a line.

        Args:
            number: of the exposure, or 0.
            event: what happened.
            process: its id; None is this one.
        """
        line = f"{number} {os.getpid() if process is None else process} {event}\n"
        os.write(self._descriptor, line.encode())


def read_notes(path: Path) -> list[Note]:
    """All lines of a file in their order; none where it does not exist."""
    if not path.exists():
        return []
    lines = (line.split(" ", 2) for line in path.read_text().splitlines())
    return [Note(int(number), event, int(process)) for number, process, event in lines]


def attempts_of(notes: Sequence[Note]) -> list[Attempt]:
    """The computations of a run in the order of their begin.

    An attempt without an end of its own is explained by the kill of its process, or by the first
    kill of a scheduler or interruption of the command while it was the last one of its process;
    otherwise its end is "unexplained".

    Args:
        notes: in their order.
    """
    found: list[Attempt] = []
    for index, note in enumerate(notes):
        if note.event != BEGUN:
            continue
        later = notes[index + 1 :]
        end = _own_end(note, later)
        if end in NOT_COMPUTED:
            continue
        if end:
            found.append(Attempt(note.number, note.process, end))
        else:
            other, offset = _other_end(note, later)
            cause = -1 if offset < 0 else index + 1 + offset
            found.append(Attempt(note.number, note.process, other, cause))
    return found


def repeated(attempts: Iterable[Attempt]) -> dict[int, list[Attempt]]:
    """The attempts of each exposure that has more than one."""
    of: dict[int, list[Attempt]] = {}
    for attempt in attempts:
        of.setdefault(attempt.number, []).append(attempt)
    return {number: list(them) for number, them in of.items() if len(them) > 1}


def violations(attempts: Sequence[Attempt], workers: int) -> list[str]:
    """What the kills and failed writes of a run do not explain, one sentence each.

    A kill of the scheduler costs at most what was in work: one exposure for each worker.

    Args:
        attempts: of the run.
        workers: their number.
    """
    sentences = []
    for number, them in sorted(repeated(attempts).items()):
        ends = [attempt.end for attempt in them]
        if ends.count(COMMITTED) > 1:
            sentences.append(f"exposure {number}: committed {ends.count(COMMITTED)} times")
        if unexplained := [end for end in ends[:-1] if end in ("unexplained", "failed", COMMITTED)]:
            sentences.append(
                f"exposure {number}: computed again after an attempt that ended: "
                + ", ".join(unexplained)
            )
    lost = Counter(a.process for a in attempts if a.end == WORKER_KILLED)
    sentences += [
        f"process {process}: its kill cost {count} exposures"
        for process, count in lost.items()
        if count > 1
    ]
    in_work = Counter(
        (a.end, a.cause) for a in attempts if a.end in (SCHEDULER_KILLED, STOPPED) and a.cause >= 0
    )
    sentences += [
        f"{end}, note {cause}: cost {count} exposures; {workers} workers had at most {workers}"
        for (end, cause), count in in_work.items()
        if count > workers
    ]
    return sentences


def _own_end(begun: Note, later: Iterable[Note]) -> str:
    """How the process itself ended the attempt; empty where it did not."""
    for note in later:
        if note.process == begun.process and note.number == begun.number:
            return note.event if note.event in ENDS else ""
        if note.process == begun.process and note.event == BEGUN:
            return ""
    return ""


def _other_end(begun: Note, later: Sequence[Note]) -> tuple[str, int]:
    """What ended the attempt in place of its process, and the index of that note in `later`."""
    for offset, note in enumerate(later):
        if note.event == WORKER_KILLED and note.process == begun.process:
            return WORKER_KILLED, offset
    for offset, note in enumerate(later):
        if note.event == BEGUN and note.process == begun.process:
            break  # the process computed something else: nothing had ended it
        if note.event in (SCHEDULER_KILLED, STOPPED):
            return note.event, offset
    return "unexplained", -1

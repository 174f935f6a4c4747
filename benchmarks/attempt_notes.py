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
    """One computation of an exposure by a process, and how it ended."""

    number: int
    process: int
    end: str


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

    An attempt without an end of its own is explained by the kill of its process, by the kill of a
    scheduler after its begin, or by an interruption of the command after it; otherwise its end is
    "unexplained".

    Args:
        notes: in their order.
    """
    found: list[Attempt] = []
    for index, note in enumerate(notes):
        if note.event != BEGUN:
            continue
        later = notes[index + 1 :]
        end = _own_end(note, later)
        if end not in NOT_COMPUTED:
            found.append(Attempt(note.number, note.process, end or _other_end(note, later)))
    return found


def repeated(attempts: Iterable[Attempt]) -> dict[int, list[Attempt]]:
    """The attempts of each exposure that has more than one."""
    of: dict[int, list[Attempt]] = {}
    for attempt in attempts:
        of.setdefault(attempt.number, []).append(attempt)
    return {number: list(them) for number, them in of.items() if len(them) > 1}


def violations(attempts: Sequence[Attempt]) -> list[str]:
    """What the kills and failed writes of a run do not explain, one sentence each.

    Args:
        attempts: of the run.
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
    return sentences


def _own_end(begun: Note, later: Iterable[Note]) -> str:
    """How the process itself ended the attempt; empty where it did not."""
    for note in later:
        if note.process == begun.process and note.number == begun.number:
            return note.event if note.event in ENDS else ""
        if note.process == begun.process and note.event == BEGUN:
            return ""
    return ""


def _other_end(begun: Note, later: Iterable[Note]) -> str:
    events = {note.event for note in later if note.event != WORKER_KILLED}
    if any(note.event == WORKER_KILLED and note.process == begun.process for note in later):
        return WORKER_KILLED
    return next((end for end in (SCHEDULER_KILLED, STOPPED) if end in events), "unexplained")

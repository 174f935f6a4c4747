"""Which disks hold a mission, and since when: `disks.json` in each copy of a mirrored mission.

Each time a disk is dropped or joins, a new generation with the disks that belong to it is written
durably before anything more is called stored. The history decides which of two copies leads.
"""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, Field

from daemon.mission.canonical_json import canonical_bytes, parse_record
from daemon.mission.record_types import Count, Ordinal, read_record
from daemon.mission.store import durable
from processing.rig.value_types import Name

STATE_FILE = "disks.json"
STATE_FORMAT = 1


@dataclass(frozen=True)
class Generation:
    """A period in which the same disks held the mission.

    `token` is random: two diverged disks may have the same count, but never the same token.
    `disks` are ids (`daemon.mission.store.disk_identity`), `first` is the number of the first
    exposure that that may be missing on a disk dropped at the beginning of this generation.
    """

    number: Ordinal
    token: Name
    disks: tuple[Name, ...] = ()
    first: Count = 1


class _History(BaseModel):
    format: Count
    generations: Annotated[tuple[Generation, ...], Field(min_length=1)]


Generations = tuple[Generation, ...]
"""Generations of a copy, oldest first; empty for a mission that was never mirrored."""


def next_generation(history: Generations, disks: Sequence[str], first: int) -> Generations:
    """The history with a new generation of these disks at its end."""
    number = 1 + (history[-1].number if history else 0)
    return (*history, Generation(number, secrets.token_hex(8), tuple(disks), first))


def is_up_to_date_with(history: Generations, other: Generations) -> bool:
    """Whether a copy knows all that another knows: the other's last generation is in its history.

    Both lead where they are in step; neither where each went on without the other.
    """
    return not other or other[-1].token in {generation.token for generation in history}


def first_difference(outdated: Generations, leading: Generations) -> int:
    """Number of the first exposure of the leading copy that may be missing in the other."""
    since = leading[len(outdated) :]
    return min((generation.first for generation in since), default=1)


def read_generations(mission: Path) -> Generations:
    """The history of a copy; empty where there is none.

    Raises:
        RecordError: the file is damaged.
        OSError: the disk refused.
    """
    try:
        content = parse_record((mission / STATE_FILE).read_bytes(), STATE_FILE)
    except FileNotFoundError:
        return ()
    return read_record(_History, content, STATE_FILE).generations


def write_generations(mission: Path, history: Generations) -> None:
    """Write the history of a copy; it is durable on return.

    Raises:
        OSError: the disk refused; the earlier one is still there.
    """
    generations: list[dict[str, Any]] = [
        {"number": g.number, "token": g.token, "disks": list(g.disks), "first": g.first}
        for g in history
    ]
    content = {"format": STATE_FORMAT, "generations": generations}
    durable.replace_file(mission / STATE_FILE, canonical_bytes(content))

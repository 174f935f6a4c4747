"""Bring two copies of a mission together on the ground: what `syntopic repair --mirror` does.

In flight the same is done by `daemon.mission.mirror.disk_rejoin`.
"""

from __future__ import annotations

from collections.abc import Callable

from daemon.mission.layout import CURRENT_FILE, Mission
from daemon.mission.mirror.generations import (
    first_difference,
    is_up_to_date_with,
    next_generation,
    read_generations,
    write_generations,
)
from daemon.mission.mirror.mirror_startup import copy_missing_tail
from daemon.mission.mirror.resync import MirrorError, Resync, refuse_split
from daemon.mission.store import durable
from daemon.mission.store.disk_identity import give_disk_id


def leading_first(one: Mission, other: Mission) -> tuple[Mission, Mission]:
    """Two copies of one mission, that which leads first.

    Raises:
        MirrorError: they are not copies of one mission, or each went on without the other.
        RecordError: a history is damaged.
    """
    if one.id != other.id or one.genesis_sha256() != other.genesis_sha256():
        raise MirrorError(f"{one.path} and {other.path} are not copies of one mission")
    if one.path.resolve() == other.path.resolve():
        raise MirrorError(f"{one.path} and {other.path} are one folder; give the other copy")
    ours, theirs = read_generations(one.path), read_generations(other.path)
    if is_up_to_date_with(theirs, ours) and not is_up_to_date_with(ours, theirs):
        one, other = other, one
    refuse_split(one, other)
    return one, other


def before_recovery(leading: Mission, outdated: Mission) -> list[str]:
    """Take over what a flight that was interrupted wrote to the other copy only; both are held.

    Raises:
        OSError, DaemonError: a disk refused.
    """
    ours, theirs = read_generations(leading.path), read_generations(outdated.path)
    if not ours or not theirs or ours[-1].token != theirs[-1].token:
        return []
    return copy_missing_tail(leading, outdated)


def after_recovery(
    leading: Mission, outdated: Mission, step: Callable[[], None] = lambda: None
) -> list[str]:
    """Bring the other copy up to date with one that recovery has put in order; both are held.

    Args:
        leading: the copy that leads.
        outdated: the other one.
        step: called between blocks of bytes.

    Returns:
        Sentences that say what was done.

    Raises:
        OSError, DaemonError: a disk refused; doing it again goes on where it stopped.
    """
    ours, theirs = read_generations(leading.path), read_generations(outdated.path)
    count = Resync(leading, outdated, first_difference(theirs, ours), step)
    done = count.run()
    count.copy_chain_and_index()
    ids = [give_disk_id(leading.root), give_disk_id(outdated.root)]
    if not ours or set(ours[-1].disks) != set(ids) or ours != theirs:
        number = 1 + max(leading.numbers(), default=0)
        history = next_generation(ours, ids, number)
        write_generations(outdated.path, history)
        write_generations(leading.path, history)
    if outdated.is_current and not leading.is_current:
        (outdated.root / CURRENT_FILE).unlink()
        durable.sync_directory(outdated.root)
    return [f"{outdated.path}: brought up to date with {leading.path}; {done} items were copied"]

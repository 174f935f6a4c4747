"""Level-2 whose attempts and commits are noted, with a store that fails some of its calls.

A read fails before the computation, a write after it, before the manifest. Used by
`benchmarks.killed_workers`; worker processes import it by name.
"""

from __future__ import annotations

import errno
import os
import random
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from daemon.mission.layout import Mission
from daemon.mission.store import product_manifests
from daemon.postflight.batch.executor import BatchAction, BatchTask
from daemon.postflight.batch.level2_work import Level2Work


@dataclass(frozen=True)
class CountedWork:
    """Level-2 whose attempts are noted in a file, with a store that fails some calls."""

    work: Level2Work
    attempts: Path
    failure_share: float

    @property
    def threads(self) -> int:
        return self.work.threads

    @property
    def memory_nbytes(self) -> int:
        return self.work.memory_nbytes

    def with_threads(self, threads: int) -> CountedWork:
        return replace(self, work=self.work.with_threads(threads))

    def open(self) -> CountedAction:
        _count_commits(self)
        action = CountedAction(self, self.work.open())
        action.note("0 opened")
        return action


class CountedAction:
    """One line before each computation, with what happens to it."""

    def __init__(self, counted: CountedWork, action: BatchAction) -> None:
        self._counted, self._action = counted, action
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT
        self._attempts = os.open(counted.attempts, flags, 0o644)

    def note(self, line: str) -> None:
        """Add a line to the file."""
        os.write(self._attempts, f"{line}\n".encode())

    def clone(self) -> CountedAction:
        return CountedAction(self._counted, self._action.clone())

    def __call__(self, task: BatchTask) -> Any:
        mission = self._counted.work.mission
        _fail_sometimes(self._attempts, task.number, "read", self._counted)
        is_there = product_manifests.is_complete(
            Mission(mission, mission.name), task.number, task.payload.key
        )
        self.note(f"{task.number} {'recognized' if is_there else 'computed'}")
        result = self._action(task)
        return {"exposure": result["exposure"]}


def _fail_sometimes(attempts: int, number: int, call: str, counted: CountedWork) -> None:
    if random.random() < counted.failure_share:
        os.write(attempts, f"{number} {call} failed\n".encode())
        where = str(counted.work.mission)
        raise OSError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT), where)


def _count_commits(counted: CountedWork) -> None:
    """Replace the commit of this process by one that is noted and fails sometimes."""
    real = getattr(product_manifests.commit, "counted", product_manifests.commit)
    attempts = os.open(counted.attempts, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)

    def commit(
        mission: Mission,
        number: int,
        manifest: product_manifests.ProductManifest,
        provenance: Mapping[str, Any],
    ) -> bool:
        _fail_sometimes(attempts, number, "write", counted)
        is_committed = bool(real(mission, number, manifest, provenance))
        if is_committed:
            os.write(attempts, f"{number} committed\n".encode())
        return is_committed

    commit.counted = real  # type: ignore[attr-defined]  # so that a second work counts once
    product_manifests.commit = commit

"""Level-2 whose attempts and commits are noted, with a store that fails some of its calls.

A read fails before the computation, a write after it, before the manifest. Used by
`benchmarks.killed_workers`; worker processes import it by name.
"""

from __future__ import annotations

import errno
import os
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.attempt_notes import BEGUN, COMMITTED, WRITE_FAILED, NoteFile
from daemon.mission.layout import Mission
from daemon.mission.store import product_manifests
from daemon.mission.store.product_manifests import ClaimedElsewhereError
from daemon.postflight.batch.executor import BatchAction, BatchTask
from daemon.postflight.batch.level2_work import Level2Work


@dataclass(frozen=True)
class CountedWork:
    """Level-2 whose attempts are noted in a file, with a store that fails some calls."""

    work: Level2Work
    notes: Path
    failure_share: float
    threads: int = 1

    @property
    def memory_nbytes(self) -> int:
        return self.work.memory_nbytes

    def open(self) -> CountedAction:
        notes = NoteFile(self.notes)
        commit = _CountedCommit(self, notes)
        product_manifests.commit = commit
        action = CountedAction(self, replace(self.work, threads=self.threads).open(), notes, commit)
        notes.add(0, "opened")
        return action


class CountedAction:
    """One line before each attempt, and one with what became of it."""

    def __init__(
        self, counted: CountedWork, action: BatchAction, notes: NoteFile, commit: _CountedCommit
    ) -> None:
        self._counted, self._action = counted, action
        self._notes, self._commit = notes, commit

    def clone(self) -> CountedAction:
        return CountedAction(self._counted, self._action.clone(), self._notes, self._commit)

    def __call__(self, task: BatchTask) -> Any:
        number = task.number
        self._notes.add(number, BEGUN)
        self._commit.end, self._commit.is_noted = "recognized", False
        try:
            if random.random() < self._counted.failure_share:
                self._commit.end = "read failed"
                raise _timed_out(self._counted.work.mission)
            result = self._action(task)
        except ClaimedElsewhereError:
            self._commit.end = "claimed elsewhere"
            raise
        except Exception:
            if self._commit.end == "recognized":
                self._commit.end = "failed"
            raise
        finally:
            if not self._commit.is_noted:
                self._notes.add(number, self._commit.end)
        return {"exposure": result["exposure"]}


class _CountedCommit:
    """In place of the commit of a process: fails sometimes; `end` is what became of the last."""

    def __init__(self, counted: CountedWork, notes: NoteFile) -> None:
        real: Callable[..., bool] = product_manifests.commit
        # So that a second work of a process counts once.
        self._real: Callable[..., bool] = real._real if isinstance(real, _CountedCommit) else real
        self._counted, self._notes = counted, notes
        self.end, self.is_noted = "", False

    def __call__(
        self,
        mission: Mission,
        number: int,
        manifest: product_manifests.ProductManifest,
        provenance: Mapping[str, Any],
    ) -> bool:
        if random.random() < self._counted.failure_share:
            self.end = WRITE_FAILED
            raise _timed_out(self._counted.work.mission)
        is_committed = self._real(mission, number, manifest, provenance)
        # Noted here, so that a kill behind it does not look like one before it.
        self.end = COMMITTED if is_committed else "committed before"
        self._notes.add(number, self.end)
        self.is_noted = True
        return is_committed


def _timed_out(where: Path) -> OSError:
    return OSError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT), str(where))

"""What runs in a worker of a cluster: works that are open there, and one task after another."""

from __future__ import annotations

import hashlib
import pickle
import threading
from collections import OrderedDict
from typing import Final

import distributed

from daemon.postflight.batch.executor import BatchAction, BatchTask, TaskOutcome
from daemon.postflight.batch.local_processes import outcome_of, picklable

WORKS_MAX: Final = 2
"""Works that a worker has open: one ends while the next begins."""


class WorkRefused:
    """A worker that cannot do the work at all, why, and its address."""

    def __init__(self, error: Exception, worker: str = "") -> None:
        self.error, self.worker = error, worker


_actions: OrderedDict[str, dict[int, BatchAction]] = OrderedDict()
"""Opened works by hash, the last used one at the end; of each, an action for every thread."""
_lock = threading.Lock()


def run_on_worker(pickled_work: bytes, task: BatchTask | None) -> TaskOutcome | WorkRefused | None:
    """Compute one task in a worker; the work is opened once for each of its threads.

    Args:
        pickled_work: the work.
        task: None opens the work only.
    """
    work, thread = hashlib.sha256(pickled_work).hexdigest(), threading.get_ident()
    with _lock:
        own = _actions.setdefault(work, {})
        _actions.move_to_end(work)
        # Calibrations and buffers of works that ended are freed; a worker outlives many commands.
        while len(_actions) > WORKS_MAX:
            _actions.popitem(last=False)
        action = own.get(thread)
        if action is None:
            first = next(iter(own.values()), None)
            try:
                action = first.clone() if first else pickle.loads(pickled_work).open()
            except Exception as error:  # noqa: BLE001 - the command states it
                return WorkRefused(picklable(error), _own_address())
            own[thread] = action
    return None if task is None else outcome_of(action, task)


def _own_address() -> str:
    try:
        return str(distributed.get_worker().address)
    except ValueError:
        return ""  # not in a worker

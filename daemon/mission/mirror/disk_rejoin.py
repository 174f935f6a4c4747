"""A disk that is not in use: polled, and brought up to date in the background.

Storing has priority over it. When it has everything, it reports at which change that
was; `daemon.mission.mirror.mirrored` lets it join.
"""

from __future__ import annotations

import errno
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from daemon import DaemonError
from daemon.mission.layout import Mission
from daemon.mission.mirror.generations import Generations, read_generations
from daemon.mission.mirror.resync import MirrorError, Resync
from daemon.mission.store import durable
from daemon.mission.store.disk_identity import Disk, give_disk_id, prove_writable, read_disk_id

BUSY_POLL_S = 0.02
PASS_PAUSE_S = 0.2
NICE = 19


@dataclass(frozen=True)
class RejoinSettings:
    """When a disk that is not in use may return.

    It is polled every `poll_s`, after each failure half as often, down to every `retry_max_s`;
    it needs `required_nbytes` free, in addition to the missing files.
    """

    poll_s: float = 5.0
    retry_max_s: float = 60.0
    required_nbytes: int = 0


class RejoiningDisk:
    """Brings a disk up to date, in a thread of its own.

    `ready_at` is the change up to which the disk has everything, None while it has not; `problem`
    is the reason, empty where nothing blocks it; `waiting` counts exposures to be copied.

    Args:
        disk: which one; an empty id for one that was not there when the mission was opened.
        mission_id: the mission.
        source: the copy that leads now.
        changes: how many exposures and records were stored so far.
        is_busy: whether an exposure is being stored, so that copying waits.
        is_free: whether nothing of ours hangs on the disk any more.
        open_log: name of the log being written.
        first_missing: the first exposure that that may be missing on a disk of this history.
        settings: when it may return.
        delay_s: how long to wait before the first look.
    """

    def __init__(
        self,
        disk: Disk,
        mission_id: str,
        *,
        source: Callable[[], Mission],
        changes: Callable[[], int],
        is_busy: Callable[[], bool],
        is_free: Callable[[], bool],
        open_log: Callable[[], str],
        first_missing: Callable[[Generations], int],
        settings: RejoinSettings,
        delay_s: float = 0.0,
        is_held: bool = False,
    ) -> None:
        self.disk = disk
        self.ready_at: int | None = None
        self.problem = ""
        self.resync: Resync | None = None
        self._mission_id = mission_id
        self._source = source
        self._changes = changes
        self._is_busy = is_busy
        self._is_free = is_free
        self._open_log = open_log
        self._first_missing = first_missing
        self._settings = settings
        self._is_held = is_held
        self._is_accepted = False
        self._ended = threading.Event()
        self._wake = threading.Event()
        self._thread = threading.Thread(
            target=self._run, args=(delay_s,), name=f"return-{disk.label}", daemon=True
        )
        self._thread.start()

    @property
    def status(self) -> dict[str, Any]:
        """How the disk is: plain JSON types."""
        if self._is_held:
            state = "released"
        else:
            state = "dropped" if self.problem or self.resync is None else "catching up"
        return {
            "disk": self.disk.label,
            "path": str(self.disk.root),
            "id": self.disk.id,
            "state": state,
            "exposures_to_copy": self.waiting,
            "sentence": self.problem,
        }

    @property
    def waiting(self) -> int:
        return 0 if self.resync is None else self.resync.waiting

    @property
    def has_ended(self) -> bool:
        """Whether it was stopped, and its thread has ended."""
        return self._ended.is_set() and not self._thread.is_alive()

    @property
    def target(self) -> Mission:
        """The mission on this disk."""
        return Mission(self.disk.root / self._mission_id, self._mission_id)

    def accept(self) -> None:
        """Take whatever disk is there now, a new one too."""
        self._is_held, self._is_accepted = False, True
        self._wake.set()

    def end(self, timeout_s: float = 0.0) -> bool:
        """Stop; whether the thread has ended in time."""
        self._ended.set()
        self._wake.set()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self, delay_s: float) -> None:
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
        pause_s = self._settings.poll_s
        self._wake.wait(delay_s)
        while not self._ended.is_set():
            self._wake.clear()
            if not self._is_held and self._is_free():
                try:
                    self._bring_up_to_date()
                except (OSError, DaemonError) as error:
                    self.ready_at = None
                    self.problem = f"disk {self.disk} is not in use: {_error_text(error)}"
                    pause_s = min(2 * pause_s, self._settings.retry_max_s)
            # Stopped, it has what it had: the disk may join as soon as the thread has ended.
            if not self._ended.is_set():
                self.ready_at = None
                self._wake.wait(pause_s)

    def _bring_up_to_date(self) -> None:
        """Copy until ended.

        Raises:
            OSError, DaemonError: it cannot be used, or no longer.
        """
        self._recognise()
        source = self._source()
        self._require_free_space()
        prove_writable(self.disk.root)
        target = self.target
        history = read_generations(target.path) if target.path.is_dir() else ()
        self.resync = Resync(source, target, self._first_missing(history), self._step)
        durable.make_directories(target.path)
        with target.held():
            while not self._ended.is_set():
                self._copy(self.resync, source)
                self._ended.wait(PASS_PAUSE_S)

    def _copy(self, resync: Resync, source: Mission) -> None:
        """Copy what is missing now, and see whether anything was."""
        if self._source() != source:
            raise MirrorError("another disk leads now")
        changes = self._changes()
        done = resync.run(self._open_log())
        self.problem = ""
        is_ready = not done and changes == self._changes() and not self._is_busy()
        self.ready_at = changes if is_ready else None

    def _recognise(self) -> None:
        found = read_disk_id(self.disk.root)
        if self._is_accepted:
            found = found or give_disk_id(self.disk.root)
            self.disk = replace(self.disk, id=found)
            self._is_accepted = False
        known = {self.disk.id} - {""} or {
            one for generation in read_generations(self._source().path) for one in generation.disks
        }
        if found is None or found not in known:
            what = "no disk of Syntopic" if found is None else "another disk"
            raise MirrorError(
                f"{what} is at {self.disk.root}; mount the right one, or take this one with: "
                f"syntopic send accept-disk --set disk={self.disk.label}"
            )
        self.disk = replace(self.disk, id=found)

    def _require_free_space(self) -> None:
        free_nbytes = durable.free_bytes(self.disk.root)
        if free_nbytes < self._settings.required_nbytes:
            free, needed = free_nbytes / 1e9, self._settings.required_nbytes / 1e9
            raise OSError(errno.ENOSPC, f"{free:.1f} GB are free; {needed:.1f} GB are needed")

    def _step(self) -> None:
        """Give way to what is being stored."""
        while self._is_busy() and not self._ended.is_set():
            time.sleep(BUSY_POLL_S)
        if self._ended.is_set():
            raise MirrorError("it is no longer brought up to date")
        if self.resync is not None and self.resync.waiting:
            self._require_free_space()


def _error_text(error: OSError | DaemonError) -> str:
    return (error.strerror or str(error)) if isinstance(error, OSError) else str(error)

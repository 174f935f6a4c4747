"""A mission on two disks: what is called stored or sealed is durable on every disk in use.

Each disk has a thread of its own. One that refuses, or makes no progress while another does, is
dropped; that is durable on the others before anything more is acknowledged. A disk that returns is
brought up to date by `daemon.mission.mirror.disk_rejoin` and joins between two orders.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.exposure import CaptureRecord, Exposure, FrameRecord
from daemon.mission.log.flight_log import FlightLog, host_boot_id, new_log_name
from daemon.mission.mirror.disk_rejoin import RejoiningDisk, RejoinSettings
from daemon.mission.mirror.generations import (
    first_difference,
    next_generation,
    read_generations,
    write_generations,
)
from daemon.mission.mirror.mirrored_log import SharedStream
from daemon.mission.store.disk_executor import DroppedError
from daemon.mission.store.disk_identity import Disk
from daemon.mission.transfer.mission_copy import MissionCopy

POLL_S = 0.05
END_TIMEOUT_S = 2.0

EventName = Literal["disk-dropped", "disk-released", "disk-joined"]
T = TypeVar("T")


@dataclass(frozen=True)
class DiskEvent:
    """A disk was dropped or has joined; `in_use` are the disks in use from now on."""

    name: EventName
    disk: Disk
    sentence: str
    in_use: tuple[Disk, ...]
    dropped_count: int


class MirroredStorage:
    """Writes frames, records and the flight log to every disk in use. For one thread.

    Args:
        mission_id: the mission; its folder is there on the first disk.
        disks: the disks, the leading one first; the others join once they are up to date.
        stall_s: how long a disk may make no progress while another does.
        rejoin: when and how a disk that is not in use is brought up to date.
        emit: called when the disks in use have changed.
    """

    def __init__(
        self,
        mission_id: str,
        disks: Sequence[Disk],
        *,
        stall_s: float,
        rejoin: RejoinSettings,
        emit: Callable[[DiskEvent], None],
        simulated: bool = False,
    ) -> None:
        self._mission_id = mission_id
        self._stall_s = stall_s
        self._rejoin = rejoin
        self._emit = emit
        self._polled_s = time.monotonic()
        self._abandoned: list[MissionCopy] = []
        self._inactive: dict[str, RejoiningDisk] = {}
        self._changes = 0
        self._ends_mission = False
        self.is_storing = False
        self.dropped_count = 0
        leading = MissionCopy(disks[0], mission_id)
        self._history = read_generations(leading.mission.path)
        self._is_recorded, self._is_due = bool(self._history), False
        self._copies = [leading]
        numbers = leading.mission.numbers()
        self._first_missing = self._next_number = 1 + max(numbers, default=0)
        self._log_name = new_log_name()
        leading.executor.submit(partial(leading.open, self._log_name)).result()
        self._stream = SharedStream(self._append_log, self._sync_log)
        self._log = FlightLog(
            leading.mission.log_dir / self._log_name,
            boot_id=host_boot_id(),
            simulated=simulated,
            stream=self._stream,
        )
        self._log.sync()
        for disk in disks[1:]:
            self._start_rejoin(disk, 0.0)

    @property
    def log(self) -> FlightLog:
        """The flight log, on every disk in use."""
        return self._log

    @property
    def in_use(self) -> tuple[Disk, ...]:
        """The disks in use, the leading one first."""
        return tuple(copy.disk for copy in self._copies)

    @property
    def unindexed(self) -> int:
        """How many changes an index has refused so far."""
        return max(copy.writer.unindexed for copy in self._copies)

    @property
    def status(self) -> tuple[dict[str, Any], ...]:
        """How each disk is, by label: plain JSON types."""
        in_use: dict[str, dict[str, Any]] = {
            disk.label: {
                "disk": disk.label,
                "path": str(disk.root),
                "id": disk.id,
                "state": "in use",
                "exposures_to_copy": 0,
                "sentence": "",
            }
            for disk in self.in_use
        }
        others = {label: inactive.status for label, inactive in self._inactive.items()}
        return tuple((in_use | others)[label] for label in sorted(in_use | others, reverse=True))

    @property
    def inactive(self) -> Mapping[str, RejoiningDisk]:
        """Disks that are not in use, by label."""
        return self._inactive

    def write(
        self, capture: CaptureRecord, pixels: Mapping[str, NDArray[np.uint16]]
    ) -> tuple[tuple[FrameRecord, ...], tuple[str, ...]]:
        """Make an exposure's frames durable on every disk in use.

        Returns:
            The frames, and the ids of the disks that have them.

        Raises:
            OSError, StoreError: as `Level0Writer.write`; no disk took it.
        """
        self._next_number = capture.number
        self.is_storing = True
        try:
            frames = self._on_all_disks(lambda copy: copy.writer.write_frames(capture, pixels))
            try:
                self._record()
            except OSError:
                self._withdraw(capture.number)
                raise
            stored = replace(capture, frames=frames)
            self._on_all_disks(lambda copy: copy.writer.note_stored(stored))
        finally:
            self._next_number = capture.number + 1
            self.is_storing = False
            self._changes += 1
        return frames, tuple(disk.id for disk in self.in_use)

    def seal(self, exposure: Exposure) -> str:
        """Write the final record of a stored exposure on every disk in use.

        Returns:
            SHA-256 of the record.

        Raises:
            OSError, StoreError: as `Level0Writer.seal`; sealing the same again is right.
        """
        try:
            sha256 = self._on_all_disks(lambda copy: copy.writer.seal(exposure))
            self._record()
        finally:
            self._changes += 1
        return sha256

    def note_products(self, number: int, files: Mapping[str, int], verdict: str | None) -> None:
        """Note products in the index of the leading disk, where they are."""
        copy = self._copies[0]
        copy.executor.submit(lambda: copy.writer.note_products(number, files, verdict))

    def write_note(self, name: str, data: bytes) -> None:
        """Put a small file under a name below the root of every disk in use; asynchronous.

        Args:
            name: relative to the root, such as "unhandled-faults.json".
            data: its content.
        """
        for copy in self._copies:
            copy.executor.submit(partial(copy.write_note, name, data))

    def tick(self) -> None:
        """Drop disks that stall or refused meanwhile, and let a disk join that is up to date.

        To be called between two orders, several times within `stall_s`.
        """
        self._drop_stalled()
        self._drop_refusing()
        if self._is_due:
            # Refused, it is tried again before anything is acknowledged.
            with suppress(OSError):
                self._record()
        for inactive in list(self._inactive.values()):
            if inactive.ready_at == self._changes:
                self._join(inactive)
            elif inactive.has_ended:
                # An exposure was stored before its thread had ended.
                self._start_rejoin(inactive.disk, 0.0)

    def release(self, label: str, reason: str) -> None:
        """Release a disk, so that it can be unmounted.

        Raises:
            DaemonError: it is not in use, or it is the only one.
        """
        copy = next((c for c in self._copies if c.disk.label == label), None)
        if copy is None:
            raise DaemonError(f"disk {label} is not in use")
        if len(self._copies) == 1:
            raise DaemonError(f"disk {label} is the only one in use; it cannot be released")
        self._wait({copy: copy.executor.submit(copy.close)})
        self._drop(copy, reason, is_fault=False)

    def drop(self, label: str, reason: str) -> None:
        """Drop a disk that failed elsewhere; never the only one."""
        for copy in list(self._copies):
            if copy.disk.label == label:
                self._drop(copy, reason)

    def accept(self, label: str) -> None:
        """Take whatever disk is at the place of one that is not in use, and bring it up to date.

        Raises:
            DaemonError: the disk is in use.
        """
        inactive = self._inactive.get(label)
        if inactive is None:
            raise DaemonError(f"disk {label} is in use; release it first")
        inactive.accept()

    def end_mission(self) -> None:
        """The mission may not be used once this is closed."""
        self._ends_mission = True

    def close(self) -> None:
        """Close log and index on every disk in use."""
        for inactive in self._inactive.values():
            inactive.end()
        self._log.close()
        self._wait({copy: copy.executor.submit(copy.close) for copy in self._copies})
        if self._ends_mission:
            self._wait({copy: copy.executor.submit(copy.mission.close) for copy in self._copies})
        for copy in self._copies:
            copy.executor.end(END_TIMEOUT_S)

    @property
    def is_hanging(self) -> bool:
        """Whether a thread still hangs on a disk that was dropped."""
        return any(copy.executor.is_alive for copy in (*self._abandoned, *self._copies))

    def _hangs_on(self, label: str) -> bool:
        return any(c.executor.is_alive for c in self._abandoned if c.disk.label == label)

    # Work on all disks

    def _on_all_disks(self, work: Callable[[MissionCopy], T]) -> T:
        """Do the same on every disk in use; a disk that refuses where another does not is dropped.

        Raises:
            OSError, StoreError: the error of the leading disk, where all failed.
        """
        futures = {copy: copy.executor.submit(partial(work, copy)) for copy in self._copies}
        self._wait(futures)
        results: dict[MissionCopy, T] = {}
        refusals: dict[MissionCopy, OSError | DaemonError] = {}
        for copy, future in futures.items():
            if copy not in self._copies:
                continue  # it stalled
            try:
                results[copy] = future.result()
            except (OSError, DaemonError) as error:
                refusals[copy] = error
        if not results:
            raise next(iter(refusals.values()))
        leading = next(copy for copy in self._copies if copy in results)
        for copy, refusal in refusals.items():
            self._drop(copy, _reason(refusal))
        for copy, result in results.items():
            if result != results[leading]:
                self._drop(copy, f"it wrote something else than {leading.disk}")
        return results[leading]

    def _wait(self, futures: Mapping[MissionCopy, Future[Any]]) -> None:
        """Until all is done on every disk that is not dropped meanwhile."""
        while True:
            pending = [
                future
                for copy, future in futures.items()
                if not future.done() and not copy.executor.is_abandoned
            ]
            if not pending:
                return
            wait(pending, timeout=POLL_S)
            self._drop_stalled()

    # Disks in use

    def _is_current(self) -> bool:
        return self._is_recorded and set(self._history[-1].disks) == {d.id for d in self.in_use}

    def _record(self) -> None:
        """Make durable which disks are in use, before anything is acknowledged by them alone.

        Raises:
            OSError: the last disk refused.
        """
        while not self._is_current():
            ids = [disk.id for disk in self.in_use]
            if not self._history or set(self._history[-1].disks) != set(ids):
                self._history = next_generation(self._history, ids, self._first_missing)
            history = self._history
            # mypy infers no type for the default of a parameter of a lambda.
            self._on_all_disks(lambda copy, h=history: write_generations(copy.mission.path, h))  # type: ignore[misc]
            self._is_recorded, self._is_due = True, False

    def _drop_stalled(self) -> None:
        now_s = time.monotonic()
        elapsed_s, self._polled_s = now_s - self._polled_s, now_s
        waited_s = {copy: copy.executor.update_waited(elapsed_s) for copy in self._copies}
        # Where all of them wait, the machine is busy or they share a cause: dropping does not help.
        if min(waited_s.values()) > self._stall_s / 2:
            return
        for copy, waited in waited_s.items():
            if waited > self._stall_s:
                self._drop(copy, f"it made no progress for {self._stall_s:g} s")

    def _drop_refusing(self) -> None:
        refusing = [copy for copy in self._copies if copy.refusal is not None]
        if len(refusing) < len(self._copies):
            for copy in refusing:
                assert copy.refusal is not None
                self._drop(copy, _reason(copy.refusal))
        for copy in refusing:
            copy.refusal = None

    def _drop(self, copy: MissionCopy, reason: str, *, is_fault: bool = True) -> None:
        if copy not in self._copies or len(self._copies) == 1:
            return
        self._first_missing = self._next_number
        self._copies.remove(copy)
        copy.executor.abandon()
        self._abandoned.append(copy)
        self._is_recorded, self._is_due = False, True
        self.dropped_count += is_fault
        self._start_rejoin(copy.disk, self._rejoin.poll_s, is_held=not is_fault)
        left = ", ".join(map(str, self.in_use))
        if is_fault:
            sentence = (
                f"disk {copy.disk} was dropped: {reason}; storing goes on with {left}; check its "
                "cable and power; it is brought up to date when it answers again"
            )
            self._emit_event("disk-dropped", copy.disk, sentence)
        else:
            sentence = (
                f"disk {copy.disk} is released ({reason}) and may be unmounted; storing goes on "
                f"with {left}"
            )
            self._emit_event("disk-released", copy.disk, sentence)

    def _join(self, inactive: RejoiningDisk) -> None:
        """A disk that has everything is in use again."""
        leading, resync = self._copies[0], inactive.resync
        if resync is None or not inactive.end(POLL_S):
            return
        self._wait({leading: leading.executor.submit(lambda: None)})  # the log is on it up to here
        copy = MissionCopy(inactive.disk, self._mission_id)
        work = partial(copy.join, leading, resync, self._log_name, self._stream.offset)
        opening = copy.executor.submit(work)
        wait([opening], timeout=self._stall_s)
        try:
            if not opening.done():
                raise DaemonError(f"it was not opened within {self._stall_s:g} s")
            opening.result()
        except (OSError, DaemonError) as error:
            copy.executor.abandon()
            self._abandoned.append(copy)
            self._start_rejoin(inactive.disk, self._rejoin.poll_s)
            self._inactive[
                inactive.disk.label
            ].problem = f"disk {inactive.disk} is not in use: {_reason(error)}"
            return
        del self._inactive[inactive.disk.label]
        self._copies.append(copy)
        self._first_missing = self._next_number
        self._is_recorded, self._is_due = False, True
        with suppress(OSError):
            self._record()
        if copy in self._copies:
            self._emit_event("disk-joined", copy.disk, f"disk {copy.disk} is up to date and in use")

    def _emit_event(self, name: EventName, disk: Disk, sentence: str) -> None:
        self._emit(DiskEvent(name, disk, sentence, self.in_use, self.dropped_count))

    def _start_rejoin(self, disk: Disk, delay_s: float, *, is_held: bool = False) -> None:
        self._inactive[disk.label] = RejoiningDisk(
            disk,
            self._mission_id,
            source=lambda: self._copies[0].mission,
            changes=lambda: self._changes,
            is_busy=lambda: self.is_storing,
            is_free=lambda: not self._hangs_on(disk.label),
            open_log=lambda: self._log_name,
            first_missing=lambda history: first_difference(history, self._history),
            settings=self._rejoin,
            delay_s=delay_s,
            is_held=is_held,
        )

    def _withdraw(self, number: int) -> None:
        """No disk may keep what was not acknowledged; recovery keeps what cannot be taken back."""
        withdrawals = {
            c: c.executor.submit(partial(c.writer.withdraw, number)) for c in self._copies
        }
        self._wait(withdrawals)

    def _append_log(self, data: bytes) -> None:
        for copy in self._copies:
            copy.executor.submit(partial(copy.append_log, data))

    def _sync_log(self) -> None:
        for copy in self._copies:
            copy.executor.submit(copy.sync_log)


def _reason(error: OSError | DaemonError) -> str:
    if isinstance(error, DroppedError):
        return "it was dropped"
    return (error.strerror or str(error)) if isinstance(error, OSError) else str(error)

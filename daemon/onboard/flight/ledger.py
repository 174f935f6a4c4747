"""The ledger: every trigger, frame and event mark is accounted for.

Pure counting, without clock, disk or threads. One account counts what arrived, the other its
causes; `imbalances` compares them. The states of an exposure are in
`daemon.onboard.flight.transitions`.

    triggers              = open + complete + degraded + lost
    received (each head)  = pending + used + late + duplicate + corrupt + spurious
    received (marks)      = the same

*Pending* is what arrived and is not attributed yet; at the end of a flight it is zero and the
term vanishes. The third check binds frames to triggers: exposures that are complete or
degraded and do not name a head as missing are that head's used frames, give or take the exposures
that are open or lost.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from daemon.mission.exposure import Exposure
from daemon.onboard.flight.transitions import (
    ExposureState,
    ExposureStatus,
    LedgerError,
    StorageState,
    Transition,
    next_status,
)

__all__ = ["CAUSES", "MARK", "Ledger", "LedgerError", "LedgerSheet", "Receipts"]

CAUSES = ("used", "late", "duplicate", "corrupt", "spurious")
PENDING = "pending"
MARK = "mark"
"""Key of a missing event mark among the causes of an exposure."""

Causes = Mapping[str, str] | Iterable[tuple[str, str]]

_TRANSITION_TO = {
    ExposureState.COMPLETE: Transition.SET_COMPLETE,
    ExposureState.DEGRADED: Transition.SET_DEGRADED,
    ExposureState.LOST: Transition.SET_LOST,
}


@dataclass(frozen=True)
class Receipts:
    """What became of all that was received from one head, or of all event marks.

    `missing` counts finalized exposures without it; it is not part of `received`.
    """

    name: str
    received: int = 0
    used: int = 0
    late: int = 0
    duplicate: int = 0
    corrupt: int = 0
    spurious: int = 0
    pending: int = 0
    missing: int = 0


@dataclass(frozen=True)
class LedgerSheet:
    """The balance sheet of a flight. `frames` is the total over `heads`."""

    triggers: int
    open: int
    complete: int
    degraded: int
    lost: int
    stored: int
    sealed: int
    heads: tuple[Receipts, ...]
    frames: Receipts
    marks: Receipts
    imbalances: tuple[str, ...]

    @property
    def is_balanced(self) -> bool:
        return not self.imbalances

    def as_json(self) -> dict[str, Any]:
        """The sheet as an object of JSON types."""
        return {
            "triggers": {
                "triggers": self.triggers,
                "open": self.open,
                "complete": self.complete,
                "degraded": self.degraded,
                "lost": self.lost,
                "stored": self.stored,
                "sealed": self.sealed,
            },
            "heads": [asdict(head) for head in self.heads],
            "frames": asdict(self.frames),
            "marks": asdict(self.marks),
            "imbalances": list(self.imbalances),
            "balanced": self.is_balanced,
        }


@dataclass
class _LedgerEntry:
    status: ExposureStatus = field(default_factory=ExposureStatus)
    missing: frozenset[str] = frozenset()


class _Account:
    """The two books of one head, or of the marks."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.received = 0
        self.pending = 0
        self.by_cause = dict.fromkeys(CAUSES, 0)

    def enter(self, cause: str) -> None:
        if cause == PENDING:
            self.received += 1
            self.pending += 1
        elif cause not in self.by_cause:
            known = ", ".join((PENDING, *CAUSES))
            raise LedgerError(f"{self.name}: cause {cause!r}; it is one of {known}")
        elif self.pending:
            self.pending -= 1
            self.by_cause[cause] += 1
        else:
            self.received += 1
            self.by_cause[cause] += 1

    def receipts(self, missing: int) -> Receipts:
        return Receipts(
            self.name,
            received=self.received,
            **self.by_cause,
            pending=self.pending,
            missing=missing,
        )


class Ledger:
    """Counts for one mission.

    Heads are named by the sensor they carry; the sheet lists those given here first, others as
    they turn up.
    """

    def __init__(self, heads: Sequence[str] = ()) -> None:
        self._entries: dict[int, _LedgerEntry] = {}
        self._heads = {head: _Account(head) for head in heads}
        self._marks = _Account("marks")
        self._triggers = 0
        self._in_state = dict.fromkeys(ExposureState, 0)
        self._in_storage = dict.fromkeys(StorageState, 0)
        self._missing: Counter[str] = Counter()

    @classmethod
    def resume(
        cls,
        exposures: Iterable[Exposure],
        *,
        heads: Sequence[str] = (),
        sheet: Mapping[str, Any] | None = None,
    ) -> Ledger:
        """Continue a flight from its sealed records.

        Frames and marks that became no part of an exposure are in no record: they come from the
        last sheet that was kept, where one is given (its JSON form; what cannot be read in it
        counts as zero). What was pending when the service ended was never durable and is not
        carried on.
        """
        ledger = cls(heads)
        for exposure in exposures:
            ledger.trigger(exposure.number)
            for frame in exposure.frames:
                ledger.frame(frame.sensor, "used")
            if exposure.mark_source == "event-mark":
                ledger.mark("used")
            causes = dict(exposure.missing)
            if exposure.state != "complete" and not causes:
                causes = {"exposure": f"recorded as {exposure.state}"}
            state = "degraded" if exposure.state == "complete" and causes else exposure.state
            ledger.set_state(exposure.number, state, causes)
            if state != "lost":
                ledger.stored(exposure.number)
            ledger.sealed(exposure.number)
        if sheet is not None:
            ledger._restore_counts(sheet)
        return ledger

    def trigger(self, number: int) -> None:
        """A pulse was given for exposure `number`."""
        if number in self._entries:
            raise LedgerError(f"exposure {number} was triggered already; numbers are used once")
        self._entries[number] = _LedgerEntry()
        self._triggers += 1
        self._in_state[ExposureState.OPEN] += 1
        self._in_storage[StorageState.VOLATILE] += 1

    def frame(self, head: str, cause: str) -> None:
        """A frame arrived ("pending"), or it is known what became of one.

        A cause is taken from what is pending; without that, arrival and cause are one entry.
        """
        self._account(head).enter(cause)

    def mark(self, cause: str) -> None:
        """An event mark arrived ("pending"), or it is known what became of one."""
        self._marks.enter(cause)

    def set_state(self, number: int, state: str | ExposureState, causes: Causes = ()) -> None:
        """Set the final state of an exposure; until it is sealed, the state may only get worse.

        Args:
            number: the exposure.
            state: "complete", "degraded" or "lost".
            causes: what is missing and why: heads without a frame, "mark", or another problem. None
                for a complete exposure, at least one otherwise. A head that sent a duplicate in
                addition to its good frame is not named.
        """
        try:
            new_state = ExposureState(state)
        except ValueError:
            new_state = ExposureState.OPEN
        named = dict(causes)
        if new_state not in _TRANSITION_TO:
            raise LedgerError(f"exposure {number}: the final state is complete, degraded or lost")
        if new_state is ExposureState.COMPLETE and named:
            raise LedgerError(f"exposure {number}: is complete, but missing: {', '.join(named)}")
        if new_state is not ExposureState.COMPLETE and not named:
            raise LedgerError(
                f"exposure {number}: is {new_state.value}; state what is missing and why"
            )
        entry = self._entry(number)
        self._step(number, _TRANSITION_TO[new_state])
        self._missing.subtract(entry.missing)
        entry.missing = frozenset() if new_state is ExposureState.LOST else frozenset(named)
        self._missing.update(entry.missing)

    def stored(self, number: int) -> None:
        """Its pixels are durable."""
        self._step(number, Transition.STORE)

    def sealed(self, number: int) -> None:
        """Its record is final and durable."""
        self._step(number, Transition.SEAL)

    def status(self, number: int) -> ExposureStatus:
        """State and storage of an exposure."""
        return self._entry(number).status

    def open_numbers(self) -> list[int]:
        """Exposures without a final state, ascending."""
        return sorted(n for n, e in self._entries.items() if e.status.state is ExposureState.OPEN)

    def imbalances(
        self, delivered: Mapping[str, int] | None = None, *, has_landed: bool = False
    ) -> list[str]:
        """One sentence for everything that does not add up; empty when all counts agree.

        Args:
            delivered: frames delivered according to the driver, by head; compared if given.
            has_landed: the flight has ended; nothing may be open or pending.
        """
        found = self._trigger_imbalances()
        if has_landed:
            found += [
                f"{account.name}: {account.pending} pending after landing"
                for account in (*self._heads.values(), self._marks)
                if account.pending
            ]
            if self._in_state[ExposureState.OPEN]:
                found.append(
                    f"{self._in_state[ExposureState.OPEN]} exposures are open after landing"
                )
        for account in (*self._heads.values(), self._marks):
            total = account.pending + sum(account.by_cause.values())
            if account.received != total:
                found.append(f"{account.name}: {account.received} received, {total} accounted for")
        with_frames = (
            self._in_state[ExposureState.COMPLETE] + self._in_state[ExposureState.DEGRADED]
        )
        undecided = self._in_state[ExposureState.OPEN] + self._in_state[ExposureState.LOST]
        for head, account in self._heads.items():
            expected, used = with_frames - self._missing[head], account.by_cause["used"]
            if not expected <= used <= expected + undecided:
                found.append(
                    f"{head}: {used} frames used, but {expected} exposures have one "
                    f"and {undecided} are open or lost"
                )
        used = self._marks.by_cause["used"]
        if used > self._triggers:
            found.append(f"marks: {used} used for {self._triggers} triggers")
        for head, count in (delivered or {}).items():
            received = self._account(head).received
            if received != count:
                found.append(f"{head}: its driver delivered {count} frames, {received} arrived")
        return found

    def sheet(self) -> LedgerSheet:
        """The balance sheet as of now."""
        heads = tuple(a.receipts(self._missing[head]) for head, a in self._heads.items())
        sums = {
            item.name: sum(getattr(receipts, item.name) for receipts in heads)
            for item in fields(Receipts)
            if item.name != "name"
        }
        return LedgerSheet(
            triggers=self._triggers,
            open=self._in_state[ExposureState.OPEN],
            complete=self._in_state[ExposureState.COMPLETE],
            degraded=self._in_state[ExposureState.DEGRADED],
            lost=self._in_state[ExposureState.LOST],
            stored=self._in_storage[StorageState.STORED] + self._sealed_with_pixels(),
            sealed=self._in_storage[StorageState.SEALED],
            heads=heads,
            frames=Receipts("frames", **sums),
            marks=self._marks.receipts(self._missing[MARK]),
            imbalances=tuple(self.imbalances()),
        )

    def _trigger_imbalances(self) -> list[str]:
        found = []
        counted = dict.fromkeys(ExposureState, 0)
        for entry in self._entries.values():
            counted[entry.status.state] += 1
        if sum(self._in_state.values()) != self._triggers or counted != self._in_state:
            states = ", ".join(f"{count} {state.value}" for state, count in counted.items())
            found.append(f"{self._triggers} triggers, but {states}")
        return found

    def _sealed_with_pixels(self) -> int:
        return self._in_storage[StorageState.SEALED] - sum(
            entry.status == ExposureStatus(ExposureState.LOST, StorageState.SEALED)
            for entry in self._entries.values()
        )

    def _step(self, number: int, step: Transition) -> None:
        entry = self._entry(number)
        before = entry.status
        try:
            entry.status = next_status(before, step)
        except LedgerError as error:
            raise LedgerError(f"exposure {number}: {error}") from error
        self._in_state[before.state] -= 1
        self._in_state[entry.status.state] += 1
        self._in_storage[before.storage] -= 1
        self._in_storage[entry.status.storage] += 1

    def _restore_counts(self, sheet: Mapping[str, Any]) -> None:
        lines = sheet.get("heads")
        by_name = {
            line["name"]: line
            for line in (lines if isinstance(lines, list | tuple) else [])
            if isinstance(line, Mapping) and isinstance(line.get("name"), str)
        }
        marks = sheet.get("marks")
        accounts = [(self._account(head), line) for head, line in by_name.items()]
        for account, line in [*accounts, (self._marks, marks)]:
            for cause in CAUSES[1:]:
                count = line.get(cause) if isinstance(line, Mapping) else None
                if isinstance(count, int) and not isinstance(count, bool) and count > 0:
                    account.received += count
                    account.by_cause[cause] += count

    def _account(self, head: str) -> _Account:
        return self._heads.setdefault(head, _Account(head))

    def _entry(self, number: int) -> _LedgerEntry:
        entry = self._entries.get(number)
        if entry is None:
            raise LedgerError(f"exposure {number} was never triggered")
        return entry

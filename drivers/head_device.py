"""What every head has, whatever it is reached through: slots, reopening, counters and an end.

How a head is opened, served and let go of is in the room of its family.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Mapping
from typing import ClassVar, Final

from drivers.clock import BackOff, Clock, HostClock
from drivers.contract import DeviceError, FrameMemory, LifeCycle, Sink
from drivers.settings import Configured
from drivers.telling import Teller

CLOSE_TIMEOUT_S: Final = 2.0


class HeadDevice(Configured):
    """A head whose frames land in memory of the caller's: opened, served, lost and opened again.

    A driver says how: `_reach` opens the head, `_serve` delivers until `_closing` is set or the
    head is lost, `_let_go` drops what belongs to the opening. One thread at a time calls `bind`
    and `run`; `recycle`, `trigger`, `close` and `statistics` are for any thread.
    """

    kind: ClassVar = "head"
    counted: ClassVar[tuple[str, ...]] = ("frames", "underruns", "opened")
    """Counters that are told even while they are zero."""

    def __init__(
        self,
        name: str,
        settings: Mapping[str, object],
        *,
        memory: FrameMemory,
        clock: Clock | None = None,
    ) -> None:
        super().__init__(name, settings)
        self._memory = memory
        self._clock: Clock = clock or HostClock()
        self._teller = Teller(name, self._clock)
        self._state = LifeCycle.CREATED
        self._closing = threading.Event()
        self._ended = threading.Event()
        self._ended.set()
        self._slots = threading.Lock()
        self._lent_out: set[int] = set()
        self._last_slot = -1
        self._counters: Counter[str] = Counter(dict.fromkeys(self.counted, 0))

    @property
    def state(self) -> LifeCycle:
        return self._state

    def run(self, sink: Sink) -> None:
        """Deliver until closed. See `drivers.contract.Device`."""
        if self._closing.is_set():
            return
        self._ended.clear()
        self._teller.sink = sink
        pause = BackOff()
        is_reachable = True
        try:
            while not self._closing.is_set():
                try:
                    self._reach()
                except DeviceError as error:
                    self._state = LifeCycle.INACTIVE
                    if is_reachable and not self._closing.is_set():
                        is_reachable = False
                        self._teller.tell(
                            self._word_for(error),
                            f"{error}. It is tried again by itself.",
                            fault=True,
                        )
                    self._clock.wait(self._closing, pause.next_s())
                    continue
                is_reachable = True
                self._teller.tell("opened", self._opened_sentence())
                frames = self._counters["frames"]
                self._serve(sink)
                if self._counters["frames"] > frames:
                    pause.reset()
                self._clock.wait(self._closing, pause.next_s())
        finally:
            self._let_go()
            self._teller.sink = None
            self._state = LifeCycle.INACTIVE
            self._ended.set()

    def close(self) -> None:
        """End `run` within two seconds and let go of the head; may be called twice."""
        self._closing.set()
        if self._ended.wait(CLOSE_TIMEOUT_S):
            self._let_go()
        self._state = LifeCycle.INACTIVE

    def recycle(self, slot: int) -> None:
        """Hand a slot back; from any thread. ValueError for a slot that was not handed out."""
        with self._slots:
            if slot not in self._lent_out:
                raise ValueError(f"{self.name}: slot {slot} was not handed out; recycle it once")
            self._lent_out.discard(slot)
            self._returned(slot)

    def statistics(self) -> Mapping[str, int]:
        """Counters since creation, by stable name; see the driver's page."""
        return dict(sorted(self._counters.items()))

    # For a driver to say

    def _reach(self) -> None:
        """Open the head where it is not open. DeviceError where it cannot be."""
        raise NotImplementedError

    def _serve(self, sink: Sink) -> None:
        """Deliver until `_closing` is set or the head is lost; tells of a loss itself."""
        raise NotImplementedError

    def _let_go(self) -> None:
        """Drop what belongs to this opening; called twice, too."""

    def _returned(self, slot: int) -> None:
        """A slot came back. Called with `_slots` held."""

    def _opened_sentence(self) -> str:
        return f"The head {self.name} is open; nothing to do."

    def _word_for(self, error: DeviceError) -> str:
        """The event that tells of a head that cannot be opened."""
        return "lost"

    # For a driver to use

    def _lend_out(self, slot: int) -> None:
        """Note that a slot goes to the caller with its frame."""
        with self._slots:
            self._lent_out.add(slot)

    def _free_slot(self) -> int | None:
        """The next slot that nobody has; None, counted and told, where all are taken."""
        with self._slots:
            free = [slot for slot in range(self._memory.slot_count) if slot not in self._lent_out]
            if free:
                # In turn, so that a slot that is let go of too early shows at once.
                slot = min(free, key=lambda s: (s <= self._last_slot, s))
                self._last_slot = slot
                return slot
        self._counters["underruns"] += 1
        self._complain_of_underrun()
        return None

    def _complain_of_underrun(self) -> None:
        self._teller.complain(
            "underrun",
            f"The head {self.name} lost a frame because all {self._memory.slot_count} slots "
            "are taken. Storage is too slow for this rate; lengthen the interval.",
        )

"""Base of all heads: frames in slots of the caller's memory."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import ClassVar

from drivers.base.device import DeviceDriver
from drivers.contract import DeviceError, FrameMemory
from drivers.timescales.clock import Clock


class HeadDevice(DeviceDriver):
    """A head whose frames are written to the caller's memory.

    One thread at a time calls `bind` and `run`; `recycle`, `trigger`, `close` and `statistics` are
    for any thread.
    """

    kind: ClassVar = "head"
    counted: ClassVar[tuple[str, ...]] = ("frames", "underruns", "opened")
    delivery_counter: ClassVar = "frames"

    def __init__(
        self,
        name: str,
        settings: Mapping[str, object],
        *,
        memory: FrameMemory,
        clock: Clock | None = None,
    ) -> None:
        super().__init__(name, settings, clock=clock)
        self._memory = memory
        self._slots = threading.Lock()
        self._slots_in_use: set[int] = set()
        self._last_slot = -1

    def recycle(self, slot: int) -> None:
        """Return a slot of a frame that is no longer needed; from any thread.

        Args:
            slot: `Frame.slot` of that frame.

        Raises:
            ValueError: the slot was not handed out, or is returned twice.
        """
        with self._slots:
            if slot not in self._slots_in_use:
                raise ValueError(f"{self.name}: slot {slot} was not handed out; recycle it once")
            self._slots_in_use.discard(slot)
            self._slot_returned(slot)

    def statistics(self) -> Mapping[str, int]:
        """Counters since creation; see the driver's page.

        Returns:
            Counts by stable name, sorted.
        """
        return dict(sorted(self.counters.items()))

    def adjust(self, exposure_time_us: float, gain_db: float, tdi_shifts: int) -> None:
        """Refused; a driver that can change settings while it runs overrides this.

        Args:
            exposure_time_us: exposure time, us.
            gain_db: gain, dB.
            tdi_shifts: number of TDI shifts.

        Raises:
            DeviceError: always.
        """
        raise DeviceError(
            f"{self.name}: settings of this head cannot be changed while it runs; change them in "
            "the configuration and start again"
        )

    # Overridden by drivers

    def _slot_returned(self, slot: int) -> None:
        """A slot came back. Called with `_slots` held."""

    def _opened_sentence(self) -> str:
        return f"The head {self.name} is open; nothing to do."

    def _held_settings(self) -> Mapping[str, float | int | str]:
        """What the driver wrote or switched off, with the value that the head holds."""
        return {}

    def _emit_opened(self) -> None:
        self.emitter.emit("opened", self._opened_sentence(), settings=self._held_settings())

    # Used by drivers

    def _mark_in_use(self, slot: int) -> None:
        """Note that a slot goes to the caller with its frame."""
        with self._slots:
            self._slots_in_use.add(slot)

    def _free_slot(self) -> int | None:
        """The next free slot; None, counted and reported, if all are in use."""
        with self._slots:
            free = [
                slot for slot in range(self._memory.slot_count) if slot not in self._slots_in_use
            ]
            if free:
                # In turn, so that a slot that is let go of too early shows at once.
                slot = min(free, key=lambda s: (s <= self._last_slot, s))
                self._last_slot = slot
                return slot
        self.counters["underruns"] += 1
        self._report_underrun()
        return None

    def _report_underrun(self) -> None:
        self.emitter.emit_throttled(
            "underrun",
            f"The head {self.name} lost a frame because all {self._memory.slot_count} slots "
            "are taken. Storage is too slow for this rate; lengthen the interval.",
        )

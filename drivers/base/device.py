"""What every device of ours has: settings, a voice, counters, a life cycle, back-off and an end.

How a device is reached, served and let go of is in the room of its family.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Mapping
from typing import ClassVar, Final

from drivers.base.event_emitter import EventEmitter
from drivers.base.settings import Configured
from drivers.contract import DeviceError, LifeCycle, Sink
from drivers.timescales.clock import BackOff, Clock, MonotonicClock

CLOSE_TIMEOUT_S: Final = 2.0


class DeviceDriver(Configured):
    """A device that one thread of the caller's runs: reached, served, lost and reached again.

    A driver says how: `_reach` opens the device where it is not open, `_serve` delivers until
    `_closing` is set or the device is lost, `_release_device` drops what belongs to the opening.
    `close` and `statistics` are for any thread.
    """

    counted: ClassVar[tuple[str, ...]] = ()
    """Counters that are told even while they are zero."""
    delivery_counter: ClassVar[str] = ""
    """The counter that rises with what is delivered; then the next attempt comes soon again."""

    def __init__(
        self, name: str, settings: Mapping[str, object], *, clock: Clock | None = None
    ) -> None:
        super().__init__(name, settings)
        self.clock: Clock = clock or MonotonicClock()
        self.emitter = EventEmitter(name, self.clock)
        self.counters: Counter[str] = Counter(dict.fromkeys(self.counted, 0))
        self._state = LifeCycle.CREATED
        self._closing = threading.Event()
        self._ended = threading.Event()
        self._ended.set()
        self._is_lost = False

    @property
    def state(self) -> LifeCycle:
        return self._state

    def run(self, sink: Sink) -> None:
        """Deliver until closed. See `drivers.contract.Device`."""
        if self._closing.is_set():
            return
        self._ended.clear()
        self.emitter.sink = sink
        pause = BackOff()
        try:
            while not self._closing.is_set():
                try:
                    self._open_device()
                except DeviceError as error:
                    self._state = LifeCycle.INACTIVE
                    if not self._closing.is_set():
                        sentence = f"{error}. It is tried again by itself."
                        self._emit_lost(sentence, self._event_for(error))
                else:
                    self._emit_opened()
                    self._is_lost = False
                    before = self.counters[self.delivery_counter]
                    self._serve(sink)
                    self._release_device()
                    if self.counters[self.delivery_counter] > before:
                        pause.reset()
                if not self._closing.is_set():
                    self.clock.wait(self._closing, pause.next_s())
        finally:
            self._release_device()
            self.emitter.sink = None
            self._state = LifeCycle.INACTIVE
            self._ended.set()

    def close(self) -> None:
        """End `run` within two seconds and let go of the device; may be called twice."""
        self._closing.set()
        if self._ended.wait(CLOSE_TIMEOUT_S):
            self._release_device()
        self._state = LifeCycle.INACTIVE

    def statistics(self) -> Mapping[str, int]:
        """Counters since creation, by stable name; see the driver's page."""
        return dict(self.counters)

    def _emit_lost(self, sentence: str, event: str = "lost") -> None:
        """Tell of a loss once, until the device is open again."""
        if not self._is_lost:
            self._is_lost = True
            self.emitter.emit(event, sentence, fault=True)

    # For a driver to say

    def _open_device(self) -> None:
        """Open the device where it is not open. DeviceError where it cannot be."""
        raise NotImplementedError

    def _serve(self, sink: Sink) -> None:
        """Deliver until `_closing` is set or the device is lost; tells of a loss itself."""
        raise NotImplementedError

    def _release_device(self) -> None:
        """Drop what belongs to this opening; called twice, too."""

    def _emit_opened(self) -> None:
        """Tell that the device is open."""
        raise NotImplementedError

    def _event_for(self, error: DeviceError) -> str:
        """The event that tells of a device that cannot be opened."""
        return "lost"

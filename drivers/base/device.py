"""Base of all drivers: settings, events, counters, life cycle, back-off and closing.

Opening, reading and releasing a device are in the package of its family.
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
    """A device that is run by one thread of the caller: opened, read, lost and reopened.

    A driver overrides three methods. `_open_device` opens the device if it is not open. `_serve`
    calls `_begin_delivery` as soon as the device does what it is asked for, and delivers until
    `_closing` is set or the device is lost. `_release_device` releases the resources of this
    opening. `close` and `statistics` may be called from any thread.
    """

    counted: ClassVar[tuple[str, ...]] = ()
    """Counters that are reported even while they are zero."""
    delivery_counter: ClassVar[str] = ""
    """The counter of delivered records. If it has risen, the back-off restarts."""

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
        """Present state of the life cycle."""
        return self._state

    def run(self, sink: Sink) -> None:
        """Deliver until `close` is called. See `drivers.contract.Device`.

        Args:
            sink: receives every record, in this thread.
        """
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
                        sentence = f"{error}. Retrying automatically."
                        self._emit_lost(sentence, self._event_for(error))
                else:
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
        """End `run` within two seconds and release the device; may be called twice."""
        self._closing.set()
        if self._ended.wait(CLOSE_TIMEOUT_S):
            self._release_device()
        self._state = LifeCycle.INACTIVE

    def statistics(self) -> Mapping[str, int]:
        """Counters since creation; see the driver's page.

        Returns:
            Counts by stable name.
        """
        return dict(self.counters)

    def _begin_delivery(self) -> None:
        """Become ACTIVE, and report it: from here on the device delivers what it is asked for."""
        self._state = LifeCycle.ACTIVE
        self._emit_opened()
        self._is_lost = False

    def _emit_lost(self, sentence: str, event: str = "lost") -> None:
        """Report a loss once, until the device is open again."""
        if not self._is_lost:
            self._is_lost = True
            self.emitter.emit(event, sentence, fault=True)

    # Overridden by drivers

    def _open_device(self) -> None:
        """Open the device if it is not open. DeviceError if that fails."""
        raise NotImplementedError

    def _serve(self, sink: Sink) -> None:
        """Begin delivery; deliver until `_closing` is set or the device is lost; report a loss."""
        raise NotImplementedError

    def _release_device(self) -> None:
        """Release the resources of this opening; may be called twice."""

    def _emit_opened(self) -> None:
        """Report that the device is open."""
        raise NotImplementedError

    def _event_for(self, error: DeviceError) -> str:
        """The name of the event for a device that cannot be opened."""
        return "lost"

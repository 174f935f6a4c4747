"""Software triggers of all heads, fired together: the degraded mode, with its jitter stated."""

from __future__ import annotations

import concurrent.futures
import logging
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import ClassVar

from drivers.base.settings import Configured, Setting
from drivers.contract import DeviceError, Head, TriggerPulse
from drivers.timescales.clock import Clock, MonotonicClock
from drivers.triggers.delays import check_delays

log = logging.getLogger(__name__)


class SoftwareTrigger(Configured):
    """Fires every head by its own software trigger, in parallel, with one thread per head.

    `heads` are the heads by output (cone). The time of a pulse is the middle between the first and
    the last possible instant of any head, minus its delay; sigma is half of that interval.
    """

    kind: ClassVar = "trigger"
    fires_heads: ClassVar = True
    head_trigger_source: ClassVar = "software"

    timeout_s = Setting(
        2.0, minimum=0.1, maximum=10, help="longest wait for the heads to be triggered"
    )

    def __init__(
        self,
        name: str,
        settings: Mapping[str, object],
        *,
        heads: Mapping[str, Sequence[Head]],
        clock: Clock | None = None,
    ) -> None:
        super().__init__(name, settings)
        self._clock: Clock = clock or MonotonicClock()
        self._heads = [(output, head) for output, group in heads.items() for head in group]
        if not self._heads:
            raise DeviceError(f"{name}: a software trigger needs at least one head")
        self._delays_ns = dict.fromkeys(heads, 0)
        self._closing = threading.Event()
        self._counters: Counter[str] = Counter(pulses=0, failures=0)
        # The threads are started before the first pulse: a start takes longer than a trigger.
        self._threads = concurrent.futures.ThreadPoolExecutor(
            len(self._heads), thread_name_prefix=f"{name}-fire"
        )

    def bind(self) -> Mapping[str, str]:
        """Nothing is opened. See `drivers.contract.Trigger`.

        Returns:
            The outputs and the number of heads.
        """
        return {"outputs": " ".join(self._delays_ns), "heads": str(len(self._heads))}

    def program(self, delays_ns: Mapping[str, int]) -> None:
        """Set the delay of every output named.

        Args:
            delays_ns: delay from firing by output, ns.

        Raises:
            DeviceError: unknown output, or delay out of range.
        """
        check_delays(self.name, delays_ns, self._delays_ns)
        self._delays_ns.update(delays_ns)

    def fire(self, sequence: int) -> TriggerPulse:
        """Trigger all heads; returns if at least one was triggered, and logs the failed ones.

        Args:
            sequence: number of the pulse.

        Returns:
            The pulse; `count` is the number of pulses since creation.

        Raises:
            DeviceError: no head was triggered (one line per head), or the trigger is closed.
        """
        if self._closing.is_set():
            raise DeviceError(f"{self.name}: the trigger is closed; create a new one")
        start_ns = self._clock.mono_ns()
        pending = {
            self._threads.submit(self._fire_one, head, self._delays_ns[output], start_ns): head
            for output, head in self._heads
        }
        done, late = concurrent.futures.wait(pending, timeout=self.timeout_s)
        failures = [f"{pending[f].name}: not triggered within {self.timeout_s:g} s" for f in late]
        spans: list[tuple[int, int]] = []
        for future in done:
            error = future.exception()
            if error is None:
                spans.append(future.result())
            elif isinstance(error, DeviceError):
                failures.append(str(error))
            else:
                raise error
        self._counters["failures"] += len(failures)
        if not spans:
            raise DeviceError("\n".join([f"{self.name}: no head was triggered", *failures]))
        for failure in failures:
            log.warning("trigger=%s sequence=%d failure=%r", self.name, sequence, failure)
        self._counters["pulses"] += 1
        first_ns = min(before for before, _ in spans)
        last_ns = max(after for _, after in spans)
        sigma_ns = (last_ns - first_ns + 1) // 2
        # Each head fired at its own instant within that interval.
        count, spread_ns = self._counters["pulses"], round(sigma_ns / 3**0.5)
        return TriggerPulse(sequence, first_ns + sigma_ns, sigma_ns, count, spread_ns)

    def close(self) -> None:
        """End the threads; may be called twice."""
        self._closing.set()
        self._threads.shutdown(wait=False, cancel_futures=True)

    def statistics(self) -> Mapping[str, int]:
        """Counters since creation.

        Returns:
            pulses, failures (heads that were not triggered).
        """
        return dict(self._counters)

    def _fire_one(self, head: Head, delay_ns: int, start_ns: int) -> tuple[int, int]:
        """Trigger a head at its delay; returns the first and last possible time minus the delay."""
        left_ns = start_ns + delay_ns - self._clock.mono_ns()
        if left_ns > 0:
            self._clock.wait(self._closing, left_ns * 1e-9)
        before_ns = self._clock.mono_ns()
        head.trigger()
        after_ns = self._clock.mono_ns()
        return before_ns - delay_ns, after_ns - delay_ns

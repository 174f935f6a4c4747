"""What the probes read over the last minutes, and what they read when an exposure was made."""

from __future__ import annotations

from collections import deque

from daemon.exposure import TemperatureRecord
from drivers.contract import TemperatureSample

MEMORY = 128
"""Samples kept of each probe; two minutes of a probe read every second."""


class Temperatures:
    """The recent samples of every probe."""

    def __init__(self) -> None:
        self._samples: dict[str, deque[TemperatureSample]] = {}

    def add(self, sample: TemperatureSample) -> None:
        """Note a reading."""
        self._samples.setdefault(sample.probe, deque(maxlen=MEMORY)).append(sample)

    def __contains__(self, probe: str) -> bool:
        """Whether a probe was ever read."""
        return probe in self._samples

    def at(self, mono_ns: int) -> tuple[TemperatureRecord, ...]:
        """The last reading of every probe at an instant; its first one where that came later."""
        records = []
        for probe, samples in self._samples.items():
            before = (s for s in reversed(samples) if s.mono_ns <= mono_ns)
            sample = next(before, samples[0])
            records.append(TemperatureRecord(probe, sample.value_c, mono_ns - sample.mono_ns))
        return tuple(records)

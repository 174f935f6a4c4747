"""Probe readings of the last minutes, and the readings at an exposure.

A sensor with a thermal lag gets its own reading in addition to that of its probe: the probe's
history through a first-order lag.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

from daemon.mission.exposure import TemperatureRecord
from drivers.contract import TemperatureSample
from processing.geometry.drift import lag_step, lagged_probe
from processing.rig import Sensor

SAMPLES_PER_PROBE = 128
"""Samples kept of each probe; two minutes of a probe read every second."""


class TemperatureHistory:
    """The recent samples of every probe, and the lagged ones of sensors that ask for them.

    A lag begins in balance with the first reading: what happened before it is forgotten with the
    lag's own time constant. Readings of an open probe are passed over, the next is reached in a
    straight line.
    """

    def __init__(self, lagged: Sequence[Sensor] = ()) -> None:
        """`lagged` are the sensors with `drift.lag_s` above zero."""
        self._samples: dict[str, deque[TemperatureSample]] = {}
        self._lagged = tuple(lagged)
        self._last_read: dict[str, TemperatureSample] = {}

    def add(self, sample: TemperatureSample) -> None:
        """Note a reading."""
        self._append(sample.probe, sample)
        if sample.value_c is None:
            return
        before = self._last_read.get(sample.probe)
        if before is not None and sample.mono_ns <= before.mono_ns:
            return
        for sensor in self._lagged:
            if sensor.probe == sample.probe:
                self._update_lagged(sensor, before, sample)
        self._last_read[sample.probe] = sample

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

    def _update_lagged(
        self, sensor: Sensor, before: TemperatureSample | None, now: TemperatureSample
    ) -> None:
        name = lagged_probe(sensor)
        value_c = now.value_c
        assert value_c is not None
        if before is not None and before.value_c is not None:
            lagged_c = self._samples[name][-1].value_c
            assert lagged_c is not None
            step_s = (now.mono_ns - before.mono_ns) * 1e-9
            value_c = lag_step(lagged_c, before.value_c, value_c, step_s, sensor.drift.lag_s)
        self._append(name, replace(now, probe=name, value_c=value_c))

    def _append(self, name: str, sample: TemperatureSample) -> None:
        self._samples.setdefault(name, deque(maxlen=SAMPLES_PER_PROBE)).append(sample)

"""The host's own temperature sensors as a thermometer.

Finding and reading a sensor is in `drivers.thermometers.host.sensors`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Final

from drivers.base.device import DeviceDriver
from drivers.base.settings import Setting
from drivers.contract import DeviceError, LifeCycle, Sink, TemperatureSample
from drivers.thermometers.host.sensors import HostSensor, SensorLostError, find_sensors
from drivers.timescales.clock import Clock

SYSFS: Final = Path("/sys")


class HostThermometer(DeviceDriver):
    """Sensors of the Linux host: hwmon chips (processor, disks, boards) and iio devices.

    A sensor is named `chip/channel` or `chip/label`, or `chip@device/...` if chips share a name. It
    is never named by its number, which changes from boot to boot. A sensor whose files vanish
    yields nothing until it is found again by its name. A sensor that its chip reports as faulty
    yields samples with `value_c=None`.

    Source: Linux Documentation/hwmon/sysfs-interface, ABI/testing/sysfs-bus-iio.
    """

    kind: ClassVar = "thermometer"
    counted = ("readings", "failures", "open_sensors", "losses")

    sensors: Setting[tuple[str, ...]] = Setting(
        (), required=True, minimum=1, maximum=64, help="sensors as chip/channel or chip/label"
    )
    channels: Setting[tuple[str, ...]] = Setting(
        (), required=True, minimum=1, maximum=64, help="names of the probes, one for each sensor"
    )
    interval_s = Setting(1.0, minimum=0.05, maximum=3600, help="time from reading to reading")

    def __init__(
        self,
        name: str,
        settings: Mapping[str, object],
        *,
        clock: Clock | None = None,
        root: Path = SYSFS,
    ) -> None:
        super().__init__(name, settings, clock=clock)
        self._root = root
        self._found: dict[str, HostSensor] = {}
        self._lost: set[str] = set()

    @classmethod
    def setting_conflicts(cls, values: Mapping[str, Any]) -> list[str]:
        sensors, channels = values["sensors"], values["channels"]
        found = []
        if len(sensors) != len(channels):
            found.append(f"channels has {len(channels)} names; sensors has {len(sensors)}")
        for key in ("sensors", "channels"):
            twice = sorted({name for name in values[key] if values[key].count(name) > 1})
            if twice:
                found.append(f"{key} names {', '.join(twice)} twice; once is enough")
        wrong = [sensor for sensor in sensors if "/" not in sensor.strip("/")]
        if wrong:
            found.append(f"sensors names {', '.join(wrong)}; chip/channel, as coretemp/temp1")
        return found

    def bind(self) -> Mapping[str, str]:
        """Find and read every sensor. See `drivers.contract.Device`.

        Returns:
            The reading of each probe.

        Raises:
            DeviceError: a sensor is missing, ambiguous or unreadable; one line each.
        """
        found = {}
        problems = []
        known = find_sensors(self._root)
        for probe, sensor in zip(self.channels, self.sensors, strict=True):
            try:
                self._found[probe] = self._find(sensor, known)
                value_c = self._found[probe].read_c()
            except SensorLostError as error:
                problems.append(f"{self.name}: {error}")
                continue
            found[f"probe {probe}"] = "open" if value_c is None else f"{value_c:.1f} degC"
        if problems:
            raise DeviceError("\n".join(problems))
        self._state = LifeCycle.BOUND
        return found

    def _open_device(self) -> None:
        """Nothing to open: sysfs is always there; missing sensors are searched at every reading."""

    def _emit_opened(self) -> None:
        self.emitter.emit("opened", f"The host's sensors {self.name} are read; nothing to do.")

    def _serve(self, sink: Sink) -> None:
        self._begin_delivery()
        next_ns = self.clock.mono_ns()
        while not self._closing.is_set():
            self._read_all(sink)
            now_ns = self.clock.mono_ns()
            next_ns = max(next_ns + round(self.interval_s * 1e9), now_ns)
            self.clock.wait(self._closing, (next_ns - now_ns) * 1e-9)

    def _read_all(self, sink: Sink) -> None:
        known: list[HostSensor] | None = None
        for probe, sensor in zip(self.channels, self.sensors, strict=True):
            try:
                if probe not in self._found:
                    known = find_sensors(self._root) if known is None else known
                    self._found[probe] = self._find(sensor, known)
                value_c = self._found[probe].read_c()
            except SensorLostError as error:
                self._found.pop(probe, None)
                self.counters["failures"] += 1
                if probe not in self._lost:
                    self._lost.add(probe)
                    self.counters["losses"] += 1
                    self.emitter.emit(
                        "lost",
                        f"The sensor {sensor} of probe {probe} cannot be read ({error}). Check "
                        "that its kernel module is loaded. Retrying automatically.",
                        fault=True,
                    )
                continue
            if probe in self._lost:
                self._lost.discard(probe)
                self.emitter.emit(
                    "recovered", f"The sensor {sensor} of probe {probe} is back; nothing to do."
                )
            self.counters["readings"] += 1
            self.counters["open_sensors"] += value_c is None
            sink(TemperatureSample(probe, value_c, self.clock.mono_ns()))

    def _find(self, sensor: str, known: list[HostSensor]) -> HostSensor:
        matches = [candidate for candidate in known if sensor in candidate.aliases]
        if len(matches) == 1:
            return matches[0]
        if matches:
            devices = ", ".join(candidate.aliases[-1] for candidate in matches)
            raise SensorLostError(f"sensor {sensor} is there {len(matches)} times: {devices}")
        listed = ", ".join(candidate.aliases[0] for candidate in known[:20]) or "none at all"
        raise SensorLostError(f"sensor {sensor} is not there; the host has {listed}")

"""Temperature sensors of the kernel below /sys: hwmon chips and iio devices.

This module finds sensors by name and reads them; `drivers.thermometers.host.thermometer` decides
when.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from drivers import DriverError

MAX_TEXT: Final = 128
_INPUT: Final = re.compile(r"temp\d+_input")
_IIO: Final = re.compile(r"in_(temp\w*?)_(input|raw)")
_NUMBER: Final = re.compile(r"[-+]?\d{1,12}(\.\d{1,12})?")


class SensorLostError(DriverError):
    """The sensor's files cannot be read or contain no number; internal."""


@dataclass(frozen=True)
class HostSensor:
    """One temperature of the host.

    `chip` is the name given by its kernel driver. `device` is the parent device; it distinguishes
    chips of the same name. `channel` is such as temp1 or temp_ambient, `label` the chip's label.
    """

    chip: str
    device: str
    channel: str
    label: str
    path: Path
    is_raw: bool

    @property
    def aliases(self) -> tuple[str, ...]:
        """The names of the sensor in a configuration, the shortest first."""
        # Quirk: the number of a hwmon chip changes from boot to boot. It is not part of a name.
        # Upstream: no report known (2026-11-23).
        channels = (self.channel, self.label) if self.label else (self.channel,)
        chips = (self.chip, f"{self.chip}@{self.device}") if self.device else (self.chip,)
        return tuple(f"{chip}/{channel}" for chip in chips for channel in channels)

    def read_c(self) -> float | None:
        """Read the sensor.

        Returns:
            Temperature, degC; None if the chip reports an open sensor.

        Raises:
            SensorLostError: it no longer exists or does not answer.
        """
        if self.is_raw:
            stem = self.path.name.removesuffix("_raw")
            raw = _number(self.path)
            offset = _number_or(self.path.with_name(f"{stem}_offset"), 0.0)
            scale = _number_or(self.path.with_name(f"{stem}_scale"), 1.0)
            return (raw + offset) * scale / 1000
        fault = self.path.with_name(self.path.name.removesuffix("_input") + "_fault")
        if _number_or(fault, 0.0) != 0:
            return None
        return _number(self.path) / 1000


def find_sensors(root: Path) -> list[HostSensor]:
    """Every temperature of the host.

    Args:
        root: where sysfs is mounted, normally /sys.

    Returns:
        The sensors, hwmon before iio; empty if the kernel has none.

    Source: Linux Documentation/hwmon/sysfs-interface, ABI/testing/sysfs-bus-iio.
    """
    found: list[HostSensor] = []
    for folder in _folders(root / "class" / "hwmon", "hwmon*"):
        found += [
            _sensor(folder, path, path.name.removesuffix("_input"))
            for path in _folders(folder, "temp*_input")
            if _INPUT.fullmatch(path.name)
        ]
    for folder in _folders(root / "bus" / "iio" / "devices", "iio:device*"):
        channels: dict[str, Path] = {}
        for path in _folders(folder, "in_temp*"):
            named = _IIO.fullmatch(path.name)
            # A value computed by the driver takes precedence over a raw value.
            if named and (named[2] == "input" or named[1] not in channels):
                channels[named[1]] = path
        found += [_sensor(folder, path, channel) for channel, path in channels.items()]
    return found


def _folders(parent: Path, pattern: str) -> Iterator[Path]:
    try:
        yield from sorted(parent.glob(pattern), key=lambda p: (len(p.name), p.name))
    except OSError:
        return


def _sensor(folder: Path, path: Path, channel: str) -> HostSensor:
    device = folder / "device"
    label = path.with_name(re.sub(r"_(input|raw)$", "_label", path.name))
    return HostSensor(
        chip=_text_or(folder / "name", folder.name),
        device=device.resolve().name if device.is_symlink() else "",
        channel=channel,
        label=_text_or(label, ""),
        path=path,
        is_raw=path.name.endswith("_raw"),
    )


def _text(path: Path) -> str:
    with path.open("rb") as stream:
        return stream.read(MAX_TEXT).decode("utf-8", "replace").strip()


def _text_or(path: Path, otherwise: str) -> str:
    try:
        return _text(path) or otherwise
    except OSError:
        return otherwise


def _number(path: Path) -> float:
    try:
        text = _text(path)
    except OSError as error:
        raise SensorLostError(f"{path}: {error.strerror or error}") from error
    if _NUMBER.fullmatch(text) is None:
        raise SensorLostError(f"{path} contains {text[:40]!r}, which is no number")
    return float(text)


def _number_or(path: Path, otherwise: float) -> float:
    return _number(path) if path.exists() else otherwise

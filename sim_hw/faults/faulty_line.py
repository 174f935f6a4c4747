"""Faults of emulated devices on a line, applied between a device and its host.

Called from the device's own thread with everything it sends, and with nothing every 50 ms, so that
delayed bytes can be released later and unsolicited bytes can be added.
"""

from __future__ import annotations

import heapq
import itertools
import time
from typing import Protocol

from sim_hw.devices.device_loop import LineDevice
from sim_hw.faults.channel import Channel
from sim_hw.world.world_clock import WorldClock

NOISE_BYTES = 2000


class PluggableLine(Protocol):
    """A line whose cable can be pulled so that the host sees its port go."""

    def unplug(self) -> None: ...

    def plug_in(self) -> None: ...


class FaultyWire:
    """The `wire` of a device: its channel, and the cable where the line has one to pull."""

    def __init__(
        self, device: LineDevice, channel: Channel[bytes], cable: PluggableLine | None = None
    ) -> None:
        self._device = device
        self._channel = channel
        self._cable = cable
        self._is_plugged = True
        self._later: list[tuple[int, int, bytes]] = []
        self._order = itertools.count()

    def __call__(self, data: bytes, mono_ns: int) -> bytes:
        """What goes to the host now."""
        channel = self._channel
        if channel.counter_restarts(mono_ns):
            self._device.restart_count()
        if channel.has_power_cycled(mono_ns):
            self._device.restart()
        self._handle_the_cable(mono_ns)
        for topic, message in self._device.parts(data) if data else ():
            for delivery in channel.send(message, mono_ns, topic=topic):
                heapq.heappush(self._later, (delivery.at_ns, next(self._order), delivery.message))
        due = b""
        while self._later and self._later[0][0] <= mono_ns:
            due += heapq.heappop(self._later)[2]
        if channel.flood_is_due(mono_ns):
            due += channel.noise(NOISE_BYTES)
        return due if channel.is_connected(mono_ns) else b""

    def _handle_the_cable(self, mono_ns: int) -> None:
        is_plugged = self._channel.is_connected(mono_ns)
        if is_plugged == self._is_plugged:
            return
        self._is_plugged = is_plugged
        if self._cable is None:
            return
        if is_plugged:
            self._cable.plug_in()
        else:
            self._cable.unplug()


class FaultyWorldClock(WorldClock):
    """The time a receiver believes: that of the world, and the error of its clock faults."""

    def __init__(self, world: WorldClock, channel: Channel[bytes]) -> None:
        super().__init__(world.gps_ns_at_start, world.mono_ns_at_start)
        object.__setattr__(self, "_channel", channel)

    _channel: Channel[bytes]

    def error_ns(self, mono_ns: int) -> int:
        """How far it is ahead of the world."""
        return self._channel.clock_error_ns(mono_ns)

    def own_gps_ns(self, world_gps_ns: int) -> int:
        """What it shows at a GPS time of the world."""
        return world_gps_ns + self.error_ns(super().mono_ns(world_gps_ns))

    def world_gps_ns(self, own_gps_ns: int) -> int:
        """What time it really is, by the error it has now."""
        return own_gps_ns - self.error_ns(time.monotonic_ns())

    def gps_ns(self, mono_ns: int) -> int:
        return super().gps_ns(mono_ns) + self.error_ns(mono_ns)

    def mono_ns(self, gps_ns: int) -> int:
        """When its clock shows this, by the error it has now."""
        return super().mono_ns(gps_ns - self.error_ns(time.monotonic_ns()))

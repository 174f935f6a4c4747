"""An emulated Applanix system: groups 1 and 2 every epoch, 3 and 7 every second, events at once.

Its groups are encoded in `applanix_messages`; epochs and edges are those of every receiver.
"""

from __future__ import annotations

from sim_hw.receivers import applanix_messages as applanix
from sim_hw.receivers.emulated_receiver import Edge, EmulatedReceiver
from sim_hw.world.world_clock import NS_PER_S

SATELLITES = 17
POS_S_AT_START = 4321.0
"""Seconds since power-on, the second time of every group."""


class ApplanixReceiver(EmulatedReceiver):
    """Rising edges are event 1, with their number since power-on."""

    alignment = applanix.FULL_NAVIGATION
    synchronization = applanix.FULLY_SYNCHRONIZED

    def epoch_bytes(self, epoch_gps_ns: int) -> bytes:
        pos_s = self._pos_s(epoch_gps_ns)
        parts = []
        if self.is_first_of_second(epoch_gps_ns):
            count = int(pos_s - POS_S_AT_START)
            parts += [
                applanix.primary_gnss(epoch_gps_ns, pos_s, SATELLITES, self.leap_seconds),
                applanix.pps(epoch_gps_ns, pos_s, count, self.synchronization),
            ]
        parts += [
            applanix.performance(epoch_gps_ns, pos_s, self.accuracy),
            applanix.navigation(epoch_gps_ns, pos_s, self.state(epoch_gps_ns), self.alignment),
        ]
        return b"".join(parts)

    def event_bytes(self, edge: Edge) -> bytes:
        if not edge.is_rising:
            return b""
        self.counts["mark_messages"] += 1
        return applanix.event(edge.gps_ns, self._pos_s(edge.gps_ns), edge.number)

    def _pos_s(self, gps_ns: int) -> float:
        return POS_S_AT_START + (gps_ns - self.clock.gps_ns_at_start) / NS_PER_S

"""An emulated Trimble board with GSOF: a transmission every epoch, and one for every event.

Its records are encoded in `gsof_messages`; epochs and edges are those of every receiver.
"""

from __future__ import annotations

from sim_hw.receivers import gsof_messages as gsof
from sim_hw.receivers.emulated_receiver import Edge, EmulatedReceiver

SATELLITES = 22


class GsofReceiver(EmulatedReceiver):
    """Records of the antenna and of the inertial solution, in two pages; rising edges at once."""

    _transmissions = 0

    def epoch_bytes(self, epoch_gps_ns: int) -> bytes:
        state = self.state(epoch_gps_ns)
        records = gsof.time(epoch_gps_ns, SATELLITES) + gsof.llh(state) + gsof.velocity(state)
        records += gsof.sigma(self.accuracy)
        if self.is_first_of_second(epoch_gps_ns):
            records += gsof.utc(epoch_gps_ns, self.leap_seconds)
        records += gsof.ins_rms(epoch_gps_ns, self.accuracy)
        return self._transmission(records + gsof.ins_navigation(epoch_gps_ns, state))

    def event_bytes(self, edge: Edge) -> bytes:
        if not edge.is_rising:
            return b""
        self.counts["mark_messages"] += 1
        return self._transmission(gsof.event_marker(edge.gps_ns, edge.number))

    def _transmission(self, records: bytes) -> bytes:
        self._transmissions += 1
        return gsof.transmission(self._transmissions, records)

"""An emulated VectorNav unit: one binary output every epoch, and one for every edge on SyncIn.

Its messages are encoded in `vectornav_messages`; epochs and edges are those of every receiver.
"""

from __future__ import annotations

from sim_hw.receivers import vectornav_messages as vectornav
from sim_hw.receivers.emulated_receiver import Edge, EmulatedReceiver

SATELLITES = 16
MEASUREMENT_PERIOD_NS = 2_500_000
"""A message belongs to the inertial measurement after the edge; there are 400 a second."""


class VectornavReceiver(EmulatedReceiver):
    """Navigation every epoch; time, time since the edge and count of edges for every rising
    edge."""

    time_status = vectornav.ALL_TIMES_OK

    def epoch_bytes(self, epoch_gps_ns: int) -> bytes:
        return vectornav.navigation(
            epoch_gps_ns,
            self.state(epoch_gps_ns),
            self.accuracy,
            SATELLITES,
            self.leap_seconds,
            self.time_status,
        )

    def event_bytes(self, edge: Edge) -> bytes:
        if not edge.is_rising:
            return b""
        self.counts["mark_messages"] += 1
        since_edge_ns = -edge.gps_ns % MEASUREMENT_PERIOD_NS
        return vectornav.sync_in(
            edge.gps_ns + since_edge_ns, since_edge_ns, edge.number, self.time_status
        )

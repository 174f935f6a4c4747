"""An emulated Septentrio receiver: SBF with position, attitude and external events.

Its blocks are encoded in `septentrio_messages`; epochs and edges are those of every receiver.
"""

from __future__ import annotations

from typing import ClassVar

from sim_hw.receivers import septentrio_messages as sbf
from sim_hw.receivers.emulated_receiver import Edge, EmulatedReceiver

SATELLITES = 24
EVENT_A = 1


class SeptentrioReceiver(EmulatedReceiver):
    """Every epoch PVTGeodetic with its covariances, DOP, EndOfPVT and AttEuler; events at once.

    Epochs are whole periods of the receiver's own time, which its clock bias takes off GPS by up to
    half a millisecond, as these receivers let it wander. It sends its time once a second. As after
    switching on, rising edges only are reported; `reported_edges` selects them.
    """

    reported_edges: frozenset[int] = frozenset((sbf.RISING,))

    clock_bias_max_ns: ClassVar[int] = 500_000

    def epoch_bytes(self, epoch_gps_ns: int) -> bytes:
        rx_ns = self.nominal_ns(epoch_gps_ns)
        # The clock is behind where an epoch comes later than its nominal time.
        bias_ns = rx_ns - epoch_gps_ns
        state = self.state(epoch_gps_ns)
        parts = [
            sbf.pvt_geodetic(rx_ns, bias_ns, state, self.accuracy, SATELLITES),
            sbf.pos_cov_geodetic(rx_ns, self.accuracy),
            sbf.vel_cov_geodetic(rx_ns, self.accuracy),
            sbf.dop(rx_ns, SATELLITES),
            sbf.end_of_pvt(rx_ns),
            sbf.att_euler(rx_ns, state, SATELLITES),
        ]
        if self.is_first_of_second(epoch_gps_ns):
            parts.append(sbf.receiver_time(rx_ns, self.leap_seconds))
        return b"".join(parts)

    def event_bytes(self, edge: Edge) -> bytes:
        polarity = sbf.RISING if edge.is_rising else sbf.FALLING
        if polarity not in self.reported_edges:
            return b""
        bias_ns = -self.bias_ns(edge.gps_ns)
        rx_ns = edge.gps_ns + bias_ns
        self.counts["mark_messages"] += 1
        received = sbf.ext_event(rx_ns, bias_ns, source=EVENT_A, polarity=polarity)
        return received + sbf.ext_event_pvt_geodetic(
            rx_ns, bias_ns, self.state(edge.gps_ns), self.accuracy, SATELLITES
        )

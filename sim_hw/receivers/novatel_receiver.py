"""An emulated NovAtel OEM7 receiver with SPAN: binary logs, marks with time and with solution.

Its logs are encoded in `novatel_messages`; epochs and edges are those of every receiver.
"""

from __future__ import annotations

from sim_hw.receivers import novatel_messages as oem7
from sim_hw.receivers.emulated_receiver import Edge, EmulatedReceiver

SATELLITES = 18
CLOCK_OFFSET_MAX_NS = 200
"""Offset of the receiver's steered clock from GPS; MARKxTIME contains it, solutions do not."""


class NovatelReceiver(EmulatedReceiver):
    """INSPVAX and INSATT every epoch; BESTPOS, BESTVEL and TIME once a second; marks at once.

    MARKxTIME and then MARKxPVA report every rising edge on `mark_input` (1 to 4).
    """

    mark_input = 1

    def epoch_bytes(self, epoch_gps_ns: int) -> bytes:
        state = self.state(epoch_gps_ns)
        parts = []
        if self.is_first_of_second(epoch_gps_ns):
            parts += [
                oem7.time_log(epoch_gps_ns, self.leap_seconds),
                oem7.bestpos(epoch_gps_ns, state, self.accuracy, SATELLITES),
                oem7.bestvel(epoch_gps_ns, state),
            ]
        parts.append(oem7.inspvax(epoch_gps_ns, state, self.accuracy))
        parts.append(oem7.insatt(epoch_gps_ns, state))
        return b"".join(parts)

    def event_bytes(self, edge: Edge) -> bytes:
        if not edge.is_rising:
            return b""
        self.counts["mark_messages"] += 2
        offset_ns = self.random.randrange(-CLOCK_OFFSET_MAX_NS, CLOCK_OFFSET_MAX_NS)
        return oem7.mark_time(
            self.mark_input, edge.gps_ns, offset_ns, self.leap_seconds
        ) + oem7.mark_pva(self.mark_input, edge.gps_ns, self.state(edge.gps_ns))

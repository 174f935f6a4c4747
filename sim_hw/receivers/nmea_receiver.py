"""An emulated receiver that speaks NMEA 0183 only, with attitude and event marks.

Its sentences are encoded in `nmea_sentences`; epochs and edges are those of every receiver.
"""

from __future__ import annotations

from sim_hw.receivers import nmea_sentences as sentences
from sim_hw.receivers.emulated_receiver import Edge, EmulatedReceiver

SATELLITES = 17
RTK = 4


class NmeaReceiver(EmulatedReceiver):
    """RMC, GGA, GST, VTG, HDT and PASHR every epoch, ZDA once a second, $PTNL,EVT at once.

    The standard's resolution is what a host gets: 10 ms, 1e-5 minutes (2 cm), 0.1 m of height; an
    event has a resolution of 1 us.
    """

    def epoch_bytes(self, epoch_gps_ns: int) -> bytes:
        state, leap_seconds, accuracy = self.state(epoch_gps_ns), self.leap_seconds, self.accuracy
        parts = [
            sentences.rmc(epoch_gps_ns, state, leap_seconds),
            sentences.gga(epoch_gps_ns, state, SATELLITES, leap_seconds, quality=RTK),
            sentences.gst(epoch_gps_ns, accuracy.horizontal_m, accuracy.vertical_m, leap_seconds),
            sentences.vtg(state),
            sentences.hdt(state),
            sentences.pashr(
                epoch_gps_ns, state, accuracy.roll_pitch_deg, accuracy.heading_deg, leap_seconds
            ),
        ]
        if self.is_first_of_second(epoch_gps_ns):
            parts.append(sentences.zda(epoch_gps_ns, leap_seconds))
        return b"".join(parts)

    def event_bytes(self, edge: Edge) -> bytes:
        if not edge.is_rising:
            return b""
        self.counts["mark_messages"] += 1
        return sentences.ptnl_event(edge.gps_ns, edge.number, self.leap_seconds)

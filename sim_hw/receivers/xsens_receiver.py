"""An emulated Xsens MTi: MTData2 every epoch, and one for every edge on SyncIn.

Its messages are encoded in `xsens_messages`; epochs and edges are those of every receiver.
"""

from __future__ import annotations

from sim_hw.receivers import xsens_messages as xsens
from sim_hw.receivers.emulated_receiver import Edge, EmulatedReceiver

SATELLITES = 15
TICKS_AT_START = (1 << 32) - 20_000
"""Ticks wrap two seconds after the world begins: a unit that was on for five days."""
SAMPLE_PERIOD_NS = 2_500_000
"""A trigger is sent with the sample after it; there are 400 a second."""


class XsensReceiver(EmulatedReceiver):
    """Time, attitude, place and velocity every epoch, GnssPvtData once a second, edges at once.

    Both edges are reported. The time stamp of an edge is resolved to 0.1 ms.
    """

    utc_flags = xsens.UTC_RESOLVED

    def epoch_bytes(self, epoch_gps_ns: int) -> bytes:
        state = self.state(epoch_gps_ns)
        parts = b""
        if self.is_first_of_second(epoch_gps_ns):
            parts = xsens.message(
                xsens.gnss_pvt(epoch_gps_ns, state, self.accuracy, SATELLITES, self.leap_seconds)
            )
        return parts + xsens.message(
            *self._times(epoch_gps_ns), *xsens.navigation(state), xsens.status_word()
        )

    def event_bytes(self, edge: Edge) -> bytes:
        self.counts["mark_messages"] += edge.is_rising
        polarity = xsens.RISING if edge.is_rising else xsens.FALLING
        sample_gps_ns = edge.gps_ns - edge.gps_ns % -SAMPLE_PERIOD_NS
        return xsens.message(
            *self._times(sample_gps_ns),
            xsens.trigger_in(self._ticks(edge.gps_ns), polarity, edge.number),
            xsens.status_word(),
        )

    def _times(self, gps_ns: int) -> tuple[xsens.Datum, ...]:
        return (
            xsens.utc_time(gps_ns, self.leap_seconds, self.utc_flags),
            xsens.sample_time_fine(self._ticks(gps_ns)),
        )

    def _ticks(self, gps_ns: int) -> int:
        return TICKS_AT_START + (gps_ns - self.clock.gps_ns_at_start) // xsens.TICK_NS

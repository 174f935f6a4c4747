"""An emulated SBG inertial unit: sbgECom logs on its own time stamps, events on Sync In A.

Its logs are encoded in `sbg_messages`; epochs and edges are those of every receiver.
"""

from __future__ import annotations

from sim_hw.receivers import sbg_messages as sbg
from sim_hw.receivers.emulated_receiver import Edge, EmulatedReceiver

SATELLITES = 19
STAMP_AT_START_US = (1 << 32) - 2_000_000
"""Time stamps wrap two seconds after the world begins: a unit that was on for 71 minutes."""


class SbgReceiver(EmulatedReceiver):
    """EKF_EULER and EKF_NAV every epoch; UTC_TIME and GPS1_POS once a second; events at once.

    Rising edges are reported. A time stamp is resolved to a microsecond.
    """

    clock_status = sbg.CLOCK_VALID
    utc_status = sbg.UTC_VALID

    def epoch_bytes(self, epoch_gps_ns: int) -> bytes:
        stamp_us = self._stamp_us(epoch_gps_ns)
        state = self.state(epoch_gps_ns)
        parts = []
        if self.is_first_of_second(epoch_gps_ns):
            parts += [
                sbg.utc_time(
                    stamp_us, epoch_gps_ns, self.leap_seconds, self.clock_status, self.utc_status
                ),
                sbg.gps1_pos(stamp_us, epoch_gps_ns, state, self.accuracy, SATELLITES),
            ]
        parts.append(sbg.ekf_euler(stamp_us, state, self.accuracy))
        parts.append(sbg.ekf_nav(stamp_us, state, self.accuracy))
        return b"".join(parts)

    def event_bytes(self, edge: Edge) -> bytes:
        if not edge.is_rising:
            return b""
        self.counts["mark_messages"] += 1
        return sbg.event(self._stamp_us(edge.gps_ns))

    def _stamp_us(self, gps_ns: int) -> int:
        return sbg.stamp_us(gps_ns - self.clock.gps_ns_at_start, STAMP_AT_START_US)

"""What the emulated receivers of the tests report, and where they stand in time."""

from __future__ import annotations

from sim_hw.receivers.emulated_receiver import ReceiverState

NS = 1_000_000_000
WEEK_NS = 7 * 86_400 * NS
# 2026-11-01T10:00:00 UTC, a Sunday: 36,018 s into GPS week 2443.
START_GPS_NS = 2443 * WEEK_NS + 36_018 * NS
STATE = ReceiverState(
    latitude_deg=48.137154321,
    longitude_deg=-11.576124321,
    height_m=1234.567,
    velocity_ned_mps=(61.234, -12.345, 0.567),
    roll_deg=-1.23456,
    pitch_deg=2.34567,
    heading_deg=348.6,
)


def state_at(_gps_ns: int) -> ReceiverState:
    return STATE

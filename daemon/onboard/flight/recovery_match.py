"""The record of an exposure that a crash left unsealed, made from the flight log.

The same matching and the same composing as in flight, fed with what was logged around the trigger.
"""

from __future__ import annotations

from collections.abc import Sequence

from daemon.mission.exposure import CaptureRecord, Exposure
from daemon.mission.log.log_records import LoggedRecord, LoggedTrigger
from daemon.mission.verification.recovery import Complete
from daemon.onboard.flight.record_builder import build_record, instant_of, ptp_instant_of
from daemon.onboard.flight.temperatures import TemperatureHistory
from daemon.onboard.timing.gps_clock import GpsClock
from daemon.onboard.timing.matching import FiredPulse, Matcher
from daemon.onboard.timing.ptp_time import PtpTime
from daemon.orientation.navigation import Track
from drivers.contract import (
    EventMark,
    Frame,
    NavSample,
    PpsEdge,
    PtpReading,
    TemperatureSample,
)
from processing.geometry.drift import lagged_sensors
from processing.quality.report import Flag
from processing.rig import Rig


def seal_from_log(rig: Rig) -> Complete:
    """What `daemon.mission.verification.recovery.recover` needs to seal exposures of this rig."""
    cone_of_head = {sensor.name: cone.name for cone in rig.cones for sensor in cone.sensors}

    def complete(capture: CaptureRecord, records: Sequence[LoggedRecord]) -> Exposure:
        clock = GpsClock()
        matcher = Matcher(cone_of_head, clock)
        track = Track()
        temperatures = TemperatureHistory(lagged_sensors(rig))
        ptp = PtpTime()
        pulse: FiredPulse | None = None
        now_ns = capture.trigger_mono_ns
        for record in records:
            if isinstance(record, NavSample) and record.time_valid:
                track.add(record)
                clock.message_arrived(record.gps_ns, record.mono_ns)
            elif isinstance(record, LoggedTrigger):
                given = pulse_of(record)
                matcher.pulse(given)
                pulse = given if given.number == capture.number else pulse
            elif isinstance(record, EventMark):
                matcher.mark(record)
            elif isinstance(record, PpsEdge):
                clock.pps_edge(record.mono_ns, record.sigma_ns)
            elif isinstance(record, TemperatureSample):
                temperatures.add(record)
            elif isinstance(record, PtpReading):
                ptp.read(record)
                now_ns = max(now_ns, record.mono_ns)
            elif isinstance(record, Frame):
                _compare_latch(record, ptp, clock)
        starts = [(frame.sensor, frame.device_ns) for frame in capture.frames]
        by_ptp = ptp_instant_of(rig, starts, pulse, ptp, now_ns)
        instant = instant_of(matcher.mark_of(capture.number), pulse, clock, by_ptp)
        heads = [head for head, _ in starts]
        suspect = Flag.PTP_FAULT if ptp.is_suspect(heads, now_ns) else Flag(0)
        return build_record(rig, capture, pulse, instant, track, temperatures, suspect)

    return complete


def _compare_latch(frame: Frame, ptp: PtpTime, clock: GpsClock) -> None:
    at_ns, mono_ns, sigma_ns = (
        frame.device_clock_ns,
        frame.device_clock_mono_ns,
        frame.latch_sigma_ns,
    )
    if at_ns is not None and mono_ns is not None and sigma_ns is not None:
        ptp.compare_latch(frame.head, at_ns, clock.gps_at(mono_ns), sigma_ns, mono_ns=mono_ns)


def pulse_of(logged: LoggedTrigger) -> FiredPulse:
    """The pulse as the matching needs it."""
    return FiredPulse(
        number=logged.number,
        mono_ns=logged.pulse.mono_ns,
        sigma_ns=logged.pulse.sigma_ns,
        count=logged.pulse.count,
        delays_ns=logged.delays_ns,
        strobe_delay_ns=logged.strobe_delay_ns,
        spread_ns=logged.pulse.spread_ns,
    )

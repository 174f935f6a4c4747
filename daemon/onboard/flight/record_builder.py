"""The record of an exposure and its instant.

Pure functions; which mark and which frames belong to an exposure is decided in
`daemon.onboard.flight.flight`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeAlias

from daemon.mission.exposure import (
    CaptureRecord,
    Exposure,
    FrameRecord,
    NavigationRecord,
    TimeSource,
)
from daemon.onboard.flight.temperatures import TemperatureHistory
from daemon.onboard.timing.gps_clock import GpsClock, Source
from daemon.onboard.timing.ptp_time import PtpInstant, PtpTime, combined
from daemon.onboard.timing.pulses import FiredPulse
from daemon.orientation.navigation import Track
from drivers.contract import EventMark
from processing.quality.report import Flag
from processing.rig import Rig

Starts: TypeAlias = Iterable[tuple[str, int | None]]
"""Heads, and the start of exposure that each one's own clock stamped, ns."""


@dataclass(frozen=True)
class Instant:
    """The instant of the strobe: GPS time, its sigma, and where it came from.

    `budget_ns` are the parts of the sigma, by what they come from.
    """

    gps_ns: int | None
    sigma_ns: int | None
    source: TimeSource
    count: int | None
    budget_ns: Mapping[str, int] = field(default_factory=dict)
    in_holdover: bool = False


def instant_of(
    mark: EventMark | None,
    pulse: FiredPulse | None,
    clock: GpsClock,
    ptp: PtpInstant | None = None,
) -> Instant:
    """The instant of the strobe: the receiver's mark, else the better of the host's clock and PTP.

    Args:
        mark: of the exposure, if there is one.
        pulse: of the exposure, if it was given.
        clock: GPS time of the host's instants.
        ptp: the instant by the clocks of heads that PTP synchronises, see `ptp_instant_of`.
    """
    if mark is not None:
        budget = {"receiver": mark.accuracy_ns}
        count = mark.count if mark.count_bits else None
        return Instant(mark.gps_ns, mark.accuracy_ns, "event-mark", count, budget)
    if pulse is None:
        return Instant(None, None, "none", None)
    strobe_ns = pulse.mono_ns + pulse.strobe_delay_ns
    estimate = clock.pulse_at(strobe_ns, pulse.sigma_ns)
    if ptp is not None and (estimate is None or ptp.sigma_ns < estimate.sigma_ns):
        return Instant(ptp.gps_ns, ptp.sigma_ns, "ptp", None, {"ptp": ptp.sigma_ns})
    if estimate is None:
        return Instant(None, None, "none", None)
    clock_ns = min(clock.sigma_of(strobe_ns, estimate.source), estimate.sigma_ns)
    trigger_ns = round(math.sqrt(estimate.sigma_ns**2 - clock_ns**2))
    return Instant(
        gps_ns=estimate.gps_ns,
        sigma_ns=estimate.sigma_ns,
        source=_SOURCES[estimate.source],
        count=None,
        budget_ns={"clock": clock_ns, "trigger": trigger_ns},
        in_holdover=estimate.in_holdover,
    )


def ptp_instant_of(
    rig: Rig,
    starts: Starts,
    pulse: FiredPulse | None,
    ptp: PtpTime,
    mono_ns: int,
) -> PtpInstant | None:
    """The instant of the strobe by the starts of exposure that PTP clocks stamped.

    Args:
        rig: for the cones of the heads.
        starts: of one exposure.
        pulse: of that exposure; its delays lead from the strobe to each start.
        ptp: the clocks.
        mono_ns: now.

    Returns:
        None where no head's PTP time may be used, or heads contradict each other.
    """
    if pulse is None:
        return None
    found = []
    for head, device_ns in starts:
        start = None if device_ns is None else ptp.at(head, device_ns, mono_ns)
        if start is not None:
            to_strobe_ns = strobe_from_start_ns(rig, head, pulse)
            sigma_ns = math.ceil(math.hypot(start.sigma_ns, pulse.spread_ns))
            found.append(PtpInstant(start.gps_ns + to_strobe_ns, sigma_ns))
    return combined(found)


def compare_ptp(
    rig: Rig, starts: Starts, pulse: FiredPulse | None, mark: EventMark, ptp: PtpTime
) -> None:
    """Compare the starts of exposure that PTP clocks stamped with the receiver's mark."""
    if pulse is None:
        return
    for head, device_ns in starts:
        if device_ns is not None:
            start_ns = mark.gps_ns - strobe_from_start_ns(rig, head, pulse)
            sigma_ns = math.hypot(mark.accuracy_ns, pulse.spread_ns)
            ptp.compare(head, device_ns, start_ns, sigma_ns, mono_ns=pulse.mono_ns)


def strobe_from_start_ns(rig: Rig, head: str, pulse: FiredPulse) -> int:
    """From the start of a head's exposure to the strobe, ns."""
    cone = rig.cone_of(head)
    return pulse.strobe_delay_ns - pulse.delays_ns[cone.name] - cone.mark_to_mid_exposure_ns


def build_record(
    rig: Rig,
    stored: CaptureRecord,
    pulse: FiredPulse | None,
    instant: Instant,
    track: Track,
    temperatures: TemperatureHistory,
    flags: Flag,
) -> Exposure:
    """The final record of a stored exposure; its place in the chain is given when it is written."""
    flags |= Flag(stored.flags)
    if instant.source != "event-mark":
        flags |= Flag.MARK_MISSING
    if instant.in_holdover:
        flags |= Flag.TIME_HOLDOVER
    navigation: NavigationRecord | None = None
    if instant.gps_ns is not None:
        navigation = track.at(instant.gps_ns, stored.trigger_mono_ns)
    if navigation is None or navigation.height_m is None or navigation.horizontal_sigma_m is None:
        flags |= Flag.GNSS
    return Exposure(
        number=stored.number,
        trigger_sequence=stored.trigger_sequence,
        trigger_mono_ns=stored.trigger_mono_ns,
        trigger_sigma_ns=stored.trigger_sigma_ns,
        boot_id=stored.boot_id,
        mark_gps_ns=instant.gps_ns,
        mark_sigma_ns=instant.sigma_ns,
        mark_source=instant.source,
        mark_count=instant.count,
        time_budget_ns=_worst_budget(rig, stored.frames, pulse, instant),
        frames=tuple(_with_time(rig, frame, pulse, instant) for frame in stored.frames),
        missing=stored.missing,
        temperatures=temperatures.at(stored.trigger_mono_ns),
        navigation=navigation,
        line_id=stored.line_id,
        strip_id=stored.strip_id,
        calibration_id=stored.calibration_id,
        calibration_sha256=stored.calibration_sha256,
        configuration_sha256=stored.configuration_sha256,
        software=stored.software,
        simulated=stored.simulated,
        state="lost" if not stored.frames else "degraded" if stored.missing else "complete",
        flags=int(flags),
    )


def _with_time(
    rig: Rig, frame: FrameRecord, pulse: FiredPulse | None, instant: Instant
) -> FrameRecord:
    """A frame's mid-exposure: the strobe, the pulses' delays, half the exposure, the head's own."""
    if instant.gps_ns is None or instant.sigma_ns is None or pulse is None:
        return frame
    cone = rig.cone_of(frame.sensor)
    half_ns = round((frame.exposure_time_us or 0.0) * 500)
    offset_ns = pulse.delays_ns[cone.name] + half_ns - pulse.strobe_delay_ns
    return replace(
        frame,
        mid_exposure_gps_ns=instant.gps_ns + offset_ns + cone.mark_to_mid_exposure_ns,
        time_sigma_ns=_combined_sigma(_budget_of(rig, frame, pulse, instant).values()),
        time_source=instant.source,
    )


def _budget_of(
    rig: Rig, frame: FrameRecord, pulse: FiredPulse, instant: Instant
) -> Mapping[str, int]:
    """What a frame's time is unsure by, by what it comes from."""
    cone = rig.cone_of(frame.sensor)
    # The strobe is the reference cone's: its own pulse needs no delay to be trusted.
    delay_ns = 0 if cone.name == rig.reference_cone else pulse.spread_ns
    head_ns = cone.mark_to_mid_exposure_sigma_ns
    return {**instant.budget_ns, "delay": delay_ns, "head": head_ns}


def _worst_budget(
    rig: Rig, frames: Iterable[FrameRecord], pulse: FiredPulse | None, instant: Instant
) -> Mapping[str, int]:
    if pulse is None or instant.gps_ns is None:
        return {}
    budgets = [_budget_of(rig, frame, pulse, instant) for frame in frames]
    return max(
        budgets, key=lambda budget: _combined_sigma(budget.values()), default=instant.budget_ns
    )


def _combined_sigma(sigmas_ns: Iterable[int]) -> int:
    return math.ceil(math.hypot(*sigmas_ns))


_SOURCES: Mapping[Source, TimeSource] = {
    "pps": "pps",
    "marks": "interpolated",
    "messages": "host",
}

"""The time of a frame: its offset from the strobe and the parts of its sigma, in nanoseconds."""

from __future__ import annotations

from dataclasses import replace

import pytest

from daemon.mission.exposure import CaptureRecord, Exposure, FrameRecord, TimeSource
from daemon.onboard.flight.record_builder import Instant, build_record, instant_of
from daemon.onboard.flight.temperatures import TemperatureHistory
from daemon.onboard.timing.gps_clock import GpsClock
from daemon.onboard.timing.pulses import FiredPulse
from daemon.orientation.navigation import Track
from drivers.contract import EventMark
from processing.quality.report import Flag
from processing.rig import find_rig

GPS_NS = 1_400_000_000_000_000_000
MINI = find_rig("ultracam-x-mini")
CONES = tuple(
    replace(cone, mark_to_mid_exposure_ns=7_000 + index, mark_to_mid_exposure_sigma_ns=120)
    for index, cone in enumerate(MINI.cones)
)
RIG = replace(MINI, cones=CONES)
SENSORS = tuple(cone.sensors[0].name for cone in RIG.cones[:2])
OTHER = next(cone for cone in RIG.cones[:2] if cone.name != RIG.reference_cone)
DELAYS_NS = {cone.name: 1_000_000 * index for index, cone in enumerate(RIG.cones)}
PULSE = FiredPulse(1, 5_000_000_000, 50_000, 1, DELAYS_NS, 2_000_000, spread_ns=350)
MARKED = Instant(GPS_NS, 40, "event-mark", 3, {"receiver": 40})


def frame_of(sensor: str, exposure_time_us: float | None = 4000.0) -> FrameRecord:
    return FrameRecord(
        sensor=sensor,
        head_serial="",
        file="",
        sha256="",
        width_px=64,
        height_px=48,
        pixel_format="Mono12",
        device_ns=None,
        counter=None,
        exposure_time_us=exposure_time_us,
        temperature_c=None,
        mono_ns=5_100_000_000,
    )


def composed(
    instant: Instant,
    pulse: FiredPulse | None,
    frames: tuple[FrameRecord, ...] = tuple(frame_of(sensor) for sensor in SENSORS),
) -> Exposure:
    stored = CaptureRecord(number=1, trigger_mono_ns=5_000_000_000, frames=frames)
    return build_record(RIG, stored, pulse, instant, Track(), TemperatureHistory(), Flag(0))


def test_mid_exposure_is_strobe_plus_delay_plus_half_the_exposure_plus_the_heads_own() -> None:
    exposure = composed(MARKED, PULSE)
    for index, frame in enumerate(exposure.frames):
        cone = RIG.cone_of(frame.sensor)
        offset_ns = DELAYS_NS[cone.name] - 2_000_000 + 2_000_000 + 7_000 + index
        assert frame.mid_exposure_gps_ns == GPS_NS + offset_ns
        assert frame.time_source == "event-mark"


def test_only_the_reference_cone_needs_no_pulse_of_its_own_to_be_trusted() -> None:
    exposure = composed(MARKED, PULSE)
    sigmas_ns = {RIG.cone_of(f.sensor).name: f.time_sigma_ns for f in exposure.frames}
    # sqrt(40^2 + 120^2) = 126.49; with the pulses' spread sqrt(40^2 + 350^2 + 120^2) = 372.16.
    assert sigmas_ns == {RIG.reference_cone: 127, OTHER.name: 373}
    assert exposure.time_budget_ns == {"receiver": 40, "delay": 350, "head": 120}


def test_without_an_exposure_time_the_start_is_what_is_known() -> None:
    sensor = OTHER.sensors[0].name
    (with_it,) = composed(MARKED, PULSE, (frame_of(sensor),)).frames
    (without,) = composed(MARKED, PULSE, (frame_of(sensor, None),)).frames
    assert with_it.mid_exposure_gps_ns is not None and without.mid_exposure_gps_ns is not None
    assert with_it.mid_exposure_gps_ns - without.mid_exposure_gps_ns == 2_000_000


@pytest.mark.parametrize(
    ("instant", "pulse"),
    [
        (MARKED, None),
        (Instant(GPS_NS, None, "event-mark", 3), PULSE),
        (Instant(None, None, "none", None), PULSE),
        (Instant(None, 40, "none", None), PULSE),
    ],
)
def test_frames_are_timed_only_by_an_instant_with_a_sigma_and_a_pulse(
    instant: Instant, pulse: FiredPulse | None
) -> None:
    exposure = composed(instant, pulse)
    assert {f.mid_exposure_gps_ns for f in exposure.frames} == {None}
    assert {f.time_sigma_ns for f in exposure.frames} == {None}
    assert exposure.mark_gps_ns == instant.gps_ns


@pytest.mark.parametrize(
    ("instant", "pulse"), [(MARKED, None), (replace(MARKED, gps_ns=None), PULSE)]
)
def test_without_pulse_or_instant_there_is_no_budget(
    instant: Instant, pulse: FiredPulse | None
) -> None:
    assert composed(instant, pulse).time_budget_ns == {}


def test_an_exposure_without_frames_is_lost_and_keeps_the_budget_of_its_instant() -> None:
    exposure = composed(MARKED, PULSE, ())
    assert (exposure.state, exposure.time_budget_ns) == ("lost", {"receiver": 40})


@pytest.mark.parametrize(
    ("source", "in_holdover", "flags"),
    [
        ("event-mark", False, Flag.GNSS),
        ("pps", False, Flag.GNSS | Flag.MARK_MISSING),
        ("pps", True, Flag.GNSS | Flag.MARK_MISSING | Flag.TIME_HOLDOVER),
    ],
)
def test_flags_name_a_missing_mark_a_coasting_clock_and_a_missing_position(
    source: TimeSource, in_holdover: bool, flags: Flag
) -> None:
    instant = replace(MARKED, source=source, in_holdover=in_holdover)
    assert Flag(composed(instant, PULSE).flags) == flags


@pytest.mark.parametrize(("count_bits", "count"), [(16, 9), (0, None)])
def test_the_instant_of_a_mark_is_the_receivers(count_bits: int, count: int | None) -> None:
    mark = EventMark("gnss", 0, GPS_NS, 25, 9, count_bits, True, 0)
    instant = instant_of(mark, PULSE, GpsClock())
    assert instant == Instant(GPS_NS, 25, "event-mark", count, {"receiver": 25})
    assert not instant.in_holdover


def test_an_instant_through_messages_is_as_unsure_as_they_are() -> None:
    clock = GpsClock()
    assert instant_of(None, PULSE, clock).source == "none"
    assert instant_of(None, None, clock) == Instant(None, None, "none", None)
    clock.message_arrived(GPS_NS, 5_000_000_000)
    instant = instant_of(None, PULSE, clock)
    # Messages come 0 to 700 ms late: 350 ms in the middle, sigma 700 ms / sqrt(12).
    assert instant == Instant(
        GPS_NS + 350_000_000 + 2_000_000,
        202_072_594,
        "host",
        None,
        {"clock": 202_072_594, "trigger": 0},
    )

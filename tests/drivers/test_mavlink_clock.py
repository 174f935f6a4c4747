"""The autopilot's time is as good as its UTC scatters: sigmas are true, steps are noticed."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from drivers.contract import DeviceEvent, EventMark, NavSample
from drivers.receivers.mavlink.boot_clock import BootClock
from drivers.receivers.mavlink.navigator import MavlinkNavigator
from drivers.timescales.gps_time import SECOND_NS
from sim_hw.receivers.mavlink_autopilot import MavlinkAutopilot
from sim_hw.receivers.utc_jitter import UtcErrors, UtcJitter
from sim_hw.world.world_clock import WorldClock
from tests.drivers.fakes import FakeClock, FakePort, RecordingSink, running
from tests.drivers.test_mavlink import BOOT_MS, GPS_NS, UNIX_US, Bus, decode, flying, new_line
from tests.drivers.test_udp_port import WITHIN_S
from tests.sim_hw.receiver_state import STATE

MS = 1_000_000
SEEDS, MESSAGES, FROM = 40, 90, 8
ARDUPILOT = UtcJitter()
EVEN = UtcJitter(median_ns=3 * MS, at_95_percent_ns=9 * MS)


@dataclass(frozen=True)
class At:
    """What the clock stated at one moment, and what was true."""

    error_ns: int
    sigma_ns: int
    utc_error_ns: int
    utc_sigma_ns: int


def system_times(
    clock: BootClock, jitter: UtcJitter | None, seed: int, ppm: float = 10.0, count: int = MESSAGES
) -> Iterator[At]:
    """SYSTEM_TIME once a second for a while; truth is the autopilot's UTC without its jitter."""
    given = None if jitter is None else UtcJitter(**{**vars(jitter), "seed": seed})
    errors = UtcErrors(given)
    rate = 1.0 + ppm * 1e-6 * math.sin(seed)
    for n in range(count):
        boot_ns = 754 * SECOND_NS + n * 1_000 * MS + (n * 7_654_321 + seed * 123_457) % (20 * MS)
        true_gps_ns = GPS_NS + round((boot_ns - 754 * SECOND_NS) * rate)
        error_ns = errors.error_ns(boot_ns)
        clock.add_system_time(UNIX_US + (true_gps_ns - GPS_NS + error_ns) // 1000, boot_ns // MS)
        requested_ns = boot_ns + 350 * MS
        stated = clock.gps_ns(requested_ns)
        assert stated is not None
        true_ns = GPS_NS + round((requested_ns - 754 * SECOND_NS) * rate) + errors.steps_ns(boot_ns)
        yield At(
            stated - true_ns,
            clock.sigma_ns(requested_ns),
            error_ns - errors.steps_ns(boot_ns),
            clock.utc_sigma_ns,
        )


def over_seeds(jitter: UtcJitter | None) -> tuple[list[At], int]:
    found, steps = [], 0
    for seed in range(SEEDS):
        clock = BootClock()
        found += list(system_times(clock, jitter, seed))[FROM:]
        steps += clock.steps
    return found, steps


@pytest.mark.trust
@pytest.mark.parametrize("jitter", [ARDUPILOT, EVEN, None], ids=["ardupilot", "even", "exact"])
def test_the_stated_sigma_of_the_autopilots_time_is_true_over_seeds(
    jitter: UtcJitter | None,
) -> None:
    found, steps = over_seeds(jitter)
    inside = sum(abs(at.error_ns) <= 2 * at.sigma_ns for at in found) / len(found)
    square = sum((at.error_ns / at.sigma_ns) ** 2 for at in found) / len(found)
    assert inside >= 0.925
    assert square <= 1.4
    assert steps <= SEEDS // 10, "jitter is no step"
    # A message is cut to a millisecond, and that is never better known.
    assert min(at.sigma_ns for at in found) > 280_000
    if jitter is not None:
        assert square >= 0.2, "not merely cautious"
        utc = sum(abs(at.utc_error_ns) <= 2 * at.utc_sigma_ns for at in found) / len(found)
        assert 0.92 <= utc <= 0.985, "stamps in UTC have the jitter of one message"
    late = [at.sigma_ns for at in found[-20:]]
    assert max(late) < 3 * MS


@pytest.mark.trust
def test_a_recorded_autopilots_jitter_never_ends_in_microseconds() -> None:
    clock = BootClock()
    for at in system_times(clock, ARDUPILOT, 5, count=1500):
        assert at.sigma_ns > 280_000
        assert at.utc_sigma_ns > 3 * MS
    assert clock.steps <= 2


@pytest.mark.trust
@pytest.mark.parametrize("step_ns", [60 * MS, 700 * MS, 3600 * SECOND_NS])
def test_a_step_of_utc_is_noticed_within_some_messages_counted_and_measured(step_ns: int) -> None:
    noticed = followed = 0
    for seed in range(20):
        clock = BootClock()
        jitter = UtcJitter(step_every_s=60.0, step_ns=step_ns)
        for n, at in enumerate(system_times(clock, jitter, seed, count=100)):
            if n == 64:
                followed += abs(at.error_ns) < 40 * MS
        noticed += clock.steps == 1
        if clock.steps == 1:
            assert clock.last_step_ns is not None
            assert abs(abs(clock.last_step_ns) - step_ns) < 50 * MS
    assert noticed >= 18
    assert followed >= 12, "what was before the step is not used any more"


def test_one_message_far_off_is_doubted_and_no_step() -> None:
    clock = BootClock()
    before = list(system_times(clock, EVEN, 3, count=40))[-1]
    boot_ms = 754_000 + 40_000
    clock.add_system_time(UNIX_US + 40_000_000 + 200_000, boot_ms)
    assert clock.steps == 0
    assert clock.sigma_ns(boot_ms * MS) > 150 * MS, "it may be the first after a step"
    clock.add_system_time(UNIX_US + 41_000_000, boot_ms + 1000)
    assert clock.sigma_ns(boot_ms * MS) < 2 * before.sigma_ns
    assert clock.steps == 0


@pytest.mark.trust
def test_a_step_is_reported_as_an_event_with_its_size_and_what_the_time_is_worth() -> None:
    clock, sink, bus = FakeClock(), RecordingSink(), Bus()
    stream = [bus.heartbeat()]
    for n in range(60):
        unix_us = UNIX_US + n * 1_000_000 + (75_000 if n >= 40 else 0)
        stream.append(
            bus.system_time(unix_us, BOOT_MS + n * 1000) + bus.position(BOOT_MS + n * 1000)
        )
    waiting = iter(stream)
    port = FakePort(clock, lambda _: next(waiting, b""))
    navigator = MavlinkNavigator("fc", {"port": "x"}, clock=clock, open_port=lambda *_: port)
    navigator.emitter.sink = sink
    line = navigator._open()
    for _ in stream:
        for record in navigator.step(line):
            sink(record)
    (event,) = [e for e in sink.events if e.name == "receiver-stepped"]
    assert isinstance(event, DeviceEvent) and event.is_fault
    assert "set its UTC by +0.075 s against its own clock (1 so far)" in event.sentence
    assert "ms now" in event.sentence and "check its power and its GPS receiver" in event.sentence
    assert navigator.statistics()["clock_steps"] == 1


def test_a_message_that_was_overtaken_is_no_restart() -> None:
    clock = BootClock()
    clock.add_system_time(UNIX_US, BOOT_MS)
    clock.add_system_time(UNIX_US - 500_000, BOOT_MS - 500)
    assert clock.steps == 0
    clock.add_system_time(UNIX_US + 60_000_000, 2_000)
    assert (clock.steps, clock.last_step_ns) == (1, None)


@pytest.mark.trust
def test_a_stamp_in_utc_is_as_good_as_one_message_and_one_since_start_as_the_line() -> None:
    bus, errors = Bus(), UtcErrors(ARDUPILOT)
    begun = bus.heartbeat()
    for n in range(60):
        error_us = errors.error_ns(n) // 1000
        begun += bus.system_time(UNIX_US + n * 1_000_000 + error_us, BOOT_MS + n * 1000)
    _, records = decode(
        begun + bus.trigger(UNIX_US + 60_000_000, 1) + bus.trigger((BOOT_MS + 60_000) * 1000, 2)
    )
    in_utc, since_start = (r.accuracy_ns for r in records if isinstance(r, EventMark))
    assert in_utc > 5 * MS
    assert MS < since_start < 3 * MS


@pytest.mark.trust
def test_attitude_is_read_from_angles_where_no_quaternion_comes() -> None:
    bus = Bus()

    def angles(boot_ms: int, yaw_deg: float) -> bytes:
        values = (math.radians(10.0), math.radians(-5.0), math.radians(yaw_deg), 0, 0, 0)
        return bus.pack_message(dialect.MAVLink_attitude_message(boot_ms, *values))

    begun = bus.heartbeat() + bus.system_time()
    data = begun + angles(BOOT_MS - 20, -2.0) + bus.position() + angles(BOOT_MS + 20, 2.0)
    (sample,) = decode(data)[1]
    assert isinstance(sample, NavSample)
    assert sample.heading_rad is not None
    assert abs(math.remainder(sample.heading_rad, math.tau)) < 1e-3
    assert sample.roll_rad == pytest.approx(math.radians(10.0), abs=1e-3)
    assert sample.pitch_rad == pytest.approx(math.radians(-5.0), abs=1e-3)
    # Quaternions that come are preferred, and angles serve again once they are old.
    both = begun + bus.attitude(BOOT_MS - 20) + angles(BOOT_MS - 10, 0.0) + bus.position()
    (sample,) = decode(both + bus.attitude(BOOT_MS + 20))[1]
    assert isinstance(sample, NavSample)
    assert sample.heading_rad == pytest.approx(math.radians(90.0), abs=1e-6)
    later = (
        begun + bus.attitude(BOOT_MS) + angles(BOOT_MS + 1990, 0.0) + bus.position(BOOT_MS + 2000)
    )
    (sample,) = decode(later + angles(BOOT_MS + 2010, 0.0))[1]
    assert isinstance(sample, NavSample)
    assert sample.roll_rad == pytest.approx(math.radians(10.0), abs=1e-3)
    damaged, _ = decode(begun + angles(BOOT_MS, math.nan))
    assert damaged.counters["bad_messages"] == 1


@pytest.mark.trust
def test_an_autopilot_with_angles_and_jitter_gives_places_within_what_it_states() -> None:
    clock = WorldClock.from_wall_clock()
    autopilot = MavlinkAutopilot(
        clock, flying, line=new_line("udp"), utc_jitter=UtcJitter(seed=8), sends_angles=True
    )
    navigator = MavlinkNavigator("fc", {"port": autopilot.port, "position_hz": 20.0})
    recorder, enough = RecordingSink(), threading.Event()

    def watch(_: object) -> None:
        leaning = sum(isinstance(r, NavSample) and r.roll_rad is not None for r in recorder.records)
        marks = sum(isinstance(r, EventMark) for r in recorder.records)
        if leaning >= 20 and marks == 2:
            enough.set()

    recorder.stop = watch
    autopilot.start()
    try:
        navigator.bind()
        given = [clock.gps_ns(time.monotonic_ns()) + n * 400 * MS for n in (1, 2)]
        for at_ns in given:
            autopilot.mark(at_ns)
        with running(navigator, recorder):
            assert enough.wait(WITHIN_S), navigator.statistics()
    finally:
        autopilot.close()
    samples = [r for r in recorder.records if isinstance(r, NavSample)]
    for sample in samples:
        true = flying(sample.gps_ns)
        away_m = abs(sample.latitude_deg - true.latitude_deg) * 111_320.0
        assert away_m < 4 * sample.horizontal_sigma_m
        assert sample.horizontal_sigma_m > 0.02
    leaning = [s for s in samples if s.roll_rad is not None]
    assert leaning[-1].roll_rad == pytest.approx(math.radians(STATE.roll_deg), abs=1e-4)
    marks = [r for r in recorder.records if isinstance(r, EventMark)]
    for mark, at_ns in zip(marks, given, strict=True):
        assert abs(mark.gps_ns - at_ns) < 4 * mark.accuracy_ns
        assert mark.accuracy_ns > MS

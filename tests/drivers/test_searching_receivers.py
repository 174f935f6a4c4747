"""A receiver without a fix is a receiver that searches: no damage, no fault, wherever it is met."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from daemon.onboard.monitoring.flight_state import FlightState
from drivers.detection.port_search import search
from drivers.detection.protocol_detection import ProtocolDetector
from drivers.receivers.fix_monitor import fix_description
from drivers.receivers.gpsd.navigator import GpsdNavigator
from drivers.receivers.message_decoder import MessageDecoder
from drivers.receivers.nmea.decoder import NmeaDecoder
from drivers.receivers.nmea.navigator import NmeaNavigator
from drivers.receivers.septentrio.decoder import SbfDecoder
from drivers.receivers.ublox.decoder import UbxDecoder
from tests.drivers import test_mavlink as mavlink
from tests.drivers import test_septentrio as septentrio
from tests.drivers.fakes import FakeClock, FakePort, RecordingSink
from tests.drivers.real_gpsd import PROGRAM, running_gpsd
from tests.drivers.test_gpsd import TPV, StubGpsd, flown, lines
from tests.drivers.test_nmea import EXCERPT, epoch, sentence
from tests.drivers.ubx_frames import nav_pvt

pytestmark = [pytest.mark.realtime, pytest.mark.trust]

COLD = b"".join(
    sentence(body)
    for body in (
        "GNRMC,,V,,,,,,,,,,N",
        "GNVTG,,,,,,,,,N",
        "GNGGA,,,,,,0,00,99.99,,,,,,",
        "GNGSA,A,1,,,,,,,,,,,,,99.99,99.99,99.99",
        "GPGSV,1,1,00",
        "GNGLL,,,,,,V,N",
        "GNGST,,,,,,,,",
        "GNZDA,,,,,,",
        "GNGNS,,,,,,NN,00,99.99,,,,",
        "GNTXT,01,01,02,ANTSTATUS=OK",
    )
)
CLOCK_ONLY = b"".join(
    sentence(body)
    for body in (
        "GNRMC,100000.00,V,,,,,,,211126,,,N",
        "GNGGA,100000.00,,,,,0,02,99.99,,,,,,",
        "GNGLL,,,,,100000.00,V,N",
    )
)


class Replayed:
    """A line that gives one piece after another, a second apart, and ends the device at last."""

    def __init__(self, *pieces: bytes) -> None:
        self.clock = FakeClock()
        self._pieces = list(pieces)
        self.done: Callable[[], None] = lambda: None

    def __call__(self, port: FakePort) -> bytes:
        self.clock.now_ns += 10**9
        if not self._pieces:
            self.done()
            return b""
        return self._pieces.pop(0)

    def navigator(self) -> NmeaNavigator:
        navigator = NmeaNavigator(
            "gnss", {"port": "a"}, clock=self.clock,
            open_port=lambda path, baudrate, parity: FakePort(self.clock, self),
        )  # fmt: skip
        self.done = navigator.close
        return navigator


def run(*pieces: bytes) -> tuple[NmeaNavigator, RecordingSink]:
    line = Replayed(*pieces)
    navigator, recorder = line.navigator(), RecordingSink()
    navigator.bind()
    navigator.run(recorder)
    return navigator, recorder


@pytest.mark.parametrize(("received", "satellites"), [(COLD, 0), (CLOCK_ONLY, 2)])
def test_a_receiver_that_was_switched_on_a_moment_ago_is_not_damaged(
    received: bytes, satellites: int
) -> None:
    decoder = NmeaDecoder("gnss")
    assert decoder.feed(received * 3, 0) == []
    assert (decoder.bad_messages, decoder.bad_bytes) == (0, 0)
    decoder.feed(sentence("GNZDA,100001.00,21,11,2026,00,00"), 0)
    assert (decoder.fix, decoder.satellites, decoder.bad_messages) == ("none", satellites, 0)


def test_what_a_receiver_without_a_fix_fills_in_is_not_read() -> None:
    filled = (
        "GPGGA,235946.005,8960.000000,N,00000.000000,E,0,0,,137.000,M,13.000,M,,",
        "GPRMC,235946.005,V,8960.000000,N,00000.000000,E,0.000,0.00,050180,,,N",
        "GPGGA,235947.005,0000.0000,N,00000.0000,E,0,00,,0.0,M,0.0,M,,0000",
    )
    decoder = NmeaDecoder("gnss")
    proprietary = b"$POLYN,TIME,RESTART_OCCURRED\r\n"
    assert decoder.feed(proprietary + b"".join(map(sentence, filled)), 0) == []
    assert (decoder.bad_messages, decoder.bad_bytes, decoder.fix) == (0, 0, "none")
    assert decoder.counters["sentences_unchecked"] == 0
    damaged = proprietary.replace(b"POLYN", b"GPOLY")
    decoder.feed(damaged, 0)
    assert decoder.bad_messages == 1


@pytest.mark.parametrize(
    ("fix", "satellites", "words"),
    [
        ("none", 0, "searching, 0 satellites"),
        ("time", 1, "searching, 1 satellite"),
        (None, None, "searching"),
        ("3d", 9, "3d, 9 satellites"),
        ("dead-reckoning", None, "dead-reckoning"),
    ],
)
def test_a_fix_as_text(fix: str | None, satellites: int | None, words: str) -> None:
    assert fix_description(fix, satellites) == words


def test_it_binds_and_states_that_it_searches() -> None:
    found = Replayed(COLD).navigator().bind()
    assert found["fix"] == "searching, 0 satellites"


def test_it_is_reported_once_as_searching_and_then_as_fixed() -> None:
    times = [f"1000{n:02d}.00" for n in range(5)]
    navigator, recorder = run(COLD, *[COLD] * 4, *[epoch(time) for time in times])
    assert recorder.event_names == ["opened", "searching", "fixed"]
    searching, fixed = recorder.events[1:]
    assert not searching.is_fault and not fixed.is_fault
    assert searching.sentence == (
        "The receiver gnss is searching, 0 satellites. Wait; its antenna needs a clear view of "
        "the sky."
    )
    assert fixed.sentence == "The receiver gnss has a fix: 3d, 17 satellites."
    assert navigator.statistics()["bad_messages"] == 0


def test_a_fix_lost_for_a_moment_is_no_news_and_for_longer_is() -> None:
    void = sentence("GNRMC,,V,,,,,,,,,,N")
    _, recorder = run(epoch("100000.00"), epoch("100001.00"), void, epoch("100003.00"))
    assert recorder.event_names == ["opened"]
    _, recorder = run(epoch("100000.00"), epoch("100001.00"), *[COLD] * 4)
    assert recorder.event_names == ["opened", "searching"]


def test_a_receiver_that_sends_no_date_or_an_old_one_is_reported_as_such() -> None:
    undated = [sentence(epoch_gga(f"1000{n:02d}.00")) for n in range(9)]
    _, recorder = run(*undated)
    assert recorder.event_names == ["opened", "no-date"]
    old = [epoch(f"1000{n:02d}.00", "070407") for n in range(4)]
    _, recorder = run(*old)
    assert recorder.event_names == ["opened", "rolled-over"]
    assert run(*[epoch(f"1000{n:02d}.00") for n in range(9)])[1].event_names == ["opened"]


def epoch_gga(time: str) -> str:
    return f"GPGGA,{time},4730.0,N,00830.0,E,1,12,0.8,952.5,M,47.5,M,,"


@pytest.mark.parametrize(
    ("decoder", "received", "satellites"),
    [
        (UbxDecoder("a"), nav_pvt(0, (2026, 11, 21, 10, 0, 0), fix_type=0, flags=0), 17),
        (SbfDecoder("a"), septentrio.pvt(1000, error=1) + septentrio.pvt(1200, error=1), 17),
        (SbfDecoder("a"), septentrio.pvt(0xFFFFFFFF, week=0xFFFF, error=1), 0),
        (mavlink.MavlinkDecoder("a"), mavlink.Bus().heartbeat() + mavlink.Bus().gps(fix=1), 17),
    ],
)
def test_every_decoder_knows_that_its_receiver_searches(
    decoder: MessageDecoder, received: bytes, satellites: int
) -> None:
    decoder.feed(received, 0)
    assert (decoder.fix, decoder.satellites, decoder.bad_messages) == ("none", satellites, 0)


def test_a_gpsd_whose_receiver_searches_reports_it() -> None:
    nothing = {"class": "TPV", "device": "/dev/ttyACM0", "mode": 1}
    sky = {"class": "SKY", "device": "/dev/ttyACM0", "uSat": 0, "satellites": []}
    stub = StubGpsd(lines(sky, nothing), lines(nothing), lines(TPV, TPV))
    try:
        navigator = GpsdNavigator("gnss", {"port": stub.port})
        assert navigator.bind()["fix"] == "searching, 0 satellites"
        recorder = flown(navigator, 1)
    finally:
        stub.close()
    assert {"searching", "fixed"} & set(recorder.event_names) == {"searching"}


def test_looking_for_devices_finds_a_receiver_that_searches() -> None:
    evidence = ProtocolDetector()
    evidence.feed(COLD, 0)
    detected = evidence.detected()
    assert detected is not None
    assert (detected.driver, detected.missing) == ("nmea", "")
    assert detected.received.endswith("; searching, 0 satellites")


def test_the_page_shows_a_receiver_that_searches_as_such() -> None:
    state = FlightState("syntopic test")
    states = []
    for name in ("opened", "searching", "fixed", "lost"):
        state.apply({"event": "device", "device": "gnss", "name": name, "sentence": name})
        (device,) = state.snapshot()["devices"]
        states.append(device["state"])
    assert states == ["ready", "searching", "ready", "lost"]


def test_gpsd_is_found_at_its_address_by_its_greeting() -> None:
    stub = StubGpsd(b"")
    try:
        (found,) = search([f"tcp://{stub.port}"])
    finally:
        stub.close()
    assert found.detected is not None and found.detected.driver == "gpsd"


@pytest.mark.peer
@pytest.mark.skipif(PROGRAM is None, reason="gpsd is absent; install Debian's gpsd")
def test_the_real_gpsd_with_an_nmea_receiver_gives_navigation_and_is_found() -> None:
    with running_gpsd() as gpsd, gpsd.playing(EXCERPT.read_bytes()):
        navigator = GpsdNavigator("gnss", {"port": gpsd.address})
        recorder = flown(navigator, 5)
        (found,) = search([f"tcp://{gpsd.address}"])
    samples = [r for r in recorder.records if getattr(r, "fix", None)]
    assert {(s.time_valid, s.leap_source, s.leap_seconds) for s in samples} == {(True, "table", 18)}
    assert found.detected is not None and found.detected.driver == "gpsd"

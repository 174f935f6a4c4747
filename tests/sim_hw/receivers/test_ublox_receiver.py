"""The emulated receiver: its bytes against pyubx2, its stream against gpsd."""

from __future__ import annotations

import io
import json
import os
import select
import shutil
import socket
import subprocess
import time
import tty
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_hw.receivers.nmea_sentences import broken_down_utc, nmea
from sim_hw.receivers.ublox_messages import nav_pvt
from sim_hw.receivers.ublox_receiver import (
    LATENCY_NS,
    STROBE_WIDTH_NS,
    ReceiverAccuracy,
    UbloxReceiver,
)
from sim_hw.world.world_clock import WorldClock
from tests.sim_hw.receiver_state import NS, START_GPS_NS, STATE, WEEK_NS, state_at
from tests.support.stopwatch import Stopwatch

pytestmark = pytest.mark.realtime


GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)


def make_receiver(*, chatter: bool = True, first_edge_count: int = 0) -> UbloxReceiver:
    """A receiver whose epochs are asked for by the test; its clock starts at `START_GPS_NS`."""
    return UbloxReceiver(
        WorldClock(START_GPS_NS, 0),
        state_at,
        chatter=chatter,
        seed=5,
        accuracy=ReceiverAccuracy(mark_ns=25),
        first_edge_count=first_edge_count,
    )


@pytest.fixture
def receiver() -> Iterator[UbloxReceiver]:
    receiver = make_receiver()
    yield receiver
    receiver.close()


def parse(data: bytes) -> list[Any]:
    """Every message in the bytes; a bad checksum, or a byte that belongs to none, is an error."""
    pyubx2 = pytest.importorskip("pyubx2", reason="pyubx2 is absent; pip install it")
    reader = pyubx2.UBXReader(
        io.BytesIO(data), protfilter=pyubx2.UBX_PROTOCOL | pyubx2.NMEA_PROTOCOL, quitonerror=2
    )
    messages, length = [], 0
    for raw, message in reader:
        length += len(raw)
        messages.append(message)
    assert length == len(data)
    return messages


def only(messages: list[Any], identity: str) -> Any:
    (message,) = [m for m in messages if m.identity == identity]
    return message


def gps_ns_of(message: Any) -> int:
    """GPS time of a NAV-PVT, from its UTC fields and 18 leap seconds."""
    utc = datetime(
        message.year, message.month, message.day, message.hour, message.min, message.second
    )
    since_epoch = utc.replace(tzinfo=UTC) - GPS_EPOCH
    return round(since_epoch / timedelta(seconds=1)) * NS + message.nano + 18 * NS


def test_epochs_come_every_200_ms_and_miss_it_by_less_than_half_a_millisecond(
    receiver: UbloxReceiver,
) -> None:
    epoch_ns = START_GPS_NS
    for _ in range(20):
        previous_ns, epoch_ns = epoch_ns, receiver.epoch_after(epoch_ns)
        assert abs((epoch_ns + 100_000_000) % 200_000_000 - 100_000_000) <= 500_000
        assert 0 < epoch_ns - previous_ns <= 200_500_000


def test_pyubx2_reads_the_numbers_that_were_put_in(receiver: UbloxReceiver) -> None:
    epoch_ns = receiver.epoch_after(START_GPS_NS)
    messages = parse(receiver.epoch_bytes(epoch_ns))
    pvt = only(messages, "NAV-PVT")
    assert pvt.lat == pytest.approx(STATE.latitude_deg, abs=0.6e-7)
    assert pvt.lon == pytest.approx(STATE.longitude_deg, abs=0.6e-7)
    assert (pvt.height, pvt.hMSL) == (1_234_567, 1_188_567)
    assert (pvt.velN, pvt.velE, pvt.velD) == (61_234, -12_345, 567)
    assert pvt.gSpeed == 62_466
    assert pvt.headMot == pytest.approx(348.6019, abs=1e-3)
    assert (pvt.fixType, pvt.gnssFixOk, pvt.numSV) == (3, 1, 14)
    assert (pvt.validDate, pvt.validTime, pvt.fullyResolved) == (1, 1, 1)
    assert (pvt.hAcc, pvt.vAcc, pvt.sAcc, pvt.tAcc) == (20, 30, 30, 20)
    attitude = only(messages, "NAV-ATT")
    assert attitude.roll == pytest.approx(-1.23456, abs=1e-5)
    assert attitude.pitch == pytest.approx(2.34567, abs=1e-5)
    assert attitude.heading == pytest.approx(348.6, abs=1e-5)


def test_the_epochs_time_is_the_same_to_the_nanosecond_in_utc_and_in_gps(
    receiver: UbloxReceiver,
) -> None:
    epoch_ns = START_GPS_NS
    for _ in range(12):
        epoch_ns = receiver.epoch_after(epoch_ns)
        messages = parse(receiver.epoch_bytes(epoch_ns))
        assert gps_ns_of(only(messages, "NAV-PVT")) == epoch_ns
        gps = only(messages, "NAV-TIMEGPS")
        assert gps.week == 2443
        assert gps.week * WEEK_NS + round(gps.iTOW * 1_000_000) + gps.fTOW == epoch_ns
        assert (gps.leapS, gps.towValid, gps.weekValid, gps.leapSValid) == (18, 1, 1, 1)


def test_leap_seconds_and_satellites_come_once_a_second(receiver: UbloxReceiver) -> None:
    epoch_ns, identities = START_GPS_NS, []
    for _ in range(10):
        epoch_ns = receiver.epoch_after(epoch_ns)
        messages = parse(receiver.epoch_bytes(epoch_ns))
        identities += [message.identity for message in messages]
        for message in messages:
            if message.identity == "NAV-TIMELS":
                assert (message.currLs, message.validCurrLs) == (18, 1)
            if message.identity == "NAV-SAT":
                assert message.numSvs == 14
    counts = {name: identities.count(name) for name in identities}
    assert counts == {
        "GNRMC": 10,
        "GNGGA": 10,
        "NAV-PVT": 10,
        "NAV-ATT": 10,
        "NAV-TIMEGPS": 10,
        "NAV-TIMELS": 2,
        "NAV-SAT": 2,
        "MON-VER": 1,
    }


def test_nmea_agrees_with_ubx_to_its_last_digit(receiver: UbloxReceiver) -> None:
    messages = parse(receiver.epoch_bytes(receiver.epoch_after(START_GPS_NS)))
    for identity in ("GNGGA", "GNRMC"):
        sentence = only(messages, identity)
        assert sentence.lat == pytest.approx(STATE.latitude_deg, abs=1e-7)
        assert sentence.lon == pytest.approx(STATE.longitude_deg, abs=1e-7)
    assert only(messages, "GNGGA").alt + only(messages, "GNGGA").sep == pytest.approx(
        STATE.height_m, abs=0.1
    )
    assert only(messages, "GNRMC").spd == pytest.approx(62.466 * 3600 / 1852, abs=2e-3)


def test_a_checksum_of_nmea_is_the_published_one() -> None:
    # The example of NMEA 0183 that is printed everywhere.
    sentence = "GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"
    assert nmea(sentence) == f"${sentence}*47\r\n".encode()


def test_without_chatter_only_what_is_needed_is_sent() -> None:
    quiet = make_receiver(chatter=False)
    messages = parse(quiet.epoch_bytes(START_GPS_NS))
    quiet.close()
    assert [m.identity for m in messages] == ["NAV-PVT", "NAV-ATT", "NAV-TIMEGPS", "NAV-TIMELS"]


@given(gps_ns=st.integers(START_GPS_NS, START_GPS_NS + 40 * 365 * 86_400 * NS))
def test_utc_is_split_as_ublox_does_it(gps_ns: int) -> None:
    utc = broken_down_utc(gps_ns)
    assert -5_000_000 <= utc.nano <= 994_999_999
    split = datetime(utc.year, utc.month, utc.day, utc.hour, utc.minute, utc.second, tzinfo=UTC)
    since = split - GPS_EPOCH
    assert (since.days * 86_400 + since.seconds + 18) * NS + utc.nano == gps_ns


def test_just_before_new_year_the_rounded_second_is_the_new_years() -> None:
    new_year = datetime(2027, 1, 1, tzinfo=UTC)
    gps_ns = round((new_year - GPS_EPOCH).total_seconds() + 18) * NS - 300_000
    pvt = only(parse(nav_pvt(gps_ns, STATE, ReceiverAccuracy(), 14, 18)), "NAV-PVT")
    assert (pvt.year, pvt.month, pvt.day, pvt.hour, pvt.min, pvt.second) == (2027, 1, 1, 0, 0, 0)
    assert pvt.nano == -300_000


def test_just_before_the_weeks_end_the_time_of_week_is_zero_and_the_week_the_next() -> None:
    receiver = make_receiver()
    gps_ns = 2444 * WEEK_NS - 300_000
    messages = parse(receiver.epoch_bytes(gps_ns))
    receiver.close()
    gps = only(messages, "NAV-TIMEGPS")
    assert (gps.week, gps.iTOW, gps.fTOW) == (2444, 0, -300_000)
    assert only(messages, "NAV-PVT").iTOW == 0


def marks_of(messages: list[Any]) -> list[Any]:
    return [message for message in messages if message.identity == "TIM-TM2"]


def test_a_mark_is_reported_with_the_epoch_after_it_to_the_nanosecond() -> None:
    receiver = make_receiver(chatter=False)
    first_ns = receiver.epoch_after(START_GPS_NS)
    second_ns = receiver.epoch_after(first_ns)
    mark_ns = first_ns + 123_456_789
    receiver.mark(mark_ns)
    assert marks_of(parse(receiver.epoch_bytes(first_ns))) == []
    (mark,) = marks_of(parse(receiver.epoch_bytes(second_ns)))
    receiver.close()
    assert (mark.ch, mark.mode, mark.timeBase, mark.utc, mark.time) == (0, 1, 1, 1, 1)
    assert (mark.newRisingEdge, mark.newFallingEdge, mark.count) == (1, 1, 1)
    rising_ns = mark.wnR * WEEK_NS + mark.towMsR * 1_000_000 + mark.towSubMsR
    falling_ns = mark.wnF * WEEK_NS + mark.towMsF * 1_000_000 + mark.towSubMsF
    assert rising_ns == mark_ns
    assert falling_ns == mark_ns + STROBE_WIDTH_NS
    assert mark.accEst == 25


def test_of_several_marks_in_one_epoch_only_the_last_is_reported_but_all_are_counted() -> None:
    receiver = make_receiver(chatter=False)
    epoch_ns = receiver.epoch_after(START_GPS_NS)
    marks_ns = [epoch_ns - 90_000_000, epoch_ns - 60_000_000, epoch_ns - 30_000_000]
    for mark_ns in marks_ns:
        receiver.mark(mark_ns)
    (mark,) = marks_of(parse(receiver.epoch_bytes(epoch_ns)))
    assert mark.count == 3
    assert mark.wnR * WEEK_NS + mark.towMsR * 1_000_000 + mark.towSubMsR == marks_ns[-1]
    assert marks_of(parse(receiver.epoch_bytes(receiver.epoch_after(epoch_ns)))) == []
    receiver.close()


def test_a_strobe_across_an_epoch_reports_its_falling_edge_with_the_next() -> None:
    receiver = make_receiver(chatter=False)
    epoch_ns = receiver.epoch_after(START_GPS_NS)
    receiver.mark(epoch_ns - STROBE_WIDTH_NS // 2)
    (first,) = marks_of(parse(receiver.epoch_bytes(epoch_ns)))
    (second,) = marks_of(parse(receiver.epoch_bytes(receiver.epoch_after(epoch_ns))))
    receiver.close()
    assert (first.newRisingEdge, first.newFallingEdge, first.count) == (1, 0, 1)
    assert (second.newRisingEdge, second.newFallingEdge, second.count) == (0, 1, 1)
    assert second.towSubMsR == first.towSubMsR


def test_the_count_of_edges_wraps_at_16_bits() -> None:
    receiver = make_receiver(chatter=False, first_edge_count=65_534)
    epoch_ns, counts = START_GPS_NS, []
    for _ in range(3):
        receiver.mark(epoch_ns + 1_000_000)
        epoch_ns = receiver.epoch_after(epoch_ns + 1_000_000)
        counts += [mark.count for mark in marks_of(parse(receiver.epoch_bytes(epoch_ns)))]
    receiver.close()
    assert counts == [65_535, 0, 1]


class HostPort:
    """A host's end of the serial line."""

    def __init__(self, port: str) -> None:
        self.fd = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self.fd)

    def read_for(self, seconds: float) -> list[tuple[int, bytes]]:
        """What arrives, each piece with its monotonic time."""
        pieces = []
        deadline = time.monotonic() + seconds
        while (left_s := deadline - time.monotonic()) > 0:
            if select.select([self.fd], [], [], left_s)[0]:
                pieces.append((time.monotonic_ns(), os.read(self.fd, 65_536)))
        return pieces

    def close(self) -> None:
        os.close(self.fd)


def test_live_bytes_arrive_30_to_80_ms_after_their_epoch_and_marks_with_them() -> None:
    clock = WorldClock.from_wall_clock()
    receiver = UbloxReceiver(clock, state_at, chatter=False, seed=2)
    host = HostPort(receiver.port)
    receiver.start()
    try:
        mark_ns = clock.gps_ns(time.monotonic_ns()) + 300_000_000
        receiver.mark(mark_ns)
        watch = Stopwatch()
        pieces = host.read_for(1.5)
        withheld_ms = 1e3 * watch.withheld_s
    finally:
        receiver.close()
        host.close()
    delays_ms = []
    for arrived_mono_ns, data in pieces:
        if data[:4] == b"\xb5\x62\x01\x07":
            pvt = next(m for m in parse(data) if m.identity == "NAV-PVT")
            delays_ms.append((arrived_mono_ns - clock.mono_ns(gps_ns_of(pvt))) / 1e6)
    assert len(delays_ms) >= 5
    assert min(delays_ms) >= LATENCY_NS[0] / 1e6
    # Half of the epochs cannot have waited longer for a core than all of them together.
    margin_ms = 20 + withheld_ms / (len(delays_ms) // 2)
    assert sorted(delays_ms)[len(delays_ms) // 2] <= LATENCY_NS[1] / 1e6 + margin_ms
    (mark,) = marks_of(parse(b"".join(data for _, data in pieces)))
    assert mark.wnR * WEEK_NS + mark.towMsR * 1_000_000 + mark.towSubMsR == mark_ns


def test_a_host_that_never_reads_costs_bytes_not_time() -> None:
    clock = WorldClock.from_wall_clock()
    receiver = UbloxReceiver(clock, state_at, rate_hz=100.0, seed=2)
    host = HostPort(receiver.port)
    receiver.start()
    try:
        deadline = time.monotonic() + 10.0
        while receiver.statistics()["bytes_lost"] == 0 and time.monotonic() < deadline:
            time.sleep(0.05)
        epochs = receiver.statistics()["epochs"]
        while receiver.statistics()["epochs"] == epochs and time.monotonic() < deadline:
            time.sleep(0.05)
        assert receiver.statistics()["bytes_lost"] > 0
        assert receiver.statistics()["epochs"] > epochs
    finally:
        receiver.close()
        host.close()


def test_what_the_host_writes_is_swallowed_and_not_echoed() -> None:
    receiver = UbloxReceiver(WorldClock.from_wall_clock(), state_at, chatter=False)
    host = HostPort(receiver.port)
    receiver.start()
    try:
        os.write(host.fd, b"\xb5\x62\x06\x8a" + bytes(200))
        data = b"".join(piece for _, piece in host.read_for(0.6))
        assert receiver.statistics()["bytes_received"] == 204
    finally:
        receiver.close()
        host.close()
    assert {m.identity for m in parse(data)} <= {
        "NAV-PVT",
        "NAV-ATT",
        "NAV-TIMEGPS",
        "NAV-TIMELS",
    }


def test_a_port_nobody_has_open_keeps_nothing_stale() -> None:
    receiver = UbloxReceiver(WorldClock.from_wall_clock(), state_at, chatter=False)
    receiver.start()
    try:
        deadline = time.monotonic() + 5.0
        while receiver.statistics()["bytes_lost"] == 0 and time.monotonic() < deadline:
            time.sleep(0.02)
        assert receiver.statistics()["bytes_lost"] > 0
        host = HostPort(receiver.port)
        assert select.select([host.fd], [], [], 0.0)[0] == []
        host.close()
    finally:
        receiver.close()


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


@pytest.mark.peer
def test_gpsd_reports_the_position_and_the_time() -> None:
    program = shutil.which("gpsd", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
    if program is None:
        pytest.skip("gpsd is absent; install Debian's gpsd")
    clock = WorldClock.from_wall_clock()
    receiver = UbloxReceiver(clock, state_at)
    receiver.start()
    # gpsd gives up root before it opens the port.
    Path(receiver.port).chmod(0o666)
    port = free_port()
    gpsd = subprocess.Popen(
        [program, "-N", "-n", "-b", "-S", str(port), receiver.port],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        watch = Stopwatch()
        report = gpsd_position(port, timeout_s=60.0)
        now_ns = clock.gps_ns(time.monotonic_ns())
    finally:
        gpsd.terminate()
        gpsd.wait(timeout=10)
        receiver.close()
    assert report["lat"] == pytest.approx(STATE.latitude_deg, abs=2e-7)
    assert report["lon"] == pytest.approx(STATE.longitude_deg, abs=2e-7)
    assert report["altHAE"] == pytest.approx(STATE.height_m, abs=0.1)
    assert report["speed"] == pytest.approx(62.466, abs=0.01)
    reported = datetime.fromisoformat(report["time"])
    age_s = now_ns / NS - 18 - (reported - GPS_EPOCH).total_seconds()
    assert 0.0 < age_s < 2.0 + watch.withheld_s


def gpsd_position(port: int, timeout_s: float) -> dict[str, Any]:
    """The first report with a three-dimensional fix."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        try:
            connection = socket.create_connection(("127.0.0.1", port), timeout=1.0)
        except OSError:
            time.sleep(0.05)
            continue
        with connection, connection.makefile("rw", encoding="ascii") as stream:
            stream.write('?WATCH={"enable":true,"json":true};\n')
            stream.flush()
            connection.settimeout(timeout_s)
            for line in stream:
                report = json.loads(line)
                if report["class"] == "TPV" and report.get("mode") == 3 and "altHAE" in report:
                    return dict(report)
                if time.monotonic() > deadline:
                    break
    pytest.fail(f"gpsd reported no position within {timeout_s:g} s")

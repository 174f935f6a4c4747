"""Emulated receivers against programs we did not write: their bytes mean what was put in."""

from __future__ import annotations

import io
import math
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from drivers.contract import EventMark
from drivers.receivers.novatel.decoder import NovatelDecoder
from sim_hw.faults.catalogue import MARK, NAVIGATION
from sim_hw.receivers.emulated_receiver import Edge, EmulatedReceiver
from sim_hw.receivers.nmea_receiver import NmeaReceiver
from sim_hw.receivers.novatel_receiver import CLOCK_OFFSET_MAX_NS, NovatelReceiver
from sim_hw.receivers.septentrio_messages import FALLING, RISING
from sim_hw.receivers.septentrio_receiver import SeptentrioReceiver
from sim_hw.world.world_clock import WorldClock
from tests.sim_hw.receiver_state import NS, START_GPS_NS, STATE, WEEK_NS, state_at
from tests.sim_hw.receivers.test_ublox_receiver import free_port, gpsd_position

Kind = Callable[..., EmulatedReceiver]
# Near a week's end and a whole number of milliseconds past nothing.
EDGES_NS = (START_GPS_NS + 123_456_789, 2444 * WEEK_NS - 1, 2444 * WEEK_NS + 999_999)


def make(kind: Kind, *, seed: int = 5) -> Any:
    """A receiver whose epochs are asked for by the test; its clock starts at `START_GPS_NS`."""
    return kind(WorldClock(START_GPS_NS, 0), state_at, seed=seed)


def first_epoch(kind: Kind, *, seed: int = 5) -> tuple[bytes, int]:
    """Its messages for the first epoch, and the time of that epoch."""
    receiver = make(kind, seed=seed)
    epoch_ns = receiver.epoch_after(START_GPS_NS - 1_000_000)
    data = receiver.epoch_bytes(epoch_ns)
    receiver.close()
    return data, epoch_ns


def edge_messages(kind: Kind) -> bytes:
    receiver = make(kind)
    data = b"".join(
        receiver.event_bytes(Edge(at, is_rising, number))
        for number, at in enumerate(EDGES_NS, start=1)
        for is_rising in (True, False)
    )
    receiver.close()
    return data


def sbf(data: bytes) -> dict[str, Any]:
    reader = pytest.importorskip("pysbf2", reason="pysbf2 is absent; pip install it").SBFReader
    messages = [(raw, m) for raw, m in reader(io.BytesIO(data), quitonerror=2)]
    assert sum(len(raw) for raw, _ in messages) == len(data), "no byte belongs to no block"
    return {m.identity: m for _, m in messages}


def oem(data: bytes) -> list[tuple[str, Any]]:
    parser = pytest.importorskip(
        "novatel_edie", reason="novatel_edie is absent; pip install it"
    ).oem.Parser()
    parser.write(data)
    return [(type(message).__name__.split("_")[0], message) for message in parser]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_pysbf2_reads_the_septentrios_numbers(seed: int) -> None:
    data, epoch_ns = first_epoch(SeptentrioReceiver, seed=seed)
    blocks = sbf(data)
    assert list(blocks) == [
        "PVTGeodetic",
        "PosCovGeodetic",
        "VelCovGeodetic",
        "DOP",
        "EndOfPVT",
        "AttEuler",
        "ReceiverTime",
    ]
    pvt = blocks["PVTGeodetic"]
    assert math.degrees(pvt.Latitude) == pytest.approx(STATE.latitude_deg, abs=1e-12)
    assert math.degrees(pvt.Longitude) == pytest.approx(STATE.longitude_deg, abs=1e-12)
    assert (pvt.Height, pvt.Undulation) == (1234.567, 46.0)
    assert (pvt.Vn, pvt.Ve, pvt.Vu) == pytest.approx((61.234, -12.345, -0.567), abs=1e-5)
    assert (pvt.Type, pvt.Error, pvt.NrSV, pvt.HAccuracy, pvt.VAccuracy) == (4, 0, 24, 0.04, 0.06)
    assert abs(pvt.RxClkBias) <= 0.5
    # Receiver time less its bias is GPS time.
    rx_ns = pvt.WNc * WEEK_NS + 36_018 * NS
    assert rx_ns - round(pvt.RxClkBias * 1e6) == epoch_ns
    attitude = blocks["AttEuler"]
    angles = (attitude.Roll, attitude.Pitch, attitude.Heading)
    assert angles == pytest.approx((-1.23456, 2.34567, 348.6), abs=1e-5)
    time = blocks["ReceiverTime"]
    assert (time.UTCYear, time.UTCMonth, time.UTCDay, time.UTCHour) == (26, 11, 1, 10)
    assert (time.DeltaLS, time.SyncLevel) == (18, 7)


def test_pysbf2_reads_the_septentrios_events_to_the_nanosecond() -> None:
    reader = pytest.importorskip("pysbf2", reason="pysbf2 is absent; pip install it").SBFReader
    events = [m for _, m in reader(io.BytesIO(edge_messages(SeptentrioReceiver)), quitonerror=2)]
    assert [m.identity for m in events] == ["ExtEvent", "ExtEventPVTGeodetic"] * 3
    for at_ns, event in zip(EDGES_NS, events[::2], strict=True):
        # pysbf2 shows TOW as a clock; its bytes are the number.
        tow_ms = int.from_bytes(event.serialize()[8:12], "little")
        exact_ns = tow_ms * 1e6 + event.Offset * 1e9 - event.RxClkBias * 1e9
        assert event.WNc * WEEK_NS + exact_ns - at_ns == pytest.approx(0.0, abs=256)
        assert round(exact_ns) - (at_ns - event.WNc * WEEK_NS) in (0, 1, -1)
        assert (event.Source, event.Polarity) == (1, 0)


def test_novatels_own_decoder_reads_the_novatels_numbers() -> None:
    data, epoch_ns = first_epoch(NovatelReceiver)
    logs = oem(data)
    assert [name for name, _ in logs] == [
        "TIME",
        "BESTPOS",
        "BESTVEL",
        "INSPVAX",
        "INSATT",
    ]
    found = dict(logs)
    week, tow_ns = divmod(epoch_ns, WEEK_NS)
    assert {(m.header.week, round(m.header.milliseconds)) for _, m in logs} == {
        (week, tow_ns // 1_000_000)
    }
    inertial = found["INSPVAX"]
    assert (inertial.latitude, inertial.longitude) == (STATE.latitude_deg, STATE.longitude_deg)
    assert inertial.orthometric_height + inertial.undulation == pytest.approx(STATE.height_m)
    speeds = (inertial.north_vel, inertial.east_vel, inertial.up_vel)
    assert speeds == (61.234, -12.345, -0.567)
    assert (inertial.roll, inertial.pitch, inertial.azimuth) == (-1.23456, 2.34567, 348.6)
    assert math.hypot(inertial.latitude_std_dev, inertial.longitude_std_dev) == pytest.approx(0.02)
    assert (found["BESTPOS"].num_svs, found["BESTPOS"].num_soln_svs) == (20, 18)
    assert found["BESTVEL"].horizontal_speed == pytest.approx(62.466, abs=1e-3)
    assert found["TIME"].utc_offset == -18.0
    assert found["INSATT"].azimuth == 348.6


def test_novatels_own_decoder_reads_every_mark_twice_and_to_the_nanosecond() -> None:
    marks = oem(edge_messages(NovatelReceiver))
    assert [name for name, _ in marks] == ["MARK1TIME", "MARK1PVA"] * 3
    for at_ns, (_, time), (_, pva) in zip(EDGES_NS, marks[::2], marks[1::2], strict=True):
        offset_ns = time.offset * 1e9
        assert 0 < abs(offset_ns) <= CLOCK_OFFSET_MAX_NS
        rx_ns = time.week * WEEK_NS + round(time.seconds * 1e9)
        assert abs(rx_ns - round(offset_ns) - at_ns) <= 1
        assert abs(pva.week * WEEK_NS + round(pva.seconds * 1e9) - at_ns) <= 1
        assert pva.height == STATE.height_m


@pytest.mark.parametrize("mark_input", [2, 3, 4])
def test_every_mark_input_of_the_novatel_has_logs_of_its_own(mark_input: int) -> None:
    receiver = make(NovatelReceiver)
    receiver.mark_input = mark_input
    data = receiver.event_bytes(Edge(EDGES_NS[0], True, 1))
    receiver.close()
    assert [name for name, _ in oem(data)] == [f"MARK{mark_input}TIME", f"MARK{mark_input}PVA"]
    (mark,) = NovatelDecoder("gnss").feed(data, 0)
    assert isinstance(mark, EventMark)
    assert (mark.channel, abs(mark.gps_ns - EDGES_NS[0]) <= 1) == (mark_input, True)


def test_with_both_edges_requested_the_septentrio_reports_each_with_its_polarity() -> None:
    receiver = make(SeptentrioReceiver)
    receiver.reported_edges = frozenset((RISING, FALLING))
    edges = [Edge(EDGES_NS[0], True, 1), Edge(EDGES_NS[0] + 50_000, False, 1)]
    data = b"".join(map(receiver.event_bytes, edges))
    receiver.close()
    reader = pytest.importorskip("pysbf2", reason="pysbf2 is absent; pip install it").SBFReader
    events = [m for _, m in reader(io.BytesIO(data), quitonerror=2) if m.identity == "ExtEvent"]
    assert [m.Polarity for m in events] == [0, 1]
    assert events[1].Offset - events[0].Offset == pytest.approx(50e-6, abs=1e-9)


def test_pynmeagps_reads_the_nmea_receivers_numbers_and_every_checksum() -> None:
    pynmeagps = pytest.importorskip("pynmeagps", reason="pynmeagps is absent; pip install it")
    data, _ = first_epoch(NmeaReceiver)
    reader = pynmeagps.NMEAReader(io.BytesIO(data), quitonerror=2, validate=1)
    found = {message.msgID: message for _, message in reader}
    assert list(found) == ["RMC", "GGA", "GST", "VTG", "HDT", "ASHR", "ZDA"]
    gga = found["GGA"]
    # The last digit is 1e-5 minutes.
    assert gga.lat == pytest.approx(STATE.latitude_deg, abs=1e-7)
    assert gga.lon == pytest.approx(STATE.longitude_deg, abs=1e-7)
    assert gga.alt + gga.sep == pytest.approx(STATE.height_m, abs=0.051)
    assert (gga.quality, str(gga.time)) == (4, "10:00:00")
    assert found["GST"].stdAlt == 0.03
    assert found["VTG"].sogk == pytest.approx(62.466 * 3.6, abs=1e-2)
    assert found["HDT"].headingT == 348.6
    angles = (found["ASHR"].roll, found["ASHR"].pitch, found["ASHR"].trueHdg)
    assert angles == pytest.approx((-1.235, 2.346, 348.6))
    assert (found["ZDA"].day, found["ZDA"].month, found["ZDA"].year) == (1, 11, 2026)


def test_an_event_of_the_nmea_receiver_is_the_published_sentence() -> None:
    from sim_hw.receivers.nmea_sentences import ptnl_event

    # The example of an event that receivers' recordings hold, byte by byte.
    gps_ns = 2181 * WEEK_NS + (5 * 86_400 + 13 * 3600 + 10 * 60 + 7 + 18) * NS + 999_785_000
    sentence = ptnl_event(gps_ns, 460, 18, channel=2)
    assert sentence.startswith(b"$PTNL,EVT,131007.999785,2,460,2181,5,18*")
    last_of_day = ptnl_event(2444 * WEEK_NS + 5 * NS, 65_540, 18)
    assert last_of_day.startswith(b"$PTNL,EVT,235947.000000,1,4,2443,6,18*")


@pytest.mark.parametrize("kind", [SeptentrioReceiver, NovatelReceiver, NmeaReceiver])
def test_marks_come_at_once_and_epochs_in_their_order(kind: Kind) -> None:
    """On a clock of the test's: what is due next is an edge or an epoch, whichever is first."""
    receiver = make(kind)
    receiver.mark(START_GPS_NS + 300_000_000)
    receiver.mark(START_GPS_NS + 310_000_000)
    dues, rising = [], 0
    receiver._plan_epoch(START_GPS_NS)
    for _ in range(10):
        dues.append(receiver.due_mono_ns())
        marks_before = receiver.statistics()["marks"]
        receiver.emit_due()
        rising += receiver.statistics()["marks"] - marks_before
    receiver.close()
    assert dues == sorted(dues)
    assert rising == 2
    assert receiver.statistics()["epochs"] == 6


@pytest.mark.parametrize("kind", [SeptentrioReceiver, NovatelReceiver, NmeaReceiver])
def test_faults_distinguish_marks_from_navigation(kind: Kind) -> None:
    receiver = make(kind)
    receiver.due_mono_ns()
    receiver._plan_epoch(START_GPS_NS)
    receiver.mark(START_GPS_NS + 1_000_000)
    topics = []
    for _ in range(3):
        receiver.due_mono_ns()
        ((topic, first_epoch),) = receiver.parts(receiver.emit_due())
        topics.append((topic, bool(first_epoch)))
    receiver.close()
    assert topics[0] == (MARK, True)
    assert (NAVIGATION, True) in topics[1:]


@pytest.mark.peer
def test_gpsd_reports_the_position_of_the_nmea_receiver() -> None:
    program = shutil.which("gpsd", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
    if program is None:
        pytest.skip("gpsd is absent; install Debian's gpsd")
    receiver = NmeaReceiver(WorldClock.from_wall_clock(), state_at)
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
        report = gpsd_position(port, timeout_s=20.0)
    finally:
        gpsd.terminate()
        gpsd.wait(timeout=10)
        receiver.close()
    assert report["lat"] == pytest.approx(STATE.latitude_deg, abs=2e-7)
    assert report["lon"] == pytest.approx(STATE.longitude_deg, abs=2e-7)
    assert report["altHAE"] == pytest.approx(STATE.height_m, abs=0.1)
    assert report["speed"] == pytest.approx(62.466, abs=0.01)

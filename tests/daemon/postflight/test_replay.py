"""What a replay compares, it compares; what was recorded is enough for it."""

from __future__ import annotations

import io
import json
import tracemalloc
import zipfile
from collections.abc import Iterable
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import FlightLog
from daemon.mission.log.log_records import Message, message_of
from daemon.onboard.flight.decisions import Decision, decision_of
from daemon.onboard.preflight.service_file import from_mapping
from daemon.postflight.replay.codecs import Decoded, codec_for, decode_all
from daemon.postflight.replay.flight_replay import ReplayResult, replay_log
from daemon.postflight.replay.product_comparison import _hashes_on_disk, content_hash
from drivers.contract import (
    ClockReading,
    DeviceEvent,
    NavSample,
    RawBytes,
    Record,
    TemperatureSample,
)
from drivers.thermometers.modbus_rtu.thermometer import ModbusThermometer
from sim_hw.receivers.emulated_receiver import ReceiverAccuracy, ReceiverState
from sim_hw.receivers.nmea_sentences import nmea
from sim_hw.receivers.ublox_messages import nav_att, nav_pvt
from tests.daemon.configuration.test_configuration import GOOD
from tests.drivers.fakes import FakeClock, FakePort, RecordingSink
from tests.drivers.test_modbus_rtu import reply

SECOND_NS = 1_000_000_000
EPOCHS = 5
GPS_NS = 1_479_000_000 * SECOND_NS


def sentences(second: int) -> bytes:
    """An epoch of a receiver at 47 N, 15 E."""
    gga = f"GPGGA,1200{second:02d}.00,4700.00000,N,01500.00000,E,4,14,0.6,1000.0,M,45.0,M,1.0,0000"
    rmc = f"GPRMC,1200{second:02d}.00,A,4700.00000,N,01500.00000,E,100.0,0.0,211126,,,R"
    return b"".join(nmea(text) for text in (gga, rmc))


def recorded(cuts: Iterable[int]) -> list[RawBytes | DeviceEvent]:
    """The line of a receiver, opened before its third epoch, in pieces of some sizes."""
    records: list[RawBytes | DeviceEvent] = []
    sizes = list(cuts)
    for second in range(EPOCHS):
        if second == 2:
            records.append(DeviceEvent("gnss", "opened", False, "", second * SECOND_NS))
        data, at = sentences(second), 0
        for size in [*sizes, len(data)]:
            if at < len(data):
                chunk = data[at : at + size]
                records.append(RawBytes("gnss", second * SECOND_NS + at, chunk))
                at += size
    return records


def decode(records: list[RawBytes | DeviceEvent]) -> list[Decoded]:
    codec = codec_for("navigator", "nmea", "gnss", {"port": "/dev/null"})
    assert codec is not None
    return decode_all(codec, records)


def flown_log() -> list[Record]:
    """What is logged of a u-blox receiver whose attitudes come behind its positions, opened before
    its third epoch; and readings of a clock, as of a receiver that can be asked."""
    state = ReceiverState(47.0, 15.0, 1000.0, (55.0, 0.0, 0.0), 1.0, 2.0, 0.0)
    recorded: list[RawBytes | DeviceEvent] = []
    for epoch in range(EPOCHS):
        mono_ns, gps_ns = (epoch + 1) * SECOND_NS, GPS_NS + epoch * SECOND_NS
        if epoch == 2:
            recorded.append(DeviceEvent("gnss", "opened", False, "", mono_ns))
        position = nav_pvt(gps_ns, state, ReceiverAccuracy(), 14, 18)
        attitude = nav_att(gps_ns, state, ReceiverAccuracy())
        recorded.append(RawBytes("gnss", mono_ns, position + attitude))
    codec = codec_for("navigator", "ublox", "gnss", {"port": "/dev/null"})
    assert codec is not None
    decoded = decode_all(codec, recorded)
    assert len(decoded) == EPOCHS - 2
    readings = [ClockReading("gnss", 7, record.mono_ns, 3) for record in decoded]
    both = [record for pair in zip(readings, decoded, strict=True) for record in pair]
    return [*recorded, *both]


def replay_of(log: Iterable[Record], folder: Path) -> ReplayResult:
    written = FlightLog.create(folder, boot_id="a boot")
    for record in log:
        written.write(message_of(record))
    written.close()
    configuration, rig = from_mapping({**GOOD, "thermometer": []}, folder / "service.toml")
    return replay_log(written.path, Mission(folder, "none"), rig, configuration, Mock())


def test_a_reading_of_a_clock_is_no_record_of_the_bytes(tmp_path: Path) -> None:
    replayed = replay_of(flown_log(), tmp_path)
    assert replayed.agrees, replayed.sentences
    assert replayed.agreements["records of gnss"] == EPOCHS - 2


def test_what_a_decoder_learned_from_bytes_that_were_not_logged_is_no_difference(
    tmp_path: Path,
) -> None:
    log = flown_log()
    opened = next(i for i, record in enumerate(log) if isinstance(record, DeviceEvent))
    replayed = replay_of(log[opened:], tmp_path)
    assert replayed.agrees, replayed.sentences
    assert replayed.agreements["records of gnss"] == EPOCHS - 3
    assert "the first 1 after it are taken as logged" in replayed.sentences[0]


@pytest.mark.parametrize("logs_first_bytes", [True, False])
def test_a_later_record_that_differs_is_a_difference(
    tmp_path: Path, logs_first_bytes: bool
) -> None:
    log = flown_log()
    log[-1] = replace(log[-1], height_m=999.0)
    replayed = replay_of(log[0 if logs_first_bytes else 2 :], tmp_path)
    assert replayed.disagreements == {"records of gnss": 1}


@given(st.lists(st.integers(min_value=1, max_value=60), max_size=5))
def test_bytes_mean_the_same_however_they_came_in_pieces(cuts: list[int]) -> None:
    in_one_piece, pieces = decode(recorded([])), decode(recorded(cuts))
    positions = [s for s in in_one_piece if isinstance(s, NavSample)]
    assert len(positions) >= EPOCHS - 3
    assert [s.gps_ns for s in in_one_piece] == [s.gps_ns for s in pieces]


def test_bytes_before_the_device_was_open_are_not_decoded() -> None:
    all_decoded = decode([r for r in recorded([]) if isinstance(r, RawBytes)])
    assert len(decode(recorded([]))) < len(all_decoded) == EPOCHS


def test_an_answer_that_came_too_late_in_flight_is_none_in_the_replay() -> None:
    clock = FakeClock()
    late = [reply(1, [999])]

    def answer(port: FakePort) -> bytes:
        if port.written:
            port.written = b""
            return b"" if late else reply(1, [7])
        return late.pop() if late and clock.now_ns > 1_900_000_000 else b""

    section = {"port": "/dev/probes", "channels": ["nose"], "parity": "N"}
    flown = ModbusThermometer(
        "probes", section, clock=clock, open_port=lambda *_: FakePort(clock, answer)
    )
    notebook = RecordingSink()
    notebook.stop = lambda _: flown._closing.set() if len(notebook.records) > 8 else None
    flown.run(notebook)
    records = notebook.records
    samples = [r for r in records if isinstance(r, TemperatureSample)]
    assert len(samples) >= 2 and samples[0].value_c == 0.7
    (stale,) = [r for r in records if isinstance(r, RawBytes) and r.device == "probes.stale"]
    assert stale.data == reply(1, [999])
    # A replay takes only what has the device's name.
    of_device = (RawBytes, DeviceEvent)
    recorded = [r for r in records if isinstance(r, of_device) and r.device == "probes"]
    codec = codec_for("thermometer", "modbus-rtu", "probes", section)
    assert codec is not None
    found = [r.value_c for r in decode_all(codec, recorded) if isinstance(r, TemperatureSample)]
    assert found == [r.value_c for r in samples]


def test_a_device_whose_bytes_are_not_logged_has_no_codec() -> None:
    assert codec_for("thermometer", "host", "host", {}) is None
    assert codec_for("navigator", "no-such-driver", "gnss", {}) is None


def test_a_decision_survives_the_log_and_damage_is_none() -> None:
    decision = Decision("advance", 12, 0, {"store": [3], "seal": None})
    assert decision_of(decision.message()) == decision
    for payload in (b"", b"{}", b'{"kind": 3}', b'{"kind": "advance", "number": "x"}'):
        assert decision_of(Message("decision", 1, payload)) is None


def tiff(pixels: np.ndarray, **how: object) -> bytes:
    buffer = BytesIO()
    tifffile.imwrite(buffer, pixels, **how)
    return buffer.getvalue()


def test_pixels_are_compared_and_not_how_they_are_written() -> None:
    pixels = np.arange(600, dtype=np.uint16).reshape(20, 30)
    one, other = tiff(pixels), tiff(pixels, description="another writer")
    assert one != other
    assert content_hash("pan.tif", one) == content_hash("pan.tif", other)
    pixels[7, 7] ^= 1
    assert content_hash("pan.tif", tiff(pixels)) != content_hash("pan.tif", one)


def test_durations_are_left_out_of_the_report_and_nothing_else() -> None:
    def report(**content: object) -> str:
        return content_hash("quality.json", json.dumps(content).encode())

    assert report(verdict="good", timings_s=1) == report(verdict="good", timings_s=2)
    assert report(verdict="good", timings_s=1) != report(verdict="refly", timings_s=1)


def test_nothing_compared_is_not_agreement() -> None:
    replayed = ReplayResult()
    assert not replayed.agrees
    replayed.compare("ledger", agrees=True)
    assert replayed.agrees
    replayed.compare("ledger", agrees=False, sentence="it differs")
    assert (replayed.agrees, replayed.sentences) == (False, ["it differs"])


@pytest.mark.trust
def test_products_that_unpack_to_more_than_they_warrant_are_unreadable(tmp_path) -> None:
    """A TIFF of 40,000 x 40,000 px in 5 kB, an .npz whose member announces gigabytes."""
    buffer = io.BytesIO()
    tifffile.imwrite(buffer, np.zeros((16, 16), np.uint16), metadata=None)
    data = bytearray(buffer.getvalue())
    with tifffile.TiffFile(io.BytesIO(data)) as tiff:
        for code in (256, 257, 278):
            at = tiff.pages[0].tags[code].valueoffset
            size = 4 if tiff.pages[0].tags[code].dtype == 4 else 2
            data[at : at + size] = (40_000).to_bytes(size, "little")
    (tmp_path / "pan.tif").write_bytes(data)
    with zipfile.ZipFile(tmp_path / "geometry.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", bytes(300_000_000))
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04 no archive")
    (tmp_path / "quality.json").write_bytes(b"[" * 100_000)
    tracemalloc.start()
    found = _hashes_on_disk(tmp_path)
    assert tracemalloc.get_traced_memory()[1] < 64_000_000
    tracemalloc.stop()
    assert set(found.values()) == {"unreadable"}

"""The flight log: nothing handed over is lost, and a torn file reads up to where it is torn."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from daemon.mission.log.flight_log import FlightLog, logs_of, read
from daemon.mission.log.log_records import LoggedTrigger, Message, message_of, record_of
from drivers.contract import (
    ClockReading,
    DeviceEvent,
    EventMark,
    Frame,
    FrameStatus,
    NavSample,
    PpsEdge,
    PtpReading,
    RawBytes,
    TemperatureSample,
    TriggerPulse,
)

RECORDS = [
    EventMark("gnss", 0, 1_447_000_000_123_456_789, 60, 65535, 16, True, 9_007_199_254_740_993),
    NavSample(
        "gnss", 1_447_000_000_200_000_000, 5, "3d", 14, 47.1, 15.4, 512.25, 1.2, 2.5,
        (60.0, -1.5, 0.25), 0.1, None, None, 1.5, 18, True,
    ),
    TemperatureSample("0", 31.25, 7),
    TemperatureSample("1", None, 8),
    PpsEdge("receiver", 2**32 - 1, 10**15 + 1, 2_500),
    ClockReading("autopilot", 2**61, 10**15 + 2, 300_000),
    PtpReading("SU00", 10**15 + 3, "Slave", -812, "001122fffe334455"),
    PtpReading("SU01", 10**15 + 4, "Listening", None, ""),
    DeviceEvent("SU00", "lost", True, "SU00 does not answer; look at its cable", 9),
    Frame(
        "SU00", 2, FrameStatus.INCOMPLETE, 2**60, 41, 1248, 832, "Mono12", 2**62, 2**62 + 5,
        10**15, 900, 10**15 + 3, 4000.0, 30.5, {"tdi_shifts": 12, "gain_db": 0.5, "mode": "on"},
    ),
    LoggedTrigger(12, TriggerPulse(12, 10**15, 150_000, 3), {"0": 0, "1": 1_333_333}, 2_000_000),
]  # fmt: skip


@pytest.fixture
def log(tmp_path):
    log = FlightLog.create(tmp_path / "log", boot_id="boot-1", software="syntopic test")
    yield log
    log.close()


@pytest.mark.parametrize("record", RECORDS, ids=lambda r: type(r).__name__)
def test_a_record_reads_back_as_it_was(record):
    assert record_of(message_of(record)) == record


def test_bytes_of_a_device_are_kept_as_they_came(log):
    all_bytes = bytes(range(256))
    log.write(message_of(RawBytes("gnss", 77, all_bytes)))
    assert list(read(log.path)) == [Message("raw/gnss", 77, all_bytes)]


@given(st.text(), st.binary(max_size=60))
def test_a_damaged_message_is_no_record_and_raises_nothing(topic, payload):
    assert record_of(Message(topic, 0, payload)) is None
    assert record_of(Message("mark/gnss", 0, payload)) is None


@settings(max_examples=150)
@given(st.data())
def test_a_message_with_a_wrong_value_is_no_record(data):
    import json

    message = message_of(data.draw(st.sampled_from(RECORDS)))
    content = json.loads(message.payload)
    key = data.draw(st.sampled_from(sorted(content)))
    content[key] = data.draw(st.sampled_from([[], {}, "x", -1, 1e400, True, "1" * 30]))
    text = json.dumps(content).encode()
    record = record_of(Message(message.topic, message.mono_ns, text))
    assert record is None or type(record) in {type(r) for r in RECORDS}


def test_what_json_cannot_hold_is_logged_as_text_and_raises_nothing(log):
    log.append("service/odd", 1, {"big": 2**60, "nan": float("nan"), "what": object, "s": "\ud800"})
    (message,) = read(log.path)
    assert b'"big":"1152921504606846976"' in message.payload
    assert b'"nan":null' in message.payload


def test_another_program_reads_a_closed_log(log):
    for record in RECORDS:
        log.write(message_of(record))
    log.sync()
    log.close()
    log.close()
    with log.path.open("rb") as file:
        reader = make_reader(file)
        statistics = reader.get_summary().statistics
        topics = [channel.topic for _, channel, _ in reader.iter_messages(log_time_order=False)]
    assert statistics.message_count == len(RECORDS) + 2
    assert topics.count("log/checkpoint") == 2
    assert "mark/gnss" in topics and "trigger" in topics
    reader = read(log.path)
    assert [record_of(m) for m in reader] == RECORDS
    assert reader.is_complete and reader.cut_nbytes == 0 and reader.bad_checkpoints == 0
    assert reader.boot_id == "boot-1"
    assert logs_of(log.path.parent) == [log.path]


def test_a_log_torn_at_any_byte_reads_up_to_there(log, tmp_path):
    for record in RECORDS:
        log.write(message_of(record))
    log.sync()
    data = log.path.read_bytes()
    complete = [record_of(m) for m in read(log.path)]
    torn = tmp_path / "torn.mcap"
    seen = set()
    for length in range(len(data)):
        torn.write_bytes(data[:length])
        reader = read(torn)
        found = [record_of(m) for m in reader]
        assert found == complete[: len(found)]
        assert not reader.is_complete and 0 <= reader.cut_nbytes <= length
        assert reader.bad_checkpoints == 0
        seen.add(len(found))
    assert seen == set(range(len(RECORDS) + 1))


@settings(max_examples=200, deadline=None)
@given(tail=st.binary(max_size=300))
def test_garbage_behind_the_last_message_is_cut_and_counted(tmp_path_factory, tail):
    folder = tmp_path_factory.mktemp("log")
    log = FlightLog(folder / "a.mcap", boot_id="b")
    log.write(message_of(RECORDS[0]))
    with log.path.open("ab") as file:
        file.write(tail)
    reader = read(log.path)
    found = list(reader)
    assert record_of(found[0]) == RECORDS[0]
    assert reader.cut_nbytes <= len(tail)
    os.close(log._stream._descriptor)


def test_zeros_of_a_power_cut_are_cut(log):
    log.write(message_of(RECORDS[0]))
    with log.path.open("ab") as file:
        file.write(bytes(4096))
    reader = read(log.path)
    assert len(list(reader)) == 1
    assert reader.cut_nbytes == 4096


def test_a_bit_that_turned_on_the_disk_is_seen_at_the_next_checkpoint(log):
    log.write(message_of(RawBytes("gnss", 1, b"\xb5\x62 as it came")))
    log.sync()
    data = log.path.read_bytes().replace(b"as it came", b"as it cane")
    log.path.write_bytes(data)
    reader = read(log.path)
    assert len(list(reader)) == 1
    assert reader.bad_checkpoints == 1


def test_a_checkpoint_that_cannot_be_read_is_counted_as_bad(log):
    log.sync()
    data = log.path.read_bytes()
    log.path.write_bytes(data.replace(b'{"crc32"', b'["crc32"'))
    reader = read(log.path)
    assert list(reader) == []
    assert reader.bad_checkpoints == 1


def test_a_refusing_disk_costs_messages_and_the_log_counts_them(log, monkeypatch):
    log.append("service/a", 1, {"n": 1})
    with monkeypatch.context() as patch:
        half_done = os.write

        def short(descriptor, data):
            half_done(descriptor, data[: len(data) // 2])
            raise OSError(28, "No space left on device")

        patch.setattr("daemon.mission.log.flight_log.os.write", short)
        for n in (2, 3):
            log.append("service/b", n, {"n": n})
        log.sync()
    assert log.dropped == 2
    log.append("service/b", 4, {"n": 4})
    log.close()
    reader = read(log.path)
    messages = [(m.topic, m.payload) for m in reader]
    assert messages == [
        ("service/a", b'{"n":1}\n'),
        ("log/dropped", b'{"dropped":2}\n'),
        ("service/b", b'{"n":4}\n'),
    ]
    assert reader.is_complete and reader.bad_checkpoints == 0


def test_a_killed_process_loses_nothing_it_handed_over(tmp_path):
    program = f"""
import sys
from pathlib import Path
sys.path.insert(0, {str(Path.cwd())!r})
from daemon.mission.log.flight_log import FlightLog
log = FlightLog(Path({str(tmp_path / "k.mcap")!r}), boot_id="b")
n = 0
while True:
    n += 1
    log.append("raw/gnss", n, b"x" * 100)
    print(n, flush=True)
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
        for _ in range(500):
            acknowledged = int(process.stdout.readline())
        process.send_signal(signal.SIGKILL)
        last_lines = process.stdout.read().split(b"\n")
        process.wait(timeout=30)
    acknowledged = max([acknowledged, *(int(line) for line in last_lines[:-1])])
    reader = read(tmp_path / "k.mcap")
    numbers = [message.mono_ns for message in reader]
    assert numbers[:acknowledged] == list(range(1, acknowledged + 1))
    assert len(numbers) - acknowledged in (0, 1)

"""The Modbus RTU thermometer: frames by the book, and what a bad line does to them."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.contract import DeviceError, TemperatureSample
from drivers.thermometers.modbus_rtu.frames import crc16, find_reply, read_request
from drivers.thermometers.modbus_rtu.thermometer import ModbusThermometer
from tests.drivers.fakes import FakeClock, FakePort, RecordingSink


def reply(unit: int, registers: list[int]) -> bytes:
    """An answer as the standard has it."""
    body = struct.pack(f">BBB{len(registers)}H", unit, 4, 2 * len(registers), *registers)
    return body + struct.pack("<H", crc16(body))


def refusal(unit: int, code: int) -> bytes:
    body = struct.pack(">BBB", unit, 0x84, code)
    return body + struct.pack("<H", crc16(body))


def test_the_checksum_is_that_of_the_standard() -> None:
    # Modbus over Serial Line V1.02, 6.2.2: the CRC of 02 07 goes out as 41 12.
    assert struct.pack("<H", crc16(b"\x02\x07")) == b"\x41\x12"


def test_a_request_is_that_of_the_published_example() -> None:
    assert read_request(0x11, 0x0008, 1).hex(" ") == "11 04 00 08 00 01 b2 98"


def test_the_answer_of_the_published_example_is_read() -> None:
    found = find_reply(bytes.fromhex("11 04 02 00 0a f8 f4"), 0x11, 1)
    assert found is not None
    assert found.registers == (10,)


def test_noise_and_the_echo_of_the_request_are_stepped_over() -> None:
    echo = read_request(1, 0, 2)
    found = find_reply(b"\x00\x01" + echo + reply(1, [250, 65484]), 1, 2)
    assert found is not None
    assert found.registers == (250, 65484)
    assert found.skipped == 2 + len(echo)


@given(noise=st.binary(max_size=40), damage=st.integers(0, 8), bit=st.integers(0, 7))
def test_a_damaged_answer_is_no_answer(noise: bytes, damage: int, bit: int) -> None:
    good = bytearray(reply(9, [1, 2]))
    good[damage] ^= 1 << bit
    assert find_reply(bytes(good), 9, 2) is None
    find_reply(noise, 9, 2)


def _thermometer(
    clock: FakeClock, answer: Callable[[FakePort], bytes], **more: object
) -> ModbusThermometer:
    section = {"port": "/dev/probes", "channels": ["0", "1", "G"], "parity": "N", **more}
    return ModbusThermometer(
        "probes", section, clock=clock, open_port=lambda *_: FakePort(clock, answer)
    )


def _answers(*answers: bytes) -> Callable[[FakePort], bytes]:
    """One answer for each request written, the last one again and again."""
    left = list(answers)

    def answer(port: FakePort) -> bytes:
        if not port.written:
            return b""
        port.written = b""
        return left.pop(0) if len(left) > 1 else left[0]

    return answer


def _run(thermometer: ModbusThermometer, polls: int) -> RecordingSink:
    """Run until that many samples or events have come."""
    recorder = RecordingSink()

    def stop(_: object) -> None:
        if len(recorder.records) >= polls:
            thermometer._closing.set()

    recorder.stop = stop
    thermometer.run(recorder)
    return recorder


def _samples(recorder: RecordingSink) -> list[tuple[str, float | None]]:
    return [(r.probe, r.value_c) for r in recorder.records if isinstance(r, TemperatureSample)]


def test_registers_are_signed_tenths_of_a_degree_in_the_order_of_the_channels() -> None:
    clock = FakeClock()
    recorder = _run(_thermometer(clock, _answers(reply(1, [215, 65484, 0]))), 5)
    assert _samples(recorder)[:3] == [("0", 21.5), ("1", -5.2), ("G", 0.0)]


def test_an_open_sensor_gives_a_sample_without_a_value() -> None:
    clock = FakeClock()
    recorder = _run(_thermometer(clock, _answers(reply(1, [0x7FFF, 0x8000, 1]))), 5)
    assert _samples(recorder)[:2] == [("0", None), ("G", 0.1)]


def test_a_number_that_is_no_temperature_is_reported_and_not_given() -> None:
    clock = FakeClock()
    thermometer = _thermometer(clock, _answers(reply(1, [215, 0x8000, 1])))
    recorder = _run(thermometer, 8)
    assert {probe for probe, _ in _samples(recorder)} == {"0", "G"}
    (event,) = [event for event in recorder.events if event.name == "implausible"]
    assert "Probe 1" in event.sentence and "-3276.8 degC" in event.sentence
    assert thermometer.statistics()["implausible"] >= 2
    found = _thermometer(clock, _answers(reply(1, [215, 0x8000, 1]))).bind()
    assert found["probe 1"].startswith("-3276.8 degC is no temperature; check value_type")


def test_it_reads_once_a_second() -> None:
    clock = FakeClock()
    thermometer = _thermometer(clock, _answers(reply(1, [1, 2, 3])))
    recorder = _run(thermometer, 30)
    times = [
        r.mono_ns for r in recorder.records if isinstance(r, TemperatureSample) and r.probe == "0"
    ]
    steps_s = [(b - a) * 1e-9 for a, b in itertools.pairwise(times)]
    assert steps_s == pytest.approx([1.0] * len(steps_s), abs=0.05)


def test_an_exception_is_reported_with_its_meaning_and_is_no_silence() -> None:
    clock = FakeClock()
    thermometer = _thermometer(clock, _answers(refusal(1, 2)))
    recorder = _run(thermometer, 12)
    assert _samples(recorder) == []
    exceptions = [event for event in recorder.events if event.name == "exception"]
    assert "exception 2: it has no such registers; check first_register" in exceptions[0].sentence
    assert "silent" not in recorder.event_names
    assert thermometer.statistics()["exceptions"] >= 5


def test_one_damaged_answer_costs_only_itself() -> None:
    clock = FakeClock()
    damaged = bytearray(reply(1, [1, 2, 3]))
    damaged[4] ^= 0x10
    thermometer = _thermometer(clock, _answers(bytes(damaged), reply(1, [10, 20, 30])))
    recorder = _run(thermometer, 8)
    assert _samples(recorder)[:3] == [("0", 1.0), ("1", 2.0), ("G", 3.0)]
    assert recorder.event_names[:2] == ["opened", "checksum"]
    assert thermometer.statistics()["bad_messages"] == 1
    assert thermometer.statistics()["bad_bytes"] == len(damaged)


def test_an_answer_that_comes_after_its_time_is_not_taken_for_the_next() -> None:
    clock = FakeClock()
    late = [reply(1, [999, 999, 999])]

    def answer(port: FakePort) -> bytes:
        if port.written:
            port.written = b""
            return b"" if late else reply(1, [1, 2, 3])
        return late.pop() if late and clock.now_ns > 1_900_000_000 else b""

    recorder = _run(_thermometer(clock, answer), 6)
    assert ("0", 99.9) not in _samples(recorder)
    assert _samples(recorder)[0] == ("0", 0.1)


def test_a_module_that_sends_nothing_is_silent_after_five_seconds() -> None:
    clock = FakeClock()
    start_ns = clock.now_ns
    thermometer = _thermometer(clock, lambda port: b"")
    recorder = _run(thermometer, 2)
    assert recorder.event_names == ["opened", "silent"]
    assert 5.0 <= (recorder.events[1].mono_ns - start_ns) * 1e-9 < 6.0
    assert thermometer.statistics()["timeouts"] >= 4


def test_binding_reads_every_probe_once() -> None:
    clock = FakeClock()
    found = _thermometer(clock, _answers(reply(1, [215, 0x7FFF, 65535]))).bind()
    assert found == {
        "port": "/dev/probes",
        "unit": "1",
        "probe 0": "21.5 degC",
        "probe 1": "open",
        "probe G": "-0.1 degC",
    }


def test_binding_to_a_module_of_another_number_states_what_to_check() -> None:
    clock = FakeClock()
    with pytest.raises(DeviceError, match=r"unit 1 at /dev/probes gave no answer.*A and B swapped"):
        _thermometer(clock, _answers(reply(2, [1, 2, 3]))).bind()


@settings(max_examples=50, deadline=None)
@given(st.lists(st.binary(max_size=30), min_size=1, max_size=8))
def test_whatever_a_module_sends_nothing_is_raised(answers: list[bytes]) -> None:
    clock = FakeClock()
    left = list(answers)

    def answer(port: FakePort) -> bytes:
        clock.now_ns += 10_000_000
        if not left:
            thermometer._closing.set()
            return b""
        return left.pop()

    thermometer = _thermometer(clock, answer)
    thermometer.run(RecordingSink())
    assert thermometer.statistics()["bytes"] == sum(len(a) for a in answers) - sum(
        len(a) for a in left
    )

"""The ASCII line thermometer: what instruments write, and what a bad line does."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.contract import DeviceError, TemperatureSample
from drivers.thermometers.ascii_line.thermometer import AsciiLineThermometer
from tests.drivers.fakes import FakeClock, FakePort, RecordingSink
from tests.drivers.pty_line import PtyLine

TWO = r"^T1=\s*(?P<a>\S+) T2=\s*(?P<b>\S+)$"
ONE = r"^CH(?P<channel>\d+): *(?P<value>\S+)"


def thermometer(
    clock: FakeClock, answer: Callable[[FakePort], bytes], **more: object
) -> AsciiLineThermometer:
    section = {"port": "/dev/probes", "pattern": TWO, "channels": ["0", "G"], **more}
    return AsciiLineThermometer(
        "probes", section, clock=clock, open_port=lambda *_: FakePort(clock, answer)
    )


def readings(
    data: bytes, **more: object
) -> tuple[list[TemperatureSample], dict[str, int], RecordingSink]:
    """What a thermometer makes of bytes that come once; it is closed when the line falls still."""
    left = [data]
    device: AsciiLineThermometer

    def answer(port: FakePort) -> bytes:
        if left:
            return left.pop()
        device._closing.set()
        return b""

    device = thermometer(FakeClock(), answer, **more)
    recorder = RecordingSink()
    device.run(recorder)
    samples = [r for r in recorder.records if isinstance(r, TemperatureSample)]
    return samples, dict(device.statistics()), recorder


def values(data: bytes, **more: object) -> list[tuple[str, float | None]]:
    return [(sample.probe, sample.value_c) for sample in readings(data, **more)[0]]


def test_a_line_holds_the_readings_of_several_channels() -> None:
    assert values(b"T1= 21.5 T2=-0,25\r\n") == [("0", 21.5), ("G", -0.25)]


def test_a_line_per_channel_names_its_probe() -> None:
    data = b"CH1: 20.5\rCH7: 99\rCH2: 1e1\r"
    found, counted, _ = readings(data, pattern=ONE, channel_labels=["1", "2"])
    assert [(s.probe, s.value_c) for s in found] == [("0", 20.5), ("G", 10.0)]
    assert counted["other_channels"] == 1


def test_an_open_sensor_is_a_sample_without_a_value() -> None:
    found = values(b"T1=open T2=----\n", open_sensor_labels=["OPEN", "----"])
    assert found == [("0", None), ("G", None)]


@pytest.mark.parametrize(("unit", "expected"), [("C", 50.0), ("F", 10.0), ("K", -223.15)])
def test_units_end_in_degrees_celsius(unit: str, expected: float) -> None:
    found = values(b"T1=50 T2=50\n", unit=unit)
    assert found[0][1] == pytest.approx(expected)


@pytest.mark.parametrize("reading", [b"nan", b"inf", b"-274", b"1_0", b"9e99", b"0x10", b"2001"])
def test_what_is_no_temperature_is_no_sample_and_harms_no_neighbour(reading: bytes) -> None:
    found, counted, recorder = readings(b"T1=" + reading + b" T2=21\n")
    assert [(s.probe, s.value_c) for s in found] == [("G", 21.0)]
    assert counted["bad_messages"] == 1
    assert "unreadable" in recorder.event_names


def test_a_line_without_an_end_is_dropped_and_the_next_one_is_read() -> None:
    found, counted, _ = readings(b"x" * 100_000 + b"\nT1=1 T2=2\n")
    assert [s.value_c for s in found] == [1.0, 2.0]
    assert counted["bad_bytes"] >= 100_000
    assert counted["lines"] == 1


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=600))
def test_random_bytes_neither_raise_nor_harm_the_next_line(data: bytes) -> None:
    assert values(data + b"\nT1=1 T2=2\n")[-2:] == [("0", 1.0), ("G", 2.0)]


def test_a_command_is_sent_at_its_interval() -> None:
    clock = FakeClock()
    commands: list[tuple[int, bytes]] = []
    device: AsciiLineThermometer

    def answer(port: FakePort) -> bytes:
        if not port.written:
            return b""
        commands.append((clock.now_ns, port.written))
        port.written = b""
        if len(commands) == 4:
            device._closing.set()
        return b"T1=1 T2=2\r"

    device = thermometer(clock, answer, command="*T?", command_end="crlf", interval_s=0.5)
    recorder = RecordingSink()
    device.run(recorder)
    assert {command for _, command in commands} == {b"*T?\r\n"}
    gaps_s = [(b - a) / 1e9 for (a, _), (b, _) in itertools.pairwise(commands)]
    assert gaps_s == pytest.approx([0.5] * 3, abs=0.01)
    assert device.statistics()["readings"] == 8


@pytest.mark.parametrize(
    ("received", "hint"),
    [
        (b"", "nothing came"),
        (b"T1=", "no complete line came"),
        (b"hello\n", "the last was 'hello'; check pattern"),
        (b"T1=1 T2=?\n", "no reading of G"),
    ],
)
def test_binding_states_what_is_wrong(received: bytes, hint: str) -> None:
    left = [received]
    device = thermometer(FakeClock(), lambda port: left.pop() if left else b"")
    with pytest.raises(DeviceError, match=hint):
        device.bind()


def test_contradicting_settings_are_refused_with_a_sentence() -> None:
    def problems_of(**more: object) -> str:
        section = {"port": "/dev/probes", "pattern": TWO, "channels": ["0", "G"], **more}
        return "\n".join(AsciiLineThermometer.problems(section))

    assert problems_of() == ""
    assert "(?P<x>'; it does not compile" in problems_of(pattern="(?P<x>")
    assert "pattern has 0 named groups; 2 are needed" in problems_of(pattern=r"T=\d+")
    assert "channels names 0 twice" in problems_of(channels=["0", "0"])
    assert "channel_labels is given; only" in problems_of(channel_labels=["a", "b"])
    assert "has 1 labels; channels has 2" in problems_of(pattern=ONE, channel_labels=["a"])
    assert "at least twice interval_s = 20" in problems_of(command="T?", interval_s=10.0)


def test_an_instrument_on_a_real_line_is_bound_and_read() -> None:
    with PtyLine() as line:
        device = AsciiLineThermometer(
            "probes", {"port": line.near, "pattern": TWO, "channels": ["0", "G"]}
        )
        threading.Timer(0.1, line.inject, (b"garbage\r\nT1=20.0 T2=OPEN\r\n",)).start()
        found = device.bind()
        device.close()
    assert (found["probe 0"], found["probe G"]) == ("20.00 degC", "open")

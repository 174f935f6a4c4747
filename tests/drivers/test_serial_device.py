"""The base of serial devices: opening, losing, silence and closing, on a clock of our own."""

from __future__ import annotations

import os
import termios
import threading
from collections.abc import Iterable, Mapping

import pytest
import serial

from drivers.contract import DeviceError, LifeCycle, RawBytes, TemperatureSample
from drivers.transport.serial_device import SerialDevice, SerialLine, open_serial_port
from tests.drivers.fakes import FakeClock, FakePort, RecordingSink, refusing_port
from tests.support.stopwatch import Stopwatch


class EchoDevice(SerialDevice):
    """Understands the byte "!" and takes all else for noise."""

    what = "parrot"

    def line_settings(self) -> tuple[int, str]:
        return 9600, "N"

    def identify(self, line: SerialLine) -> Mapping[str, str]:
        if b"!" not in line.read(0.2):
            raise DeviceError(f"{self.name}: it does not speak; feed it")
        return {"voice": "loud"}

    def step(self, line: SerialLine) -> Iterable[TemperatureSample]:
        read_bytes = line.read(0.2)
        self.count_messages(messages=read_bytes.count(b"!"))
        return [TemperatureSample("beak", 39.0, self.clock.mono_ns())] * read_bytes.count(b"!")


def _echo_device(clock: FakeClock, *ports: FakePort) -> EchoDevice:
    """A parrot whose port is each of these in turn, and then none."""
    left = list(ports)

    def opener(path: str, baudrate: int, parity: str) -> FakePort:
        return left.pop(0) if left else refusing_port(path, baudrate, parity)

    return EchoDevice(
        "polly", {"port": "/dev/polly", "silence_s": 3}, clock=clock, open_port=opener
    )


def _run_until(echo_device: EchoDevice, clock: FakeClock, seconds: float) -> RecordingSink:
    """Run in this thread until the fake clock has passed that many seconds."""
    recorder = RecordingSink()
    end_ns = clock.now_ns + round(seconds * 1e9)
    wait = clock.wait

    def wait_and_end(event: threading.Event, timeout_s: float) -> bool:
        wait(event, timeout_s)
        if clock.now_ns >= end_ns:
            event.set()
        return event.is_set()

    clock.wait = wait_and_end
    echo_device.run(recorder)
    return recorder


def test_a_port_that_cannot_be_opened_is_tried_after_02_04_08_up_to_5_s() -> None:
    clock = FakeClock()
    recorder = _run_until(_echo_device(clock), clock, 20)
    assert clock.waits_s[:7] == [0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0]
    assert recorder.event_names == ["lost"], "the loss is reported once, not every time"
    assert "check the cable" in recorder.events[0].sentence


def test_silence_is_noticed_after_the_stated_time_and_its_end_too() -> None:
    clock = FakeClock()
    quiet = FakePort(clock, lambda port: b"")
    start_ns = clock.now_ns

    def say_once_per_step(port: FakePort) -> bytes:
        clock.now_ns += 200_000_000
        return b"!" if clock.now_ns < 10_000_000_000 else b""

    talking = FakePort(clock, say_once_per_step)
    recorder = _run_until(_echo_device(clock, quiet, talking), clock, 15)
    assert recorder.event_names[:3] == ["opened", "silent", "recovered"]
    silent, recovered = recorder.events[1:3]
    assert 3.0 <= (silent.mono_ns - start_ns) * 1e-9 < 3.3
    assert silent.is_fault
    assert not recovered.is_fault
    assert "polly" in silent.sentence
    assert quiet.closed, "a silent port is reopened"


def test_noise_is_no_sign_of_life() -> None:
    clock = FakeClock()

    def noise(port: FakePort) -> bytes:
        clock.now_ns += 100_000_000
        return b"\xff\x00"

    recorder = _run_until(_echo_device(clock, FakePort(clock, noise)), clock, 4)
    assert "silent" in recorder.event_names


def test_a_port_that_fails_in_use_is_lost_and_opened_again() -> None:
    clock = FakeClock()

    def fail(port: FakePort) -> bytes:
        raise serial.SerialException("device reports readiness to read but returned no data")

    def talk(port: FakePort) -> bytes:
        clock.now_ns += 100_000_000
        return b"!"

    recorder = RecordingSink()
    echo_device = _echo_device(clock, FakePort(clock, fail), FakePort(clock, talk))
    recorder.stop = lambda record: (
        echo_device._closing.set() if isinstance(record, TemperatureSample) else None
    )
    echo_device.run(recorder)
    assert recorder.event_names == ["opened", "lost", "opened"]
    assert echo_device.statistics()["opened"] == 2
    assert echo_device.state is LifeCycle.INACTIVE


def test_every_byte_goes_to_the_flight_log() -> None:
    clock = FakeClock()
    read_bytes = [b"abc", b"!", b"\x00\xff!"]

    def talk(port: FakePort) -> bytes:
        clock.now_ns += 100_000_000
        return read_bytes.pop(0) if read_bytes else b""

    echo_device = _echo_device(clock, FakePort(clock, talk))
    recorder = _run_until(echo_device, clock, 4)
    raw = b"".join(r.data for r in recorder.records if isinstance(r, RawBytes))
    assert raw == b"abc!\x00\xff!"
    assert echo_device.statistics()["bytes"] == 7
    assert echo_device.statistics()["messages"] == 2


def test_binding_reports_what_was_found_or_what_to_do() -> None:
    clock = FakeClock()
    echo_device = _echo_device(clock, FakePort(clock, lambda port: b"!"))
    assert echo_device.state is LifeCycle.CREATED
    assert echo_device.bind() == {"port": "/dev/polly", "voice": "loud"}
    assert echo_device.state is LifeCycle.BOUND
    with pytest.raises(DeviceError, match="feed it"):
        _echo_device(clock, FakePort(clock, lambda port: b"")).bind()


@pytest.mark.realtime
def test_closing_ends_a_run_within_two_seconds_and_may_be_done_twice() -> None:
    master, slave = os.openpty()
    try:
        echo_device = EchoDevice("polly", {"port": os.ttyname(slave)})
        thread = threading.Thread(target=echo_device.run, args=(RecordingSink(),))
        thread.start()
        watch = Stopwatch()
        echo_device.close()
        echo_device.close()
        thread.join(20)
        assert not thread.is_alive()
        assert watch.is_within(1.0)
        assert echo_device.state is LifeCycle.INACTIVE
    finally:
        os.close(master)
        os.close(slave)


def test_a_pseudo_terminal_that_refuses_parity_reports_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise termios.error(22, "Invalid argument")

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(DeviceError, match=r'parity E is refused.*set parity = "N"'):
        open_serial_port("/dev/pts/1", 9600, "E")


def test_a_port_that_does_not_exist_reports_it() -> None:
    with pytest.raises(DeviceError, match="there is no such port; check the cable"):
        open_serial_port("/dev/there-is-none", 9600, "N")


def test_a_port_that_another_program_holds_is_refused() -> None:
    master, slave = os.openpty()
    try:
        first = open_serial_port(os.ttyname(slave), 9600, "N")
        with pytest.raises(DeviceError, match="this program has it open already"):
            open_serial_port(os.ttyname(slave), 9600, "N")
        first.close()
    finally:
        os.close(master)
        os.close(slave)

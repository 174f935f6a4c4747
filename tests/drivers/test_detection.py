"""Finding devices: protocol and speed, over lines that garble data at a wrong baud rate."""

from __future__ import annotations

import functools
import json
import operator
import os
import shutil
import socket
import subprocess
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from daemon.cli import app
from daemon.cli.find_ports import toml_sections
from drivers.base import registry
from drivers.detection.line_format import line_format_of
from drivers.detection.port_search import DetectionResult, search
from drivers.detection.protocol_detection import ProtocolDetector
from drivers.thermometers.ascii_line.pattern import LinePattern
from sim_hw.devices.ascii_probe import AsciiProbe
from sim_hw.devices.device_loop import LineDevice
from sim_hw.devices.modbus_probe import ModbusProbe
from sim_hw.devices.network_line import TcpLine, UdpLine
from sim_hw.receivers.mavlink_autopilot import MavlinkAutopilot
from sim_hw.receivers.nmea_receiver import NmeaReceiver
from sim_hw.receivers.novatel_receiver import NovatelReceiver
from sim_hw.receivers.septentrio_receiver import SeptentrioReceiver
from sim_hw.receivers.ublox_receiver import UbloxReceiver
from sim_hw.world.world_clock import WorldClock
from tests.drivers.fakes import FakeClock, FakePort
from tests.drivers.uart_relay import UartRelay, sampled
from tests.sim_hw.receiver_state import state_at
from tests.system.demo_mission import syntopic

pytestmark = pytest.mark.realtime


DEVICES: dict[str, tuple[Callable[[], LineDevice], str, int]] = {
    # The u-blox sends NMEA in addition to its own: it is a u-blox all the same.
    "ublox": (lambda: UbloxReceiver(_clock(), state_at, rate_hz=1.0), "ublox", 38_400),
    "novatel": (lambda: NovatelReceiver(_clock(), state_at, rate_hz=1.0), "novatel", 230_400),
    "septentrio": (lambda: SeptentrioReceiver(_clock(), state_at, rate_hz=1.0), "septentrio",
                   115_200),
    "nmea": (lambda: NmeaReceiver(_clock(), state_at, rate_hz=1.0), "nmea", 9_600),
    "mavlink": (lambda: MavlinkAutopilot(_clock(), state_at), "mavlink", 57_600),
    "ascii": (lambda: AsciiProbe([lambda: 21.5, lambda: None], ["T1={0} T2={1}"]), "ascii-line",
              9_600),
    "modbus": (lambda: ModbusProbe([lambda: 21.5], unit=2), "modbus-rtu", 19_200),
}  # fmt: skip


def _clock() -> WorldClock:
    return WorldClock.from_wall_clock()


@contextmanager
def running(*devices: LineDevice) -> Iterator[None]:
    for device in devices:
        device.start()
    try:
        yield
    finally:
        for device in devices:
            device.close()


def test_at_the_right_speed_a_line_carries_every_byte_and_at_a_wrong_one_garbage() -> None:
    sentence = b"$GNRMC,100000.00,A,4808.22925,N*4D\r\n"
    assert sampled(sentence, 9600, 9600) == sentence
    # Known by heart from a line set twice too fast: "U" is 0xE6 or 0x66 and the like.
    assert sentence not in sampled(sentence, 9600, 19_200)
    assert len(sampled(sentence, 9600, 19_200)) > len(sentence)
    assert len(sampled(sentence, 19_200, 9600)) < len(sentence)
    # 2 % of error is what a real line carries.
    assert sampled(sentence, 9600, 9600 + 190) == sentence


def test_every_device_is_found_with_its_protocol_and_its_speed() -> None:
    """All at once, each behind a line of its own speed; a wrong one gives what a UART gives."""
    progress: dict[str, list[str]] = {}
    with ExitStack() as stack:
        relays, devices = {}, {}
        for kind, (make, _, baudrate) in DEVICES.items():
            devices[kind] = make()
            stack.enter_context(running(devices[kind]))
            relays[kind] = stack.enter_context(UartRelay(devices[kind].port, baudrate))
        found = search(
            [relay.port for relay in relays.values()],
            on_progress=lambda port, sentence: progress.setdefault(port, []).append(sentence),
        )
        speeds = {kind: set(relay.speeds) for kind, relay in relays.items()}
    by_kind = dict(zip(relays, found, strict=True))
    for kind, (_, driver, baudrate) in DEVICES.items():
        one = by_kind[kind]
        assert one.detected is not None, (kind, one.sentence, progress[one.port])
        assert (one.detected.driver, one.baudrate) == (driver, baudrate)
        assert progress[one.port][0] == "listening at 115200"
    assert speeds["nmea"] >= {115_200, 9_600}, "data arrived at a wrong baud rate, too"
    sections = tomllib.loads(toml_sections(found))
    assert [s["name"] for s in sections["navigator"]] == [
        "gnss",
        "gnss2",
        "gnss3",
        "gnss4",
        "gnss5",
    ]
    for kind, written in sections.items():
        for section in written:
            own = {key: value for key, value in section.items() if key not in ("name", "driver")}
            assert registry.problems(kind, section["driver"], own) == []
    assert by_kind["modbus"].detected.settings["unit"] == 2
    assert by_kind["modbus"].detected.settings["register_kind"] == "input"
    assert by_kind["ascii"].detected.settings["channels"] == ["0", "1"]


def test_what_came_while_the_host_stood_still_is_read_before_a_speed_is_given_up() -> None:
    clock, reads = FakeClock(), iter(range(100))
    sentence = b"$GNRMC,100000.00,A,4808.22925,N,01134.12345,E,0.0,0.0,290726,,,A*"
    sentence += b"%02X\r\n" % functools.reduce(operator.xor, sentence[1:-1])

    def answer(port: FakePort) -> bytes:
        if next(reads) == 0:
            port.clock.now_ns += 5_000_000_000
            return b""
        return 3 * sentence

    (found,) = search(
        ["/dev/ttyS0"], ask=False, baudrates=[9600], clock=clock,
        open_port=lambda *_: FakePort(clock, answer),
    )  # fmt: skip
    assert found.detected is not None and found.detected.driver == "nmea", found.sentence


def test_devices_on_the_network_are_found_without_a_speed() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        free = probe.getsockname()
    receiver = SeptentrioReceiver(_clock(), state_at, line=TcpLine())
    autopilot = MavlinkAutopilot(_clock(), state_at, line=UdpLine(free))
    with socket.create_server(("127.0.0.1", 0)) as mute, running(receiver, autopilot):
        silent = f"tcp://127.0.0.1:{mute.getsockname()[1]}"
        found = search([receiver.port, autopilot.port, silent, "tcp://127.0.0.1:9"])
    assert [one.detected and one.detected.driver for one in found] == [
        "septentrio",
        "mavlink",
        None,
        None,
    ]
    assert [one.baudrate for one in found] == [None] * 4
    assert "no data received" in found[2].sentence
    assert "cannot be opened" in found[3].sentence
    section = tomllib.loads(toml_sections(found))["navigator"][0]
    assert "baudrate" not in section


def test_the_command_prints_what_to_paste_and_reports_whether_anything_was_found() -> None:
    receiver = UbloxReceiver(_clock(), state_at)
    with running(receiver):
        done = syntopic("check", "--find", receiver.port, "/dev/no-such-port", "--json")
        shown = CliRunner().invoke(app, ["check", "--find", receiver.port])
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert [port["found"] for port in report["ports"]] == [True, False]
    assert report["ports"][0]["protocol"] == "UBX"
    assert "NAV-PVT" in report["ports"][0]["received"]
    assert tomllib.loads(report["toml"]) == {"navigator": [{
        "name": "gnss", "driver": "ublox", "port": receiver.port, "baudrate": 115_200,
        "parity": "N",
    }]}  # fmt: skip
    assert "Next: paste this" in shown.stdout
    assert 'driver = "ublox"' in shown.stdout
    nothing = CliRunner().invoke(app, ["check", "--find", "/dev/no-such-port"])
    assert nothing.exit_code == 1
    assert "check the cable" in " ".join(nothing.stdout.split())
    assert CliRunner().invoke(app, ["check"]).exit_code == 2


def test_listening_only_sends_nothing() -> None:
    master, slave = os.openpty()
    port = os.ttyname(slave)
    try:
        (found,) = search([port], ask=False)
        os.set_blocking(master, False)
        with pytest.raises(BlockingIOError):
            os.read(master, 1)
    finally:
        os.close(master)
        os.close(slave)
    assert found.detected is None
    assert "no data received; check power, cable and the port's name" in found.sentence


def test_a_port_that_is_not_there_is_reported_with_its_remedy() -> None:
    (found,) = search(["/dev/no-such-port"])
    assert found.sentence == (
        "cannot be opened: there is no such port; check the cable and the port's name"
    )


@pytest.mark.parametrize(("report", "pattern", "readings"), [
    (b"21.5 22.5\r\n21.6 -3.0\r\n21.7 1\r\n", r"^(?P<t0>\S+) (?P<t1>\S+)$", 2),
    (b"TEMP: 20.1 C\n" * 3, r"^TEMP:\s*(?P<t0>\S+) C$", 1),
    (b"A=1,B=OPEN\r" * 3, r"^A=(?P<t0>\S+),B=(?P<t1>\S+)$", 2),
    (b"CH1: 20.1\r\nCH2: 20.2\r\nCH3: 9\r\n", None, 1),
])  # fmt: skip
def test_a_pattern_is_proposed_where_lines_agree(
    report: bytes, pattern: str | None, readings: int
) -> None:
    found = line_format_of(report)
    assert found is not None
    assert (found.pattern, found.readings) == (pattern, readings)
    if pattern is not None:
        matched = LinePattern(pattern).search(found.example)
        assert matched is not None and len(matched) == readings


@pytest.mark.parametrize(
    "report", [b"", b"hello\r\nworld\r\n", b"$GNTXT,1*00\r\n" * 3, bytes(range(256)) * 4]
)
def test_what_is_no_reading_is_no_instrument(report: bytes) -> None:
    assert line_format_of(report) is None


@settings(max_examples=40, deadline=None)
@given(data=st.binary(max_size=3000))
def test_noise_is_nobody(data: bytes) -> None:
    evidence = ProtocolDetector()
    for at in range(0, len(data), 97):
        evidence.feed(data[at : at + 97], at)
    if not evidence.looks_like_text:
        assert evidence.detected() is None


@pytest.mark.peer
def test_a_gpsd_is_known_by_its_greeting() -> None:
    program = shutil.which("gpsd", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
    if program is None:
        pytest.skip("gpsd is absent; install Debian's gpsd")
    receiver = UbloxReceiver(_clock(), state_at)
    with socket.create_server(("127.0.0.1", 0)) as probe:
        number = probe.getsockname()[1]
    with running(receiver):
        Path(receiver.port).chmod(0o666)
        gpsd = subprocess.Popen([program, "-N", "-n", "-b", "-S", str(number), receiver.port],
                                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # fmt: skip
        try:
            (found,) = _until_open(f"tcp://127.0.0.1:{number}")
        finally:
            gpsd.terminate()
            gpsd.wait(timeout=10)
    assert found.detected is not None
    assert found.detected.driver == "gpsd"
    section: dict[str, Any] = tomllib.loads(toml_sections([found]))["navigator"][0]
    assert section["port"] == f"127.0.0.1:{number}"


def _until_open(address: str) -> list[DetectionResult]:
    deadline = time.monotonic() + 20
    while True:
        found = search([address])
        if found[0].detected is not None or time.monotonic() > deadline:
            return found

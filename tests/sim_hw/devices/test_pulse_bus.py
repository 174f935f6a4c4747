"""The emulated trigger unit against docs/reference/flight/pulse-bus.md."""

from __future__ import annotations

import queue
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sim_hw.devices.pulse_bus import Firing, PulseBus
from tests.support.stopwatch import Stopwatch

pytestmark = pytest.mark.realtime


TIMEOUT_S = 3.0


class Client:
    """One TCP connection to the unit, line by line."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._socket = socket.create_connection(address, timeout=TIMEOUT_S)
        self._reader = self._socket.makefile("rb")
        self.greeting = self.line()

    def line(self) -> str:
        """The next line of the unit's; "" where it has hung up."""
        return self._reader.readline().decode("ascii").removesuffix("\n")

    def send(self, data: bytes) -> None:
        self._socket.sendall(data)

    def ask(self, line: str) -> str:
        self.send(line.encode("ascii") + b"\n")
        return self.line()

    def close(self) -> None:
        self._reader.close()
        self._socket.close()


@dataclass
class Unit:
    bus: PulseBus
    firings: queue.Queue[Firing]

    def connect(self) -> Client:
        return Client(self.bus.address)

    def next_firing(self) -> Firing:
        return self.firings.get(timeout=TIMEOUT_S)


@pytest.fixture
def unit() -> Iterator[Unit]:
    firings: queue.Queue[Firing] = queue.Queue()
    bus = PulseBus("ultracam-x-mini", ("0", "1", "G"), firings.put)
    bus.start()
    yield Unit(bus, firings)
    bus.close()


def test_it_greets_with_version_name_and_outputs(unit: Unit) -> None:
    client = unit.connect()
    assert client.greeting == "PULSEBUS 1 ultracam-x-mini 0 1 G"
    client.close()


def test_a_firing_is_answered_at_once_and_gives_each_output_its_delay(unit: Unit) -> None:
    client = unit.connect()
    assert client.ask("DELAY 1 1000000000") == "OK DELAY 1 1000000000"
    assert client.ask("DELAY G 2500000") == "OK DELAY G 2500000"
    before_ns = time.monotonic_ns()
    assert client.ask("FIRE 18446744073709551615") == "FIRED 18446744073709551615 1"
    after_ns = time.monotonic_ns()
    assert after_ns - before_ns < 500_000_000
    firing = unit.next_firing()
    assert (firing.sequence, firing.count) == (2**64 - 1, 1)
    undelayed_ns = firing.pulses_mono_ns["0"]
    assert before_ns <= undelayed_ns <= after_ns
    assert firing.pulses_mono_ns == {
        "0": undelayed_ns,
        "1": undelayed_ns + 1_000_000_000,
        "G": undelayed_ns + 2_500_000,
    }
    client.close()


def test_the_count_is_the_units_own_and_outlives_a_connection(unit: Unit) -> None:
    first = unit.connect()
    assert first.ask("FIRE 7") == "FIRED 7 1"
    assert first.ask("FIRE 7") == "FIRED 7 2"
    first.close()
    second = unit.connect()
    assert second.ask("STATUS") == "STATUS 2"
    assert second.ask("FIRE 0") == "FIRED 0 3"
    second.close()


def test_a_second_connection_receives_the_name_of_the_owner_and_is_closed(unit: Unit) -> None:
    owner = unit.connect()
    host, port = owner._socket.getsockname()
    second = unit.connect()
    assert second.greeting == f"ERR busy: owned by {host}:{port}"
    assert second.line() == ""
    assert owner.ask("STATUS") == "STATUS 0"
    owner.close()
    second.close()


@pytest.mark.parametrize(
    "line",
    [
        "DELAY 0 -1",
        "DELAY 0 1000000001",
        "DELAY 0 1.5",
        "DELAY 9 5",
        "DELAY 0",
        "FIRE",
        "FIRE -1",
        "FIRE 18446744073709551616",
        "FIRE one",
        "FIRE  1",
        "fire 1",
        "",
        "STATUS 1",
    ],
)
def test_what_is_not_a_command_is_refused_and_nothing_is_done(unit: Unit, line: str) -> None:
    client = unit.connect()
    assert client.ask(line).startswith("ERR ")
    assert client.ask("STATUS") == "STATUS 0"
    client.close()


def test_commands_may_come_torn_and_glued(unit: Unit) -> None:
    client = unit.connect()
    client.send(b"STA")
    client.send(b"TUS\nFIRE 1\nFI")
    client.send(b"RE 2\n")
    assert [client.line() for _ in range(3)] == ["STATUS 0", "FIRED 1 1", "FIRED 2 2"]
    assert [unit.next_firing().sequence for _ in range(2)] == [1, 2]
    client.close()


def test_a_slow_world_does_not_delay_the_answer() -> None:
    def stall(_firing: Firing) -> None:
        time.sleep(0.3)

    bus = PulseBus("bus", ("0",), stall)
    bus.start()
    client = Client(bus.address)
    watch = Stopwatch()
    assert [client.ask(f"FIRE {n}") for n in range(3)] == ["FIRED 0 1", "FIRED 1 2", "FIRED 2 3"]
    assert watch.is_within(0.3)
    client.close()
    bus.close()


def test_a_closed_unit_has_hung_up(unit: Unit) -> None:
    client = unit.connect()
    unit.bus.close()
    assert client.line() == ""
    client.close()


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(rubbish=st.binary(max_size=600).filter(lambda data: b"FIRE" not in data))
def test_rubbish_is_answered_line_by_line_and_the_unit_goes_on(unit: Unit, rubbish: bytes) -> None:
    client = unit.connect()
    client.send(rubbish + b"\nFIRE 99\n")
    while not (answer := client.line()).startswith("FIRED 99 "):
        assert answer.startswith(("ERR ", "STATUS "))
    client.close()

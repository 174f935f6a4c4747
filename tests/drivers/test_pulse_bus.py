"""The pulse bus client against units that follow docs/reference/flight/pulse-bus.md, or do not."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from drivers.contract import DeviceError
from drivers.triggers.pulse_bus import PulseBusTrigger
from tests.support.stopwatch import Stopwatch

pytestmark = pytest.mark.realtime


Answer = Callable[[str], str | None]


class Unit:
    """A trigger unit on a loopback port; `answer` may be replaced, None is silence."""

    def __init__(self, port: int = 0) -> None:
        self.count = 0
        self.received_lines: list[str] = []
        self.answer: Answer = self.by_the_book
        self.greeting = "PULSEBUS 1 sim 0 1 G"
        self._server = socket.create_server(("127.88.40.1", port))
        self.port: int = self._server.getsockname()[1]
        self._peers: list[socket.socket] = []
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def by_the_book(self, line: str) -> str | None:
        match line.split():
            case ["DELAY", output, delay]:
                return f"OK DELAY {output} {delay}"
            case ["FIRE", sequence]:
                self.count += 1
                return f"FIRED {sequence} {self.count}"
            case ["STATUS"]:
                return f"STATUS {self.count}"
        return "ERR no such command"

    def hang_up(self) -> None:
        # A client that is quick to come again is another one.
        peers, self._peers = self._peers, []
        for peer in peers:
            with contextlib.suppress(OSError):
                peer.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        self.hang_up()
        self._thread.join(5)

    def _accept(self) -> None:
        while True:
            try:
                peer, _ = self._server.accept()
            except OSError:
                return
            self._peers.append(peer)
            threading.Thread(target=self._talk, args=(peer,), daemon=True).start()

    def _talk(self, peer: socket.socket) -> None:
        # A client that has gone away is part of these tests.
        with contextlib.suppress(OSError), peer:
            peer.sendall(self.greeting.encode("ascii") + b"\n")
            for line in peer.makefile("r", encoding="ascii", newline="\n"):
                self.received_lines.append(line.strip())
                answer = self.answer(line.strip())
                if answer is not None:
                    peer.sendall(answer.encode("ascii") + b"\n")


@pytest.fixture
def unit() -> Iterator[Unit]:
    unit = Unit()
    yield unit
    unit.close()


@pytest.fixture
def trigger(unit: Unit) -> Iterator[PulseBusTrigger]:
    trigger = PulseBusTrigger("bus", {"host": "127.88.40.1", "port": unit.port, "timeout_s": 0.2})
    yield trigger
    trigger.close()


def test_binding_reports_name_outputs_and_count(trigger: PulseBusTrigger) -> None:
    found = trigger.bind()
    assert (found["unit"], found["outputs"], found["count"]) == ("sim", "0 1 G", "0")


def test_a_pulse_has_the_host_time_of_its_round_trip(trigger: PulseBusTrigger) -> None:
    trigger.bind()
    watch = Stopwatch()
    before_ns = time.monotonic_ns()
    pulse = trigger.fire(18_446_744_073_709_551_615)
    after_ns = time.monotonic_ns()
    assert pulse.sequence == 18_446_744_073_709_551_615
    assert pulse.count == 1
    assert before_ns <= pulse.mono_ns - pulse.sigma_ns
    assert pulse.mono_ns + pulse.sigma_ns <= after_ns + 1
    assert 0 < pulse.sigma_ns < 50_000_000 + watch.withheld_s * 1e9


def test_delays_are_sent_for_every_output(trigger: PulseBusTrigger, unit: Unit) -> None:
    trigger.program({"0": 1_000_000, "1": 0, "G": 2_345_678})
    assert unit.received_lines == ["DELAY 0 1000000", "DELAY 1 0", "DELAY G 2345678"]


def test_outputs_and_delays_that_cannot_be_are_refused_together(trigger: PulseBusTrigger) -> None:
    with pytest.raises(DeviceError) as caught:
        trigger.program({"7": 0, "0": -1, "1": 1_000_000_001})
    assert str(caught.value).splitlines() == [
        "bus: output '7' does not exist; the trigger has 0, 1, G",
        "bus: delay of output '0' is -1 ns; 0 to 1000000000",
        "bus: delay of output '1' is 1000000001 ns; 0 to 1000000000",
    ]


def test_after_a_broken_connection_the_delays_are_programmed_again(
    trigger: PulseBusTrigger, unit: Unit
) -> None:
    trigger.program({"0": 5})
    assert trigger.fire(1).count == 1
    unit.hang_up()
    unit.received_lines.clear()
    # The line was sent to nobody: the count is the same, and the pulse was not given.
    with pytest.raises(DeviceError, match="whether the heads fired is not known"):
        trigger.fire(2)
    pulse = trigger.fire(3)
    assert unit.received_lines == ["DELAY 0 5", "STATUS", "FIRE 3"]
    assert pulse.sequence == 3


def test_a_pulse_without_an_answer_is_not_given_twice(trigger: PulseBusTrigger, unit: Unit) -> None:
    trigger.bind()
    unit.received_lines.clear()
    unit.answer = lambda line: None
    with pytest.raises(DeviceError, match=r"no answer within 0\.2 s"):
        trigger.fire(4)
    unit.answer = unit.by_the_book
    assert trigger.fire(5).count == 1
    assert unit.received_lines == ["FIRE 4", "STATUS", "FIRE 5"]


@pytest.mark.parametrize("gives", ["silence", "hang-up"])
def test_a_pulse_whose_answer_is_lost_is_known_by_its_count(
    trigger: PulseBusTrigger, unit: Unit, gives: str
) -> None:
    def without_answer(line: str) -> str | None:
        answer_line = unit.by_the_book(line)
        if line != "FIRE 4":
            return answer_line
        if gives == "hang-up":
            unit.hang_up()
        return None

    trigger.bind()
    unit.answer = without_answer
    before_ns = time.monotonic_ns()
    pulse = trigger.fire(4)
    assert pulse.count == 1
    assert before_ns <= pulse.mono_ns - pulse.sigma_ns
    assert gives == "hang-up" or pulse.sigma_ns >= 100_000_000, "it may have been at any time"
    assert trigger.fire(5).count == 2
    assert trigger.statistics()["answers_lost"] == 1


def test_a_count_that_restarted_proves_no_pulse(trigger: PulseBusTrigger, unit: Unit) -> None:
    trigger.bind()
    trigger.fire(1)
    trigger.fire(2)

    def restarted(line: str) -> str | None:
        if line == "FIRE 3":
            unit.count = 0
            return None
        return unit.by_the_book(line)

    unit.answer = restarted
    with pytest.raises(DeviceError, match="whether the heads fired is not known"):
        trigger.fire(3)


def test_a_late_answer_is_not_taken_for_that_of_the_next_pulse(
    trigger: PulseBusTrigger, unit: Unit
) -> None:
    def late(line: str) -> str | None:
        if line == "FIRE 1":
            time.sleep(0.3)
        return unit.by_the_book(line)

    trigger.bind()
    unit.answer = late
    with contextlib.suppress(DeviceError):
        trigger.fire(1)
    assert trigger.fire(2).sequence == 2


def test_a_unit_that_another_program_owns_is_named(trigger: PulseBusTrigger, unit: Unit) -> None:
    unit.greeting = "ERR busy: owned by 127.0.0.1:5000"
    with pytest.raises(DeviceError, match=r"busy: owned by 127\.0\.0\.1:5000.*end the program"):
        trigger.bind()


@pytest.mark.parametrize("greeting", ["PULSEBUS 2 sim", "SSH-2.0-OpenSSH", "", "\x7f"])
def test_something_else_behind_the_port_is_refused(
    trigger: PulseBusTrigger, unit: Unit, greeting: str
) -> None:
    unit.greeting = greeting
    with pytest.raises(DeviceError, match="check host and port"):
        trigger.bind()


def test_a_refused_line_states_that_nothing_was_done(trigger: PulseBusTrigger, unit: Unit) -> None:
    trigger.bind()
    unit.answer = lambda line: "ERR charge pump empty"
    with pytest.raises(DeviceError, match="charge pump empty; nothing was done"):
        trigger.fire(1)


@pytest.mark.parametrize("nonsense", ["FIRED", "FIRED 1", "FIRED 1 x", "FIRED 2 1", "OK 1 2", ""])
def test_an_answer_without_sense_is_no_pulse(
    trigger: PulseBusTrigger, unit: Unit, nonsense: str
) -> None:
    trigger.bind()
    unit.answer = lambda line: nonsense
    with pytest.raises(DeviceError):
        trigger.fire(1)


def test_no_unit_at_all_is_reported_at_once() -> None:
    trigger = PulseBusTrigger("bus", {"host": "127.88.40.1", "port": 9})
    with pytest.raises(DeviceError, match="check its power, cable, host and port"):
        trigger.bind()


def test_an_answer_that_comes_twice_is_not_taken_for_that_of_the_next_pulse() -> None:
    unit = Unit()
    twice = unit.by_the_book
    unit.answer = lambda line: f"{(answer_line := twice(line))}\n{answer_line}"
    trigger = PulseBusTrigger("trigger", {"host": "127.88.40.1", "port": unit.port})
    try:
        trigger.program({"0": 5, "1": 7})
        assert [trigger.fire(sequence).count for sequence in (1, 2, 3)] == [1, 2, 3]
        assert trigger.statistics()["stale_answers"] >= 3
        assert trigger.statistics()["failures"] == 0
    finally:
        trigger.close()
        unit.close()

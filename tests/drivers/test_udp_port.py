"""A listening UDP port takes one sender: others are dropped, counted, reported, never followed."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from drivers.contract import DeviceError, NavSample
from drivers.receivers.mavlink.navigator import MavlinkNavigator
from drivers.transport import udp_port
from drivers.transport.udp_port import SenderFilter, open_udp_port
from tests.drivers.fakes import RecordingSink, running
from tests.drivers.test_mavlink import BOOT_MS, Bus, free_udp_port

pytestmark = pytest.mark.realtime


WITHIN_S = 30.0
S = 1_000_000_000
OURS, FOREIGN = 475_000_000, 100_000_000
"""Latitudes, 1e-7 degrees."""


class UdpAutopilot:
    """An autopilot at an address of the loopback network, from `start()` to `close()`."""

    def __init__(self, number: int, host: str, latitude: int = OURS, *, what: str = "autopilot"):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((host, 0))
        self._to = ("127.0.0.1", number)
        self._bus, self._latitude, self._what = Bus(), latitude, what
        self._boot_ms = BOOT_MS
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> UdpAutopilot:
        self._thread.start()
        return self

    def _run(self) -> None:
        while not self._stop.wait(0.01):
            self._boot_ms += 10
            for datagram in self._message():
                self.socket.sendto(datagram, self._to)

    def _message(self) -> list[bytes]:
        if self._what == "garbage":
            return [b"\xfd\xff\x00\x00", bytes(range(200))]
        if self._what == "ground station":
            return [self._bus.heartbeat(8)]
        unix_us = 1_793_527_200_000_000 + self._boot_ms * 1000
        bus, at_ms = self._bus, self._boot_ms
        return [
            bus.heartbeat() + bus.system_time(unix_us, at_ms),
            bus.gps() + bus.position(at_ms, latitude=self._latitude),
        ]

    def close(self) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(5)
        self.socket.close()


@contextmanager
def running_autopilots(*speakers: UdpAutopilot) -> Iterator[None]:
    try:
        for speaker in speakers:
            speaker.start()
        yield
    finally:
        for speaker in speakers:
            speaker.close()


class Watch(RecordingSink):
    """A sink that waits for what a test asks for."""

    def wait_for(self, what: str, is_so) -> None:
        deadline = time.monotonic() + WITHIN_S
        while not is_so():
            assert time.monotonic() < deadline, what
            time.sleep(0.01)

    @property
    def latitudes(self) -> list[float]:
        return [round(r.latitude_deg, 6) for r in self.records if isinstance(r, NavSample)]


def navigator(number: int, query: str = "", **settings: object) -> MavlinkNavigator:
    port = f"udpin://127.0.0.1:{number}{query}"
    return MavlinkNavigator("fc", {"port": port, "silence_s": 2.0, "request": False, **settings})


@pytest.mark.trust
@pytest.mark.parametrize("first", ["garbage", "ground station"])
def test_who_speaks_first_without_being_the_autopilot_does_not_become_the_sender(
    first: str,
) -> None:
    number = free_udp_port()
    device, sink = navigator(number), Watch()
    other = UdpAutopilot(number, "127.0.0.2", what=first)
    ours = UdpAutopilot(number, "127.0.0.1")
    with running_autopilots(other, ours):
        device.bind()
        with running(device, sink):
            sink.wait_for("samples", lambda: len(sink.latitudes) > 5)
            sink.wait_for("the fault", lambda: "other-sender" in sink.event_names)
    assert set(sink.latitudes) == {47.5}
    assert device._sender is not None and device._sender.address == "127.0.0.1"


@pytest.mark.trust
def test_another_autopilot_is_dropped_counted_and_reported_in_a_sentence() -> None:
    number = free_udp_port()
    device, sink = navigator(number), Watch()
    with running_autopilots(UdpAutopilot(number, "127.0.0.1")):
        device.bind()
        with running(device, sink), running_autopilots(UdpAutopilot(number, "127.0.0.2", FOREIGN)):
            sink.wait_for("the fault", lambda: "other-sender" in sink.event_names)
            at = len(sink.latitudes)
            sink.wait_for("more samples", lambda: len(sink.latitudes) > at + 10)
    (event,) = [e for e in sink.events if e.name == "other-sender"]
    assert event.is_fault
    assert "datagrams of other senders were dropped, the last from 127.0.0.2:" in event.sentence
    assert "only 127.0.0.1:" in event.sentence
    assert "add ?from=ADDRESS to its port" in event.sentence
    assert device.statistics()["other_senders"] > 0
    assert set(sink.latitudes) == {47.5}


@pytest.mark.trust
def test_a_silent_autopilot_is_not_replaced_by_another_and_comes_back_from_a_new_port(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(udp_port, "PORT_CHANGE_TIMEOUT_S", 0.3)
    number = free_udp_port()
    device, sink = navigator(number, silence_s=0.5), Watch()
    ours = UdpAutopilot(number, "127.0.0.1").start()
    device.bind()
    with running(device, sink), running_autopilots(UdpAutopilot(number, "127.0.0.2", FOREIGN)):
        sink.wait_for("samples", lambda: len(sink.latitudes) > 3)
        ours.close()
        opened = device.statistics()["opened"]
        sink.wait_for("two openings", lambda: device.statistics()["opened"] >= opened + 2)
        assert "silent" in sink.event_names
        at = len(sink.latitudes)
        with running_autopilots(UdpAutopilot(number, "127.0.0.1")):
            sink.wait_for("more samples", lambda: len(sink.latitudes) > at + 3)
    assert set(sink.latitudes) == {47.5}


@pytest.mark.trust
def test_the_configured_sender_is_taken_though_another_speaks_first() -> None:
    number = free_udp_port()
    device, sink = navigator(number, "?from=127.0.0.1"), Watch()
    with running_autopilots(UdpAutopilot(number, "127.0.0.2", FOREIGN)):
        with pytest.raises(DeviceError) as failed:
            device.bind()
        assert "nothing came at udpin://" in str(failed.value)
        assert "dropped, the last from 127.0.0.2:" in str(failed.value)
        assert "only 127.0.0.1 is accepted" in str(failed.value)
        assert "correct ?from= in its port" in str(failed.value)
        with running_autopilots(UdpAutopilot(number, "127.0.0.1")), running(device, sink):
            sink.wait_for("samples", lambda: len(sink.latitudes) > 5)
    assert set(sink.latitudes) == {47.5}


def test_a_sender_keeps_its_port_until_it_was_silent_and_its_address_for_ever() -> None:
    sender = SenderFilter()
    assert sender.accepts(("10.0.0.5", 1), 10 * S)
    assert sender.accepts(("10.0.0.6", 1), 10 * S), "nobody was understood yet"
    sender.lock()
    assert (sender.address, sender.port) == ("10.0.0.6", 1)
    assert not sender.accepts(("10.0.0.6", 2), 11 * S)
    assert not sender.accepts(("10.0.0.6", 2), 12 * S - 1)
    assert sender.accepts(("10.0.0.6", 2), 12 * S)
    assert not sender.accepts(("10.0.0.6", 1), 12 * S), "the port before is another one now"
    assert not sender.accepts(("10.0.0.5", 1), 999 * S)
    assert (sender.others, sender.last_other) == (4, "10.0.0.5:1")


def test_what_is_read_and_written_is_complete_datagrams_of_the_sender() -> None:
    number = free_udp_port()
    port = open_udp_port(f"udpin://127.0.0.1:{number}")
    port.timeout = 0.05
    assert port.read(1) == b""
    assert port.write(b"to nobody") == 0
    speaker = open_udp_port(f"udpout://127.0.0.1:{number}")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other_socket:
        speaker.timeout = port.timeout = 5.0
        assert speaker.write(b"hello") == 5
        assert port.read(1) + port.read(port.in_waiting) == b"hello"
        assert port.sender is not None
        port.sender.lock()
        other_socket.sendto(b"and me", ("127.0.0.1", number))
        assert speaker.write(b"again") == 5
        assert port.read(5) == b"again", "an unknown sender's datagram delays no other one"
        assert port.write(b"welcome") == 7
        assert speaker.read(7) == b"welcome"
    with pytest.raises(DeviceError, match="no other program listens there"):
        open_udp_port(f"udpin://127.0.0.1:{number}")
    port.close()
    speaker.close()


@pytest.mark.parametrize(
    "address",
    ["?from=", "?from=autopilot", "?from=1.2.3.4&from=1.2.3.5", "?only=1.2.3.4", "?from=::1"],
)
def test_a_sender_that_is_no_address_is_refused_with_the_cure(address: str) -> None:
    with pytest.raises(DeviceError, match=r"write udpin://host:port\?from=10.0.0.5"):
        open_udp_port(f"udpin://127.0.0.1:14550{address}")
    with pytest.raises(DeviceError, match="udpin://host:port"):
        open_udp_port("udpin://nowhere")

"""The loop of emulated devices: on every kind of line, and with something in between."""

from __future__ import annotations

import os
import select
import socket
import time
import tty

import pytest

from sim_hw.devices.device_loop import LineDevice
from sim_hw.devices.network_line import TcpLine, UdpLine
from sim_hw.devices.pseudo_terminal import PseudoTerminal

pytestmark = pytest.mark.realtime


WITHIN_S = 10.0


class TickDevice(LineDevice):
    """Sends "tick" every 20 ms and answers everything in capitals."""

    next_ns = 0

    def due_mono_ns(self) -> int:
        return self.next_ns

    def emit_due(self) -> bytes:
        self.next_ns = time.monotonic_ns() + 20_000_000
        return b"tick\n"

    def on_received(self, data: bytes) -> bytes:
        return data.upper()


def read_until(connection: socket.socket, wanted: bytes) -> bytes:
    connection.settimeout(WITHIN_S)
    received = b""
    while wanted not in received:
        received += connection.recv(65_536)
    return received


def test_two_hosts_over_tcp_receive_the_same_and_may_leave() -> None:
    line = TcpLine()
    device = TickDevice("clockwork", line)
    device.start()
    host, port = line.port.removeprefix("tcp://").split(":")
    try:
        with socket.create_connection((host, int(port)), WITHIN_S) as first:
            with socket.create_connection((host, int(port)), WITHIN_S) as second:
                read_until(second, b"tick")
                second.sendall(b"hello\n")
                assert b"HELLO" in read_until(second, b"HELLO")
                assert b"HELLO" in read_until(first, b"HELLO")
            read_until(first, b"tick\ntick\ntick")
        deadline = time.monotonic() + WITHIN_S
        while line.is_open_by_a_host and time.monotonic() < deadline:
            time.sleep(0.02)
        assert not line.is_open_by_a_host
        assert device.statistics()["bytes_received"] == 6
    finally:
        device.close()


def test_over_udp_it_sends_to_its_destination_and_then_to_whoever_answers() -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        station.bind(("127.0.0.1", 0))
        device = TickDevice("clockwork", UdpLine(station.getsockname()))
        device.start()
        try:
            station.settimeout(WITHIN_S)
            data, sender = station.recvfrom(100)
            assert data == b"tick\n"
            assert device.port == "udpin://{}:{}".format(*station.getsockname())
            other.sendto(b"me too", sender)
            assert b"ME TOO" in read_until(other, b"ME TOO")
        finally:
            device.close()


@pytest.mark.parametrize("kept_ms", [0, 60])
def test_what_stands_on_the_wire_may_change_drop_and_delay_bytes(kept_ms: int) -> None:
    device = TickDevice("clockwork", PseudoTerminal())
    delayed: list[tuple[int, bytes]] = []

    def byte_filter(data: bytes, mono_ns: int) -> bytes:
        delayed.append((mono_ns, data.replace(b"tick", b"tock")))
        ripe = [piece for at, piece in delayed if mono_ns - at >= kept_ms * 1_000_000]
        delayed[:] = [(at, piece) for at, piece in delayed if mono_ns - at < kept_ms * 1_000_000]
        return b"".join(ripe)

    device.byte_filter = byte_filter
    fd = os.open(device.port, os.O_RDWR | os.O_NOCTTY)
    tty.setraw(fd)
    device.start()
    try:
        received = b""
        deadline = time.monotonic() + WITHIN_S
        while received.count(b"tock\n") < 5 and time.monotonic() < deadline:
            if select.select([fd], [], [], 1.0)[0]:
                received += os.read(fd, 4096)
        assert received.count(b"tock\n") >= 5
        assert b"tick" not in received
    finally:
        device.close()
        os.close(fd)


def test_a_device_that_nobody_listens_to_loses_its_output_and_ends_on_request() -> None:
    device = TickDevice("clockwork", PseudoTerminal())
    device.start()
    deadline = time.monotonic() + WITHIN_S
    while device.statistics()["bytes_lost"] < 50 and time.monotonic() < deadline:
        time.sleep(0.02)
    device.close()
    device.close()
    assert device.statistics()["bytes_lost"] >= 50
    assert device.statistics()["bytes_sent"] == 0

"""A device behind TCP is the same device: it is lost, found again and closed as on a cable."""

from __future__ import annotations

import socket
import threading
from pathlib import Path

import pytest

from drivers.contract import DeviceError, DeviceEvent, NavSample
from drivers.receivers.ublox.decoder import UbxDecoder
from drivers.receivers.ublox.navigator import UbloxNavigator
from drivers.transport.serial_device import open_serial_port
from drivers.transport.tcp_port import TcpPort
from tests.drivers.fakes import RecordingSink

RECORDED = (Path(__file__).parent / "data" / "ublox-neo-m8l-excerpt.ubx").read_bytes()


def test_a_receiver_behind_tcp_gives_what_it_gives_on_a_cable_and_is_found_again() -> None:
    expected = [r.gps_ns for r in UbxDecoder("m8l").feed(RECORDED, 0) if isinstance(r, NavSample)]
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(10)
        navigator = UbloxNavigator("m8l", {"port": f"tcp://127.0.0.1:{server.getsockname()[1]}"})
        recorder = RecordingSink()
        enough = threading.Event()

        def watch(_: object) -> None:
            if sum(isinstance(r, NavSample) for r in recorder.records) >= 2 * len(expected):
                enough.set()

        recorder.stop = watch
        thread = threading.Thread(target=navigator.run, args=(recorder,))
        thread.start()
        connections: list[socket.socket] = []
        for _ in range(2):
            connection, _address = server.accept()
            connection.sendall(RECORDED)
            if not connections:
                connection.close()  # the cable is pulled
            connections.append(connection)
        assert enough.wait(10)
        navigator.close()
        thread.join(5)
        assert not thread.is_alive()
        connections[1].close()
    assert [r.gps_ns for r in recorder.records if isinstance(r, NavSample)] == 2 * expected
    names = [r.name for r in recorder.records if isinstance(r, DeviceEvent)]
    assert [name for name in names if name in ("opened", "lost")] == ["opened", "lost", "opened"]


def test_silence_on_tcp_is_waited_for_and_gives_nothing() -> None:
    near, far = socket.socketpair()
    with far:
        port = TcpPort(near)
        assert port.read(1) == b""
        far.sendall(b"abc")
        port.timeout = 1.0
        assert (port.read(1), port.in_waiting, port.read(2)) == (b"a", 2, b"bc")
        assert port.write(b"xy") == 2
        assert far.recv(2) == b"xy"
        port.close()
        port.close()


def test_nobody_at_an_address_is_reported_with_the_remedy() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        number = server.getsockname()[1]
    with pytest.raises(DeviceError, match="check that the device is on the network"):
        open_serial_port(f"tcp://127.0.0.1:{number}", 9600, "N")
    for wrong in ("tcp://", "tcp://host", "tcp://host:0", "tcp://host:99999", "tcp://host:x"):
        with pytest.raises(DeviceError, match="write tcp://host:port"):
            open_serial_port(wrong, 9600, "N")

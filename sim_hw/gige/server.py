"""The UDP sockets of a head's control channel and the thread that answers on them."""

from __future__ import annotations

import ipaddress
import selectors
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable

from sim_hw.gige.control import ControlChannel
from sim_hw.gige.gvcp import ALLOW_BROADCAST_ACK, PORT

BROADCAST_ADDRESS = "255.255.255.255"

_HEARTBEAT_CHECK_S = 0.25
_RECEIVE_BYTES = 2048


class ControlServer:
    """Serves one control channel on (address, 3956), and discovery by broadcast.

    Without an `interface` broadcasts are answered on the loopback alone. With one, the head answers
    on that interface as a device on a network does, also to askers in another subnet.
    """

    def __init__(
        self,
        address: str,
        channel: ControlChannel,
        is_listening: Callable[[], bool] = lambda: True,
        interface: str = "",
        network: Callable[[], ipaddress.IPv4Network] | None = None,
    ) -> None:
        self._interface = interface
        self._network = network
        self._selector: selectors.BaseSelector | None = None
        self._is_listening = is_listening
        self._address = address
        self._channel = channel
        self._sockets: list[socket.socket] = []
        self._wake: tuple[socket.socket, socket.socket] | None = None
        self._thread: threading.Thread | None = None
        self._ignore_until_ns = 0
        self.counts: Counter[str] = Counter()

    def start(self) -> None:
        """Bind and answer.

        Raises:
            OSError: the address is not this host's, or it is in use.
        """
        try:
            self._bind()
        except OSError as error:
            self._close_sockets()
            raise OSError(
                error.errno,
                f"{self._address}:{PORT} cannot be used ({error.strerror}); stop the other head"
                " there or choose another address",
            ) from error
        self._wake = socket.socketpair()
        self._thread = threading.Thread(
            target=self._serve, name=f"gvcp-{self._address}", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        if self._wake is not None:
            self._wake[1].send(b"\0")
            if self._thread is not None:
                self._thread.join(timeout=5.0)
            for end in self._wake:
                end.close()
            self._wake = None
        self._close_sockets()

    def ignore_until(self, until_mono_ns: int) -> None:
        """Ignore all input until then, as a device that restarts."""
        self._ignore_until_ns = until_mono_ns

    def _bind(self) -> None:
        self._sockets.append(self._control_socket(self._address))
        if self._interface or ipaddress.IPv4Address(self._address).is_loopback:
            discovery = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._sockets.append(discovery)
            self._bind_to_interface(discovery)
            discovery.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            discovery.bind((BROADCAST_ADDRESS, PORT))
        for opened in self._sockets:
            opened.setblocking(False)

    def move_to(self, address: str) -> None:
        """Answer at another address from now on; called by the thread that serves."""
        moved = self._control_socket(address)
        moved.setblocking(False)
        old, self._sockets[0], self._address = self._sockets[0], moved, address
        if self._selector is not None:
            self._selector.unregister(old)
            self._selector.register(moved, selectors.EVENT_READ)
        old.close()

    def _control_socket(self, address: str) -> socket.socket:
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._bind_to_interface(opened)
            opened.bind((address, PORT))
        except OSError:
            opened.close()
            raise
        return opened

    def _bind_to_interface(self, opened: socket.socket) -> None:
        if self._interface:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            opened.setsockopt(
                socket.SOL_SOCKET, socket.SO_BINDTODEVICE, self._interface.encode("ascii")
            )

    def _close_sockets(self) -> None:
        for opened in self._sockets:
            opened.close()
        self._sockets.clear()

    def _serve(self) -> None:
        assert self._wake is not None
        woken = self._wake[0]
        with selectors.DefaultSelector() as selector:
            self._selector = selector
            for readable in (*self._sockets, woken):
                selector.register(readable, selectors.EVENT_READ)
            while True:
                ready = [key.fileobj for key, _ in selector.select(_HEARTBEAT_CHECK_S)]
                if woken in ready:
                    return
                for readable in list(self._sockets):
                    if readable in ready:
                        self._receive(readable)
                self._is_listening()
                self._channel.expire(time.monotonic_ns())

    def _receive(self, readable: socket.socket) -> None:
        try:
            packet, peer = readable.recvfrom(_RECEIVE_BYTES)
        except OSError:
            self.counts["receive_errors"] += 1
            return
        now_ns = time.monotonic_ns()
        # An emulated head answers a broadcast from outside this machine on its interface alone.
        is_foreign = (
            not self._interface
            and readable is not self._sockets[0]
            and not ipaddress.IPv4Address(peer[0]).is_loopback
        )
        if now_ns < self._ignore_until_ns or is_foreign or not self._is_listening():
            return
        answer = self._channel.answer(packet, (peer[0], peer[1]), now_ns)
        if answer is None:
            return
        try:
            self._sockets[0].sendto(answer, self._destination(packet, peer))
        except OSError:
            self.counts["send_errors"] += 1

    def _destination(self, packet: bytes, peer: tuple[str, int]) -> tuple[str, int]:
        """Where an answer goes: to the asker, or to all where it allows that from another
        subnet."""
        if self._network is None or not self._interface or not packet[1] & ALLOW_BROADCAST_ACK:
            return peer
        is_near = ipaddress.IPv4Address(peer[0]) in self._network()
        return peer if is_near else (BROADCAST_ADDRESS, peer[1])

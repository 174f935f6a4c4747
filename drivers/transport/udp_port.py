"""Datagrams that read and write like a serial port.

For autopilots and receivers that send over UDP, by the form of `port`: "udpin://host:port" listens
there, "udpin://host:port?from=ADDRESS" accepts only that sender, and "udpout://host:port" sends to
that address.
"""

from __future__ import annotations

import ipaddress
import socket
import time
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final
from urllib.parse import parse_qs, urlsplit

from drivers.contract import DeviceError
from drivers.transport.tcp_port import host_and_number

LISTEN_SCHEME: Final = "udpin://"
SEND_SCHEME: Final = "udpout://"
DATAGRAM_NBYTES: Final = 65_536
PORT_CHANGE_TIMEOUT_S: Final = 2.0
"""After that silence, the sender may use another port, since it may have been restarted."""

Address = tuple[str, int]

listening: Final[weakref.WeakSet[socket.socket]] = weakref.WeakSet()
"""The listening sockets of this process, entered before they are bound."""


@dataclass
class SenderFilter:
    """The sender that a listening port accepts; it outlives the port, which may be reopened.

    `address` is the configured one, or that of the first sender of a valid message. Until it is
    known, datagrams of all senders are accepted. Afterwards no other address is accepted, however
    long the sender is silent. Only its port may change, `PORT_CHANGE_TIMEOUT_S` after its last
    datagram.
    """

    address: str | None = None
    port: int | None = None
    is_configured: bool = False
    others: int = 0
    """Number of dropped datagrams of other senders."""
    last_other: str = ""
    _last: Address | None = None
    _last_ns: int = 0

    @property
    def last(self) -> Address | None:
        """The source of the latest accepted datagram, to which answers are sent."""
        return self._last

    def accepts(self, source: Address, mono_ns: int) -> bool:
        """Whether a datagram is accepted; a rejected one is counted.

        Args:
            source: address and port of its sender.
            mono_ns: its arrival on CLOCK_MONOTONIC, ns.

        Returns:
            True if it is of the accepted sender, or of any while none is known.
        """
        is_restarted = mono_ns - self._last_ns >= PORT_CHANGE_TIMEOUT_S * 1e9
        is_same_port = self.port in (None, source[1]) or is_restarted
        if self.address not in (None, source[0]) or not is_same_port:
            self.others += 1
            self.last_other = f"{source[0]}:{source[1]}"
            return False
        if self.port is not None:
            self.port = source[1]
        self._last, self._last_ns = source, mono_ns
        return True

    def lock(self) -> None:
        """The latest datagram was valid: from now on, accept only its sender."""
        if self._last is not None and self.port is None:
            self.address, self.port = self._last

    def sentence(self) -> str:
        """The number of dropped datagrams of other senders, and the remedy.

        Returns:
            The sentence, without a full stop.
        """
        hint = (
            "correct ?from= in its port" if self.is_configured else "add ?from=ADDRESS to its port"
        )
        port = "" if self.port is None else f":{self.port}"
        return (
            f"{self.others} datagrams of other senders were dropped, the last from "
            f"{self.last_other}; only {self.address}{port} is accepted. End the other sender, or "
            f"{hint}"
        )


class UdpPort:
    """One UDP socket; a port of `drivers.transport.serial_device.SerialLine`.

    `sender` selects the accepted sender of a listening port, so that two senders cannot corrupt
    each other's messages. It is None for a connected port, where the kernel drops other senders.
    """

    def __init__(
        self,
        udp: socket.socket,
        sender: SenderFilter | None,
        *,
        mono_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._socket = udp
        self.sender = sender
        self._mono_ns = mono_ns
        self._buffer = b""
        self.timeout: float = 0.0

    @property
    def in_waiting(self) -> int:
        """Bytes that `read` has without waiting."""
        return len(self._buffer)

    def read(self, size: int = 1) -> bytes:
        """Read received bytes.

        Args:
            size: largest number of bytes; the rest of a datagram is returned by the next call.

        Returns:
            At most `size` bytes; empty if none is received within `timeout` seconds.

        Raises:
            OSError: the other end refused an earlier datagram (ICMP port unreachable).
        """
        if not self._buffer:
            self._buffer = self._datagram()
        data, self._buffer = self._buffer[:size], self._buffer[size:]
        return data

    def _datagram(self) -> bytes:
        """The next accepted datagram; empty if none is received in time."""
        until_s = time.monotonic() + self.timeout
        while True:
            self._socket.settimeout(max(until_s - time.monotonic(), 1e-3))
            try:
                data, source = self._socket.recvfrom(DATAGRAM_NBYTES)
            except TimeoutError:
                return b""
            if self.sender is None or self.sender.accepts((source[0], source[1]), self._mono_ns()):
                return data
            if time.monotonic() >= until_s:
                return b""

    def write(self, data: bytes, /) -> int:
        """Send one datagram, on a listening port to the latest accepted sender.

        Args:
            data: bytes of the datagram.

        Returns:
            Number of bytes sent; 0 on a listening port that has received nothing yet.

        Raises:
            OSError: it could not be sent.
        """
        if self.sender is None:
            return self._socket.send(data)
        return self._socket.sendto(data, self.sender.last) if self.sender.last else 0

    def close(self) -> None:
        """Release the socket."""
        self._socket.close()


def open_udp_port(address: str) -> UdpPort:
    """Open a UDP socket by the form of its address.

    Args:
        address: "udpin://host:port", "udpin://host:port?from=ADDRESS" or "udpout://host:port".

    Returns:
        The socket as a port.

    Raises:
        DeviceError: the address is wrong or in use; the message contains the remedy.
    """
    place = host_and_number(address)
    if place is None:
        raise DeviceError(
            f"port {address} is no address; write udpin://host:port, such as udpin://0.0.0.0:14550"
        )
    is_listening = address.startswith(LISTEN_SCHEME)
    only_from = _only_from(address) if is_listening else None
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        if is_listening:
            listening.add(udp)
            udp.bind(place)
            return UdpPort(udp, SenderFilter(only_from, is_configured=only_from is not None))
        udp.connect(place)
        return UdpPort(udp, None)
    except (OSError, UnicodeError) as error:
        udp.close()
        raise DeviceError(
            f"port {address} cannot be opened: {error or type(error).__name__}; check the address, "
            "and that no other program listens there"
        ) from error


def _only_from(address: str) -> str | None:
    """The sender in "?from=".

    Raises:
        DeviceError: it is no IPv4 address, or there is another key.
    """
    query = urlsplit(address).query
    if not query:
        return None
    given = parse_qs(query, keep_blank_values=True)
    try:
        if set(given) != {"from"} or len(given["from"]) != 1:
            raise ValueError(f"{query!r} is not from=ADDRESS")
        return str(ipaddress.IPv4Address(given["from"][0]))
    except ValueError as error:
        raise DeviceError(
            f"port {address}: {error}; write udpin://host:port?from=10.0.0.5 with the sender's "
            "IPv4 address"
        ) from error

"""Only the head's own datagrams reach Aravis; those of other senders are dropped and counted.

This module makes the kernel filter Aravis' own sockets. A forged address of the head is not
detected.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Final

from drivers.contract import DeviceError
from drivers.transport import udp_port

SO_ATTACH_FILTER: Final = 26
SO_MEMINFO: Final = 55
MEMINFO_NBYTES: Final = 36
MEMINFO_DROPS: Final = 8
SCAN_INTERVAL_S: Final = 0.0005
TEST_PACKET_TIMEOUT_S: Final = 0.1
DRAIN_BATCH: Final = 256
QUEUED_MAX: Final = 100_000
"""Larger than the number of datagrams in any receive buffer."""

LOAD_WORD: Final = 0x20
LOAD_HALF: Final = 0x28
LOAD_BYTE: Final = 0x30
JUMP_EQUAL: Final = 0x15
JUMP_BITS: Final = 0x45
RETURN: Final = 0x06
ACCEPT_ALL: Final = 0xFFFF_FFFF
IP_HEADER: Final = 0xFFF0_0000
"""SKF_NET_OFF: offsets from here on are relative to the network header."""

Condition = tuple[int, int, int, int]
"""Load, offset, jump and value."""


def interface_towards(address: str) -> str:
    """The address of this computer from which the kernel reaches a head.

    Args:
        address: IPv4 address of the head.

    Returns:
        IPv4 address of the interface.

    Raises:
        OSError: there is no route.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect((address, 1))
        return str(probe.getsockname()[0])


class SocketCapture:
    """Captures every UDP socket that Aravis binds to the interface in the meantime.

    Aravis creates and uses a socket within one call, so a thread scans for it. The caller holds
    `drivers.cameras.aravis.library.OPENING`.
    """

    def __init__(self, interface: str, address: str) -> None:
        self._interface, self._address = interface, address
        self._known = {inode for _, inode in _sockets()}
        self._found: list[socket.socket] = []
        self._scan_lock = threading.Lock()
        self._stop_scanning = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="aravis-sockets", daemon=True)

    def __enter__(self) -> SocketCapture:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stop_scanning.set()
        self._thread.join()
        for found in self._found:
            found.close()

    def take(self) -> socket.socket:
        """The first captured socket.

        Returns:
            A duplicate of it; the caller closes it.

        Raises:
            DeviceError: there is none.
        """
        self._scan()
        with self._scan_lock:
            if not self._found:
                raise DeviceError(
                    f"the control socket of the head at {self._address} was not found; check that "
                    "/proc is mounted"
                )
            return self._found.pop(0)

    def _watch(self) -> None:
        while not self._stop_scanning.wait(SCAN_INTERVAL_S):
            self._scan()

    def _scan(self) -> None:
        with self._scan_lock:
            ours = {udp.fileno() for udp in list(udp_port.listening)}
            for descriptor, inode in _sockets():
                if inode in self._known or descriptor in ours:
                    continue
                found = _duplicate_socket(descriptor, self._is_aravis)
                if found is not None:
                    self._known.add(inode)
                    filter_by_source(found, self._address)
                    self._found.append(found)

    def _is_aravis(self, candidate: socket.socket) -> bool:
        """Whether the socket is bound to the interface and not connected."""
        if (candidate.family, candidate.type) != (socket.AF_INET, socket.SOCK_DGRAM):
            return False
        host, port = candidate.getsockname()
        if host != self._interface or port == 0:
            return False
        try:
            candidate.getpeername()
        except OSError:
            return True
        return False


class ControlSocketFilter:
    """Filters the control socket of an opened head: only its GVCP port is accepted.

    The socket is filtered, not connected.
    """

    def __init__(self, control: socket.socket, address: str, port: int) -> None:
        # Quirk: a connected UDP socket fails on ICMP errors, which any host can forge.
        # Upstream: manual: Linux, net/ipv4/udp.c, __udp4_lib_err.
        self._control = control
        filter_by_source(control, address, port)

    def dropped_datagrams(self) -> int:
        """Datagrams of other senders that were dropped.

        Returns:
            Their number since the filter was attached.
        """
        return _drops(self._control)

    def close(self) -> None:
        """Close this descriptor of the socket; the filter stays attached."""
        self._control.close()


class StreamSocketFilter:
    """The stream socket, connected to the head, and a second socket at the same address.

    The kernel delivers the head's datagrams to the connected socket and all others to the second
    socket, which counts them. Create it while Aravis does not read.

    Args:
        port: of the stream's socket.
        address: of the head.
        source_port: the port in the head's register; 0 if it is empty.
        fire_test_packet: makes the head send one datagram; its port overrides the register.

    If both are missing, the first source port of the head is used.

    Raises:
        DeviceError: the socket does not exist or the kernel refuses.
    """

    def __init__(
        self, port: int, address: str, source_port: int, fire_test_packet: Callable[[], None]
    ) -> None:
        self._address, self.source_port = address, source_port
        self._is_certain = False
        self._received = 0
        self.last_other = ""
        try:
            self._stream = socket_at(port)
            self._stream.connect((address, 0))
            self._discard_queued()
            fire_test_packet()
            self._await_test_packet()
            self._stream.connect((address, self.source_port))
            self._others = _second_socket(self._stream)
        except OSError as error:
            raise DeviceError(
                f"the stream of the head at {address} cannot be filtered by its address ({error}); "
                f"check that no other program uses UDP port {port}"
            ) from error
        self._discard_queued()

    @property
    def source(self) -> str:
        """The accepted sender."""
        return f"{self._address}:{self.source_port}" if self.source_port else self._address

    def set_receive_buffer(self, nbytes: int) -> None:
        """Set the receive buffer of the stream's socket.

        Args:
            nbytes: requested bytes; the kernel limits them to net.core.rmem_max.
        """
        self._stream.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, nbytes)

    def poll(self, received_packets: int) -> int:
        """Count datagrams of other senders, and lock the head's port once it is known.

        Args:
            received_packets: number of packets that Aravis has received from the head.

        Returns:
            Number of datagrams of other senders since creation.
        """
        self._is_certain |= self.source_port != 0 and received_packets > 0
        if not self._is_certain:
            self._lock_to_queued_datagram()
        for _ in range(DRAIN_BATCH):
            try:
                _, (host, port) = self._others.recvfrom(1)
            except OSError:
                break
            if host == self._address and not self._is_certain:
                self._lock_source_port(port)
                continue
            self._received += 1
            self.last_other = f"{host}:{port}"
        return self._received + _drops(self._others)

    def kernel_drops(self) -> int:
        """Datagrams of the head that found the stream's buffer full.

        Returns:
            Their number, as the kernel counts it.
        """
        return _drops(self._stream)

    def close(self) -> None:
        """Close both descriptors; the stream's socket stays connected."""
        self._others.close()
        self._stream.close()

    def _await_test_packet(self) -> None:
        if select.select([self._stream], [], [], TEST_PACKET_TIMEOUT_S)[0]:
            with contextlib.suppress(OSError):
                self.source_port = self._stream.recvfrom(1, socket.MSG_DONTWAIT)[1][1]

    def _lock_to_queued_datagram(self) -> None:
        """Lock the port of a datagram that Aravis has not read yet; it stays in the queue."""
        with contextlib.suppress(OSError):
            _, (_, port) = self._stream.recvfrom(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
            self._lock_source_port(port)

    def _lock_source_port(self, port: int) -> None:
        self._stream.connect((self._address, port))
        self.source_port, self._is_certain = port, True

    def _discard_queued(self) -> None:
        """Drop the datagrams from before the socket was connected."""
        for _ in range(QUEUED_MAX):
            try:
                self._stream.recv(1, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return
            except OSError:
                continue


def filter_by_source(udp: socket.socket, address: str, port: int | None = None) -> None:
    """Make the kernel drop datagrams of a UDP socket from other senders.

    Args:
        udp: the socket.
        address: IPv4 address of the accepted sender.
        port: its port; None for any.

    Raises:
        OSError: the kernel refuses the filter.
    """
    # Quirk: Aravis 0.8 accepts datagrams of any sender on its control and stream sockets.
    # Upstream: no report known (2026-11-23); src/arvgvdevice.c, src/arvgvstream.c.
    conditions = [(LOAD_WORD, IP_HEADER + 12, JUMP_EQUAL, _as_number(address))]
    if port is not None:
        conditions.append((LOAD_HALF, 0, JUMP_EQUAL, port))
    attach_filter(udp, conditions)


def filter_packet_sockets(known: set[str], source: tuple[str, int], to: tuple[str, int]) -> int:
    """Restrict new packet sockets of this process to the datagrams of one stream.

    Only unfragmented datagrams are accepted.

    Args:
        known: inodes of the sockets that are left alone.
        source: IPv4 address and port of the sender; port 0 for any.
        to: IPv4 address and port of the receiver.

    Returns:
        Number of sockets.
    """
    # Quirk: Aravis' own filter ignores the source port. It is replaced.
    # Upstream: AravisProject/aravis#697.
    program = [
        (LOAD_HALF, 12, JUMP_EQUAL, 0x0800),
        (LOAD_BYTE, 14, JUMP_EQUAL, 0x45),
        (LOAD_BYTE, 23, JUMP_EQUAL, socket.IPPROTO_UDP),
        (LOAD_HALF, 20, JUMP_BITS, 0x3FFF),
        (LOAD_WORD, 26, JUMP_EQUAL, _as_number(source[0])),
        (LOAD_WORD, 30, JUMP_EQUAL, _as_number(to[0])),
        (LOAD_HALF, 36, JUMP_EQUAL, to[1]),
    ]
    if source[1]:
        program.append((LOAD_HALF, 34, JUMP_EQUAL, source[1]))
    count = 0
    for descriptor, inode in _sockets():
        if inode in known:
            continue
        found = _duplicate_socket(descriptor, lambda s: s.family == socket.AF_PACKET)
        if found is not None:
            with found:
                attach_filter(found, program)
                count += 1
    return count


def socket_inodes() -> set[str]:
    """Inodes of all sockets of this process, to detect new ones later.

    Returns:
        Such as "socket:[12345]".
    """
    return {inode for _, inode in _sockets()}


def attach_filter(to: socket.socket, conditions: list[Condition]) -> None:
    """Filter a socket: every condition must hold.

    JUMP_EQUAL requires the value, JUMP_BITS that none of its bits is set.

    Args:
        to: the socket.
        conditions: load, offset (bytes), jump and value of each.

    Raises:
        OSError: the kernel refuses the filter.

    Source: Linux, Documentation/networking/filter.rst.
    """
    code = b""
    for index, (load, offset, jump, value) in enumerate(conditions):
        # Two instructions follow the conditions: accept all bytes, and drop.
        to_drop = 2 * (len(conditions) - index) - 1
        code += struct.pack("=HBBI", load, 0, 0, offset)
        yes, no = (0, to_drop) if jump == JUMP_EQUAL else (to_drop, 0)
        code += struct.pack("=HBBI", jump, yes, no, value)
    code += struct.pack("=HBBI", RETURN, 0, 0, ACCEPT_ALL) + struct.pack("=HBBI", RETURN, 0, 0, 0)
    program = ctypes.create_string_buffer(code)
    count = 2 * len(conditions) + 2
    to.setsockopt(
        socket.SOL_SOCKET, SO_ATTACH_FILTER, struct.pack("@HP", count, ctypes.addressof(program))
    )


def socket_at(port: int) -> socket.socket:
    """A duplicate descriptor of this process's UDP socket at a port.

    Args:
        port: local port.

    Returns:
        The socket; the caller closes it.

    Raises:
        FileNotFoundError: there is none.
    """

    def is_it(found: socket.socket) -> bool:
        is_udp = (found.family, found.type) == (socket.AF_INET, socket.SOCK_DGRAM)
        return is_udp and found.getsockname()[1] == port

    for descriptor, _ in _sockets():
        found = _duplicate_socket(descriptor, is_it)
        if found is not None:
            return found
    raise FileNotFoundError(f"no socket is bound to UDP port {port}")


def _second_socket(first: socket.socket) -> socket.socket:
    """A second socket at the address of `first`; afterwards no other one can bind there."""
    second = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    both = (first, second)
    try:
        for each in both:
            each.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        second.bind(first.getsockname())
        second.setblocking(False)
    except OSError:
        second.close()
        raise
    finally:
        with contextlib.suppress(OSError):
            for each in both:
                each.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
    return second


def _drops(of: socket.socket) -> int:
    """Datagrams that the kernel dropped for this socket; 0 if it does not report them."""
    try:
        found = of.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, MEMINFO_NBYTES)
    except OSError:
        return 0
    return int(struct.unpack("=9I", found)[MEMINFO_DROPS])


def _sockets() -> Iterator[tuple[int, str]]:
    """Descriptor and inode of every socket of this process."""
    for entry in Path("/proc/self/fd").iterdir():
        # Another thread may close the descriptor in the meantime.
        with contextlib.suppress(OSError):
            target = str(entry.readlink())
            if target.startswith("socket:"):
                yield int(entry.name), target


def _duplicate_socket(
    descriptor: int, predicate: Callable[[socket.socket], bool]
) -> socket.socket | None:
    """A duplicate of a descriptor, if the predicate accepts its socket; else None."""
    with contextlib.suppress(OSError):
        found = socket.socket(fileno=os.dup(descriptor))
        with contextlib.suppress(OSError):
            if predicate(found):
                return found
        found.close()
    return None


def _as_number(address: str) -> int:
    return int.from_bytes(socket.inet_aton(address), "big")

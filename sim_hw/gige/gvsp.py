"""GVSP on the wire: one frame as a table of datagrams that the kernel sends in batches.

Header, slice of the image and slice of the chunk data are gathered by the kernel (sendmmsg), so
that pixels are never copied and packets never built one by one. `stream` decides when to send.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_hw.gige.features import IMAGE_CHUNK_ID
from sim_hw.gige.gvcp import Status

HEADER_LENGTH = 8
UDP_OVERHEAD = 28
"""IPv4 and UDP headers, which GevSCPSPacketSize counts in."""

PAYLOAD_IMAGE = 0x0001
PAYLOAD_EXTENDED_CHUNKS = 0x4000

_LEADER, _TRAILER, _DATA = 1, 2, 3
_LEADER_BODY = struct.Struct(">HHQIIIIIHH")
_TRAILER_BODY = struct.Struct(">HHI")
_CHUNK_TRAILER_BODY = struct.Struct(">HHIII")
_HEADER_DTYPE = np.dtype([("status", ">u2"), ("block_id", ">u2"), ("format_and_packet", ">u4")])
_BATCH_MAX = 1024
"""UIO_MAXIOV: sendmmsg takes no more messages at a time."""


class _Vector(ctypes.Structure):
    _fields_ = [("base", ctypes.c_size_t), ("length", ctypes.c_size_t)]


class _MessageHeader(ctypes.Structure):
    """struct msghdr of sendmsg(2)."""

    _fields_ = [
        ("name", ctypes.c_size_t),
        ("name_length", ctypes.c_uint32),
        ("vectors", ctypes.c_size_t),
        ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_size_t),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    ]


class _Message(ctypes.Structure):
    """struct mmsghdr of sendmmsg(2)."""

    _fields_ = [("header", _MessageHeader), ("sent", ctypes.c_uint)]


_VECTOR_DTYPE = np.dtype(_Vector)
_HEADER_FIELDS = [name for name, *_ in _MessageHeader._fields_]
_MESSAGE_DTYPE = np.dtype(
    {
        "names": _HEADER_FIELDS,
        "formats": [np.dtype(kind) for _, kind, *_ in _MessageHeader._fields_],
        "offsets": [getattr(_MessageHeader, name).offset for name in _HEADER_FIELDS],
        "itemsize": ctypes.sizeof(_Message),
    }
)

_libc = ctypes.CDLL(None, use_errno=True)
_libc.sendmmsg.argtypes = [ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int]
_libc.sendmmsg.restype = ctypes.c_int


@dataclass(frozen=True)
class FrameHeader:
    """The description of a frame in its leader; `timestamp_ns` is on the device's clock."""

    block_id: int
    timestamp_ns: int
    pixel_format: int
    width_px: int
    height_px: int


@dataclass(frozen=True)
class Destination:
    """Where a frame goes, in packets of which size (IP header included) and how far apart.

    `packet_delay_ns` is inserted between the end of a packet and the next (GevSCPD),
    `transfer_delay_ns` before the first one (GevSCFTD). `throughput_limit_bytes_per_s` is the
    highest rate on the wire (DeviceLinkThroughputLimit).
    """

    address: str
    port: int
    packet_size: int
    packet_delay_ns: int = 0
    transfer_delay_ns: int = 0
    throughput_limit_bytes_per_s: float = float("inf")


@dataclass(frozen=True)
class PacketBatch:
    """Some datagrams of a frame, ready for the kernel. Holds what its pointers point to."""

    messages: NDArray[np.void]
    referenced_arrays: tuple[Any, ...]

    def __len__(self) -> int:
        return len(self.messages)


class FramePackets:
    """The datagrams of one frame: packet 0 is the leader, the last one the trailer.

    `image` is what goes over the wire, C-contiguous; it is referred to, never copied, and must not
    change as long as this object lives. `chunks` follows the image where it is not empty.
    """

    def __init__(
        self,
        header: FrameHeader,
        image: NDArray[np.uint8] | NDArray[np.uint16],
        chunks: bytes,
        destination: Destination,
    ) -> None:
        if not image.flags.c_contiguous:
            raise ValueError(f"image of shape {image.shape} is not contiguous")
        self.block_id = header.block_id
        self.destination = destination
        payload_type = PAYLOAD_IMAGE | (PAYLOAD_EXTENDED_CHUNKS if chunks else 0)
        leader = _LEADER_BODY.pack(
            0,
            payload_type,
            header.timestamp_ns & 0xFFFF_FFFF_FFFF_FFFF,
            header.pixel_format,
            header.width_px,
            header.height_px,
            0,
            0,
            0,
            0,
        )
        trailer = _TRAILER_BODY.pack(0, payload_type, header.height_px)
        if chunks:
            trailer = _CHUNK_TRAILER_BODY.pack(
                0, payload_type, header.height_px, image.nbytes + len(chunks), 0
            )
        step = destination.packet_size - UDP_OVERHEAD - HEADER_LENGTH
        data_count = -(-(image.nbytes + len(chunks)) // step)
        self.count = data_count + 2
        self._headers = np.zeros(self.count, _HEADER_DTYPE)
        self._headers["block_id"] = header.block_id
        formats = np.full(self.count, _DATA << 24, np.uint32)
        formats[0], formats[-1] = _LEADER << 24, _TRAILER << 24
        self._headers["format_and_packet"] = formats | np.arange(self.count, dtype=np.uint32)

        self._image = image
        self._chunks = np.frombuffer(chunks or b"\0", np.uint8)
        self._ends = np.frombuffer(leader + trailer, np.uint8)
        self._name = np.frombuffer(
            struct.pack(
                "=H2s4s8x",
                socket.AF_INET,
                struct.pack(">H", destination.port),
                socket.inet_aton(destination.address),
            ),
            np.uint8,
        )
        bodies = self._bodies(step, data_count, len(chunks), len(leader), len(trailer))
        self.sizes: NDArray[np.int64] = (
            HEADER_LENGTH + UDP_OVERHEAD + bodies["length"].sum(axis=1).astype(np.int64)
        )
        self._vectors = np.zeros((self.count, 3), _VECTOR_DTYPE)
        self._vectors[:, 1:] = bodies
        self._messages = self._point(self._headers, self._vectors)

    def batch(self, first: int, last: int) -> PacketBatch:
        """Packets `first` to `last`, both included."""
        return PacketBatch(self._messages[first : last + 1], (self,))

    def only(self, packets: NDArray[np.intp]) -> PacketBatch:
        """Chosen packets, in the order given."""
        return PacketBatch(self._messages[packets], (self,))

    def resent(self, packets: NDArray[np.intp]) -> PacketBatch:
        """Chosen packets, marked as answers to a resend request."""
        headers = self._headers[packets]
        headers["status"] = Status.PACKET_RESEND
        vectors = self._vectors[packets]
        return PacketBatch(self._point(headers, vectors), (self, headers, vectors))

    def _bodies(
        self, step: int, data_count: int, chunk_bytes: int, leader_bytes: int, trailer_bytes: int
    ) -> NDArray[np.void]:
        """Address and length of each packet's part of the image and of the chunk data."""
        bodies = np.zeros((self.count, 2), _VECTOR_DTYPE)
        image_bytes = self._image.nbytes
        start = np.arange(data_count, dtype=np.int64) * step
        end = np.minimum(start + step, image_bytes + chunk_bytes)
        in_image = np.minimum(end, image_bytes) - np.minimum(start, image_bytes)
        data = bodies[1:-1]
        data["base"][:, 0] = _address(self._image) + np.minimum(start, image_bytes)
        data["length"][:, 0] = in_image
        data["base"][:, 1] = _address(self._chunks) + np.maximum(start - image_bytes, 0)
        data["length"][:, 1] = (end - start) - in_image
        bodies[0, 0] = (_address(self._ends), leader_bytes)
        bodies[-1, 0] = (_address(self._ends) + leader_bytes, trailer_bytes)
        return bodies

    def _point(self, headers: NDArray[np.void], vectors: NDArray[np.void]) -> NDArray[np.void]:
        """Messages whose vectors are these headers and bodies; `vectors` is completed in place."""
        count = len(headers)
        index = np.arange(count, dtype=np.uint64)
        vectors["base"][:, 0] = _address(headers) + index * _HEADER_DTYPE.itemsize
        vectors["length"][:, 0] = HEADER_LENGTH
        messages = np.zeros(count, _MESSAGE_DTYPE)
        messages["name"] = _address(self._name)
        messages["name_length"] = self._name.nbytes
        messages["vectors"] = _address(vectors) + index * (3 * _VECTOR_DTYPE.itemsize)
        messages["vector_count"] = 3
        return messages


def send(descriptor: int, batch: PacketBatch) -> tuple[int, int]:
    """Give a batch to the kernel. Returns how many it took and how many it refused."""
    messages = batch.messages
    count, done, refused = len(messages), 0, 0
    base = _address(messages)
    while done < count:
        todo = min(count - done, _BATCH_MAX)
        taken = _libc.sendmmsg(descriptor, base + done * messages.strides[0], todo, 0)
        if taken > 0:
            done += taken
            continue
        number = ctypes.get_errno()
        if number == errno.EINTR:
            continue
        if number == errno.EBADF:
            raise OSError(number, os.strerror(number))
        # One datagram that cannot go (too long, no buffers) must not keep back the others.
        refused += 1
        done += 1
    return done - refused, refused


def chunk_data(image_bytes: int, chunks: Sequence[tuple[int, bytes]]) -> bytes:
    """What follows the image: its own chunk tag, then each chunk's data and tag (id, length)."""
    parts = [struct.pack(">II", IMAGE_CHUNK_ID, image_bytes)]
    for chunk_id, value in chunks:
        parts += [value, struct.pack(">II", chunk_id, len(value))]
    return b"".join(parts)


def unavailable_packet(block_id: int, packet: int) -> bytes:
    """The answer to a request for a packet that is no longer kept."""
    return struct.pack(">HHI", Status.PACKET_UNAVAILABLE, block_id, _DATA << 24 | packet)


def _address(array: NDArray[Any]) -> int:
    return int(array.ctypes.data)

"""GSOF records out of a stream of bytes: packets, pages of packets, and the fields of records.

What a record means is in `drivers.receivers.gsof.decoder`.

Source: Trimble OEM GNSS receiver help, "GSOF messages: overview" and the page of each message;
"Report packet 40h (GENOUT)" for packets and pages.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from drivers.receivers.message_framer import MessageFramer

START: Final = b"\x02"
END: Final = 0x03
GENOUT: Final = 0x40
HEADER_NBYTES: Final = 4
"""Start, receiver status, type of the packet, length of its data."""
TAIL_NBYTES: Final = 2
PAGE_NBYTES: Final = 3
"""Transmission number, index of the page, index of the last page."""


@dataclass(frozen=True)
class _Layout:
    name: str
    fields: struct.Struct


LAYOUTS: Final[Mapping[int, _Layout]] = {
    1: _Layout("Time", struct.Struct(">IHBBBB")),
    2: _Layout("Llh", struct.Struct(">3d")),
    8: _Layout("Velocity", struct.Struct(">B3f")),
    12: _Layout("Sigma", struct.Struct(">9fH")),
    16: _Layout("Utc", struct.Struct(">IHhB")),
    49: _Layout("InsNavigation", struct.Struct(">HIBB3d4f4d6f")),
    50: _Layout("InsRms", struct.Struct(">HIBB9f")),
    51: _Layout("EventMarker", struct.Struct(">BHdI")),
}
"""Records that are of use here, by type. Newer firmware appends fields, which are left."""


@dataclass(frozen=True)
class GsofRecord:
    """One record: its name and its values."""

    name: str
    values: tuple[Any, ...]


def gsof_framer() -> MessageFramer:
    """A framer for GENOUT packets.

    Returns:
        A new framer with an empty buffer.
    """
    return MessageFramer(START, _size_of, _fits)


def records_of(content: bytes) -> Iterator[GsofRecord]:
    """Take the records of a whole transmission apart.

    Args:
        content: the joined pages, without their indices.

    Yields:
        The records that are of use here, in their order.

    Raises:
        ValueError: a record is cut or shorter than its kind, or a number is infinite or none.
    """
    at = 0
    while at < len(content):
        if at + 2 > len(content):
            raise ValueError("a record that is cut")
        number, nbytes = content[at], content[at + 1]
        body = content[at + 2 : at + 2 + nbytes]
        at += 2 + nbytes
        if at > len(content):
            raise ValueError("a record that is cut")
        layout = LAYOUTS.get(number)
        if layout is None:
            continue
        if nbytes < layout.fields.size:
            raise ValueError(f"{layout.name} of {nbytes} bytes")
        values = layout.fields.unpack_from(body)
        if not all(math.isfinite(value) for value in values):
            raise ValueError(f"{layout.name} holds a number that is none")
        yield GsofRecord(layout.name, values)


class Transmissions:
    """Joins the pages of one transmission. A record may begin on one page and end on the next."""

    def __init__(self) -> None:
        self._number = self._lost = -1
        self._pages: list[bytes] = []
        self.incomplete = 0
        """Transmissions of which a page was missing."""

    def reset(self) -> None:
        """Discard the pages received so far."""
        self._pages = []

    def add(self, packet: bytes) -> bytes | None:
        """Add a packet.

        Args:
            packet: a whole checked packet.

        Returns:
            The joined content once its last page has come; None before.

        Raises:
            ValueError: the packet has no page, or a page behind its last one.
        """
        data = packet[HEADER_NBYTES:-TAIL_NBYTES]
        if len(data) < PAGE_NBYTES:
            raise ValueError("a packet without a page")
        number, index, last = data[:PAGE_NBYTES]
        if index > last:
            raise ValueError("a page behind the last one")
        if index == 0:
            self.incomplete += bool(self._pages)
            self._number, self._lost, self._pages = number, -1, []
        elif not self._pages or number != self._number or index != len(self._pages):
            self.incomplete += bool(self._pages) or number != self._lost
            self._lost, self._pages = number, []
            return None
        self._pages.append(data[PAGE_NBYTES:])
        if index < last:
            return None
        content = b"".join(self._pages)
        self._pages = []
        return content


def _size_of(buffer: bytes, at: int) -> int | None:
    head = buffer[at : at + HEADER_NBYTES]
    if len(head) > 2 and head[2] != GENOUT:
        return 0
    if len(head) < HEADER_NBYTES:
        return None
    return HEADER_NBYTES + head[3] + TAIL_NBYTES


def _fits(packet: bytes) -> bool:
    return packet[-1] == END and sum(packet[1:-TAIL_NBYTES]) & 0xFF == packet[-TAIL_NBYTES]

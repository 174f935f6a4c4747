"""Base of the decoders of all receivers: counting, and tolerance of invalid input.

The framer of each protocol separates messages, and its decoder interprets them;
the arithmetic of time is in `drivers.timescales.gps_time`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from typing import ClassVar, Protocol

from drivers.contract import EventMark, NavSample
from drivers.timescales.gps_time import FAR_NS

Nav = NavSample | EventMark


class Framer(Protocol):
    """Cuts whole, checked messages out of a stream, and counts them."""

    frames: int
    bad_frames: int
    bad_bytes: int

    @property
    def pending(self) -> int:
        """Bytes of a message that is not whole yet."""

    def reset(self) -> None:
        """Discard an incomplete message."""

    def feed(self, data: bytes) -> list[bytes]:
        """Add bytes of the stream.

        Args:
            data: bytes as received, cut anywhere.

        Returns:
            The messages that became complete with them.
        """


class MessageDecoder:
    """Bytes in, records out, no I/O and no clock. Nothing that is fed raises.

    A protocol converts a complete message in `on_message`. `decode_errors` lists the exceptions
    that mean an invalid message, and `bad_counter` is the name of their counter.
    """

    decode_errors: tuple[type[Exception], ...] = (ValueError,)
    bad_counter: ClassVar[str] = "bad_messages"

    def __init__(self, receiver: str, framer: Framer, counters: tuple[str, ...]) -> None:
        self.receiver = receiver
        self.counters: Counter[str] = Counter({self.bad_counter: 0} | dict.fromkeys(counters, 0))
        self.seen: Counter[str] = Counter()
        """Messages understood, by name."""
        self._framer = framer
        self._leap: int | None = None
        self.other_edges = 0
        """Event marks in succession of the edge that is not the configured one."""
        self._gps_ns: int | None = None
        """GPS time of the last navigation epoch whose time could be trusted."""
        self.fix: str | None = None
        """The receiver's latest fix status, as in NavSample; None before the first."""
        self.satellites: int | None = None
        """Satellites in use; None if the receiver has not reported them."""

    @abstractmethod
    def on_message(self, message: bytes, mono_ns: int) -> list[Nav]:
        """Interpret one complete message.

        Args:
            message: its bytes, checked by the framer.
            mono_ns: arrival on CLOCK_MONOTONIC, ns.

        Returns:
            The records it makes; may be empty.

        Raises:
            Exception: one of `decode_errors` if the message is invalid.
        """

    @property
    def leap_seconds(self) -> int | None:
        """GPS - UTC as the receiver knows it; None before it does."""
        return self._leap

    @property
    def frames(self) -> int:
        """Undamaged messages so far, of any kind."""
        return self._framer.frames

    @property
    def bad_messages(self) -> int:
        """Messages whose checksum, length or content was wrong."""
        return self._framer.bad_frames + self.counters[self.bad_counter]

    @property
    def bad_bytes(self) -> int:
        """Bytes that belong to no message."""
        return self._framer.bad_bytes

    @property
    def pending(self) -> int:
        """Bytes kept of a message that is not whole yet."""
        return self._framer.pending

    def reset(self) -> None:
        """The line was reopened: discard incomplete messages."""
        self._framer.reset()
        self.fix = self.satellites = None

    def feed(self, data: bytes, mono_ns: int) -> list[Nav]:
        """Decode bytes of the stream; an invalid message is counted.

        Args:
            data: bytes as received, cut anywhere.
            mono_ns: their arrival on CLOCK_MONOTONIC, ns.

        Returns:
            The records that became complete, stamped with `mono_ns`.
        """
        records: list[Nav] = []
        for message in self._framer.feed(data):
            try:
                decoded = self.on_message(message, mono_ns)
            except self.decode_errors:
                self.counters[self.bad_counter] += 1
                continue
            records.extend(decoded)
            for record in decoded:
                if isinstance(record, NavSample):
                    self.fix, self.satellites = record.fix, record.satellites
        return records

    def is_near_navigation(self, gps_ns: int) -> bool:
        """Whether a mark may be of a time; one far from navigation is counted.

        Args:
            gps_ns: time of the mark, ns since the GPS epoch.

        Returns:
            True within FAR_NS of the last navigation epoch, and before the first one.
        """
        if self._gps_ns is None or abs(gps_ns - self._gps_ns) <= FAR_NS:
            return True
        self.counters["marks_far"] += 1
        return False

"""pymavlink: loaded when it is first needed, and what is asked of it."""

from __future__ import annotations

import functools
import struct
from typing import Any, Final

from drivers.base.extras import missing
from drivers.receivers.message_framer import MessageFramer

V1: Final = 0xFE
V2: Final = 0xFD
SIGNED: Final = 0x01
SIGNATURE_NBYTES: Final = 13
V1_OVERHEAD: Final = 8
V2_OVERHEAD: Final = 12


@functools.cache
def dialect() -> Any:
    """The dialect with the most messages: ArduPilot's, which holds all common ones.

    Returns:
        The module of pymavlink.

    Raises:
        MissingExtraError: pymavlink is not installed.
    """
    try:
        from pymavlink.dialects.v20 import ardupilotmega
    except ImportError as error:
        raise missing("mavlink", error) from error
    return ardupilotmega


class MavlinkParser:
    """Bytes of a whole message into pymavlink's object for it."""

    def __init__(self) -> None:
        self._dialect = dialect()
        self._parser = self._dialect.MAVLink(None)
        # Quirk: pymavlink raises other exceptions than its own for invalid content.
        # Upstream: dronekit/dronekit-python#263.
        self.errors: tuple[type[Exception], ...] = (
            self._dialect.MAVError,
            ValueError,
            TypeError,
            AttributeError,
            OverflowError,
            struct.error,
        )

    def framer(self) -> MessageFramer:
        """A framer for versions 1 and 2, signed or not; messages not in the dialect are none.

        Returns:
            A new framer.
        """
        return MessageFramer(bytes((V1, V2)), self._size_of, self._fits)

    def messages_of(self, datagram: bytes) -> list[bytes] | None:
        """The checked messages of a datagram.

        Args:
            datagram: its bytes.

        Returns:
            The bytes of each message; None if the datagram holds anything else.
        """
        found, at = [], 0
        while at < len(datagram):
            size = self._size_of(datagram, at) if datagram[at] in (V1, V2) else 0
            message = datagram[at : at + (size or 0)]
            if not size or len(message) < size or not self._fits(message):
                return None
            found.append(message)
            at += size
        return found

    def parse(self, frame: bytes) -> Any:
        """The message of a checked frame.

        Args:
            frame: bytes of one message.

        Returns:
            pymavlink's object of the message.

        Raises:
            Exception: one of `errors` if its content is invalid.
        """
        return self._parser.decode(bytearray(frame))

    def _size_of(self, buffer: bytes, at: int) -> int | None:
        if buffer[at] == V1:
            head = buffer[at : at + 6]
            if len(head) < 6:
                return None
            return V1_OVERHEAD + head[1] if head[5] in self._dialect.mavlink_map else 0
        head = buffer[at : at + 10]
        if len(head) > 2 and head[2] & ~SIGNED:
            return 0
        if len(head) < 10:
            return None
        if int.from_bytes(head[7:10], "little") not in self._dialect.mavlink_map:
            return 0
        return V2_OVERHEAD + head[1] + (SIGNATURE_NBYTES if head[2] & SIGNED else 0)

    def _fits(self, frame: bytes) -> bool:
        is_v1 = frame[0] == V1
        identity = frame[5] if is_v1 else int.from_bytes(frame[7:10], "little")
        end = (6 if is_v1 else 10) + frame[1]
        checked = bytearray(frame[1:end])
        checked.append(self._dialect.mavlink_map[identity].crc_extra)
        crc: int = self._dialect.x25crc(checked).crc
        return crc == int.from_bytes(frame[end : end + 2], "little")

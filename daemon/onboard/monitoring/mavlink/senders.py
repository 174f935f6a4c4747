"""Senders of MAVLink to the camera: each has its own parser, and their number is bounded.

Messages are executed in `daemon.onboard.monitoring.mavlink.camera`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from drivers.receivers.mavlink.library import MavlinkParser
from drivers.receivers.message_framer import MessageFramer

DATAGRAM_MAX_BYTES: Final = 2048
STREAMS_MAX: Final = 16
"""Senders whose messages span several datagrams."""
STREAM_BYTES_PER_S: Final = 8000
"""Limit for all unsigned ones together; searching damaged bytes for messages costs time."""
PEERS_MAX: Final = 16
PEER_TIMEOUT_S: Final = 60.0

Address = tuple[str, int]


@dataclass
class _Peer:
    last_s: float
    is_signed: bool


class Senders:
    """Senders of recent messages.

    `peers` receive unrequested messages. If the table is full, a sender with a verified signature
    replaces one without. An unsigned new sender waits for a free entry.
    """

    def __init__(self, parser: MavlinkParser) -> None:
        self._parser = parser
        self._peers: dict[Address, _Peer] = {}
        self._streams: dict[Address, MessageFramer] = {}
        self._credit_bytes, self._credit_s = float(STREAM_BYTES_PER_S), 0.0

    @property
    def peers(self) -> tuple[Address, ...]:
        return tuple(self._peers)

    def messages(self, data: bytes, address: Address, now_s: float) -> tuple[list[bytes], int]:
        """Complete, checked messages of a datagram, and the number of other bytes.

        A datagram of whole messages, as nearly all are, is parsed alone: nothing that came before
        can damage it. Others are a part of the stream of bytes of their sender.
        """
        if len(data) > DATAGRAM_MAX_BYTES:
            return [], len(data)
        complete = self._parser.messages_of(data)
        if complete is not None:
            self._streams.pop(address, None)
            return complete, 0
        if not self._is_signed(address) and not self._spend(len(data), now_s):
            return [], len(data)
        # Removed and inserted again, so that the order is that of last use.
        stream = self._streams.pop(address, None) or self._parser.framer()
        self._streams[address] = stream
        while len(self._streams) > STREAMS_MAX:
            unsigned = [each for each in self._streams if not self._is_signed(each)]
            del self._streams[(unsigned or list(self._streams))[0]]
        before = stream.bad_bytes
        return stream.feed(data), stream.bad_bytes - before

    def register(self, address: Address, now_s: float, *, is_signed: bool) -> bool:
        """Register a sender; whether it is a peer now."""
        for old in [a for a, p in self._peers.items() if now_s - p.last_s > PEER_TIMEOUT_S]:
            del self._peers[old]
        peer = self._peers.get(address)
        if peer is not None:
            peer.last_s, peer.is_signed = now_s, peer.is_signed or is_signed
            return True
        if len(self._peers) >= PEERS_MAX:
            evictable = [a for a, p in self._peers.items() if is_signed and not p.is_signed]
            if not evictable:
                return False
            del self._peers[min(evictable, key=lambda each: self._peers[each].last_s)]
        self._peers[address] = _Peer(now_s, is_signed)
        return True

    def _is_signed(self, address: Address) -> bool:
        peer = self._peers.get(address)
        return peer is not None and peer.is_signed

    def _spend(self, nbytes: int, now_s: float) -> bool:
        passed_s, self._credit_s = now_s - self._credit_s, now_s
        gained = passed_s * STREAM_BYTES_PER_S
        self._credit_bytes = min(self._credit_bytes + gained, STREAM_BYTES_PER_S)
        if nbytes > self._credit_bytes:
            return False
        self._credit_bytes -= nbytes
        return True

"""Telemetry over a lossy one-way link: self-contained datagrams, sent repeatedly.

Nothing is acknowledged. The brief state, faults and the latest exposure are sent first and most
often. The remaining budget repeats earlier exposures, so that a client that lost datagrams or
connected late obtains the same state. Format in docs/reference/flight/telemetry.md.
"""

from __future__ import annotations

import asyncio
import math
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import msgpack

from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.telemetry import VERSION, packed

DATAGRAM_MAX_BYTES = 1200
"""Passes every link without fragmentation."""

BRIEF_EVERY_S = 1.0
FAULT_EVERY_S = 2.0
NEW_FAULT_TIMES, NEW_FAULT_EVERY_S = 6, 0.6
"""A new fault is first sent six times: a link with one third loss loses all of them once in 700."""

REPEATED_EXPOSURES = 200
"""Number of the newest exposures that are repeated."""

PICTURE_EVERY = 4
"""One picture, or piece of one, per this many repeated exposures."""

PREVIEWS_MAX = 8
PIECES_MAX = 1000
TICK_S = 0.1
BURST_S = 1.0


@dataclass
class DatagramScheduler:
    """Order of the datagrams of one link. Times are those of any monotonic clock."""

    bytes_per_s: float
    _credit: float = 0.0
    _at_s: float | None = None
    _brief_s: float = -math.inf
    _faults: dict[tuple[str, bool, bool], tuple[float, int]] = field(default_factory=dict)
    _last_sequence: int = 0
    _repeat_index: int = 0
    _preview_index: int = 0
    _preview_at: int = -1

    def due(self, state: FlightState, now_s: float) -> Iterator[bytes]:
        """The datagrams that are due, within the budget."""
        passed_s = BURST_S if self._at_s is None else now_s - self._at_s
        limit = max(self.bytes_per_s * BURST_S, DATAGRAM_MAX_BYTES)
        self._credit, self._at_s = min(self._credit + passed_s * self.bytes_per_s, limit), now_s
        for datagram in self._candidates(state, now_s):
            if len(datagram) > self._credit:
                return
            self._credit -= len(datagram)
            yield datagram

    def _candidates(self, state: FlightState, now_s: float) -> Iterator[bytes]:
        for fault in state.faults():
            key = (fault["id"], fault["stands"], fault["acknowledged"])
            sent_s, times = self._faults.get(key, (-math.inf, 0))
            pause_s = NEW_FAULT_EVERY_S if times < NEW_FAULT_TIMES else FAULT_EVERY_S
            if now_s - sent_s >= pause_s:
                yield _datagram("fault", fault)
                self._faults[key] = now_s, times + 1
        if now_s - self._brief_s >= BRIEF_EVERY_S:
            yield _datagram("brief", _brief_of(state))
            self._brief_s = now_s
        for one in state.changed("exposures", self._last_sequence):
            yield _datagram("exposure", one)
            self._last_sequence = one["sequence"]
        newest = state.exposures()[-REPEATED_EXPOSURES:]
        previews = [*state.changed("residuals", 0), *state.changed("thumbnails", 0)]
        for _ in newest:
            self._repeat_index %= len(newest)
            if (
                previews
                and self._repeat_index % PICTURE_EVERY == 0
                and self._preview_at != self._repeat_index
            ):
                self._preview_index %= len(previews)
                picture = previews[-1 - self._preview_index]
                yield _datagram("thumbnail" if "data" in picture else "residuals", picture)
                self._preview_index += 1
                self._preview_at = self._repeat_index
            yield _datagram("exposure", newest[self._repeat_index])
            self._repeat_index += 1  # one that did not fit is the next one's first
            self._preview_at = -1


class DatagramReceiver:
    """Receiver: the state from datagrams in any order, with any of them missing."""

    def __init__(self) -> None:
        self.brief: dict[str, Any] = {}
        self.faults: dict[str, dict[str, Any]] = {}
        self.exposures: dict[int, dict[str, Any]] = {}
        self.residuals: dict[int, dict[str, Any]] = {}
        self._pieces: dict[int, dict[int, dict[str, Any]]] = {}
        self.rejected_count = 0

    def thumbnail(self, number: int) -> bytes | None:
        """The JPEG of an exposure; None before all pieces have arrived."""
        pieces = self._pieces.get(number, {})
        if not pieces or len(pieces) < next(iter(pieces.values()))["pieces"]:
            return None
        return b"".join(pieces[k]["data"] for k in sorted(pieces))

    def receive(self, datagram: bytes) -> None:
        """Add one datagram; invalid ones are counted."""
        try:
            message = msgpack.unpackb(datagram)
            kind, content = message["kind"], message["content"]
            if message["version"] != VERSION or not isinstance(content, dict):
                raise ValueError("of another version")
            if kind in ("exposure", "residuals", "thumbnail"):
                _check_number(content["number"])
            if kind == "brief":
                self._receive_brief(content)
            elif kind == "fault":
                self._newer(self.faults, content["id"], content)
            elif kind == "exposure":
                self._newer(self.exposures, content["number"], content)
            elif kind == "residuals":
                self._newer(self.residuals, content["number"], content)
            elif kind == "thumbnail":
                _check_number(content["piece"])
                if not (1 <= _check_number(content["pieces"]) <= PIECES_MAX):
                    raise ValueError("of more pieces than a picture has")
                if not isinstance(content["data"], bytes):
                    raise TypeError("a piece of a picture is bytes")
                pieces = self._pieces.setdefault(content["number"], {})
                self._newer(pieces, content["piece"], content)
            for previews in (self.residuals, self._pieces):
                while len(previews) > PREVIEWS_MAX:
                    del previews[min(previews)]
        except (ValueError, KeyError, TypeError, msgpack.UnpackException):
            self.rejected_count += 1

    def _receive_brief(self, content: dict[str, Any]) -> None:
        if content["sequence"] < self.brief.get("sequence", -1):
            if content["mission"] == self.brief.get("mission"):
                return  # it was overtaken
            self.exposures.clear()
            self.residuals.clear()
            self._pieces.clear()
        self.brief = content
        reported = set(content["faults"])
        for removed in [stored for stored in self.faults if stored not in reported]:
            del self.faults[removed]

    @staticmethod
    def _newer(stored: dict[Any, dict[str, Any]], key: Any, content: dict[str, Any]) -> None:
        if content["sequence"] >= stored.get(key, {}).get("sequence", -1):
            stored[key] = content


def _check_number(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError("an integer is required")
    return value


async def send(state: FlightState, addresses: Mapping[str, tuple[str, int]], budget: float) -> None:
    """Send to each address for ever; a failing link loses only its own datagrams."""
    senders = {name: DatagramScheduler(budget) for name in addresses}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.setblocking(False)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        while True:
            for name, sender in senders.items():
                for datagram in sender.due(state, time.monotonic()):
                    with suppress(OSError):
                        link.sendto(datagram, addresses[name])
            await asyncio.sleep(TICK_S)


def _brief_of(state: FlightState) -> dict[str, Any]:
    """The brief state, with the ids of the faults."""
    brief = state.brief()
    status = dict(brief["status"])
    mission = brief["mission"]
    return {
        **{
            key: brief[key] for key in ("sequence", "phase", "simulated", "last_number", "verdicts")
        },
        "mission": mission.get("id"),
        "rig": mission.get("rig"),
        "status": status,
        "faults": [fault["id"] for fault in brief["faults"]],
    }


_DROP_ORDER = ("findings", "found", "valid_area", "footprint", "place", "figures", "recovery")


def _datagram(kind: str, content: Mapping[str, Any]) -> bytes:
    """One datagram; the least important parts are dropped if it is too long."""
    remaining = dict(content)
    data = packed({"version": VERSION, "kind": kind, "content": remaining})
    for name in _DROP_ORDER:
        if len(data) <= DATAGRAM_MAX_BYTES:
            break
        if remaining.pop(name, None) is not None:
            data = packed({"version": VERSION, "kind": kind, "content": remaining})
    return data

"""Telemetry under a byte budget: the brief state first, then changed items as the budget allows.

No client has a queue. A client has cursors into the state. Each record holds the brief state
and, as far as the budget allows, the changes after each cursor. A slow link therefore costs
freshness, never memory, and ends up with the same state. A client that shows only the newest part
of a flight receives the past newest first, in records of bounded size. The schema is in
docs/reference/flight/telemetry.md.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import msgpack

from daemon.onboard.monitoring.flight_state import PARTS, FlightState

VERSION = 1
MIN_BYTES_PER_S = 1000
"""Below this rate not even the brief state fits once in a few seconds."""

BRIEF_SHARE = 0.5
ARRAY_HEAD_BYTES = 3
"""Header of a list of up to 65535 items."""

BURST_S = 2.0
"""Unused budget is accumulated for at most this time."""

PAST_BYTES = 24_000
"""Of the past, in one record for a client with `newest`. About 8 kB after compression, so that a
record passes a link of 27 kB/s in less time than the page waits for one."""
CURVE_ITEMS_MAX = 1000
"""Of track and history, evenly spaced, for a client with `newest`."""
CURVES = ("track", "history")
SMALL_PARTS = ("devices", "settings")
"""Complete in the first record: what they hold is the present, not the past."""


@dataclass
class Subscription:
    """One client: its budget, the requested parts, and its cursors."""

    bytes_per_s: float = math.inf
    parts: tuple[str, ...] = PARTS
    newest: int | None = None
    """How many exposures and events of the past are sent; None: all, oldest first."""
    _past: dict[str, deque[Any]] | None = None
    _cursors: dict[str, int] = field(default_factory=dict)
    _sent_sequence: int = -1
    _sent_s: float = -math.inf
    _sent_faults: list[Any] = field(default_factory=list)
    _credit: float = 0.0
    _refilled_s: float | None = None

    def record(self, state: FlightState, now_s: float, *, repeat_s: float = 1.0) -> Any:
        """The next record, as msgpack or JSON types; None if nothing is due.

        Args:
            now_s: time of any monotonic clock in s.
            repeat_s: interval of the brief state in s if nothing changed.
        """
        self._refill(now_s)
        if state.sequence == self._sent_sequence and now_s - self._sent_s < repeat_s:
            return None
        record: dict[str, Any] = {"version": VERSION, **state.brief()}
        nbytes = packed_nbytes(record)
        left = self._credit - nbytes
        # The brief state may use half of the budget; a new fault is sent as soon as credit allows.
        pause_s = nbytes / (BRIEF_SHARE * self.bytes_per_s)
        is_too_soon = now_s - self._sent_s < pause_s and record["faults"] == self._sent_faults
        if left < 0 or is_too_soon:
            return None
        if self.newest is not None and self._past is None:
            self._past = self._begin_past(state, self.newest)
        complete = True
        for part in self.parts:
            items, left, is_complete = self._take_items(state, part, left)
            if items:
                record[part] = items
            complete = complete and is_complete
        if self._past:
            left = self._take_past(record, left)
            complete = complete and not self._past
        self._credit = left
        self._sent_sequence = state.sequence if complete else -1
        self._sent_s, self._sent_faults = now_s, record["faults"]
        return record

    def _begin_past(self, state: FlightState, newest: int) -> dict[str, deque[Any]]:
        """What there was before this client, newest first; its cursors begin behind that."""
        past: dict[str, deque[Any]] = {}
        for part in self.parts:
            if part in SMALL_PARTS:
                continue
            items = state.exposures() if part == "exposures" else state.changed(part, 0)
            chosen = evenly(items, CURVE_ITEMS_MAX) if part in CURVES else items[-newest:]
            past[part] = deque(reversed(chosen))
            self._cursors[part] = state.sequence
        return {part: items for part, items in past.items() if items}

    def _take_past(self, record: dict[str, Any], left: float) -> float:
        """Add items of the past to a record, and return what is left of the budget."""
        assert self._past is not None
        room = min(left, PAST_BYTES)
        left -= room
        for part, items in list(self._past.items()):
            while items:
                nbytes = packed_nbytes(items[0])
                if part not in record:
                    nbytes += packed_nbytes(part) + ARRAY_HEAD_BYTES
                if nbytes > room:
                    return left + room
                room -= nbytes
                record.setdefault(part, []).append(items.popleft())
            del self._past[part]
        return left + room

    def _refill(self, now_s: float) -> None:
        limit = self.bytes_per_s * BURST_S
        if math.isinf(limit):
            self._credit = limit
            return
        passed_s = BURST_S if self._refilled_s is None else now_s - self._refilled_s
        self._credit = min(self._credit + passed_s * self.bytes_per_s, limit)
        self._refilled_s = now_s

    def _take_items(
        self, state: FlightState, part: str, left: float
    ) -> tuple[list[Any], float, bool]:
        """Items of a part that fit, what is left of the budget, and whether all were included."""
        selected: list[Any] = []
        for item in state.changed(part, self._cursors.get(part, 0)):
            nbytes = packed_nbytes(item)
            if not selected:
                nbytes += packed_nbytes(part) + ARRAY_HEAD_BYTES
            if nbytes > left:
                return selected, left, False
            left -= nbytes
            selected.append(item)
            self._cursors[part] = item["sequence"]
        return selected, left, True


def evenly(items: Sequence[Any], count: int) -> list[Any]:
    """At most so many of the items, evenly spaced, the last one among them.

    Example:
        >>> evenly([1, 2, 3, 4, 5, 6, 7], 3)
        [1, 4, 7]
        >>> evenly([1, 2], 3)
        [1, 2]
    """
    step = max(1, -(-len(items) // count))
    return list(items[::-1][::step][::-1])


def packed(record: Any) -> bytes:
    """A record as msgpack."""
    data: bytes = msgpack.packb(record, use_bin_type=True)
    return data


def packed_nbytes(item: Any) -> int:
    return len(packed(item))

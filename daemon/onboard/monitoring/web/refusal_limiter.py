"""How many refused commands are recorded one by one, and the summary of the others.

Whoever floods the service with commands that are refused must neither fill the flight log nor hide
among the entries: an address has a few entries a minute, all addresses together some more, and what
exceeds them is counted by address.
"""

from __future__ import annotations

from dataclasses import dataclass, field

PER_ADDRESS, PER_ADDRESS_REFILL_S = 5, 30.0
"""Entries of one address at once, and the time after which it may have one more."""
IN_TOTAL, IN_TOTAL_REFILL_S = 30, 5.0
SUMMARY_EVERY_S = 60.0
ADDRESSES_MAX = 256
ADDRESSES_NAMED = 8
"""Addresses that a summary names; the others are in its total."""


@dataclass
class _Bucket:
    """Permits that return with time."""

    size: int
    refill_s: float
    _left: float = field(init=False)
    _at_s: float = field(init=False)

    def __post_init__(self) -> None:
        self._left, self._at_s = float(self.size), 0.0

    def take(self, now_s: float) -> bool:
        self._left = min(self.size, self._left + max(0.0, now_s - self._at_s) / self.refill_s)
        self._at_s = now_s
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


class RefusalLimiter:
    """Decides which refused attempts get an entry of their own, and counts the others."""

    def __init__(self) -> None:
        self._total = _Bucket(IN_TOTAL, IN_TOTAL_REFILL_S)
        self._addresses: dict[str, _Bucket] = {}
        self._counts: dict[str, int] = {}
        self._uncounted = 0

    def is_recorded(self, address: str, now_s: float) -> bool:
        """Whether this attempt is recorded by itself; otherwise it is counted for `summary`."""
        bucket = self._addresses.pop(address, None) or _Bucket(PER_ADDRESS, PER_ADDRESS_REFILL_S)
        while len(self._addresses) >= ADDRESSES_MAX:
            del self._addresses[next(iter(self._addresses))]  # the one silent for longest
        self._addresses[address] = bucket
        if bucket.take(now_s) and self._total.take(now_s):
            return True
        if address in self._counts or len(self._counts) < ADDRESSES_MAX:
            self._counts[address] = self._counts.get(address, 0) + 1
        else:
            self._uncounted += 1
        return False

    def summary(self) -> tuple[int, str]:
        """How many attempts were not recorded since the last call, and a sentence on them."""
        counts, self._counts = self._counts, {}
        total, self._uncounted = sum(counts.values()) + self._uncounted, 0
        if total == 0:
            return 0, ""
        busiest = sorted(counts.items(), key=lambda item: -item[1])[:ADDRESSES_NAMED]
        named = ", ".join(f"{address} ({count})" for address, count in busiest)
        return total, f"{total} more refused commands, from {named}" + (
            " and others" if len(counts) > ADDRESSES_NAMED or total > sum(counts.values()) else ""
        )

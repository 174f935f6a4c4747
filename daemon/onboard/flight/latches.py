"""Faults that stand, or stood and nobody has acknowledged: kept until a person has seen them.

Pure, but for the file that carries them over to the next start of the service.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from daemon.mission.records import Fields, RecordError, canonical_bytes, parse_record

FILE = "unhandled-faults.json"
"""In the root of missions: what nobody had acknowledged when the service was last heard."""
KEPT = 200
DELIVERS = frozenset({"opened", "recovered"})
IS_GONE = frozenset({"absent", "lost", "silent", "held-by-another"})
"""Names of device events after which a device delivers, or does not; others are complaints of one
that does."""
SEARCHES, FIXED = "searching", "fixed"
"""Likewise, of a receiver that is open and has no fix yet, and that has one."""
FILE_MAX_BYTES = 1_000_000


@dataclass(frozen=True)
class Latch:
    """A fault. `id` names it, `previous` says that it is of an earlier start of the service."""

    id: str
    device: str
    sentence: str
    stands: bool = True
    acknowledged: bool = False
    count: int = 1
    sequence: int = 0
    previous: bool = False


class Latches:
    """Faults by their id; the oldest is forgotten beyond `KEPT`."""

    def __init__(self) -> None:
        self._latches: dict[str, Latch] = {}

    def raise_fault(
        self, fault: str, sentence: str, device: str = "", *, sequence: int = 0
    ) -> None:
        """A fault has come, or come again."""
        known = self._latches.pop(fault, None)
        count = known.count + 1 if known else 1
        self._latches[fault] = Latch(fault, device, sentence, count=count, sequence=sequence)
        while len(self._latches) > KEPT:
            del self._latches[next(iter(self._latches))]

    def pass_fault(self, fault: str) -> None:
        """A fault is over; it stays listed until a person has acknowledged it."""
        found = self._latches.get(fault)
        if found is None:
            return
        if found.acknowledged:
            del self._latches[fault]
        else:
            self._latches[fault] = replace(found, stands=False)

    def acknowledge(self, fault: str) -> bool:
        """A person has seen a fault. One that has passed leaves the list; one that stands stays."""
        found = self._latches.get(fault)
        if found is None:
            return False
        if found.stands:
            self._latches[fault] = replace(found, acknowledged=True)
        else:
            del self._latches[fault]
        return True

    def apply(self, event: Mapping[str, Any], *, sequence: int = 0) -> None:
        """What an event of the service raises or puts an end to."""
        kind, sentence = event.get("event"), str(event.get("sentence", ""))
        if kind == "device":
            self._apply_device(event, sentence, sequence)
        elif kind == "disk-dropped":
            label = str(event.get("disk"))
            self.raise_fault(f"disk {label}", sentence, f"disk {label}", sequence=sequence)
        elif kind == "disk-health":
            fault = f"health of disk {event.get('disk')}"
            if event.get("fault"):
                self.raise_fault(fault, sentence, fault, sequence=sequence)
            else:
                self.pass_fault(fault)
        elif kind in ("disk-joined", "disk-released"):
            self.pass_fault(f"disk {event.get('disk')}")
        elif kind in _RAISES:
            fault, device = _RAISES[kind]
            self.raise_fault(fault, sentence, device, sequence=sequence)
        elif kind == "page-link":
            self.raise_fault("page link", sentence, "service", sequence=sequence)
            self.pass_fault("page link")  # it happened; nothing stands
        elif kind == "prerequisite":
            fault = f"prerequisite {event.get('item')}"
            self.raise_fault(fault, sentence, "service", sequence=sequence)
        elif kind == "lost":
            number, cause = event.get("number"), event.get("cause")
            said = f"Exposure {number}: {cause}"
            fault = f"exposure {number}"
            self.raise_fault(fault, said, "exposures", sequence=sequence)
            self.pass_fault(fault)  # it happened; nothing stands
        elif kind == "ready":
            for absent in event.get("absent", []):
                said = f"Flying without {absent}; look at it."
                self.raise_fault(f"absent {absent}", said, str(absent), sequence=sequence)
        elif kind == "status":
            if event.get("exposures_left"):
                self.pass_fault("disk")
            self._pass_absent(event)
        elif kind == "previous-fault":
            latch = _latch(event)
            self.add_previous([latch] if latch else [], sequence=sequence)

    def _pass_absent(self, event: Mapping[str, Any]) -> None:
        """What was absent when the service became ready, and is there now."""
        if isinstance(absent := event.get("absent"), list):
            still = {f"absent {one}" for one in absent}
            for fault in [f for f in self._latches if f.startswith("absent ")]:
                if fault not in still and self._latches[fault].stands:
                    self.pass_fault(fault)

    def _apply_device(self, event: Mapping[str, Any], sentence: str, sequence: int) -> None:
        device, name = str(event.get("device")), event.get("name")
        if device == "clock":
            # One device, several things that come and go by themselves.
            fault = f"clock {name}"
            if event.get("fault"):
                self.raise_fault(fault, sentence, device, sequence=sequence)
            if not event.get("fault") or str(name).endswith("stepped"):
                self.pass_fault(fault)
        elif name in DELIVERS:
            self.pass_fault(f"device {device}")
        elif event.get("fault"):
            is_gone = name in IS_GONE
            fault = f"device {device}" if is_gone else f"{name} {device}"
            self.raise_fault(fault, sentence, device, sequence=sequence)
            if not is_gone:
                self.pass_fault(fault)

    def add_previous(self, latches: Iterable[Latch], *, sequence: int = 0) -> None:
        """Faults of an earlier start: they no longer stand, and nobody has acknowledged them."""
        for latch in latches:
            if latch.id not in self._latches:
                self._latches[latch.id] = replace(
                    latch, stands=False, acknowledged=False, sequence=sequence, previous=True
                )

    def listed(self) -> list[dict[str, Any]]:
        """All of them as plain JSON types, the newest first."""
        return [asdict(latch) for latch in sorted(self._latches.values(), key=_newest_first)]

    def unhandled(self) -> tuple[Latch, ...]:
        """Those that nobody has acknowledged, in the order they came."""
        return tuple(latch for latch in self._latches.values() if not latch.acknowledged)

    def __contains__(self, fault: str) -> bool:
        return fault in self._latches


def unhandled_note(latches: Iterable[Latch]) -> bytes:
    """The content of `FILE`: the faults nobody has acknowledged, for the next start."""
    kept = [{key: getattr(latch, key) for key in _KEYS} for latch in latches]
    return canonical_bytes({"faults": kept})


def read_unhandled(root: Path) -> tuple[Latch, ...]:
    """The faults nobody had acknowledged; none where the file is missing or damaged."""
    path = root / FILE
    try:
        if path.stat().st_size > FILE_MAX_BYTES:
            return ()
        content = parse_record(path.read_bytes(), FILE)
    except (OSError, RecordError):
        return ()
    listed = content.get("faults")
    return tuple(
        latch
        for one in (listed if isinstance(listed, list) else [])[:KEPT]
        if isinstance(one, Mapping) and (latch := _latch(one)) is not None
    )


def previous_faults(latches: Iterable[Latch]) -> list[dict[str, Any]]:
    """Events that tell of faults of an earlier start."""
    return [
        {"event": "previous-fault", **{key: getattr(latch, key) for key in _KEYS}}
        for latch in latches
    ]


_RAISES: Mapping[object, tuple[str, str]] = {
    "fault": ("service", "service"),
    "ledger": ("ledger", "service"),
    "disk": ("disk", "disk"),
    "mirror": ("mirror", "disk"),
    "not-written": ("disk", "disk"),
    "power": ("power", "power"),
    "override": ("override", "service"),
}
"""Faults and their device, by the event that raises them."""
_KEYS = ("id", "device", "sentence", "count")


def _latch(content: Mapping[str, Any]) -> Latch | None:
    problems: list[str] = []
    fields = Fields(dict(content), "", FILE, problems)
    latch = Latch(
        fields.text("id"),
        fields.text("device"),
        fields.text("sentence"),
        count=fields.integer("count", 1, minimum=1),
    )
    return None if problems else latch


def _newest_first(latch: Latch) -> int:
    return -latch.sequence

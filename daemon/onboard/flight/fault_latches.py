"""Active faults, and past faults that no operator has acknowledged.

Pure, except for the file that carries them over to the next start of the service.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from daemon.mission.canonical_json import RecordError, canonical_bytes, parse_record
from daemon.mission.record_types import LongText, Ordinal, read_record
from daemon.onboard.flight.event_table import Severity, entry_of

FILE = "unhandled-faults.json"
"""In the root of missions: the unacknowledged faults of the last run."""
FAULTS_MAX = 200
DELIVERING = frozenset({"opened", "recovered"})
UNAVAILABLE = frozenset({"absent", "lost", "silent", "held-by-another"})
"""Names of device events after which a device delivers, or does not. Other events report
problems of a device that delivers."""
SEARCHING, FIXED = "searching", "fixed"
"""The same for a receiver that is open: without a fix, and with one."""
FILE_MAX_BYTES = 1_000_000


@dataclass(frozen=True)
class LatchedFault:
    """A fault. `stands` is true while it is active; `previous` marks an earlier run.

    `code` is an event of `daemon.onboard.flight.event_table`, which has its severity, cause and
    action. `acknowledged_by` is the name and role of whoever acknowledged it. Times are those of
    the service's monotonic clock.
    """

    id: str
    device: str
    sentence: str
    stands: bool = True
    acknowledged: bool = False
    count: int = 1
    sequence: int = 0
    previous: bool = False
    code: str = ""
    severity: Severity = "warning"
    acknowledged_by: str = ""
    raised_mono_ns: str | None = None
    cleared_mono_ns: str | None = None


class FaultLatches:
    """Faults by their id; beyond `FAULTS_MAX` the oldest is dropped."""

    def __init__(self) -> None:
        self._latches: dict[str, LatchedFault] = {}
        self._code = ""
        self._mono_ns: str | None = None

    def raise_fault(
        self, fault: str, sentence: str, device: str = "", *, sequence: int = 0
    ) -> None:
        """Record a new or repeated fault."""
        known = self._latches.pop(fault, None)
        count = known.count + 1 if known else 1
        entry = entry_of(self._code)
        self._latches[fault] = LatchedFault(
            fault,
            device,
            sentence,
            count=count,
            sequence=sequence,
            code=self._code,
            severity="warning" if entry is None else entry.severity,
            raised_mono_ns=self._mono_ns,
        )
        while len(self._latches) > FAULTS_MAX:
            del self._latches[next(iter(self._latches))]

    def clear_fault(self, fault: str) -> None:
        """Record the end of a fault; it stays listed until it is acknowledged."""
        found = self._latches.get(fault)
        if found is None:
            return
        if found.acknowledged:
            del self._latches[fault]
        else:
            self._latches[fault] = replace(found, stands=False, cleared_mono_ns=self._mono_ns)

    def acknowledge(self, fault: str, by: str = "") -> bool:
        """Acknowledge a fault. A past fault is removed, an active one stays. False if unknown.

        `by` is the name and role of the person.
        """
        found = self._latches.get(fault)
        if found is None:
            return False
        if found.stands:
            self._latches[fault] = replace(found, acknowledged=True, acknowledged_by=by)
        else:
            del self._latches[fault]
        return True

    def apply(self, event: Mapping[str, Any], *, sequence: int = 0) -> None:
        """Raise or clear the faults that an event of the service implies."""
        kind, sentence = event.get("event"), str(event.get("sentence", ""))
        self._code = code_of(event)
        if event.get("mono_ns") is not None:
            self._mono_ns = str(event["mono_ns"])
        if kind == "device":
            self._apply_device(event, sentence, sequence)
        elif kind == "disk-dropped":
            label = str(event.get("disk"))
            self.raise_fault(f"disk {label}", sentence, f"disk {label}", sequence=sequence)
        elif kind == "disk-health":
            fault = f"health of disk {event.get('disk')}"
            if event.get("fault"):
                self.raise_fault(fault, sentence, f"disk {event.get('disk')}", sequence=sequence)
            else:
                self.clear_fault(fault)
        elif kind in ("disk-joined", "disk-released"):
            self.clear_fault(f"disk {event.get('disk')}")
        elif kind in ("deviation", "decisions") and not event.get("fault", kind == "decisions"):
            self.clear_fault(str(kind))
        elif kind in _FAULT_OF_EVENT:
            fault, device = _FAULT_OF_EVENT[kind]
            self.raise_fault(fault, sentence, device, sequence=sequence)
        elif kind == "page-link":
            self.raise_fault("page link", sentence, "service", sequence=sequence)
            self.clear_fault("page link")  # a single occurrence, not an active fault
        elif kind == "prerequisite":
            fault = f"prerequisite {event.get('item')}"
            self.raise_fault(fault, sentence, "service", sequence=sequence)
        elif kind == "lost":
            number, cause = event.get("number"), event.get("cause")
            description = f"Exposure {number}: {cause}"
            fault = f"exposure {number}"
            self.raise_fault(fault, description, "exposures", sequence=sequence)
            self.clear_fault(fault)  # a single occurrence, not an active fault
        elif kind == "ready":
            for absent in event.get("absent", []):
                description = f"Flying without {absent}. Check it."
                self.raise_fault(f"absent {absent}", description, str(absent), sequence=sequence)
        elif kind == "status":
            if event.get("exposures_left") and not event.get("is_disk_low"):
                self.clear_fault_if_active("disk")
            self._clear_present(event)
            self._clear_mirror(event)
            if event.get("missing") == []:
                self.clear_fault_if_active("override")
        elif kind == "triangulated":
            # It works again: the process was started again and takes in exposures.
            self.clear_fault_if_active("triangulation")
        elif kind == "previous-fault":
            latch = _latch(event)
            self.add_previous([latch] if latch else [], sequence=sequence)

    def _clear_present(self, event: Mapping[str, Any]) -> None:
        """Clear the faults of devices that were absent at the start and are present now."""
        if isinstance(absent := event.get("absent"), list):
            still = {f"absent {one}" for one in absent}
            for fault in [f for f in self._latches if f.startswith("absent ")]:
                if fault not in still and self._latches[fault].stands:
                    self.clear_fault(fault)

    def _clear_mirror(self, event: Mapping[str, Any]) -> None:
        """Clear the faults of the mirror once both disks are in use, and of a disk that is."""
        disks = event.get("disks")
        if not isinstance(disks, list) or len(disks) < 2:
            return
        for one in disks:
            if isinstance(one, Mapping) and one.get("state") == "in use":
                self.clear_fault_if_active(f"prerequisite disk {one.get('disk')}")
        if all(isinstance(one, Mapping) and one.get("state") == "in use" for one in disks):
            self.clear_fault_if_active("mirror")

    def clear_fault_if_active(self, fault: str) -> None:
        """Clear a fault that stands; a cleared one keeps the time at which it was cleared."""
        found = self._latches.get(fault)
        if found is not None and found.stands:
            self.clear_fault(fault)

    def _apply_device(self, event: Mapping[str, Any], sentence: str, sequence: int) -> None:
        device, name = str(event.get("device")), event.get("name")
        if device == "clock":
            # One device with several independent faults.
            fault = f"clock {name}"
            if event.get("fault"):
                self.raise_fault(fault, sentence, device, sequence=sequence)
            if not event.get("fault") or str(name).endswith("stepped"):
                self.clear_fault(fault)
        elif name in DELIVERING:
            self.clear_fault(f"device {device}")
        elif event.get("fault"):
            is_unavailable = name in UNAVAILABLE
            fault = f"device {device}" if is_unavailable else f"{name} {device}"
            self.raise_fault(fault, sentence, device, sequence=sequence)
            if not is_unavailable:
                self.clear_fault(fault)

    def add_previous(self, latches: Iterable[LatchedFault], *, sequence: int = 0) -> None:
        """Add the unacknowledged faults of an earlier run; they are no longer active."""
        for latch in latches:
            if latch.id not in self._latches:
                self._latches[latch.id] = replace(
                    latch, stands=False, acknowledged=False, sequence=sequence, previous=True
                )

    def listed(self) -> list[dict[str, Any]]:
        """All of them as plain JSON types, the newest first."""
        return [asdict(latch) for latch in sorted(self._latches.values(), key=_newest_first)]

    def unhandled(self) -> tuple[LatchedFault, ...]:
        """The unacknowledged faults, oldest first."""
        return tuple(latch for latch in self._latches.values() if not latch.acknowledged)

    def __contains__(self, fault: str) -> bool:
        return fault in self._latches


def unhandled_content(latches: Iterable[LatchedFault]) -> bytes:
    """The content of `FILE`: the unacknowledged faults."""
    entries = [{key: getattr(latch, key) for key in _KEYS} for latch in latches]
    return canonical_bytes({"faults": entries})


def read_unhandled(root: Path) -> tuple[LatchedFault, ...]:
    """The unacknowledged faults; empty if the file is missing or damaged."""
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
        for one in (listed if isinstance(listed, list) else [])[:FAULTS_MAX]
        if isinstance(one, Mapping) and (latch := _latch(one)) is not None
    )


def previous_faults(latches: Iterable[LatchedFault]) -> list[dict[str, Any]]:
    """Events that report faults of an earlier run."""
    return [
        {"event": "previous-fault", **{key: getattr(latch, key) for key in _KEYS}}
        for latch in latches
    ]


def code_of(event: Mapping[str, Any]) -> str:
    """The name of an event in the table of events; empty if it is not listed there.

    Args:
        event: an event of the service.

    Returns:
        The name that `syntopic explain` knows, for example "device/lost".

    Example:
        >>> code_of({"event": "device", "device": "SU02", "name": "lost"})
        'device/lost'
        >>> code_of({"event": "ready", "absent": ["trigger"]})
        'device/absent'
    """
    kind = str(event.get("event", ""))
    if kind == "ready":
        return "device/absent"
    name = f"device/{event.get('name')}" if kind == "device" else kind
    return name if entry_of(name) is not None else ""


_FAULT_OF_EVENT: Mapping[object, tuple[str, str]] = {
    "fault": ("service", "service"),
    "ledger": ("ledger", "service"),
    "disk": ("disk", "disk"),
    "mirror": ("mirror", "disk"),
    "not-written": ("disk", "disk"),
    "power": ("power", "power"),
    "override": ("override", "service"),
    "deviation": ("deviation", "guidance"),
    "decisions": ("decisions", "service"),
    "triangulation-failed": ("triangulation", "triangulation"),
}
"""Faults and their device, by the event that raises them."""
_KEYS = ("id", "device", "sentence", "count", "code", "severity")


class _SavedFault(BaseModel):
    id: LongText
    device: LongText
    sentence: LongText
    count: Ordinal = 1
    code: LongText = ""
    severity: Severity = "warning"


def _latch(content: Mapping[str, Any]) -> LatchedFault | None:
    try:
        return LatchedFault(**vars(read_record(_SavedFault, content, FILE)))
    except RecordError:
        return None


def _newest_first(latch: LatchedFault) -> int:
    return -latch.sequence

"""Decisions are appended, survive a restart, and a damaged file is reported and never replaced."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from daemon.mission.canonical_json import RecordError
from daemon.mission.operator_decisions import (
    DECISIONS_FILE,
    OperatorDecision,
    decisions_content,
    manual_verdicts,
    read_decisions,
)
from daemon.onboard.flight.fault_latches import FaultLatches
from daemon.onboard.service.operator_journal import OperatorJournal
from daemon.planning.model import Plan, PlannedLine
from daemon.planning.retakes import RetakeError, retake_line
from tests.daemon.planning.test_steering import line


class Line:
    def __init__(self) -> None:
        self.plan, self.added = Plan("test", (line("A1", 0.0),)), list[str]()

    def add_retake(self, line_id: str, from_m: float, to_m: float) -> PlannedLine:
        found = retake_line(
            self.plan, line_id, from_m, to_m, distance_m=100.0, taken=tuple(self.added)
        )
        self.added.append(found.id)
        return found


class Bench:
    def __init__(self, folder: Path) -> None:
        self.folder, self.line, self.is_full = folder, Line(), False
        self.events: list[dict[str, Any]] = []
        self.journal = OperatorJournal(folder, self.line, self.save, self.emit, lambda: 9)

    def save(self, content: bytes) -> None:
        if self.is_full:
            raise OSError(28, "No space left on device")
        (self.folder / DECISIONS_FILE).write_bytes(content)

    def emit(self, event: str, **content: Any) -> None:
        self.events.append({"event": event, **content})

    def retake(self, from_m: float) -> str:
        return self.journal.retake(
            "A1", from_m, from_m, number=3, reason="", by="anna", role="operator"
        )


def test_decisions_are_kept_next_to_the_computed_verdict(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.journal.note({"event": "processed", "number": 7, "report": {"verdict": "usable"}})
    assert bench.journal.decide("reject", 7, "haze", "anna", "operator") is None
    assert bench.journal.decide("accept", 8, " seen ", "ben", "administrator") is None
    first, second = read_decisions(tmp_path)
    assert (first.kind, first.number, first.computed, first.reason) == (
        "reject",
        7,
        "usable",
        "haze",
    )
    assert (second.by, second.role, second.reason, second.computed) == (
        "ben", "administrator", "seen", None,
    )  # fmt: skip
    assert bench.events[0]["manual"]["by"] == "anna"
    again = Bench(tmp_path)
    assert again.journal.decide("withdraw", 7, "", "ben", "operator") is None
    assert len(read_decisions(tmp_path)) == 3
    assert set(manual_verdicts(read_decisions(tmp_path))) == {8}
    assert again.events[-1]["manual"] is None


@pytest.mark.parametrize(
    ("kind", "number", "reason", "why"),
    [
        ("accept", 3, "  ", "needs a reason"),
        ("reject", 10, "x", "no exposure 10"),
        ("reject", 0, "x", "no exposure 0"),
        ("reject", None, "x", "needs the number"),
        ("withdraw", 3, "", "no manual verdict"),
    ],
)
def test_decisions_without_ground_are_refused(
    tmp_path: Path, kind: Any, number: int | None, reason: str, why: str
) -> None:
    bench = Bench(tmp_path)
    refusal = bench.journal.decide(kind, number, reason, "anna", "operator")
    assert refusal is not None
    assert why in refusal
    assert not (tmp_path / DECISIONS_FILE).exists()


def test_a_decision_that_was_not_saved_does_not_count(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.is_full = True
    assert "disk refused" in (bench.journal.decide("reject", 3, "", "anna", "operator") or "")
    assert (bench.journal.decisions, bench.events) == ((), [])


def test_retakes_are_planned_again_after_a_restart(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    assert (bench.retake(300.0), bench.retake(500.0)) == ("A1 R1", "A1 R2")
    assert bench.events[0]["places_m"] == [50.0]
    again = Bench(tmp_path)
    assert again.line.added == ["A1 R1", "A1 R2"]
    assert [one["line"] for one in again.events] == ["A1 R1", "A1 R2"]


@pytest.mark.trust
@pytest.mark.parametrize(
    "content",
    [b"", b"{", b'{"decisions":[],"format":9}', b'{"decisions":[{"kind":"praise"}],"format":1}'],
)
def test_a_damaged_file_is_kept_and_nothing_is_accepted(tmp_path: Path, content: bytes) -> None:
    (tmp_path / DECISIONS_FILE).write_bytes(content)
    with pytest.raises(RecordError):
        read_decisions(tmp_path)
    bench = Bench(tmp_path)
    assert bench.events[0]["fault"] is True
    assert "refused" in (bench.journal.decide("reject", 3, "", "anna", "operator") or "")
    with pytest.raises(RetakeError):
        bench.retake(300.0)
    assert (tmp_path / DECISIONS_FILE).read_bytes() == content


def test_the_file_is_canonical_and_omits_what_is_empty() -> None:
    one = OperatorDecision("reject", "anna", "operator", "2026-05-01T10:00:00Z", 7)
    assert decisions_content([one]) == (
        b'{"decisions":[{"by":"anna","kind":"reject","number":7,"role":"operator",'
        b'"utc":"2026-05-01T10:00:00Z"}],"format":1}\n'
    )


def test_a_disk_that_takes_decisions_again_clears_their_fault(tmp_path: Path) -> None:
    bench, latches = Bench(tmp_path), FaultLatches()
    bench.is_full = True
    bench.retake(100.0)
    bench.is_full = False
    bench.retake(300.0)
    bench.retake(500.0)
    reports = [event for event in bench.events if event["event"] == "decisions"]
    assert [event["fault"] for event in reports] == [True, False]
    latches.apply(reports[0])
    assert latches.listed()[0]["stands"]
    latches.apply(reports[1])
    assert not latches.listed()[0]["stands"]

"""Decisions of operators in flight: manual verdicts and retakes, saved in the mission at once.

The file is described in `daemon.mission.operator_decisions`. A decision counts only after it is
saved; the computed verdict, the record and the products stay as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from daemon.mission.canonical_json import RecordError
from daemon.mission.operator_decisions import (
    DECISIONS_FILE,
    DECISIONS_MAX,
    DecisionKind,
    OperatorDecision,
    decisions_content,
    manual_verdicts,
    read_decisions,
    summary_of,
    utc_now,
)
from daemon.onboard.service.messages import EmitEvent
from daemon.planning.model import PlannedLine
from daemon.planning.retakes import RetakeError

VERDICTS_NOTED_MAX = 20_000


class RetakeTarget(Protocol):
    """The flight line; `daemon.onboard.service.flight_line.FlightLine`."""

    def add_retake(self, line_id: str, from_m: float, to_m: float) -> PlannedLine: ...


class OperatorJournal:
    """The decisions of one mission.

    Args:
        mission: the mission folder; decisions of an earlier run are read from it.
        line: takes retakes.
        save: writes the content of the file to every disk in use.
        emit: emits an event.
        last_number: number of the last triggered exposure.
    """

    def __init__(
        self,
        mission: Path,
        line: RetakeTarget,
        save: Callable[[bytes], None],
        emit: EmitEvent,
        last_number: Callable[[], int],
    ) -> None:
        self._line = line
        self._save = save
        self._emit = emit
        self._last_number = last_number
        self._computed: dict[int, str] = {}
        self._was_refused = False
        self.problem = ""
        """Why no decision is accepted; empty if they are."""
        try:
            self._decisions = list(read_decisions(mission))
        except RecordError as error:
            self._decisions = []
            self.problem = (
                f"{error}. Manual verdicts and retakes are refused in this mission; after landing "
                f"keep a copy of {DECISIONS_FILE} and ask for help"
            )
            emit("decisions", fault=True, sentence=self.problem)
        for one in self._decisions:
            if one.kind == "retake":
                self._resume(one)

    @property
    def decisions(self) -> Sequence[OperatorDecision]:
        """All decisions, oldest first."""
        return tuple(self._decisions)

    def note(self, event: Mapping[str, Any]) -> None:
        """Note the computed verdict of an event of the service."""
        report = event.get("report")
        if isinstance(report, Mapping) and isinstance(verdict := report.get("verdict"), str):
            self._computed[int(event["number"])] = verdict
            while len(self._computed) > VERDICTS_NOTED_MAX:
                del self._computed[next(iter(self._computed))]

    def decide(
        self, kind: DecisionKind, number: int | None, reason: str, by: str, role: str
    ) -> str | None:
        """Record a manual verdict.

        Args:
            kind: "reject", "accept" or "withdraw".
            number: the exposure.
            reason: why; an acceptance needs one.
            by: name of the author.
            role: role of the author.

        Returns:
            The reason of a refusal; None if it is recorded.
        """
        reason = reason.strip()
        if number is None:
            return f"{kind} needs the number of an exposure"
        if not 1 <= number <= self._last_number():
            return f"there is no exposure {number}; the last one is {self._last_number()}"
        if kind == "accept" and not reason:
            return "accept needs a reason, which is recorded next to the computed verdict"
        holding = manual_verdicts(self._decisions).get(number)
        if kind == "withdraw" and holding is None:
            return f"exposure {number} has no manual verdict"
        decision = OperatorDecision(
            kind, by, role, utc_now(), number, reason, self._computed.get(number)
        )
        refusal = self._append(decision)
        if refusal is None:
            summary = None if kind == "withdraw" else summary_of(decision)
            self._emit("manual-verdict", number=number, by=by, manual=summary)
        return refusal

    def retake(
        self,
        line: str,
        from_m: float,
        to_m: float,
        *,
        number: int | None,
        reason: str,
        by: str,
        role: str,
    ) -> str:
        """Add a retake to the lines of the flight, and record it.

        Args:
            line: id of the planned line.
            from_m: first station, m from the start of the line.
            to_m: last station, m.
            number: the exposure that is repeated, if it is a single one.
            reason: why; may be empty.
            by: name of the author.
            role: role of the author.

        Returns:
            Id of the added line.

        Raises:
            RetakeError: it cannot be flown or recorded.
        """
        if self.problem or len(self._decisions) >= DECISIONS_MAX:
            raise RetakeError(self.problem or _full())
        added = self._line.add_retake(line, from_m, to_m)
        decision = OperatorDecision(
            "retake", by, role, utc_now(), number, reason.strip(), self._computed.get(number or 0),
            line, float(from_m), float(to_m), added.id,
        )  # fmt: skip
        if (refusal := self._append(decision)) is not None:
            self._emit("decisions", fault=True, sentence=refusal)
        self._emit_retake(added, line, by, number)
        return added.id

    def _append(self, decision: OperatorDecision) -> str | None:
        if self.problem or len(self._decisions) >= DECISIONS_MAX:
            return self.problem or _full()
        try:
            self._save(decisions_content([*self._decisions, decision]))
        except OSError as error:
            self._was_refused = True
            return f"the disk refused {DECISIONS_FILE} ({error.strerror}); repeat the command"
        self._decisions.append(decision)
        if self._was_refused:
            self._was_refused = False
            self._emit("decisions", fault=False, sentence="Decisions are recorded again.")
        return None

    def _resume(self, one: OperatorDecision) -> None:
        """Plan the retake of an earlier run again."""
        try:
            added = self._line.add_retake(one.line, one.from_m or 0.0, one.to_m or 0.0)
        except RetakeError as error:
            self._emit("decisions", fault=True, sentence=f"a retake is not flown: {error}")
            return
        self._emit_retake(added, one.line, one.by, one.number)

    def _emit_retake(self, added: PlannedLine, of: str, by: str, number: int | None) -> None:
        self._emit(
            "retake",
            line=added.id,
            of=of,
            number=number,
            by=by,
            at=[list(added.start), list(added.end)],
            places_m=[round(place, 1) for place in added.at_m],
        )


def _full() -> str:
    return f"{DECISIONS_FILE} holds {DECISIONS_MAX} decisions, which is the limit"

"""Results of the checks of `syntopic check` and of the start of the service.

`syntopic run` and `syntopic check` use the same check functions.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any


class CheckOutcome(enum.StrEnum):
    """Outcome of the check of one item."""

    PASS = "pass"
    WAITING = "waiting"
    """Not a fault: data are still awaited, for example from a receiver that searches."""
    FAIL = "fail"
    NOT_TRIED = "not tried"
    """Not checked, because that requires an option; it does not affect the result."""


@dataclass(frozen=True)
class CheckResult:
    """One item: its kind and name, the outcome, and a sentence where it is not a plain pass.

    `is_blocking`: `syntopic run` refuses to start, with the same sentence. Any other failure is
    emitted as an event with the same sentence, and the service flies without the item. `found` are
    the properties that the item reported (model, serial, ...).
    """

    kind: str
    name: str
    outcome: CheckOutcome
    sentence: str = ""
    is_blocking: bool = False
    found: Mapping[str, str] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """As plain JSON types."""
        return {
            "kind": self.kind,
            "name": self.name,
            "outcome": self.outcome.value,
            "sentence": self.sentence,
            "prevents": self.is_blocking,
            "found": dict(self.found),
        }


def worst_outcome(results: Iterable[CheckResult]) -> CheckOutcome:
    """The worst of all: FAIL, else WAITING, else PASS."""
    outcomes = {result.outcome for result in results}
    worst = (CheckOutcome.FAIL, CheckOutcome.WAITING)
    return next((outcome for outcome in worst if outcome in outcomes), CheckOutcome.PASS)


def passed(kind: str, name: str, sentence: str = "", **found: str) -> CheckResult:
    """An item that is in order."""
    return CheckResult(kind, name, CheckOutcome.PASS, sentence, found=found)


def failed(kind: str, name: str, sentence: str, *, is_blocking: bool = False) -> CheckResult:
    """An item that is not in order; the sentence ends with the action."""
    return CheckResult(kind, name, CheckOutcome.FAIL, sentence, is_blocking=is_blocking)

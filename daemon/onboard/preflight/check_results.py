"""What was found of each thing a flight needs: the results of `syntopic check`, and of a start.

`syntopic run` and `syntopic check` look with the same functions; here is only what they return.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final


class CheckOutcome(enum.StrEnum):
    """What was found of one item."""

    PASS = "pass"
    WAITING = "waiting"
    """Nothing is wrong; it is not there yet, such as a receiver that searches."""
    FAIL = "fail"
    NOT_TRIED = "not tried"
    """It could not be looked at without doing more than was asked for; it decides nothing."""


@dataclass(frozen=True)
class CheckResult:
    """One item: its kind and name, the outcome, and a sentence where it is not a plain pass.

    `prevents`: `syntopic run` refuses to start because of it, with the same sentence. Any other
    failure is reported as an event with the same sentence, and the service flies without.
    `found` is what the item said of itself (model, serial, ...).
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


EXIT_STATUS: Final[Mapping[CheckOutcome, int]] = {
    CheckOutcome.PASS: 0,
    CheckOutcome.FAIL: 1,
    CheckOutcome.WAITING: 3,
}
"""Of `syntopic check`; 2 is a configuration that is refused."""


def worst_outcome(results: Iterable[CheckResult]) -> CheckOutcome:
    """The worst of all: FAIL, else WAITING, else PASS."""
    outcomes = {result.outcome for result in results}
    worst = (CheckOutcome.FAIL, CheckOutcome.WAITING)
    return next((outcome for outcome in worst if outcome in outcomes), CheckOutcome.PASS)


def passed(kind: str, name: str, sentence: str = "", **found: str) -> CheckResult:
    """An item that is in order."""
    return CheckResult(kind, name, CheckOutcome.PASS, sentence, found=found)


def failed(kind: str, name: str, sentence: str, *, is_blocking: bool = False) -> CheckResult:
    """An item that is not in order; the sentence ends with the cure."""
    return CheckResult(kind, name, CheckOutcome.FAIL, sentence, is_blocking=is_blocking)

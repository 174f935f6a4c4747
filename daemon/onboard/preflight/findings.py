"""What was found of each thing a flight needs: the results of `syntopic check`, and of a start.

`syntopic run` and `syntopic check` look with the same functions; here is only what they return.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final


class Outcome(enum.StrEnum):
    """What was found of one item."""

    PASS = "pass"
    WAITING = "waiting"
    """Nothing is wrong; it is not there yet, such as a receiver that searches."""
    FAIL = "fail"
    NOT_TRIED = "not tried"
    """It could not be looked at without doing more than was asked for; it decides nothing."""


@dataclass(frozen=True)
class Finding:
    """One item: its kind and name, the outcome, and a sentence where it is not a plain pass.

    `prevents`: `syntopic run` refuses to start because of it, with the same sentence. Any other
    failure is reported as an event with the same sentence, and the service flies without.
    `found` is what the item said of itself (model, serial, ...).
    """

    kind: str
    name: str
    outcome: Outcome
    sentence: str = ""
    prevents: bool = False
    found: Mapping[str, str] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """As plain JSON types."""
        return {
            "kind": self.kind,
            "name": self.name,
            "outcome": self.outcome.value,
            "sentence": self.sentence,
            "prevents": self.prevents,
            "found": dict(self.found),
        }


EXIT_STATUS: Final[Mapping[Outcome, int]] = {
    Outcome.PASS: 0,
    Outcome.FAIL: 1,
    Outcome.WAITING: 3,
}
"""Of `syntopic check`; 2 is a configuration that is refused."""


def overall(findings: Iterable[Finding]) -> Outcome:
    """The worst of all: FAIL, else WAITING, else PASS."""
    outcomes = {finding.outcome for finding in findings}
    worst = (Outcome.FAIL, Outcome.WAITING)
    return next((outcome for outcome in worst if outcome in outcomes), Outcome.PASS)


def passed(kind: str, name: str, sentence: str = "", **found: str) -> Finding:
    """An item that is in order."""
    return Finding(kind, name, Outcome.PASS, sentence, found=found)


def failed(kind: str, name: str, sentence: str, *, prevents: bool = False) -> Finding:
    """An item that is not in order; the sentence ends with the cure."""
    return Finding(kind, name, Outcome.FAIL, sentence, prevents=prevents)

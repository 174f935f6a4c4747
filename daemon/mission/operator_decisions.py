"""`operator-decisions.json`: what operators decided about exposures, next to the computed verdicts.

Entries are only appended. Records and products stay as they are: the file states who rejected or
accepted which exposure, when and why, and which retakes were requested. The closing line of
`chain.jsonl` has its hash.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from daemon.mission.canonical_json import (
    RECORD_MAX_BYTES,
    RecordError,
    canonical_bytes,
    parse_record,
)
from daemon.mission.record_types import Count, Finite, LongText, Ordinal, read_record

DECISIONS_FILE: Final = "operator-decisions.json"
DECISIONS_FORMAT: Final = 1
DECISIONS_MAX: Final = 4000

DecisionKind = Literal["reject", "accept", "withdraw", "retake"]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class OperatorDecision:
    """One decision. `withdraw` returns an exposure to its computed verdict.

    `computed` is the verdict that was known when it was decided. A retake has `line`, the segment
    `from_m` to `to_m` from the start of the line, and the id `retake` of the added line.
    """

    kind: DecisionKind
    by: LongText
    role: LongText
    utc: LongText
    number: Ordinal | None = None
    reason: LongText = ""
    computed: LongText | None = None
    line: LongText = ""
    from_m: Finite | None = None
    to_m: Finite | None = None
    retake: LongText = ""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class _DecisionFile:
    format: Annotated[Count, Field(le=DECISIONS_FORMAT)]
    decisions: Annotated[tuple[OperatorDecision, ...], Field(max_length=DECISIONS_MAX)]


def utc_now() -> str:
    """The present time as in the file, to the second."""
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def decisions_content(decisions: Iterable[OperatorDecision]) -> bytes:
    """The content of the file."""
    listed = [
        {key: value for key, value in asdict(one).items() if value not in ("", None)}
        for one in decisions
    ]
    return canonical_bytes({"format": DECISIONS_FORMAT, "decisions": listed})


def read_decisions(mission: Path) -> tuple[OperatorDecision, ...]:
    """The decisions of a mission, oldest first; none where there is no file.

    Args:
        mission: the mission folder.

    Returns:
        The decisions.

    Raises:
        RecordError: the file is damaged, or of a later format.
    """
    path = mission / DECISIONS_FILE
    try:
        if path.stat().st_size > RECORD_MAX_BYTES:
            raise RecordError([f"{DECISIONS_FILE} is larger than {RECORD_MAX_BYTES} bytes"])
        content = parse_record(path.read_bytes(), DECISIONS_FILE)
    except FileNotFoundError:
        return ()
    except OSError as error:
        raise RecordError([f"{DECISIONS_FILE}: cannot be read ({error.strerror})"]) from error
    return read_record(_DecisionFile, content, DECISIONS_FILE).decisions


def manual_verdicts(decisions: Sequence[OperatorDecision]) -> Mapping[int, OperatorDecision]:
    """The decision that holds for each exposure: the last `reject` or `accept` not withdrawn.

    Args:
        decisions: oldest first.

    Returns:
        The decisions by number of the exposure.

    Example:
        >>> one = OperatorDecision("reject", "anna", "operator", "2026-05-01T10:00:00Z", 7)
        >>> manual_verdicts([one])[7].kind
        'reject'
    """
    holding: dict[int, OperatorDecision] = {}
    for one in decisions:
        if one.number is None or one.kind == "retake":
            continue
        if one.kind == "withdraw":
            holding.pop(one.number, None)
        else:
            holding[one.number] = one
    return holding


def summary_of(decision: OperatorDecision) -> dict[str, Any]:
    """A manual verdict as telemetry, reports and tables show it."""
    return {
        "kind": decision.kind,
        "by": decision.by,
        "role": decision.role,
        "utc": decision.utc,
        "reason": decision.reason,
    }

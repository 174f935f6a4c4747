"""The performance gate of `make bench`: CPU time of the pipeline against the record.

Ratios to a copy of the same bytes and to a bare cv2.remap, medians of runs in turn, hardly depend
on the load of a machine. They do depend on its processor, so each has rows of its own.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from benchmarks.records import FOLDER, read_record

RECORD: Final = FOLDER / "performance-gate.json"
TOLERANCE: Final = 0.10
COMMAND: Final = "python -m benchmarks.mini --accept"
_COLUMNS: Final = ["processor", "over", "CPU time of the pipeline"]


def compared(ratios: Mapping[str, float], processor: str, record: Path = RECORD) -> dict[str, Any]:
    """Compare measured ratios with those of the record.

    Args:
        ratios: CPU time of the pipeline over that of a task, by its name.
        processor: model of the processor they were measured on.
        record: file of the record.

    Returns:
        `slower`: names of the tasks whose ratio is more than `TOLERANCE` above the record's;
        `sentences`: what was found, one for each ratio.

    Raises:
        RecordError: the record cannot be read.
    """
    known = {(row[0], row[1]): float(row[2]) for row in _rows(record)}
    slower, sentences = [], []
    for name, ratio in ratios.items():
        limit = known.get((processor, name))
        if limit is None:
            sentences.append(
                f"{name}: {ratio:.2f}; the record has no figure for {processor}, so nothing was "
                f"compared. Run `{COMMAND}` to add it."
            )
            continue
        change = ratio / limit - 1.0
        sentence = f"{name}: {ratio:.2f}, record {limit:.2f} ({change:+.0%})"
        if change > TOLERANCE:
            slower.append(name)
            sentence += (
                f". That is slower by more than {TOLERANCE:.0%}: find the change, or run "
                f"`{COMMAND}` and give the reason in the commit."
            )
        sentences.append(sentence)
    return {"slower": slower, "sentences": sentences}


def accept(ratios: Mapping[str, float], processor: str, cores: int, record: Path = RECORD) -> None:
    """Write measured ratios into the record; rows of other processors stay.

    Args:
        ratios: as of `compared`.
        processor: model of the processor.
        cores: number of its cores.
        record: file of the record.

    Raises:
        RecordError: the record cannot be read.
    """
    rows = [list(row) for row in _rows(record) if row[0] != processor]
    rows += [[processor, name, f"{ratio:.2f}"] for name, ratio in ratios.items()]
    content = {
        "date": [f"{datetime.now(UTC):%Y-%m-%d}"],
        "command": COMMAND,
        "machine": f"{processor}, {cores} cores",
        "conditions": "CPU seconds, median of runs in turn",
        "figures": [{"table": {"columns": _COLUMNS, "rows": sorted(rows)}}],
    }
    record.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _rows(record: Path) -> list[tuple[str, ...]]:
    if not record.exists():
        return []
    return [row for part in read_record(record).figures if part.table for row in part.table.rows]

"""The performance gate of `make bench`: the pace of the pipeline against the record.

Ratios to a copy of the same bytes and to a bare cv2.remap, medians of runs in turn, hardly depend
on the load of a machine; that of elapsed time does where others use its cores. They do depend on
its processor and on the ground of the exposure, so each has rows of its own.
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
RUNS: Final = 5
"""Runs of the pipeline, a copy and a remap in turn whose medians are compared, at least."""
COMMAND: Final = "python -m benchmarks.mini --accept"
SLOWER, NOT_COMPARED = 1, 3
"""Exit status where a ratio is above its record, and where there is no record of it."""
_COLUMNS: Final = ["processor", "ground", "over", "pipeline", "cores", "date"]
_KEY, _RATIO, _DATE = slice(0, 3), 3, 5


def processor_name(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """Name of the processor with its family and model.

    Virtual machines give several generations the same name.

    Args:
        cpuinfo: file of the kernel.

    Returns:
        "AMD EPYC, family 26, model 2".
    """
    known: dict[str, str] = {}
    for line in cpuinfo.read_text(encoding="utf-8").splitlines():
        key, _, value = line.partition(":")
        known.setdefault(key.strip(), value.strip())
    parts = [known.get("model name") or known.get("CPU part") or "unknown"]
    parts += [f"{name[4:]} {known[name]}" for name in ("cpu family",) if name in known]
    parts += [f"{name} {known[name]}" for name in ("model",) if name in known]
    return ", ".join(parts)


def ratios_of(timed: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """What the pipeline takes over what the tasks take that ran in turn with it.

    Args:
        timed: by task as of `daemon.cli.benchmark.measurement.interleaved`: the pipeline is
            "process", with all files of an exposure "products".

    Returns:
        Ratios of the medians: of CPU time to a copy and to a remap, of CPU time with all files and
        of elapsed time to a remap.
    """
    own, remap = timed["process"], timed["remap"]
    return {
        "copy": own["median_cpu_s"] / timed["copy"]["median_cpu_s"],
        "remap": own["median_cpu_s"] / remap["median_cpu_s"],
        "remap, with files": timed["products"]["median_cpu_s"] / remap["median_cpu_s"],
        "remap, elapsed": own["median_s"] / remap["median_s"],
    }


def compared(
    ratios: Mapping[str, float], processor: str, ground: str, record: Path = RECORD
) -> dict[str, Any]:
    """Compare measured ratios with those of the record.

    Args:
        ratios: as of `ratios_of`.
        processor: by `processor_name`, the one they were measured on.
        ground: of the exposure.
        record: file of the record.

    Returns:
        `slower`: names of the tasks whose ratio is more than `TOLERANCE` above the record's;
        `faster`: of those as far below it; `unknown`: of those without a record; `status`: the
        exit status; `sentences`: what was found, one for each ratio.

    Raises:
        RecordError: the record cannot be read.
    """
    known = {row[_KEY]: float(row[_RATIO]) for row in _rows(record)}
    slower, faster, unknown, sentences = [], [], [], []
    for name, ratio in ratios.items():
        limit = known.get((processor, ground, name))
        if limit is None:
            unknown.append(name)
            sentences.append(
                f"{name}: {ratio:.2f}; the record has no figure for {processor} over {ground}, so "
                f"nothing was compared. Run `{COMMAND}` on a state that is known to be fast to add "
                "it."
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
        elif change < -TOLERANCE:
            faster.append(name)
            sentence += (
                f". That is faster by more than {TOLERANCE:.0%}: run `{COMMAND}`, or a change to "
                "the old pace passes."
            )
        sentences.append(sentence)
    status = SLOWER if slower else NOT_COMPARED if unknown else 0
    return {
        "slower": slower,
        "faster": faster,
        "unknown": unknown,
        "status": status,
        "sentences": sentences,
    }


def accept(
    ratios: Mapping[str, float], processor: str, ground: str, cores: int, record: Path = RECORD
) -> None:
    """Write measured ratios into the record; rows of other processors and grounds stay.

    Args:
        ratios: as of `compared`.
        processor: by `processor_name`.
        ground: of the exposure.
        cores: number of cores of the machine.
        record: file of the record.

    Raises:
        RecordError: the record cannot be read.
    """
    today = f"{datetime.now(UTC):%Y-%m-%d}"
    rows = [list(row) for row in _rows(record) if row[:2] != (processor, ground)]
    rows += [
        [processor, ground, name, f"{ratio:.2f}", str(cores), today]
        for name, ratio in ratios.items()
    ]
    content = {
        "date": sorted({row[_DATE] for row in rows}),
        "command": COMMAND,
        "machine": "each row's",
        "conditions": f"CPU seconds unless elapsed, medians of {RUNS} runs in turn or more",
        "figures": [{"table": {"columns": _COLUMNS, "rows": sorted(rows)}}],
    }
    record.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _rows(record: Path) -> list[tuple[str, ...]]:
    if not record.exists():
        return []
    return [row for part in read_record(record).figures if part.table for row in part.table.rows]

"""Files common to every kind of Level-2: report, quick look and files by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

from processing.quality import valid_area
from processing.quality.report import QualityReport, as_json
from processing.quality.valid_area import ValidArea

Contents: TypeAlias = dict[str, Sequence[bytes | memoryview]]
ProductFiles: TypeAlias = tuple[dict[str, Any], Contents]
"""The content of quality.json, and the parts of every file by its name."""

FramesRead: TypeAlias = Callable[[], None] | None
"""Called once the pixels of the frames are no longer needed."""


def report_json(
    report: QualityReport, number: int, timings_s: Mapping[str, float], area: ValidArea
) -> dict[str, Any]:
    """The content of quality.json, as far as it is the same for every rig."""
    timings = {stage: round(seconds, 4) for stage, seconds in timings_s.items()}
    return {
        **as_json(report),
        "exposure": number,
        "timings_s": timings,
        "valid_area": valid_area.as_json(area),
    }

"""Common parts of the reports of all laboratory calibrations: series, parts, comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from daemon.postflight.calibration.calibration_report import (
    CalibrationReport,
    Previous,
    Quantity,
    changes_between,
    serial_warnings,
)
from daemon.postflight.calibration.laboratory.laboratory_series import (
    LaboratorySeries,
    part_serials,
)


def of_series(
    report: CalibrationReport,
    series: LaboratorySeries[Any],
    *,
    sensors: set[str],
    previous: tuple[Path, Previous] | None,
    compared: Sequence[Quantity] | None = None,
) -> CalibrationReport:
    """A calibration's own report with what it was made from, and what has changed.

    Args:
        report: its own facts, figures, sentences and sheets.
        sensors: whose serial numbers, and their lenses', belong to it.
        previous: an earlier calibration and its folder.
        compared: what is compared with that; all quantities if omitted.
    """
    rig = series.rig
    serials = {**series.file.serials, **part_serials(rig, sensors), **report.serials}
    warnings = list(report.warnings)
    if series.file.simulated:
        warnings.append("Emulated images: no calibration of a real camera.")
    if previous is not None:
        warnings += serial_warnings(previous[1], serials)
        changes = changes_between(
            previous[1].quantities, report.quantities if compared is None else compared
        )
        report = replace(report, previous=previous[1].calibration_id, changes=changes)
    return replace(
        report,
        facts=[
            ("measured", series.file.date),
            ("source", series.file.source),
            ("rig", f"{rig.name}, calibration {rig.calibration_id}"),
            *report.facts,
        ],
        serials=serials,
        warnings=warnings,
    )

"""Output of a calibration command: the folder, verdicts and comparison."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import typer

from daemon.terminal.console import Console, light_table

if TYPE_CHECKING:
    from daemon.postflight.calibration.calibration_report import (
        CalibrationFolder,
        CalibrationReport,
    )

_MAX_ROWS = 40


def publish_calibration(
    report: CalibrationReport,
    place: CalibrationFolder,
    *,
    files: Mapping[str, bytes] | None = None,
    rig_file: Callable[[str], bytes] | None = None,
    as_json: bool,
) -> None:
    """Write the calibration as a new folder and print it, as text or one JSON object.

    The report's id is `place.name`; a digest of the content is appended. `rig_file` builds
    `rig.toml` from the complete id.
    """
    from daemon.configuration.schemas import SCHEMA_FILES, schema_file_name
    from daemon.postflight.calibration.calibration_report import (
        calibration_json,
        with_content_id,
        write_calibration,
    )

    report, files = with_content_id(report, files or {}, rig_file)
    if rig_file is not None:
        files[schema_file_name("rig")] = SCHEMA_FILES["rig"].read_bytes()
    folder = place.of(report.calibration_id)
    # The same content has the same id: it is there already.
    if place.folder is not None or not folder.exists():
        write_calibration(folder, report, files)
    if as_json:
        typer.echo(json.dumps({**calibration_json(report), "written": str(folder)}))
        return
    console = Console()
    console.print(f"{report.title}", highlight=False)
    for sentence in report.verdicts:
        console.print(sentence, markup=False, highlight=False)
    for sentence in report.warnings:
        console.print(sentence, style="yellow", markup=False, highlight=False)
    if report.changes:
        significant = [c for c in report.changes if c.significant]
        console.print(
            f"Against {report.previous}: {len(significant)} of {len(report.changes)} changes are "
            "significant",
            highlight=False,
        )
        if significant:
            columns = ("old", "new", "sigma", "unit", "t")
            table = light_table("Significant changes", ("", "quantity"), columns)
            for c in significant[:_MAX_ROWS]:
                table.add_row(
                    c.where,
                    c.what,
                    f"{c.old:.6g}",
                    f"{c.new:.6g}",
                    f"{c.sigma or 0.0:.2g}",
                    c.unit,
                    f"{c.t or 0.0:.1f}",
                )
            console.print(table)
            if len(significant) > _MAX_ROWS:
                console.print(f"and {len(significant) - _MAX_ROWS} more in the report")
    console.print(f"Calibration: {folder}, report {folder / 'report.html'}", soft_wrap=True)

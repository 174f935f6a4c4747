"""What `syntopic process` prints, by the kind of image that was made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from daemon.terminal.console import Console, light_table
from processing.quality.figures import QualityFigures
from processing.quality.figures.stitching import (
    AdjustmentFigures,
    BandShiftFigures,
    MethodFigures,
    TiePointFigures,
)

Reports = Sequence[Mapping[str, Any]]


def print_reports(console: Console, title: str, reports: Reports) -> None:
    """One table for all exposures, in the columns that their method has figures for, and beneath it
    why an exposure is not good."""
    methods = {_figures(report).of(MethodFigures).method for report in reports}
    show = _heads if "heads" in methods else _bands if "bands" in methods else _stitched
    show(console, title, reports)
    for report in reports:
        for finding in report["findings"]:
            if finding["verdict"] != "good":
                line = f"Exposure {report['exposure']}: {finding['sentence']}"
                console.print(line, markup=False, highlight=False)


def _stitched(console: Console, title: str, reports: Reports) -> None:
    table = light_table(
        title, (), ("exposure", "tie points", "sigma0 px", "sigma0 um", "verdict", "s")
    )
    for report in reports:
        figures = _figures(report)
        adjustment, points = figures.of(AdjustmentFigures), figures.of(TiePointFigures)
        table.add_row(
            str(report["exposure"]),
            f"{points.tie_points_pp or 0} + {points.tie_points_pc or 0}",
            _px(adjustment.sigma0_px, 3),
            _px(adjustment.sigma0_um, 2),
            report["verdict"],
            f"{report['duration_s']:.1f}",
        )
    console.print(table)


def _heads(console: Console, title: str, reports: Reports) -> None:
    table = light_table(title, ("exposure", "heads"), ("verdict", "s"))
    for report in reports:
        heads, seconds = ", ".join(report["heads"]), f"{report['duration_s']:.1f}"
        table.add_row(str(report["exposure"]), heads, report["verdict"], seconds)
    console.print(table)


def _bands(console: Console, title: str, reports: Reports) -> None:
    table = light_table(
        title,
        (),
        ("exposure", "band", "tie points", "largest shift", "rms px", "rms x", "rms y", "verdict"),
    )
    for report in reports:
        shifts_px = _figures(report).of(BandShiftFigures).shift_px_by_band
        for k, band in enumerate(report["bands"]):
            table.add_row(
                str(report["exposure"]) if k == 0 else "",
                band["band"],
                f"{band['points']} of {band['sought']}",
                _px(shifts_px.get(band["band"]), 1),
                _px(band["rms_px"], 3),
                _px(band["rms_x_px"], 3),
                _px(band["rms_y_px"], 3),
                report["verdict"] if k == 0 else "",
            )
    console.print(table)


def _figures(report: Mapping[str, Any]) -> QualityFigures:
    return QualityFigures.from_json(report["figures"])


def _px(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"

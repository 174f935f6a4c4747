"""`syntopic triangulate` of a mission of photographs: no attitudes, self-calibration."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.progress import Progress

from daemon.cli.exit_status import ExitStatus
from daemon.cli.options import lock_for
from daemon.mission.layout import Mission
from daemon.terminal.console import Console

if TYPE_CHECKING:
    from daemon.postflight.batch.batch_run import StepCompute

POSITION_SIGMA_M = (3.0, 3.0, 5.0)
"""Of a camera's own receiver; the adjustment estimates them."""


def triangulate_photographs(
    folder: Mission,
    results: Path,
    *,
    points: Path | None,
    measured: Path | None,
    crs: str | None,
    position_sigma_m: tuple[float, float, float],
    reject_beyond: float,
    compute: StepCompute,
    as_json: bool,
) -> None:
    """Orient, adjust, write the results, print them; end with a status if photographs are missing.

    Raises:
        TriangulationError: the photographs make no block, or it cannot be adjusted.
    """
    from daemon.cli.adjust import _peak_mib
    from daemon.mission.store.durable import create_file
    from daemon.postflight.adjustment.summary import print_report, report_of
    from daemon.postflight.calibration.rig_writer import rig_toml
    from daemon.postflight.triangulation.control_mistakes import control_mistakes, doubtful_control
    from daemon.postflight.triangulation.displayed_pixels import as_stored
    from daemon.postflight.triangulation.ground_control import control_of
    from daemon.postflight.triangulation.held_interior import free_principal_point
    from daemon.postflight.triangulation.photograph_block import photograph_block_of
    from daemon.postflight.triangulation.photograph_cautions import photograph_cautions
    from daemon.postflight.triangulation.photograph_project import (
        adjusted_photographs,
        adjusted_rig,
        photographs_section,
    )
    from daemon.postflight.triangulation.report import (
        print_triangulation,
        triangulation_of,
        write_triangulation,
    )
    from daemon.postflight.triangulation.triangulation import TriangulationError
    from processing.bundle.network import NetworkError
    from processing.bundle.rank_diagnosis import RankDefectError

    begun = time.perf_counter()
    with lock_for(folder, results), ExitStack() as shown:
        progress = Progress(console=Console(stderr=True), transient=True)
        task = progress.add_task("orienting", total=None)
        shown.callback(progress.stop)

        def step(what: str, done: int, total: int) -> None:
            progress.start()  # not before processes have shown their own
            progress.update(task, description=what, completed=done, total=total)

        found = photograph_block_of(
            folder, crs=crs, has_control=points is not None, compute=compute, progress=step
        )
        control, converted = as_stored(found, control_of(found, points, measured))
        if mistakes := control_mistakes(found, control):
            raise TriangulationError(f"{points}: {'; '.join(mistakes)}")

        def show(what: str, number: int, squares: float) -> None:
            progress.update(task, description=f"{what} {number}: {squares:.6g}", total=None)

        try:
            project, result, less = adjusted_photographs(
                found,
                control,
                position_sigma_m=position_sigma_m,
                reject_beyond=reject_beyond,
                progress=show,
            )
        except (NetworkError, RankDefectError) as error:
            doubts = "; ".join([str(error), *doubtful_control(found, control)])
            oriented, out = len(found.block.names), len(found.left_out)
            raise TriangulationError(
                f"{folder.path}: {oriented} of {oriented + out} photographs are oriented, and "
                f"their adjustment fails: {doubts}"
            ) from error
        report = report_of(
            result,
            project.checks,
            name=project.name,
            seconds=time.perf_counter() - begun,
            peak_mib=_peak_mib(),
        )
        report["triangulation"] = triangulation_of(found.block, found.tied, project, result)
        free = free_principal_point(
            result,
            longer_side_px=[max(size.width_px, size.height_px) for size in found.sizes],
            progress=show,
        )
        section = photographs_section(found, control, result, free)
        report["photographs"] = section
        report["cautions"] += [*converted, *less, *photograph_cautions(section)]
        write_triangulation(results, found.block, project, result, report)
        content = rig_toml(
            adjusted_rig(found.block.rig, result),
            remark="Adjusted interior orientation of photographs.",
            names_schema=False,
        )
        create_file(results / "adjusted-rig.toml", [content], mode=0o644)
    incomplete = bool(section["left_out"] or result.problems)
    if as_json:
        typer.echo(json.dumps(report | {"folder": str(results)}))
    else:
        console = Console()
        print_report(console, report | {"rejected": [], "left_out": [], "control": {"count": 0}})
        print_triangulation(console, report["triangulation"])
        console.print(
            f"{section['oriented']} photographs oriented, {len(section['left_out'])} not; "
            f"{', '.join(map(_principal_distance, section['cameras']))}; positions of EXIF "
            f"differ by {', '.join(f'{v:.1f}' for v in section['position_rms_m'])} m RMS"
            f"{_shift(section['position_shift_m'])}",
            highlight=False,
            soft_wrap=True,
        )
        console.print(f"Results: {results}, report {results / 'report.html'}", soft_wrap=True)
    if incomplete:
        raise typer.Exit(ExitStatus.PROBLEM)


def _shift(shift_m: Sequence[float] | None) -> str:
    if shift_m is None:
        return ""
    named = ", ".join(f"{value:+.1f}" for value in shift_m)
    return f", after a common shift of {named} m (east, north, up) against the control"


def _principal_distance(camera: Mapping[str, Any]) -> str:
    sigma = f"+- {camera['f_sigma_px']:.1f} px" if camera["f_sigma_px"] > 0.0 else "px (held)"
    text = f"f {camera['f_px']:.1f} {sigma} of {camera['camera']} (EXIF {camera['f_exif_px']:.1f})"
    if not camera["principal_point_estimated"]:
        return text
    x, y = camera["principal_point_free"]["point_px"]
    return f"{text}, principal point {x:+.1f} columns and {y:+.1f} rows from the middle"

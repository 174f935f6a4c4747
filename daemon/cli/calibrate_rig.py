"""`syntopic calibrate rig`: relative orientation of the heads of a rig from a block."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from daemon.cli.calibration_output import publish_calibration
from daemon.cli.options import AsJson, NewFolder
from daemon.terminal.console import Console, light_table

HELP = """Estimate the relative orientation of oblique heads to the nadir head over a block.

PROJECT is an adjustment project (docs/reference/formats.md) whose cameras are named like the rig's
cones. The images of an exposure share a projection centre and have separate angles; or the exposure
has one attitude, and the heads are free parameters. Printed in grads and degrees, phi first (R = Ry
Rx Rz), with standard deviations. Writes a dated folder with rig.toml (orientations and lenses),
report.html and calibration.json.

Examples: `syntopic calibrate rig block --rig midas`,
`syntopic calibrate rig block --rig rig.toml --previous midas-rig-2026-05-02`
"""


def rig(
    project: Annotated[Path, typer.Argument(help="project.toml, or the folder that holds it.")],
    rig: Annotated[str, typer.Option(help="Shipped rig or rig file with initial values.")],
    reference: Annotated[
        str | None, typer.Option(help="Reference camera (default: the rig's master cone).")
    ] = None,
    least_points: Annotated[
        int, typer.Option(help="Minimum number of points of an image.", min=4)
    ] = 10,
    previous: Annotated[
        Path | None, typer.Option(help="Folder of the calibration to compare with.")
    ] = None,
    out: NewFolder = None,
    as_json: AsJson = False,
) -> None:
    from daemon.postflight.adjustment.project import read_project
    from daemon.postflight.calibration.calibration_report import calibration_folder, read_previous
    from daemon.postflight.calibration.rig_calibration import (
        GRAD,
        RigCalibrationError,
        calibrated_rig,
        report_of,
        rig_file,
    )
    from processing.bundle.adjust import adjust
    from processing.bundle.initial_values import completed
    from processing.bundle.network import NetworkError
    from processing.bundle.rank_diagnosis import RankDefectError
    from processing.calibration.relative_orientation import relative_orientations
    from processing.rig import find_rig

    path = project / "project.toml" if project.is_dir() else project
    given = read_project(path)
    old = find_rig(rig)
    before = None if previous is None else read_previous(previous, kind="rig")
    today = f"{datetime.now(UTC):%Y-%m-%d}"
    place = calibration_folder(out, f"{old.name}-rig", today, next_to=path.parent)
    try:
        with Progress(console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("starting values", total=None)
            result = adjust(
                completed(given.network),
                given.settings,
                progress=lambda what, number, value: progress.update(
                    task, description=f"{what} {number}: {value:.6g}"
                ),
            )
        name = reference or old.master_cone or given.network.cameras[0].name
        found = relative_orientations(result, name, least_points=least_points)
    except (NetworkError, RankDefectError, ValueError) as error:
        raise RigCalibrationError(f"{given.name}: {error}") from error
    made = calibrated_rig(old, result, found, calibration_id=place.name, date=today)
    report = report_of(given, result, found, made, date=today, previous=before)
    if not as_json:
        console = Console()
        console.print(
            f"sigma0 {result.sigma0:.3f}; against {name}, R = Ry(phi) Rx(omega) Rz(kappa)"
        )
        for unit, factor in (("grad", GRAD), ("deg", 0.9 * GRAD)):
            columns = ("phi", "\u00b1", "omega", "\u00b1", "kappa", "\u00b1", "exposures")
            table = light_table(unit, ("head",), columns)
            for k, head in enumerate(found.heads):
                angles, sigma = found.angles(k)
                cells = [
                    text
                    for a, s in zip(angles * factor, sigma * factor, strict=True)
                    for text in (f"{a:.4f}", f"{s:.4f}")
                ]
                table.add_row(head.head, *cells, str(head.exposures))
            console.print(table)
    publish_calibration(
        report,
        place,
        rig_file=lambda name: rig_file(
            replace(made, calibration_id=name), given, found, date=today
        ),
        as_json=as_json,
    )

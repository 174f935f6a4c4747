"""`syntopic export project`: an adjusted project for another program, with its measurements."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from daemon.cli.options import AsJson
from daemon.configuration.model import ConfigurationError
from daemon.terminal.console import Console

if TYPE_CHECKING:
    from daemon.postflight.exchange.photogrammetry import Angles, Unit

PROJECT_HELP = """Export an adjusted project with its image measurements for another program.

Programs: colmap (text model), opensfm (reconstruction.json and tracks.csv), pix4d (external and
internal camera parameters, bingo.txt), bingo, patb, inpho. The project, such as that of `syntopic
triangulate`, is adjusted first; measurements that the adjustment leaves out are not written. Each
camera is fitted to the program's model, and refused above 0.02 px. BINGO, PATB and Inpho get
measurements without distortion.

Examples: `syntopic export project MISSION/export/triangulation/pan --to colmap --out sparse`,
`syntopic export project block --to bingo --out bingo --angles omega-phi-kappa --unit deg`
"""


def project(
    path: Annotated[Path, typer.Argument(help="project.toml, or the folder that holds it.")],
    program: Annotated[str, typer.Option("--to", help="Program, such as colmap or bingo.")],
    out: Annotated[Path, typer.Option(help="Folder for the files; must be new.")],
    angles: Annotated[
        str | None,
        typer.Option(help="Order of BINGO's angles: omega-phi-kappa or phi-omega-kappa (default)."),
    ] = None,
    unit: Annotated[
        str | None, typer.Option(help="Unit of BINGO's angles: deg or gon (default).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.postflight.exchange.photogrammetry import UNITS
    from daemon.postflight.exchange.project_export import PROGRAMS, export_project

    for option, value, known in (
        ("--to", program, PROGRAMS),
        ("--angles", angles, (None, "omega-phi-kappa", "phi-omega-kappa")),
        ("--unit", unit, (None, *UNITS)),
    ):
        if value not in known:
            raise ConfigurationError(
                [f"{option} is {value!r}; {', '.join(filter(None, known))} are right"]
            )
    done = export_project(
        path, program, out, angles=cast("Angles | None", angles), unit=cast("Unit | None", unit)
    )
    block = done.block
    content = {
        "folder": str(out),
        "images": len(block.images),
        "cameras": {camera.name: done.residuals_px[camera.name] for camera in block.cameras},
        "object_points": len(block.points.names),
        "image_points": len(block.points.image),
        "sigma0": done.sigma0,
        "frame": None if block.frame is None else block.frame.name,
        "notes": list(done.notes),
    }
    if as_json:
        typer.echo(json.dumps(content))
        return
    console = Console()
    console.print(
        f"{content['images']} images of {len(block.cameras)} cameras, {content['object_points']} "
        f"object points, {content['image_points']} image points in {out}; sigma0 "
        f"{done.sigma0:.3f}, calibration carried over within "
        f"{max(done.residuals_px.values()):.4f} px",
        soft_wrap=True,
    )
    console.print(
        f"Coordinates: {content['frame'] or 'those of the project'}", soft_wrap=True, markup=False
    )
    for note in done.notes:
        console.print(note, soft_wrap=True, markup=False)

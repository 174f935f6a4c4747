"""`syntopic export project`: an adjusted project for another program, with its measurements."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from daemon.cli.options import AsJson
from daemon.configuration.model import ConfigurationError
from daemon.terminal.console import Console

PROJECT_HELP = """Export an adjusted project with its image measurements for another program.

Programs: colmap (text model), opensfm (reconstruction.json and tracks.csv). The project, such as
that of `syntopic triangulate`, is adjusted first; measurements that the adjustment leaves out are
not written. Each camera is fitted to the program's model, and refused above 0.02 px.

Example: `syntopic export project MISSION/export/triangulation/pan --to colmap --out sparse`
"""


def project(
    path: Annotated[Path, typer.Argument(help="project.toml, or the folder that holds it.")],
    program: Annotated[str, typer.Option("--to", help="Program: colmap or opensfm.")],
    out: Annotated[Path, typer.Option(help="Folder for the files; must be new.")],
    as_json: AsJson = False,
) -> None:
    from daemon.postflight.exchange.project_export import PROGRAMS, export_project

    if program not in PROGRAMS:
        raise ConfigurationError([f"--to is {program!r}; {', '.join(PROGRAMS)} are right"])
    done = export_project(path, program, out)
    block = done.block
    content = {
        "folder": str(out),
        "images": len(block.images),
        "cameras": {camera.name: done.residuals_px[camera.name] for camera in block.cameras},
        "object_points": len(block.points.names),
        "image_points": len(block.points.image),
        "sigma0": done.sigma0,
        "frame": None if block.frame is None else block.frame.name,
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

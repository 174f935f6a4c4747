"""Options that several commands have, said once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]

Series = Annotated[Path, typer.Argument(help="Folder with series.json, rig.toml and frames.")]
NewFolder = Annotated[
    Path | None,
    typer.Option(help="The new folder; else beside what it is made from, named by its id."),
]

Trajectory = Annotated[Path | None, typer.Option(help="Post-processed trajectory: SBET, or .csv.")]
MountFile = Annotated[Path | None, typer.Option(help="TOML with the [mount] to use.")]
Crs = Annotated[str | None, typer.Option(help="Such as EPSG:25833; default: UTM zone.")]
PositionSigma = Annotated[
    tuple[float, float, float], typer.Option(help="Of the trajectory, m: east north up.")
]
AttitudeSigma = Annotated[
    tuple[float, float, float], typer.Option(help="Roll, pitch, heading, mdeg.")
]

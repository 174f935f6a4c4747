"""Options that several commands have, and what follows from them."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from daemon.mission.layout import Mission

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]

Series = Annotated[Path, typer.Argument(help="Folder with series.json, rig.toml and frames.")]
NewFolder = Annotated[
    Path | None,
    typer.Option(help="New folder (default: next to the input, named by its id)."),
]

Trajectory = Annotated[
    Path | None, typer.Option(help="Post-processed trajectory: SBET, .csv or .pos.")
]
MountFile = Annotated[Path | None, typer.Option(help="TOML file with the [mount].")]
Crs = Annotated[str | None, typer.Option(help="CRS, such as EPSG:25833 (default: UTM zone).")]
PositionSigma = Annotated[
    tuple[float, float, float],
    typer.Option(help="Standard deviation of positions in m: east north up."),
]
AttitudeSigma = Annotated[
    tuple[float, float, float],
    typer.Option(help="Standard deviation of roll, pitch, heading in mdeg."),
]


def lock_for(mission: Mission, target: Path) -> AbstractContextManager[None]:
    """Hold the mission against other writers, if `target` is a place in it.

    Raises:
        MissionError: on entering, where another process holds it.
    """
    is_inside = target.resolve().is_relative_to(mission.path.resolve())
    return mission.held() if is_inside else nullcontext()

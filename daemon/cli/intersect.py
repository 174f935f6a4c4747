"""`syntopic intersect`: ground points from places measured in oriented images."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from daemon.cli.exit_status import exit_if_failed
from daemon.cli.options import AsJson, AttitudeSigma, Crs, MountFile, PositionSigma, Trajectory
from daemon.terminal.console import Console, light_table

HELP = """Compute ground points from measurements in two or more oriented images, with accuracy.

MEASURED is a table: image (as `syntopic orient` names it, such as 000012_5), point, column_px,
row_px of the Level-2 image, sigma_px. Images are oriented by trajectory, boresight and the rig's
mounting angles; their uncertainty is propagated into the points with its correlations.

Example: `syntopic intersect MISSION measured.csv --trajectory sbet.out --out points.csv`
"""

COLUMNS = (
    *("point", "east_m", "north_m", "height_m", "latitude_deg", "longitude_deg"),
    *("ellipsoidal_height_m", "sx_m", "sy_m", "sz_m", "image_sx_m", "image_sy_m", "image_sz_m"),
    "rays",
)


def intersect(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    measured: Annotated[Path, typer.Argument(help="Image measurements (CSV).")],
    trajectory: Trajectory = None,
    mount: MountFile = None,
    crs: Crs = None,
    image_sigma: Annotated[
        float, typer.Option(help="Standard deviation without sigma_px, in px.", min=1e-3)
    ] = 0.5,
    position_sigma: PositionSigma = (0.05, 0.05, 0.08),
    attitude_sigma: AttitudeSigma = (5.0, 5.0, 8.0),
    boresight_sigma: Annotated[
        tuple[float, float, float],
        typer.Option(help="Standard deviation common to all exposures in mdeg."),
    ] = (1.5, 1.5, 3.0),
    out: Annotated[Path | None, typer.Option(help="New table of the points.")] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.layout import Mission
    from daemon.orientation.navigation_sigmas import attitude_sigmas
    from daemon.postflight.adjustment.csv_tables import write_table
    from daemon.postflight.triangulation.space_intersection import (
        IntersectionError,
        IntersectionSigmas,
    )
    from daemon.postflight.triangulation.space_intersection import intersect as intersected

    if out is not None and out.exists():
        raise IntersectionError(f"{out} exists; give another name with --out")
    done = intersected(
        Mission.open(mission),
        measured,
        IntersectionSigmas(
            image_px=image_sigma,
            position_m=position_sigma,
            attitude_rad=attitude_sigmas(attitude_sigma),
            boresight_rad=attitude_sigmas(boresight_sigma),
        ),
        crs=crs,
        trajectory_file=trajectory,
        mount_file=mount,
    )
    if out is not None:
        write_table(
            out,
            f"Intersected points in {done.crs}, heights: {done.height_system}; sigmas east, north, "
            "up, and their part of the image",
            COLUMNS,
            (
                (
                    p.name, *p.place_m, p.latitude_deg, p.longitude_deg, p.height_m, *p.sigma_m,
                    *p.of_image_m, str(p.rays),
                )
                for p in done.points
            ),
        )  # fmt: skip
    if as_json:
        typer.echo(json.dumps(asdict(done)))
        exit_if_failed(done.failures)
        return
    console = Console()
    columns = ("east m", "north m", "height m", "\u00b1 x", "\u00b1 y", "\u00b1 z", "rays")
    table = light_table(f"{done.crs}, heights: {done.height_system}", ("point",), columns)
    for p in done.points:
        cells = [f"{v:.2f}" for v in p.place_m] + [f"{v:.2f}" for v in p.sigma_m]
        table.add_row(p.name, *cells, str(p.rays))
    console.print(table)
    if done.left_out:
        console.print(
            f"Not fixed by their rays (one ray, or one projection centre): "
            f"{', '.join(done.left_out)}",
            markup=False,
        )
    if out is not None:
        console.print(f"Table: {out}", soft_wrap=True)
    exit_if_failed(done.failures)

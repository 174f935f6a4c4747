"""`syntopic export block`: oriented images with cameras and rig for another program."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer
from rich.progress import Progress

from daemon.cli.exit_status import exit_if_failed
from daemon.cli.options import AsJson, Crs, MountFile, Trajectory
from daemon.configuration.model import ConfigurationError
from daemon.terminal.console import Console

if TYPE_CHECKING:
    from daemon.postflight.exchange.mission_block import ImageKind, StitchedImage
    from daemon.postflight.exchange.mission_export import Program, RigChoice
    from daemon.postflight.exchange.photogrammetry import Angles, Unit

BLOCK_HELP = """Export oriented images with cameras, accuracies and rig for another program.

Programs: colmap (text model and, with --database, position priors with covariance), opensfm (also
OpenDroneMap's geo.txt and image_groups.txt), metashape (cameras.xml), pix4d, nerfstudio, bingo,
patb, bluh, imagestation, inpho (project with its camera). The folder
also has the images as JPEG with EXIF and XMP, and `about.json` with the local frame, the rig and
the residuals.

Raw frames keep their distortion. Each calibration is fitted to the program's camera model, and
refused above 0.02 px. Heads form a rig where their attitudes change by less than 0.1 px against
each other.

Examples: `syntopic export block MISSION --to colmap --trajectory sbet.out --database`,
`syntopic export block MISSION --to metashape --images raw`
"""


def block(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    program: Annotated[
        str, typer.Option("--to", help="Program, such as colmap, metashape or inpho.")
    ],
    images: Annotated[
        str, typer.Option(help="Images: perspective (Level-2) or raw (Level-0).")
    ] = "perspective",
    stitched: Annotated[
        str,
        typer.Option(
            help="Image of a stitched rig: pan or rgbn (Level-2), rgb or cir (Level-3, 8 bits)."
        ),
    ] = "pan",
    rig: Annotated[str, typer.Option(help="Rig of the heads: auto, yes or no.")] = "auto",
    database: Annotated[
        bool, typer.Option("--database", help="COLMAP's database, through pycolmap.")
    ] = False,
    copies: Annotated[
        bool, typer.Option("--copies/--no-copies", help="Copies of the images as JPEG.")
    ] = True,
    angles: Annotated[
        str | None,
        typer.Option(
            help="Order: omega-phi-kappa, phi-omega-kappa or heading-roll-pitch "
            "(default: the program's own)."
        ),
    ] = None,
    unit: Annotated[
        str | None, typer.Option(help="Unit of angles: deg or gon (default: the program's own).")
    ] = None,
    position_sigma: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            help="Standard deviation of positions in m: east north up (default: the receiver's)."
        ),
    ] = None,
    trajectory: Trajectory = None,
    mount: MountFile = None,
    crs: Crs = None,
    only: Annotated[
        list[int] | None, typer.Option(help="Number of an exposure; repeatable.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.layout import Mission
    from daemon.postflight.exchange.mission_block import KINDS, STITCHED, block_of_mission
    from daemon.postflight.exchange.mission_export import PROGRAMS, export_block
    from daemon.postflight.exchange.photogrammetry import ANGLES, UNITS
    from daemon.postflight.export.picture_files import left_out_of_jpeg

    for option, value, known in (
        ("--to", program, PROGRAMS),
        ("--images", images, KINDS),
        ("--stitched", stitched, STITCHED),
        ("--rig", rig, ("auto", "yes", "no")),
        ("--angles", angles, (None, *ANGLES)),
        ("--unit", unit, (None, *UNITS)),
    ):
        if value not in known:
            raise ConfigurationError(
                [f"{option} is {value!r}; {', '.join(filter(None, known))} are right"]
            )
    if database and program != "colmap":
        raise ConfigurationError([f"--database is COLMAP's; --to is {program}"])
    if position_sigma is not None and not all(0.0 < sigma < 1e4 for sigma in position_sigma):
        raise ConfigurationError(["--position-sigma has three positive numbers, in metres"])
    folder = Mission.open(mission)
    with folder.held(), Progress(console=Console(stderr=True), transient=True) as progress:
        read = block_of_mission(
            folder,
            cast("ImageKind", images),
            stitched=cast("StitchedImage", stitched),
            crs=crs,
            trajectory_file=trajectory,
            mount_file=mount,
            only=only or (),
            position_sigma_m=position_sigma,
        )
        task = progress.add_task("writing", total=len(read.block.images))
        done = export_block(
            folder,
            read,
            cast("Program", program),
            rig=cast("RigChoice", rig),
            database=database,
            images=copies,
            angles=cast("Angles | None", angles),
            unit=cast("Unit | None", unit),
            progress=lambda count: progress.update(task, completed=count),
        )
    if as_json:
        failures = [failure.as_json() for failure in read.failures]
        content = {"folder": str(done.folder), **done.about, "priors": done.priors}
        typer.echo(json.dumps(content | {"failures": failures}))
        exit_if_failed(read.failures)
        return
    console = Console()
    worst = max(done.residuals_px.values())
    console.print(
        f"{len(done.block.images)} images of {len(done.block.cameras)} cameras in {done.folder}; "
        f"calibration carried over within {worst:.4f} px",
        soft_wrap=True,
    )
    console.print(
        f"{'A rig' if done.rig else 'No rig'}: {done.rig_reason}", soft_wrap=True, markup=False
    )
    if missing := read.missing:
        console.print(f"Without an image: {', '.join(missing)}", style="yellow", markup=False)
    if unknown := done.about["without_accuracy"]:
        console.print(
            f"{unknown} images have no accuracy of position; give --position-sigma", style="yellow"
        )
    for camera in read.block.cameras:
        if left_out := left_out_of_jpeg(camera.bands):
            console.print(
                f"{camera.name}: a JPEG has three bands, without {', '.join(left_out)}; "
                "`syntopic export pictures` writes all bands",
                style="yellow",
                markup=False,
            )
    if read.block.frame is not None:
        console.print(f"Coordinates: {read.block.frame.name}; see about.json", soft_wrap=True)
    exit_if_failed(read.failures)

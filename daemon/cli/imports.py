"""`syntopic import`: images of other cameras become a mission folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import Progress
from typer.core import TyperGroup

from daemon.cli.options import AsJson
from daemon.terminal.console import Console


class _Commands(TyperGroup):
    """The commands; former names are refused with the present one."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name in RENAMED:
            ctx.fail(f"No such command '{cmd_name}'. Use '{RENAMED[cmd_name]}'.")
        return super().get_command(ctx, cmd_name)


RENAMED = {"rededge": "multispectral"}

app = typer.Typer(
    cls=_Commands,
    help="""Import exposures of other cameras as a mission folder for `syntopic process`.

Example: `syntopic import multispectral 0000SET --out field-7`
""",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)


@app.callback()
def imports() -> None:
    """Bring in exposures of other cameras."""


@app.command()
def multispectral(
    folder: Annotated[
        Path, typer.Argument(help="Folder with IMG_0000_1.tif ..., searched recursively.")
    ],
    out: Annotated[Path, typer.Option(help="New mission folder.")],
    as_json: AsJson = False,
) -> None:
    """Import images of multispectral cameras by the calibration in their tags.

    Reads MicaSense RedEdge, Altum and Dual, Parrot Sequoia, DJI Phantom 4 and Mavic 3
    Multispectral, Sentera 6X, and others with the same tags. Each serial number becomes a mission:
    with several, OUT has a folder for each.

    Example: `syntopic import multispectral 000/ --out missions/field-7`
    """
    from daemon.postflight.importers.multispectral import import_multispectral

    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("importing", total=None)
        imported = import_multispectral(
            folder,
            out,
            progress=lambda done, total: progress.update(task, completed=done, total=total),
        )
    if as_json:
        cameras = [
            {
                "mission": str(one.mission.path),
                "camera": one.camera,
                "serial": one.serial,
                "exposures": one.exposures,
                "frames": one.frames,
                "lens_fit_px": dict(one.lens_fit_px),
                "missing": list(one.missing),
                "notes": list(one.notes),
            }
            for one in imported
        ]
        typer.echo(json.dumps({"cameras": cameras}))
        return
    console = Console()
    for one in imported:
        worst = max(one.lens_fit_px.values(), default=0.0)
        console.print(
            f"{one.camera} {one.serial}: {one.exposures} exposures, {one.frames} frames in "
            f"{one.mission.path}; lens distortion carried over within {worst:.3f} px",
            soft_wrap=True,
            markup=False,
        )
        for sentence in (*one.missing, *one.notes):
            console.print(sentence, markup=False, style="yellow", soft_wrap=True)
    for one in imported:
        console.print(f"Next: syntopic process {one.mission.path}", soft_wrap=True)


@app.command()
def photographs(
    folder: Annotated[Path, typer.Argument(help="Folder with JPEG or TIFF files.")],
    out: Annotated[Path, typer.Option(help="New mission folder.")],
    focal_mm: Annotated[
        float | None, typer.Option(help="Focal length in mm (default: EXIF).", min=0.1)
    ] = None,
    pixel_um: Annotated[
        float | None, typer.Option(help="Pixel pitch in um (default: EXIF).", min=0.1)
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Import photographs with positions in EXIF as a mission.

    Each camera becomes a head: photographs that differ in camera, serial number, size or focal
    length. Its interior orientation is provisional; `syntopic triangulate` estimates it.

    Example: `syntopic import photographs DCIM --out missions/field-8`
    """
    from daemon.postflight.importers.photographs import import_photographs, in_order

    imported = import_photographs(folder, out, focal_mm=focal_mm, pixel_um=pixel_um)
    first = imported.photographs[0]
    heads = in_order(imported.heads)
    if as_json:
        content = {
            "mission": str(imported.mission.path),
            "photographs": len(imported.photographs),
            "camera": first.camera,
            "f_px": first.focal_px,
            "pixel_um": first.pitch_mm * 1e3,
            "heads": heads,
            "notes": list(imported.notes),
        }
        typer.echo(json.dumps(content))
        return
    console = Console()
    of = f"{first.camera}, {first.width_px} x {first.height_px} px"
    console.print(
        f"{len(imported.photographs)} photographs of "
        f"{of if len(heads) == 1 else f'{len(heads)} cameras'}, in {out}",
        soft_wrap=True,
    )
    for note in imported.notes:
        console.print(note, style="yellow", markup=False)
    console.print(f"Next: syntopic triangulate {out}")


@app.command()
def dbat(
    script: Annotated[Path, typer.Argument(help="Script (XML) of a camera calibration.")],
    out: Annotated[Path, typer.Option(help="Folder for the adjustment project; must be new.")],
    as_json: AsJson = False,
) -> None:
    """Import a camera calibration of the Damped Bundle Adjustment Toolbox for `syntopic adjust`.

    Example: `syntopic import dbat camcal.xml --out camcal`
    """
    from daemon.postflight.adjustment.project_writer import write_project
    from daemon.postflight.importers.dbat import import_dbat

    imported = import_dbat(script)
    write_project(out, imported.file, imported.network, imported.checks)
    network = imported.network
    counts = {
        "images": len(network.images.names),
        "object_points": len(network.points.names),
        "image_points": len(network.image_points.image),
    }
    if as_json:
        typer.echo(json.dumps({"project": str(out), **counts, "notes": list(imported.notes)}))
        return
    console = Console()
    console.print(
        f"{counts['images']} images, {counts['object_points']} object points, "
        f"{counts['image_points']} image points in {out}"
    )
    for note in imported.notes:
        console.print(note, style="yellow", markup=False)
    console.print(f"Next: syntopic adjust {out}")


BLOCK_HELP = """Import cameras, orientations and points of another program for `syntopic adjust`.

Programs: colmap (folder of a model), opensfm (reconstruction.json and tracks.csv), metashape
(cameras.xml), bundler (bundle.out), bal (problem file), bingo, patb and pix4d (folder with
measurements, orientation and cameras.txt), inpho (project). Distortion is converted to the ten
parameters by fit; above 0.02 px Brown's model is kept, or the measurements are corrected. Without
--position-sigma the project is a free network; where files do not state that coordinates are in
metres, it needs --metric.

Examples: `syntopic import block sparse/0 --from colmap --out block`,
`syntopic import block bundle.out --from bundler --out block --image-sigma 0.3`
"""


@app.command("block", help=BLOCK_HELP)
def block(
    path: Annotated[Path, typer.Argument(help="File or folder of the program.")],
    program: Annotated[
        str, typer.Option("--from", help="Program, such as colmap, metashape or bingo.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for the adjustment project; must be new.")],
    image_sigma: Annotated[
        float, typer.Option(help="Standard deviation of image coordinates in px.", min=1e-3)
    ] = 0.5,
    position_sigma: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Standard deviation of positions in m: x y z (default: free network)."),
    ] = None,
    metric: Annotated[
        bool,
        typer.Option(
            "--metric", help="Coordinates are in metres, although the files do not state it."
        ),
    ] = False,
    photographs_folder: Annotated[
        Path | None,
        typer.Option(
            "--photographs",
            help="Folder of the images, whose positions in EXIF show feet and other units.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.configuration.model import ConfigurationError
    from daemon.postflight.exchange.block_project import READERS, import_block

    if program not in READERS:
        raise ConfigurationError([f"--from is {program!r}; {', '.join(READERS)} are right"])
    if position_sigma is not None and not all(0.0 < sigma < 1e6 for sigma in position_sigma):
        raise ConfigurationError(["--position-sigma has three positive numbers, in metres"])
    done = import_block(
        path,
        program,
        out,
        sigma_px=image_sigma,
        position_sigma_m=position_sigma,
        is_metric=metric,
        photographs=photographs_folder,
    )
    block = done.block
    counts = {
        "images": len(block.images),
        "cameras": len(block.cameras),
        "object_points": len(block.points.names),
        "image_points": len(block.points.image),
    }
    frame = None if block.frame is None else block.frame.name
    if as_json:
        content = {"project": str(out), **counts, "residuals_px": dict(done.residuals_px)}
        typer.echo(json.dumps(content | {"frame": frame, "notes": list(block.notes)}))
        return
    console = Console()
    worst = max(done.residuals_px.values(), default=0.0)
    console.print(
        f"{counts['images']} images of {counts['cameras']} cameras, {counts['object_points']} "
        f"object points, {counts['image_points']} image points in {out}; distortion carried over "
        f"within {worst:.4f} px",
        soft_wrap=True,
    )
    for note in block.notes:
        console.print(note, style="yellow", markup=False)
    console.print(f"Coordinates: {frame or 'a frame that the file does not state'}", soft_wrap=True)
    if counts["image_points"]:
        console.print(f"Next: syntopic adjust {out}", soft_wrap=True)

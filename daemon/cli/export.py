"""`syntopic export`: what a mission holds, in the form that other programs want."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from daemon.cli.batch_options import ExecutorOptions, takes_executor
from daemon.cli.exit_status import exit_if_failed
from daemon.cli.export_block import BLOCK_HELP, block
from daemon.cli.export_gis import GIS_HELP, STAC_HELP, gis, stac
from daemon.cli.export_gnss import RINEX_HELP, TRAJECTORY_HELP, rinex, trajectory
from daemon.cli.export_project import PROJECT_HELP, project
from daemon.cli.options import AsJson
from daemon.terminal.console import Console, light_table
from drivers.base.extras import require

ORIENTATION_HELP = """Compute the exterior orientation of every cone at each mid-exposure time.

The source is the navigation of the flight or a post-processed trajectory; each trajectory has its
own folder. Writes CSV, PAT-B, angles for BINGO, footprints (GeoJSON) and STAC items.

Examples: `syntopic orient MISSION`, `syntopic orient MISSION --trajectory sbet.out`,
`syntopic orient MISSION --mount boresight-2026-11-21/mount.toml`
"""

PICTURES_HELP = """Export pictures as COG, tiled TIFF, JPEG 2000, or JPEG with EXIF and XMP.

Level-2, or with --level 3 the pansharpened RGB and CIR images in 16 or 8 bits. The images are not
rectified. A COG and a TIFF have tags, and ground control points on level ground. A JPEG contains
time, position, attitude, accuracies, focal length and pixel size for programs that read EXIF and
XMP (exiftool, photogrammetric programs); its description names bands that it cannot hold. All but
JPEG require `pip install 'syntopic[geotiff]'`.

Examples: `syntopic export pictures MISSION --trajectory sbet.out`,
`syntopic export pictures MISSION --as jpeg --only 12`,
`syntopic export pictures MISSION --level 3 --bits 8 --as tiff`
"""

CERTIFICATE_HELP = """Export the camera of the images as a calibration certificate: JSON and HTML.

Describes the virtual camera of stitched images, or each head with separate images: principal
distance, principal point with axes and signs, pixel size, serial numbers, validity.

Example: `syntopic export certificate MISSION`
"""

PICTURES_PER_PROCESS = 8
ORIENTATIONS_PER_PROCESS = 5000
"""So many exposures take longer than the start of a process."""

app = typer.Typer(
    help="""Export a mission for other programs.

Unreadable exposures are listed at the end with the cause. The others are written, and the exit
status is 1.

Examples: `syntopic export raw MISSION`, `syntopic export orientation MISSION --crs EPSG:25833`
""",
    rich_markup_mode="markdown",
    no_args_is_help=True,
)


@app.callback()
def export() -> None:
    """Export a mission for other programs."""


app.command("block", help=BLOCK_HELP)(block)
app.command("project", help=PROJECT_HELP)(project)
app.command("stac", help=STAC_HELP)(stac)
app.command("gis", help=GIS_HELP)(gis)
app.command("rinex", help=RINEX_HELP)(rinex)
app.command("trajectory", help=TRAJECTORY_HELP)(trajectory)


@app.command()
def raw(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    as_json: AsJson = False,
) -> None:
    """Export the bytes of each receiver in its native format, and the event file.

    Example: `syntopic export raw missions/20261121T101500Z-ultracam-x-mini`
    """
    from daemon.mission.layout import Mission
    from daemon.postflight.export.raw import export_raw

    folder = Mission.open(mission)
    with folder.held():
        done = export_raw(folder)
    if as_json:
        listed = {
            "folder": str(done.folder),
            "nbytes": done.nbytes,
            "events": done.events,
            "failures": [failure.as_json() for failure in done.failures],
        }
        typer.echo(json.dumps(listed))
        exit_if_failed(done.failures)
        return
    console = Console()
    for name, nbytes in done.nbytes.items():
        console.print(f"{name}: {nbytes} bytes")
    console.print(f"events.csv: {done.events} exposures; frames.csv: every frame of theirs")
    console.print(f"They are in {done.folder}", soft_wrap=True)
    exit_if_failed(done.failures)


@app.command()
def foxglove(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    as_json: AsJson = False,
) -> None:
    """Export track, thumbnails and messages as one MCAP file for Foxglove.

    Example: `syntopic export foxglove missions/20261121T101500Z-ultracam-x-mini`
    """
    from daemon.mission.layout import Mission
    from daemon.postflight.export.foxglove import export_foxglove

    folder = Mission.open(mission)
    with folder.held():
        done = export_foxglove(folder)
    if as_json:
        failures = [failure.as_json() for failure in done.failures]
        content = {"file": str(done.file), "messages": done.messages, "failures": failures}
        typer.echo(json.dumps(content))
    else:
        listed = ", ".join(f"{topic} {count}" for topic, count in done.messages.items())
        Console().print(f"{listed or 'nothing'}; written to {done.file}", soft_wrap=True)
    exit_if_failed(done.failures)


@app.command(help=PICTURES_HELP)
@takes_executor
def pictures(
    mission: Annotated[Path, typer.Argument(help="Mission folder with Level-2 or Level-3.")],
    kind: Annotated[str, typer.Option("--as", help="Format: cog, tiff, jp2 or jpeg.")] = "cog",
    level: Annotated[int, typer.Option(help="Level of the products: 2 or 3.")] = 2,
    bits: Annotated[int, typer.Option(help="Bits of Level-3: 16 or 8.")] = 16,
    attitude_sigma: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Standard deviation of roll, pitch, heading in mdeg."),
    ] = None,
    trajectory: Annotated[
        Path | None, typer.Option(help="Post-processed trajectory: SBET, .csv or .pos.")
    ] = None,
    mount: Annotated[Path | None, typer.Option(help="TOML file with the [mount].")] = None,
    crs: Annotated[
        str | None, typer.Option(help="CRS, such as EPSG:25833 (default: UTM zone).")
    ] = None,
    only: Annotated[
        list[int] | None, typer.Option(help="Number of an exposure; repeatable.")
    ] = None,
    *,
    where: ExecutorOptions,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.layout import Mission
    from daemon.postflight.export.level2_export import KINDS, PictureError
    from daemon.postflight.export.picture_export import export_pictures

    if kind not in KINDS:
        raise PictureError(f"--as is {kind!r}; {', '.join(KINDS)} are right")
    if level not in (2, 3) or bits not in (8, 16) or (level == 2 and bits == 8 and kind != "jpeg"):
        raise PictureError(
            f"--level {level} --bits {bits}; Level-2 has 16 bits, Level-3 has 16 and 8"
        )
    if kind != "jpeg":
        require("geotiff")
    where.check()
    folder = Mission.open(mission)
    with folder.held():
        files, failures = export_pictures(
            folder,
            kind,
            crs=crs,
            trajectory_file=trajectory,
            mount_file=mount,
            only=only or (),
            level=level,
            depth=bits,
            roll_pitch_yaw_sigma_deg=None
            if attitude_sigma is None
            else (attitude_sigma[0] * 1e-3, attitude_sigma[1] * 1e-3, attitude_sigma[2] * 1e-3),
            compute=where.compute("writing", PICTURES_PER_PROCESS),
        )
    out = folder.export_dir / kind
    names = [path.relative_to(out) for path in files]
    if as_json:
        content = {
            "folder": str(out),
            "files": [name.as_posix() for name in names],
            "failures": [failure.as_json() for failure in failures],
        }
        typer.echo(json.dumps(content))
    else:
        Console().print(f"{len(files)} pictures in {out}", soft_wrap=True)
        if products := sorted({name.parts[0] for name in names if len(name.parts) > 1}):
            Console().print(
                f"Products have a folder each: {', '.join(products)}. Give a program one of them: "
                "several together look like the bands of one rig.",
                soft_wrap=True,
            )
    exit_if_failed(failures)


@app.command(help=CERTIFICATE_HELP)
def certificate(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    as_json: AsJson = False,
) -> None:
    from daemon.mission.layout import Mission
    from daemon.postflight.export.camera_certificate import write_certificate

    folder = Mission.open(mission)
    with folder.held():
        listed, path, failures = write_certificate(folder)
    if as_json:
        typer.echo(json.dumps(listed))
        exit_if_failed(failures)
        return
    console = Console()
    for camera in listed["cameras"]:
        x, y = camera["principal_point_mm"]
        console.print(
            f"{camera['name']}: principal distance {camera['principal_distance_mm']:.6f} mm, "
            f"principal point {x:.3f} {y:.3f} mm, {camera['width_px']} x {camera['height_px']} px "
            f"of {camera['pixel_size_um']:g} um",
            highlight=False,
        )
    console.print(f"Certificate: {path}", soft_wrap=True)
    exit_if_failed(failures)


@app.command(help=ORIENTATION_HELP)
@takes_executor
def orientation(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    trajectory: Annotated[
        Path | None, typer.Option(help="Post-processed trajectory: SBET, .csv or .pos.")
    ] = None,
    crs: Annotated[
        str | None, typer.Option(help="CRS, such as EPSG:25833+7837 (default: UTM zone).")
    ] = None,
    receiver: Annotated[str | None, typer.Option(help="Navigator, if there are several.")] = None,
    mount: Annotated[
        Path | None, typer.Option(help="TOML file with the [mount], from calibrate boresight.")
    ] = None,
    dem: Annotated[
        Path | None, typer.Option(help="Height model for footprints: GeoTIFF or .asc.")
    ] = None,
    *,
    where: ExecutorOptions,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.layout import Mission
    from daemon.postflight.export import orientation_set as orientation_export

    where.check()
    folder = Mission.open(mission)
    with folder.held():
        done = orientation_export.export_orientation(
            folder,
            crs=crs,
            trajectory_file=trajectory,
            receiver=receiver,
            mount_file=mount,
            dem_file=dem,
            compute=where.compute("orienting", ORIENTATIONS_PER_PROCESS),
        )
    if as_json:
        typer.echo(json.dumps(orientation_export.as_json(done)))
        exit_if_failed(done.failures)
        return
    console = Console()
    table = light_table(
        f"{done.crs}, heights: {done.height_system}",
        ("image",),
        ("east m", "north m", "height m", "omega", "phi", "kappa"),
    )
    stitched = [eo for eo in done.oriented if eo.is_virtual]
    for eo in stitched or done.oriented:
        place = (f"{value:.2f}" for value in eo.centre_m)
        table.add_row(eo.name, *place, *(f"{angle:.4f}" for angle in eo.omega_phi_kappa_deg))
    console.print(table)
    if stitched:
        console.print(f"and {len(done.oriented) - len(stitched)} of single heads, in the files")
    for one in done.missing:
        console.print(f"{one.exposure:06d} {one.cone}: not oriented, {one.reason}", style="yellow")
    if done.change_m is not None:
        console.print(
            f"Against the flight's own navigation: at most {done.change_m:.3f} m and "
            f"{done.change_deg:.4f} deg"
        )
    if done.offset_m is not None:
        forward, right, down = done.offset_m
        console.print(
            f"Median of the differences in the camera's axes: forward {forward:+.3f} m, right "
            f"{right:+.3f} m, down {down:+.3f} m"
        )
    console.print(
        f"CSV, PAT-B, BINGO, footprints and STAC items are in {done.folder}; read about.txt first",
        soft_wrap=True,
    )
    exit_if_failed(done.failures)

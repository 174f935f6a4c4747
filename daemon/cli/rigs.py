"""`syntopic rigs`: which cameras are known, and what follows from their files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from daemon.cli import rigs_image
from daemon.cli.options import AsJson
from daemon.mission.store.durable import replace_file
from daemon.terminal.console import Console, light_table
from processing.rig import Rig, find_rig, load_rig, shipped_rigs

app = typer.Typer(
    help="""List the shipped rigs, or describe a rig file.

Examples: `syntopic rigs`, `syntopic rigs show ultracam-x`, `syntopic rigs propose-image rig.toml`
""",
    rich_markup_mode="markdown",
)


@app.callback(invoke_without_command=True)
def rigs(
    context: typer.Context,
    as_json: AsJson = False,
) -> None:
    if context.invoked_subcommand is not None:
        return
    loaded = [load_rig(path) for path in shipped_rigs().values()]
    if as_json:
        typer.echo(json.dumps({"rigs": [_row(rig) for rig in loaded]}))
        return
    figures = ("image px", "sensors", "cones", "interval s")
    table = light_table("Rigs", ("name", "timing"), figures)
    for rig in loaded:
        image = rig.virtual_image
        table.add_row(
            rig.name,
            rig.timing,
            f"{image.width_px} x {image.height_px}" if image else "none",
            str(len(rig.sensors)),
            str(len(rig.cones)),
            f"{rig.frame_interval_s:g}",
        )
    console = Console()
    console.print(table)
    console.print("Next: syntopic rigs show NAME")


@app.command()
def show(
    name: Annotated[str, typer.Argument(help="Name of a shipped rig, or a rig file.")],
    drawing: Annotated[
        Path | None, typer.Option(help="New drawing of the focal planes (SVG).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print topology, overlaps and the counts of the adjustment; on request, draw the focal planes.

    Examples: `syntopic rigs show ultracam-x`, `syntopic rigs show my-rig.toml --drawing rig.svg`
    """
    from processing.geometry import topology
    from processing.mosaic import mosaic_plots as draw
    from processing.pipelines.perspective import has_head_images

    rig = find_rig(name)
    counts = topology.counts(rig)
    overlaps = topology.overlaps(rig) if rig.virtual_image else ()
    pitch_mm = rig.virtual_image.pitch_mm if rig.virtual_image else rig.sensors[0].pitch_mm
    if drawing is not None:
        replace_file(drawing, draw.focal_planes_svg(rig).encode("utf-8"))
    if as_json:
        typer.echo(
            json.dumps(
                _row(rig)
                | {
                    "calibrated": rig.is_calibrated,
                    "parameters": counts.parameters,
                    "constraints": counts.constraints,
                    "independent": counts.parameters - counts.constraints,
                    "layers": [
                        {
                            "cone": layer.cone,
                            "sensors": layer.sensors,
                            "parameters": layer.parameters,
                            "constraints": layer.constraints,
                        }
                        for layer in counts.cones
                    ],
                    "overlaps": [
                        {
                            "sensors": [overlap.sensor_a, overlap.sensor_b],
                            "width_px": round(overlap.rectangle.width_mm / pitch_mm, 1),
                            "height_px": round(overlap.rectangle.height_mm / pitch_mm, 1),
                        }
                        for overlap in overlaps
                    ],
                    "drawing": None if drawing is None else str(drawing),
                }
            )
        )
        return
    console = Console()
    calibration = rig.calibration_date and f"calibrated {rig.calibration_date}"
    console.print(f"{rig.name}  {rig.title}; {rig.timing}; {calibration or 'uncalibrated'}")
    figures = ("f mm", "forward mm", "right mm", "param.", "constr.")
    cones = light_table("Cones", ("cone", "bands", "sensors"), figures)
    layers = {layer.cone: layer for layer in counts.cones}
    for cone in rig.cones:
        layer = layers.get(cone.name)
        cones.add_row(
            cone.name + (" master" if cone.name == rig.master_cone else ""),
            ", ".join(cone.bands),
            " ".join(sensor.name for sensor in cone.sensors),
            f"{cone.lens.f_mm:.3f}",
            f"{cone.position_mm[0]:g}",
            f"{cone.position_mm[1]:g}",
            str(layer.parameters) if layer else "-",
            str(layer.constraints) if layer else "-",
        )
    console.print(cones)
    strips = light_table(f"Overlaps ({len(overlaps)})", ("sensors",), ("width px", "height px"))
    for overlap in overlaps:
        strips.add_row(
            f"{overlap.sensor_a} - {overlap.sensor_b}",
            f"{overlap.rectangle.width_mm / pitch_mm:.0f}",
            f"{overlap.rectangle.height_mm / pitch_mm:.0f}",
        )
    console.print(strips)
    if has_head_images(rig):
        console.print(
            "Nothing is stitched: each head is an image of its own "
            "(docs/how-to/processing/midas.md)",
            soft_wrap=True,
        )
    else:
        console.print(
            f"Adjustment: {counts.parameters} parameters, {counts.constraints} constraints, "
            f"{counts.parameters - counts.constraints} independent unknowns"
            + (
                " (a cone with - is registered to green)"
                if any(cone.name not in layers for cone in rig.cones)
                else ""
            )
        )
    if drawing is None:
        console.print("Next: --drawing FILE draws the focal planes")
    else:
        console.print(f"Focal planes drawn in {drawing}", soft_wrap=True)


app.command(name="propose-image", help=rigs_image.HELP)(rigs_image.propose_image)


def _row(rig: Rig) -> dict[str, object]:
    image = rig.virtual_image
    return {
        "name": rig.name,
        "title": rig.title,
        "timing": rig.timing,
        "width_px": image.width_px if image else None,
        "height_px": image.height_px if image else None,
        "sensors": len(rig.sensors),
        "cones": len(rig.cones),
        "frame_interval_s": rig.frame_interval_s,
    }

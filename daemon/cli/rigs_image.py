"""`syntopic rigs propose-image`: a virtual image for heads that overlap and have none."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from daemon.cli.options import AsJson
from daemon.terminal.console import Console, light_table

if TYPE_CHECKING:
    from processing.geometry.image_proposal import ImageProposal

HELP = """Propose a virtual image for heads that overlap and have none.

The virtual camera looks along the mean of the heads' axes. Its image is the largest rectangle about
that axis that the heads cover together. With --mission, the rotations between the heads are first
refined by tie points of its frames. Prints size, coverage and overlaps. Nothing is changed without
--write, which writes the image into the rig file and keeps its comments.

Heads that do not overlap, oblique heads and heads of one field are refused.

Examples: `syntopic rigs propose-image rig.toml`,
`syntopic rigs propose-image rig.toml --mission missions/2026-11-21 --write`
"""

_COLUMNS, _ROWS = 60, 18


def propose_image(
    rig: Annotated[Path, typer.Argument(help="Rig file without [virtual_image].")],
    mission: Annotated[
        Path | None, typer.Option(help="Mission whose frames refine the rotations.")
    ] = None,
    write: Annotated[bool, typer.Option("--write", help="Change of the rig file.")] = False,
    as_json: AsJson = False,
) -> None:
    from daemon.initialization.rig_edits import with_virtual_image
    from daemon.mission.store.durable import replace_file
    from processing.geometry.image_proposal import boresight_deg, propose_image
    from processing.rig import load_rig

    given = load_rig(rig)
    refined: dict[str, Any] = {}
    if mission is not None:
        from daemon.postflight.calibration.head_refinement import refined_rotations

        given, refined = refined_rotations(given, mission)
    proposal = propose_image(given)
    text = rig.read_bytes().decode("utf-8")
    changed = with_virtual_image(
        text, proposal, written_by=f"syntopic rigs propose-image {rig.name}"
    )
    former = _boresight_of(rig.parent / "service.toml")
    boresight = [round(float(v), 6) + 0.0 for v in boresight_deg(former, proposal.turned)]
    if write:
        replace_file(rig, changed.encode("utf-8"))
    if as_json:
        content = _as_json(proposal) | {
            "refined": refined,
            "boresight_deg": boresight,
            "former_boresight_deg": list(former),
            "written": str(rig) if write else None,
        }
        typer.echo(json.dumps(content))
        return
    console = Console()
    _print(console, proposal, refined)
    if boresight != [round(v, 6) + 0.0 for v in former]:
        console.print(
            f"Angles now refer to the virtual camera: set [mount] boresight_deg = {boresight} in "
            f"service.toml (it is {list(former)})",
            style="yellow",
            soft_wrap=True,
        )
    for warning in proposal.warnings:
        console.print(warning, style="yellow", markup=False)
    if write:
        console.print(f"Written: {rig}. Next: syntopic check", soft_wrap=True)
    else:
        console.print("Nothing is changed. --write writes it into the rig file")


def _boresight_of(service: Path) -> tuple[float, float, float]:
    """The boresight of a configuration next to the rig file; zero without one."""
    import tomllib

    try:
        mount = tomllib.loads(service.read_text(encoding="utf-8")).get("mount", {})
        roll, pitch, heading = (float(v) for v in mount.get("boresight_deg", (0.0, 0.0, 0.0)))
    except (OSError, ValueError, TypeError, AttributeError):
        return (0.0, 0.0, 0.0)
    return roll, pitch, heading


def _print(console: Console, proposal: ImageProposal, refined: dict[str, Any]) -> None:
    image = proposal.image
    for head, one in refined.items():
        console.print(
            f"{head}: rotated by {one['turned_deg']:.3f} degrees against the rig file, "
            f"{one['ties']} tie points, {one['rms_px']:.2f} px",
            markup=False,
        )
    table = light_table("Proposed [virtual_image]", ("",), ("value",))
    field = [
        math.degrees(2.0 * math.atan(n * image.pitch_mm / 2.0 / image.f_mm))
        for n in (image.width_px, image.height_px)
    ]
    for name, value in (
        ("size", f"{image.width_px} x {image.height_px} px"),
        ("pixel size", f"{image.pitch_um:g} um"),
        ("principal distance", f"{image.f_mm:.4f} mm"),
        ("field of view", f"{field[0]:.1f} x {field[1]:.1f} degrees"),
        ("share of what the heads see", f"{proposal.covered:.0%}"),
    ):
        table.add_row(name, value)
    console.print(table)
    strips = light_table("Overlaps", ("heads",), ("width px", "length px", "share"))
    for o in proposal.overlaps:
        strips.add_row(
            " - ".join(o.heads), f"{o.width_px:.0f}", f"{o.length_px:.0f}", f"{o.share:.0%}"
        )
    console.print(strips)
    for line in drawing(proposal):
        console.print(line, markup=False, highlight=False)


def drawing(proposal: ImageProposal) -> list[str]:
    """The fields of the heads as text: their numbers, # where they overlap, the image framed."""
    names = list(proposal.masks)
    masks = list(proposal.masks.values())
    side = masks[0].shape[0]
    half = (
        proposal.image.width_px / 2.0 / proposal.cell_px,
        proposal.image.height_px / 2.0 / proposal.cell_px,
    )
    rows = [k for k in range(side) if any(mask[k].any() for mask in masks)]
    columns = [k for k in range(side) if any(mask[:, k].any() for mask in masks)]

    def at(index: int, count: int, used: list[int]) -> int:
        return used[0] + round((used[-1] - used[0]) * index / (count - 1))

    frame_x = _nearest([at(k, _COLUMNS, columns) for k in range(_COLUMNS)], side, half[0])
    frame_y = _nearest([at(k, _ROWS, rows) for k in range(_ROWS)], side, half[1])
    lines = []
    for j in range(_ROWS):
        text = ""
        for i in range(_COLUMNS):
            here = [mask[at(j, _ROWS, rows), at(i, _COLUMNS, columns)] for mask in masks]
            on_x = frame_x[0] <= i <= frame_x[1]
            on_y = frame_y[0] <= j <= frame_y[1]
            if on_x and j in frame_y:
                text += "-"
            elif on_y and i in frame_x:
                text += "|"
            elif sum(here) > 1:
                text += "#"
            else:
                text += str(here.index(True) + 1) if any(here) else " "
        lines.append(text.rstrip())
    numbers = ", ".join(f"{k + 1} {name}" for k, name in enumerate(names))
    return [*lines, f"{numbers}, # overlap; the frame is the image"]


def _nearest(places: list[int], side: int, half: float) -> tuple[int, int]:
    """Indices of the two places nearest to the borders of the image."""
    middle = (side - 1) / 2.0
    low, high = (
        min(range(len(places)), key=lambda k: abs(places[k] - middle - sign * half))
        for sign in (-1.0, 1.0)
    )
    return low, high


def _as_json(proposal: ImageProposal) -> dict[str, Any]:
    image = proposal.image
    return {
        "virtual_image": {
            "width_px": image.width_px,
            "height_px": image.height_px,
            "pitch_um": image.pitch_um,
            "f_mm": image.f_mm,
        },
        "covered": proposal.covered,
        "overlaps": [
            {
                "heads": list(o.heads),
                "width_px": round(o.width_px, 1),
                "length_px": round(o.length_px, 1),
                "share": round(o.share, 4),
            }
            for o in proposal.overlaps
        ],
        "rotation_rad": {c.name: list(c.rotation_rad) for c in proposal.rig.cones},
        "position_mm": {c.name: list(c.position_mm) for c in proposal.rig.cones},
        "warnings": list(proposal.warnings),
    }

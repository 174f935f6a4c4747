"""`syntopic check --find-heads`: which heads there are, and what to write for them."""

from __future__ import annotations

import json
from typing import Any, NoReturn

import typer

from daemon.cli.exit_status import status_of
from daemon.terminal.console import Console, light_table


def find_heads(*, as_json: bool) -> NoReturn:
    """Ask the networks and the kernel for heads; the exit status is 0 where there is one."""
    found, problems = found_heads()
    sections = "\n\n".join(_section(head) for head in found)
    if as_json:
        typer.echo(json.dumps({"heads": found, "problems": problems, "toml": sections}))
    else:
        console = Console()
        table = light_table("", ("driver", "address", "model", "serial", "formats"), ())
        for head in found:
            settings, what = head["settings"], head["found"]
            where = settings.get("address") or settings.get("device", "")
            formats = ", ".join(what.get("formats", [])[:6])
            cells = (head["driver"], where, what["model"], what["serial"], formats)
            table.add_row(*cells)
        console.print(table)
        for problem in problems:
            console.print(problem, style="yellow", markup=False, soft_wrap=True)
        if found:
            console.print("Next: paste this into the service configuration, and name the sensors.")
            console.print(f"\n{sections}\n", markup=False, highlight=False, soft_wrap=True)
        else:
            console.print("No head was found. Check power and cables; see docs/reference/drivers.")
    raise typer.Exit(status_of(is_good=bool(found)))


def found_heads() -> tuple[list[dict[str, Any]], list[str]]:
    """Heads by driver, with the settings that reach them; and the drivers without an answer."""
    genicam, problems = _genicam_heads()
    video, more = v4l2_heads()
    return genicam + video, problems + more


def _genicam_heads() -> tuple[list[dict[str, Any]], list[str]]:
    from drivers.cameras.aravis import discovery
    from drivers.contract import DeviceError

    try:
        heads = discovery.heads()
    except DeviceError as error:
        return [], [str(error)]
    return [
        {
            "driver": "aravis",
            "settings": {"address": head.address, "serial": head.serial},
            "found": {"model": head.model, "vendor": head.vendor, "serial": head.serial},
        }
        for head in heads
    ], []


def v4l2_heads() -> tuple[list[dict[str, Any]], list[str]]:
    """The kernel's capture nodes alone; see `found_heads`."""
    from drivers.cameras.v4l2.discovery import capture_nodes
    from drivers.cameras.v4l2.formats import FORMATS

    found: list[dict[str, Any]] = []
    problems: list[str] = []
    for node in capture_nodes():
        ours = [name for name in node.formats if name in FORMATS]
        if node.problem:
            problems.append(f"{node.path}: {node.problem}; add this user to the group video")
        elif node.refusal:
            problems.append(f"{node.path} ({node.card}): {node.refusal}")
        elif not ours:
            problems.append(f"{node.path} ({node.card}) has no format that is one of ours")
        else:
            properties = {
                "model": node.card,
                "serial": node.serial,
                "bus": node.bus,
                "formats": ours,
            }
            widest = max(ours, key=lambda name: FORMATS[name].bits)
            settings = {"device": node.path, "pixel_format": widest}
            found.append({"driver": "v4l2", "settings": settings, "found": properties})
    return found, problems


def _section(head: dict[str, Any]) -> str:
    lines = ["[[head]]", 'sensor = ""  # to do: which sensor of the rig it is']
    lines.append(f"driver = {json.dumps(head['driver'])}")
    # JSON's texts are TOML's.
    lines += [f"{key} = {json.dumps(value)}" for key, value in head["settings"].items() if value]
    return "\n".join(lines)

"""`syntopic init`: find heads and receivers, ask a few questions, write the files."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.live import Live

from daemon.cli.exit_status import ExitStatus, status_of
from daemon.cli.find_ports import SearchProgress, result_table
from daemon.cli.init_answers import GivenAnswers
from daemon.cli.init_output import initialization_json, is_failed, print_end, print_rig
from daemon.cli.init_questions import Questions
from daemon.cli.options import AsJson
from daemon.initialization.new_configuration import refuse_existing, write_configuration
from daemon.initialization.provisional import assumptions
from daemon.terminal.console import Console, light_table

if TYPE_CHECKING:
    from daemon.initialization.answers import Answers
    from daemon.initialization.discovery import Discovery
    from daemon.initialization.service_text import TriggerUnit
    from daemon.onboard.preflight.check_results import CheckResult
    from drivers.detection.port_search import DetectionResult

HELP = """Find heads and receivers, ask at most eight questions, write rig.toml and service.toml.

Heads are found by GigE Vision and USB3 Vision discovery and as V4L2 devices. Receivers are
recognized at serial ports and usual addresses by their messages. Focal length and pixel size
suffice: the rig is then uncalibrated, and every product states so. The files are checked as
`syntopic check --fire` does, and values that are provisional are listed.

Options answer the questions. Without a terminal, --focal-length and --pixel-size are needed, and
--arrangement for several heads. Existing files are not changed without --replace.

Examples: `syntopic init`, `syntopic init my-rig --focal-length 50 --pixel-size 3.45`,
`syntopic init my-rig --head 10.0.0.11 --head 10.0.0.12 --arrangement side-by-side
--focal-length "50 50" --pixel-size 5.5 --angle 20 --port /dev/ttyUSB0 --yes`
"""
PORTS_TIMEOUT_S = 60.0


def init(
    folder: Annotated[
        Path, typer.Argument(help="Folder of the files; created if missing.")
    ] = Path(),
    head: Annotated[
        list[str] | None,
        typer.Option(help="Address or device of a head; repeated in the order of the arrangement."),
    ] = None,
    port: Annotated[
        list[str] | None,
        typer.Option(help="Port or address of a receiver; repeated (default: all serial ports)."),
    ] = None,
    no_receiver: Annotated[
        bool, typer.Option("--no-receiver", help="No search for receivers.")
    ] = False,
    arrangement: Annotated[
        str | None, typer.Option(help="single, side-by-side, fore-aft or nadir-oblique.")
    ] = None,
    focal_length: Annotated[
        list[str] | None, typer.Option(help="Focal length in mm, for all heads or for each.")
    ] = None,
    pixel_size: Annotated[
        list[str] | None, typer.Option(help="Pixel size in um, for all heads or for each.")
    ] = None,
    angle: Annotated[
        str | None,
        typer.Option(help="Angle between axes in degrees (default: 0; nadir-oblique: 45)."),
    ] = None,
    distance: Annotated[
        str | None, typer.Option(help="Distance between lenses in mm (default: 100).")
    ] = None,
    interval: Annotated[
        str | None, typer.Option(help="Time between exposures in s (default: 2).")
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the rig (default: the folder's).")
    ] = None,
    trigger_unit: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="Address of a trigger unit (default: software)."),
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="No questions: defaults for what is not given.")
    ] = False,
    replace_files: Annotated[
        bool, typer.Option("--replace", help="Keep existing files under another name.")
    ] = False,
    no_check: Annotated[bool, typer.Option("--no-check", help="No check of the devices.")] = False,
    as_json: AsJson = False,
) -> None:
    began = time.monotonic()
    console = Console(stderr=as_json)
    if not replace_files:
        refuse_existing(folder)
    given = GivenAnswers(
        arrangement=arrangement,
        focal_length=None if focal_length is None else " ".join(focal_length),
        pixel_size=None if pixel_size is None else " ".join(pixel_size),
        angle=angle,
        distance=distance,
        interval=interval,
        has_order=bool(head),
        asks=not yes and not as_json and sys.stdin.isatty(),
    )
    given.check_early()
    unit = _trigger_unit(trigger_unit)
    rig_name = _rig_name(name, folder)
    discovery = _heads(console, head or [])
    _require_heads(console, discovery, unit, as_json=as_json)
    found = [] if no_receiver else _receivers(console, port or [])
    answers = given.answers(rig_name, discovery.heads, Questions(console))
    print_rig(console, answers)
    if given.asks and not given.agree(f"Write rig.toml and service.toml into {folder.resolve()}"):
        console.print("Nothing was written.")
        raise typer.Exit(ExitStatus.DONE)
    receivers = [one for one in found if one.detected and one.detected.kind == "navigator"]
    written = _write(folder, answers, receivers, unit, replace_files=replace_files)
    provisional = assumptions(
        answers, has_receiver=bool(receivers), has_trigger_unit=unit is not None
    )
    results = [] if no_check else _check(console, folder)
    if as_json:
        typer.echo(
            json.dumps(
                initialization_json(
                    answers, found, written, provisional, results, time.monotonic() - began
                )
            )
        )
    else:
        print_end(console, folder, written, provisional, results)
    raise typer.Exit(status_of(is_good=not is_failed(results)))


def _trigger_unit(text: str | None) -> TriggerUnit | None:
    from daemon.initialization.service_text import TriggerUnit

    if text is None:
        return None
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise typer.BadParameter(f"--trigger-unit is {text!r}; write HOST:PORT")
    return TriggerUnit(host, int(port))


def _rig_name(name: str | None, folder: Path) -> str:
    from processing.rig.value_types import plain_name

    if name is not None and not plain_name(name):
        raise typer.BadParameter(
            f"--name is {name!r}; letters, digits, '_', '-' and inner dots only, 64 at most"
        )
    default = folder.resolve().name
    return name or (default if plain_name(default) else "rig")


def _heads(console: Console, wanted: Sequence[str]) -> Discovery:
    from daemon.initialization.discovery import discover

    with console.status("searching for heads"):
        return discover(wanted)


def _require_heads(
    console: Console, discovery: Discovery, unit: TriggerUnit | None, *, as_json: bool
) -> None:
    """Print what was found; end the command where it is not enough for a rig."""
    if discovery.heads:
        table = light_table("Heads", ("", "at", "model", "serial", "format"), ("pixels",))
        for number, one in enumerate(discovery.heads, start=1):
            size = f"{one.width_px} x {one.height_px}"
            table.add_row(f"{number} ", one.place, one.model, one.serial, one.pixel_format, size)
        console.print(table)
    for note in discovery.notes:
        console.print(note, style="yellow", soft_wrap=True)
    problems = list(discovery.problems)
    if unit is None:
        problems += [
            f"head {one.model} at {one.place} has no software trigger; give --trigger-unit "
            "HOST:PORT (docs/reference/drivers/pulse-bus.md)"
            for one in discovery.heads
            if not one.is_triggerable
        ]
    if not discovery.heads and not problems:
        problems.append(
            "No head was found. Check power and cables, and that this computer has an address in "
            "the network of the heads; give --head ADDRESS for a head that does not answer the "
            "discovery"
        )
    if not problems:
        return
    for problem in problems:
        console.print(problem, style="red", soft_wrap=True)
    if discovery.heads:
        console.print("To leave a head out, name the others with --head.")
    console.print("Nothing was written.")
    if as_json:
        typer.echo(json.dumps({"heads": [], "problems": problems, "written": []}))
    raise typer.Exit(ExitStatus.PROBLEM)


def _receivers(console: Console, ports: Sequence[str]) -> list[DetectionResult]:
    from drivers.detection.port_search import default_ports, search

    names = list(ports) or default_ports()
    progress = SearchProgress(names)
    with Live(console=console, get_renderable=progress.table, refresh_per_second=4, transient=True):
        found = search(
            names, ask=False, on_progress=progress.on_progress, timeout_s=PORTS_TIMEOUT_S
        )
    console.print("Receivers")
    console.print(result_table(found))
    for one in found:
        if one.detected is not None and one.detected.kind != "navigator":
            console.print(
                f"{one.port} is no receiver and is left out; syntopic check --find {one.port} "
                "prints its section.",
                style="yellow",
                soft_wrap=True,
            )
    return found


def _write(
    folder: Path,
    answers: Answers,
    receivers: Sequence[DetectionResult],
    unit: TriggerUnit | None,
    *,
    replace_files: bool,
) -> list[Path]:
    from daemon.initialization.rig_text import rig_text
    from daemon.initialization.service_text import service_text

    rig = rig_text(answers, written_by="syntopic init")
    service = service_text(
        answers, receivers, written_by="syntopic init", trigger_unit=unit, has_page=_has_page()
    )
    return write_configuration(folder, rig, service, replace=replace_files)


def _has_page() -> bool:
    from drivers.base.extras import MissingExtraError, require

    try:
        require("watch")
    except MissingExtraError:
        return False
    return True


def _check(console: Console, folder: Path) -> list[CheckResult]:
    from daemon.cli.check import collect_results
    from daemon.onboard.preflight.service_file import load

    path = folder / "service.toml"
    configuration, rig = load(path)
    with console.status("checking the files and every device, with one exposure"):
        return collect_results(configuration, rig, path, fire=True)

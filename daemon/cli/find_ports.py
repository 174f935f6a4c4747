"""`syntopic check --find`: detect the protocols at the ports of this computer."""

from __future__ import annotations

import json
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NoReturn

import typer
from rich.live import Live
from rich.table import Table
from rich.text import Text

from daemon.cli.exit_status import status_of
from daemon.terminal.console import Console, light_table
from drivers.base.extras import MissingExtraError, require

if TYPE_CHECKING:
    from drivers.detection.port_search import DetectionResult

NAMES = {"navigator": "gnss", "thermometer": "probes"}


def find(ports: Sequence[str], *, as_json: bool, ask: bool) -> NoReturn:
    """Search the given ports and addresses, or all serial ports and the usual addresses.

    The exit status is 0 where something was found, 1 where nothing was.
    """
    from drivers.detection.port_search import default_ports, search

    names = list(ports) or default_ports()
    console = Console(stderr=as_json)
    try:
        require("mavlink")
    except MissingExtraError as error:
        # Everything else is found without it.
        console.print(str(error), style="yellow", markup=False, soft_wrap=True)
    progress = SearchProgress(names)
    with Live(console=console, get_renderable=progress.table, refresh_per_second=4, transient=True):
        found = search(names, ask=ask, on_progress=progress.on_progress)
    sections = toml_sections(found)
    if as_json:
        typer.echo(json.dumps({"ports": [result_json(one) for one in found], "toml": sections}))
    else:
        _print(console, found, sections)
    raise typer.Exit(status_of(is_good=any(one.detected for one in found)))


class SearchProgress:
    """Progress at each port, reported by the threads that probe it."""

    def __init__(self, ports: Sequence[str]) -> None:
        self._doing = dict.fromkeys(ports, "opening")
        self._lock = threading.Lock()

    def on_progress(self, port: str, sentence: str) -> None:
        with self._lock:
            self._doing[port] = sentence

    def table(self) -> Table:
        table = light_table("", ("port", "doing"), ())
        with self._lock:
            for port, doing in self._doing.items():
                table.add_row(port, doing)
        return table


def toml_sections(found: Sequence[DetectionResult]) -> str:
    """The sections of a service configuration for all that was found."""
    taken: dict[str, int] = {}
    sections = []
    for one in found:
        detected = one.detected
        if detected is None:
            continue
        taken[detected.kind] = taken.get(detected.kind, 0) + 1
        number = taken[detected.kind]
        port = one.port.removeprefix("tcp://") if detected.driver == "gpsd" else one.port
        settings: dict[str, Any] = {
            "name": NAMES[detected.kind] + (str(number) if number > 1 else ""),
            "driver": detected.driver,
            "port": port,
        }
        if one.baudrate is not None:
            settings["baudrate"] = one.baudrate
            settings["parity"] = one.parity
        lines = [
            f"[[{detected.kind}]]",
            *(f"# to do: {text}" for text in [detected.missing] if text),
        ]
        # JSON's texts, numbers and lists of texts are TOML's.
        lines += [
            f"{key} = {json.dumps(v)}" for key, v in {**settings, **detected.settings}.items()
        ]
        sections.append("\n".join(lines))
    return "\n\n".join(sections) + ("\n" if sections else "")


def result_json(one: DetectionResult) -> dict[str, Any]:
    """What was found at a port, as JSON types."""
    detected = one.detected
    if detected is None:
        return {"port": one.port, "found": False, "sentence": one.sentence}
    return {
        "port": one.port,
        "found": True,
        "kind": detected.kind,
        "driver": detected.driver,
        "protocol": detected.protocol,
        "baudrate": one.baudrate,
        "parity": one.parity,
        "received": detected.received,
        "missing": detected.missing,
        "settings": dict(detected.settings),
    }


def result_table(found: Sequence[DetectionResult]) -> Table:
    """What was found at each port, or the reason why nothing was."""
    table = light_table("", ("port", "protocol", "received"), ("baud",))
    for one in found:
        if one.detected is None:
            table.add_row(one.port, Text("nothing", "dim"), one.sentence, "")
            continue
        received = one.detected.received
        if one.detected.missing:
            received += f"; missing: {one.detected.missing}"
        speed = "" if one.baudrate is None else f"{one.baudrate} {one.parity}"
        table.add_row(one.port, Text(one.detected.protocol, "green"), received, speed)
    return table


def _print(console: Console, found: Sequence[DetectionResult], sections: str) -> None:
    console.print(result_table(found))
    if not sections:
        console.print(
            "Nothing was found. Check power and cables; see docs/reference/drivers for each device."
        )
        return
    console.print("Next: paste this into the service configuration, then syntopic check it.")
    console.print(f"\n{sections}", markup=False, highlight=False, soft_wrap=True)

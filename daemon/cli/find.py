"""`syntopic check --find`: what speaks at the ports of this computer, and what to write for it."""

from __future__ import annotations

import json
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NoReturn

import typer
from rich.live import Live
from rich.table import Table
from rich.text import Text

from daemon.terminal.console import Console
from daemon.terminal.tables import light_table
from drivers.base.extras import MissingExtraError, require

if TYPE_CHECKING:
    from drivers.detection.search import Found

NAMES = {"navigator": "gnss", "thermometer": "probes"}


def find(ports: Sequence[str], *, as_json: bool, ask: bool) -> NoReturn:
    """Search the given ports and addresses, or all serial ports and the usual addresses.

    The exit status is 0 where something was found, 1 where nothing was.
    """
    from drivers.detection.search import search, usual_ports

    names = list(ports) or usual_ports()
    console = Console(stderr=as_json)
    try:
        require("mavlink")
    except MissingExtraError as error:
        # Everything else is found without it.
        console.print(str(error), style="yellow", markup=False, soft_wrap=True)
    progress = _Progress(names)
    with Live(console=console, get_renderable=progress.table, refresh_per_second=4, transient=True):
        found = search(names, ask=ask, tell=progress.tell)
    sections = toml_sections(found)
    if as_json:
        typer.echo(json.dumps({"ports": [_as_json(one) for one in found], "toml": sections}))
    else:
        _print(console, found, sections)
    raise typer.Exit(0 if any(one.speaker for one in found) else 1)


class _Progress:
    """What is being tried at each port; told from the threads that try it."""

    def __init__(self, ports: Sequence[str]) -> None:
        self._doing = dict.fromkeys(ports, "opening")
        self._lock = threading.Lock()

    def tell(self, port: str, sentence: str) -> None:
        with self._lock:
            self._doing[port] = sentence

    def table(self) -> Table:
        table = light_table("", ("port", "doing"), ())
        with self._lock:
            for port, doing in self._doing.items():
                table.add_row(port, doing)
        return table


def toml_sections(found: Sequence[Found]) -> str:
    """The sections of a service configuration for all that was found."""
    taken: dict[str, int] = {}
    sections = []
    for one in found:
        speaker = one.speaker
        if speaker is None:
            continue
        taken[speaker.kind] = taken.get(speaker.kind, 0) + 1
        number = taken[speaker.kind]
        port = one.port.removeprefix("tcp://") if speaker.driver == "gpsd" else one.port
        settings: dict[str, Any] = {
            "name": NAMES[speaker.kind] + (str(number) if number > 1 else ""),
            "driver": speaker.driver,
            "port": port,
        }
        if one.baudrate is not None:
            settings["baudrate"] = one.baudrate
            settings["parity"] = one.parity
        lines = [f"[[{speaker.kind}]]", *(f"# to do: {text}" for text in [speaker.missing] if text)]
        # JSON's texts, numbers and lists of texts are TOML's.
        lines += [f"{key} = {json.dumps(v)}" for key, v in {**settings, **speaker.settings}.items()]
        sections.append("\n".join(lines))
    return "\n\n".join(sections) + ("\n" if sections else "")


def _as_json(one: Found) -> dict[str, Any]:
    speaker = one.speaker
    if speaker is None:
        return {"port": one.port, "found": False, "sentence": one.sentence}
    return {
        "port": one.port,
        "found": True,
        "kind": speaker.kind,
        "driver": speaker.driver,
        "protocol": speaker.protocol,
        "baudrate": one.baudrate,
        "parity": one.parity,
        "heard": speaker.heard,
        "missing": speaker.missing,
        "settings": dict(speaker.settings),
    }


def _print(console: Console, found: Sequence[Found], sections: str) -> None:
    table = light_table("", ("port", "speaks", "heard"), ("baud",))
    for one in found:
        if one.speaker is None:
            table.add_row(one.port, Text("nothing", "dim"), one.sentence, "")
            continue
        heard = one.speaker.heard
        if one.speaker.missing:
            heard += f"; missing: {one.speaker.missing}"
        speed = "" if one.baudrate is None else f"{one.baudrate} {one.parity}"
        table.add_row(one.port, Text(one.speaker.protocol, "green"), heard, speed)
    console.print(table)
    if not sections:
        console.print(
            "Nothing was found. Check power and cables; see docs/drivers for each device."
        )
        return
    console.print("Next: paste this into the service configuration, then syntopic check it.")
    console.print(f"\n{sections}", markup=False, highlight=False, soft_wrap=True)

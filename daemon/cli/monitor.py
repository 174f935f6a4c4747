"""`syntopic monitor`: a flight watched from a terminal."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any

import typer
from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from daemon.errors import DaemonError
from daemon.tables import light_table
from daemon.watch.state import PARTS, PICTURE_PARTS
from drivers.extras import require

HELP = """Watch a flight from a terminal: phase, ledger, faults, the last exposures.

Without an address the services on the network are looked for; one is watched, several are listed.

Examples: `syntopic monitor`, `syntopic monitor 10.0.0.5:8470 --bytes-per-s 4000`
"""
FIND_S = 3.0
SILENT_S = 10.0
ROWS = 12
COLOURS = {"good": "green", "usable": "yellow", "refly": "red", "lost": "red"}
MARKS = {"good": "●", "usable": "▲", "refly": "■", "lost": "✖"}


class MonitorError(DaemonError):
    """Nothing can be watched; the sentence says why."""


@dataclass(frozen=True)
class Found:
    """A service that announced itself."""

    address: str
    text: dict[str, str]


def monitor(
    address: Annotated[str, typer.Argument(help="HOST:PORT; found by itself if left out.")] = "",
    token: Annotated[str, typer.Option(envvar="SYNTOPIC_TOKEN", help="If looking needs one.")] = "",
    bytes_per_s: Annotated[float, typer.Option(help="Budget of a thin link.", min=1000)] = 1e6,
    tls: Annotated[bool, typer.Option(help="The service speaks TLS.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the state once, as one JSON object.")
    ] = False,
) -> None:
    console = Console(stderr=as_json)
    if not address:
        found = find_services()
        if not found:
            raise MonitorError(
                f"no service was heard within {FIND_S:.0f} s; give its address: "
                "syntopic monitor HOST:PORT"
            )
        if len(found) > 1:
            console.print(_services_table(found))
            raise typer.Exit(2)
        address, tls = found[0].address, found[0].text.get("tls") == "true"
    scheme = "wss" if tls else "ws"
    url = f"{scheme}://{address}/api/v1/telemetry?form=msgpack&bytes_per_s={bytes_per_s:.0f}"
    state: _Seen | None = None
    with Live(Text(f"calling {address}"), console=console, refresh_per_second=4) as live:
        for record in _records(url, token):
            if record is None and state is not None:
                since = f"✖ NO LINK since {time.strftime('%H:%M:%S')}: what is shown is of then"
                live.update(Group(Text(since, style="bold red"), state.drawn(address)))
                state = None
            elif record is not None:
                # Each link tells all there is.
                state = state or _Seen()
                state.take(record)
                if as_json:
                    live.update(Text())
                    typer.echo(json.dumps(state.as_json()))
                    return
                live.update(state.drawn(address))


def find_services(within_s: float = FIND_S) -> list[Found]:
    """Services that announce themselves by multicast DNS on this network."""
    require("watch")
    from zeroconf import ServiceBrowser, ServiceStateChange, Zeroconf

    names: set[str] = set()

    def heard(
        zeroconf: Zeroconf, service_type: str, name: str, state_change: ServiceStateChange
    ) -> None:
        if state_change is ServiceStateChange.Added:
            names.add(name)

    zeroconf = Zeroconf()
    try:
        ServiceBrowser(zeroconf, "_syntopic._tcp.local.", handlers=[heard])
        time.sleep(within_s)
        found = []
        for name in sorted(names):
            info = zeroconf.get_service_info("_syntopic._tcp.local.", name, timeout=1000)
            if info is not None and info.parsed_addresses():
                text = {k.decode(): (v or b"").decode() for k, v in info.properties.items()}
                found.append(Found(f"{info.parsed_addresses()[0]}:{info.port}", text))
        return found
    finally:
        zeroconf.close()


class _Seen:
    """The state as far as it was told."""

    def __init__(self) -> None:
        self.brief: dict[str, Any] = {}
        self.exposures: dict[int, dict[str, Any]] = {}
        self.devices: dict[str, dict[str, Any]] = {}

    def take(self, record: dict[str, Any]) -> None:
        for one in record.pop("exposures", []):
            self.exposures[one["number"]] = one
        for one in record.pop("devices", []):
            self.devices[one["name"]] = one
        for part in (*PARTS, *PICTURE_PARTS):
            record.pop(part, None)
        self.brief = record

    def as_json(self) -> dict[str, Any]:
        return {
            **self.brief,
            "exposures": list(self.exposures.values()),
            "devices": list(self.devices.values()),
        }

    def drawn(self, address: str) -> Group:
        status = self.brief.get("status", {})
        ledger = (status.get("ledger") or {}).get("triggers", {})
        mark = "SIMULATED  " if self.brief.get("simulated") else ""
        head = Text(f"{mark}{self.brief['mission'].get('id', '')}  {address}\n", style="bold")
        head.append(
            f"{self.brief['phase']}   triggers {ledger.get('triggers', 0)}, complete "
            f"{ledger.get('complete', 0)}, degraded {ledger.get('degraded', 0)}, lost "
            f"{ledger.get('lost', 0)}   {status.get('exposures_left', '?')} exposures left   "
            f"clock ±{_duration(status.get('clock_sigma_ns'))}"
        )
        return Group(Panel(head), *self._faults(), self._table())

    def _faults(self) -> Iterator[Text]:
        for fault in self.brief.get("faults", []):
            word, style = ("✖ WARNING", "red") if fault["stands"] else ("▲ passed", "yellow")
            yield Text(f"{word}  {fault['sentence']}", style=style)

    def _table(self) -> Table:
        table = light_table("", ("exposure", "verdict"), ("frames", "s0 px", "dC", "tie points"))
        for _, one in sorted(self.exposures.items())[-ROWS:]:
            figures, verdict = one.get("figures", {}), str(one.get("verdict") or "")
            word = verdict or str(one["step"])
            table.add_row(
                str(one["number"]),
                Text(f"{MARKS.get(word, '')} {word}", COLOURS.get(word, "")),
                str(one.get("frames", "")),
                _number(figures.get("sigma0_px"), ".3f"),
                _number(figures.get("dc_k"), "+.1f"),
                f"{figures.get('tie_points_pp', '')}",
            )
        return table


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _duration(ns: float | None) -> str:
    """Nanoseconds, in the unit that suits."""
    if ns is None:
        return "?"
    for factor, unit in ((1e9, "s"), (1e6, "ms"), (1e3, "us")):
        if ns >= factor:
            return f"{ns / factor:.3g} {unit}"
    return f"{ns:.0f} ns"


def _records(url: str, token: str) -> Iterator[dict[str, Any] | None]:
    """Telemetry for ever; None when the link breaks, which is taken up again."""
    require("watch")
    import msgpack
    from websockets.exceptions import ConnectionClosed, InvalidHandshake
    from websockets.sync.client import connect

    told = False
    while True:
        try:
            with connect(f"{url}&token={token}" if token else url, max_size=16_000_000) as link:
                while True:
                    yield msgpack.unpackb(link.recv(timeout=SILENT_S))
                    told = True
        except (ConnectionClosed, InvalidHandshake, OSError, TimeoutError) as error:
            if not told:
                raise MonitorError(
                    f"{url.split('?')[0]}: no telemetry ({error}); look at the address, and "
                    "whether looking needs a token"
                ) from error
            yield None
            time.sleep(1.0)


def _services_table(found: list[Found]) -> Table:
    table = light_table("Several services; name one", ("address", "rig", "mission", "phase"), ())
    for one in found:
        table.add_row(one.address, *(one.text.get(key, "") for key in ("rig", "mission", "phase")))
    return table

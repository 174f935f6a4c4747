"""`syntopic monitor`: a flight watched from a terminal."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pydantic import BaseModel, Field, FiniteFloat, ValidationError
from rich.console import Group
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from daemon import DaemonError
from daemon.cli.exit_status import ExitStatus
from daemon.onboard.monitoring.flight_state import EXPOSURES_MAX, PARTS, PREVIEW_PARTS
from daemon.terminal.console import Console, light_table
from processing.rig.problem_sentences import findings_of, sentences

if TYPE_CHECKING:
    from daemon.onboard.monitoring.client.mdns_browser import AnnouncedService

HELP = """Monitor a flight from a terminal: phase, ledger, faults, the last exposures.

Without an address announced services are listed; a single one is monitored. An
announcement determines neither TLS nor the receiver of a token: https:// or --tls requires TLS,
and a token is sent only to a given address.

With --serve the services at several addresses, or all announced ones, are gathered on one page:
one row each, and their alarms merged.

Examples: `syntopic monitor`, `syntopic monitor 10.0.0.5:8470 --bytes-per-s 4000`,
`syntopic monitor https://camera1.local:8470 --authority authority.pem`,
`syntopic monitor --serve 8480 10.0.0.5 10.0.0.6`
"""
ROWS = 12
FAULTS_SHOWN = 20
DEVICES_MAX = 500
COLOURS = {"good": "green", "usable": "yellow", "refly": "red", "lost": "red"}
MARKS = {"good": "●", "usable": "▲", "refly": "■", "lost": "✖"}


class MonitorError(DaemonError):
    """No service can be monitored; the message contains the reason."""


class _Figures(BaseModel):
    sigma0_px: FiniteFloat | None = None
    dc_k: FiniteFloat | None = None
    tie_points_pp: int | None = None


class _Exposure(BaseModel):
    number: int = Field(ge=0, lt=10**9)
    step: str = ""
    verdict: str | None = None
    frames: int | None = None
    figures: _Figures = _Figures()


class _Device(BaseModel):
    name: str


class _Fault(BaseModel):
    sentence: str
    stands: bool


class _Mission(BaseModel):
    id: str = ""


class _Triggers(BaseModel):
    triggers: int = 0
    complete: int = 0
    degraded: int = 0
    lost: int = 0


class _Ledger(BaseModel):
    triggers: _Triggers = _Triggers()


class _Status(BaseModel):
    ledger: _Ledger | None = None
    exposures_left: int | None = None
    clock_sigma_ns: FiniteFloat | None = None


class _Record(BaseModel):
    """What is drawn of a telemetry record (docs/reference/flight/telemetry.md).

    Other keys are only passed on.
    """

    phase: str
    simulated: bool = False
    mission: _Mission
    status: _Status = _Status()
    faults: list[_Fault] = []
    exposures: list[_Exposure] = []
    devices: list[_Device] = []


def monitor(
    addresses: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ADDRESS]...",
            help="HOST:PORT or URL (default: discovered by mDNS); several with --serve.",
        ),
    ] = None,
    token: Annotated[
        str, typer.Option(envvar="SYNTOPIC_TOKEN", help="Access token, if reading requires one.")
    ] = "",
    bytes_per_s: Annotated[
        float, typer.Option(help="Budget of a slow link in bytes per second.", min=1000, max=1.5e6)
    ] = 1e6,
    tls: Annotated[bool, typer.Option(help="TLS, as with https://.")] = False,
    authority: Annotated[
        Path | None, typer.Option(help="PEM file of the trusted authority (default: system's).")
    ] = None,
    token_without_tls: Annotated[
        bool, typer.Option("--token-without-tls", help="Permission to send the token unencrypted.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the state once, as one JSON object.")
    ] = False,
    serve: Annotated[
        str, typer.Option(help="HOST:PORT or PORT of a page that shows several aircraft.")
    ] = "",
    serve_without_token: Annotated[
        bool,
        typer.Option(
            "--serve-without-token",
            help="Permission to serve other machines what requires --token, without token and TLS.",
        ),
    ] = False,
) -> None:
    from daemon.onboard.monitoring.client.telemetry_client import (
        AccessOptions,
        parse_service_address,
        telemetry_records,
    )

    console = Console(stderr=as_json)
    given = addresses or []
    access = AccessOptions(token, authority, token_without_tls)
    if serve:
        from daemon.cli.monitor_fleet import serve_fleet

        named = given or _announced_services(token)
        members = [parse_service_address(one, tls=tls) for one in named]
        serve_fleet(serve, members, access, is_open=serve_without_token)
        return
    if len(given) > 1:
        raise MonitorError("one service is monitored in a terminal; for several add --serve 8480")
    service = parse_service_address(given[0] if given else _single_service(console, token), tls=tls)
    state: _MonitorState | None = None
    with Live(Text(f"calling {service.address}"), console=console, refresh_per_second=4) as live:
        for record in telemetry_records(service, access, bytes_per_s):
            if record is None and state is not None:
                since = f"✖ Connection lost {time.strftime('%H:%M:%S')}. Values are frozen."
                live.update(Group(Text(since, style="bold red"), state.drawn(service.address)))
                state = None
            elif record is not None:
                # The first record of a connection is complete.
                state = state or _MonitorState()
                state.receive(record)
                if as_json:
                    live.update(Text())
                    typer.echo(json.dumps(state.as_json()))
                    return
                live.update(state.drawn(service.address))


def _announced_services(token: str) -> list[str]:
    """The addresses of all announced services, for one page; none of them gets a token."""
    from daemon.onboard.monitoring.client.mdns_browser import find_services

    if token:
        raise MonitorError("a token is not sent to announced addresses; give the addresses")
    found = [one.address for one in find_services()]
    if not found:
        raise MonitorError("no service announced itself; give the addresses of the services")
    return found


def _single_service(console: Console, token: str) -> str:
    """The address of the service that announces itself, where there is one and no token."""
    from daemon.onboard.monitoring.client.mdns_browser import BROWSE_S, SERVICES_MAX, find_services

    found = find_services()
    if not found:
        raise MonitorError(
            f"no service announced itself within {BROWSE_S:.0f} s; give its address: "
            "syntopic monitor HOST:PORT"
        )
    if len(found) == 1 and not token:
        return found[0].address
    console.print(_services_table(found))
    if token:
        raise MonitorError(
            "a token is not sent to an address that was only announced, since any host can "
            "announce one; give the address: syntopic monitor https://HOST:PORT"
        )
    if len(found) >= SERVICES_MAX:
        raise MonitorError(f"{SERVICES_MAX} services or more announce themselves; give an address")
    raise typer.Exit(ExitStatus.REFUSED)


class _MonitorState:
    """The state as received so far."""

    def __init__(self) -> None:
        self.brief: dict[str, Any] = {}
        self.exposures: dict[int, dict[str, Any]] = {}
        self.devices: dict[str, dict[str, Any]] = {}
        self._drawn: dict[int, _Exposure] = {}
        self._record: _Record | None = None

    def receive(self, record: dict[str, Any]) -> None:
        """Add a record.

        Raises:
            MonitorError: it does not have the form of docs/reference/flight/telemetry.md.
        """
        try:
            validated = _Record.model_validate(record)
        except ValidationError as error:
            raise MonitorError(
                f"the service sends invalid telemetry: {sentences(findings_of(error))[0]}. Look "
                "at the address, and at the version of both sides"
            ) from None
        self._record = validated
        for exposure, content in zip(validated.exposures, record.pop("exposures", []), strict=True):
            self.exposures[exposure.number], self._drawn[exposure.number] = content, exposure
        for device, content in zip(validated.devices, record.pop("devices", []), strict=True):
            self.devices[device.name] = content
        for entries, limit in ((self.exposures, EXPOSURES_MAX), (self._drawn, EXPOSURES_MAX)):
            _drop_oldest(entries, limit)
        _drop_oldest(self.devices, DEVICES_MAX)
        for part in (*PARTS, *PREVIEW_PARTS):
            record.pop(part, None)
        self.brief = record

    def as_json(self) -> dict[str, Any]:
        return {
            **self.brief,
            "exposures": list(self.exposures.values()),
            "devices": list(self.devices.values()),
        }

    def drawn(self, address: str) -> Group:
        assert self._record is not None
        status, mission = self._record.status, self._record.mission
        triggers = (status.ledger or _Ledger()).triggers
        left = "?" if status.exposures_left is None else status.exposures_left
        mark = "SIMULATED  " if self._record.simulated else ""
        head = Text(f"{mark}{mission.id}  {address}\n", style="bold")
        head.append(
            f"{self._record.phase}   triggers {triggers.triggers}, complete {triggers.complete}, "
            f"degraded {triggers.degraded}, lost {triggers.lost}   {left} exposures left   "
            f"clock ±{_duration(status.clock_sigma_ns)}"
        )
        return Group(Panel(head), *self._faults(self._record.faults), self._table())

    def _faults(self, faults: list[_Fault]) -> Iterator[Text]:
        for fault in faults[:FAULTS_SHOWN]:
            verdict_or_step, style = (
                ("✖ WARNING", "red") if fault.stands else ("▲ cleared", "yellow")
            )
            yield Text(f"{verdict_or_step}  {fault.sentence}", style=style)
        if len(faults) > FAULTS_SHOWN:
            yield Text(f"and {len(faults) - FAULTS_SHOWN} more faults", style="red")

    def _table(self) -> Table:
        table = light_table("", ("exposure", "verdict"), ("frames", "s0 px", "dC", "tie points"))
        for number, one in sorted(self._drawn.items())[-ROWS:]:
            verdict_or_step = one.verdict or one.step
            table.add_row(
                str(number),
                Text(
                    f"{MARKS.get(verdict_or_step, '')} {verdict_or_step}",
                    COLOURS.get(verdict_or_step, ""),
                ),
                _number(one.frames, "d"),
                _number(one.figures.sigma0_px, ".3f"),
                _number(one.figures.dc_k, "+.1f"),
                _number(one.figures.tie_points_pp, "d"),
            )
        return table


def _drop_oldest(entries: dict[Any, Any], limit: int) -> None:
    while len(entries) > limit:
        del entries[next(iter(entries))]


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


def _services_table(found: list[AnnouncedService]) -> Table:
    columns = ("rig", "mission", "phase", "tls")
    table = light_table("Announced services; name one", ("address", *columns), ())
    for one in found:
        table.add_row(one.address, *(Text(one.text.get(key, "")) for key in columns))
    return table

"""`syntopic sim`: the emulated devices alone, for any program to connect to.

The emulator runs in processes of its own; this module starts it and reads its output.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from daemon import DaemonError
from daemon.cli.options import AsJson
from daemon.configuration.schemas import SCHEMA_FILES, schema_file_name, schema_line
from daemon.mission.store.durable import replace_file
from daemon.mission.store.output_places import refuse_foreign_file, refuse_occupied
from daemon.terminal.console import Console
from drivers.base.extras import require
from processing.rig import find_rig

HELP = """Run the emulated devices of a rig until Ctrl-C.

Prints their addresses and writes a matching service configuration for the daemon. Any other GigE
Vision, u-blox or Modbus program can connect as well.

Example: `syntopic sim ultracam-x-mini --out flights/sim --fault silent@60:receiver,8` and then
`syntopic run flights/sim/service.toml`
"""


GVCP_PORT = 3956
_WRITTEN_BY = b"# Written by `syntopic sim`"


class EmulatorError(DaemonError):
    """The emulator did not start; the message is its last output."""


class Emulator:
    """A running emulator process and its first output.

    It ends with the thread that created it.
    """

    def __init__(self, arguments: Sequence[str]) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "sim_hw", *arguments, "--parent", str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        assert self.process.stdout is not None
        self.ready: dict[str, Any] = {}
        try:
            for line in self.process.stdout:
                message = json.loads(line)
                if message.get("event") == "ready":
                    self.ready = message
                    return
        except BaseException:
            self.end()
            raise
        raise EmulatorError(f"the emulator ended with status {self.process.wait(10)}; see above")

    def add_fault(self, text: str) -> None:
        """Plan a fault, NAME@TIME[:DEVICE][,DURATION], of an emulator with `--read-faults`."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{text}\n")
        self.process.stdin.flush()

    def end(self) -> None:
        """Close all devices."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(10)
            except subprocess.TimeoutExpired:
                os.killpg(self.process.pid, signal.SIGKILL)
                self.process.wait(10)


def sim(
    rig: Annotated[str, typer.Argument(help="Name of a shipped rig, or a rig file.")],
    out: Annotated[Path, typer.Option(help="Folder for calibration, truth and scene.")] = Path(
        "flights/sim"
    ),
    seed: Annotated[int, typer.Option(help="Seed for all random generators.")] = 1,
    dc: Annotated[float, typer.Option(help="Temperature above calibration in K.")] = 0.0,
    displace: Annotated[
        list[str] | None,
        typer.Option(help="Displacement of a sensor in px: SU02=1.0,-0.6; repeatable."),
    ] = None,
    packet_loss: Annotated[float, typer.Option(help="Share of image packets lost.")] = 0.0,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            help="NAME@TIME[:DEVICE][,DURATION], see docs/reference/results/faults.md; repeatable."
        ),
    ] = None,
    scenario: Annotated[Path | None, typer.Option(help="Scenario file with faults.")] = None,
    receiver: Annotated[
        str,
        typer.Option(
            help="Receiver: ublox, novatel, septentrio, nmea, sbg, vectornav, xsens, applanix, "
            "gsof or mavlink."
        ),
    ] = "ublox",
    probe: Annotated[str, typer.Option(help="Thermometer: modbus or ascii.")] = "modbus",
    pps: Annotated[bool, typer.Option("--pps", help="Emulated pulse per second.")] = False,
    first_address: Annotated[
        str, typer.Option(help="Address of the first head (default: a free one).")
    ] = "",
    scene: Annotated[
        Path | None, typer.Option(help="GeoTIFF as the ground (default: generated scene).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    if scene is not None:
        require("geotiff")
    refuse_foreign_flight(out)
    arguments = simulator_arguments(
        rig, out, seed=seed, dc=dc, displace=displace or [], packet_loss=packet_loss
    )
    arguments += ["--first-address", first_address or free_first_address()]
    arguments += ["--scene", str(scene)] if scene else []
    arguments += ["--receiver", receiver, "--probe", probe, *(["--pps"] if pps else [])]
    for planned in fault or []:
        arguments += ["--fault", planned]
    arguments += ["--scenario", str(scenario)] if scenario else []
    emulator = Emulator(arguments)
    path = out / "service.toml"
    text = service_toml(emulator.ready, root="missions", watch_port=8470)
    write_service_file(path, text)
    if as_json:
        typer.echo(json.dumps(emulator.ready | {"configuration": str(path)}))
    else:
        _print_addresses(emulator.ready, path)
    try:
        emulator.process.wait()
    finally:
        emulator.end()


def refuse_foreign_flight(folder: Path) -> None:
    """Refuse a folder with a configuration or a calibration that the emulator did not write.

    Raises:
        OutputPlaceError: it has one.
    """
    cure = "give another folder with --out"
    refuse_foreign_file(folder / "service.toml", lambda head: _WRITTEN_BY in head, cure=cure)
    if not (folder / "truth").is_dir():
        refuse_occupied(folder / "calibration", cure=cure)


def simulator_arguments(
    rig: str,
    out: Path,
    *,
    seed: int,
    dc: float,
    displace: Sequence[str],
    packet_loss: float = 0.0,
) -> list[str]:
    """The emulator's command line."""
    out.mkdir(parents=True, exist_ok=True)
    arguments = [rig, "--out", str(out), "--seed", str(seed), "--dc", str(dc)]
    for item in displace:
        arguments += ["--displace", item]
    return [*arguments, "--packet-loss", str(packet_loss)] if packet_loss else arguments


def free_first_address() -> str:
    """The first loopback block 127.p.k.2 on which no emulated rig answers yet.

    p is this process's own, so that rigs started at the same moment do not choose the same one, and
    a service that searches for the heads of an earlier flight does not find these.
    """
    own = 1 + os.getpid() % 250
    for block in range(256):
        address = f"127.{own}.{block}.2"
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind((address, GVCP_PORT))
            except OSError:
                continue
            return address
    raise EmulatorError("256 emulated rigs are running here already; end one of them")


def write_service_file(path: Path, text: str) -> None:
    """Write a service configuration, and the schema that its first line names."""
    replace_file(path.parent / schema_file_name("service"), SCHEMA_FILES["service"].read_bytes())
    replace_file(path, text.encode("utf-8"))


def service_toml(
    ready: Mapping[str, Any],
    *,
    root: str,
    count: int | None = None,
    baselines: bool = False,
    end_when_done: bool = False,
    watch_port: int | None = None,
) -> str:
    """A service configuration that fits the emulated devices.

    Clients are served on `watch_port` (0: a free port; None: no monitoring).
    """
    plan = ready["plan"]
    rig = find_rig(ready["rig_file"])
    probes = ready["probes"]
    host, _, port = ready["pulse_bus"].rpartition(":")
    lines = [
        schema_line("service"),
        f"{_WRITTEN_BY.decode()} for the devices it emulates.",
        "[mission]",
        f"root = {_quoted(root)}",
        f"rig = {_quoted(str(Path(ready['rig_file']).resolve()))}",
        f"radiometry = {_quoted(str(Path(ready['calibration']).resolve() / 'radiometry'))}",
        "simulated = true",
        f"end_when_done = {str(end_when_done).lower()}",
        "",
        "[plan]",
        'line = "1"',
        f"ground_height_m = {plan['ground_height_m']}",
        f"height_above_ground_m = {plan['height_above_ground_m']}",
        f"ground_speed_mps = {plan['ground_speed_mps']}",
        "",
        "[trigger]",
        'driver = "pulse-bus"',
        f"host = {_quoted(host)}",
        f"port = {port}",
        'mode = "distance"',
        f"distance_m = {plan['distance_m']}",
        *([f"count = {count}"] if count else []),
        "",
        "[processing]",
        f"baselines = {str(baselines).lower()}",
        *(
            ["", "[watch]", f"port = {watch_port}", 'tokens = "tokens.toml"']
            if watch_port is not None
            else []
        ),
        *(_section("thermometer", "probes", probes) if rig.probes else []),
        *_section("navigator", "gnss", ready["receiver"]),
        *(_section("pps", "pps", ready["pps"]) if ready.get("pps") else []),
    ]
    for sensor, head in ready["heads"].items():
        lines += [
            "",
            "[[head]]",
            f"sensor = {_quoted(sensor)}",
            'driver = "aravis"',
            f"address = {_quoted(head['address'])}",
            'trigger_source = "line"',
            f"exposure_time_us = {float(plan['exposure_time_us'][rig.cone_of(sensor).name])}",
            f"tdi_shifts = {plan['tdi_shifts'][rig.cone_of(sensor).name]}",
        ]
    return "\n".join(lines) + "\n"


def _section(kind: str, name: str, settings: Mapping[str, Any]) -> list[str]:
    """A device's section: JSON's texts, numbers and lists of texts are TOML's."""
    lines = ["", f"[[{kind}]]", f"name = {_quoted(name)}"]
    lines += [f"{key} = {json.dumps(value)}" for key, value in settings.items()]
    if settings["driver"] == "modbus-rtu":
        lines.append('parity = "N"  # a pseudo terminal has no parity')
    return lines


def _quoted(text: str) -> str:
    return json.dumps(text)


def _print_addresses(ready: Mapping[str, Any], path: Path) -> None:
    console = Console()
    console.print(f"{ready['rig']} is up: {len(ready['heads'])} GigE Vision heads")
    addresses = "  ".join(f"{name} {head['address']}" for name, head in ready["heads"].items())
    console.print(f"  heads     {addresses}")
    console.print(f"  trigger   pulse bus at {ready['pulse_bus']}")
    for title, device in (("receiver", ready["receiver"]), ("probes", ready["probes"])):
        console.print(f"  {title:8}  {device['driver']} at {device['port']}")
    console.print(f"  truth     {ready['truth']}")
    console.print(f"Next, in another terminal: syntopic check {path}, then run it.")
    console.print("Ctrl-C ends the emulator.")

"""`syntopic check`: is everything in place for a flight, and if not, what helps?"""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.tree import Tree

from daemon.cli.find import find as find_devices
from daemon.cli.find_heads import find_heads

HELP = """Validate a configuration, open every device, and print what is well and what is not.

The exit status is 0 when all is well, 1 when a device is not, 2 when the configuration is refused.

With `--find`, find out what speaks at serial ports, tcp://host:port, udpin://host:port (those
given, or all serial ports and the usual addresses): protocol, speed, and the configuration for it.
With `--find-heads`, which GigE Vision, USB3 Vision and V4L2 heads there are, and the same.

Examples: `syntopic check flights/sim/service.toml`, `syntopic check --find`,
`syntopic check --find /dev/ttyUSB0 tcp://10.0.0.5:3001`
"""
BIND_TIMEOUT_S = 25.0


def check(
    targets: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="CONFIG | PORT...", help="Service configuration (TOML); with --find, ports."
        ),
    ] = None,
    find: Annotated[
        bool, typer.Option("--find", help="Find out what speaks at ports, and how fast.")
    ] = False,
    heads: Annotated[
        bool, typer.Option("--find-heads", help="Find out which heads there are.")
    ] = False,
    listen_only: Annotated[
        bool, typer.Option("--listen-only", help="With --find, send nothing to any port.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    if find:
        find_devices(targets or [], as_json=as_json, ask=not listen_only)
    if heads:
        find_heads(as_json=as_json)
    if targets is None or len(targets) != 1:
        raise typer.BadParameter(
            "give one service configuration, or --find and ports, or --find-heads"
        )
    check_devices(Path(targets[0]), as_json=as_json)


def check_devices(config: Path, *, as_json: bool) -> None:
    """Open every device of a configuration and say what is well and what is not."""
    from daemon.configuration import load

    configuration, rig = load(config)
    console = Console(stderr=as_json)
    with console.status("opening devices"):
        findings = _open_all(configuration, rig)
    well = all(finding["ok"] for finding in findings)
    if as_json:
        typer.echo(json.dumps({"rig": rig.name, "ok": well, "devices": findings}))
    else:
        _print_tree(console, config, rig.name, findings)
        if well:
            console.print(f"All well. Next: [bold]syntopic run {config}[/]")
        else:
            console.print("[bold red]Not ready[/]; see the cures above.")
    raise typer.Exit(0 if well else 1)


def _open_all(configuration: Any, rig: Any) -> list[dict[str, Any]]:
    """Bind every device at once, each in its own thread and each with a time-out."""
    from daemon.service.capture import open_device
    from daemon.service.devices import device_specs, frame_nbytes, serial_problem
    from daemon.service.memory import FrameRing

    findings: list[dict[str, Any]] = []
    threads: list[tuple[threading.Thread, dict[str, Any]]] = []
    heads: dict[str, list[Any]] = {}
    for spec in device_specs(configuration, rig):
        finding: dict[str, Any] = {
            "kind": spec.kind,
            "name": spec.name,
            "driver": spec.driver,
            "ok": False,
        }
        memory = None
        if spec.kind == "head":
            memory = FrameRing.create(spec.name, 2, frame_nbytes(rig, spec.name))
        device = open_device(spec, memory=memory, heads=heads)
        if spec.kind == "head":
            heads.setdefault(spec.output, []).append(device)
        findings.append(finding)
        thread = threading.Thread(target=_bind, args=(device, finding), daemon=True)
        threads.append((thread, finding))
        thread.start()
    deadline = time.monotonic() + BIND_TIMEOUT_S
    for thread, finding in threads:
        thread.join(max(0.0, deadline - time.monotonic()))
        if thread.is_alive():
            finding["problem"] = (
                f"no answer within {BIND_TIMEOUT_S:g} s while opening it; check cable and power"
            )
    for finding in findings:
        if finding["kind"] == "head" and finding["ok"]:
            problem = serial_problem(rig, finding["name"], finding["found"])
            if problem is not None:
                finding |= {"ok": False, "problem": problem}
    return findings


def _bind(device: Any, finding: dict[str, Any]) -> None:
    from drivers.contract import DeviceError

    try:
        finding["found"] = dict(device.bind())
    except DeviceError as error:
        finding["problem"] = str(error)
        return
    finally:
        device.close()
    finding["ok"] = True


def _print_tree(
    console: Console, config: Path, rig_name: str, findings: list[dict[str, Any]]
) -> None:
    tree = Tree(f"[bold]{config}[/] for {rig_name}: valid")
    for kind in dict.fromkeys(finding["kind"] for finding in findings):
        branch = tree.add(kind)
        for finding in findings:
            if finding["kind"] != kind:
                continue
            label = f"{finding['name']} ({finding['driver']})"
            if finding["ok"]:
                told = ", ".join(f"{k} {v}" for k, v in finding.get("found", {}).items())
                branch.add(f"[green]ok[/] {label}: {told}")
            else:
                branch.add(f"[red]not ok[/] {label}: {finding.get('problem', 'no answer')}")
    console.print(tree)

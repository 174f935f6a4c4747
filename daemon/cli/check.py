"""`syntopic check`: is everything in place for a flight, and if not, what helps?"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text
from rich.tree import Tree

from daemon.cli.exit_status import ExitStatus
from daemon.cli.find_heads import find_heads
from daemon.cli.find_ports import find as find_devices
from daemon.cli.options import AsJson
from daemon.terminal.console import Console, light_table

if TYPE_CHECKING:
    from daemon.configuration.model import Configuration
    from daemon.onboard.preflight.check_results import CheckResult
    from processing.rig import Rig

HELP = """Validate a configuration, build the service, and verify each device with one datum.

Prerequisites, pipeline, kernels, page and arming are checked with the functions that `run` uses.
Only with `--fire` one exposure is fired to verify frames and event marks. While the
service runs, it is queried over its control socket, and no device is opened. An item is
waiting if, for example, its receiver searches.

With `--find`, detect the protocols at serial ports, tcp://host:port, udpin://host:port (those
given, or all serial ports and the usual addresses): protocol, speed, and the configuration for it.
With `--find-heads`, search for GigE Vision, USB3 Vision and V4L2 heads.

For heads on a network, the computer and the path of each head are examined: MTU by test packets,
receive buffers, reverse-path filter, firewall, subnets, dropped packets. The link budget is
printed: what the heads of each interface send per exposure, the time that takes, and the pause
between packets that each head is given.

Examples: `syntopic check flights/sim/service.toml`, `syntopic check service.toml --fire --json`,
`syntopic check --find`, `syntopic check --find /dev/ttyUSB0 tcp://10.0.0.5:3001`
"""
STATUSES = {
    "pass": ExitStatus.DONE,
    "fail": ExitStatus.PROBLEM,
    "waiting": ExitStatus.WAITING,
}
COLOURS = {"pass": "green", "waiting": "yellow", "fail": "red", "not tried": "dim"}


def check(
    targets: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="CONFIG | PORT...", help="Service configuration (TOML); with --find, ports."
        ),
    ] = None,
    find: Annotated[
        bool, typer.Option("--find", help="Detection of protocol and speed at ports.")
    ] = False,
    heads: Annotated[bool, typer.Option("--find-heads", help="Search for heads.")] = False,
    listen_only: Annotated[
        bool, typer.Option("--listen-only", help="With --find: no transmission to any port.")
    ] = False,
    fire: Annotated[
        bool, typer.Option("--fire", help="One exposure to verify frames and event marks.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    if find:
        find_devices(targets or [], as_json=as_json, ask=not listen_only)
    if heads:
        find_heads(as_json=as_json)
    if targets is None or len(targets) != 1:
        raise typer.BadParameter(
            "give one service configuration, or --find and ports, or --find-heads"
        )
    check_flight(Path(targets[0]), fire=fire, as_json=as_json)


def check_flight(config: Path, *, fire: bool, as_json: bool) -> None:
    """Look at everything a flight with this configuration needs, and print it."""
    from daemon.onboard.preflight.check_results import CheckOutcome, worst_outcome
    from daemon.onboard.preflight.prerequisites import link_tables
    from daemon.onboard.preflight.service_file import load

    configuration, rig = load(config)
    console = Console(stderr=as_json)
    with console.status("looking at what a flight needs"):
        results = collect_results(configuration, rig, config, fire=fire)
        links = link_tables(configuration, rig)
    outcome = worst_outcome(results)
    if as_json:
        listed = [result.as_json() for result in results]
        typer.echo(
            json.dumps(
                {"rig": rig.name, "outcome": outcome.value, "findings": listed, "links": links}
            )
        )
    else:
        _print_tree(console, config, rig.name, results)
        print_links(console, links)
        if outcome is CheckOutcome.PASS:
            console.print(f"All passes. Next: syntopic run {config}")
        elif outcome is CheckOutcome.WAITING:
            console.print("Waiting for what is marked so; nothing fails.", style="yellow")
        else:
            console.print("Not ready; do as the sentences in red say.", style="bold red")
    raise typer.Exit(STATUSES[outcome.value])


def collect_results(
    configuration: Configuration, rig: Rig, config: Path, *, fire: bool
) -> list[CheckResult]:
    """All findings: of the running service where there is one, else of what `run` would build."""
    from daemon.mission.mirror.mirror_startup import interrupted_mission
    from daemon.onboard.monitoring.access.service_query import query_service
    from daemon.onboard.preflight.kernel_counters import read_counters
    from daemon.onboard.preflight.network_diagnosis import kernel_results, network_diagnosis
    from daemon.onboard.preflight.prerequisites import prerequisites
    from daemon.onboard.preflight.resumption import resumption_result
    from daemon.onboard.preflight.system_check import run_system_check

    mission = interrupted_mission(configuration)
    if mission is not None and mission.is_held():
        return query_service(configuration, mission)
    results = prerequisites(configuration, rig)
    if any(result.is_blocking for result in results):
        return results
    if mission is not None:
        result, rig = resumption_result(mission, configuration, rig, config)
        results.append(result)
        if result.is_blocking:
            return results
    results += network_diagnosis(configuration, rig)
    before = read_counters()
    results += asyncio.run(run_system_check(configuration, rig, fire=fire))
    return results + kernel_results(configuration, before)


def _print_tree(console: Console, config: Path, rig: str, results: Sequence[CheckResult]) -> None:
    tree = Tree(f"{config} for {rig}: valid")
    for kind in dict.fromkeys(result.kind for result in results):
        branch = tree.add(kind)
        for result in results:
            if result.kind != kind:
                continue
            outcome = result.outcome.value
            found = ", ".join(f"{key} {value}" for key, value in result.found.items() if value)
            label = ": ".join(filter(None, (result.name, result.sentence or found)))
            branch.add(Text.assemble((outcome, COLOURS[outcome]), " ", label))
    console.print(tree)


def print_links(console: Console, links: Sequence[Mapping[str, Any]]) -> None:
    """Print the budget of every link.

    Args:
        console: where.
        links: as `daemon.onboard.preflight.prerequisites.link_tables` returns them.
    """
    for link in links:
        table = light_table(
            _title(link),
            ("head",),
            ("packet B", "packets", "MB", "Mbit/s", "pause us", "start ms", "end ms"),
        )
        for head in link["heads"]:
            end_s = head["transfer_delay_us"] * 1e-6 + head["transfer_s"]
            table.add_row(
                head["head"],
                str(head["packet_size"]),
                str(head["packets"]),
                f"{head['wire_bytes'] / 1e6:.2f}",
                f"{head['rate_mbps']:.1f}",
                f"{head['packet_delay_us']:.1f}",
                f"{head['transfer_delay_us'] * 1e-3:.1f}",
                f"{end_s * 1e3:.0f}",
            )
        console.print(table)


def _title(link: Mapping[str, Any]) -> str:
    verdict = "fits" if link["fits"] else "does not fit"
    return (
        f"{link['interface']}, {link['rate_mbps']:g} Mbit/s: {link['wire_bytes'] / 1e6:.1f} MB on "
        f"the wire take {link['needed_s']:.2f} s of {link['interval_s']:g} s ({verdict}, "
        f"{link['usable_s']:.2f} s are usable)"
    )

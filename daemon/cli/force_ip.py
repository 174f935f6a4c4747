"""`syntopic force-ip`: give a GigE Vision head an address in the subnet of this computer."""

from __future__ import annotations

import dataclasses
import json
from typing import Annotated

import typer

from daemon.cli.exit_status import ExitStatus
from daemon.cli.options import AsJson
from daemon.terminal.console import Console

HELP = """Give a GigE Vision head an IP address until it is switched off (FORCEIP).

The head is addressed by its MAC address in a broadcast on one interface, whatever its subnet is.
`syntopic check` prints the command for a head that it finds in another subnet. A head that a
program controls keeps its address. For a lasting address, set the head's persistent address with
the tool of its maker.

Examples: `sudo syntopic force-ip eth1 00:11:22:33:44:55 10.0.0.5`,
`sudo syntopic force-ip eth1 00:11:22:33:44:55 10.0.0.5 --mask 255.255.255.0 --json`
"""


def force_ip(
    interface: Annotated[str, typer.Argument(help="Interface of the head, such as eth1.")],
    mac: Annotated[str, typer.Argument(help="MAC address of the head.")],
    address: Annotated[str, typer.Argument(help="New IPv4 address of the head.")],
    mask: Annotated[str, typer.Option(help="Mask of its subnet.")] = "255.255.255.0",
    gateway: Annotated[str, typer.Option(help="Gateway of its subnet.")] = "0.0.0.0",
    as_json: AsJson = False,
) -> None:
    from drivers.cameras.aravis.broadcast_discovery import force_address
    from drivers.contract import DeviceError

    try:
        head = force_address(interface, mac, address, mask, gateway)
    except DeviceError as error:
        if as_json:
            typer.echo(json.dumps({"problem": str(error)}))
        else:
            Console(stderr=True).print(str(error), style="red", markup=False, soft_wrap=True)
        raise typer.Exit(ExitStatus.PROBLEM) from None
    if as_json:
        typer.echo(json.dumps(dataclasses.asdict(head)))
    else:
        Console().print(
            f"The head {head.model} {head.serial} ({head.mac}) on {interface} now has the address "
            f"{head.address}, until it is switched off.",
            markup=False,
            highlight=False,
            soft_wrap=True,
        )

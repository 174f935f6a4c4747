"""A switch between heads and computer: a bridge of the kernel whose port has rate and buffer.

Heads, switch and computer are network namespaces joined by veth pairs. The port towards the
computer is shaped by `tbf`: what does not fit its buffer is dropped, as in a switch.
"""

from __future__ import annotations

import json
import os
import secrets
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

COMMAND_TIMEOUT_S = 20.0
COMPUTER_ADDRESS = "10.91.0.1"
HEADS_NETWORK = "10.91.0"
FIRST_HEAD = 10
PREFIX_LENGTH = 24


class SwitchError(Exception):
    """The kernel refuses namespaces, bridges or shaping."""


@dataclass(frozen=True)
class Switch:
    """Names of the namespaces and of the computer's interface."""

    computer: str
    heads: str
    bridge: str
    interface: str
    port: str

    def at_computer(self, command: Sequence[str]) -> list[str]:
        """A command that runs on the computer."""
        return ["ip", "netns", "exec", self.computer, *command]

    def at_heads(self, command: Sequence[str]) -> list[str]:
        """A command that runs where the heads are."""
        return ["ip", "netns", "exec", self.heads, *command]

    def head_address(self, index: int) -> str:
        """Address of a head by its index."""
        return f"{HEADS_NETWORK}.{FIRST_HEAD + index}"

    def dropped_packets(self) -> int:
        """Packets that the port towards the computer has dropped."""
        command = ["tc", "-n", self.bridge, "-s", "-j", "qdisc", "show", "dev", self.port]
        return int(json.loads(_run(*command))[0]["drops"])


@contextmanager
def switch(
    head_count: int, rate_mbps: float, buffer_nbytes: int, *, mtu: int = 9000
) -> Iterator[Switch]:
    """A switch with heads on one side and a computer on the other.

    Args:
        head_count: addresses on the side of the heads.
        rate_mbps: rate of the port towards the computer.
        buffer_nbytes: buffer of that port; a packet that finds it full is dropped.
        mtu: largest IP packet of all links.

    Raises:
        SwitchError: not root, or the kernel has not all of its parts.
    """
    if os.geteuid() != 0:
        raise SwitchError("network namespaces and tbf need root")
    mark = secrets.token_hex(3)
    made = Switch(f"syn-c-{mark}", f"syn-h-{mark}", f"syn-s-{mark}", f"ec{mark}", f"pc{mark}")
    heads_link, heads_port = f"eh{mark}", f"ph{mark}"
    names = (made.computer, made.heads, made.bridge)
    created = []
    try:
        for name in names:
            _run("ip", "netns", "add", name)
            created.append(name)
            _run("ip", "-n", name, "link", "set", "lo", "up")
        _run("ip", "-n", made.bridge, "link", "add", "br0", "type", "bridge")
        for port, link, name in (
            (made.port, made.interface, made.computer),
            (heads_port, heads_link, made.heads),
        ):
            _run("ip", "-n", made.bridge, "link", "add", port, "type", "veth", "peer", link)
            _run("ip", "-n", made.bridge, "link", "set", link, "netns", name)
            _run("ip", "-n", made.bridge, "link", "set", port, "mtu", str(mtu), "master", "br0")
            _run("ip", "-n", name, "link", "set", link, "mtu", str(mtu), "up")
            _run("ip", "-n", made.bridge, "link", "set", port, "up")
        _run("ip", "-n", made.bridge, "link", "set", "br0", "mtu", str(mtu), "up")
        address = f"{COMPUTER_ADDRESS}/{PREFIX_LENGTH}"
        _run("ip", "-n", made.computer, "address", "add", address, "dev", made.interface)
        for index in range(head_count):
            address = f"{made.head_address(index)}/{PREFIX_LENGTH}"
            _run("ip", "-n", made.heads, "address", "add", address, "dev", heads_link)
        _run(
            *("tc", "-n", made.bridge, "qdisc", "add", "dev", made.port, "root", "tbf"),
            *("rate", f"{rate_mbps:g}mbit", "burst", str(mtu + 18)),
            *("limit", str(buffer_nbytes)),
        )
        yield made
    finally:
        for name in created:
            subprocess.run(
                ["ip", "netns", "delete", name],
                check=False,
                capture_output=True,
                timeout=COMMAND_TIMEOUT_S,
            )


def _run(*command: str) -> str:
    try:
        return subprocess.run(
            command, check=True, capture_output=True, text=True, timeout=COMMAND_TIMEOUT_S
        ).stdout
    except (OSError, subprocess.SubprocessError) as error:
        reason = getattr(error, "stderr", "") or str(error)
        raise SwitchError(f"{' '.join(command)}: {reason.strip()}") from None

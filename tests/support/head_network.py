"""A computer and emulated heads, each in a network namespace, joined by veth pairs.

As a program it is one side of it: `python -m tests.support.head_network heads JSON` serves heads
until its standard input closes, `python -m tests.support.head_network diagnose JSON` prints the
diagnosis of a configuration as JSON.
"""

from __future__ import annotations

import contextlib
import copy
import json
import os
import secrets
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

TIMEOUT_S = 60.0
SIZE_PX = (320, 240)


@dataclass
class HeadNetwork:
    """Two namespaces; `eth1` of the computer is joined with `eth1` of the heads."""

    computer: str
    heads: str
    running: list[subprocess.Popen[str]] = field(default_factory=list)

    def ip(self, where: str, *arguments: str) -> None:
        """Run `ip` in a namespace."""
        run("ip", "-n", where, *arguments)

    def sysctl(self, where: str, name: str, value: int) -> None:
        """Set a sysctl of a namespace."""
        path = f"/proc/sys/{name.replace('.', '/')}"
        run("ip", "netns", "exec", where, "sh", "-c", f"echo {value} > {path}")

    def link(self, name: str, computer: str = "", heads: str = "", mtu: int = 1500) -> None:
        """Join the two by another veth pair; addresses with prefix length."""
        run(
            *("ip", "link", "add", name, "netns", self.computer, "type", "veth"),
            *("peer", "name", name, "netns", self.heads),
        )
        for where, address in ((self.computer, computer), (self.heads, heads)):
            if address:
                self.ip(where, "address", "add", address, "dev", name)
            self.ip(where, "link", "set", name, "mtu", str(mtu), "up")

    def serve(self, *heads: dict[str, Any]) -> None:
        """Start emulated heads: `address`, `mask`, `serial` and `interface` of each."""
        command = [sys.executable, "-m", "tests.support.head_network", "heads", json.dumps(heads)]
        process = subprocess.Popen(
            ["ip", "netns", "exec", self.heads, *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.running.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"

    def at_computer(self, *command: str) -> subprocess.CompletedProcess[str]:
        """Run a command on the computer."""
        return subprocess.run(
            ["ip", "netns", "exec", self.computer, *command],
            check=False,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
        )

    def diagnose(self, *heads: dict[str, Any]) -> dict[str, dict[str, Any]]:
        """The diagnosis of a configuration with these heads, by name of the item."""
        ended = self.at_computer(
            sys.executable, "-m", "tests.support.head_network", "diagnose", json.dumps(heads)
        )
        assert ended.returncode == 0, ended.stderr
        return {result["name"]: result for result in json.loads(ended.stdout)}

    def end(self) -> None:
        """End the heads."""
        for process in self.running:
            with contextlib.suppress(OSError):
                process.communicate(timeout=TIMEOUT_S)
        self.running.clear()


@contextmanager
def head_network(
    computer: str = "10.77.0.1/24", heads: str = "10.77.0.2/24", mtu: int = 1500
) -> Iterator[HeadNetwork]:
    """A computer and heads on one link; a skip where that is not allowed."""
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("network namespaces need root and iproute2")
    mark = secrets.token_hex(3)
    made = HeadNetwork(f"syn-k-{mark}", f"syn-g-{mark}")
    created = []
    try:
        for name in (made.computer, made.heads):
            try:
                run("ip", "netns", "add", name)
            except subprocess.CalledProcessError as error:
                pytest.skip(f"no network namespaces here: {error.stderr.strip()}")
            created.append(name)
            made.ip(name, "link", "set", "lo", "up")
        made.link("eth1", computer, heads, mtu)
        yield made
    finally:
        made.end()
        for name in created:
            run("ip", "netns", "delete", name)


def run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True, text=True, timeout=TIMEOUT_S)


def _serve(heads: Sequence[dict[str, Any]]) -> None:
    import numpy as np

    from sim_hw.gige.gige_head import FrameSize, GigeHead, HeadIdentity
    from sim_hw.world.world_clock import FreeRunningClock

    picture = np.zeros(SIZE_PX[::-1], np.uint16)
    serving = [
        GigeHead(
            HeadIdentity(
                head["address"],
                head.get("serial", f"N-{index}"),
                "Emulated",
                "Peer",
                mask=head.get("mask", "255.255.255.0"),
            ),
            FrameSize(*SIZE_PX),
            lambda _: picture,
            lambda _: 30.0,
            FreeRunningClock(0, 0.0),
            interface=head.get("interface", "eth1"),
        )
        for index, head in enumerate(heads)
    ]
    for head in serving:
        head.start()
    print("ready", flush=True)
    sys.stdin.read()
    for head in serving:
        head.close()


def _diagnose(heads: Sequence[dict[str, Any]]) -> None:
    from daemon.onboard.preflight.kernel_counters import read_counters
    from daemon.onboard.preflight.network_diagnosis import kernel_results, network_diagnosis
    from daemon.onboard.preflight.service_file import from_mapping
    from tests.daemon.configuration.test_configuration import GOOD

    content = copy.deepcopy(GOOD)
    sensors = ("SU00", "SU01", "SU02")
    content["head"] = [
        {"driver": "aravis", "sensor": sensor, **head}
        for sensor, head in zip(sensors, heads, strict=False)
    ]
    configuration, rig = from_mapping(content, Path("service.toml"))
    before = read_counters()
    results = list(network_diagnosis(configuration, rig))
    results += kernel_results(configuration, before)
    print(json.dumps([result.as_json() for result in results]))


if __name__ == "__main__":
    {"heads": _serve, "diagnose": _diagnose}[sys.argv[1]](json.loads(sys.argv[2]))

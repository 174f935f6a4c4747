"""Hosts of a network of their own, as Linux network namespaces joined by a veth pair."""

from __future__ import annotations

import ctypes
import os
import secrets
import shutil
import subprocess
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import pytest

T = TypeVar("T")
CLONE_NEWNET = 0x40000000
COMMAND_TIMEOUT_S = 20.0


class Host:
    """A namespace; what runs in it has its network alone."""

    def __init__(self, name: str, address: str) -> None:
        self.name, self.address = name, address
        self._thread = ThreadPoolExecutor(1, name, initializer=_enter, initargs=(name,))

    def run(self, work: Callable[[], T]) -> T:
        """Call `work` in a thread of this host; processes it starts belong there, too."""
        return self._thread.submit(work).result()

    def end(self) -> None:
        self._thread.shutdown()


@contextmanager
def two_hosts() -> Iterator[tuple[Host, Host]]:
    """Two hosts that reach each other and nothing else; a skip where that is not allowed."""
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("network namespaces need root and iproute2")
    mark = secrets.token_hex(3)
    names = (f"syn-a-{mark}", f"syn-b-{mark}")
    links = (f"sa{mark}", f"sb{mark}")
    devices = []
    try:
        for name in names:
            try:
                _ip("netns", "add", name)
            except subprocess.CalledProcessError as error:
                pytest.skip(f"no network namespaces here: {error.stderr.decode().strip()}")
            devices.append(name)
        _ip("-n", names[0], "link", "add", links[0], "type", "veth", "peer", links[1])
        _ip("-n", names[0], "link", "set", links[1], "netns", names[1])
        hosts = []
        for i, (name, link) in enumerate(zip(names, links, strict=True), start=1):
            # Chromium gives requests up when an address appears, as one of IPv6 does later.
            _ip("-n", name, "link", "set", link, "addrgenmode", "none")
            _ip("-n", name, "address", "add", f"10.209.77.{i}/30", "dev", link)
            for one in ("lo", link):
                _ip("-n", name, "link", "set", one, "up")
            hosts.append(Host(name, f"10.209.77.{i}"))
        yield hosts[0], hosts[1]
        for host in hosts:
            host.end()
    finally:
        for name in devices:
            _ip("netns", "delete", name)


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, timeout=COMMAND_TIMEOUT_S)


def _enter(name: str) -> None:
    """Let this thread, and what it starts, use the network of a namespace; setns(2)."""
    descriptor = os.open(Path("/run/netns") / name, os.O_RDONLY | os.O_CLOEXEC)
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.setns(descriptor, CLONE_NEWNET) != 0:
            raise OSError(ctypes.get_errno(), f"setns to {name}")
    finally:
        os.close(descriptor)

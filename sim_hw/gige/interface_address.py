"""The address of an emulated head on an interface of its network namespace."""

from __future__ import annotations

import ipaddress
import subprocess

_TIMEOUT_S = 5.0


def replace_address(interface: str, old: str, new: str, mask: str) -> bool:
    """Give an interface a new address instead of the old one; False if the kernel refuses."""
    prefix = ipaddress.IPv4Network((new, mask), strict=False).prefixlen
    if not _ip("address", "replace", f"{new}/{prefix}", "dev", interface):
        return False
    for line in _addresses(interface):
        if line.partition("/")[0] == old and old != new:
            _ip("address", "delete", line, "dev", interface)
    return True


def _addresses(interface: str) -> list[str]:
    shown = _run("-o", "-4", "address", "show", "dev", interface)
    return [line.split()[3] for line in (shown or "").splitlines() if len(line.split()) > 3]


def _ip(*arguments: str) -> bool:
    return _run(*arguments) is not None


def _run(*arguments: str) -> str | None:
    try:
        return subprocess.run(
            ["ip", *arguments], check=True, capture_output=True, text=True, timeout=_TIMEOUT_S
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return None

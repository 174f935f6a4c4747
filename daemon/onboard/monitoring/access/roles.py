"""Roles, and the least role that each command requires.

A command reaches the service only through `daemon.onboard.monitoring.access.gate`, which asks here,
whatever way it came: page, API, MAVLink or control socket.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

Role = Literal["observer", "operator", "administrator"]
ROLES: Final[tuple[Role, ...]] = ("observer", "operator", "administrator")
"""From the one that permits least; each includes those before it."""

COMMAND_ROLES: Final[Mapping[str, Role]] = {
    "arm": "operator",
    "start": "operator",
    "stop": "operator",
    "trigger": "operator",
    "interval": "operator",
    "distance": "operator",
    "exposure": "operator",
    "acknowledge": "operator",
    "land": "operator",
    "new-mission": "administrator",
    "release-disk": "administrator",
    "accept-disk": "administrator",
}
"""What flies the camera is the operator's; what changes disks or configuration is not."""


@dataclass(frozen=True)
class Principal:
    """Who gives a command: name, role (None: unknown, nothing is permitted), and address."""

    name: str
    role: Role | None
    address: str


def missing_role(principal: Principal, command: str) -> Role | None:
    """The role that `principal` needs for a command and does not have; None if permitted."""
    needed = COMMAND_ROLES.get(command, ROLES[-1])
    if principal.role is not None and ROLES.index(principal.role) >= ROLES.index(needed):
        return None
    return needed

"""Who gives a command, and whether their role permits it.

A command reaches the service only through `daemon.onboard.monitoring.access.command_gateway`, which
asks here, whatever way it came: page, API, MAVLink or control socket.
"""

from __future__ import annotations

from dataclasses import dataclass

from daemon.onboard.service.command_rules import COMMAND_ROLES, ROLES, Role, permits

__all__ = ["COMMAND_ROLES", "ROLES", "Principal", "Role", "missing_role"]


@dataclass(frozen=True)
class Principal:
    """Who gives a command: name, role (None: unknown, nothing is permitted), and address."""

    name: str
    role: Role | None
    address: str


def missing_role(principal: Principal, command: str) -> Role | None:
    """The role that `principal` needs for a command and does not have; None if permitted."""
    if permits(principal.role, command):
        return None
    return COMMAND_ROLES.get(command, ROLES[-1])

"""Sender of a command, and authorization by role.

A command reaches the service only through `daemon.onboard.monitoring.access.command_gateway`, which
calls this, for page, API, MAVLink and control socket.
"""

from __future__ import annotations

from dataclasses import dataclass

from daemon.onboard.service.command_rules import COMMAND_ROLES, ROLES, Role, permits

__all__ = ["COMMAND_ROLES", "ROLES", "Principal", "Role", "missing_role"]


@dataclass(frozen=True)
class Principal:
    """Sender of a command: name, role (None: unknown, nothing is permitted), and address."""

    name: str
    role: Role | None
    address: str


def missing_role(principal: Principal, command: str) -> Role | None:
    """The role required for a command; None if `principal` has it."""
    if permits(principal.role, command):
        return None
    return COMMAND_ROLES.get(command, ROLES[-1])

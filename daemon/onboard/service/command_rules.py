"""The commands that a person may give, the role each requires, and the types of its arguments.

The page's process checks all of it before it passes a command on, and the service again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from daemon.onboard.service.messages import ServiceCommand
from processing.rig.problem_sentences import findings_of, sentences

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
    "reject": "operator",
    "accept": "operator",
    "withdraw": "operator",
    "retake": "operator",
    "verify": "operator",
    "copy": "operator",
    "report": "operator",
    "shutdown": "administrator",
    "new-mission": "administrator",
    "release-disk": "administrator",
    "accept-disk": "administrator",
}
"""What flies the camera is the operator's; what changes disks, configuration or power is not."""
LANDED_COMMANDS: Final = frozenset(
    {"verify", "copy", "report", "shutdown", "new-mission", "acknowledge"}
)
"""Commands that are accepted after the flight has ended."""


class CommandBody(BaseModel):
    """What a command may carry besides its name."""

    model_config = ConfigDict(extra="forbid")

    fault: str | None = Field(default=None, max_length=200, description="which, for acknowledge")
    override: bool = Field(default=False, description="start although something is missing")
    reason: str | None = Field(
        default=None, max_length=200, description="for override, reject, accept, retake"
    )
    disk: Literal["root", "mirror"] | None = Field(
        default=None, description="for release-disk and accept-disk"
    )
    folder: str | None = Field(
        default=None, max_length=200, description="for copy: one of [landing] copy_to"
    )
    number: int | None = Field(
        default=None, ge=1, lt=10**9, description="exposure, for reject, accept, withdraw, retake"
    )
    line: str | None = Field(default=None, max_length=200, description="planned line, for retake")
    from_m: float | None = Field(
        default=None, ge=-1e6, le=1e6, description="first station on the line, for retake"
    )
    to_m: float | None = Field(
        default=None, ge=-1e6, le=1e6, description="last station on the line, for retake"
    )
    interval_s: float | None = Field(default=None, gt=0, le=3600, description="for interval")
    count: int = Field(default=0, ge=0, le=10**6, description="for interval; 0: until stopped")
    distance_m: float | None = Field(default=None, gt=0, le=10**5, description="for distance")
    control: Literal["manual", "automatic"] | None = Field(default=None, description="for exposure")
    exposure_time_us: float | None = Field(default=None, gt=0, le=60e6, description="for exposure")
    gain_db: float | None = Field(default=None, ge=0, le=60, description="for exposure")
    tdi_shifts: int | None = Field(default=None, ge=0, le=1000, description="for exposure")
    of: str | None = Field(
        default=None, max_length=40, description="for exposure: pan, or a cone; else all"
    )


def permits(role: str | None, command: str) -> bool:
    """Whether a role permits a command. A command that is not listed needs the highest role."""
    needed = COMMAND_ROLES.get(command, ROLES[-1])
    known: tuple[str, ...] = ROLES
    return role in known and known.index(role) >= known.index(needed)


def violation(command: ServiceCommand) -> str | None:
    """Why a command breaks the rules, in a sentence; None where it does not."""
    if command.name not in COMMAND_ROLES:
        return f"there is no command {command.name}"
    if not permits(command.role, command.name):
        needed = COMMAND_ROLES[command.name]
        return f"{command.by} has the role {command.role}; {command.name} needs the role {needed}"
    try:
        CommandBody.model_validate(dict(command.arguments), strict=True)
    except ValidationError as error:
        return f"arguments of {command.name}: {'. '.join(sentences(findings_of(error)))[:500]}"
    return None

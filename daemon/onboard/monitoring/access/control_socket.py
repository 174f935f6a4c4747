"""Commands over a Unix socket, authorized by peer credentials and group.

Members of `control_group` are operators; root, the service's own user and members of
`control_administrator_group` are administrators.

Clients are identified by peer credentials (SO_PEERCRED, SO_PEERGROUPS; unix(7)), never by their own
statement. A request is a line of JSON, {"command": "start", "arguments": {}}, and so is its answer,
{"done": true, "sentence": "..."}.
"""

from __future__ import annotations

import asyncio
import grp
import json
import os
import pwd
import socket
import stat
import struct
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, get_args

from pydantic import ValidationError

from daemon import DaemonError
from daemon.onboard.monitoring.access.command_gateway import (
    AnswerTimeoutError,
    CommandGateway,
    NotPermittedError,
)
from daemon.onboard.monitoring.access.roles import Principal, Role
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.web.api import CommandName
from daemon.onboard.service.command_rules import CommandBody
from processing.rig.problem_sentences import findings_of, sentences

SO_PEERGROUPS: Final = 59
"""Of Linux 4.13, <asm-generic/socket.h>; Python has no name for it."""
GROUPS_MAX: Final = 256
"""Python reads 1024 bytes at most. Of a user in more groups only the first group counts."""
LINE_MAX_BYTES: Final = 16_384
ANSWER_MAX_BYTES: Final = 1_000_000
STATE: Final = "state"
"""Query of the state; changes nothing and is not logged."""
IDLE_TIMEOUT_S: Final = 30.0
ANSWER_TIMEOUT_S: Final = 10.0
UNAUTHORIZED_TIMEOUT_S: Final = 1.0
CALLERS_MAX: Final = 8


class ControlError(DaemonError):
    """A socket that cannot be opened or reached; the message contains the corrective action."""


@dataclass(frozen=True)
class PeerProcess:
    """Peer credentials of a client."""

    pid: int
    uid: int
    groups: frozenset[int]

    @property
    def name(self) -> str:
        """For the audit log: the number cannot be renamed, the name can be read."""
        try:
            return f"uid {self.uid} ({pwd.getpwuid(self.uid).pw_name})"
        except KeyError:
            return f"uid {self.uid}"


def peer_process(connection: socket.socket) -> PeerProcess:
    """Peer credentials at the time of connecting."""
    layout = struct.Struct("3i")
    found = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, layout.size)
    pid, uid, gid = layout.unpack(found)
    size = struct.calcsize("I")
    listed = b""
    with suppress(OSError):
        listed = connection.getsockopt(socket.SOL_SOCKET, SO_PEERGROUPS, GROUPS_MAX * size)
    groups = struct.unpack(f"{len(listed) // size}I", listed)
    return PeerProcess(pid, uid, frozenset((gid, *groups)))


class ControlSocket:
    """The socket and its requests.

    Args:
        path: where it is; the folder must be there.
        group: its members are operators; None: the group of the service.
        administrators: its members are administrators; None: no group.
        gate: the way to the service.
        state: what a fault that is acknowledged leaves.
    """

    def __init__(
        self,
        path: Path,
        group: str | None,
        administrators: str | None,
        gateway: CommandGateway,
        state: FlightState,
    ) -> None:
        self.path = path
        self._gateway = gateway
        self._state = state
        self._gid = _gid_of(group)
        self._administrators = None if administrators is None else _gid_of(administrators)
        self._callers = 0
        self._server: asyncio.Server | None = None

    async def begin(self) -> None:
        """Listen.

        Raises:
            ControlError: the path is taken, or the folder is not ours to write into.
        """
        listening = _listen(self.path, self._gid)
        self._server = await asyncio.start_unix_server(
            self._serve, sock=listening, limit=LINE_MAX_BYTES
        )

    def end(self) -> None:
        """Stop listening and remove the socket."""
        if self._server is not None:
            self._server.close()
            with suppress(OSError):
                self.path.unlink()

    def role_of(self, caller: PeerProcess) -> Role | None:
        """The role of a process by its user and groups; None: not authorized."""
        if caller.uid in (0, os.geteuid()) or self._administrators in caller.groups:
            return "administrator"
        return "operator" if self._gid in caller.groups else None

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        caller = peer_process(writer.get_extra_info("socket"))
        by = Principal(caller.name, self.role_of(caller), f"control socket, pid {caller.pid}")
        try:
            if by.role is None:
                await self._refuse(reader, writer, by)
            elif self._callers >= CALLERS_MAX:
                await _answer(writer, done=False, sentence="too many callers; try again")
            else:
                self._callers += 1
                try:
                    await self._serve_requests(reader, writer, by)
                finally:
                    self._callers -= 1
        except (TimeoutError, ConnectionError, ValueError):
            pass  # it stalled, disconnected, or sent an endless line
        finally:
            writer.close()

    async def _refuse(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, by: Principal
    ) -> None:
        """Refuse an unauthorized process and record its request."""
        sentence = f"{by.name} may not command; the group {self._group} may"
        attempted: tuple[str, Any] | str = ""
        # Unread bytes would discard the answer when the socket closes.
        with suppress(TimeoutError, ValueError):
            attempted = _request(await asyncio.wait_for(reader.readline(), UNAUTHORIZED_TIMEOUT_S))
        self._gateway.refuse("" if isinstance(attempted, str) else attempted[0], by, sentence)
        await _answer(writer, done=False, sentence=sentence)

    async def _serve_requests(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, by: Principal
    ) -> None:
        while line := await asyncio.wait_for(reader.readline(), IDLE_TIMEOUT_S):
            if _is_state_query(line):
                await _answer(writer, done=True, sentence="", **self._state_now())
                continue
            done, sentence = await self._execute(line, by)
            await _answer(writer, done=done, sentence=sentence)

    async def _execute(self, line: bytes, by: Principal) -> tuple[bool, str]:
        query = _request(line)
        if isinstance(query, str):
            self._gateway.refuse("", by, query)
            return False, query
        name, arguments = query
        try:
            answer = await self._gateway.command(name, arguments, by)
        except (AnswerTimeoutError, NotPermittedError) as error:
            return False, str(error)
        if answer.done and name == "acknowledge":
            self._state.acknowledge(str(arguments.get("fault")))
        return answer.done, answer.sentence

    def _state_now(self) -> dict[str, Any]:
        """The state, as `ask` returns it."""
        brief = self._state.brief()
        devices = [
            {key: device.get(key) for key in ("kind", "name", "state", "sentence")}
            for device in self._state.changed("devices", 0)
        ]
        return {
            "phase": brief["phase"],
            "missing": brief["status"].get("missing", []),
            "devices": devices,
            "faults": brief["faults"],
        }

    @property
    def _group(self) -> str:
        try:
            return grp.getgrgid(self._gid).gr_name
        except KeyError:
            return str(self._gid)


def send_command(path: Path, name: str, arguments: Mapping[str, Any]) -> tuple[bool, str]:
    """Send one command over a socket; whether it succeeded, and the message of the service.

    Raises:
        ControlError: no service listens, access is denied, or the answer timed out.
    """
    answer = _exchange(path, {"command": name, "arguments": dict(arguments)})
    return bool(answer.get("done")), str(answer.get("sentence", ""))


def query_state(path: Path) -> Mapping[str, Any]:
    """The state of the service: phase, devices, what is missing for arming, and faults.

    Raises:
        ControlError: as for `give`, or the caller may not ask.
    """
    answer = _exchange(path, {"command": STATE})
    if not answer.get("done"):
        raise ControlError(f"{path}: {answer.get('sentence')}")
    return answer


def _exchange(path: Path, query: Mapping[str, Any]) -> Mapping[str, Any]:
    """Send a line and read the line that answers it."""
    request = json.dumps(query).encode() + b"\n"
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            connection.settimeout(ANSWER_TIMEOUT_S)
            connection.connect(str(path))
            connection.sendall(request)
            with connection.makefile("rb") as answers:
                answer = json.loads(answers.readline(ANSWER_MAX_BYTES))
    except PermissionError as error:
        raise ControlError(f"{path}: permission denied; join the group that commands") from error
    except (OSError, ValueError) as error:
        raise ControlError(
            f"{path}: no answer ({error}); does the service run, with [watch] control?"
        ) from error
    return answer if isinstance(answer, Mapping) else {}


def _request(line: bytes) -> tuple[str, dict[str, Any]] | str:
    """The command and arguments of a line, or an error message."""
    try:
        query = json.loads(line)
        name, arguments = query["command"], query.get("arguments", {})
        body = CommandBody.model_validate(arguments)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        if isinstance(error, ValidationError):
            return f"arguments: {'. '.join(sentences(findings_of(error)))}"
        return 'not understood; a line is {"command": NAME, "arguments": {...}}'
    if name not in get_args(CommandName):
        return f"there is no command {str(name)[:40]!r}; one of {', '.join(get_args(CommandName))}"
    return str(name), body.model_dump(exclude_none=True)


def _is_state_query(line: bytes) -> bool:
    try:
        query = json.loads(line)
    except (ValueError, RecursionError):
        return False
    return isinstance(query, dict) and query.get("command") == STATE


async def _answer(
    writer: asyncio.StreamWriter, *, done: bool, sentence: str, **state: object
) -> None:
    writer.write(json.dumps({"done": done, "sentence": sentence, **state}).encode() + b"\n")
    await asyncio.wait_for(writer.drain(), ANSWER_TIMEOUT_S)


def _gid_of(group: str | None) -> int:
    if group is None:
        return os.getegid()
    try:
        return grp.getgrnam(group).gr_gid
    except KeyError as error:
        raise ControlError(
            f"there is no group {group!r}; [watch] control_group names one"
        ) from error


def _listen(path: Path, gid: int) -> socket.socket:
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
    try:
        _remove_stale_socket(path)
        listening.bind(str(path))
        path.chmod(0o660)
        if gid != os.getegid():
            try:
                os.chown(path, -1, gid)
            except PermissionError:
                # The hardened unit may not chown: world-connectable, authorized by peer
                # credentials.
                path.chmod(0o666)
        listening.listen(CALLERS_MAX)
    except OSError as error:
        listening.close()
        raise ControlError(
            f"{path}: {error.strerror or error}; [watch] control names a path in a folder the "
            "service may write into"
        ) from error
    listening.setblocking(False)
    return listening


def _remove_stale_socket(path: Path) -> None:
    """Remove a socket without a listener, and nothing else."""
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise FileExistsError(17, "a file that is not a socket exists")
    except FileNotFoundError:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()
            return
    raise FileExistsError(17, "another service listens on it")

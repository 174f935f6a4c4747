"""Clients of the Unix socket are authorized by peer credentials and group."""

from __future__ import annotations

import asyncio
import grp
import json
import os
import socket
import stat
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from daemon.onboard.monitoring.access.command_gateway import CommandGateway
from daemon.onboard.monitoring.access.control_socket import (
    ControlError,
    ControlSocket,
    PeerProcess,
    peer_process,
    send_command,
)
from daemon.onboard.monitoring.access.roles import Role
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.service.messages import Answer, CommandRefused, ServiceCommand
from tests.daemon.onboard.monitoring import flight_events

RELEASE = "release-disk"
ME = f"uid {os.geteuid()}"
STATE_QUERY = """
import json, os, socket, sys
os.setgroups([int(g) for g in sys.argv[2].split(",") if g])
os.setgid(65534)
os.setuid(65534)
with socket.socket(socket.AF_UNIX) as connection:
    connection.connect(sys.argv[1])
    connection.sendall(b'{"command": "%s"}\\n' % sys.argv[3].encode())
    sys.stdout.write(connection.makefile().readline())
"""


class Service:
    """Answers at once and remembers what it was asked."""

    def __init__(self) -> None:
        self.commands: list[ServiceCommand] = []
        self.refused: list[CommandRefused] = []
        self.state = FlightState("syntopic test")
        self.gateway = CommandGateway(self.receive)

    def receive(self, command: ServiceCommand | CommandRefused) -> None:
        if isinstance(command, CommandRefused):
            self.refused.append(command)
            return
        self.commands.append(command)
        answer = Answer(command.number, command.name != "stop", "as asked")
        asyncio.get_running_loop().call_soon(self.gateway.on_answer, answer)

    @asynccontextmanager
    async def listening(self, path: Path, group: str | None = None) -> AsyncIterator[ControlSocket]:
        control = ControlSocket(path, group, None, self.gateway, self.state)
        await control.begin()
        try:
            yield control
        finally:
            control.end()


def with_socket(service: Service, path: Path, query: Callable[[], Any]) -> Any:
    """Ask from another thread while the socket listens."""

    async def run() -> Any:
        async with service.listening(path), asyncio.timeout(20):
            return await asyncio.to_thread(query)

    return asyncio.run(run())


def lines(path: Path, *sent: bytes) -> list[dict[str, Any]]:
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(10)
        connection.connect(str(path))
        with connection.makefile("rwb") as stream:
            answers = []
            for line in sent:
                stream.write(line)
                stream.flush()
                answers.append(json.loads(stream.readline()))
            return answers


def test_a_command_is_given_in_the_name_the_kernel_knows(tmp_path: Path) -> None:
    service, path = Service(), tmp_path / "control.sock"
    done = with_socket(service, path, lambda: send_command(path, "start", {"override": True}))
    assert done == (True, "as asked")
    (command,) = service.commands
    assert (command.name, command.by.split(" (")[0]) == ("start", ME)
    assert command.arguments["override"] is True
    refused = with_socket(service, path, lambda: send_command(path, "stop", {}))
    assert refused == (False, "as asked")


def test_the_socket_is_for_owner_and_group_and_removed_with_the_service(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    mode = with_socket(Service(), path, lambda: stat.S_IMODE(path.stat().st_mode))
    assert mode == 0o660
    assert not path.exists()


def test_a_fault_that_is_acknowledged_leaves_the_list(tmp_path: Path) -> None:
    service, path = Service(), tmp_path / "control.sock"
    service.state.apply(flight_events.lost("SU02"))
    service.state.apply(flight_events.recovered("SU02"))
    assert with_socket(
        service, path, lambda: send_command(path, "acknowledge", {"fault": "device SU02"})
    )
    assert service.state.faults() == []


def test_an_invalid_line_is_answered_and_the_next_line_is_executed(tmp_path: Path) -> None:
    service, path = Service(), tmp_path / "control.sock"
    nonsense = (
        *(b"\n", b"start\n", b"[]\n", b"{}\n", b'{"command": ["start"]}\n', b"\xff\xfe\n"),
        *(b'{"command": "format-the-disk"}\n', b'{"command": "start", "arguments": 7}\n'),
        b'{"command": "interval", "arguments": {"interval_s": -1}}\n',
        b'{"command": "start", "arguments": {"by": "somebody else"}}\n',
        b"[" * 5000 + b"\n",
    )
    answers = with_socket(service, path, lambda: lines(path, *nonsense, b'{"command": "start"}\n'))
    assert [answer["done"] for answer in answers] == [False] * len(nonsense) + [True]
    assert [command.name for command in service.commands] == ["start"]


def test_an_endless_line_is_cut_off_and_other_clients_are_served(tmp_path: Path) -> None:
    service, path = Service(), tmp_path / "control.sock"

    def flood() -> tuple[bool, str]:
        with socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(10)
            connection.connect(str(path))
            try:
                connection.sendall(b"x" * 1_000_000)
                assert connection.recv(1) == b""
            except (BrokenPipeError, ConnectionResetError):
                pass
        return send_command(path, "start", {})

    assert with_socket(service, path, flood)[0]


@pytest.mark.parametrize(
    ("caller", "role"),
    [
        (PeerProcess(1, 0, frozenset()), "administrator"),
        (PeerProcess(1, os.geteuid(), frozenset()), "administrator"),
        (PeerProcess(1, 4711, frozenset({grp.getgrnam("adm").gr_gid})), "administrator"),
        (PeerProcess(1, 4711, frozenset({grp.getgrnam("dialout").gr_gid})), "operator"),
        (PeerProcess(1, 4711, frozenset({4712})), None),
    ],
)
def test_user_and_groups_of_a_process_are_its_role(
    caller: PeerProcess, role: Role | None, tmp_path: Path
) -> None:
    service = Service()
    control = ControlSocket(tmp_path / "c", "dialout", "adm", service.gateway, service.state)
    assert control.role_of(caller) == role


def test_groups_are_read_from_peer_credentials() -> None:
    here, there = socket.socketpair(socket.AF_UNIX)
    with here, there:
        caller = peer_process(here)
    assert (caller.pid, caller.uid) == (os.getpid(), os.geteuid())
    assert caller.groups == frozenset((os.getegid(), *os.getgroups()))


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to ask as somebody else")
def test_an_unknown_client_is_refused_and_logged_and_a_member_is_served() -> None:
    with tempfile.TemporaryDirectory() as folder:
        # Everybody may enter it, as /run/syntopic.
        Path(folder).chmod(0o755)
        _query_as_others(Path(folder) / "control.sock")


def _query_as_others(path: Path) -> None:
    service = Service()
    group = grp.getgrnam("dialout")

    def query(groups: str, name: str) -> dict[str, Any]:
        # Knocking is open to all, as where the hardened unit may not give the socket away.
        path.chmod(0o666)
        done = subprocess.run(
            [sys.executable, "-c", STATE_QUERY, str(path), groups, name],
            capture_output=True,
            text=True,
            timeout=20,
            check=True,
        )
        return dict(json.loads(done.stdout))

    async def run() -> list[dict[str, Any]]:
        async with service.listening(path, group.gr_name):
            query_line = (("", "start"), (str(group.gr_gid), "start"), (str(group.gr_gid), RELEASE))
            return [await asyncio.to_thread(query, *one) for one in query_line]

    unauthorized, member, too_much = asyncio.run(run())
    assert (unauthorized["done"], "dialout may" in unauthorized["sentence"]) == (False, True)
    assert member["done"] is True
    assert (too_much["done"], "administrator" in too_much["sentence"]) == (False, True)
    (command,) = service.commands
    assert (command.by.split(" (")[0], command.role) == ("uid 65534", "operator")
    assert command.address.startswith("control socket, pid ")
    assert [(one.name, one.role, one.sentence) for one in service.refused] == [
        ("start", "none", unauthorized["sentence"]),
        (RELEASE, "operator", too_much["sentence"]),
    ]


def test_a_socket_left_by_a_killed_service_is_taken_over_and_a_file_is_not(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    assert with_socket(Service(), path, lambda: send_command(path, "start", {}))[0]
    path.write_text("precious")
    with pytest.raises(ControlError, match="not a socket"):
        with_socket(Service(), path, lambda: None)
    assert path.read_text() == "precious"


def test_a_second_service_does_not_take_the_socket_of_the_first(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"

    def second() -> None:
        with_socket(Service(), path, lambda: None)

    with pytest.raises(ControlError, match="another service"):
        with_socket(Service(), path, second)


def test_a_missing_listener_and_an_unknown_group_are_reported(tmp_path: Path) -> None:
    with pytest.raises(ControlError, match="does the service run"):
        send_command(tmp_path / "none.sock", "start", {})
    service = Service()
    with pytest.raises(ControlError, match="no group"):
        ControlSocket(tmp_path / "c", "no-such-group", None, service.gateway, service.state)


def test_the_command_line_sends_its_values_and_returns_the_result_as_status(
    tmp_path: Path,
) -> None:
    service, path = Service(), tmp_path / "control.sock"

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "daemon", "send", *arguments, "--socket", str(path)],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )

    async def query() -> tuple[subprocess.CompletedProcess[str], ...]:
        async with service.listening(path):
            given = ("interval", "--set", "interval_s=2.5", "--set", "count=4", "--json")
            return await asyncio.to_thread(run, *given), await asyncio.to_thread(run, "stop")

    done, refused = asyncio.run(query())
    assert (done.returncode, json.loads(done.stdout)["done"]) == (0, True)
    assert (refused.returncode, refused.stdout.strip()) == (1, "as asked")
    interval = service.commands[0].arguments
    assert (interval["interval_s"], interval["count"]) == (2.5, 4)

"""`syntopic monitor` against services that are none, and announcements that lie."""

from __future__ import annotations

import http
import json
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgpack
import pytest
from typer.testing import CliRunner, Result
from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve

from daemon import DaemonError
from daemon.cli import app
from daemon.cli.monitor import _MonitorState
from daemon.onboard.monitoring.client import mdns_browser
from daemon.onboard.monitoring.client.mdns_browser import AnnouncedService, parse_announcement
from daemon.onboard.monitoring.client.telemetry_client import (
    AccessOptions,
    ClientError,
    ServiceAddress,
    check_token_transport,
    parse_service_address,
)
from daemon.terminal.console import Console
from daemon.terminal.printable import printable, printable_tree

pytestmark = pytest.mark.trust
ESCAPES = "\x1b[2J\x1b]0;owned\x07\x9b31m\u202eevil\u2028\x00"
GOOD: dict[str, Any] = {
    "version": 1,
    "phase": "flying",
    "mission": {"id": "m1"},
    "status": {},
    "faults": [],
}
Answer = Callable[[ServerConnection, Request], Response | None]


class Impostor:
    """A WebSocket server in the hands of the test; it notes what it is asked."""

    def __init__(self, data: bytes | str = b"", answer: Answer | None = None) -> None:
        self.requests: list[Request] = []
        self._data, self._answer = data, answer

    def _note(self, connection: ServerConnection, request: Request) -> Response | None:
        self.requests.append(request)
        return self._answer(connection, request) if self._answer else None

    def _send(self, connection: ServerConnection) -> None:
        connection.send(self._data)
        connection.recv(timeout=10)

    @contextmanager
    def listening(self) -> Iterator[str]:
        with serve(self._send, "127.0.0.1", 0, process_request=self._note) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            yield f"127.0.0.1:{server.socket.getsockname()[1]}"
            server.shutdown()


def watched(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["monitor", *arguments, "--json"])


def refused(result: Result) -> str:
    """The sentence of a command that ended in one, with nothing that a terminal obeys."""
    assert isinstance(result.exception, DaemonError), result.exception
    sentence = str(result.exception)
    assert printable(sentence, 2000) == sentence
    return sentence


def record(**changes: Any) -> bytes:
    return bytes(msgpack.packb(GOOD | changes))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        b"\x93\x01",
        b"\x91" * 2000 + b"\x90",
        b"\x81\x90\x01",
        b"\xc7\x04\x05abcd",
        b"\xa3\xff\xfe\xfd",
        "text",
        bytes(msgpack.packb([])),
        bytes(msgpack.packb({})),
        record(phase=7),
        record(mission="m1"),
        record(mission={"id": ["x"]}),
        record(faults=[{"sentence": None, "stands": True}]),
        record(exposures=[{"number": "one"}]),
        record(exposures={"number": 1}),
        record(devices=[{"name": {}}]),
        record(status={"clock_sigma_ns": "soon"}),
        record(status={"ledger": {"triggers": []}}),
        bytes(msgpack.packb({**GOOD, "x": msgpack.Timestamp(1)})),
        b"\xdd\xff\xff\xff\xff",
        b"\xdf\xff\xff\xff\xff",
    ],
)
def test_malformed_telemetry_ends_in_a_sentence(data: bytes | str) -> None:
    with Impostor(data).listening() as address:
        assert "telemetry" in refused(watched(address))


def test_only_what_prints_is_left_of_a_text() -> None:
    assert printable("Größe 5 µm, 日本") == "Größe 5 µm, 日本"
    assert (
        printable("a\x1b[2J\x9b\x00\n\u202e\u200f\u2028\ud800z")
        == "a\ufffd[2J" + "\ufffd" * 7 + "z"
    )
    assert printable("x" * 501) == "x" * 499 + "…" and printable("x" * 500) == "x" * 500
    assert printable_tree({"a\x1b": [1.5, float("nan"), b"x", True]}) == {
        "a\ufffd": [1.5, None, None, True]
    }


def test_control_sequences_of_a_service_never_reach_the_terminal() -> None:
    fault = {"id": "x", "sentence": f"SU02 {ESCAPES}", "stands": True}
    exposure = {"number": 1, "step": ESCAPES, "verdict": f"good{ESCAPES}"}
    data = record(
        phase=ESCAPES, mission={"id": ESCAPES}, faults=[fault], exposures=[exposure], **{ESCAPES: 1}
    )
    with Impostor(data).listening() as address:
        result = watched(address)
    assert result.exit_code == 0, result.output
    state = json.loads(result.stdout)
    assert printable_tree(state) == state
    seen = _MonitorState()
    seen.receive(state)
    console = Console(record=True, width=100, force_terminal=False)
    console.print(seen.drawn(address))
    drawn = console.export_text().replace("\n", "")
    assert "owned" in drawn and printable(drawn, 10**6) == drawn


def test_what_a_service_answers_is_printed_without_control_sequences() -> None:
    def answer(connection: ServerConnection, _request: Request) -> Response:
        return connection.respond(http.HTTPStatus.GONE, f"no {ESCAPES * 200}")

    with Impostor(answer=answer).listening() as address:
        sentence = refused(watched(address))
    assert "status 410" in sentence and len(sentence) < 400


def test_a_token_is_sent_in_a_header_and_follows_no_redirect_and_no_proxy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    thief = Impostor(record())
    with thief.listening() as stolen:
        monkeypatch.setenv("HTTP_PROXY", f"http://{stolen}")
        monkeypatch.setenv("ALL_PROXY", f"http://{stolen}")
        monkeypatch.setenv("NO_PROXY", "")

        def redirect(_connection: ServerConnection, _request: Request) -> Response:
            headers = Headers(Location=f"ws://{stolen}/api/v1/telemetry", Connection="close")
            return Response(307, "Temporary Redirect", headers, b"")

        redirecting = Impostor(answer=redirect)
        with redirecting.listening() as address:
            refused(watched(address, "--token", "syn_secret"))
        honest = Impostor(record())
        with honest.listening() as address:
            assert watched(address, "--token", "syn_secret").exit_code == 0
    assert thief.requests == []
    for request in (*redirecting.requests, *honest.requests):
        assert "syn_secret" not in request.path
        assert request.headers["Authorization"] == "Bearer syn_secret"


def test_a_token_is_sent_unencrypted_to_this_machine_only() -> None:
    access = AccessOptions("syn_secret")
    for address in ("127.0.0.1:1", "127.9.9.9:1", "[::1]:1", "localhost:1", "https://10.0.0.5"):
        check_token_transport(parse_service_address(address), access)
    for address in ("10.0.0.5:8470", "http://camera.local", "ws://[fd00::1]:1", "localhost.evil:1"):
        with pytest.raises(ClientError, match="--token-without-tls"):
            check_token_transport(parse_service_address(address), access)
        check_token_transport(parse_service_address(address), AccessOptions())
        check_token_transport(
            parse_service_address(address), AccessOptions("syn_secret", is_token_public=True)
        )
    check_token_transport(parse_service_address("10.0.0.5:8470", tls=True), access)
    for token in ("syn a", "syn\r\nX: y", "ä", "x" * 201):
        with pytest.raises(ClientError, match="invalid characters"):
            check_token_transport(parse_service_address("https://a"), AccessOptions(token))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("camera.local", ServiceAddress("camera.local", 8470, is_tls=False)),
        ("https://camera.local:1/", ServiceAddress("camera.local", 1, is_tls=True)),
        ("wss://[fd00::1]", ServiceAddress("fd00::1", 8470, is_tls=True)),
        ("http://10.0.0.5:99", ServiceAddress("10.0.0.5", 99, is_tls=False)),
    ],
)
def test_an_address_is_what_the_person_wrote(text: str, expected: ServiceAddress) -> None:
    assert parse_service_address(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        *("", "ftp://a", "a:99999", "a:b", "http://u:p@a", "a/api?token=syn_x", "a?x", "a b:1"),
        *(f"a{ESCAPES}:1", "https://", "[::1", "a" * 300),
    ],
)
def test_an_address_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ClientError) as error:
        parse_service_address(text)
    assert printable(str(error.value), 2000) == str(error.value)
    assert "syn_x" not in str(error.value)


def test_tls_and_http_contradict_each_other() -> None:
    with pytest.raises(ClientError, match="--tls requires it"):
        parse_service_address("http://a", tls=True)


def test_an_announcement_neither_gets_a_token_nor_decides_about_tls(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    forger = Impostor(record())
    with forger.listening() as address:
        for tls in ("true", "false"):
            announced = AnnouncedService(address, {"tls": tls, "token": "command"})
            monkeypatch.setattr(mdns_browser, "find_services", lambda one=announced: [one])
            sentence = refused(watched("--token", "syn_secret"))
            assert "any host can announce" in sentence
            assert forger.requests == []
            # Without a token the person's option decides: plain without, TLS with it.
            assert watched().exit_code == 0
            assert "TLS" in refused(watched("--tls"))
            forger.requests.clear()


def test_announced_texts_are_printable_and_bounded() -> None:
    from zeroconf import ServiceInfo

    properties = {b"rig": ESCAPES.encode(), b"mission": b"\xff\xfe" + b"x" * 200, b"\x1bk": None}
    info = ServiceInfo(
        "_syntopic._tcp.local.",
        "a._syntopic._tcp.local.",
        addresses=[socket.inet_aton("10.0.0.5")],
        port=8470,
        properties=properties,
    )
    announced = parse_announcement(info)
    assert announced is not None and announced.address == "10.0.0.5:8470"
    for text in (*announced.text, *announced.text.values()):
        assert printable(text) == text and len(text) <= mdns_browser.TEXT_MAX
    for port, addresses in ((0, [b"\x0a\x00\x00\x05"]), (8470, [])):
        odd = ServiceInfo(
            "_syntopic._tcp.local.", "a._syntopic._tcp.local.", addresses=addresses, port=port
        )
        assert parse_announcement(odd) is None

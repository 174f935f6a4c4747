"""Attacks on the page server over its socket: others are answered meanwhile, and memory stays."""

from __future__ import annotations

import os
import resource
import socket
import threading
import time
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from daemon.onboard.monitoring.access.tokens import FAILURES_ALLOWED
from daemon.onboard.monitoring.http_limits import (
    HEAD_MAX_BYTES,
    MESSAGE_MAX_BYTES,
    RECEIVED_BURST_BYTES,
)
from daemon.onboard.monitoring.process_restrictions import (
    FILES_MAX,
    MEMORY_MAX_BYTES,
    OOM_SCORE,
    apply_resource_limits,
)
from daemon.onboard.monitoring.web.connections import (
    CONNECTIONS_PER_SOURCE,
    IDLE_MAX_S,
    REQUESTS_BURST,
    REQUESTS_PER_S,
)
from daemon.onboard.monitoring.web.request_body import BODY_MAX_BYTES, parse_command_body
from tests.daemon.onboard.monitoring.attacked_page import (
    ATTACKER,
    OPERATOR,
    Page,
    command,
    get,
    read_all,
    status_of,
    upgrade,
)
from tests.support.stopwatch import Stopwatch

pytestmark = pytest.mark.realtime


GROWTH_MAX_KB = 30_000
ANSWERED_WITHIN_S = 3.0
"""While an attack lasts; the machine may be busy."""
OFFERED_BYTES = int(os.environ.get("SYNTOPIC_OFFERED_BYTES", "1200000000"))


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    page = Page(tmp_path_factory.mktemp("page"))
    yield page
    page.end()


def pour(link: socket.socket, data: bytes, most: int) -> int:
    """Send data again and again; how much was taken before the server closed."""
    sent = 0
    try:
        while sent < most:
            link.sendall(data)
            sent += len(data)
    except OSError:
        pass
    return sent


@pytest.mark.trust
@pytest.mark.parametrize("with_token", [False, True], ids=["anonymous", "operator"])
@pytest.mark.parametrize("length", ["Content-Length: {0}", "Transfer-Encoding: chunked"])
def test_a_body_of_1200_megabytes_is_refused_before_it_is_read(
    page: Page, length: str, with_token: bool
) -> None:
    before_kb = page.resident_kb
    head = command(page.token if with_token else "", length.format(OFFERED_BYTES))
    with page.connect() as link:
        link.sendall(head + b"10000\r\n" * ("chunked" in length))
        taken = pour(link, bytes(65536), OFFERED_BYTES)
        assert taken < 20_000_000  # what the kernel's buffers hold
    assert page.resident_kb - before_kb < GROWTH_MAX_KB
    status, answer = page.request(head)
    assert status == (411 if "chunked" in length else 413), answer
    assert b"application/problem+json" in answer


@pytest.mark.trust
def test_60_megabytes_of_brackets_do_not_hold_up_others(page: Page) -> None:
    nested = b"[[]," * 16384
    slowest_s = 0.0
    with page.connect() as link:
        link.sendall(command(page.token, "Content-Length: 60000000"))
        pouring = threading.Thread(target=pour, args=(link, nested, 60_000_000))
        pouring.start()
        for _ in range(5):
            watch = Stopwatch()
            assert page.request(get("/api/v1/brief", "Connection: close"), OPERATOR)[0] == 200
            slowest_s = max(slowest_s, watch.own_s)
        pouring.join()
    assert slowest_s < ANSWERED_WITHIN_S


def test_a_missing_token_is_refused_before_the_body_is_read(page: Page) -> None:
    broken = b"{" * 1000
    status, _ = page.request(command("", body=broken))
    assert status == 401
    # The body may still be on its way: it is not waited for.
    with page.connect() as link:
        link.sendall(command("", "Content-Type: application/json", "Content-Length: 1000"))
        watch = Stopwatch()
        assert status_of(read_all(link))[0] == 401
        assert watch.is_within(ANSWERED_WITHIN_S)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b"[" * BODY_MAX_BYTES, "nested"),
        (b'{"count": ' + b"9" * 10_000 + b"}", "not a JSON record"),
        (b'{"interval_s": 1e999}', "1e999 is beyond the numbers"),
        (b'{"interval_s": NaN}', "not a number"),
        (b'{"override": true, "override": false}', "twice"),
        (b'{"fault": "\xff"}', "not a JSON record"),
        (b'{"fault": "\\ud800"}', "JSON"),
        (b'{"fault": "' + b"a" * 201 + b'"}', "200"),
        (b"[]", "object"),
        (b'{"__class__": "x"}', "__class__"),
        (b"\x1f\x8b\x08\x00", "not a JSON record"),
    ],
)
def test_hostile_json_is_refused_in_a_sentence(body: bytes, words: str) -> None:
    with pytest.raises(ValueError, match=words) as raised:
        parse_command_body(body)
    assert len(str(raised.value)) < 2000


def test_the_operators_own_bodies_are_held_to_the_limits_too(page: Page) -> None:
    cases = (
        (command(page.token, body=b"[" * BODY_MAX_BYTES), 422),
        (command(page.token, body=b"x" * (BODY_MAX_BYTES + 1)), 413),
        (command(page.token, "Content-Encoding: gzip", body=b"x"), 415),
        (command(page.token, "Content-Encoding: identity", body=b'{"override": true}'), 200),
        (command(page.token, "Content-Type: text/plain", "Content-Length: 2") + b"{}", 415),
        (command(page.token, "Content-Length: -1"), 400),
        (command(page.token, "Content-Length: 5", "Content-Length: 6") + b"123456", 400),
        (command(page.token, "Content-Length: 1" + "0" * 5000) + b"x", 400),
        (get("/api/v1/brief", "Content-Length: 5") + b"12345", 413),
        (get("/api/v1/brief", "Connection: close", *(f"X-{n}: 1" for n in range(100))), 431),
        (get("/" + "a" * 3 * HEAD_MAX_BYTES), 400),
        (get("/api/v1/brief", "X: " + "a" * 3 * HEAD_MAX_BYTES), 400),
        (b"\x16\x03\x01\x02\x00\x01" + bytes(500), 400),
    )
    for request, expected in cases:
        status, answer = page.request(request)
        assert status == expected, (request[:200], answer)


@pytest.mark.trust
def test_a_body_that_does_not_come_is_waited_for_briefly(page: Page) -> None:
    with page.connect() as link:
        link.sendall(command(page.token, "Content-Type: application/json", "Content-Length: 10"))
        watch = Stopwatch()
        for _ in range(3):
            link.sendall(b" ")
            time.sleep(0.2)
        assert status_of(read_all(link))[0] == 408
        assert watch.is_within(15.0)


@pytest.mark.trust
def test_wrong_tokens_never_keep_a_valid_one_out(page: Page) -> None:
    """From the same address, over HTTP and WebSocket, whatever X-Forwarded-For contains."""
    statuses = [page.request(command("guess"))[0] for _ in range(FAILURES_ALLOWED + 2)]
    assert statuses[:FAILURES_ALLOWED] == [401] * FAILURES_ALLOWED
    assert statuses[FAILURES_ALLOWED:] == [429, 429]
    for _ in range(FAILURES_ALLOWED + 1):
        page.request(
            upgrade(
                "", "Authorization: Bearer guess", "Origin: http://127.0.0.1", "Connection: close"
            )
        )
    assert page.request(command("guess", f"X-Forwarded-For: {OPERATOR}"))[0] == 429
    assert page.request(command("guess"), OPERATOR)[0] == 401
    assert page.stop_command(ATTACKER)[0] == 200
    assert page.stop_command(OPERATOR)[0] == 200
    assert page.commands[-1] == "stop"


@pytest.mark.trust
def test_a_flood_of_connections_keeps_nobody_out(page: Page) -> None:
    held = []
    try:
        held += [page.connect() for _ in range(2 * CONNECTIONS_PER_SOURCE)]
        for source in (OPERATOR, ATTACKER):
            status, took_s = page.stop_command(source)
            assert (status, took_s < ANSWERED_WITHIN_S) == (200, True)
        # The oldest were closed, the others wait for a request.
        assert read_all(held[0]) == b""
        files = len(list(Path(f"/proc/{page.child.process.pid}/fd").iterdir()))
        assert files < CONNECTIONS_PER_SOURCE + 60
    finally:
        for link in held:
            link.close()


@pytest.mark.trust
def test_a_flood_of_requests_is_answered_429_and_the_operator_200(page: Page) -> None:
    request = get("/api/v1/ledger")
    with page.connect() as link:
        # Pipelined; the connection is closed with the first refusal.
        begun_s = time.monotonic()
        pour(link, request * 100, len(request) * 3 * REQUESTS_BURST)
        answers = read_all(link)
        refilled = REQUESTS_PER_S * (time.monotonic() - begun_s)
    # The first refusal may come after requests that are answered meanwhile.
    assert answers.count(b"HTTP/1.1 200") <= REQUESTS_BURST + refilled + 1
    assert answers.count(b"HTTP/1.1 429") <= 1
    refused = 0
    deadline = time.monotonic() + 20
    while not refused and time.monotonic() < deadline:
        refused += page.request(get("/api/v1/ledger", "Connection: close"))[0] == 429
    assert refused
    assert page.request(get("/api/v1/ledger", "Connection: close"), OPERATOR)[0] == 200
    assert page.stop_command(ATTACKER)[0] == 200


def masked(opcode: int, payload: bytes, *, final: bool = True) -> bytes:
    length = len(payload)
    size = bytes([0x80 | length]) if length < 126 else b"\xfe" + length.to_bytes(2, "big")
    return bytes([(0x80 if final else 0) | opcode]) + size + bytes(4) + payload


@pytest.mark.trust
@pytest.mark.parametrize(
    "frames",
    [
        masked(1, b"", final=False) + masked(0, b"", final=False) * 5000,
        masked(9, b"ping") * 5000,
        masked(1, b"x" * 100) * 500,
        masked(1, b"\xff"),
        b"\xc1\xff" + (2**62).to_bytes(8, "big") + bytes(4),
        masked(3, b"x"),
    ],
    ids=["fragments", "pings", "messages", "not UTF-8", "huge", "no opcode"],
)
def test_a_talkative_or_malformed_watcher_is_let_go(page: Page, frames: bytes) -> None:
    before_kb = page.resident_kb
    with page.connect(OPERATOR) as link:
        link.sendall(upgrade())
        assert link.recv(4096).startswith(b"HTTP/1.1 101")
        watch = Stopwatch()
        sent = pour(link, frames, 20 * RECEIVED_BURST_BYTES + len(frames))
        read_all(link)
        assert watch.is_within(15.0), sent
    assert page.resident_kb - before_kb < GROWTH_MAX_KB
    assert page.request(get("/api/v1/brief", "Connection: close"), OPERATOR)[0] == 200


@pytest.mark.trust
def test_a_compressed_message_that_expands_to_megabytes_is_not_taken(page: Page) -> None:
    squeezed = zlib.compressobj(wbits=-15)
    bomb = squeezed.compress(bytes(3_000_000)) + squeezed.flush(zlib.Z_SYNC_FLUSH)[:-4]
    assert len(bomb) < MESSAGE_MAX_BYTES
    before_kb = page.resident_kb
    for _ in range(10):
        with page.connect("127.0.0.7") as link:
            link.sendall(upgrade("", "Sec-WebSocket-Extensions: permessage-deflate"))
            assert b"permessage-deflate" in link.recv(4096)
            link.sendall(masked(0x41, bomb))
            assert b"\x03\xf1" in read_all(link)  # 1009, message too big
    assert page.resident_kb - before_kb < GROWTH_MAX_KB


@pytest.mark.soak
def test_a_header_that_never_ends_is_cut_off(page: Page) -> None:
    with page.connect("127.0.0.8") as link:
        link.settimeout(IDLE_MAX_S + 10)
        link.sendall(b"GET / HTTP/1.1\r\n")
        begun = time.monotonic()
        sending = threading.Thread(target=drip, args=(link,))
        sending.start()
        read_all(link)
        assert IDLE_MAX_S - 2 < time.monotonic() - begun < IDLE_MAX_S + 8
        sending.join()


def drip(link: socket.socket) -> None:
    """A header line every second, until the connection is gone."""
    with suppress(OSError):
        for number in range(int(IDLE_MAX_S) + 10):
            link.sendall(f"X-{number}: 1\r\n".encode())
            time.sleep(1.0)


@pytest.mark.trust
def test_watchers_of_one_address_do_not_take_the_places_of_others(page: Page) -> None:
    source, held = "127.0.0.6", []
    try:
        for _ in range(CONNECTIONS_PER_SOURCE):
            link = page.connect(source)
            held.append(link)
            link.sendall(upgrade())
            assert link.recv(4096).startswith(b"HTTP/1.1 101")
        with page.connect(OPERATOR) as link:
            link.sendall(upgrade())
            assert link.recv(4096).startswith(b"HTTP/1.1 101")
        with page.connect(source) as link:
            link.sendall(upgrade("", f"Authorization: Bearer {page.token}"))
            assert link.recv(4096).startswith(b"HTTP/1.1 101")
    finally:
        for link in held:
            link.close()


@pytest.mark.trust
@pytest.mark.parametrize(
    ("host", "is_served"),
    [
        ("127.0.0.1", True),
        ("127.0.0.1:8470", True),
        ("[::1]:8470", True),
        ("localhost:1", True),
        (f"{socket.gethostname()}.local", True),
        (f"{socket.gethostname().upper()}.LOCAL.:80", True),
        ("camera.example", False),
        ("rebound.attacker.example:8470", False),
        ("127.0.0.1.attacker.example", False),
        ("localhost.attacker.example", False),
        ("0x7f000001", False),
        ("127.0.0.1@attacker.example", False),
        ("127.0.0.1, attacker.example", False),
        ("", False),
    ],
)
def test_only_own_names_are_served(page: Page, host: str, is_served: bool) -> None:
    """A page from elsewhere could read the state once its name resolves to this address."""
    status, _ = page.request(get("/api/v1/state", "Connection: close", host=host), "127.0.0.4")
    assert status == (200 if is_served else 421)
    with page.connect("127.0.0.4") as link:
        link.sendall(upgrade(host=host))
        assert link.recv(4096).startswith(b"HTTP/1.1 101") == is_served
    status, _ = page.request(get("/", "Connection: close", host=host), "127.0.0.4")
    assert status == (200 if is_served else 421)


@pytest.mark.trust
@pytest.mark.parametrize(
    ("origin", "is_allowed"),
    [
        ("http://127.0.0.1", True),
        ("https://127.0.0.1", True),
        ("http://127.0.0.1:81", False),
        ("http://127.0.0.2", False),
        ("http://attacker.example", False),
        ("https://127.0.0.1.attacker.example", False),
        ("http://attacker.example/127.0.0.1", False),
        ("http://attacker.example@127.0.0.1", False),
        ("null", False),
        ("file://", False),
    ],
)
def test_a_page_from_elsewhere_neither_commands_nor_watches(
    page: Page, origin: str, is_allowed: bool
) -> None:
    source = "127.0.0.5"
    given = len(page.commands)
    status, _ = page.request(command(page.token, f"Origin: {origin}"), source)
    assert status == (200 if is_allowed else 403)
    assert len(page.commands) - given == is_allowed
    with page.connect(source) as link:
        link.sendall(upgrade("", f"Origin: {origin}"))
        assert link.recv(4096).startswith(b"HTTP/1.1 101") == is_allowed


def test_two_host_headers_are_refused(page: Page) -> None:
    request = get("/api/v1/state", "Host: attacker.example", "Connection: close")
    assert page.request(request)[0] in (400, 421)
    assert page.request(b"GET /api/v1/state HTTP/1.0\r\n\r\n")[0] == 421


def test_names_and_proxies_of_the_configuration_count(tmp_path: Path) -> None:
    page = Page(tmp_path, hosts=("camera.example",), proxies=("127.0.0.9",))
    try:
        status, _ = page.request(
            get("/", "Connection: close", host="camera.example:443"), "127.0.0.9"
        )
        assert status == 200
        for _ in range(FAILURES_ALLOWED):
            forwarded = f"X-Forwarded-For: {OPERATOR}, 198.51.100.1"
            assert page.request(command("guess", forwarded), "127.0.0.9")[0] == 401
        assert page.request(command("guess", forwarded), "127.0.0.9")[0] == 429
        # Counted for the client that the proxy names, not for the proxy or what the client claims.
        other = "X-Forwarded-For: 198.51.100.1, 198.51.100.2"
        assert page.request(command("guess", other), "127.0.0.9")[0] == 401
        # A client that is not a proxy cannot name another client.
        assert page.request(command("guess", forwarded), ATTACKER)[0] == 401
    finally:
        page.end()


@pytest.mark.trust
def test_the_pages_process_is_bounded_by_itself(page: Page) -> None:
    pid = page.child.process.pid or 0
    limits = {
        line[:26].strip(): line[26:].split()[0]
        for line in Path(f"/proc/{pid}/limits").read_text().splitlines()
    }
    assert limits["Max data size"] == str(MEMORY_MAX_BYTES)
    assert limits["Max open files"] == str(FILES_MAX)
    assert limits["Max core file size"] == "0"
    assert int(Path(f"/proc/{pid}/oom_score_adj").read_text()) == OOM_SCORE
    assert os.getpriority(os.PRIO_PROCESS, pid) > os.getpriority(os.PRIO_PROCESS, 0)
    data_kb = next(
        int(line.split()[1])
        for line in Path(f"/proc/{pid}/status").read_text().splitlines()
        if line.startswith("VmData")
    )
    assert data_kb * 1024 < MEMORY_MAX_BYTES / 2
    # This process, the service, has none of these limits.
    assert resource.getrlimit(resource.RLIMIT_DATA)[0] != MEMORY_MAX_BYTES


def test_a_process_that_was_not_started_for_the_page_is_not_bounded() -> None:
    before = [resource.getrlimit(kind) for kind in (resource.RLIMIT_DATA, resource.RLIMIT_NOFILE)]
    apply_resource_limits()
    after = [resource.getrlimit(kind) for kind in (resource.RLIMIT_DATA, resource.RLIMIT_NOFILE)]
    assert after == before

"""A page's process in the hands of an attacker: what it sends is dropped, counted and reported."""

from __future__ import annotations

import array
import asyncio
import os
import pickle
import socket
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgpack
import pytest

from daemon.onboard.flight.fault_latches import FaultLatches
from daemon.onboard.service import page_connection
from daemon.onboard.service.command_execution import invalid_event, invalid_message
from daemon.onboard.service.command_rules import COMMAND_ROLES, ROLES
from daemon.onboard.service.messages import (
    Answer,
    CommandRefused,
    InvalidMessages,
    Ping,
    Pong,
    ServiceCommand,
    ServiceEvent,
    Stop,
)
from daemon.onboard.service.page_connection import (
    BURST,
    MESSAGES_PER_TURN,
    PageConnection,
    PageProcess,
)
from daemon.onboard.service.page_messages import (
    ARGUMENTS_MAX,
    FROM_PAGE_MAX_BYTES,
    NAME_MAX,
    TEXT_MAX,
    TO_PAGE_MAX_BYTES,
    InvalidMessageError,
    pack_from_page,
    pack_to_page,
    unpack_from_page,
    unpack_to_page,
)
from daemon.onboard.service.supervisor import Supervisor
from tests.daemon.onboard.service.test_audit import Flight
from tests.support.stopwatch import Stopwatch

pytestmark = pytest.mark.realtime


COMMAND = ServiceCommand(
    7, "interval", {"interval_s": 2.0, "count": 3}, "anna", "operator", "10.0.0.9"
)
WATCHING = ServiceEvent({"event": "watching", "host": "127.0.0.1", "port": 8080, "tls": False})
FROM_PAGE = (
    Pong({}),
    COMMAND,
    CommandRefused("land", "unknown", "none", "10.0.0.66", "no", 7),
    WATCHING,
    ServiceEvent(
        {"event": "device", "device": "tokens", "name": "absent", "fault": True, "sentence": "x"}
    ),
    ServiceEvent({"event": "tls-certificate", "fault": False, "sentence": "renewed"}),
    ServiceEvent({"event": "signing-state", "sentence": "x"}),
)
TO_PAGE = (
    Ping(),
    Stop(),
    Answer(7, True, "armed"),
    ServiceEvent(
        {"event": "status", "mono_ns": "1", "position": None, "ledger": {"a": [1, 2.5, True]}}
    ),
)


class Exploit:
    """What unpickling this would do is seen by everybody."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {self.path}",)


def packed(kind: str, **fields: object) -> bytes:
    data: bytes = msgpack.packb([kind, fields])
    return data


def command(**changes: object) -> bytes:
    fields = {key: getattr(COMMAND, key) for key in COMMAND.__dataclass_fields__}
    return packed("command", **{**fields, **changes})


def hostile() -> dict[str, bytes]:
    """Bytes that are no message, by what they are."""
    valid = pack_from_page(COMMAND)
    nested: object = 1
    for _ in range(400):
        nested = [nested]
    return {
        "cut off": valid[:-1],
        "cut off after its head": valid[:2],
        "one byte too many": valid + b"\0",
        "two messages in one packet": valid * 2,
        "an unknown kind": packed("execute", code="1"),
        "a message of the other direction": pack_to_page(Stop()),
        "a name of a class": packed("daemon.onboard.service.messages.Bound", name="head"),
        "an array of 2^32 - 1": b"\xdd\xff\xff\xff\xff",
        "a map of 2^32 - 1": b"\x92\xa4pong\xdf\xff\xff\xff\xff",
        "a text of 2^32 - 1 bytes": b"\x92\xdb\xff\xff\xff\xff",
        "arrays of 32,000 in arrays of 32,000": b"\xdc\x7d\x00" * 10_000,
        "nested": msgpack.packb(["pong", {"a": nested}]),
        "an extension": msgpack.packb(["pong", {"a": msgpack.ExtType(1, b"x")}]),
        "a timestamp": msgpack.packb(["pong", {"a": msgpack.Timestamp(1)}]),
        "bytes": command(by=b"anna"),
        "no utf-8": b"\x92\xa4pong\x81\xa1\xff\x01",
        "a single surrogate": msgpack.packb(
            ["event", {"event": "signing-state", "sentence": "\ud800"}],
            unicode_errors="surrogatepass",
        ),
        "a key twice": b"\x92\xa4pong\x82\xa1a\x01\xa1a\x02",
        "a key that is a number": msgpack.packb(["pong", {1: 2}]),
        "no pair": msgpack.packb("pong"),
        "statistics": packed("pong", statistics={"capture": {"frames": 1}}),
        "a field missing": packed("command", number=1, name="arm"),
        "a field too many": command(extra=1),
        "a number that is a flag": command(number=True),
        "a number that is a text": command(number="7"),
        "number 0": command(number=0),
        "number 2^63": command(number=2**63),
        "a name that is a list": command(name=["arm"]),
        "a role that is nothing": command(role=None),
        "a name of 201": command(by="a" * (NAME_MAX + 1)),
        "a sentence of 4,001": packed(
            "event", event="signing-state", sentence="a" * (TEXT_MAX + 1)
        ),
        "arguments that are a list": command(arguments=[1]),
        "an argument that is a map": command(arguments={"count": {"a": 1}}),
        "an argument NaN": command(arguments={"interval_s": float("nan")}),
        "an argument of 201": command(arguments={"reason": "a" * (NAME_MAX + 1)}),
        "too many arguments": command(
            arguments=dict.fromkeys(map(str, range(ARGUMENTS_MAX + 1)), 1)
        ),
        "a count of 0": packed(
            "refused", name="a", by="a", role="a", address="a", sentence="a", count=0
        ),
        "an event of the service": packed("event", event="ready", absent=[]),
        "an event without a name": packed("event", sentence="x"),
        "an event whose name is a number": packed("event", event=1),
        "a head that is absent": packed(
            "event", event="device", device="SU00", name="absent", fault=True, sentence="x"
        ),
        "a device that is found": packed(
            "event", event="device", device="tokens", name="opened", fault=True, sentence="x"
        ),
        "an instant of its own": packed("event", event="signing-state", sentence="x", mono_ns="1"),
        "a port of 65,536": packed("event", event="watching", host="::", port=65_536, tls=True),
    }


@contextmanager
def link() -> Iterator[tuple[PageProcess, socket.socket]]:
    """The service's end without a process, and the socket that an attacker holds."""
    ours = PageProcess.__new__(PageProcess)
    ours.name = "watch"
    ours.connection, theirs = ours._ends()
    try:
        yield ours, theirs
    finally:
        ours.connection.close()
        theirs.close()


def received(ours: PageProcess) -> list[object]:
    """Everything that is received now."""
    found: list[object] = []
    while batch := list(ours.receive()):
        found += batch
    return found


@pytest.mark.parametrize("message", FROM_PAGE, ids=lambda one: type(one).__name__)
def test_messages_of_the_pages_process_arrive_unchanged(message: object) -> None:
    assert unpack_from_page(pack_from_page(message)) == message


@pytest.mark.parametrize("message", TO_PAGE, ids=lambda one: type(one).__name__)
def test_messages_of_the_service_arrive_unchanged(message: object) -> None:
    assert unpack_to_page(pack_to_page(message)) == message


def test_a_text_that_is_too_long_or_cannot_be_packed_is_cut_before_it_is_sent() -> None:
    refused = CommandRefused("land", "a" * 300, "none", "\ud800", "b" * 5000)
    sent = unpack_from_page(pack_from_page(refused))
    assert isinstance(sent, CommandRefused)
    assert (len(sent.by), len(sent.sentence), sent.address) == (NAME_MAX, TEXT_MAX, "\\ud800")


def test_an_invalid_message_is_an_error_and_is_never_sent() -> None:
    with link() as (ours, theirs):
        for event in ({"a": object()}, {"a": 2**70}, {"a": "x" * TO_PAGE_MAX_BYTES}):
            with pytest.raises(ValueError, match=r".+"):
                ours.try_send(ServiceEvent({"event": "status", **event}))
        with pytest.raises(ValueError, match="Pong"):
            ours.try_send(Pong({}))
        with pytest.raises(BlockingIOError):
            theirs.recv(10, socket.MSG_DONTWAIT)


@pytest.mark.trust
@pytest.mark.attack
def test_bytes_that_are_no_message_are_dropped_counted_and_reported_between_two_that_are() -> None:
    for name, data in hostile().items():
        with pytest.raises(InvalidMessageError):
            unpack_from_page(data)
        with link() as (ours, theirs):
            for one in (pack_from_page(COMMAND), data, pack_from_page(WATCHING)):
                theirs.send(one)
            found = received(ours)
            assert found[:2] == [COMMAND, WATCHING], name
            (report,) = found[2:]
            assert isinstance(report, InvalidMessages) and report.count == ours.invalid == 1, name
            assert invalid_event(report)["fault"] is True
            assert b'"invalid":1' in invalid_message(report).payload.replace(b" ", b"")
            latches = FaultLatches()
            latches.apply(invalid_event(report))
            assert [one["id"] for one in latches.listed()] == ["page link"]


@pytest.mark.trust
@pytest.mark.attack
def test_a_pickle_is_never_executed_by_either_end(tmp_path: Path) -> None:
    planted = tmp_path / "executed"
    exploit = Exploit(planted)
    forms = [pickle.dumps(exploit, protocol) for protocol in range(pickle.HIGHEST_PROTOCOL + 1)]
    forms += [len(one).to_bytes(4, "big") + one for one in forms]  # as multiprocessing sends them
    with link() as (ours, theirs):
        for form in forms:
            theirs.send(form)
        (report,) = received(ours)
        assert isinstance(report, InvalidMessages) and report.count == len(forms)
        page = PageConnection(theirs)
        for form in forms:
            ours.connection.send(form)
        assert page.receive(0.0) is None
        assert page._received.invalid == len(forms)
        (report_event,) = [one for one in received(ours) if isinstance(one, ServiceEvent)]
        assert report_event.event["event"] == "page-link"
    assert not planted.exists()


@pytest.mark.trust
@pytest.mark.attack
def test_a_packet_that_is_too_large_is_dropped_and_the_next_one_is_understood() -> None:
    with link() as (ours, theirs):
        theirs.send(b"\xc0" * (FROM_PAGE_MAX_BYTES + 1))
        theirs.send(pack_from_page(COMMAND))
        found = received(ours)
        assert found[0] == COMMAND
        assert isinstance(found[1], InvalidMessages) and "more than" in found[1].sentence


@pytest.mark.attack
def test_bombs_take_neither_memory_nor_time() -> None:
    tracemalloc.start()
    try:
        for data in hostile().values():
            tracemalloc.reset_peak()
            before, begun_s = tracemalloc.get_traced_memory()[0], time.process_time()
            with pytest.raises(InvalidMessageError):
                unpack_from_page(data)
            assert tracemalloc.get_traced_memory()[1] - before < 1_000_000
            assert time.process_time() - begun_s < 0.5
    finally:
        tracemalloc.stop()


@pytest.mark.attack
def test_file_descriptors_that_come_with_a_packet_are_not_taken() -> None:
    with link() as (ours, theirs):
        reading, writing = os.pipe()
        rights = (socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [writing] * 50))
        before = len(list(Path("/proc/self/fd").iterdir()))
        theirs.sendmsg([pack_from_page(COMMAND)], [rights])
        assert received(ours) == [COMMAND]
        assert len(list(Path("/proc/self/fd").iterdir())) == before
        os.close(reading)
        os.close(writing)


@pytest.mark.trust
@pytest.mark.attack
def test_a_flood_leaves_the_others_their_turn_and_waits_in_the_page_process() -> None:
    with link() as (ours, theirs):
        theirs.setblocking(False)
        sent = received = 0
        begun_s = time.monotonic()
        while not ours.pause_s:
            try:
                theirs.send(pack_from_page(COMMAND))
                sent += 1
            except BlockingIOError:
                batch = list(ours.receive())
                assert len(batch) <= MESSAGES_PER_TURN
                received += len(batch)
        took_s = time.monotonic() - begun_s
        assert BURST <= received <= BURST + page_connection.RATE_PER_S * took_s + 1
        assert list(ours.receive()) == [] or ours._allowance < 2
        time.sleep(ours.pause_s + 0.1)
        later = len(list(ours.receive()))
        assert 1 <= later <= MESSAGES_PER_TURN, "it goes on by itself"
        assert sent >= received + later, "nothing is lost on the way"


def hostile_page(link: PageConnection) -> None:
    """A page's process that sends no message, among those it owes, and is then quiet."""
    raw = link._connection
    for data in hostile().values():
        raw.send(data)
    raw.send(pickle.dumps(Exploit(Path("/nonexistent"))))
    link.send(COMMAND)
    while True:
        if isinstance(link.receive(1.0), Ping):
            link.send(Pong({}))


@pytest.mark.trust
@pytest.mark.attack
def test_the_supervisor_survives_a_hostile_page_process_and_receives_its_valid_messages() -> None:
    messages: list[object] = []
    died: list[str] = []

    async def watched() -> None:
        made = Supervisor(messages.append, died.append)
        made.spawn("watch", f"{__name__}:hostile_page", (), {})
        deadline = time.monotonic() + 60.0
        while Pong({}) not in messages and time.monotonic() < deadline:
            assert made.ping() == []
            await asyncio.sleep(0.05)
        await made.end(("watch",))

    asyncio.run(watched())
    assert died == [] and COMMAND in messages and Pong({}) in messages
    reported = [one for one in messages if isinstance(one, InvalidMessages)]
    assert 1 <= sum(one.count for one in reported) <= len(hostile()) + 1
    assert all(isinstance(one, ServiceCommand | Pong | InvalidMessages) for one in messages)


def flooding_page(link: PageConnection) -> None:
    """A page's process that sends without end."""
    while True:
        link.send(COMMAND)


@pytest.mark.attack
def test_the_loop_of_the_service_turns_while_the_page_process_floods() -> None:
    count = 0
    begun = asyncio.Event()

    def ignore(_message: object) -> None:
        nonlocal count
        count += 1
        begun.set()

    async def watched() -> float:
        made = Supervisor(ignore, lambda _: None)
        made.spawn("watch", f"{__name__}:flooding_page", (), {})
        await asyncio.wait_for(begun.wait(), 60.0)
        begun_s, slowest_s = time.monotonic(), 0.0
        while time.monotonic() - begun_s < 6.0:
            watch = Stopwatch()
            await asyncio.sleep(0.01)
            slowest_s = max(slowest_s, watch.own_s)
        limit = (
            BURST
            + page_connection.RATE_PER_S * (time.monotonic() - begun_s + 1.0)
            + MESSAGES_PER_TURN
        )
        assert BURST < count <= limit, "it goes on, and no faster than permitted"
        await made.end(("watch",))
        return slowest_s

    assert asyncio.run(watched()) < 1.0


@pytest.mark.trust
@pytest.mark.attack
def test_a_command_with_a_role_that_does_not_permit_it_is_refused_by_the_service_too() -> None:
    for name, needed in COMMAND_ROLES.items():
        for role in ("", "none", "root", *ROLES[: ROLES.index(needed)]):
            flight = Flight()
            flight.receive(ServiceCommand(1, name, {}, "eva", role, "10.0.0.66"))
            assert [answer.done for answer in flight.answers] == [False]
            assert flight.events[0]["event"] == "command-refused"
            assert b'"refused":true' in flight.sent[0][1].message.payload.replace(b" ", b"")


@pytest.mark.trust
@pytest.mark.attack
@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("execute", {"code": "1"}),
        ("__class__", {}),
        ("arm", {"override": 1}),
        ("arm", {"override": True, "reason": 7}),
        ("arm", {"unknown": 1}),
        ("interval", {"interval_s": "2"}),
        ("interval", {"interval_s": -1.0}),
        ("interval", {"interval_s": 1.0, "count": True}),
        ("interval", {"interval_s": 1.0, "count": 1.0}),
        ("distance", {"distance_m": 1e300}),
        ("release-disk", {"disk": "/etc"}),
        ("acknowledge", {"fault": 1}),
        ("exposure", {"gain_db": True}),
        ("exposure", {"tdi_shifts": 1.5}),
        ("exposure", {"control": "else"}),
    ],
)
def test_a_command_that_is_not_listed_or_has_wrong_arguments_is_refused_by_the_service_too(
    name: str, arguments: dict[str, object]
) -> None:
    flight = Flight()
    flight.receive(ServiceCommand(1, name, arguments, "eva", "administrator", "10.0.0.66"))
    assert [answer.done for answer in flight.answers] == [False]
    assert [event["event"] for event in flight.events] == ["command-refused"]

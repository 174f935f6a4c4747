"""Attacks at the camera's MAVLink port: jamming, replay, forgery and crowds; loopback only."""

from __future__ import annotations

import copy
import hashlib
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from daemon.configuration.model import SIGNING_STATE
from daemon.onboard.monitoring.mavlink.senders import (
    DATAGRAM_MAX_BYTES,
    PEERS_MAX,
    STREAMS_MAX,
    Senders,
)
from daemon.onboard.monitoring.mavlink.signatures import (
    SIGNING_EPOCH_UNIX_NS,
    TICKS_PER_S,
    Signatures,
)
from daemon.onboard.monitoring.mavlink.signatures import (
    STREAMS_MAX as SIGNED_STREAMS_MAX,
)
from daemon.onboard.preflight.service_file import from_mapping
from drivers.receivers.mavlink.library import MavlinkParser
from tests.daemon.configuration.test_configuration import GOOD
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.test_mavsdk_camera import Flying, wait_for

dialect = pytest.importorskip(
    "pymavlink.dialects.v20.ardupilotmega", reason="pip install 'syntopic[mavlink]'"
)
pytestmark = [pytest.mark.trust, pytest.mark.attack]
KEY = bytes(range(32))
NOW_NS = SIGNING_EPOCH_UNIX_NS + 400_000_000 * 1_000_000_000
NOW = 400_000_000 * TICKS_PER_S
MINUTE = 60 * TICKS_PER_S
HOUR = 60 * MINUTE
TRIGGER = (2000, 0, 0, 0, 1, 0, 0, 0, 0)
ACCEPTED, DENIED = 0, 2


class Station:
    """A ground station at an address of its own, for a camera that listens."""

    def __init__(self, flying: Flying, key: bytes | None = None, host: str = "127.0.0.1") -> None:
        self.camera = ("127.0.0.1", flying.port)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((host, 0))
        self.socket.settimeout(0.05)
        self.mav = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
        self.reader = dialect.MAVLink(None)
        self.reader.robust_parsing = True
        self.received: list[Any] = []
        if key is not None:
            self.mav.signing.secret_key = key
            self.mav.signing.sign_outgoing = True
            self.mav.signing.timestamp = round((time.time() - 1_420_070_400) * 1e5)

    def packed(self, *command: float) -> bytes:
        message = self.mav.command_long_encode(1, 100, int(command[0]), *command[1:])
        return bytes(message.pack(self.mav))

    def send(self, data: bytes) -> None:
        self.socket.sendto(data, self.camera)

    def beat(self) -> None:
        self.send(bytes(self.mav.heartbeat_encode(6, 8, 0, 0, 4).pack(self.mav)))

    def receive(self, kind: str) -> list[Any]:
        with suppress(TimeoutError):
            self.received += self.reader.parse_buffer(bytearray(self.socket.recv(2048))) or []
        return [message for message in self.received if message.get_type() == kind]

    def order(self) -> int:
        """Send one capture and return what became of it."""
        self.received.clear()
        self.send(self.packed(*TRIGGER))
        (ack, *_) = wait_for(lambda: self.receive("COMMAND_ACK"), "the answer")
        return int(ack.result)

    def close(self) -> None:
        self.socket.close()


@contextmanager
def flight(tmp_path: Path, **settings: Any) -> Iterator[Flying]:
    (tmp_path / "key").write_text(KEY.hex())
    (tmp_path / "key").chmod(0o600)
    given = {"scheme": "udpin", "commands": "signed", "signing_key": tmp_path / "key",
             "signing_state": tmp_path / "state" / "signing.json"}  # fmt: skip
    flying = Flying(**{**given, **settings})
    try:
        yield flying
    finally:
        flying.close()


@contextmanager
def hammering(
    flying: Flying, *, hosts: list[str], payload: bytes, every_s: float
) -> Iterator[None]:
    """Unknown senders that repeat the same message until the block ends."""
    sockets = []
    for host in hosts:
        sockets.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        sockets[-1].bind((host, 0))
    stop = threading.Event()

    def hammer() -> None:
        while not stop.wait(every_s):
            for one in sockets:
                one.sendto(payload, ("127.0.0.1", flying.port))

    thread = threading.Thread(target=hammer, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(5)
        for one in sockets:
            one.close()


# Jamming


@pytest.mark.parametrize(
    "stray",
    [b"\xfd" + bytes(9), b"\xfd\xff" + bytes(8), bytes(10), b"\xfe\xff\x00\x01\x01\x00", b"\xfd"],
    ids=["short v2", "long v2", "zeros", "v1", "one byte"],
)
def test_stray_bytes_of_others_before_each_command_jam_none_of_ten(
    tmp_path: Path, stray: bytes
) -> None:
    with flight(tmp_path) as flying:
        operator, unknown_sender = Station(flying, KEY), Station(flying, host="127.0.0.2")
        for _ in range(10):
            unknown_sender.send(stray)
            assert operator.order() == ACCEPTED
        assert len(flying.commands) == 10
        operator.close(), unknown_sender.close()


def test_stray_bytes_from_the_operators_own_address_jam_nothing_either(tmp_path: Path) -> None:
    with flight(tmp_path) as flying:
        operator = Station(flying, KEY)
        strays = (b"\xfd\xff" + bytes(8), b"noise", b"\xfe\xff\x00\x01\x01\x00")
        for expected, stray in zip((2, 4, 6), strays, strict=True):
            operator.send(stray)
            assert operator.order() == ACCEPTED
            operator.send(stray + operator.packed(*TRIGGER))
            wait_for(lambda n=expected: len(flying.commands) >= n, "the command behind stray bytes")
        assert len(flying.commands) == 6
        operator.close()


def test_a_command_cut_in_two_datagrams_is_put_together_by_its_sender_only() -> None:
    parser = MavlinkParser()
    senders = Senders(parser)
    mav = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    complete = bytes(mav.heartbeat_encode(6, 8, 0, 0, 4).pack(mav))
    assert senders.messages(complete[:9], ("a", 1), 0.0) == ([], 0)
    assert senders.messages(complete[9:], ("b", 1), 0.0)[0] == []
    assert senders.messages(complete, ("b", 1), 0.0) == ([complete], 0)
    assert senders.messages(complete[9:], ("a", 1), 0.0) == ([complete], 0)


def test_senders_of_fragments_are_bounded_and_unsigned_ones_leave_first() -> None:
    senders = Senders(MavlinkParser())
    mav = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    complete = bytes(mav.heartbeat_encode(6, 8, 0, 0, 4).pack(mav))
    senders.register(("operator", 1), 0.0, is_signed=True)
    assert senders.messages(complete[:9], ("operator", 1), 0.0) == ([], 0)
    for n in range(500):
        senders.messages(complete[:9], (f"unknown {n}", 1), 0.0)
    assert len(senders._streams) == STREAMS_MAX
    assert senders.messages(complete[9:], ("operator", 1), 0.0) == ([complete], 0)


def test_damaged_bytes_cost_a_bounded_time_and_whole_messages_pass_all_the_same() -> None:
    senders = Senders(MavlinkParser())
    mav = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    complete = bytes(mav.heartbeat_encode(6, 8, 0, 0, 4).pack(mav))
    costly = (b"\xfd\xff\x00\x00\x00\x00\x00\x00\x00\x00" * 204)[:DATAGRAM_MAX_BYTES]
    begin = time.process_time()
    for n in range(2000):
        assert senders.messages(costly, (f"{n % 50}", 1), n * 1e-4)[0] == []
        assert senders.messages(complete, ("operator", 1), n * 1e-4) == ([complete], 0)
    assert time.process_time() - begin < 5.0, "4 MB in 0.2 s of them"
    assert senders.messages(bytes(65_000), ("x", 1), 1.0) == ([], 65_000)


# Replay


def test_a_recorded_command_is_not_obeyed_after_a_restart_even_with_the_clock_put_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with flight(tmp_path) as flying:
        operator = Station(flying, KEY)
        recorded = operator.packed(*TRIGGER)
        operator.send(recorded)
        wait_for(lambda: len(flying.commands) == 1, "the command")
        operator.close()
    before_ns = time.time_ns() - 86_400 * 1_000_000_000
    for clock_ns in (None, before_ns):
        if clock_ns is not None:
            clocks = {"unix_ns": lambda: before_ns, "mono_ns": time.monotonic_ns}
            monkeypatch.setattr(Signatures.__init__, "__kwdefaults__", clocks)
        with flight(tmp_path) as flying:
            attacker, operator = Station(flying, host="127.0.0.2"), Station(flying, KEY)
            operator.mav.signing.timestamp += 10 * TICKS_PER_S
            attacker.send(recorded)
            (ack, *_) = wait_for(lambda s=attacker: s.receive("COMMAND_ACK"), "the answer")
            assert ack.result == DENIED
            assert flying.commands == []
            assert operator.order() == ACCEPTED, "the operator is not locked out"
            attacker.close(), operator.close()


def test_the_timestamp_is_durable_before_the_command_is_obeyed(tmp_path: Path) -> None:
    with flight(tmp_path) as flying:
        state, seen = tmp_path / "state" / "signing.json", []
        obey = flying.gateway._send
        flying.gateway._send = lambda command: (seen.append(state.exists()), obey(command))
        operator = Station(flying, KEY)
        assert operator.order() == ACCEPTED
        assert seen == [True]
        # As if killed here: nothing more is saved, and another process reads what there is.
        assert not Signatures(KEY, state).accept(operator.packed(*TRIGGER)[:-13] + bytes(13))
        last = operator.mav.signing.timestamp
        operator.mav.signing.timestamp = last - 2
        assert not Signatures(KEY, state).accept(operator.packed(*TRIGGER))
        operator.mav.signing.timestamp = last
        assert Signatures(KEY, state).accept(operator.packed(*TRIGGER))
        operator.close()


def test_a_disk_that_refuses_is_reported_and_the_operator_obeyed(tmp_path: Path) -> None:
    sentences: list[str] = []
    with flight(tmp_path) as flying:
        (tmp_path / "state").write_text("a file where the folder would be")
        flying.camera._report = sentences.append
        operator = Station(flying, KEY)
        assert operator.order() == ACCEPTED
        operator.close()
    assert "cannot be saved" in sentences[0] and "check that disk" in sentences[0]


@pytest.mark.parametrize("content", [b"", b"{}", b"[]", b'{"key": "x", "clock": -1, "streams": []}',
    b'{"key": "x", "clock": 1, "streams": [[1, 2, 3]]}',
    b'{"key": "x", "clock": 1, "streams": [[1, 2, 300, 4]]}', bytes(range(200, 250))])  # fmt: skip
def test_damaged_timestamps_are_not_taken_for_none(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "state").write_bytes(content)
    with pytest.raises(ValueError, match="recorded commands could be executed again"):
        Signatures(KEY, tmp_path / "state")


def test_the_state_is_stored_below_the_missions_unless_configured(tmp_path: Path) -> None:
    text = copy.deepcopy(GOOD)
    text["watch"] = {"mavlink": {"commands": "signed", "signing_key": "key"}}
    for given, expected in ((None, tmp_path / "missions" / SIGNING_STATE), ("s", tmp_path / "s")):
        if given:
            text["watch"]["mavlink"]["signing_state"] = given
        watch = from_mapping(text, tmp_path / "service.toml")[0].watch
        assert watch is not None and watch.mavlink is not None
        assert watch.mavlink.signing_state == expected


# Signing clock and streams


class Clock:
    """A host's clock and its monotonic one, as a test puts them."""

    def __init__(self, behind_s: float = 0.0) -> None:
        self.unix = NOW_NS - round(behind_s * 1e9)
        self.mono = 0

    def signatures(self, path: Path | None = None) -> Signatures:
        return Signatures(KEY, path, unix_ns=lambda: self.unix, mono_ns=lambda: self.mono)


def signed(timestamp: int, *, system: int = 255, component: int = 190, link: int = 0,
           key: bytes = KEY) -> bytes:  # fmt: skip
    mav = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
    mav.signing.secret_key, mav.signing.link_id = key, link
    mav.signing.sign_outgoing, mav.signing.timestamp = True, timestamp
    return bytes(mav.heartbeat_encode(6, 8, 0, 0, 4).pack(mav))


def test_a_message_is_accepted_once_and_only_newer_ones_of_its_stream_after_it() -> None:
    signatures = Clock().signatures()
    assert signatures.accept(signed(NOW))
    assert not signatures.accept(signed(NOW))
    assert not signatures.accept(signed(NOW - 1))
    assert signatures.accept(signed(NOW + 1))
    for other in ({"system": 254}, {"component": 191}, {"link": 1}):
        assert signatures.accept(signed(NOW, **other)), "a stream of its own"
    assert not signatures.accept(signed(NOW + 9, key=bytes(32)))
    assert not signatures.accept(signed(NOW + 9)[:-13])
    assert not signatures.accept(b"")


def test_a_forged_timestamp_of_the_future_locks_nobody_out() -> None:
    signatures = Clock().signatures()
    assert not signatures.accept(signed(NOW + 24 * HOUR, key=bytes(32)))
    assert signatures.accept(signed(NOW))
    assert not signatures.accept(signed(NOW + 24 * HOUR, key=bytes(32)))
    assert signatures.accept(signed(NOW + 1))
    assert signatures.now() == NOW + 1


def test_a_new_stream_may_lag_by_a_minute_and_a_known_one_as_long_as_it_goes_on() -> None:
    signatures = Clock().signatures()
    assert not signatures.accept(signed(NOW - MINUTE - 1))
    assert signatures.accept(signed(NOW - MINUTE))
    signatures.advance(NOW_NS + 3600 * 1_000_000_000)
    assert signatures.now() == NOW + HOUR
    assert signatures.accept(signed(NOW - MINUTE + 1)), "a tablet with a slow clock goes on"
    assert not signatures.accept(signed(NOW, link=1))
    assert signatures.accept(signed(NOW + HOUR - MINUTE, link=1))


def test_a_tablet_with_a_slow_clock_gets_in_by_the_time_of_our_signed_messages() -> None:
    camera, tablet = Clock().signatures(), Clock(behind_s=7200).signatures()
    assert not camera.accept(signed(tablet.next_timestamp()))
    # It receives our heartbeat, and its signing clock follows, as the specification requires.
    assert tablet.accept(signed(camera.next_timestamp(), system=1, component=100))
    assert camera.accept(signed(tablet.next_timestamp()))


def test_gps_time_only_ever_advances_the_signing_clock() -> None:
    clock = Clock(behind_s=86_400)
    signatures = clock.signatures()
    signatures.advance(NOW_NS)
    assert signatures.now() == NOW
    signatures.advance(NOW_NS - 3600 * 1_000_000_000)
    signatures.advance(0)
    assert signatures.now() == NOW
    clock.mono += 5 * 1_000_000_000
    assert signatures.now() == NOW + 5 * TICKS_PER_S, "it goes on while the host's is behind"
    clock.unix = NOW_NS + 60 * 1_000_000_000
    assert signatures.now() == NOW + MINUTE


def test_what_is_sent_is_signed_with_the_clock_and_ever_later() -> None:
    clock = Clock()
    signatures = clock.signatures()
    sent = [signatures.next_timestamp() for _ in range(3)]
    assert sent == [NOW, NOW + 1, NOW + 2]
    clock.unix += 1_000_000_000
    assert signatures.next_timestamp() == NOW + TICKS_PER_S


def test_streams_and_clock_survive_a_restart_and_another_key_resets_them(tmp_path: Path) -> None:
    path = tmp_path / "state"
    first = Clock().signatures(path)
    assert first.accept(signed(NOW + HOUR))
    assert not first.is_saved
    first.save()
    assert first.is_saved
    assert path.stat().st_mode & 0o777 == 0o600
    again = Clock(behind_s=86_400).signatures(path)
    assert again.now() == NOW + HOUR
    assert not again.accept(signed(NOW + HOUR))
    assert not again.accept(signed(NOW, link=3)), "a new stream lags more than a minute"
    assert again.accept(signed(NOW + HOUR + 1))
    other = Signatures(bytes(32), path, unix_ns=lambda: NOW_NS)
    assert other.accept(signed(NOW + HOUR, key=bytes(32)))


def test_streams_are_bounded() -> None:
    signatures = Clock().signatures()
    for n in range(SIGNED_STREAMS_MAX + 50):
        assert signatures.accept(signed(NOW + n, system=1 + n % 250, component=1 + n // 250))
    assert len(signatures._last) == SIGNED_STREAMS_MAX
    last = NOW + SIGNED_STREAMS_MAX + 49
    assert not signatures.accept(signed(last, system=1 + 305 % 250, component=1 + 305 // 250))


def test_the_signature_is_that_of_the_specification() -> None:
    frame = signed(NOW)
    assert hashlib.sha256(KEY + frame[:-6]).digest()[:6] == frame[-6:]
    assert frame[-13] == 0 and int.from_bytes(frame[-12:-6], "little") == NOW


def test_gps_time_of_a_flight_advances_the_clock_and_that_of_an_emulated_one_does_not(
    tmp_path: Path,
) -> None:
    with flight(tmp_path) as flying:
        signatures = flying.camera._signatures
        ahead_ns = time.time_ns() + 3600 * 1_000_000_000 - 315_964_800 * 1_000_000_000
        is_ahead = 3000 * TICKS_PER_S
        host = (time.time_ns() - SIGNING_EPOCH_UNIX_NS) // 10_000
        flying.state.apply({**flight_events.mission(), "simulated": True})
        flying.state.apply({**flight_events.status("flying"), "gps_ns": str(ahead_ns)})
        time.sleep(0.5)
        assert signatures.now() - host < is_ahead
        flying.state.apply({**flight_events.mission(), "simulated": False})
        wait_for(lambda: signatures.now() - host > is_ahead, "the signing clock to follow")


# Crowds


CROWD = [f"127.0.1.{n}" for n in range(1, 21)]


def heartbeats(station: Station, count: int) -> float:
    """Seconds until so many heartbeats of the camera are received, sending one a second."""
    begin = beat_s = time.monotonic()
    station.received.clear()
    station.beat()
    while len(station.receive("HEARTBEAT")) < count:
        assert time.monotonic() - begin < 30.0, "the operator receives no heartbeat"
        if time.monotonic() - beat_s >= 1.0:
            beat_s = time.monotonic()
            station.beat()
    return time.monotonic() - begin


@pytest.mark.parametrize("key", [KEY, None], ids=["signed", "unsigned"])
def test_twenty_other_addresses_do_not_starve_an_operators_heartbeats(
    tmp_path: Path, key: bytes | None
) -> None:
    mav = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    payload = bytes(mav.heartbeat_encode(6, 8, 0, 0, 4).pack(mav))
    with flight(tmp_path) as flying, hammering(flying, hosts=CROWD, payload=payload, every_s=0.02):
        wait_for(lambda: len(flying.camera._senders.peers) == PEERS_MAX, "the crowd")
        operator = Station(flying, key)
        heartbeats(operator, 3)
        is_peer = operator.socket.getsockname() in flying.camera._senders.peers
        assert is_peer == (key is not None), "who signs takes the place of who does not"
        operator.close()


def test_earlier_senders_stay_and_silent_ones_are_replaced() -> None:
    senders = Senders(MavlinkParser())
    assert senders.register(("operator", 1), 0.0, is_signed=False)
    for n in range(100):
        senders.register((f"unknown {n}", 1), 1.0, is_signed=False)
    assert len(senders.peers) == PEERS_MAX
    assert ("operator", 1) in senders.peers
    senders.register(("operator", 1), 59.0, is_signed=False)
    assert senders.register(("late", 1), 62.0, is_signed=False)
    assert set(senders.peers) == {("operator", 1), ("late", 1)}


def test_a_signed_sender_is_never_replaced_by_an_unsigned_one() -> None:
    senders = Senders(MavlinkParser())
    for n in range(PEERS_MAX):
        assert senders.register((f"operator {n}", 1), float(n), is_signed=n % 2 == 0)
    assert not senders.register(("unknown", 1), 20.0, is_signed=False)
    assert senders.register(("signed", 1), 20.0, is_signed=True)
    assert ("operator 1", 1) not in senders.peers, "the unsigned one that was silent for longest"
    for n in range(PEERS_MAX):
        senders.register((f"signed {n}", 1), 21.0, is_signed=True)
    assert {f"operator {n}" for n in range(0, PEERS_MAX, 2)} <= {a for a, _ in senders.peers}

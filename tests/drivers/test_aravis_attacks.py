"""The Aravis head while somebody else sends to its ports: nothing is lost or stored for that.

Attackers have loopback addresses of their own. One datagram with a block number 30 ahead used to
cost every later exposure, and a forged frame in time was stored as the head's.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.cli.find_heads import found_heads
from drivers.cameras.aravis import gvcp
from drivers.cameras.aravis.packet_filter import SocketCapture
from drivers.contract import DeviceError, FrameStatus
from drivers.transport.udp_port import open_udp_port
from sim_hw.faults.plan import PlannedFault
from sim_hw.gige import features
from sim_hw.gige.gige_head import FrameSize, GigeHead, HeadIdentity, Pacing, WireFaults
from sim_hw.gige.gvsp import PAYLOAD_IMAGE
from sim_hw.world.world_clock import FreeRunningClock
from tests.daemon.onboard.monitoring.test_mavsdk_camera import free_port
from tests.drivers.test_aravis_head import NETWORK, PATTERN, SHAPE, Pair, flying
from tests.support.stopwatch import Stopwatch

pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
pytestmark = [pytest.mark.realtime, pytest.mark.timeout(240), pytest.mark.trust, pytest.mark.attack]

HEAD = f"{NETWORK}.1"
ATTACKER_ADDRESS = f"{NETWORK}.66"
MONO16 = 0x0110_0007
FORGED = np.full(SHAPE, 0x0ABC, np.uint16)
AHEAD = 30
CONTROL_ADDRESS = f"{NETWORK}.99"


def has_packet_sockets() -> bool:
    with contextlib.suppress(OSError), socket.socket(socket.AF_PACKET, socket.SOCK_RAW):
        return True
    return False


def stream_of(pair: Pair) -> tuple[str, int]:
    """Where the head sends its frames."""
    destination = pair.emulated._acquisition.destination()
    assert destination is not None
    return destination.address, destination.port


def packet(block_id: int, kind: int, number: int, body: bytes = b"") -> bytes:
    return struct.pack(">HHI", 0, block_id, kind << 24 | number) + body


def forged_frame(block_id: int, packet_size: int) -> list[bytes]:
    """A whole frame of the attacker's pixels, as the head would send it without chunks."""
    leader = struct.pack(">HHQIIIIIHH", 0, PAYLOAD_IMAGE, 1, MONO16, SHAPE[1], SHAPE[0], 0, 0, 0, 0)
    step = packet_size - 36
    data = FORGED.tobytes()
    parts = [data[at : at + step] for at in range(0, len(data), step)]
    trailer = struct.pack(">HHI", 0, PAYLOAD_IMAGE, SHAPE[0])
    return [
        packet(block_id, 1, 0, leader),
        *(packet(block_id, 3, n, part) for n, part in enumerate(parts, 1)),
        packet(block_id, 2, len(parts) + 1, trailer),
    ]


def wait_counted(pair: Pair, name: str, count: int) -> None:
    deadline = time.monotonic() + 40
    pause = threading.Event()
    while pair.driver.statistics()[name] < count:
        assert time.monotonic() < deadline, dict(pair.driver.statistics())
        pause.wait(0.05)


@contextlib.contextmanager
def attacker_socket(address: str = ATTACKER_ADDRESS) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind((address, 0))
        yield udp


def fly_attacked(pair: Pair, attacker: socket.socket, count: int = 6) -> int:
    """Before each pulse a datagram far ahead and the whole next frame, forged; how many sent."""
    sent = 0
    for number in range(1, count + 1):
        for datagram in (
            packet(number + AHEAD, 3, 1, b"\xff" * 100),
            *forged_frame(number, pair.driver._session.camera.frame_settings["GevSCPSPacketSize"]),
        ):
            attacker.sendto(datagram, stream_of(pair))
            sent += 1
        pair.pulse(number)
        pair.wait_frames(number)
    return sent


def assert_unaffected(pair: Pair, count: int = 6) -> None:
    assert [f.status for f in pair.frames] == [FrameStatus.COMPLETE] * count
    assert [f.counter for f in pair.frames] == list(range(1, count + 1))
    for picture in pair.pictures:
        np.testing.assert_array_equal(picture, PATTERN)
    assert pair.driver.statistics()["opened"] == 1


@pytest.mark.parametrize("packet_socket", [False, True])
def test_forged_frames_and_block_numbers_of_another_address_cost_nothing(
    packet_socket: bool,
) -> None:
    if packet_socket and not has_packet_sockets():
        pytest.skip("packet sockets need CAP_NET_RAW")
    with flying(packet_socket=packet_socket) as (pair,), attacker_socket() as attacker:
        sent = fly_attacked(pair, attacker)
        wait_counted(pair, "other_senders", sent)
        source = "{}:{}".format(*attacker.getsockname())
        accepted = f"{HEAD}:{pair.emulated._stream_port}"
    assert_unaffected(pair)
    assert pair.driver.statistics()["other_senders"] == sent
    (event,) = [e for e in pair.events if e.name == "other-sender"]
    assert event.is_fault
    assert f"the last from {source}; only {accepted} is accepted" in event.sentence
    assert "connect the heads to a separate network" in event.sentence


def test_another_port_of_the_heads_address_is_another_sender() -> None:
    with flying() as (pair,), attacker_socket(HEAD) as attacker:
        sent = fly_attacked(pair, attacker)
        wait_counted(pair, "other_senders", sent)
    assert_unaffected(pair)


@pytest.mark.skipif(not has_packet_sockets(), reason="packet sockets need CAP_NET_RAW")
def test_a_packet_socket_takes_the_heads_port_only() -> None:
    with flying(packet_socket=True) as (pair,), attacker_socket(HEAD) as attacker:
        fly_attacked(pair, attacker)
    assert_unaffected(pair)


@contextlib.contextmanager
def head_reporting_port(port: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Pair]:
    """A head whose register for its stream's source port holds something else."""
    start = GigeHead.start

    def start_and_report(head: GigeHead) -> None:
        start(head)
        head._registers.set_register(features.STREAM_SOURCE_PORT, port)

    monkeypatch.setattr(GigeHead, "start", start_and_report)
    with flying() as (pair,):
        yield pair


def test_a_head_that_does_not_say_its_port_is_held_to_the_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with head_reporting_port(0, monkeypatch) as pair, attacker_socket() as attacker:
        fly_attacked(pair, attacker, 3)
        with attacker_socket(HEAD) as other_port:
            for number in range(4, 7):
                other_port.sendto(packet(number + AHEAD, 3, 1), stream_of(pair))
                for datagram in forged_frame(number, 8000):
                    other_port.sendto(datagram, stream_of(pair))
                pair.pulse(number)
                pair.wait_frames(number)
    assert_unaffected(pair)


def test_a_head_that_reports_a_wrong_port_loses_no_frame_for_that(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with head_reporting_port(9, monkeypatch) as pair, attacker_socket() as attacker:
        # Its test packet shows where it really sends from.
        fly_attacked(pair, attacker)
    assert_unaffected(pair)


def test_a_head_that_skips_block_numbers_loses_one_exposure_at_most() -> None:
    with flying() as (pair,):
        for number in (1, 2):
            pair.pulse(number)
            pair.wait_frames(number)
        pair.emulated._stream._socket.sendto(packet(2 + AHEAD, 3, 1, b"\0" * 100), stream_of(pair))
        pair.wait_frames(3)  # the datagram itself is an incomplete frame
        pause = threading.Event()
        for number in range(3, 9):
            pair.pulse(number)
            pause.wait(0.4)
        pair.wait(lambda: pair.frames[-1].counter == 8, "the last frame")
    complete = [f.counter for f in pair.frames if f.status is FrameStatus.COMPLETE]
    assert complete == [1, 2, 4, 5, 6, 7, 8]
    assert pair.driver.statistics()["stream_restarts"] == 1
    assert "stream-restarted" in [e.name for e in pair.events]


def acknowledgement(code: int, request_id: int, body: bytes, status: int = 0) -> bytes:
    return struct.pack(">HHHH", status, code, len(body), request_id) + body


def forged_answers() -> list[bytes]:
    """Answers to anything that may be asked, for every number near those that Aravis counts."""
    value = struct.pack(">I", 0)
    return [
        acknowledgement(code, request_id, value)
        for request_id in (*range(65200, 65536), *range(1, 200))
        for code in (0x0081, 0x0085, 0x0003, 0x0005, 0x00C1)
    ] + [acknowledgement(0x0089, n, struct.pack(">HH", 0, 65_535)) for n in range(1, 20)]


@pytest.mark.parametrize("address", [ATTACKER_ADDRESS, HEAD], ids=["another", "another port"])
def test_forged_answers_to_control_commands_change_nothing(address: str) -> None:
    with flying(latch_interval_s=0.5) as (pair,), attacker_socket(address) as attacker:
        control = pair.emulated._control.controller
        assert control is not None
        over = threading.Event()

        def attack() -> None:
            while not over.is_set():
                for answer in forged_answers():
                    attacker.sendto(answer, control)
                over.wait(0.05)

        thread = threading.Thread(target=attack)
        thread.start()
        try:
            latches = pair.driver.statistics()["latches"]
            wait_counted(pair, "latches", latches + 4)
            pair.pulse(1)
            pair.wait_frames(1)
        finally:
            over.set()
            thread.join()
    assert_unaffected(pair, 1)
    assert pair.frames[0].temperature_c == 36.5
    assert abs(pair.start_on_host_ns(pair.frames[0]) - pair.starts_ns[0]) < 50_000_000
    assert pair.driver.statistics()["other_senders"] > 0
    assert "lost" not in [e.name for e in pair.events]


def test_pending_acknowledgements_of_others_do_not_keep_a_lost_head_away() -> None:
    silent = WireFaults(planned=(PlannedFault("silent", "SU00", None, 1, 6.0, 0.0),))
    with flying(faults=silent) as (pair,), attacker_socket() as attacker:
        control = pair.emulated._control.controller
        assert control is not None
        over = threading.Event()

        def attack() -> None:
            while not over.wait(0.02):
                attacker.sendto(acknowledgement(0x0089, 1, struct.pack(">HH", 0, 65_535)), control)

        thread = threading.Thread(target=attack)
        thread.start()
        try:
            pair.pulse(1)
            # Letting go of a silent head is a question of 2.5 s, three times.
            pair.wait(lambda: [e.name for e in pair.events].count("opened") == 2, "open again")
        finally:
            over.set()
            thread.join()


def accepted_by(udp: socket.socket) -> set[str]:
    """Which of head and unknown sender reaches a socket."""
    udp.settimeout(0.2)
    for address in (HEAD, ATTACKER_ADDRESS):
        with attacker_socket(address) as sender:
            sender.sendto(b"?", ("127.0.0.1", udp.getsockname()[1]))
    found = set()
    with contextlib.suppress(TimeoutError):
        while True:
            found.add(udp.recvfrom(10)[1][0])
    return found


def test_a_socket_is_held_to_the_head_as_soon_as_aravis_binds_it() -> None:
    """Aravis makes and uses sockets within one call; ours and those of others stay as they are."""
    with contextlib.ExitStack() as stack:
        before = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        before.bind(("127.0.0.1", 0))
        sockets = stack.enter_context(SocketCapture("127.0.0.1", HEAD))
        elsewhere = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        elsewhere.bind(("127.0.0.2", 0))
        receiver = open_udp_port(f"udpin://127.0.0.1:{free_port()}")
        stack.callback(receiver.close)
        forger = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        forger.bind(("127.0.0.1", 0))
        pause = threading.Event()
        pause.wait(0.2)
        assert accepted_by(forger) == {HEAD}
        assert accepted_by(before) == accepted_by(receiver._socket) == {HEAD, ATTACKER_ADDRESS}
        with sockets.take() as taken:
            assert taken.getsockname() == forger.getsockname()
        with pytest.raises(DeviceError, match="control socket"):
            sockets.take()


@contextlib.contextmanager
def control_port(*answers: tuple[int, int, bytes]) -> Iterator[None]:
    """A head that gives these answers to each command: number added, code, body."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind((CONTROL_ADDRESS, gvcp.GVCP_PORT))
        udp.settimeout(0.1)
        over = threading.Event()

        def serve() -> None:
            while not over.is_set():
                with contextlib.suppress(TimeoutError):
                    command, peer = udp.recvfrom(576)
                    (request_id,) = struct.unpack_from(">H", command, 6)
                    for added, code, body in answers:
                        number = 1 + (request_id + added - 1) % 65535
                        udp.sendto(acknowledgement(code, number, body), peer)
                        over.wait(0.01)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()


def test_only_the_answer_with_the_number_of_the_request_counts() -> None:
    yes, no = struct.pack(">I", 2), struct.pack(">I", 0)
    with control_port((1, 0x0081, no), (0, 0x0083, no), (0, 0x0003, no), (0, 0x0081, yes)):
        assert gvcp.control_privilege(CONTROL_ADDRESS, timeout_s=2.0) == 2
    with control_port((1, 0x0081, no), (-1, 0x0081, no)):
        assert gvcp.control_privilege(CONTROL_ADDRESS, timeout_s=0.3) is None


def test_a_head_may_ask_for_more_time_but_not_without_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(gvcp, "PENDING_MAX_S", 0.5)
    pending = (0, 0x0089, struct.pack(">HH", 0, 60_000))
    with control_port(pending, *[pending] * 20, (0, 0x0081, struct.pack(">I", 2))):
        assert gvcp.control_privilege(CONTROL_ADDRESS, timeout_s=0.15) == 2
    with control_port(pending, pending):
        watch = Stopwatch()
        assert gvcp.control_privilege(CONTROL_ADDRESS, timeout_s=0.15) is None
        assert watch.elapsed_s > 0.5 and watch.is_within(5.0)


@contextlib.contextmanager
def impostor(serial: str, model: str, user_id: str) -> Iterator[None]:
    """Another head, with an identity of the attacker's choice."""
    head = GigeHead(
        HeadIdentity(f"{NETWORK}.77", serial, model, "Peer", user_id),
        FrameSize(SHAPE[1], SHAPE[0]),
        lambda _request: FORGED,
        lambda _mono_ns: 0.0,
        FreeRunningClock(),
        WireFaults(),
        Pacing.for_receive_buffer(4 << 20),
    )
    head.start()
    try:
        yield
    finally:
        head.close()


def test_what_answers_discovery_prints_no_markup_and_no_control_sequences() -> None:
    with impostor("[/x]", "\x1b[31mA\u202e\r[bold]", ""):
        shown = CliRunner().invoke(app, ["check", "--find-heads"], env={"COLUMNS": "200"})
    assert shown.exit_code == 0, shown.exception
    assert "[/x]" in shown.stdout
    assert "?[31mA" in shown.stdout
    assert "[bold]" in shown.stdout
    assert not [c for c in shown.stdout if not c.isprintable() and c != "\n"]


def test_who_answers_discovery_in_a_heads_name_is_not_opened() -> None:
    with impostor("EVIL", "Head", HEAD):
        found, _ = found_heads()
        assert "EVIL" in [head["settings"]["serial"] for head in found]
        with flying() as (pair,):
            pair.pulse(1)
            pair.wait_frames(1)
            assert pair.driver.bind()["serial"] == "E-0"
    assert_unaffected(pair, 1)

"""The control channel of an emulated head, packet by packet, without a socket."""

from __future__ import annotations

import struct
from xml.etree import ElementTree

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_hw.gige import features as at
from sim_hw.gige.control import ControlChannel, HeadActions
from sim_hw.gige.gvcp import ResendRequest, Status
from sim_hw.gige.registers import FrameSize, HeadIdentity, RegisterMemory

HOST = ("127.0.0.1", 40_000)
OTHER_HOST = ("127.0.0.1", 40_001)
STREAM_SOCKET_OF_HOST = ("127.0.0.1", 40_002)
DISCOVERY, PACKETRESEND = 0x0002, 0x0040
READREG, WRITEREG, READMEM, WRITEMEM = 0x0080, 0x0082, 0x0084, 0x0086
MS = 1_000_000


class Bench:
    """A control channel and the calls of its head's actions."""

    def __init__(self) -> None:
        self.written: list[int] = []
        self.resends: list[ResendRequest] = []
        self.control_lost = 0
        self.acquiring = False
        self.actions: list[int | None] = []
        self.registers = RegisterMemory(
            HeadIdentity("127.77.0.1", "S-1", "Model", "Vendor", "SU00"), FrameSize(1248, 832)
        )
        self.channel = ControlChannel(
            self.registers,
            HeadActions(
                written=self.written.append,
                resend=self.resends.append,
                execute_action=self._act,
                control_lost=self._lost,
                is_acquiring=lambda: self.acquiring,
            ),
        )
        self._request_id = 0

    def _act(self, device_ns: int | None) -> Status:
        self.actions.append(device_ns)
        return Status.SUCCESS

    def _lost(self) -> None:
        self.control_lost += 1

    def packet(self, code: int, body: bytes = b"", flags: int = 1) -> bytes:
        self._request_id = self._request_id % 0xFFFF + 1
        return struct.pack(">BBHHH", 0x42, flags, code, len(body), self._request_id) + body

    def ask(
        self, code: int, body: bytes = b"", peer: tuple[str, int] = HOST, now_ns: int = 0
    ) -> tuple[int, bytes]:
        """Status and body of the acknowledgement."""
        packet = self.packet(code, body)
        answer = self.channel.answer(packet, peer, now_ns)
        assert answer is not None
        status, acknowledged, length, request_id = struct.unpack(">HHHH", answer[:8])
        assert acknowledged == code + 1
        assert request_id == struct.unpack(">H", packet[6:8])[0]
        assert length == len(answer) - 8
        return status, answer[8:]

    def read(self, address: int, peer: tuple[str, int] = HOST, now_ns: int = 0) -> int:
        status, body = self.ask(READREG, struct.pack(">I", address), peer, now_ns)
        assert status == Status.SUCCESS
        return int(struct.unpack(">I", body)[0])

    def write(self, address: int, value: int, peer: tuple[str, int] = HOST, now_ns: int = 0) -> int:
        """Status of writing one register."""
        return self.ask(WRITEREG, struct.pack(">II", address, value), peer, now_ns)[0]

    def take_control(self, peer: tuple[str, int] = HOST, now_ns: int = 0) -> int:
        return self.write(at.CONTROL_PRIVILEGE, at.CONTROL_ACCESS, peer, now_ns)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_discovery_identifies_the_head(bench: Bench) -> None:
    status, body = bench.ask(DISCOVERY)
    assert status == Status.SUCCESS
    assert len(body) == 0xF8
    assert body[0x24:0x28] == bytes((127, 77, 0, 1))
    assert body[0x48:0x68].rstrip(b"\0") == b"Vendor"
    assert body[0x68:0x88].rstrip(b"\0") == b"Model"
    assert body[0xD8:0xE8].rstrip(b"\0") == b"S-1"
    assert body[0xE8:0xF8].rstrip(b"\0") == b"SU00"


def test_nobody_writes_without_the_privilege(bench: Bench) -> None:
    address = bench.registers.address_of("TdiShifts")
    assert bench.write(address, 12) == Status.ACCESS_DENIED
    assert bench.take_control() == Status.SUCCESS
    assert bench.write(address, 12) == Status.SUCCESS
    assert bench.read(address) == 12
    assert bench.written == [address]


def test_a_second_controller_is_refused_but_may_read(bench: Bench) -> None:
    bench.take_control()
    assert bench.take_control(OTHER_HOST) == Status.ACCESS_DENIED
    assert bench.write(at.STREAM_PACKET_DELAY, 1, OTHER_HOST) == Status.ACCESS_DENIED
    assert bench.read(at.HEARTBEAT_TIMEOUT, OTHER_HOST) == 3000


def test_exclusive_access_keeps_others_from_reading_all_but_the_privilege(bench: Bench) -> None:
    bench.write(at.CONTROL_PRIVILEGE, at.EXCLUSIVE_ACCESS)
    status, _ = bench.ask(READREG, struct.pack(">I", at.HEARTBEAT_TIMEOUT), OTHER_HOST)
    assert status == Status.ACCESS_DENIED
    assert bench.read(at.CONTROL_PRIVILEGE, OTHER_HOST) == at.EXCLUSIVE_ACCESS


def test_a_dead_controller_holds_the_privilege_until_the_heartbeat_times_out(bench: Bench) -> None:
    bench.take_control(now_ns=0)
    assert bench.take_control(OTHER_HOST, now_ns=3000 * MS) == Status.ACCESS_DENIED
    assert bench.control_lost == 0
    assert bench.take_control(OTHER_HOST, now_ns=3001 * MS) == Status.SUCCESS
    assert bench.control_lost == 1
    assert bench.channel.controller == OTHER_HOST


def test_the_heartbeat_timeout_is_what_the_controller_wrote(bench: Bench) -> None:
    bench.take_control(now_ns=0)
    assert bench.write(at.HEARTBEAT_TIMEOUT, 499, now_ns=0) == Status.INVALID_PARAMETER
    assert bench.write(at.HEARTBEAT_TIMEOUT, 500, now_ns=0) == Status.SUCCESS
    bench.channel.expire(500 * MS)
    assert bench.channel.controller == HOST
    bench.channel.expire(501 * MS)
    assert bench.channel.controller is None
    assert bench.read(at.CONTROL_PRIVILEGE, now_ns=501 * MS) == 0


def test_any_command_of_the_controller_is_a_heartbeat(bench: Bench) -> None:
    bench.take_control(now_ns=0)
    for second in range(1, 20):
        bench.read(at.CONTROL_PRIVILEGE, now_ns=second * 1000 * MS)
    assert bench.channel.controller == HOST
    assert bench.control_lost == 0


def test_giving_the_privilege_back_stops_the_head(bench: Bench) -> None:
    bench.take_control()
    bench.write(at.CONTROL_PRIVILEGE, 0)
    assert bench.control_lost == 1
    assert bench.take_control(OTHER_HOST) == Status.SUCCESS


def test_a_command_repeated_for_a_lost_answer_is_done_once(bench: Bench) -> None:
    bench.take_control()
    address = bench.registers.address_of("TriggerSoftware")
    packet = bench.packet(WRITEREG, struct.pack(">II", address, 1))
    first = bench.channel.answer(packet, HOST, 0)
    assert bench.channel.answer(packet, HOST, 1) == first
    assert bench.written == [address]


@pytest.mark.parametrize(
    ("name", "value"),
    [("TdiShifts", 65), ("PixelFormat", 7), ("TriggerMode", 2), ("Width", 640), ("OffsetX", 8)],
)
def test_a_value_out_of_bounds_is_refused_and_changes_nothing(
    bench: Bench, name: str, value: int
) -> None:
    bench.take_control()
    before = bench.registers.integer(name)
    assert bench.write(bench.registers.address_of(name), value) == Status.INVALID_PARAMETER
    assert bench.registers.integer(name) == before


@pytest.mark.parametrize("microseconds", [9.9, 1_000_001.0, float("nan"), float("inf"), -5.0])
def test_an_exposure_time_that_cannot_be_is_refused(bench: Bench, microseconds: float) -> None:
    bench.take_control()
    body = struct.pack(">Id", bench.registers.address_of("ExposureTime"), microseconds)
    assert bench.ask(WRITEMEM, body)[0] == Status.INVALID_PARAMETER
    assert bench.registers.number("ExposureTime") == 5000.0


def test_an_exposure_time_is_written_as_a_double(bench: Bench) -> None:
    bench.take_control()
    body = struct.pack(">Id", bench.registers.address_of("ExposureTime"), 1234.5)
    assert bench.ask(WRITEMEM, body)[0] == Status.SUCCESS
    assert bench.registers.number("ExposureTime") == 1234.5


def test_the_pixel_format_is_locked_while_acquiring(bench: Bench) -> None:
    bench.take_control()
    address = bench.registers.address_of("PixelFormat")
    bench.acquiring = True
    assert bench.write(address, at.PIXEL_FORMATS["Mono8"]) == Status.BUSY
    bench.acquiring = False
    assert bench.write(address, at.PIXEL_FORMATS["Mono8"]) == Status.SUCCESS


@pytest.mark.parametrize(
    ("address", "status"),
    [
        (0x5000, Status.INVALID_ADDRESS),
        (at.DISCOVERY_LENGTH, Status.INVALID_ADDRESS),
        (2, Status.BAD_ALIGNMENT),
    ],
)
def test_reading_where_nothing_is_gives_its_own_status(
    bench: Bench, address: int, status: Status
) -> None:
    assert bench.ask(READREG, struct.pack(">I", address))[0] == status


def test_what_is_read_only_cannot_be_written(bench: Bench) -> None:
    bench.take_control()
    assert bench.write(at.VERSION, 0) == Status.WRITE_PROTECT
    assert bench.write(at.XML_START, 0) == Status.WRITE_PROTECT
    assert bench.read(at.VERSION) == 0x0002_0000


def test_several_registers_are_written_up_to_the_first_refusal(bench: Bench) -> None:
    bench.take_control()
    tdi = bench.registers.address_of("TdiShifts")
    body = struct.pack(">IIIIII", tdi, 5, tdi, 99, tdi, 7)
    status, answer = bench.ask(WRITEREG, body)
    assert status == Status.INVALID_PARAMETER
    assert struct.unpack(">HH", answer) == (0, 1)
    assert bench.registers.integer("TdiShifts") == 5


def test_the_description_is_read_from_the_heads_memory_and_is_well_formed(bench: Bench) -> None:
    _, body = bench.ask(READMEM, struct.pack(">IHH", at.XML_URL, 0, 512))
    name, address, length = body[4:].rstrip(b"\0").decode().removeprefix("Local:").split(";")
    assert name == "head.xml"
    start, size = int(address, 16), int(length, 16)
    xml = b""
    while len(xml) < size:
        count = min(512, size - len(xml))
        _, body = bench.ask(READMEM, struct.pack(">IHH", start + len(xml), 0, count))
        xml += body[4:]
    root = ElementTree.fromstring(xml.rstrip(b"\0").decode())
    named = {node.get("Name") for node in root.iter() if node.get("Name")}
    referred = {
        node.text
        for node in root.iter()
        if node.tag.rpartition("}")[2] in ("pFeature", "pValue", "pPort", "pIndex", "pSelected")
    }
    assert referred <= named
    assert {"ExposureTime", "TdiShifts", "DeviceTemperature", "ChunkTimestamp"} <= named


def test_a_resend_request_comes_from_the_controllers_stream_socket(bench: Bench) -> None:
    body = struct.pack(">HHII", 0, 7, 3, 9)
    bench.channel.answer(bench.packet(PACKETRESEND, body, flags=0), STREAM_SOCKET_OF_HOST, 0)
    assert bench.resends == []
    bench.take_control()
    bench.channel.answer(bench.packet(PACKETRESEND, body, flags=0), STREAM_SOCKET_OF_HOST, 0)
    bench.channel.answer(bench.packet(PACKETRESEND, body, flags=0), ("127.0.0.9", 1), 0)
    assert bench.resends == [ResendRequest(7, 3, 9)]


def test_an_unknown_command_is_answered_so(bench: Bench) -> None:
    assert bench.ask(0x00F0)[0] == Status.NOT_IMPLEMENTED


def test_what_is_not_gvcp_is_counted_and_dropped(bench: Bench) -> None:
    good = bench.packet(DISCOVERY)
    for packet in (b"", b"\x42", b"\x43" + good[1:], good + b"x", good[:4] + b"\0\4" + good[6:]):
        assert bench.channel.answer(packet, HOST, 0) is None
    assert bench.channel.counts["garbage_packets"] == 5


any_address = st.one_of(
    st.integers(0, 0x3_0000), st.integers(0, 2**32 - 1), st.integers(0x1_0000, 0x1_0600)
)
any_body = st.one_of(
    st.binary(max_size=600),
    st.lists(any_address, max_size=8).map(lambda a: struct.pack(f">{len(a)}I", *a)),
    st.builds(lambda a, rest: struct.pack(">I", a) + rest, any_address, st.binary(max_size=64)),
    st.builds(lambda a, n: struct.pack(">IHH", a, 0, n), any_address, st.integers(0, 65_535)),
)
any_command = st.builds(
    lambda flags, code, identifier, body: (
        struct.pack(">BBHHH", 0x42, flags, code, len(body), identifier) + body
    ),
    st.integers(0, 255),
    st.one_of(st.sampled_from([2, 4, 0x40, 0x80, 0x82, 0x84, 0x86]), st.integers(0, 65_535)),
    st.integers(0, 65_535),
    any_body,
)


@settings(max_examples=150, deadline=None)
@given(
    packets=st.lists(
        st.tuples(
            st.one_of(any_command, st.binary(max_size=700)),
            st.sampled_from([HOST, OTHER_HOST]),
            st.integers(0, 10**10),
        ),
        max_size=30,
    )
)
def test_hostile_packets_never_raise_and_the_head_still_answers(
    packets: list[tuple[bytes, tuple[str, int], int]],
) -> None:
    bench = Bench()
    now_ns = 0
    for packet, peer, later_ns in packets:
        now_ns += later_ns
        answer = bench.channel.answer(packet, peer, now_ns)
        assert answer is None or 8 <= len(answer) <= 8 + 4 + 540
    later_ns = now_ns + (1 << 32) * MS + 1
    assert bench.ask(DISCOVERY, now_ns=later_ns)[0] == Status.SUCCESS
    assert bench.take_control(OTHER_HOST, now_ns=later_ns) == Status.SUCCESS


ACTION, ACTION_CAPABILITY, SCHEDULED_CAPABILITY = 0x0100, 1 << 6, 1 << 17


def bench_with_keys() -> Bench:
    """A controlled head with device key 7, group key 8 and group mask 0b0110."""
    bench = Bench()
    bench.ask(WRITEREG, struct.pack(">II", at.CONTROL_PRIVILEGE, 2))
    for address, value in ((0x090C, 7), (0x9800, 8), (0x9804, 0b0110)):
        bench.ask(WRITEREG, struct.pack(">II", address, value))
    return bench


def test_a_head_states_that_it_takes_actions_scheduled_ones_too() -> None:
    capability = Bench().read(0x0934)
    assert capability & ACTION_CAPABILITY
    assert capability & SCHEDULED_CAPABILITY
    assert Bench().read(0x0908) == 1, "one action signal"


def test_an_action_is_taken_from_whoever_knows_the_keys() -> None:
    bench = bench_with_keys()
    status, body = bench.ask(ACTION, struct.pack(">III", 7, 8, 0b0010), OTHER_HOST)
    assert (status, body) == (Status.SUCCESS, b"")
    assert bench.actions == [None]


@pytest.mark.parametrize("keys", [(6, 8, 0b0010), (7, 9, 0b0010), (7, 8, 0b1001)])
def test_an_action_that_means_others_is_passed_over_in_silence(keys: tuple[int, int, int]) -> None:
    bench = bench_with_keys()
    packet = bench.packet(ACTION, struct.pack(">III", *keys))
    assert bench.channel.answer(packet, OTHER_HOST, 0) is None
    assert bench.actions == []


def test_a_head_without_a_controller_takes_no_action() -> None:
    bench = Bench()
    packet = bench.packet(ACTION, struct.pack(">III", 0, 0, 0xFFFF_FFFF))
    assert bench.channel.answer(packet, OTHER_HOST, 0) is None


def test_a_scheduled_action_states_its_time() -> None:
    bench = bench_with_keys()
    body = struct.pack(">IIIQ", 7, 8, 0xFFFF_FFFF, 123_456_789_012_345)
    assert bench.channel.answer(bench.packet(ACTION, body, flags=0x81), HOST, 0) is not None
    assert bench.actions == [123_456_789_012_345]
    status, _ = bench.ask(ACTION, body)
    assert status == Status.INVALID_HEADER, "a time, and no flag that announces it"


def test_an_action_that_asks_for_no_answer_gets_none() -> None:
    bench = bench_with_keys()
    packet = bench.packet(ACTION, struct.pack(">III", 7, 8, 2), flags=0)
    assert bench.channel.answer(packet, OTHER_HOST, 0) is None
    assert bench.actions == [None]

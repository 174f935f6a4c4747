"""FORCEIP at the control channel of an emulated head, packet by packet."""

from __future__ import annotations

import struct
from dataclasses import replace

import pytest

from sim_hw.gige.gvcp import ForceIpRequest, GvcpCommand, Status, parse_force_ip
from tests.sim_hw.gige.test_control import HOST, OTHER_HOST, Bench

FORCEIP = 0x0004
OWN_MAC = bytes((0x02, 0x00, 127, 77, 0, 1))


def body(mac: bytes = OWN_MAC) -> bytes:
    """Fields at their offsets: MAC 2, address 20, mask 36, gateway 52."""
    found = bytearray(56)
    found[2:8] = mac
    found[20:24] = bytes((10, 0, 0, 5))
    found[36:40] = bytes((255, 255, 255, 0))
    found[52:56] = bytes((10, 0, 0, 254))
    return bytes(found)


@pytest.fixture
def forced() -> list[ForceIpRequest]:
    return []


@pytest.fixture
def bench(forced: list[ForceIpRequest]) -> Bench:
    made = Bench()

    def force(request: ForceIpRequest) -> Status:
        forced.append(request)
        return Status.SUCCESS

    made.channel._actions = replace(made.channel._actions, force_address=force)
    return made


def test_the_head_with_this_mac_takes_the_address(
    bench: Bench, forced: list[ForceIpRequest]
) -> None:
    assert bench.ask(FORCEIP, body()) == (Status.SUCCESS, b"")
    assert forced == [ForceIpRequest(OWN_MAC, "10.0.0.5", "255.255.255.0", "10.0.0.254")]


def test_another_mac_is_not_answered(bench: Bench, forced: list[ForceIpRequest]) -> None:
    packet = bench.packet(FORCEIP, body(bytes((0x02, 0x00, 127, 77, 0, 2))))
    assert bench.channel.answer(packet, HOST, 0) is None
    assert forced == []


@pytest.mark.parametrize("asker", [HOST, OTHER_HOST])
def test_a_head_under_control_keeps_its_address(
    bench: Bench, forced: list[ForceIpRequest], asker: tuple[str, int]
) -> None:
    bench.take_control()
    assert bench.ask(FORCEIP, body(), asker)[0] == Status.ACCESS_DENIED
    assert forced == []


@pytest.mark.parametrize("length", [0, 55, 57])
def test_a_body_of_another_length_is_refused(bench: Bench, length: int) -> None:
    assert bench.ask(FORCEIP, (body() + b"\0")[:length])[0] == Status.INVALID_HEADER


def test_a_head_without_an_interface_of_its_own_has_no_force_ip() -> None:
    assert Bench().ask(FORCEIP, body())[0] == Status.NOT_IMPLEMENTED


def test_our_command_has_its_fields_where_the_emulated_head_reads_them() -> None:
    request = struct.pack(
        ">H6s12x4s12x4s12x4s", 0, OWN_MAC, b"\x0a\0\0\5", b"\xff\xff\xff\0", b"\0" * 4
    )
    parsed = parse_force_ip(GvcpCommand(FORCEIP, 1, 1, request))
    assert parsed == ForceIpRequest(OWN_MAC, "10.0.0.5", "255.255.255.0", "0.0.0.0")

"""The emulated temperature module: frame by frame, and read by pymodbus' client."""

from __future__ import annotations

import math
import os
import select
import struct
import time
import tty
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.client.mixin import ModbusClientMixin

from sim_hw.devices.modbus_probe import ModbusProbe, crc16

TEMPERATURES_C: tuple[float | None, ...] = (21.34, -5.2, None, 0.0, 250.0, -40.04)
REGISTERS = (213, 65484, 0x7FFF, 0, 2500, 65136)
FIRST_REGISTER = 100


def make_probe() -> ModbusProbe:
    channels = [lambda value=value: value for value in TEMPERATURES_C]
    return ModbusProbe(channels, unit=3, first_register=FIRST_REGISTER)


@pytest.fixture
def probe() -> Iterator[ModbusProbe]:
    probe = make_probe()
    probe.start()
    yield probe
    probe.close()


def framed(*body: int) -> bytes:
    """A frame with its CRC."""
    return bytes(body) + struct.pack("<H", crc16(bytes(body)))


def request(start: int, count: int, *, unit: int = 3, function: int = 4) -> bytes:
    return framed(unit, function, start >> 8, start & 0xFF, count >> 8, count & 0xFF)


def test_the_crc_is_that_of_the_standards_example() -> None:
    # Modbus over Serial Line V1.02, appendix B: 02 07 gives 41 12 on the line.
    assert struct.pack("<H", crc16(b"\x02\x07")) == b"\x41\x12"


@pytest.mark.parametrize("function", [3, 4])
def test_channels_are_tenths_of_a_degree_and_an_open_sensor_is_7fff(function: int) -> None:
    answer = make_probe().answer(request(FIRST_REGISTER, 6, function=function))
    assert answer is not None
    assert answer[:3] == bytes((3, function, 12))
    assert struct.unpack(">6H", answer[3:15]) == REGISTERS
    assert crc16(answer) == 0


@pytest.mark.parametrize("order", ["big", "little"])
def test_floats_are_those_of_pymodbus_in_both_word_orders(order: str) -> None:
    channels = [lambda value=value: value for value in TEMPERATURES_C]
    floats = ModbusProbe(channels, unit=3, float_word_order=order)
    answer = floats.answer(request(0, 12, function=3))
    assert answer is not None
    registers = list(struct.unpack(">12H", answer[3:27]))
    kind = ModbusClientMixin.DATATYPE.FLOAT32
    for number, value_c in enumerate(TEMPERATURES_C):
        read = ModbusClientMixin.convert_from_registers(
            registers[2 * number : 2 * number + 2], kind, word_order=order
        )
        if value_c is None:
            assert math.isnan(read)
        else:
            assert read == pytest.approx(value_c, abs=1e-5)
    odd = floats.answer(request(1, 2, function=3))
    assert odd is not None
    assert list(struct.unpack(">2H", odd[3:7])) == registers[1:3]


def test_a_module_with_holding_registers_only_refuses_function_4() -> None:
    holding = ModbusProbe([lambda: 21.5], unit=3, functions=(3,))
    assert holding.answer(request(0, 1)) == framed(3, 0x84, 1)
    assert holding.answer(request(0, 1, function=3)) == framed(3, 3, 2, 0, 215)


def test_part_of_the_channels_may_be_read() -> None:
    answer = make_probe().answer(request(FIRST_REGISTER + 1, 2))
    assert answer == framed(3, 4, 4, 0xFF, 0xCC, 0x7F, 0xFF)


@pytest.mark.parametrize(
    ("asked", "code"),
    [
        (request(FIRST_REGISTER, 7), 2),
        (request(FIRST_REGISTER - 1, 1), 2),
        (request(0, 1), 2),
        (request(FIRST_REGISTER, 0), 3),
        (request(FIRST_REGISTER, 126), 3),
    ],
)
def test_what_is_not_there_is_an_exception(asked: bytes, code: int) -> None:
    assert make_probe().answer(asked) == framed(3, 0x84, code)


def test_a_function_it_does_not_have_is_exception_1() -> None:
    assert make_probe().answer(framed(3, 6, 0, 100, 0, 1)) == framed(3, 0x86, 1)


def test_another_slaves_request_and_a_damaged_one_are_met_with_silence() -> None:
    probe = make_probe()
    assert probe.answer(request(FIRST_REGISTER, 1, unit=4)) is None
    assert probe.answer(request(FIRST_REGISTER, 1, unit=0)) is None
    damaged = bytearray(request(FIRST_REGISTER, 1))
    damaged[3] ^= 1
    assert probe.answer(bytes(damaged)) is None
    assert probe.statistics() == {
        "requests": 0,
        "exceptions": 0,
        "damaged_frames": 1,
        "other_slaves": 2,
    }


@given(frame=st.binary(max_size=300))
def test_no_frame_makes_it_raise(frame: bytes) -> None:
    make_probe().answer(frame)
    make_probe().answer(framed(*frame))


class Line:
    """The host's end of the serial line, raw."""

    def __init__(self, port: str) -> None:
        self._fd = os.open(port, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._fd)

    def send(self, data: bytes) -> None:
        os.write(self._fd, data)

    def receive(self, count: int, timeout_s: float = 2.0) -> bytes:
        """That many bytes, or what came in time."""
        received = b""
        deadline = time.monotonic() + timeout_s
        while len(received) < count and (left_s := deadline - time.monotonic()) > 0:
            if select.select([self._fd], [], [], left_s)[0]:
                received += os.read(self._fd, count - len(received))
        return received

    def close(self) -> None:
        os.close(self._fd)


@pytest.fixture
def line(probe: ModbusProbe) -> Iterator[Line]:
    line = Line(probe.port)
    yield line
    line.close()


def test_it_finds_the_next_request_after_noise_and_a_silence(line: Line) -> None:
    line.send(b"\x03\x04\x00")
    assert line.receive(1, timeout_s=0.1) == b""
    line.send(request(FIRST_REGISTER, 1))
    assert line.receive(7) == framed(3, 4, 2, 0, 213)


def test_a_request_may_come_in_pieces(line: Line) -> None:
    full_request = request(FIRST_REGISTER, 1)
    line.send(full_request[:3])
    line.send(full_request[3:])
    assert line.receive(7) == framed(3, 4, 2, 0, 213)


def test_a_babbling_line_is_survived(line: Line) -> None:
    for _ in range(20):
        line.send(b"\x55" * 100)
    assert line.receive(1, timeout_s=0.1) == b""
    line.send(request(FIRST_REGISTER, 1))
    assert line.receive(7) == framed(3, 4, 2, 0, 213)


def test_the_line_can_be_closed_and_opened_again(probe: ModbusProbe) -> None:
    for _ in range(3):
        line = Line(probe.port)
        line.send(request(FIRST_REGISTER, 1))
        assert line.receive(7) == framed(3, 4, 2, 0, 213)
        line.close()


@pytest.mark.peer
def test_pymodbus_reads_the_same_temperatures(probe: ModbusProbe) -> None:
    pymodbus = pytest.importorskip("pymodbus.client", reason="pymodbus is absent; pip install it")
    client = pymodbus.ModbusSerialClient(
        probe.port, baudrate=19_200, parity="N", timeout=1, retries=0
    )
    assert client.connect()
    try:
        read = client.read_input_registers(FIRST_REGISTER, count=6, device_id=3)
        assert tuple(read.registers) == REGISTERS
        held = client.read_holding_registers(FIRST_REGISTER + 1, count=1, device_id=3)
        assert held.registers == [65484]
        beyond = client.read_input_registers(FIRST_REGISTER, count=7, device_id=3)
        assert beyond.isError()
        assert beyond.exception_code == 2
    finally:
        client.close()

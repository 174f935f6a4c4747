"""Modbus registers as temperatures: holding registers, floats in both word orders, and wrong
ones."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.client.mixin import ModbusClientMixin

from drivers.base import registry
from drivers.thermometers.modbus_rtu.frames import READ_HOLDING_REGISTERS, crc16, find_reply
from drivers.thermometers.modbus_rtu.readings import ImplausibleReadingError, ReadingFormat
from drivers.thermometers.modbus_rtu.thermometer import ModbusThermometer
from tests.drivers.fakes import FakeClock
from tests.drivers.test_modbus_rtu import _answers, _run, _samples, _thermometer

FLOAT = ModbusClientMixin.DATATYPE.FLOAT32


def holding_reply(unit: int, registers: list[int]) -> bytes:
    body = struct.pack(f">BBB{len(registers)}H", unit, 3, 2 * len(registers), *registers)
    return body + struct.pack("<H", crc16(body))


@pytest.mark.parametrize("order", ["big", "little"])
@given(value=st.floats(-200, 1800, width=32).filter(lambda v: v == 0 or abs(v) > 1e-3))
def test_a_float_that_pymodbus_writes_is_read_in_both_word_orders(order: str, value: float) -> None:
    registers = ModbusClientMixin.convert_to_registers(value, FLOAT, word_order=order)
    assert ReadingFormat("float32", order, 1.0).temperature_c(registers) == value


def swapped(order: str) -> str:
    return "little" if order == "big" else "big"


@pytest.mark.parametrize("order", ["big", "little"])
@given(value=st.floats(-200, 1800, width=32).filter(lambda v: v == 0 or abs(v) > 1e-3))
def test_no_temperature_is_evidence_for_the_other_word_order(order: str, value: float) -> None:
    registers = ModbusClientMixin.convert_to_registers(value, FLOAT, word_order=order)
    assert ReadingFormat("float32", order, 1.0).word_order_evidence(registers) >= 0
    assert ReadingFormat("float32", swapped(order), 1.0).word_order_evidence(registers) <= 0


def floats(values: list[float], order: str = "big") -> list[int]:
    convert = ModbusClientMixin.convert_to_registers
    return [word for value in values for word in convert(value, FLOAT, word_order=order)]


def polled(*polls: list[float], order: str) -> ModbusThermometer:
    """A thermometer of one channel set to `order`, after these readings in the order "big"."""
    replies = [holding_reply(1, floats(poll)) for poll in polls]
    return _thermometer(
        FakeClock(), _answers(*replies), channels=["0"], register_kind="holding",
        value_type="float32", word_order=order, scale_c=1.0,
    )  # fmt: skip


def test_floats_of_the_other_word_order_yield_no_reading_even_if_they_look_like_one() -> None:
    # 21.53 with its words swapped is 0.0589, 21.535 is a denormal number or beyond the limits.
    thermometer = polled([21.53], [21.53], [21.535], [21.53], order="little")
    recorder = _run(thermometer, 2)
    assert _samples(recorder) == []
    assert "word-order" in recorder.event_names
    assert thermometer.statistics()["unconfirmed"] >= 1


def test_a_reading_that_is_one_in_both_orders_waits_for_one_that_is_not() -> None:
    thermometer = polled([21.53], [21.53], [21.5], [21.53], order="big")
    samples = _samples(_run(thermometer, 8))
    assert samples[0] == ("0", 21.5)
    assert samples[1] == ("0", pytest.approx(21.53, abs=1e-5))
    assert thermometer.statistics()["unconfirmed"] == 2


def test_a_failed_channel_does_not_silence_its_neighbours() -> None:
    # -9999 is the error value of some modules; with its words swapped it is 0.008.
    thermometer = _thermometer(
        FakeClock(), _answers(holding_reply(1, floats([21.5, -9999.0, 30.25]))),
        register_kind="holding", value_type="float32", scale_c=1.0,
    )  # fmt: skip
    recorder = _run(thermometer, 6)
    assert _samples(recorder)[:2] == [("0", 21.5), ("G", 30.25)]
    assert "implausible" in recorder.event_names and "word-order" not in recorder.event_names


@pytest.mark.parametrize(
    ("format_", "registers", "value_c"),
    [
        (ReadingFormat(), [215], 21.5),
        (ReadingFormat(), [65484], -5.2),
        (ReadingFormat(), [0x7FFF], None),
        (ReadingFormat(scale_c=0.01), [2153], 21.53),
        (ReadingFormat("uint16", scale_c=0.01, offset_c=-273.15), [29465], 21.5),
        (ReadingFormat("uint16", scale_c=0.05), [0x8000], 1638.4),
        (ReadingFormat(open_sensor=0x8000), [0x8000], None),
        (ReadingFormat("float32", scale_c=1.0), [0x7FC0, 0], None),
        (ReadingFormat("float32", scale_c=1.0), [0, 0], 0.0),
        (ReadingFormat("float32", scale_c=1.0, offset_c=-273.15), [0x4393, 0x5333], 21.5),
    ],
)
def test_scale_offset_and_open_sensors(
    format_: ReadingFormat, registers: list[int], value_c: float | None
) -> None:
    read = format_.temperature_c(registers)
    assert read == (None if value_c is None else pytest.approx(value_c, abs=1e-4))


@pytest.mark.parametrize(
    ("scale_c", "offset_c", "register", "is_one"),
    [
        (1.0, 0.0, 2000, True),
        (1.0, 0.0, 2001, False),
        (1.0, -273.15, 0, True),
        (1.0, -273.16, 0, False),
    ],
)
def test_temperatures_lie_between_absolute_zero_and_2000_degrees(
    scale_c: float, offset_c: float, register: int, is_one: bool
) -> None:
    reading = ReadingFormat("uint16", scale_c=scale_c, offset_c=offset_c)
    if is_one:
        assert reading.temperature_c([register]) == register * scale_c + offset_c
    else:
        with pytest.raises(ImplausibleReadingError):
            reading.temperature_c([register])


@given(st.lists(st.integers(0, 0xFFFF), min_size=2, max_size=2))
def test_any_registers_are_a_temperature_an_open_sensor_or_refused(registers: list[int]) -> None:
    for format_ in (ReadingFormat(), ReadingFormat("float32", "little", 1.0)):
        try:
            value_c = format_.temperature_c(registers[: format_.words])
        except ImplausibleReadingError:
            continue
        assert value_c is None or (math.isfinite(value_c) and -273.15 <= value_c <= 2000)


def test_the_published_example_of_holding_registers_is_read() -> None:
    # Modbus Application Protocol V1.1b3, section 6.3: registers 108 to 110 hold 555, 0 and 100.
    body = bytes.fromhex("11 03 06 02 2b 00 00 00 64")
    found = find_reply(body + struct.pack("<H", crc16(body)), 0x11, 3, READ_HOLDING_REGISTERS)
    assert found is not None
    assert found.registers == (555, 0, 100)


def test_a_reply_to_the_other_function_is_not_taken() -> None:
    assert find_reply(holding_reply(1, [1, 2]), 1, 2) is None
    assert find_reply(holding_reply(1, [1, 2]), 1, 2, READ_HOLDING_REGISTERS) is not None


def test_floats_in_holding_registers_come_out_in_the_order_of_the_channels() -> None:
    clock = FakeClock()
    words = [
        word
        for value in (21.5, -5.25, math.nan)
        for word in ModbusClientMixin.convert_to_registers(value, FLOAT, word_order="little")
    ]
    thermometer = _thermometer(
        clock, _answers(holding_reply(1, words)), register_kind="holding", value_type="float32",
        word_order="little", scale_c=1.0,
    )  # fmt: skip
    assert _samples(_run(thermometer, 5))[:3] == [("0", 21.5), ("1", -5.25), ("G", None)]


def test_channels_and_registers_beyond_the_limits_are_refused() -> None:
    def problems(**more: object) -> list[str]:
        section = {"port": "/dev/probes", "value_type": "float32", **more}
        return registry.problems("thermometer", "modbus-rtu", section)

    names = [str(n) for n in range(63)]
    assert problems(channels=names) == ["channels has 63 names; at most 62 of float32"]
    assert problems(channels=names[:62]) == []
    assert problems(channels=names[:2], first_register=65532) == []
    assert problems(channels=names[:2], first_register=65533) == [
        "first_register is 65533; with 2 channels at most 65532"
    ]

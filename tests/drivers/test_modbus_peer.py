"""The Modbus thermometer against pymodbus' server, over a pair of pseudo-terminals."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator

import pytest
from pymodbus.client.mixin import ModbusClientMixin

from drivers.contract import DeviceError, TemperatureSample
from drivers.thermometers.modbus_rtu.thermometer import ModbusThermometer
from tests.drivers.fakes import RecordingSink
from tests.drivers.pty_line import PtyLine

pymodbus_server = pytest.importorskip("pymodbus.server", reason="needs pymodbus (group dev)")
pymodbus_datastore = pytest.importorskip("pymodbus.datastore", reason="needs pymodbus")
pytestmark = pytest.mark.peer

UNIT = 3
REGISTERS = [215, 65484, 0x7FFF, 301]
"""From register 10: 21.5 degC, -5.2 degC, open, 30.1 degC."""
FLOATS_C = [21.5, -5.25, 30.125]
FLOAT_REGISTERS = [
    register
    for order in ("big", "little")
    for value in FLOATS_C
    for register in ModbusClientMixin.convert_to_registers(
        value, ModbusClientMixin.DATATYPE.FLOAT32, word_order=order
    )
]
"""From holding register 10 with the upper half first, from 16 with the lower half first."""


@pytest.fixture
def line() -> Iterator[PtyLine]:
    """A line with pymodbus' server at its far end."""
    with PtyLine() as line:
        loop = asyncio.new_event_loop()
        listening = threading.Event()
        thread = threading.Thread(target=_serve, args=(loop, line.far, listening))
        thread.start()
        assert listening.wait(10)
        yield line
        asyncio.run_coroutine_threadsafe(pymodbus_server.ServerAsyncStop(), loop).result(10)
        thread.join(10)


def _serve(loop: asyncio.AbstractEventLoop, port: str, listening: threading.Event) -> None:
    async def serve() -> None:
        block = pymodbus_datastore.ModbusSequentialDataBlock(11, REGISTERS)
        floats = pymodbus_datastore.ModbusSequentialDataBlock(11, FLOAT_REGISTERS)
        device = pymodbus_datastore.ModbusDeviceContext(ir=block, hr=floats)
        context = pymodbus_datastore.ModbusServerContext(devices={UNIT: device}, single=False)
        loop.call_later(0.2, listening.set)
        await pymodbus_server.StartAsyncSerialServer(context, port=port, baudrate=19200, parity="N")

    asyncio.set_event_loop(loop)
    loop.run_until_complete(serve())
    loop.close()


def _thermometer(line: PtyLine, **more: object) -> ModbusThermometer:
    section: dict[str, object] = {
        "port": line.near,
        "parity": "N",
        "unit": UNIT,
        "first_register": 10,
        "channels": ["0", "1", "2", "G"],
        "interval_s": 0.1,
        "answer_timeout_s": 0.3,
        "silence_s": 0.6,
        **more,
    }
    return ModbusThermometer("probes", section)


def _run(thermometer: ModbusThermometer, enough: int) -> RecordingSink:
    """Run until that many samples have come, ten seconds at most."""
    recorder = RecordingSink()
    done = threading.Event()

    def stop(_: object) -> None:
        if sum(isinstance(r, TemperatureSample) for r in recorder.records) >= enough:
            done.set()

    recorder.stop = stop
    thread = threading.Thread(target=thermometer.run, args=(recorder,))
    thread.start()
    came = done.wait(10)
    thermometer.close()
    thread.join(5)
    assert came, recorder.events
    return recorder


def test_pymodbus_registers_come_out_as_degrees(line: PtyLine) -> None:
    thermometer = _thermometer(line)
    found = thermometer.bind()
    assert found["probe 0"] == "21.5 degC"
    recorder = _run(thermometer, 8)
    samples = [(r.probe, r.value_c) for r in recorder.records if isinstance(r, TemperatureSample)]
    assert samples[:4] == [("0", 21.5), ("1", -5.2), ("2", None), ("G", 30.1)]
    assert thermometer.statistics()["bad_bytes"] == 0


@pytest.mark.parametrize(("order", "first_register"), [("big", 10), ("little", 16)])
def test_pymodbus_floats_in_holding_registers_come_out_as_degrees(
    line: PtyLine, order: str, first_register: int
) -> None:
    thermometer = _thermometer(
        line, register_kind="holding", value_type="float32", word_order=order, scale_c=1.0,
        first_register=first_register, channels=["0", "1", "G"],
    )  # fmt: skip
    recorder = _run(thermometer, 3)
    samples = [(r.probe, r.value_c) for r in recorder.records if isinstance(r, TemperatureSample)]
    assert samples[:3] == list(zip(["0", "1", "G"], FLOATS_C, strict=True))


def test_registers_that_pymodbus_does_not_have_are_an_exception_2(line: PtyLine) -> None:
    thermometer = _thermometer(line, first_register=100)
    with pytest.raises(DeviceError, match="exception 2"):
        thermometer.bind()
    thermometer.close()


def test_a_unit_that_is_not_on_the_line_is_not_found(line: PtyLine) -> None:
    thermometer = _thermometer(line, unit=9)
    with pytest.raises(DeviceError, match=r"exception|gave no answer"):
        thermometer.bind()
    thermometer.close()


def test_noise_on_the_line_loses_no_reading(line: PtyLine) -> None:
    line.noise_to_near = b"\x03\x04\x00\xff\x03"
    thermometer = _thermometer(line)
    recorder = _run(thermometer, 8)
    assert thermometer.statistics()["bad_bytes"] == 5
    assert thermometer.statistics()["timeouts"] == 0
    assert "checksum" not in recorder.event_names


def test_a_cut_line_is_silent_and_recovers(line: PtyLine) -> None:
    thermometer = _thermometer(line)
    recorder = RecordingSink()
    seen = {name: threading.Event() for name in ("opened", "silent", "recovered")}

    def note(_: object) -> None:
        for name in recorder.event_names:
            if name in seen:
                seen[name].set()

    recorder.stop = note
    thread = threading.Thread(target=thermometer.run, args=(recorder,))
    thread.start()
    try:
        assert seen["opened"].wait(5)
        line.is_cut = True
        assert seen["silent"].wait(5)
        line.is_cut = False
        assert seen["recovered"].wait(10)
    finally:
        thermometer.close()
        thread.join(5)

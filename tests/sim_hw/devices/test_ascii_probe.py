"""The emulated instrument of lines: read by pyserial and Python's own `re`, then by our driver."""

from __future__ import annotations

import re
import threading
from pathlib import Path

import pytest
import serial

from drivers.base import registry
from drivers.contract import TemperatureSample
from drivers.thermometers.ascii_line.thermometer import AsciiLineThermometer
from sim_hw.devices.ascii_probe import AsciiProbe
from sim_hw.devices.network_line import TcpLine
from sim_hw.devices.pseudo_terminal import PseudoTerminal
from sim_hw.receivers.device_kinds import PROBES, probes
from tests.drivers.fakes import RecordingSink

WITHIN_S = 20.0
CHANNELS = [lambda: 21.34, lambda: -5.2, lambda: None, lambda: float("nan")]


def test_pyserial_reads_its_lines_by_their_pattern() -> None:
    probe = AsciiProbe(CHANNELS, ["T1={0} T2={1} T3={2} T4={3}"], interval_s=0.05)
    with serial.Serial(probe.port, timeout=WITHIN_S) as port:
        probe.start()
        try:
            line = port.readline()
        finally:
            probe.close()
    found = re.fullmatch(rb"T1=(\S+) T2=(\S+) T3=(\S+) T4=(\S+)\r\n", line)
    assert found is not None
    assert found.groups() == (b"+21.34", b"-5.20", b"OPEN", b"OPEN")


def test_queried_by_command_it_answers_that_and_nothing_else() -> None:
    probe = AsciiProbe(
        CHANNELS[:2], ["CH1: {0}", "CH2: {1}"], command="READ?", value_format="{:.1f}", end="\r"
    )
    with serial.Serial(probe.port, timeout=WITHIN_S) as port:
        probe.start()
        try:
            port.write(b"WHO?\r\nREAD")
            port.write(b"?\r")
            received = port.read_until(b"CH2: -5.2\r")
            port.timeout = 0.2
            assert port.read(1) == b""
        finally:
            probe.close()
    assert received == b"CH1: 21.3\rCH2: -5.2\r"
    assert (probe.counts["commands"], probe.counts["unknown_commands"]) == (1, 1)


@pytest.mark.parametrize(("command", "network"), [("", False), ("R", False), ("", True)])
def test_the_driver_reads_what_the_instrument_measures(command: str, network: bool) -> None:
    probe = AsciiProbe(
        CHANNELS[:3],
        ["T1={0} T2={1} T3={2}"],
        interval_s=0.1,
        command=command,
        line=TcpLine() if network else PseudoTerminal(),
    )
    thermometer = AsciiLineThermometer("probes", {
        "port": probe.port, "pattern": r"^T1=(?P<a>\S+) T2=(?P<b>\S+) T3=(?P<c>\S+)$",
        "channels": ["0", "1", "G"], "command": command, "interval_s": 0.1,
    })  # fmt: skip
    notebook, enough = RecordingSink(), threading.Event()

    def watch(_: object) -> None:
        if sum(isinstance(r, TemperatureSample) for r in notebook.records) >= 9:
            enough.set()

    notebook.stop = watch
    probe.start()
    thread = threading.Thread(target=thermometer.run, args=(notebook,))
    thread.start()
    try:
        assert enough.wait(WITHIN_S)
    finally:
        thermometer.close()
        thread.join(5)
        probe.close()
    found = [(r.probe, r.value_c) for r in notebook.records if isinstance(r, TemperatureSample)]
    assert found[:6] == [("0", 21.34), ("1", -5.2), ("G", None)] * 2
    assert thermometer.statistics()["bad_messages"] == 0


@pytest.mark.parametrize("kind", PROBES)
def test_the_settings_that_are_reported_fit_the_device(kind: str, tmp_path: Path) -> None:
    names = {str(n): (lambda n=n: 20.0 + n) for n in range(8)}
    emulated = probes(kind, names, tmp_path / "probes")
    driver = {"modbus": "modbus-rtu", "ascii": "ascii-line"}[kind]
    settings = {**emulated.settings, "parity": "N"}
    assert registry.problems("thermometer", driver, settings) == []
    emulated.device.start()
    device = registry.driver_for("thermometer", driver)("probes", settings)
    try:
        found = device.bind()
        assert "27" in str(found)
    finally:
        device.close()
        emulated.device.close()

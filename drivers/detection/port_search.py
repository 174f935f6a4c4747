"""Search for the port and baud rate of a device: ports are opened with one setting after another.

Messages are recognized in `drivers.detection.protocol_detection`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from serial.tools import list_ports

from drivers.contract import DeviceError
from drivers.detection.protocol_detection import DetectedDevice, ProtocolDetector
from drivers.thermometers.modbus_rtu.frames import (
    ILLEGAL_FUNCTION,
    READ_HOLDING_REGISTERS,
    READ_INPUT_REGISTERS,
    Reply,
    find_reply,
    read_request,
)
from drivers.timescales.clock import Clock, MonotonicClock
from drivers.transport.serial_device import LineLostError, PortOpener, SerialLine, open_serial_port

BAUDRATES: Final = (
    115_200, 9_600, 38_400, 57_600, 230_400, 460_800, 921_600, 19_200, 4_800,
)  # fmt: skip
"""In order of probability: factory settings of receivers, then usual higher rates."""
MODBUS_LINES: Final = tuple(
    (baudrate, parity) for baudrate in (19_200, 9_600, 38_400, 115_200, 57_600) for parity in "EN"
)
MODBUS_UNITS: Final = (1, 2, 3, 4)
MODBUS_ANSWER_S: Final = 0.15
SILENCE_S: Final = 2.2
"""Receivers and instruments that send unrequested do so once a second; one message may be lost."""
UNDECODED_TIMEOUT_S: Final = 0.4
UNDECODED_NBYTES: Final = 300
"""That many bytes without a message mean a wrong baud rate."""
LISTEN_S: Final = 3.2
"""Listening time after a first message; the identifying message is sent once a second."""
UNDECODED_LIMIT_S: Final = 1.4
"""After that time without a message, the baud rate is wrong for any number of bytes."""
CYCLE_COMPLETE_S: Final = 1.5
"""By then, every message that is sent once a second has been received."""
STEP_S: Final = 0.1
SEARCH_TIMEOUT_S: Final = 120.0
"""Two passes over all baud rates take 80 s. The limit ends the wait for a hung kernel driver."""
DEFAULT_ADDRESSES: Final = ("udpin://0.0.0.0:14550", "tcp://127.0.0.1:2947")
"""Usual addresses of autopilots and of gpsd."""
BY_ID: Final = Path("/dev/serial/by-id")

ProgressCallback = Callable[[str, str], None]


@dataclass(frozen=True)
class DetectionResult:
    """The device at a port and its line settings, or None and a sentence with the reason."""

    port: str
    detected: DetectedDevice | None
    baudrate: int | None = None
    parity: str = "N"
    sentence: str = ""


def default_ports() -> list[str]:
    """The ports that are searched if none are named.

    Returns:
        Every serial port of the host, by its persistent name if it has one, then the usual
        network addresses.
    """
    by_id = {}
    if BY_ID.is_dir():
        by_id = {str(link.resolve()): str(link) for link in sorted(BY_ID.iterdir())}
    ports = [by_id.get(port.device, port.device) for port in list_ports.comports()]
    return [*ports, *DEFAULT_ADDRESSES]


def search(
    ports: Iterable[str],
    *,
    ask: bool = True,
    on_progress: ProgressCallback = lambda port, sentence: None,
    baudrates: Sequence[int] = BAUDRATES,
    clock: Clock | None = None,
    open_port: PortOpener = open_serial_port,
    timeout_s: float = SEARCH_TIMEOUT_S,
) -> list[DetectionResult]:
    """The device at every port; all ports are searched in parallel.

    Args:
        ports: serial ports and network addresses.
        ask: whether Modbus registers are requested at a serial port that receives nothing.
        on_progress: receives the port and the present step; called from several threads.
        baudrates: bit/s, in the order of the search.
        clock: of the listening times.
        open_port: opens a port with a baud rate and a parity.
        timeout_s: after it, a port that is still being searched is reported as not answering.

    Returns:
        One result for each port, in the order of `ports`, without repeated ports.
    """
    names = list(dict.fromkeys(ports))
    found: dict[str, DetectionResult] = {}

    def search_port(port: str) -> None:
        searcher = _Search(port, on_progress, clock or MonotonicClock(), open_port)
        found[port] = searcher.run(baudrates, ask=ask)

    threads = [threading.Thread(target=search_port, args=(port,), daemon=True) for port in names]
    for thread in threads:
        thread.start()
    deadline = time.monotonic() + timeout_s
    for thread in threads:
        thread.join(max(0.0, deadline - time.monotonic()))
    stuck = f"did not answer within {timeout_s:g} s; unplug it, plug it in and try again"
    return [found.get(port, DetectionResult(port, None, sentence=stuck)) for port in names]


class _Search:
    def __init__(
        self, port: str, on_progress: ProgressCallback, clock: Clock, open_port: PortOpener
    ) -> None:
        self._port = port
        self._on_progress = on_progress
        self._clock = clock
        self._open_port = open_port
        self._never = threading.Event()

    def run(self, baudrates: Sequence[int], *, ask: bool) -> DetectionResult:
        is_network = "://" in self._port
        received_data = False
        try:
            # A second pass for devices that sent too little in the first one.
            for number, baudrate in enumerate(baudrates[:1] if is_network else (*baudrates,) * 2):
                self._on_progress(
                    self._port, "listening" + ("" if is_network else f" at {baudrate}")
                )
                # A device that was received at another baud rate is received at this one, too.
                silence_s = 2 * SILENCE_S if received_data else SILENCE_S
                detector = self._listen(baudrate, silence_s)
                detected = detector.detected()
                if detected is not None:
                    return DetectionResult(self._port, detected, None if is_network else baudrate)
                received_data = received_data or detector.nbytes > 0
                if number >= 1 and not received_data:
                    # A wrong baud rate also receives bytes, but no messages.
                    break
            if ask and not is_network and not received_data:
                modbus_result = self._ask()
                if modbus_result is not None:
                    return modbus_result
        except DeviceError as error:
            return DetectionResult(
                self._port, None, sentence=str(error).removeprefix(f"port {self._port} ")
            )
        except LineLostError as error:
            return DetectionResult(
                self._port, None, sentence=f"was lost meanwhile ({error}); check the cable"
            )
        if received_data:
            return DetectionResult(
                self._port,
                None,
                sentence="data received, but no known message at any usual baud rate; check the "
                "wiring and the output settings of the device",
            )
        where = "address" if is_network else "port"
        return DetectionResult(
            self._port,
            None,
            sentence=f"no data received; check power, cable and the {where}'s name",
        )

    def _listen(self, baudrate: int, silence_s: float) -> ProtocolDetector:
        detector = ProtocolDetector()
        line = SerialLine(self._open_port(self._port, baudrate, "N"), lambda _: None)
        begun_ns = self._clock.mono_ns()
        try:
            if "://" not in self._port:
                # Bytes in the buffer were received at the previous baud rate.
                line.read(0.0)
            while True:
                # Reading comes first: on a busy host the time may be over before the first byte.
                detector.feed(line.read(STEP_S), self._clock.mono_ns())
                elapsed_s = (self._clock.mono_ns() - begun_ns) * 1e-9
                if elapsed_s > LISTEN_S or detector.is_certain(
                    has_listened_long_enough=elapsed_s > CYCLE_COMPLETE_S
                ):
                    return detector
                if not detector.nbytes and elapsed_s > silence_s:
                    return detector
                if detector.nbytes and not detector.has_messages:
                    has_enough = (
                        detector.nbytes > UNDECODED_NBYTES and elapsed_s > UNDECODED_TIMEOUT_S
                    )
                    if has_enough or elapsed_s > UNDECODED_LIMIT_S:
                        return detector
        finally:
            line.close()

    def _ask(self) -> DetectionResult | None:
        """Request one register of the usual Modbus units; they send nothing unrequested."""
        for baudrate, parity in MODBUS_LINES:
            try:
                port = self._open_port(self._port, baudrate, parity)
            except DeviceError:
                # A port without parity, such as a pseudo-terminal.
                continue
            self._on_progress(self._port, f"requesting Modbus registers at {baudrate} {parity}")
            line = SerialLine(port, lambda _: None)
            try:
                for unit in MODBUS_UNITS:
                    kind = self._register_kind(line, unit)
                    if kind is not None:
                        settings = {
                            "unit": unit,
                            "register_kind": kind,
                            "first_register": 0,
                            "channels": ["0"],
                        }
                        detected = DetectedDevice(
                            "thermometer",
                            "modbus-rtu",
                            "Modbus RTU",
                            f"an answer of unit {unit}",
                            "the names of the probes, in the order of the registers",
                            settings,
                        )
                        return DetectionResult(self._port, detected, baudrate, parity)
            except LineLostError:
                # Quirk: pseudo-terminals refuse parity late, with the first read.
                # Upstream: pyserial/pyserial#196.
                continue
            finally:
                line.close()
        return None

    def _register_kind(self, line: SerialLine, unit: int) -> str | None:
        """The kind of registers that a Modbus unit has; None if it does not answer."""
        reply = self._modbus_reply(line, unit, READ_INPUT_REGISTERS)
        if reply is None:
            return None
        if reply.exception != ILLEGAL_FUNCTION:
            return "input"
        holding = self._modbus_reply(line, unit, READ_HOLDING_REGISTERS)
        return "input" if holding is None or holding.exception == ILLEGAL_FUNCTION else "holding"

    def _modbus_reply(self, line: SerialLine, unit: int, function: int) -> Reply | None:
        line.write(read_request(unit, 0, 1, function))
        received = b""
        deadline_ns = self._clock.mono_ns() + round(MODBUS_ANSWER_S * 1e9)
        while (left_ns := deadline_ns - self._clock.mono_ns()) > 0:
            received += line.read(left_ns * 1e-9)
            reply = find_reply(received, unit, 1, function)
            if reply is not None:
                return reply
        return None

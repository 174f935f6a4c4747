"""Which port and which speed: opening ports one way after another until something makes sense.

What makes sense is decided in `drivers.detection.protocol_detection`.
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
from drivers.thermometers.modbus_rtu.frames import find_reply, read_request
from drivers.timescales.clock import Clock, MonotonicClock
from drivers.transport.serial_device import LineLostError, PortOpener, SerialLine, open_serial_port

BAUDRATES: Final = (
    115_200, 9_600, 38_400, 57_600, 230_400, 460_800, 921_600, 19_200, 4_800,
)  # fmt: skip
"""From the likeliest: factory settings of receivers, then what crews raise them to."""
MODBUS_LINES: Final = tuple(
    (baudrate, parity) for baudrate in (19_200, 9_600, 38_400, 115_200, 57_600) for parity in "EN"
)
MODBUS_UNITS: Final = (1, 2, 3, 4)
MODBUS_ANSWER_S: Final = 0.15
SILENCE_S: Final = 2.2
"""Receivers and instruments that speak by themselves do so once a second; one may be missed."""
UNDECODED_TIMEOUT_S: Final = 0.4
UNDECODED_NBYTES: Final = 300
"""So much that makes no sense is the wrong speed."""
LISTEN_S: Final = 3.2
"""For whom something made sense: the message that tells who it is comes once a second."""
UNDECODED_LIMIT_S: Final = 1.4
"""Likewise whatever has come by then."""
CYCLE_COMPLETE_S: Final = 1.5
"""By then a receiver has said everything it says once a second."""
STEP_S: Final = 0.1
SEARCH_TIMEOUT_S: Final = 120.0
"""Twice through all speeds takes 80 s; a driver of the kernel that hangs is not waited for."""
DEFAULT_ADDRESSES: Final = ("udpin://0.0.0.0:14550", "tcp://127.0.0.1:2947")
"""Where autopilots send to, and where gpsd serves."""
BY_ID: Final = Path("/dev/serial/by-id")

ProgressCallback = Callable[[str, str], None]


@dataclass(frozen=True)
class DetectionResult:
    """What is at a port: a speaker and how it is reached, or None and a sentence about it."""

    port: str
    detected: DetectedDevice | None
    baudrate: int | None = None
    parity: str = "N"
    sentence: str = ""


def default_ports() -> list[str]:
    """Every serial port of the host by its lasting name where it has one, and usual addresses."""
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
) -> list[DetectionResult]:
    """What speaks at every port, all of them at once; `tell` hears what is being tried.

    With `ask`, a serial port where nothing speaks by itself is asked for Modbus registers.
    """
    names = list(dict.fromkeys(ports))
    found: dict[str, DetectionResult] = {}

    def look(port: str) -> None:
        searcher = _Search(port, on_progress, clock or MonotonicClock(), open_port)
        found[port] = searcher.run(baudrates, ask=ask)

    threads = [threading.Thread(target=look, args=(port,), daemon=True) for port in names]
    for thread in threads:
        thread.start()
    deadline = time.monotonic() + SEARCH_TIMEOUT_S
    for thread in threads:
        thread.join(max(0.0, deadline - time.monotonic()))
    stuck = f"did not answer within {SEARCH_TIMEOUT_S:g} s; unplug it, plug it in and try again"
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
            # A second time for those of whom too little came the first time.
            for number, baudrate in enumerate(baudrates[:1] if is_network else (*baudrates,) * 2):
                self._on_progress(
                    self._port, "listening" + ("" if is_network else f" at {baudrate}")
                )
                # Who has been heard at another speed will be heard at this one.
                silence_s = 2 * SILENCE_S if received_data else SILENCE_S
                detector = self._listen(baudrate, silence_s)
                detected = detector.detected()
                if detected is not None:
                    return DetectionResult(self._port, detected, None if is_network else baudrate)
                received_data = received_data or detector.nbytes > 0
                if number >= 1 and not received_data:
                    # Also at a wrong speed a speaker is heard, only not understood.
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
                sentence="speaks, but nothing known at any usual speed; check the wiring and what "
                "the device is set to send",
            )
        where = "address" if is_network else "port"
        return DetectionResult(
            self._port,
            None,
            sentence=f"nothing speaks there; check power, cable and the {where}'s name",
        )

    def _listen(self, baudrate: int, silence_s: float) -> ProtocolDetector:
        detector = ProtocolDetector()
        line = SerialLine(self._open_port(self._port, baudrate, "N"), lambda _: None)
        begun_ns = self._clock.mono_ns()
        try:
            if "://" not in self._port:
                # What still lies there was heard at the speed before.
                line.read(0.0)
            while True:
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
                detector.feed(line.read(STEP_S), self._clock.mono_ns())
        finally:
            line.close()

    def _ask(self) -> DetectionResult | None:
        """Modbus slaves say nothing by themselves: read one register of the usual ones."""
        for baudrate, parity in MODBUS_LINES:
            try:
                port = self._open_port(self._port, baudrate, parity)
            except DeviceError:
                # A port that cannot do parity, such as a pseudo-terminal.
                continue
            self._on_progress(self._port, f"asking for Modbus at {baudrate} {parity}")
            line = SerialLine(port, lambda _: None)
            try:
                for unit in MODBUS_UNITS:
                    if self._modbus_unit_answers(line, unit):
                        settings = {"unit": unit, "first_register": 0, "channels": ["0"]}
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
                # Pseudo-terminals refuse parity late, with the first read.
                continue
            finally:
                line.close()
        return None

    def _modbus_unit_answers(self, line: SerialLine, unit: int) -> bool:
        line.write(read_request(unit, 0, 1))
        received = b""
        deadline_ns = self._clock.mono_ns() + round(MODBUS_ANSWER_S * 1e9)
        while (left_ns := deadline_ns - self._clock.mono_ns()) > 0:
            received += line.read(left_ns * 1e-9)
            if find_reply(received, unit, 1) is not None:
                return True
        return False

"""Which port and which speed: opening ports one way after another until something makes sense.

What makes sense is decided in `drivers.detection.evidence`.
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
from drivers.detection.evidence import Evidence, Speaker
from drivers.thermometers.modbus_rtu.frames import find_reply, read_request
from drivers.timescales.clock import Clock, HostClock
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
NONSENSE_S: Final = 0.4
NONSENSE_NBYTES: Final = 300
"""So much that makes no sense is the wrong speed."""
LISTEN_S: Final = 3.2
"""For whom something made sense: the message that tells who it is comes once a second."""
NONSENSE_AT_LAST_S: Final = 1.4
"""Likewise whatever has come by then."""
SETTLED_S: Final = 1.5
"""By then a receiver has said everything it says once a second."""
STEP_S: Final = 0.1
WITHIN_S: Final = 120.0
"""Twice through all speeds takes 80 s; a driver of the kernel that hangs is not waited for."""
USUAL_ADDRESSES: Final = ("udpin://0.0.0.0:14550", "tcp://127.0.0.1:2947")
"""Where autopilots send to, and where gpsd serves."""
BY_ID: Final = Path("/dev/serial/by-id")

Told = Callable[[str, str], None]


@dataclass(frozen=True)
class Found:
    """What is at a port: a speaker and how it is reached, or None and a sentence about it."""

    port: str
    speaker: Speaker | None
    baudrate: int | None = None
    parity: str = "N"
    sentence: str = ""


def usual_ports() -> list[str]:
    """Every serial port of the host by its lasting name where it has one, and usual addresses."""
    lasting = {}
    if BY_ID.is_dir():
        lasting = {str(link.resolve()): str(link) for link in sorted(BY_ID.iterdir())}
    ports = [lasting.get(port.device, port.device) for port in list_ports.comports()]
    return [*ports, *USUAL_ADDRESSES]


def search(
    ports: Iterable[str],
    *,
    ask: bool = True,
    tell: Told = lambda port, sentence: None,
    baudrates: Sequence[int] = BAUDRATES,
    clock: Clock | None = None,
    open_port: PortOpener = open_serial_port,
) -> list[Found]:
    """What speaks at every port, all of them at once; `tell` hears what is being tried.

    With `ask`, a serial port where nothing speaks by itself is asked for Modbus registers.
    """
    names = list(dict.fromkeys(ports))
    found: dict[str, Found] = {}

    def look(port: str) -> None:
        searcher = _Search(port, tell, clock or HostClock(), open_port)
        found[port] = searcher.run(baudrates, ask=ask)

    threads = [threading.Thread(target=look, args=(port,), daemon=True) for port in names]
    for thread in threads:
        thread.start()
    deadline = time.monotonic() + WITHIN_S
    for thread in threads:
        thread.join(max(0.0, deadline - time.monotonic()))
    stuck = f"did not answer within {WITHIN_S:g} s; unplug it, plug it in and try again"
    return [found.get(port, Found(port, None, sentence=stuck)) for port in names]


class _Search:
    def __init__(self, port: str, tell: Told, clock: Clock, open_port: PortOpener) -> None:
        self._port = port
        self._tell = tell
        self._clock = clock
        self._open_port = open_port
        self._never = threading.Event()

    def run(self, baudrates: Sequence[int], *, ask: bool) -> Found:
        is_network = "://" in self._port
        heard_something = False
        try:
            # A second time for those of whom too little came the first time.
            for number, baudrate in enumerate(baudrates[:1] if is_network else (*baudrates,) * 2):
                self._tell(self._port, "listening" + ("" if is_network else f" at {baudrate}"))
                # Who has been heard at another speed will be heard at this one.
                silence_s = 2 * SILENCE_S if heard_something else SILENCE_S
                evidence = self._listen(baudrate, silence_s)
                speaker = evidence.speaker()
                if speaker is not None:
                    return Found(self._port, speaker, None if is_network else baudrate)
                heard_something = heard_something or evidence.nbytes > 0
                if number >= 1 and not heard_something:
                    # Also at a wrong speed a speaker is heard, only not understood.
                    break
            if ask and not is_network and not heard_something:
                asked = self._ask()
                if asked is not None:
                    return asked
        except DeviceError as error:
            return Found(self._port, None, sentence=str(error).removeprefix(f"port {self._port} "))
        except LineLostError as error:
            return Found(
                self._port, None, sentence=f"was lost meanwhile ({error}); check the cable"
            )
        if heard_something:
            return Found(
                self._port,
                None,
                sentence="speaks, but nothing known at any usual speed; check the wiring and what "
                "the device is set to send",
            )
        where = "address" if is_network else "port"
        return Found(
            self._port,
            None,
            sentence=f"nothing speaks there; check power, cable and the {where}'s name",
        )

    def _listen(self, baudrate: int, silence_s: float) -> Evidence:
        evidence = Evidence()
        line = SerialLine(self._open_port(self._port, baudrate, "N"), lambda _: None)
        begun_ns = self._clock.mono_ns()
        try:
            if "://" not in self._port:
                # What still lies there was heard at the speed before.
                line.read(0.0)
            while True:
                elapsed_s = (self._clock.mono_ns() - begun_ns) * 1e-9
                if elapsed_s > LISTEN_S or evidence.is_certain(has_settled=elapsed_s > SETTLED_S):
                    return evidence
                if not evidence.nbytes and elapsed_s > silence_s:
                    return evidence
                if evidence.nbytes and not evidence.has_messages:
                    has_enough = evidence.nbytes > NONSENSE_NBYTES and elapsed_s > NONSENSE_S
                    if has_enough or elapsed_s > NONSENSE_AT_LAST_S:
                        return evidence
                evidence.feed(line.read(STEP_S), self._clock.mono_ns())
        finally:
            line.close()

    def _ask(self) -> Found | None:
        """Modbus slaves say nothing by themselves: read one register of the usual ones."""
        for baudrate, parity in MODBUS_LINES:
            try:
                port = self._open_port(self._port, baudrate, parity)
            except DeviceError:
                # A port that cannot do parity, such as a pseudo-terminal.
                continue
            self._tell(self._port, f"asking for Modbus at {baudrate} {parity}")
            line = SerialLine(port, lambda _: None)
            try:
                for unit in MODBUS_UNITS:
                    if self._answers(line, unit):
                        settings = {"unit": unit, "first_register": 0, "channels": ["0"]}
                        speaker = Speaker(
                            "thermometer",
                            "modbus-rtu",
                            "Modbus RTU",
                            f"an answer of unit {unit}",
                            "the names of the probes, in the order of the registers",
                            settings,
                        )
                        return Found(self._port, speaker, baudrate, parity)
            except LineLostError:
                # Pseudo-terminals refuse parity late, with the first read.
                continue
            finally:
                line.close()
        return None

    def _answers(self, line: SerialLine, unit: int) -> bool:
        line.write(read_request(unit, 0, 1))
        received = b""
        deadline_ns = self._clock.mono_ns() + round(MODBUS_ANSWER_S * 1e9)
        while (left_ns := deadline_ns - self._clock.mono_ns()) > 0:
            received += line.read(left_ns * 1e-9)
            if find_reply(received, unit, 1) is not None:
                return True
        return False

"""Every parser with genuine messages to spoil, and the ways to spoil them."""

from __future__ import annotations

import random
import socket
import struct
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

from drivers.cameras.aravis import gvcp
from drivers.contract import DeviceError
from drivers.receivers.applanix.decoder import ApplanixDecoder
from drivers.receivers.gpsd.reports import GpsdReports
from drivers.receivers.gsof.decoder import GsofDecoder
from drivers.receivers.message_decoder import MessageDecoder
from drivers.receivers.nmea.decoder import NmeaDecoder
from drivers.receivers.novatel.decoder import NovatelDecoder
from drivers.receivers.sbg.decoder import SbgDecoder
from drivers.receivers.septentrio.decoder import SbfDecoder
from drivers.receivers.ublox.decoder import UbxDecoder
from drivers.receivers.vectornav.decoder import VectornavDecoder
from drivers.receivers.xsens.decoder import XsensDecoder
from drivers.thermometers.ascii_line.thermometer import AsciiLineThermometer
from drivers.thermometers.modbus_rtu.frames import find_reply
from drivers.triggers.pulse_bus import PulseBusTrigger
from sim_hw.gige.control import ControlChannel, HeadActions
from sim_hw.gige.registers import FrameSize, HeadIdentity, RegisterMemory
from sim_hw.receivers.emulated_receiver import EmulatedReceiver, ReceiverState
from sim_hw.receivers.mavlink_autopilot import MavlinkAutopilot
from sim_hw.receivers.nmea_receiver import NmeaReceiver
from sim_hw.receivers.novatel_receiver import NovatelReceiver
from sim_hw.receivers.sbg_receiver import SbgReceiver
from sim_hw.receivers.septentrio_receiver import SeptentrioReceiver
from sim_hw.receivers.ublox_receiver import UbloxReceiver
from sim_hw.receivers.vectornav_receiver import VectornavReceiver
from sim_hw.world.world_clock import WorldClock
from tests.drivers.fakes import FakeClock
from tests.robustness.faults.resealed_messages import (
    reseal_applanix,
    reseal_gsof,
    reseal_mavlink,
    reseal_modbus,
    reseal_nmea,
    reseal_novatel,
    reseal_sbf,
    reseal_sbg,
    reseal_ubx,
    reseal_vectornav,
    reseal_xsens,
)

GPS_NS = 1_447_400_000_000_000_000
STATE = ReceiverState(48.1, 11.5, 3395.0, (60.0, 3.0, 0.1), 1.0, -2.0, 33.0)
DATA = Path(__file__).parents[2] / "drivers" / "data"

Feed = Callable[[bytes], object]
Reseal = Callable[[bytearray], bytes]


@dataclass
class Parser:
    """A parser that listens: fed with bytes, asked what it has understood and what it keeps.

    `share` is its part of all mutated messages; `answers_only` means one that looks at a message
    at a time and has nothing to resynchronise.
    """

    name: str
    genuine: tuple[bytes, ...]
    feed: Feed
    understood: Callable[[], int]
    state: tuple[object, ...]
    share: float
    reseal: Reseal | None = None
    retained_limit: int = 70_000
    answers_only: bool = False


@dataclass
class Mutator:
    """Spoils messages: bits, lengths, ends, middles; some with a right checksum again."""

    genuine: tuple[bytes, ...]
    reseal: Reseal | None
    rng: random.Random
    produced: int = field(default=0)

    def messages(self, count: int) -> Iterator[bytes]:
        """So many spoilt messages."""
        rng, genuine = self.rng, self.genuine
        for _ in range(count):
            self.produced += 1
            kind = int(rng.random() * 10)
            message = bytearray(genuine[int(rng.random() * len(genuine))])
            at = int(rng.random() * len(message))
            if kind <= 2:
                message[at] ^= 1 << int(rng.random() * 8)
            elif kind == 3:
                message[at] = int(rng.random() * 256)
                message[int(rng.random() * len(message))] = int(rng.random() * 256)
            elif kind == 4:
                del message[at:]
            elif kind == 5:
                del message[at : at + 1 + int(rng.random() * 8)]
            elif kind == 6:
                message[at:at] = rng.randbytes(1 + int(rng.random() * 8))
            elif kind == 7:
                other = genuine[int(rng.random() * len(genuine))]
                message[at:] = other[int(rng.random() * len(other)) :]
            elif kind == 8:
                message = bytearray(rng.randbytes(1 + int(rng.random() * 40)))
            elif self.reseal is not None:
                # Wrong content that is rightly sealed: the worst there is.
                for _ in range(1 + int(rng.random() * 4)):
                    message[int(rng.random() * len(message))] = int(rng.random() * 256)
                yield self.reseal(message)
                continue
            yield bytes(message)


# Seals


# Parsers


def _stream(produced: EmulatedReceiver) -> bytes:
    """Some epochs with marks."""
    data = b""
    for epoch in range(12):
        gps_ns = GPS_NS + epoch * 200_000_000
        produced.mark(gps_ns - 70_000_000)
        if produced.sends_events_immediately:
            data += b"".join(produced.event_bytes(edge) for edge in produced.take_edges(gps_ns))
        data += produced.epoch_bytes(gps_ns)
    produced.close()
    return data


def _receiver(
    name: str,
    produced: type[EmulatedReceiver],
    decoder: MessageDecoder,
    reseal: Reseal,
    share: float,
    **more: Any,
) -> Parser:
    stream = _stream(produced(WorldClock(GPS_NS, 0), lambda _: STATE, **more))
    return _decoding(name, stream, decoder, reseal, share)


def _decoding(
    name: str, stream: bytes, decoder: MessageDecoder, reseal: Reseal, share: float
) -> Parser:
    genuine = tuple(decoder._framer.feed(stream))
    decoder.reset()
    return Parser(
        name,
        genuine,
        lambda data: decoder.feed(data, 0),
        lambda: decoder.frames,
        (decoder,),
        share,
        reseal,
    )


def ublox() -> Parser:
    return _receiver("ublox", UbloxReceiver, UbxDecoder("r"), reseal_ubx, 0.1, chatter=False)


def nmea() -> Parser:
    parser = _receiver("nmea", NmeaReceiver, NmeaDecoder("r"), reseal_nmea, 0.1)
    recorded = (DATA / "ublox-zed-f9r-excerpt.nmea").read_bytes().splitlines(keepends=True)
    event = b"$PTNL,EVT,165402.123456,1,460,2133,5,18*7D\r\n"
    extra = tuple(line for line in recorded if line.startswith(b"$"))
    parser.genuine += (*extra, reseal_nmea(bytearray(event)))
    return parser


def novatel() -> Parser:
    parser = _receiver("novatel", NovatelReceiver, NovatelDecoder("r"), reseal_novatel, 0.1)
    text = NovatelDecoder("text")
    recorded = (DATA / "novatel-ins2-excerpt.gps").read_bytes()
    parser.genuine += tuple(text._framer.feed(recorded))
    return parser


def septentrio() -> Parser:
    return _receiver("septentrio", SeptentrioReceiver, SbfDecoder("r"), reseal_sbf, 0.1)


def sbg() -> Parser:
    return _receiver("sbg", SbgReceiver, SbgDecoder("r"), reseal_sbg, 0.05)


def vectornav() -> Parser:
    return _receiver("vectornav", VectornavReceiver, VectornavDecoder("r"), reseal_vectornav, 0.05)


def xsens() -> Parser:
    from tests.drivers import test_xsens as mtdata2

    marked = mtdata2.message(
        mtdata2.utc(),
        mtdata2.fine(),
        mtdata2.trigger(mtdata2.FINE),
        mtdata2.status(),
        mtdata2.place(),
    )
    stream = mtdata2.GNSS + mtdata2.POSITION + marked
    return _decoding("xsens", stream, XsensDecoder("r"), reseal_xsens, 0.05)


def applanix() -> Parser:
    from tests.drivers import test_applanix as pos

    stream = pos.BEGUN + pos.performance() + pos.nav() + pos.event(1) + pos.event(2)
    return _decoding("applanix", stream, ApplanixDecoder("r"), reseal_applanix, 0.05)


def gsof() -> Parser:
    from tests.drivers import test_gsof as trimble

    stream = trimble.packets(trimble.EPOCH) + trimble.packets(trimble.INS + trimble.event(1), 2)
    return _decoding("gsof", stream, GsofDecoder("r"), reseal_gsof, 0.05)


def mavlink() -> Parser:
    from drivers.receivers.mavlink.decoder import MavlinkDecoder

    autopilot = MavlinkAutopilot(WorldClock(GPS_NS, 0), lambda _: STATE)
    stream = b""
    for tenth in range(1, 15):
        autopilot.mark(GPS_NS + tenth * 100_000_000)
        stream += autopilot.messages_until(tenth * 100_000_000)
    autopilot.close()
    return _decoding("mavlink", stream, MavlinkDecoder("r"), reseal_mavlink, 0.1)


def gpsd() -> Parser:
    reports = GpsdReports("r", "")
    genuine = (
        b'{"class":"VERSION","release":"3.25","rev":"3.25","proto_major":3,"proto_minor":15}\n',
        b'{"class":"DEVICES","devices":[{"class":"DEVICE","path":"/dev/ttyUSB0"}]}\n',
        b'{"class":"TPV","device":"/dev/ttyUSB0","mode":3,"time":"2026-11-21T10:00:00.200Z",'
        b'"leapseconds":18,"lat":48.1,"lon":11.5,"altHAE":560.2,"track":33.1,"speed":60.2,'
        b'"climb":0.1,"eph":0.9,"epv":1.3,"eps":0.1,"velN":50.1,"velE":33.2,"velD":-0.1}\n',
        b'{"class":"SKY","device":"/dev/ttyUSB0","uSat":14,"nSat":20}\n',
        b'{"class":"ATT","device":"/dev/ttyUSB0","roll":1.5,"pitch":-2.5,"heading":33.0}\n',
        b'{"class":"ERROR","message":"no"}\n',
    )
    return Parser(
        "gpsd",
        genuine,
        lambda data: reports.feed(data, 0),
        lambda: sum(reports.seen.values()),
        (reports,),
        0.1,
    )


def ascii_line() -> Parser:
    clock = FakeClock()
    inbox: deque[bytes] = deque()
    thermometer = AsciiLineThermometer(
        "t",
        {
            "port": "none",
            "channels": ["a", "b"],
            "pattern": r"(?P<channel>CH\d+)\s*=\s*(?P<value>\S+)",
            "channel_labels": ["CH1", "CH2"],
        },
        clock=clock,
    )
    thermometer.connected()
    line = _Inbox(inbox)

    def feed(data: bytes) -> None:
        inbox.append(data)
        for _ in thermometer.step(line):
            pass

    return Parser(
        "ascii-line",
        (b"CH1 = 21.5\r\n", b"CH2 =-4.25\r\n", b"CH1 = OPEN\r\n", b"CH3 = 20\r\n"),
        feed,
        lambda: thermometer.counters["lines"],
        (thermometer,),
        0.1,
    )


@dataclass
class _Inbox:
    """A line that has what was put into it."""

    inbox: deque[bytes]

    def read(self, timeout_s: float) -> bytes:
        return self.inbox.popleft() if self.inbox else b""


def modbus() -> Parser:
    understood = 0

    def feed(data: bytes) -> None:
        nonlocal understood
        understood += find_reply(data, 1, 4) is not None

    return Parser(
        "modbus",
        (
            *(
                reseal_modbus(bytearray(struct.pack(">BBB4HH", 1, 4, 8, a, 0x7FFF, 65484, 0, 0)))
                for a in range(200, 216)
            ),
            reseal_modbus(bytearray(b"\x01\x84\x02\0\0")),
        ),
        feed,
        lambda: understood,
        (),
        0.05,
        reseal_modbus,
        answers_only=True,
    )


class _Unit:
    """A trigger unit that answers what it was given to say."""

    def __init__(self) -> None:
        self.replies: deque[bytes] = deque()

    def settimeout(self, value: float, /) -> None:
        pass

    def sendall(self, data: bytes, /) -> None:
        pass

    def recv(self, size: int, /) -> bytes:
        return self.replies.popleft() if self.replies else b""

    def shutdown(self, how: int, /) -> None:
        pass

    def close(self) -> None:
        self.replies.clear()


def pulse_bus() -> Parser:
    unit = _Unit()
    greeting = b"PULSEBUS 1 sim 0 1 G\n"

    def connect(_host: str, _port: int, _timeout_s: float) -> _Unit:
        unit.replies.appendleft(greeting)
        return unit

    trigger = PulseBusTrigger("t", {"port": 1}, clock=FakeClock(), connect=connect)
    fired = 0
    sequence = 0

    def feed(data: bytes) -> None:
        nonlocal fired, sequence
        sequence = 7 if sequence != 7 else 8
        unit.replies.append(data.replace(b"FIRED 7 ", b"FIRED %d " % sequence))
        try:
            trigger.fire(sequence)
        except DeviceError:
            return
        fired += 1

    return Parser(
        "pulse-bus",
        (b"FIRED 7 12\n", b"FIRED 7 4294967296\n", b"ERR busy: owned by 127.0.0.1\n"),
        feed,
        lambda: fired,
        (trigger,),
        0.05,
        answers_only=True,
    )


def gvcp_answers() -> Parser:
    """What a head may answer to a question of our driver's own."""
    answered = 0
    sent: list[bytes] = []
    channel = mock.MagicMock()
    channel.__enter__.return_value = channel

    def receive(_: int) -> bytes:
        if not sent:
            raise TimeoutError("a head that sends no more")
        return sent.pop()

    channel.recv.side_effect = receive

    def feed(data: bytes) -> None:
        nonlocal answered
        sent.append(data)
        with (
            mock.patch.object(socket, "socket", return_value=channel),
            mock.patch.object(gvcp.secrets, "randbelow", return_value=0),
        ):
            answered += gvcp.control_privilege("127.0.0.1", timeout_s=0.1) is not None
        channel.reset_mock()  # it records each call

    return Parser(
        "gvcp-answer",
        tuple(struct.pack(">HHHHI", 0, 0x81, 4, 1, value) for value in (0, 1, 2, 3)),
        feed,
        lambda: answered,
        (),
        0.01,
        answers_only=True,
    )


def gvcp_commands() -> Parser:
    """What a controller may say to an emulated head."""
    registers = RegisterMemory(HeadIdentity("127.0.0.2", "1", "m", "v", "u"), FrameSize(64, 48))
    nothing = mock.Mock()
    control = ControlChannel(
        registers,
        HeadActions(
            written=nothing,
            resend=nothing,
            execute_action=nothing,
            control_lost=nothing,
            is_acquiring=lambda: False,
        ),
    )
    answered = 0

    def feed(data: bytes) -> None:
        nonlocal answered
        answered += control.answer(data, ("127.0.0.1", 4000), 0) is not None
        nothing.reset_mock()

    def command(code: int, body: bytes) -> bytes:
        return struct.pack(">BBHHH", 0x42, 1, code, len(body), 1) + body

    return Parser(
        "gvcp-command",
        (
            command(0x0002, b""),
            command(0x0080, struct.pack(">I", 0x0A00)),
            command(0x0082, struct.pack(">II", 0x0A00, 2)),
            command(0x0084, struct.pack(">IHH", 0x0, 0, 64)),
            command(0x0086, struct.pack(">I", 0x200) + b"text\0\0\0\0"),
            command(0x0040, struct.pack(">HHII", 0, 1, 0, 5)),
        ),
        feed,
        lambda: answered,
        (control,),
        0.04,
        answers_only=True,
    )


PARSERS: Mapping[str, Callable[[], Parser]] = {
    "ublox": ublox,
    "nmea": nmea,
    "novatel": novatel,
    "septentrio": septentrio,
    "sbg": sbg,
    "vectornav": vectornav,
    "xsens": xsens,
    "applanix": applanix,
    "gsof": gsof,
    "mavlink": mavlink,
    "gpsd": gpsd,
    "ascii-line": ascii_line,
    "modbus": modbus,
    "pulse-bus": pulse_bus,
    "gvcp-answer": gvcp_answers,
    "gvcp-command": gvcp_commands,
}

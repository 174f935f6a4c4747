"""A million hostile bytes for every receiver's decoder, ten million in the long run.

Streams of the emulated receivers with bits turned over, bytes lost, doubled and made up, and noise
in between, cut into pieces at random: nothing raises, nothing grows, and after every disturbance
the second whole message is understood.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pytest

from drivers.receivers.mavlink.decoder import MavlinkDecoder
from drivers.receivers.message_decoder import MessageDecoder
from drivers.receivers.nmea.decoder import NmeaDecoder
from drivers.receivers.novatel.decoder import NovatelDecoder
from drivers.receivers.sbg.decoder import SbgDecoder
from drivers.receivers.septentrio.decoder import SbfDecoder
from drivers.receivers.ublox.decoder import UbxDecoder
from drivers.receivers.vectornav.decoder import VectornavDecoder
from sim_hw.receivers.emulated_receiver import Edge, EmulatedReceiver
from sim_hw.receivers.mavlink_autopilot import MavlinkAutopilot
from sim_hw.receivers.nmea_receiver import NmeaReceiver
from sim_hw.receivers.novatel_receiver import NovatelReceiver
from sim_hw.receivers.sbg_receiver import SbgReceiver
from sim_hw.receivers.septentrio_receiver import SeptentrioReceiver
from sim_hw.receivers.ublox_receiver import UbloxReceiver
from sim_hw.receivers.vectornav_receiver import VectornavReceiver
from sim_hw.world.world_clock import WorldClock
from tests.sim_hw.receiver_state import NS, START_GPS_NS, state_at

IN_CI = 1_000_000
IN_THE_LONG_RUN = 10_000_000
EPOCHS = 20


@dataclass(frozen=True)
class Protocol:
    """A decoder, the data of its receiver, and the limit of bytes kept of an incomplete message."""

    decoder: Callable[[str], MessageDecoder]
    source: Callable[[], bytes]
    max_pending_nbytes: int


def bytes_of(kind: type[EmulatedReceiver]) -> bytes:
    """A few seconds of a receiver with marks."""
    receiver = kind(WorldClock(START_GPS_NS, 0), state_at, rate_hz=5.0, seed=3)
    epoch_ns, parts = START_GPS_NS, []
    for number in range(EPOCHS):
        epoch_ns = receiver.epoch_after(epoch_ns)
        receiver.mark(epoch_ns - 50_000_000)
        parts += [
            receiver.event_bytes(Edge(epoch_ns - 50_000_000, True, number)),
            receiver.epoch_bytes(epoch_ns),
        ]
    receiver.close()
    return b"".join(parts)


def bytes_of_autopilot() -> bytes:
    autopilot = MavlinkAutopilot(WorldClock(START_GPS_NS, 0), state_at)
    for second in range(4):
        autopilot.mark(START_GPS_NS + second * NS)
    data = b"".join(autopilot.messages_until(n * NS // 20) for n in range(80))
    autopilot.close()
    return data


PROTOCOLS = {
    "ublox": Protocol(UbxDecoder, lambda: bytes_of(UbloxReceiver), 8_200),
    "novatel": Protocol(NovatelDecoder, lambda: bytes_of(NovatelReceiver), 8_500),
    "septentrio": Protocol(SbfDecoder, lambda: bytes_of(SeptentrioReceiver), 16_384),
    "sbg": Protocol(SbgDecoder, lambda: bytes_of(SbgReceiver), 4_100),
    "vectornav": Protocol(VectornavDecoder, lambda: bytes_of(VectornavReceiver), 4_100),
    "nmea": Protocol(NmeaDecoder, lambda: bytes_of(NmeaReceiver), 256),
    "mavlink": Protocol(MavlinkDecoder, bytes_of_autopilot, 300),
}


def disturbed(clean: bytes, chance: random.Random) -> bytes:
    """The stream with some of all that happens on bad lines."""
    data = bytearray(clean)
    for _ in range(chance.randint(1, 12)):
        at = chance.randrange(len(data))
        length = chance.choice((1, 2, 5, 40, 300))
        what = chance.randrange(6)
        if what == 0:
            data[at] ^= 1 << chance.randrange(8)
        elif what == 1:
            del data[at : at + length]
        elif what == 2:
            data[at:at] = data[at : at + length]
        elif what == 3:
            data[at:at] = chance.randbytes(length)
        elif what == 4:
            data[at : at + length] = bytes(min(length, len(data) - at))
        else:
            data[at : at + 2] = clean[:2]
        if len(data) < 100:
            break
    return bytes(data)


def pieces(data: bytes, chance: random.Random) -> Iterator[bytes]:
    at = 0
    while at < len(data):
        end = at + chance.choice((1, 7, 64, 700, 4096))
        yield data[at:end]
        at = end


def survive(name: str, total: int) -> None:
    protocol = PROTOCOLS[name]
    clean = protocol.source()
    reference = protocol.decoder("gnss")
    reference.feed(clean, 0)
    per_clean_stream = reference.frames
    assert reference.bad_messages == 0
    assert per_clean_stream > EPOCHS
    chance = random.Random(f"hostile-{name}")
    decoder = protocol.decoder("gnss")
    fed = 0
    while fed < total:
        hostile = disturbed(clean, chance)
        for piece in pieces(hostile, chance):
            decoder.feed(piece, fed)
            fed += len(piece)
            assert decoder.pending <= protocol.max_pending_nbytes + 4096
        before = decoder.frames
        for piece in pieces(clean, chance):
            decoder.feed(piece, fed)
            fed += len(piece)
        # The disturbed end may swallow the first message, and the last may be waited for.
        assert decoder.frames - before >= per_clean_stream - 2, f"after {fed} bytes"
    assert decoder.bad_messages > 0
    assert all(
        len(buffered) < 1000
        for buffered in vars(decoder).values()
        if isinstance(buffered, list | dict)
    ), "nothing grows"


@pytest.mark.parametrize("name", list(PROTOCOLS))
def test_a_million_hostile_bytes_raise_nothing_and_cost_no_message_behind_them(name: str) -> None:
    survive(name, IN_CI)


@pytest.mark.soak
@pytest.mark.parametrize("name", list(PROTOCOLS))
def test_ten_million_hostile_bytes_raise_nothing(name: str) -> None:
    survive(name, IN_THE_LONG_RUN)

"""The register memory of an emulated head: what may be read, what may be written, and its bounds.

It holds addresses, lengths and limits; `control` and `gige_head` act on writes.
"""

from __future__ import annotations

import ipaddress
import math
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass

from sim_hw import SimulatorError
from sim_hw.gige import features as at
from sim_hw.gige.description import description_xml
from sim_hw.gige.features import (
    BooleanFeature,
    CommandFeature,
    EnumerationFeature,
    Feature,
    FloatFeature,
    IntegerFeature,
    StringFeature,
)
from sim_hw.gige.gvcp import Status

TICKS_PER_SECOND = 1_000_000_000

_GEV_2_0 = 0x0002_0000
_BIG_ENDIAN_TRANSMITTER_UTF8 = 0x8000_0001
_LINK_LOCAL_DHCP_PERSISTENT = 0x7
_USER_NAME_AND_SERIAL = 0xC000_0000
_RESEND_WRITEMEM_CONCATENATION = 0x7
_ACTION_AND_SCHEDULED = 1 << 6 | 1 << 17


class RegisterRefusedError(SimulatorError):
    """A read or write the head does not grant; `status` goes into the acknowledgement."""

    def __init__(self, status: Status) -> None:
        super().__init__(status.name)
        self.status = status


@dataclass(frozen=True)
class HeadIdentity:
    """The identity of a head: its network address and the strings it reports.

    `address` is IPv4, one per head; `serial` has at most 15 bytes, `user_id` 15, the others 31.
    """

    address: str
    serial: str
    model: str = "UC-Head"
    vendor: str = "Syntopic"
    user_id: str = ""
    mask: str = "255.0.0.0"


@dataclass(frozen=True)
class FrameSize:
    """Pixels of the sensor."""

    width_px: int
    height_px: int


class RegisterMemory:
    """Registers by address for the wire, and by feature name for the head. Thread-safe.

    Reads beyond what exists, writes to what is read-only and values out of bounds raise
    `RegisterRefusedError`; nothing is ever half written.
    """

    def __init__(self, identity: HeadIdentity, size: FrameSize) -> None:
        self._features = at.head_features(size.width_px, size.height_px)
        self._by_name = {feature.name: feature for feature in self._features}
        self._xml = description_xml(self._features, identity.vendor, identity.model)
        self._xml += bytes(-len(self._xml) % 4)
        self._identity = identity
        self._lock = threading.RLock()
        self._live: dict[int, Callable[[], bytes]] = {}
        self._blocks = self._readable_blocks()
        self._bytes: dict[int, bytearray] = {}
        self.reset()

    def reset(self) -> None:
        """Back to what the head holds at power-on."""
        with self._lock:
            self._bytes = {start: bytearray(length) for start, length in self._blocks.items()}
            self._bytes[at.XML_START][:] = self._xml
            self._write_bootstrap()
            for feature in self._features:
                self._write_default(feature)

    def provide(self, name: str, value: Callable[[], bytes]) -> None:
        """Let a feature's bytes be asked for at every read instead of being stored."""
        self._live[self._by_name[name].address] = value

    def read(self, address: int, length: int) -> bytes:
        """Bytes of `length` from `address`; they may span features but not gaps."""
        if address % 4 or length % 4 or length <= 0:
            raise RegisterRefusedError(Status.BAD_ALIGNMENT)
        with self._lock:
            for live, value in self._live.items():
                if live < address + length and address < live + 8:
                    current = value()
                    start, block = self._block(live, len(current))
                    block[live - start : live - start + len(current)] = current
            start, block = self._block(address, length)
            return bytes(block[address - start : address - start + length])

    def write(self, address: int, data: bytes, *, acquiring: bool = False) -> None:
        """Write one feature, whole; a string may be written in part."""
        if address % 4 or len(data) % 4 or not data:
            raise RegisterRefusedError(Status.BAD_ALIGNMENT)
        with self._lock:
            start, block = self._block(address, len(data))
            sharing = [f for f in self._features if f.address <= address < f.address + f.length]
            writable = [f for f in sharing if f.access != "RO"]
            if not writable:
                raise RegisterRefusedError(Status.WRITE_PROTECT)
            for feature in writable:
                if acquiring and feature.locked_while_acquiring:
                    raise RegisterRefusedError(Status.BUSY)
                _check(feature, address, data)
            block[address - start : address - start + len(data)] = data

    def register(self, address: int) -> int:
        """The 32-bit register at an address."""
        return int(struct.unpack(">I", self.read(address, 4))[0])

    def set_register(self, address: int, value: int) -> None:
        """Set a register from inside, whoever may write it from outside."""
        self._store(address, struct.pack(">I", value & 0xFFFF_FFFF))

    def set_register64(self, address: int, value: int) -> None:
        """Set a 64-bit register from inside."""
        self._store(address, struct.pack(">Q", value & 0xFFFF_FFFF_FFFF_FFFF))

    def integer(self, name: str) -> int:
        """Value of an integer, enumeration or boolean feature."""
        feature = self._by_name[name]
        value = self.register(feature.address)
        if isinstance(feature, IntegerFeature) and feature.bits is not None:
            lowest, highest = feature.bits
            value = (value >> lowest) & ((1 << (highest - lowest + 1)) - 1)
        return value

    def number(self, name: str) -> float:
        """Value of a float feature."""
        return float(struct.unpack(">d", self.read(self._by_name[name].address, 8))[0])

    def address_of(self, name: str) -> int:
        return self._by_name[name].address

    def chunk_is_enabled(self, chunk: str) -> bool:
        """Whether ChunkEnable is set for that entry of ChunkSelector."""
        base = self.address_of("ChunkEnable")
        return bool(self.register(base + 4 * at.CHUNKS[chunk]))

    def bits_per_pixel(self) -> int:
        return (self.integer("PixelFormat") >> 16) & 0xFF

    def _readable_blocks(self) -> dict[int, int]:
        word_addresses = set(range(0, at.DISCOVERY_LENGTH, 4))
        word_addresses |= set(range(at.XML_URL, at.XML_URL + at.XML_URL_LENGTH, 4))
        word_addresses |= {
            at.INTERFACES,
            at.MESSAGE_CHANNELS,
            at.STREAM_CHANNELS,
            at.STREAM_CAPABILITY,
        }
        word_addresses |= {
            at.ACTION_SIGNALS,
            at.CONTROL_CAPABILITY,
            at.CONTROL_PRIVILEGE,
            at.STREAM_SOURCE_PORT,
        }
        for feature in self._features:
            word_addresses |= set(range(feature.address, feature.address + feature.length, 4))
        blocks: dict[int, int] = {}
        start = previous = -8
        for register in sorted(word_addresses):
            if register != previous + 4:
                start = register
            blocks[start] = register + 4 - start
            previous = register
        blocks[at.XML_START] = len(self._xml)
        return blocks

    def _block(self, address: int, length: int) -> tuple[int, bytearray]:
        for start, block in self._bytes.items():
            if start <= address and address + length <= start + len(block):
                return start, block
        raise RegisterRefusedError(Status.INVALID_ADDRESS)

    def _store(self, address: int, data: bytes) -> None:
        with self._lock:
            start, block = self._block(address, len(data))
            block[address - start : address - start + len(data)] = data

    def _text(self, address: int, text: str, length: int) -> None:
        self._store(address, text.encode("utf-8")[: length - 1].ljust(length, b"\0"))

    def _write_bootstrap(self) -> None:
        identity = self._identity
        ip = int(ipaddress.IPv4Address(identity.address))
        for address, value in (
            (at.VERSION, _GEV_2_0),
            (at.DEVICE_MODE, _BIG_ENDIAN_TRANSMITTER_UTF8),
            # A locally administered MAC made of the IPv4 address: one per head.
            (at.MAC_HIGH, 0x0200),
            (at.MAC_LOW, ip),
            (at.IP_OPTIONS, _LINK_LOCAL_DHCP_PERSISTENT),
            (at.IP_CONFIGURATION, _LINK_LOCAL_DHCP_PERSISTENT),
            (at.IP_ADDRESS, ip),
            (at.SUBNET_MASK, int(ipaddress.IPv4Address(identity.mask))),
            (at.INTERFACES, 1),
            (at.STREAM_CHANNELS, 1),
            (at.ACTION_SIGNALS, 1),
            (
                at.CONTROL_CAPABILITY,
                _USER_NAME_AND_SERIAL | _RESEND_WRITEMEM_CONCATENATION | _ACTION_AND_SCHEDULED,
            ),
        ):
            self.set_register(address, value)
        for address, text, length in (
            (at.MANUFACTURER, identity.vendor, 32),
            (at.MODEL, identity.model, 32),
            (at.DEVICE_VERSION, "1.0", 32),
            (at.MANUFACTURER_INFO, "emulated", 48),
            (at.SERIAL, identity.serial, 16),
            (at.USER_NAME, identity.user_id, 16),
            (
                at.XML_URL,
                f"Local:head.xml;{at.XML_START:X};{len(self._xml):X}",
                at.XML_URL_LENGTH,
            ),
        ):
            self._text(address, text, length)
        self.set_register64(at.TICK_FREQUENCY_HIGH, TICKS_PER_SECOND)

    def _write_default(self, feature: Feature) -> None:
        match feature:
            case IntegerFeature() if feature.default:
                self.set_register(feature.address, feature.default)
            case EnumerationFeature():
                self.set_register(feature.address, feature.default)
            case BooleanFeature() if feature.default:
                for register in range(feature.address, feature.address + feature.length, 4):
                    self.set_register(register, feature.default)
            case FloatFeature():
                self._store(feature.address, struct.pack(">d", feature.default))


def _check(feature: Feature, address: int, data: bytes) -> None:
    """Refuse data that the feature cannot hold."""
    if isinstance(feature, StringFeature):
        if address + len(data) > feature.address + feature.length:
            raise RegisterRefusedError(Status.INVALID_ADDRESS)
        return
    if isinstance(feature, FloatFeature):
        if address != feature.address or len(data) != 8:
            raise RegisterRefusedError(Status.INVALID_PARAMETER)
        (number,) = struct.unpack(">d", data)
        if not (math.isfinite(number) and feature.minimum <= number <= feature.maximum):
            raise RegisterRefusedError(Status.INVALID_PARAMETER)
        return
    if len(data) != 4:
        raise RegisterRefusedError(Status.INVALID_PARAMETER)
    (value,) = struct.unpack(">I", data)
    match feature:
        case IntegerFeature():
            if feature.bits is not None:
                lowest, highest = feature.bits
                value = (value >> lowest) & ((1 << (highest - lowest + 1)) - 1)
            ok = feature.minimum <= value <= feature.maximum
        case EnumerationFeature():
            ok = value in feature.entries.values()
        case BooleanFeature():
            ok = feature.bit is not None or value in (0, 1)
        case CommandFeature():
            ok = True
        case _:
            ok = False
    if not ok:
        raise RegisterRefusedError(Status.INVALID_PARAMETER)

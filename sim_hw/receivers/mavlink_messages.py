"""MAVLink 2 messages as bytes: those of an autopilot and the requests to it.

Written from the common message set (https://mavlink.io/en/messages/common.html) and the guide on
serialization: field order on the wire, CRC seed and truncation all follow from the definitions
below, which list each message's fields as the message set does, extensions behind the bar.
"""

from __future__ import annotations

import functools
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

DEFINITIONS = """
0 HEARTBEAT uint8_t type, uint8_t autopilot, uint8_t base_mode, uint32_t custom_mode,
  uint8_t system_status, uint8_t_mavlink_version mavlink_version
2 SYSTEM_TIME uint64_t time_unix_usec, uint32_t time_boot_ms
20 PARAM_REQUEST_READ uint8_t target_system, uint8_t target_component, char[16] param_id,
  int16_t param_index
21 PARAM_REQUEST_LIST uint8_t target_system, uint8_t target_component
22 PARAM_VALUE char[16] param_id, float param_value, uint8_t param_type, uint16_t param_count,
  uint16_t param_index
23 PARAM_SET uint8_t target_system, uint8_t target_component, char[16] param_id, float param_value,
  uint8_t param_type
24 GPS_RAW_INT uint64_t time_usec, uint8_t fix_type, int32_t lat, int32_t lon, int32_t alt,
  uint16_t eph, uint16_t epv, uint16_t vel, uint16_t cog, uint8_t satellites_visible
  | int32_t alt_ellipsoid, uint32_t h_acc, uint32_t v_acc, uint32_t vel_acc, uint32_t hdg_acc,
  uint16_t yaw
30 ATTITUDE uint32_t time_boot_ms, float roll, float pitch, float yaw, float rollspeed,
  float pitchspeed, float yawspeed
31 ATTITUDE_QUATERNION uint32_t time_boot_ms, float q1, float q2, float q3, float q4,
  float rollspeed, float pitchspeed, float yawspeed | float[4] repr_offset_q
33 GLOBAL_POSITION_INT uint32_t time_boot_ms, int32_t lat, int32_t lon, int32_t alt,
  int32_t relative_alt, int16_t vx, int16_t vy, int16_t vz, uint16_t hdg
46 MISSION_ITEM_REACHED uint16_t seq
66 REQUEST_DATA_STREAM uint8_t target_system, uint8_t target_component, uint8_t req_stream_id,
  uint16_t req_message_rate, uint8_t start_stop
76 COMMAND_LONG uint8_t target_system, uint8_t target_component, uint16_t command,
  uint8_t confirmation, float param1, float param2, float param3, float param4, float param5,
  float param6, float param7
77 COMMAND_ACK uint16_t command, uint8_t result | uint8_t progress, int32_t result_param2,
  uint8_t target_system, uint8_t target_component
105 HIGHRES_IMU uint64_t time_usec, float xacc, float yacc, float zacc, float xgyro, float ygyro,
  float zgyro, float xmag, float ymag, float zmag, float abs_pressure, float diff_pressure,
  float pressure_alt, float temperature, uint16_t fields_updated | uint8_t id
111 TIMESYNC int64_t tc1, int64_t ts1
112 CAMERA_TRIGGER uint64_t time_usec, uint32_t seq
148 AUTOPILOT_VERSION uint64_t capabilities, uint32_t flight_sw_version,
  uint32_t middleware_sw_version, uint32_t os_sw_version, uint32_t board_version,
  uint8_t[8] flight_custom_version, uint8_t[8] middleware_custom_version,
  uint8_t[8] os_custom_version, uint16_t vendor_id, uint16_t product_id, uint64_t uid
  | uint8_t[18] uid2
244 MESSAGE_INTERVAL uint16_t message_id, int32_t interval_us
"""
CODES = {
    "char": "s",
    "uint8_t": "B",
    "uint8_t_mavlink_version": "B",
    "int16_t": "h",
    "uint16_t": "H",
    "int32_t": "i",
    "uint32_t": "I",
    "int64_t": "q",
    "uint64_t": "Q",
    "float": "f",
}
MAGIC = 0xFD
_HEADER_NBYTES = 10
_CRC_NBYTES = 2
_SIGNATURE_NBYTES = 13
_SIGNED = 0x01
_FIELD = re.compile(r"(\w+)(?:\[(\d+)\])? (\w+)")


@dataclass(frozen=True)
class MessageField:
    """One field: `length` is that of an array, 0 for a single value."""

    kind: str
    name: str
    length: int

    @property
    def code(self) -> str:
        return (str(self.length) if self.length else "") + CODES[self.kind]

    @property
    def element_nbytes(self) -> int:
        return struct.calcsize("<" + CODES[self.kind])


@dataclass(frozen=True)
class MessageDefinition:
    """A message: fields in their order on the wire, and what its definition adds to its CRC."""

    number: int
    name: str
    fields: tuple[MessageField, ...]
    crc_extra: int

    @functools.cached_property
    def layout(self) -> struct.Struct:
        return struct.Struct("<" + "".join(field.code for field in self.fields))

    def payload(self, values: dict[str, Any]) -> bytes:
        """Packed, with zeros at its end cut off, but never empty."""
        flat: list[Any] = []
        for field in self.fields:
            value = values.get(field.name, b"" if field.kind == "char" else 0)
            if field.length and field.kind != "char":
                flat += value if isinstance(value, Sequence) else [value] * field.length
            else:
                flat.append(value)
        packed = self.layout.pack(*flat)
        return packed.rstrip(b"\x00") or packed[:1]

    def values(self, payload: bytes) -> dict[str, Any]:
        """Unpacked; what was cut off, or is of an older definition, is zero."""
        flat = list(
            self.layout.unpack(payload[: self.layout.size].ljust(self.layout.size, b"\x00"))
        )
        found: dict[str, Any] = {}
        for field in self.fields:
            if field.length and field.kind != "char":
                found[field.name] = [flat.pop(0) for _ in range(field.length)]
            else:
                found[field.name] = flat.pop(0)
        return found


@dataclass(frozen=True)
class ReceivedMessage:
    """A received message."""

    name: str
    system: int
    component: int
    values: dict[str, Any]


def x25(data: bytes, crc: int = 0xFFFF) -> int:
    """The CRC-16/MCRF4XX of MAVLink."""
    for byte in data:
        byte = (byte ^ crc) & 0xFF
        byte = (byte ^ byte << 4) & 0xFF
        crc = crc >> 8 ^ byte << 8 ^ byte << 3 ^ byte >> 4
    return crc


@functools.cache
def definitions() -> dict[str, MessageDefinition]:
    """Every message of `DEFINITIONS` by name."""
    found = {}
    for text in re.split(r"\n(?=\d)", DEFINITIONS.strip()):
        number, name, fields = text.split(maxsplit=2)
        base, _, extensions = fields.partition("|")
        ordered = sorted(_fields(base), key=lambda field: -field.element_nbytes)
        seed = x25(f"{name} ".encode())
        for field in ordered:
            seed = x25(
                f"{field.kind.removesuffix('_mavlink_version')} {field.name} ".encode(), seed
            )
            if field.length:
                seed = x25(bytes((field.length,)), seed)
        extra = seed & 0xFF ^ seed >> 8
        found[name] = MessageDefinition(int(number), name, (*ordered, *_fields(extensions)), extra)
    return found


@functools.cache
def by_number() -> dict[int, MessageDefinition]:
    return {definition.number: definition for definition in definitions().values()}


def message(name: str, sequence: int, system: int, component: int, **values: Any) -> bytes:
    """A whole unsigned message of version 2; fields that are not given are zero."""
    definition = definitions()[name]
    payload = definition.payload(values)
    head = struct.pack(
        "<BBBBBB", len(payload), 0, 0, sequence & 0xFF, system, component
    ) + definition.number.to_bytes(3, "little")
    crc = x25(bytes((definition.crc_extra,)), x25(head + payload))
    return bytes((MAGIC,)) + head + payload + struct.pack("<H", crc)


def messages_in(data: bytes) -> list[tuple[str, bytes]]:
    """Whole messages, one behind the other, as `message` makes them, each with its name."""
    found = []
    while data:
        size = _HEADER_NBYTES + data[1] + _CRC_NBYTES
        number = int.from_bytes(data[7:10], "little")
        found.append((by_number()[number].name, data[:size]))
        data = data[size:]
    return found


class MavlinkStreamParser:
    """Takes messages of version 2 out of what a host writes; others and damage are skipped."""

    def __init__(self) -> None:
        self._buffer = b""

    def feed(self, data: bytes) -> list[ReceivedMessage]:
        buffer = self._buffer + data
        found = []
        while (start := buffer.find(MAGIC)) >= 0:
            buffer = buffer[start:]
            if len(buffer) < _HEADER_NBYTES:
                break
            length, flags = buffer[1], buffer[2]
            end = _HEADER_NBYTES + length
            message_end = end + _CRC_NBYTES + (_SIGNATURE_NBYTES if flags & _SIGNED else 0)
            if len(buffer) < message_end:
                break
            definition = by_number().get(int.from_bytes(buffer[7:10], "little"))
            checked = None
            if definition is not None:
                checked = x25(bytes((definition.crc_extra,)), x25(buffer[1:end]))
            if definition is None or checked != int.from_bytes(buffer[end : end + 2], "little"):
                # Unknown or damaged: the next message may begin anywhere behind its first byte.
                buffer = buffer[1:]
                continue
            values = definition.values(buffer[_HEADER_NBYTES:end])
            found.append(ReceivedMessage(definition.name, buffer[5], buffer[6], values))
            buffer = buffer[message_end:]
        else:
            buffer = b""
        self._buffer = buffer
        return found


def _fields(text: str) -> tuple[MessageField, ...]:
    return tuple(
        MessageField(kind, name, int(length or 0)) for kind, length, name in _FIELD.findall(text)
    )

"""The flight log: every device's bytes and records as they came, in MCAP, never pixels.

What is handed over goes to the kernel at once, so a killed process loses nothing, and to the disk
whenever the owner calls `sync`. A log that ends in the middle of a message is normal weather.
"""

from __future__ import annotations

import logging
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import Any, Protocol

import zstandard
from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC, CompressionType, IndexType, Writer

from daemon.mission.canonical_json import RecordError, canonical_bytes, parse_record
from daemon.mission.log.log_records import Message, lenient_json_bytes
from daemon.mission.store import durable

PROFILE = "syntopic"
CHECKPOINT_TOPIC = "log/checkpoint"
"""Written at every sync: CRC-32 of all bytes of the file before it."""

RECORD_MAX_NBYTES = 16_000_000
"""Nothing larger is read: messages of ours have some kB, chunks of other tools a few MB."""

_DAMAGE_ERRORS = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    LookupError,
    TypeError,
    ArithmeticError,
    RuntimeError,
    EOFError,
    MemoryError,
)
"""What the readers of records and chunks raise on damaged or untrusted bytes."""

_KNOWN_OPCODES = {int(opcode) for opcode in Opcode}
_RECORD_HEADER = struct.Struct("<BQ")
_MESSAGE_HEADER = struct.Struct("<HIQQ")
_log = logging.getLogger(__name__)


class LogStream(Protocol):
    """Where the bytes of a log go; `crc32` is that of all bytes so far."""

    offset: int
    crc32: int
    is_closed: bool

    def write(self, data: bytes) -> int: ...
    def tell(self) -> int: ...
    def flush(self) -> None: ...
    def sync(self) -> None: ...
    def close(self) -> None: ...


class FlightLog:
    """Appends to one MCAP file, one per start of the service. Not for several threads.

    Messages are written one by one without chunks. A disk that refuses costs messages, counted in
    `dropped`, never an exception: exposures matter more than their log.
    """

    def __init__(
        self,
        path: Path,
        *,
        boot_id: str,
        software: str = "",
        simulated: bool = False,
        stream: LogStream | None = None,
    ) -> None:
        self.path = path
        self.dropped = 0
        self._reported = 0
        self._channels: dict[str, int] = {}
        self._schema: int | None = None
        self._sequence = 0
        self._stream: LogStream = stream or _UnbufferedStream(path)
        self._synced_at = 0
        self._writer = Writer(
            self._stream,
            compression=CompressionType.NONE,
            index_types=IndexType.NONE,
            use_chunking=False,
        )
        self._writer.start(profile=PROFILE, library="syntopic")
        self._checkpoint_channel = self._writer.register_channel(CHECKPOINT_TOPIC, "json", 0)
        about = {
            "boot_id": boot_id,
            "software": software,
            "started_utc": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%S.%fZ}",
            "clock": "CLOCK_MONOTONIC, nanoseconds since boot",
            **({"simulated": "true"} if simulated else {}),
        }
        self._writer.add_metadata(PROFILE, about)

    @classmethod
    def create(
        cls,
        log_dir: Path,
        *,
        boot_id: str | None = None,
        software: str = "",
        simulated: bool = False,
    ) -> FlightLog:
        """Begin a new file named after the present UTC; its name is durable on return.

        Raises:
            OSError: the disk refused.
        """
        durable.make_directories(log_dir)
        path = log_dir / new_log_name()
        boot_id = boot_id or host_boot_id()
        log = cls(path, boot_id=boot_id, software=software, simulated=simulated)
        log.sync()
        durable.sync_directory(log_dir)
        return log

    def append(self, topic: str, mono_ns: int, payload: bytes | Mapping[str, Any]) -> None:
        """Hand a message to the kernel.

        Args:
            topic: such as "raw/gnss" or "event/SU00".
            mono_ns: arrival on CLOCK_MONOTONIC.
            payload: bytes go in as they are; an object becomes canonical JSON, what JSON cannot
                hold exactly as text.
        """
        is_json = not topic.startswith("raw/")
        data = payload if isinstance(payload, bytes) else lenient_json_bytes(payload)
        self._sequence += 1
        try:
            if self.dropped > self._reported:
                lost = self.dropped
                self._add("log/dropped", mono_ns, canonical_bytes({"dropped": lost}), is_json=True)
                self._reported = lost
            self._add(topic, mono_ns, data, is_json=is_json)
        except OSError as error:
            if self.dropped == self._reported:
                _log.error("log=%s refused=%s; free the disk", self.path.name, error.strerror)
            self.dropped += 1
            # Their definitions may be among what was lost; they are given again.
            self._channels.clear()
            self._schema = None

    def write(self, message: Message) -> None:
        """Append a message made by `daemon.mission.log.log_records`."""
        self.append(message.topic, message.mono_ns, message.payload)

    def sync(self) -> None:
        """Put everything handed over so far on the disk, with a checkpoint. Never raises."""
        if self._stream.offset == self._synced_at:
            return
        checkpoint = {"offset": self._stream.offset, "crc32": self._stream.crc32}
        try:
            self._writer.add_message(
                self._checkpoint_channel, 0, canonical_bytes(checkpoint), 0, self._sequence
            )
            self._stream.sync()
        except OSError as error:
            _log.error("log=%s not_synced=%s; free the disk", self.path.name, error.strerror)
        self._synced_at = self._stream.offset

    def close(self) -> None:
        """Close the file properly; may be called twice."""
        if self._stream.is_closed:
            return
        try:
            self._writer.finish()
            self._stream.sync()
        except OSError as error:
            _log.error("log=%s not_finished=%s; it reads all the same", self.path.name, error)
        self._stream.close()

    def _add(self, topic: str, mono_ns: int, data: bytes, *, is_json: bool) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._register(topic, is_json=is_json)
        self._writer.add_message(channel, max(0, mono_ns), data, max(0, mono_ns), self._sequence)

    def _register(self, topic: str, *, is_json: bool) -> int:
        if self._schema is None:
            self._schema = self._writer.register_schema(
                "syntopic.Record", "jsonschema", b'{"type":"object"}'
            )
        encoding, schema = ("json", self._schema) if is_json else ("application/octet-stream", 0)
        self._channels[topic] = self._writer.register_channel(topic, encoding, schema)
        return self._channels[topic]


class LogReader:
    """Iterates over the messages of a log, up to its torn end.

    After the iteration `cut_nbytes` is how many bytes at the end could not be read,
    `is_complete` whether the log was closed properly, and `bad_checkpoints` how many
    checkpoints disagree with what is before them. `about` is the log's description of itself, known
    as soon as the first message comes.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut_nbytes = 0
        self.is_complete = False
        self.bad_checkpoints = 0
        self.about: Mapping[str, str] = {}

    @property
    def boot_id(self) -> str:
        return self.about.get("boot_id", "")

    def __iter__(self) -> Iterator[Message]:
        size = self.path.stat().st_size
        channels: dict[int, str] = {}
        with self.path.open("rb") as file:
            position = len(MCAP0_MAGIC)
            magic = file.read(position)
            if magic != MCAP0_MAGIC:
                self.cut_nbytes = size
                return
            crc32 = zlib.crc32(magic)
            while not self.is_complete:
                header = file.read(_RECORD_HEADER.size)
                body = _read_body(file, header, size - position - len(header))
                if body is None:
                    break
                try:
                    found = list(self._records(header[0], body, channels))
                except _DAMAGE_ERRORS:
                    break
                for message in found:
                    if message.topic == CHECKPOINT_TOPIC:
                        self.bad_checkpoints += not _checksum_matches(message, position, crc32)
                    else:
                        yield message
                crc32 = zlib.crc32(body, zlib.crc32(header, crc32))
                position += len(header) + len(body)
            self.cut_nbytes = 0 if self.is_complete else size - position

    def _records(self, opcode: int, body: bytes, channels: dict[int, str]) -> Iterator[Message]:
        if opcode == Opcode.MESSAGE:
            # The bulk of every log, so unpacked here: channel, sequence, log and publish time.
            channel_id, _, mono_ns, _ = _MESSAGE_HEADER.unpack_from(body)
            yield Message(channels[channel_id], mono_ns, body[_MESSAGE_HEADER.size :])
            return
        stream = ReadDataStream(BytesIO(body))
        if opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            channels[channel.id] = channel.topic
        elif opcode == Opcode.CHUNK:
            # Ours have none; a log that went through other tools may.
            for record in breakup_chunk(_unpacked(Chunk.read(stream)), validate_crc=True):
                if isinstance(record, Channel):
                    channels[record.id] = record.topic
                elif isinstance(record, McapMessage):
                    yield Message(channels[record.channel_id], record.log_time, record.data)
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(stream)
            if metadata.name == PROFILE:
                self.about = dict(metadata.metadata)
        elif opcode == Opcode.DATA_END:
            self.is_complete = True


def read(path: Path) -> LogReader:
    """The messages of a log, whole or torn."""
    return LogReader(path)


def logs_of(log_dir: Path) -> list[Path]:
    """The logs of a mission in the order they were begun."""
    return sorted(log_dir.glob("*.mcap"))


def new_log_name() -> str:
    """The name of a log that begins now; names sort by time."""
    return f"{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}.mcap"


def host_boot_id() -> str:
    """Which boot the monotonic clock of this host counts from."""
    return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()


class _UnbufferedStream:
    """What the MCAP writer writes to: straight to the kernel, whole or not at all."""

    def __init__(self, path: Path) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        self._descriptor = os.open(path, flags, 0o644)
        self.offset = 0
        self.crc32 = 0
        self.is_closed = False

    def write(self, data: bytes) -> int:
        view = memoryview(data)
        written = 0
        try:
            while written < len(view):
                written += os.write(self._descriptor, view[written:])
        except OSError:
            # Half a message would end the log for every reader.
            os.ftruncate(self._descriptor, self.offset)
            os.lseek(self._descriptor, self.offset, os.SEEK_SET)
            raise
        self.offset += written
        self.crc32 = zlib.crc32(data, self.crc32)
        return written

    def tell(self) -> int:
        return self.offset

    def flush(self) -> None:
        """Nothing is held back."""

    def sync(self) -> None:
        os.fdatasync(self._descriptor)

    def close(self) -> None:
        if not self.is_closed:
            self.is_closed = True
            os.close(self._descriptor)


def _read_body(file: Any, header: bytes, remaining: int) -> bytes | None:
    """The body of a record, or None where the file is torn."""
    if len(header) < _RECORD_HEADER.size:
        return None
    opcode, length = _RECORD_HEADER.unpack(header)
    if length > min(remaining, RECORD_MAX_NBYTES) or (
        opcode < 0x80 and opcode not in _KNOWN_OPCODES
    ):
        return None
    body: bytes = file.read(length)
    return body if len(body) == length else None


def _unpacked(chunk: Chunk) -> Chunk:
    """A chunk with unpacked records; ValueError where they exceed its stated size or the limit."""
    if not chunk.compression:
        return chunk
    limit = min(chunk.uncompressed_size, RECORD_MAX_NBYTES) + 1
    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as reader:
            data = reader.read(limit)
    elif chunk.compression == "lz4":
        data = LZ4FrameDecompressor().decompress(chunk.data, max_length=limit)
    else:
        raise ValueError(f"compression {chunk.compression!r}")
    if len(data) != chunk.uncompressed_size:
        raise ValueError("a chunk is not of its stated size")
    return replace(chunk, compression="", data=data)


def _checksum_matches(message: Message, position: int, crc32: int) -> bool:
    try:
        content = parse_record(message.payload, message.topic)
    except RecordError:
        return False
    return content.get("offset") != position or content.get("crc32") == crc32

"""Signatures of MAVLink messages: verification, replay protection, and the signing clock.

The last timestamp of each stream and the clock outlive the process, so that a recorded message is
refused after a restart as well. Source: https://mavlink.io/en/guide/message_signing.html.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import logging
import os
import shlex
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from daemon.mission.store import durable

KEY_BYTES: Final = 32
KEY_TEXT_MAX: Final = 4096
OTHERS_PERMISSION_BITS: Final = 0o007
SIGNATURE_BYTES: Final = 6
TRAILER_BYTES: Final = 13
"""Link id, timestamp and signature."""
SIGNED_FLAG: Final = 0x01
V2_MAGIC: Final = 0xFD
TICKS_PER_S: Final = 100_000
NS_PER_TICK: Final = 10_000
TICKS_MAX: Final = (1 << 48) - 1
SIGNING_EPOCH_UNIX_NS: Final = 1_420_070_400_000_000_000
"""2015-01-01, from which timestamps count."""
NEW_STREAM_LAG_TICKS: Final = 60 * TICKS_PER_S
STREAMS_MAX: Final = 256
_log = logging.getLogger(__name__)

Stream = tuple[int, int, int]
"""System, component and link id."""


class Signatures:
    """Accepts each signed message once.

    A message of a known stream has to be newer than the last one of its stream, that of a new
    stream at most a minute behind the signing clock. The clock is the latest of what it was, of the
    host's clock, of GPS time and of all accepted messages; nothing ever puts it back.
    """

    def __init__(
        self,
        key: bytes,
        path: Path | None,
        *,
        unix_ns: Callable[[], int] = time.time_ns,
        mono_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Read what `save` has written at `path`; None keeps it in memory only.

        Raises:
            ValueError: the file is there and cannot be read, which would forget recorded messages.
        """
        self.key = key
        self._path = path
        self._unix_ns, self._mono_ns = unix_ns, mono_ns
        self._base, self._base_mono_ns = 0, mono_ns()
        self._sent = 0
        self._last: dict[Stream, int] = {}
        self.is_saved = True
        if path is not None:
            self._load(path)

    def now(self) -> int:
        """The signing clock, in units of 10 us since 2015."""
        host = (self._unix_ns() - SIGNING_EPOCH_UNIX_NS) // NS_PER_TICK
        passed = (self._mono_ns() - self._base_mono_ns) // NS_PER_TICK
        return min(max(host, self._base + passed, 0), TICKS_MAX)

    def next_timestamp(self) -> int:
        """The clock for a message to send; later than that of the previous message."""
        self._sent = max(self.now(), self._sent + 1)
        return self._sent

    def advance(self, unix_ns: int) -> None:
        """Set the clock to GPS time if that is later."""
        self._advance((unix_ns - SIGNING_EPOCH_UNIX_NS) // NS_PER_TICK)

    def accept(self, frame: bytes) -> bool:
        """Whether a complete message is signed with the key and is not a replay.

        The stream advances only after the signature was verified: a forged message with a
        timestamp of the future changes nothing.
        """
        if len(frame) <= TRAILER_BYTES or frame[0] != V2_MAGIC or not frame[2] & SIGNED_FLAG:
            return False
        digest = hashlib.sha256(self.key + frame[:-SIGNATURE_BYTES]).digest()[:SIGNATURE_BYTES]
        if not hmac.compare_digest(digest, frame[-SIGNATURE_BYTES:]):
            return False
        timestamp = int.from_bytes(frame[-12:-SIGNATURE_BYTES], "little")
        stream = frame[5], frame[6], frame[-TRAILER_BYTES]
        last = self._last.get(stream)
        if last is None:
            if timestamp < self.now() - NEW_STREAM_LAG_TICKS:
                return False
        elif timestamp <= last:
            return False
        self._last[stream] = timestamp
        while len(self._last) > STREAMS_MAX:
            del self._last[min(self._last, key=self._last.__getitem__)]
        self._advance(timestamp)
        self.is_saved = False
        return True

    def save(self) -> None:
        """Save the timestamps. OSError: the disk refuses."""
        if self._path is None:
            return
        streams = [[*stream, last] for stream, last in list(self._last.items())]
        content = {"key": self._fingerprint(), "clock": self.now(), "streams": streams}
        self.is_saved = True
        try:
            durable.make_directories(self._path.absolute().parent)
            durable.replace_file(self._path, json.dumps(content).encode() + b"\n", mode=0o600)
        except OSError:
            self.is_saved = False
            raise

    def _advance(self, ticks: int) -> None:
        if ticks > self.now():
            self._base, self._base_mono_ns = ticks, self._mono_ns()

    def _load(self, path: Path) -> None:
        try:
            content = json.loads(path.read_bytes())
            clock, streams = _checked(content)
        except FileNotFoundError:
            return
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise ValueError(
                f"{path}: the last timestamps of signed commands could not be loaded ({error}); "
                "recorded commands could be executed again. Remove the file if no command can "
                "have been recorded"
            ) from error
        self._advance(clock)
        # Messages that another key signed are refused anyway.
        if content["key"] == self._fingerprint():
            self._last = streams

    def _fingerprint(self) -> str:
        return hashlib.sha256(b"syntopic mavlink signing key" + self.key).hexdigest()[:16]


def read_key(path: Path) -> bytes:
    """The signing key of a file.

    Raises:
        ValueError: it cannot be read, is no key, or is readable by all users.
    """
    try:
        with path.open("rb") as file:
            is_open = os.fstat(file.fileno()).st_mode & OTHERS_PERMISSION_BITS
            key = bytes.fromhex(file.read(KEY_TEXT_MAX).decode("ascii").strip())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: no signing key ({error}); 64 hexadecimal digits") from error
    if len(key) != KEY_BYTES:
        raise ValueError(f"{path}: a signing key has 64 hexadecimal digits")
    if is_open:
        raise ValueError(
            f"{path}: all users of this computer may read or change the signing key; run: chmod "
            f"600 {shlex.quote(str(path))}, and use a new key if others could log in"
        )
    return key


def _checked(content: Any) -> tuple[int, dict[Stream, int]]:
    streams: dict[Stream, int] = {}
    for system, component, link, last in content["streams"]:
        numbers = (system, component, link)
        if not all(type(n) is int and 0 <= n <= 255 for n in numbers) or not _is_ticks(last):
            raise ValueError(f"{[*numbers, last]} is not a stream")
        streams[system, component, link] = last
    if not _is_ticks(content["clock"]) or not isinstance(content["key"], str):
        raise ValueError("clock or key is missing")
    return content["clock"], streams


def _is_ticks(value: object) -> bool:
    return type(value) is int and 0 <= value <= TICKS_MAX

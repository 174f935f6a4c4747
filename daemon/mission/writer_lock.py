"""One writer per mission, or several runs that commit by manifests: a lock file with its holder.

The kernel's lock (flock) decides; it ends with its process, however that dies. The file's content
is only for the sentence that refuses a second writer.
"""

from __future__ import annotations

import fcntl
import json
import os
import shlex
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from daemon import DaemonError

LOCK_FILE = ".held"
_HOLDER_MAX_BYTES = 4096
_COMMAND_MAX_CHARACTERS = 300
_ATTEMPTS, _BETWEEN_ATTEMPTS_S = 5, 0.01


class MissionError(DaemonError):
    """A mission folder that cannot be created, opened or used; the message states what to do."""


@contextmanager
def writer_lock(mission: Path, *, is_shared: bool = False) -> Iterator[None]:
    """Hold a mission against every other writer until the block ends.

    Args:
        mission: its folder.
        is_shared: admit other holders that share, which commit by manifests
            (`daemon.mission.store.product_manifests`).

    Raises:
        MissionError: another process holds it; the sentence names that process. Or the lock
            file cannot be opened.
    """
    path = mission / LOCK_FILE
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags, 0o644)
    except OSError as error:
        raise MissionError(
            f"{mission}: cannot be locked for writing ({error.strerror}). Check permissions and "
            "whether the disk is mounted read-only"
        ) from error
    try:
        try:
            _lock(descriptor, fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX)
        except BlockingIOError as error:
            raise MissionError(
                f"mission {mission.resolve().name} is held by another process"
                f"{_holder(descriptor)}. Wait until it has finished, or stop it first"
            ) from error
        own = _myself()
        _write(descriptor, own)
        try:
            yield
        finally:
            if os.pread(descriptor, _HOLDER_MAX_BYTES, 0) == own:
                _write(descriptor, b"")
    finally:
        os.close(descriptor)


def is_locked(mission: Path) -> bool:
    """Whether a writer holds the mission now."""
    try:
        descriptor = os.open(mission / LOCK_FILE, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def _lock(descriptor: int, how: int) -> None:
    """Take the lock. `is_locked` of another process may have it for an instant: ask again.

    Raises:
        BlockingIOError: another process holds it.
    """
    for _ in range(_ATTEMPTS - 1):
        with suppress(BlockingIOError):
            fcntl.flock(descriptor, how | fcntl.LOCK_NB)
            return
        time.sleep(_BETWEEN_ATTEMPTS_S)
    fcntl.flock(descriptor, how | fcntl.LOCK_NB)


def _myself() -> bytes:
    command = shlex.join([Path(sys.argv[0] or "python").name, *sys.argv[1:]])
    return json.dumps(
        {
            "pid": os.getpid(),
            "command": command[:_COMMAND_MAX_CHARACTERS],
            "since_utc": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}",
            "host": socket.gethostname(),
        }
    ).encode()


def _write(descriptor: int, data: bytes) -> None:
    """Put a new content into the lock file; a disk that refuses it does not matter."""
    try:
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, data, 0)
    except OSError:
        return


def _holder(descriptor: int) -> str:
    """Who holds the lock, as the holder wrote it; empty where the file does not say."""
    try:
        content = json.loads(os.pread(descriptor, _HOLDER_MAX_BYTES, 0))
        pid, command = int(content["pid"]), str(content["command"])
        return f": `{command}`, process {pid} on {content['host']} since {content['since_utc']}"
    except (OSError, ValueError, KeyError, TypeError):
        return ""

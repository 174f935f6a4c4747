"""The write log of a program: every change it asks of the kernel, recorded by strace.

What SQLite writes is in it as well as what we write: the layer lies below both. Changes through
shared mappings are not; of the files of a mission only `mission.db-shm` is written that way, which
SQLite rebuilds after a crash.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

STRACE = shutil.which("strace")
CALLS = (
    "openat,creat,write,pwrite64,writev,pwritev,pwritev2,fsync,fdatasync,ftruncate,truncate,"
    "fallocate,mkdir,mkdirat,rename,renameat,renameat2,unlink,unlinkat,rmdir,link,linkat,symlink,"
    "symlinkat,sync_file_range,copy_file_range,sendfile"
)


@dataclass(frozen=True)
class Operation:
    """One change: what, where, and with which bytes.

    `kind` is one of create, write, truncate, sync, mkdir, rename, exchange, unlink. `offset` is
    None for a write at the file's own position; `size` is what a file was cut to; `is_new` states
    whether a file that is opened for creation must not have been there.
    """

    kind: str
    path: str
    target: str = ""
    offset: int | None = None
    data: bytes = b""
    size: int = 0
    empties: bool = False


class WriteLogError(Exception):
    """A call that this recorder does not understand: better no log than one with a hole."""


def why_not() -> str | None:
    """Why nothing can be recorded here, or None."""
    if STRACE is None:
        return "strace is missing: apt-get install strace"
    probe = subprocess.run(
        [STRACE, "-f", "-o", "/dev/null", "true"], capture_output=True, text=True, timeout=30
    )
    if probe.returncode == 0:
        return None
    return f"strace may not trace here ({probe.stderr.strip().splitlines()[-1:]})"


WHY_NOT = why_not()
# Containers often forbid tracing; there is no other way to see each write of the real program.
needs_strace = pytest.mark.skipif(
    WHY_NOT is not None, reason=f"writes are recorded, and failures injected, by strace: {WHY_NOT}"
)


def record(command: Sequence[str], folder: Path, log: Path, *, cwd: Path) -> list[Operation]:
    """Run a program and return what it changed, in the order in which that was done.

    Args:
        command: ends by itself.
        folder: changes outside of it are left out.
        log: a folder for the recorder's own files.
        cwd: where the program runs.
    """
    assert STRACE is not None
    log.mkdir()
    traced = [STRACE, "-ff", "-y", "-xx", "-z", "-s", "100000000", "--seccomp-bpf", "-qq"]
    traced += ["--absolute-timestamps=format:unix,precision:ns", "--syscall-times=ns"]
    traced += ["-o", str(log / "trace"), "-e", f"trace={CALLS}", *command]
    subprocess.run(traced, cwd=cwd, check=True, timeout=300)
    timed = [
        found
        for path in sorted(log.iterdir())
        for line in path.read_text(encoding="ascii").splitlines()
        if (found := _timed(line)) is not None
    ]
    timed.sort()
    prefix = f"{folder}/"
    return [
        operation
        for _, call in timed
        for operation in _operations(call)
        if f"{operation.path}/".startswith(prefix)
    ]


def run_with_faults(
    command: Sequence[str],
    faults: Sequence[str],
    trace: Path,
    *,
    cwd: Path,
    stdout: Path = Path("/dev/stdout"),
) -> int:
    """Run a program some of whose calls fail or wait; how many did.

    Args:
        command: ends by itself.
        faults: as `strace -e inject=` takes them, such as "fsync:error=EIO:when=3+5"; calls are
            counted in each thread for itself.
        trace: the recorder's own file.
        cwd: where the program runs.
        stdout: where it prints.
    """
    assert STRACE is not None
    calls = ",".join(fault.partition(":")[0] for fault in faults)
    traced = [STRACE, "-f", "--seccomp-bpf", "-qq", "-o", str(trace), "-e", f"trace={calls}"]
    for fault in faults:
        traced += ["-e", f"inject={fault}"]
    with stdout.open("w") as out:
        subprocess.run([*traced, *command], cwd=cwd, stdout=out, check=True, timeout=300)
    return sum("INJECTED" in line or "DELAYED" in line for line in trace.open())


_LINE = re.compile(r"(\d+)\.(\d{9}) (.*) <(\d+)\.(\d{9})>")
_CALL = re.compile(r"(\w+)\((.*)\)\s+= (-?\d+)(?:<([^>]*)>)?.*")
_FD = re.compile(r"(?:-?\d+|AT_FDCWD)<((?:\\x[0-9a-f]{2})*)>(?:\(deleted\))?")
_DELETED = re.compile(r"-?\d+<(?:\\x[0-9a-f]{2})*>\(deleted\)")
_TEXT = re.compile(r'"((?:\\x[0-9a-f]{2})*)"')


def _timed(line: str) -> tuple[int, str] | None:
    """A call and the moment it was done, in ns; None for what is no call."""
    found = _LINE.fullmatch(line)
    if found is None:
        if "(" in line and "+++" not in line:
            raise WriteLogError(line[:200])
        return None
    begun_ns = int(found[1]) * 10**9 + int(found[2])
    return begun_ns + int(found[4]) * 10**9 + int(found[5]), found[3]


def _operations(call: str) -> Iterator[Operation]:
    found = _CALL.fullmatch(call)
    if found is None:
        raise WriteLogError(call[:200])
    name, arguments, result = found[1], found[2], int(found[3])
    descriptors = [_plain(text).decode() for text in _FD.findall(arguments)]
    texts = [_plain(text) for text in _TEXT.findall(arguments)]
    names = [text.decode() for text in texts] if "write" not in name else []
    if name in ("mkdirat", "renameat", "renameat2", "unlinkat", "linkat", "symlinkat", "openat"):
        names = [str(Path(*pair)) for pair in zip(descriptors, names, strict=False)]
    if name in ("openat", "creat"):
        if "O_CREAT" in arguments or "O_TRUNC" in arguments or name == "creat":
            empties = "O_TRUNC" in arguments or name == "creat"
            yield Operation("create", _plain(found[4]).decode(), empties=empties)
    elif _DELETED.match(arguments):
        return  # a file that has no name any more is in no state of the disk
    elif name in ("write", "writev"):
        yield Operation("write", descriptors[0], data=b"".join(texts)[:result])
    elif name in ("pwrite64", "pwritev", "pwritev2"):
        numbers = re.findall(r", (\d+)", arguments)
        offset = int(numbers[-1] if name != "pwritev2" else numbers[-2])
        yield Operation("write", descriptors[0], offset=offset, data=b"".join(texts)[:result])
    elif name in ("fsync", "fdatasync"):
        yield Operation("sync", descriptors[0])
    elif name == "ftruncate":
        yield Operation("truncate", descriptors[0], size=int(arguments.rpartition(", ")[2]))
    elif name in ("mkdir", "mkdirat"):
        yield Operation("mkdir", names[0])
    elif name in ("rename", "renameat", "renameat2"):
        kind = "exchange" if "RENAME_EXCHANGE" in arguments else "rename"
        yield Operation(kind, names[0], target=names[1])
    elif name in ("unlink", "unlinkat", "rmdir"):
        yield Operation("unlink", names[0])
    else:
        raise WriteLogError(call[:200])


def _plain(text: str) -> bytes:
    return bytes.fromhex(text.replace("\\x", ""))

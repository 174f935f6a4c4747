"""What the monitoring process may use and do, so that it affects no other process.

The limits of the systemd unit hold for all processes of the service. The resource limits here hold
for the process with network access. If it exceeds them, it ends and is started again; the flight
continues. Landlock (landlock(7)) forbids it to start programs, to read or change processes of its
user that are not its own (ptrace, /proc/PID/mem, process_vm_writev), and to send them signals.
Files are not restricted here.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import resource
import struct
from contextlib import suppress
from pathlib import Path
from typing import Final

MEMORY_MAX_BYTES = 1_000_000_000
"""Private memory, RLIMIT_DATA."""
FILES_MAX = 1024
NICENESS = 5
OOM_SCORE = 900
"""Of 1000: the kernel ends this process before any other of the service."""


CREATE_RULESET: Final = 444
RESTRICT_SELF: Final = 446
"""System calls, of the same number on every architecture."""
ABI_VERSION: Final = 1
ACCESS_FS_EXECUTE: Final = 1
SCOPE_SIGNAL: Final = 2
SIGNALS_SINCE_ABI: Final = 6
PR_SET_NO_NEW_PRIVS: Final = 38


def apply_resource_limits() -> None:
    """Limit this process; limits that the machine does not permit are skipped.

    Only a process started for monitoring is limited, since limits cannot be removed.
    """
    if multiprocessing.parent_process() is None:
        return
    for kind, limit in (
        (resource.RLIMIT_DATA, MEMORY_MAX_BYTES),
        (resource.RLIMIT_NOFILE, FILES_MAX),
        (resource.RLIMIT_CORE, 0),
    ):
        _, hard = resource.getrlimit(kind)
        limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        with suppress(OSError, ValueError):
            resource.setrlimit(kind, (limit, limit))
    with suppress(OSError):
        os.nice(NICENESS)
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(OOM_SCORE), "ascii")
    restrict()


def restrict() -> bool:
    """Restrict this thread and those it starts; False if the kernel does not support it."""
    libc = ctypes.CDLL(None, use_errno=True)
    abi = libc.syscall(CREATE_RULESET, None, ctypes.c_size_t(0), ABI_VERSION)
    if abi < 1:
        return False
    # handled_access_fs, handled_access_net, scoped; older kernels know the first alone
    ruleset = struct.pack("=QQQ", ACCESS_FS_EXECUTE, 0, SCOPE_SIGNAL)
    size = 24 if abi >= SIGNALS_SINCE_ABI else 8
    descriptor = libc.syscall(CREATE_RULESET, ruleset, ctypes.c_size_t(size), 0)
    if descriptor < 0:
        return False
    try:
        return bool(
            libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0
            and libc.syscall(RESTRICT_SELF, descriptor, 0) == 0
        )
    finally:
        os.close(descriptor)

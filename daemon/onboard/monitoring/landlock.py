"""Landlock restrictions of the monitoring process (landlock(7)).

It may not start programs, read or change processes of its user that are not its own (ptrace,
/proc/PID/mem, process_vm_writev), nor send them signals. Files are not restricted here.
"""

from __future__ import annotations

import ctypes
import os
import struct
from typing import Final

CREATE_RULESET: Final = 444
RESTRICT_SELF: Final = 446
"""System calls, of the same number on every architecture."""
ABI_VERSION: Final = 1
ACCESS_FS_EXECUTE: Final = 1
SCOPE_SIGNAL: Final = 2
SIGNALS_SINCE_ABI: Final = 6
PR_SET_NO_NEW_PRIVS: Final = 38


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

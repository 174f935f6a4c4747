"""Ends an emulator process when its parent process ends."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal

PR_SET_PDEATHSIG = 1


def terminate_with_parent(parent_pid: int | None = None) -> None:
    """Have the kernel end this process when the parent dies; it may have died before we asked.

    SIGKILL, since nobody is left for whom an orderly end would make a difference, and an orderly
    end can hang. Without a pid the parent is the one that multiprocessing names.
    """
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    parent = multiprocessing.parent_process()
    expected_parent = parent.pid if parent_pid is None and parent is not None else parent_pid
    if expected_parent is not None and os.getppid() != expected_parent:
        os.kill(os.getpid(), signal.SIGKILL)

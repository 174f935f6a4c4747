"""Threads of a process that processes exposures: how many, and how they wait."""

from __future__ import annotations

import os
import sys

SWITCH_INTERVAL_S = 0.001
"""How long one thread may hold the interpreter while another waits to enter a kernel."""


def configure_threads() -> None:
    """Let threads take turns, and sleep where they wait; call it before the first kernel runs.

    OpenMP's threads spin by default, which takes the core from the exposures processed in parallel.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    sys.setswitchinterval(SWITCH_INTERVAL_S)


def thread_counts(threads: int) -> dict[str, str]:
    """Environment variables of a process that limit its threads.

    Compiled kernels use several cores, small matrices one; waiting threads do not spin.
    """
    names = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")
    fixed = {"OPENBLAS_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
    return dict.fromkeys(names, str(threads)) | fixed

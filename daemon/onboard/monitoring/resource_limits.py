"""Bounds of the page's process: what reaches it from the network costs no other process.

A unit's limits hold for all processes of the service; these hold for the one that strangers can
reach. When it exceeds them it ends and is started again; the flight goes on.
"""

from __future__ import annotations

import multiprocessing
import os
import resource
from contextlib import suppress
from pathlib import Path

from daemon.onboard.monitoring.landlock import restrict

MEMORY_MAX_BYTES = 1_000_000_000
"""Private memory, RLIMIT_DATA."""
FILES_MAX = 1024
NICENESS = 5
OOM_SCORE = 900
"""Of 1000: the kernel ends this process before any other of the service."""


def apply_resource_limits() -> None:
    """Bound this process; what the machine does not permit is left out.

    Only a process that was started for this is bounded, never one that serves a page beside other
    work: limits cannot be taken back.
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
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(OOM_SCORE), "ascii")
    restrict()

"""Resource limits of the monitoring process, so that its load affects no other process.

The limits of the systemd unit hold for all processes of the service. These hold for the process
with network access. If it exceeds them, it ends and is started again; the flight continues.
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

"""How many worker processes a machine has cores and memory for."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from daemon.postflight.batch.control_groups import group_free_nbytes
from daemon.products.shared_maps import has_room
from processing.rig import Rig

PROCESS_NBYTES: Final = 300_000_000
"""Interpreter, libraries and kernels of one process."""
FRAMES_FACTOR: Final = 6.2
"""Memory of one exposure in work, in sizes of its raw frames, those included.

Source: benchmarks/records/bench-shared-cells.json: `ultracam-x`, with its calibrations, occupies
2,416 MiB in addition to its frames of 432 MB.
"""
FURTHER_FRAMES_FACTOR: Final = 2.7
"""Memory of a further exposure in work in the same process, in the same unit.

Source: as above: two in work occupy 668 MiB more than one, in addition to the frames of the second.
"""
MAPS_FACTOR: Final = 2.0
"""Of these, what processes of one machine have once (`daemon.products.shared_maps`): the maps of
calibrations, four bytes a pixel.

Source: benchmarks/records/shared-maps.json: 824 MiB of `ultracam-x`, whose frames are 432 MB.
"""
MEMORY_SHARE: Final = 0.8
"""Of the available memory; the rest is for the page cache that the disk is written through."""


@dataclass(frozen=True)
class ProcessAllocation:
    """Processes and the threads of each; `reason` names what limits them."""

    processes: int
    threads: int
    reason: str


def exposure_nbytes(rig: Rig) -> int:
    """Memory of a process with one exposure of this rig in work."""
    return PROCESS_NBYTES + round(FRAMES_FACTOR * _frames_nbytes(rig))


def further_exposure_nbytes(rig: Rig) -> int:
    """Memory of a further exposure in work in the same process, which shares the calibrations."""
    return round(FURTHER_FRAMES_FACTOR * _frames_nbytes(rig))


def shared_maps_nbytes(rig: Rig) -> int:
    """Memory of an exposure that processes of one machine share; 0 without room for the file."""
    nbytes = round(MAPS_FACTOR * _frames_nbytes(rig))
    return nbytes if has_room(nbytes) else 0


def _frames_nbytes(rig: Rig) -> int:
    return sum(2 * sensor.width_px * sensor.height_px for sensor in rig.sensors)


def plan_processes(
    task_nbytes: int,
    tasks: int,
    *,
    cores: int,
    available_nbytes: int,
    threads: int | None = None,
    shared_nbytes: int = 0,
) -> ProcessAllocation:
    """As many processes as cores, memory and tasks allow; at least one.

    Args:
        task_nbytes: memory of one process with a task.
        tasks: number of tasks.
        cores: that this process may use.
        available_nbytes: memory that is free, or can be.
        threads: of one process, where a person chose it.
        shared_nbytes: of `task_nbytes`, what all processes have in memory once.
    """
    by_cores = max(1, cores // (threads or 1))
    own_nbytes = max(1, task_nbytes - shared_nbytes)
    by_memory = max(1, (int(available_nbytes * MEMORY_SHARE) - shared_nbytes) // own_nbytes)
    count = max(1, min(by_cores, by_memory, tasks))
    own_threads = threads or max(1, cores // count)
    limit = "cores" if count == by_cores else "memory" if count == by_memory else "exposures"
    once = f", of which {shared_nbytes / 1e9:.1f} GB once" if shared_nbytes else ""
    reason = (
        f"{cores} cores, {available_nbytes / 1e9:.1f} GB of memory available, "
        f"{task_nbytes / 1e9:.1f} GB for an exposure{once}; limited by {limit}"
    )
    return ProcessAllocation(count, own_threads, reason)


def usable_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0))


def available_memory_nbytes() -> int:
    """Memory available to new work: of the machine, or of a control group if that is less.

    Source: proc(5), MemAvailable.
    """
    fields = dict(
        line.split(":", 1) for line in Path("/proc/meminfo").read_text("ascii").splitlines()
    )
    machine = int(fields["MemAvailable"].split()[0]) * 1024
    group = group_free_nbytes()
    return machine if group is None else min(machine, group)

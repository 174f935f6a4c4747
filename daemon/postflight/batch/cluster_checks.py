"""Whether scheduler and workers of a cluster suit a command: versions and memory.

What differs at the start ends the run. A worker that joins later and does not suit is set aside by
`daemon.postflight.batch.dask_executor`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Final

import distributed

from daemon.postflight.batch.executor import BatchWork, ExecutorEndedError

CHECKED_PACKAGES: Final = ("dask", "distributed", "msgpack", "cloudpickle")
"""Packages whose versions must be the same, for both sides to understand each other."""


class ClusterError(ExecutorEndedError):
    """A cluster that cannot be used; the message states what to do."""


def check_scheduler(client: distributed.Client) -> None:
    """Compare the scheduler's version of this program with that of the command.

    Raises:
        ClusterError: they differ.
    """
    try:
        theirs, ours = client.run_on_scheduler(version, "syntopic"), version("syntopic")
    except PackageNotFoundError:
        theirs, ours = "none", version("syntopic")
    if theirs != ours:
        raise ClusterError(
            f"the scheduler has syntopic {theirs}, this command {ours}. Install the same version "
            "where the scheduler runs: pip install 'syntopic[cluster]'"
        )


def check_versions(client: distributed.Client) -> None:
    """Compare the packages by which both sides understand each other.

    Raises:
        ClusterError: a version differs.
    """
    check_scheduler(client)
    found: dict[str, Any] = client.get_versions(check=False)
    own = found["client"]["packages"]
    sides = {"the scheduler": found["scheduler"]}
    sides |= {f"worker {name}": about for name, about in found["workers"].items()}
    for side, about in sides.items():
        if problem := version_problem(side, about["packages"], own):
            raise ClusterError(problem)


def version_problem(side: str, packages: Mapping[str, Any], own: Mapping[str, Any]) -> str:
    """A sentence on the first package whose version differs; empty where none does.

    Args:
        side: whose packages they are, in words.
        packages: versions by name.
        own: of this command.
    """
    for name in (*CHECKED_PACKAGES, "python"):
        # A Python version is three numbers with a suffix; the first two decide.
        digits = 2 if name == "python" else 9
        versions = [str(v.get(name)).split(".")[:digits] for v in (packages, own)]
        if versions[0] != versions[1]:
            return (
                f"{side} has {name} {packages.get(name)}, this command {own.get(name)}. "
                "Install the same versions: pip install 'syntopic[cluster]' on all machines"
            )
    return ""


def check_memory(client: distributed.Client, work: BatchWork) -> None:
    """Compare the memory that each worker declares with that of an exposure.

    Raises:
        ClusterError: a worker declares too little.
    """
    for name, about in client.scheduler_info()["workers"].items():
        if problem := memory_problem(name, about, work.memory_nbytes):
            raise ClusterError(problem)


def memory_problem(worker: str, about: Mapping[str, Any], task_nbytes: int) -> str:
    """A sentence where a worker declares less memory than its exposures need; else empty.

    Args:
        worker: its address.
        about: as the scheduler describes it.
        task_nbytes: memory of a process with one task.
    """
    threads, limit = max(1, about["nthreads"]), about["memory_limit"] or 0
    if not limit or limit >= threads * task_nbytes:
        return ""
    return (
        f"worker {worker} declares {limit / 1e9:.1f} GB for {threads} exposures at a time; "
        f"{threads * task_nbytes / 1e9:.1f} GB are needed. Start it with fewer --processes"
    )


def unsuitable_workers(
    client: distributed.Client, workers: Iterable[str], task_nbytes: int
) -> dict[str, str]:
    """Check workers that joined a run: an empty sentence by address, or what is wrong.

    A worker that does not answer is left out; it is checked again later.

    Args:
        client: of the cluster.
        workers: their addresses.
        task_nbytes: memory of a process with one task.

    Raises:
        OSError, TimeoutError: the scheduler does not answer.
    """
    own = client.get_versions(check=False)
    about = client.scheduler_info()["workers"]
    found: dict[str, str] = {}
    for worker in workers:
        answer = own["workers"].get(worker)
        if answer is None or worker not in about:
            continue
        found[worker] = memory_problem(worker, about[worker], task_nbytes) or version_problem(
            f"worker {worker}", answer["packages"], own["client"]["packages"]
        )
    return found

"""`python -m benchmarks.killed_workers FOLDER`: a mission on a cluster whose parts are killed.

A mission of small exposures that differ in their bytes is processed by two plain processes and by
worker processes of a dask cluster, in turn and without faults. Then a copy is processed by the
cluster while workers and the scheduler are killed at random and calls of the store fail. This
program starts the scheduler again, as systemd would; `syntopic worker` starts its own processes
again. At the end all products are compared, none was committed twice, and the number of exposures
computed again is explained by kills and failed writes; otherwise the status is 1.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import distributed

from benchmarks.counted_work import CountedWork
from benchmarks.store_mission import flown
from daemon.cli.benchmark.measurement import machine
from daemon.cli.process import as_flown
from daemon.configuration.model import ProcessingSection
from daemon.mission.layout import Mission
from daemon.mission.store import product_manifests
from daemon.planning.overlaps import overlaps_of
from daemon.postflight.batch.batch_run import BatchCounts, BatchOutcome, run_batch
from daemon.postflight.batch.cluster_address import ClusterAddress
from daemon.postflight.batch.dask_executor import DaskExecutor
from daemon.postflight.batch.executor import BatchExecutor
from daemon.postflight.batch.level2_work import Level2Work, survey
from daemon.postflight.batch.local_processes import LocalProcessExecutor
from daemon.postflight.batch.software_identity import software_identity
from processing.rig import load_rig

PORT = 18_790
STORE_FAILURE_SHARE = 0.01
RATIO_MAX = 1.18
"""Seconds of the cluster over those of two plain processes, without kills."""


class Killer(threading.Thread):
    """Kills workers and the scheduler at random, and starts the scheduler again."""

    def __init__(self, worker_command: int, kills: int, scheduler_kills: int, mean_s: float):
        super().__init__(daemon=True)
        self.worker_command, self.mean_s = worker_command, mean_s
        self.plan = ["worker"] * kills + ["scheduler"] * scheduler_kills
        random.shuffle(self.plan)
        self.done: Counter[str] = Counter()
        self.scheduler = started_scheduler()
        self.is_ended = threading.Event()

    def run(self) -> None:
        for what in self.plan:
            if self.is_ended.wait(random.expovariate(1.0 / self.mean_s)):
                return
            if what == "scheduler":
                self.scheduler.kill()
                self.scheduler.wait()
                self.scheduler = started_scheduler()
                self.done[what] += 1
            elif victim := self._next_victim():
                with suppress(ProcessLookupError):
                    os.kill(victim, signal.SIGKILL)
                    self.done[what] += 1

    def _next_victim(self) -> int | None:
        """A worker that has loaded its work; None at the end of the run."""
        while not (victims := computing_children(self.worker_command)):
            if self.is_ended.wait(0.2):
                return None
        return random.choice(victims)

    def end(self) -> None:
        self.is_ended.set()
        if self.is_alive():
            self.join()
        self.scheduler.kill()
        self.scheduler.wait()


def started_scheduler() -> subprocess.Popen[bytes]:
    dask = Path(sys.executable).with_name("dask")
    options = ["--host", "127.0.0.1", "--port", str(PORT), "--dashboard-address", "127.0.0.1:0"]
    return subprocess.Popen(
        [str(dask), "scheduler", *options],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": str(Path.cwd())},
    )


def tree_cpu_s() -> float:
    """CPU seconds of this program and of the processes below it that live now."""
    fields = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            fields[int(path.parent.name)] = path.read_text().rpartition(")")[2].split()
    tree = {os.getpid()}
    while more := {p for p, of in fields.items() if int(of[1]) in tree} - tree:
        tree |= more
    ticks = sum(int(fields[pid][11]) + int(fields[pid][12]) for pid in tree if pid in fields)
    return ticks / os.sysconf("SC_CLK_TCK")


def computing_children(parent: int) -> list[int]:
    """Worker processes: children of a command that have loaded the kernels."""
    found = []
    for name in Path(f"/proc/{parent}/task/{parent}/children").read_text().split():
        try:
            if "llvmlite" in Path(f"/proc/{name}/maps").read_text():
                found.append(int(name))
        except OSError:
            continue
    return found


def level2_work(mission: Mission) -> Level2Work:
    plan, radiometry = as_flown(mission, None)
    return Level2Work(
        mission=mission.path.absolute(),
        rig_file=None,
        processing=ProcessingSection(threads=1),
        plan=plan,
        radiometry=radiometry,
        identity=software_identity(),
    )


@dataclass(frozen=True)
class Pace:
    """Milliseconds of one exposure once every process had loaded its work: of wall and of CPU time.

    CPU time is that of this program and everything below it.
    """

    wall_ms: float
    cpu_ms: float


def computed(
    mission: Mission,
    executor: BatchExecutor,
    attempts: Path,
    failure_share: float,
    workers: int,
    at_first: Callable[[], None] = lambda: None,
) -> tuple[BatchOutcome, Pace | None]:
    """The outcome of a run and its pace; None where not all processes loaded their work in time.

    `at_first` is called after the first product.
    """
    work = level2_work(mission)
    found = survey(
        work, mission, mission.numbers(), overlaps_of(mission, load_rig(mission.rig_path))
    )
    counted = CountedWork(work, attempts, failure_share)
    known: list[tuple[int, float, float]] = []  # exposures done, wall and CPU seconds
    first = iter([at_first])

    def progress(counts: BatchCounts) -> None:
        done = counts.done + counts.failed
        if done:
            next(first, lambda: None)()
        is_last = done == len(found.pending)
        if is_last or (not known and counts_of(attempts)["opened"] >= workers):
            known.append((done, time.monotonic(), tree_cpu_s()))

    outcome = run_batch(executor, counted, found.pending, progress)
    if len(known) < 2:
        return outcome, None
    count, wall_s, cpu_s = (last - first for first, last in zip(known[0], known[-1], strict=True))
    return outcome, Pace(round(1e3 * wall_s / count, 1), round(1e3 * cpu_s / count, 1))


def compared(mission: Mission) -> dict[int, str]:
    """Hash of each product set without durations; every byte is checked against its manifest."""
    found = {}
    for number in mission.numbers():
        keys = product_manifests.committed_keys(mission, number)
        assert len(keys) == 1, (number, keys)
        problems = product_manifests.product_problems(mission, number, keys[0])
        assert not problems, problems
        manifest = product_manifests.read_manifest(mission, number, keys[0])
        assert manifest is not None
        found[number] = manifest.compared_sha256
    return found


def counts_of(attempts: Path) -> Counter[str]:
    return Counter(line.partition(" ")[2] for line in attempts.read_text().splitlines())


def linked(pristine: Mission, root: Path) -> Mission:
    """A copy of a mission without products; frames are links, for nothing writes them."""

    def copied(source: str, target: str) -> None:
        if source.endswith(".tif"):
            os.link(source, target)
        else:
            shutil.copy2(source, target)

    path = shutil.copytree(pristine.path, root / pristine.id, copy_function=copied)
    return Mission.open(Path(path))


@contextmanager
def cluster(folder: Path, workers: int, killer: Killer) -> Iterator[DaskExecutor]:
    """An executor on the scheduler of the killer, with so many worker processes."""
    url = f"tcp://127.0.0.1:{PORT}"
    command = [sys.executable, "-m", "daemon", "worker", url, "--processes", str(workers)]
    with (folder / "workers.txt").open("ab") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
    killer.worker_command = process.pid
    wait_for_workers(url, workers)
    try:
        yield DaskExecutor(ClusterAddress(url))
    finally:
        killer.end()
        process.send_signal(signal.SIGINT)
        process.wait(60)


def wait_for_workers(url: str, workers: int) -> None:
    """Start-up is no part of what is measured."""
    with distributed.Client(url, timeout=60, set_as_default=False) as client:
        client.wait_for_workers(workers, timeout=300)


def without_kills(pristine: Mission, folder: Path, rounds: int, workers: int) -> dict[str, Any]:
    """Pace of two plain processes and of the cluster, in turn, and the ratios of medians.

    On a machine with other work the ratio of CPU times is the more reliable one.
    """
    paces: dict[str, list[Pace]] = {"two processes": [], "cluster": []}
    for k in range(rounds):
        plain = linked(pristine, folder / f"plain-{k}")
        two = LocalProcessExecutor(2)
        outcome, pace = computed(plain, two, folder / f"plain-{k}.txt", 0.0, 2)
        assert not outcome.failures and pace is not None, outcome.failures
        paces["two processes"].append(pace)
        other = linked(pristine, folder / f"cluster-{k}")
        with cluster(folder, workers, Killer(0, 0, 0, 1.0)) as executor:
            outcome, pace = computed(other, executor, folder / f"cluster-{k}.txt", 0.0, workers)
        assert not outcome.failures and pace is not None, outcome.failures
        paces["cluster"].append(pace)
    wall_ms = {name: [one.wall_ms for one in of] for name, of in paces.items()}
    cpu_ms = {name: [one.cpu_ms for one in of] for name, of in paces.items()}
    return {
        "wall_ms": wall_ms,
        "ratio": round(median(wall_ms["cluster"]) / median(wall_ms["two processes"]), 3),
        "bound": RATIO_MAX,
        "cpu_ms": cpu_ms,
        "cpu_ratio": round(median(cpu_ms["cluster"]) / median(cpu_ms["two processes"]), 3),
    }


def with_kills(pristine: Mission, plain: Mission, options: argparse.Namespace) -> dict[str, Any]:
    """A run whose parts die; its figures, and sentences on what does not hold."""
    copy = linked(pristine, options.folder / "killed")
    attempts = options.folder / "killed.txt"
    killer = Killer(0, options.kills, options.scheduler_kills, options.mean_s)
    with cluster(options.folder, options.workers, killer) as executor:
        begun_s = time.monotonic()
        outcome, _ = computed(
            copy, executor, attempts, STORE_FAILURE_SHARE, options.workers, killer.start
        )
        seconds = time.monotonic() - begun_s
    noted = counts_of(attempts)
    again = noted["computed"] - options.exposures
    commits = Counter(
        line.partition(" ")[0]
        for line in attempts.read_text().splitlines()
        if line.endswith(" committed")
    )
    in_work = killer.done["scheduler"] * options.workers
    bound = killer.done["worker"] + in_work + noted["write failed"]
    problems = [failure.cause for failure in outcome.failures]
    if again > bound:
        problems.append(f"{again} computed again; {bound} at most are explained")
    if twice := [number for number, count in commits.items() if count > 1]:
        problems.append(f"committed twice: {twice}")
    if compared(copy) != compared(plain):
        problems.append("products differ from those of two processes")
    return {
        "worker_kills": killer.done["worker"],
        "scheduler_kills": killer.done["scheduler"],
        "counts": outcome.counts.as_json(),
        "begun": noted["computed"],
        "computed_again": again,
        "computed_again_bound": bound,
        "read_failures": noted["read failed"],
        "write_failures": noted["write failed"],
        "recognized": noted["recognized"],
        "committed_twice": len(twice),
        "seconds": round(seconds, 2),
        "problems": problems,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.killed_workers", description=__doc__
    )
    parser.add_argument("folder", type=Path, help="new folder for missions")
    parser.add_argument("--exposures", type=int, default=500)
    parser.add_argument("--workers", type=int, default=8)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--scheduler-kills", type=int, default=2)
    parser.add_argument("--mean-s", type=float, default=1.5, help="mean time between kills")
    parser.add_argument("--rounds", type=int, default=3, help="runs in turn without kills")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--side", type=int, default=144, help="pixels of a frame's side")
    options = parser.parse_args()
    random.seed(options.seed)
    options.folder.mkdir(parents=True)
    pristine = flown(options.folder / "flown", options.exposures, options.side)
    calm = without_kills(pristine, options.folder, options.rounds, options.workers)
    print(json.dumps(calm), file=sys.stderr)
    plain = Mission.open(options.folder / "plain-0" / pristine.id)
    killed = with_kills(pristine, plain, options)
    output: dict[str, Any] = {
        "machine": machine(),
        "load": os.getloadavg()[0],
        "exposures": options.exposures,
        "workers": options.workers,
        "seed": options.seed,
        "without_kills": calm,
        "with_kills": killed,
    }
    print(json.dumps(output))
    if killed["problems"]:
        sys.exit(1)


if __name__ == "__main__":
    main()

"""`python -m benchmarks.killed_workers FOLDER`: a mission on a cluster whose parts are killed.

A mission of small exposures that differ in their bytes is processed by two plain processes and by
worker processes of a dask cluster, in turn and without faults. Then a copy is processed by the
cluster while workers and the scheduler are killed at random and calls of the store fail. This
program starts the scheduler again, as systemd would; `syntopic worker` starts its own processes
again. At the end all products are compared, none was committed twice, and every computation that
was repeated is explained by a kill or a failed write. Otherwise the status is 1, as it is where
the cluster without kills is slower than the limit, where fewer parts were killed than planned, and
where an exposure failed.

With `--hold-s` the program ends after so many seconds with status 75; the same command continues.
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
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, Final

import distributed

from benchmarks import attempt_notes
from benchmarks.attempt_notes import NoteFile, attempts_of, read_notes
from benchmarks.counted_work import CountedWork
from benchmarks.store_mission import flown
from daemon.cli.benchmark.measurement import machine
from daemon.cli.process import as_flown
from daemon.configuration.model import ProcessingSection
from daemon.mission.canonical_json import canonical_bytes
from daemon.mission.layout import Mission
from daemon.mission.store import product_manifests
from daemon.mission.store.durable import replace_file
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
SCHEDULER_SETTINGS: Final = {
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s",
}
"""As the how-to on many exposures states."""
LAST_KILL_SHARE = 0.95
"""Of the exposures: an exposure that lost two processes is tried alone at the end of a run."""
CONTINUE_STATUS: Final = 75
"""Source: sysexits.h, EX_TEMPFAIL."""


class Killer(threading.Thread):
    """Kills workers and the scheduler at random, and starts the scheduler again.

    A kill is due when so many exposures are done as the plan states, however fast the machine is.
    """

    def __init__(self, plan: Sequence[tuple[int, str]] = (), notes: NoteFile | None = None):
        super().__init__(daemon=True)
        self.worker_command = 0
        self.plan, self.notes = plan, notes
        self.exposures_done = 0
        self.scheduler = started_scheduler()
        self.is_ended = threading.Event()

    def run(self) -> None:
        for due, what in self.plan:
            while self.exposures_done < due:
                if self.is_ended.wait(0.05):
                    return
            if what == attempt_notes.SCHEDULER_KILLED:
                self.scheduler.kill()
                self.scheduler.wait()
                self.note(what, self.scheduler.pid)
                self.scheduler = started_scheduler()
            elif victim := self._next_victim():
                with suppress(ProcessLookupError):
                    os.kill(victim, signal.SIGKILL)
                    self.note(what, victim)

    def note(self, what: str, process: int) -> None:
        if self.notes is not None:
            self.notes.add(0, what, process)

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


def kill_plan(kills: int, scheduler_kills: int, exposures: int, seed: int) -> list[tuple[int, str]]:
    """When each part is killed, in exposures done, and which one; the same in every program."""
    generator = random.Random(seed)
    parts = [attempt_notes.WORKER_KILLED] * kills
    parts += [attempt_notes.SCHEDULER_KILLED] * scheduler_kills
    generator.shuffle(parts)
    due = sorted(generator.randrange(1, int(LAST_KILL_SHARE * exposures)) for _ in parts)
    return list(zip(due, parts, strict=True))


def started_scheduler() -> subprocess.Popen[bytes]:
    dask = Path(sys.executable).with_name("dask")
    options = ["--host", "127.0.0.1", "--port", str(PORT), "--dashboard-address", "127.0.0.1:0"]
    return subprocess.Popen(
        [str(dask), "scheduler", *options],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | SCHEDULER_SETTINGS | {"PYTHONPATH": str(Path.cwd())},
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
    notes: Path,
    failure_share: float,
    workers: int,
    each: Callable[[BatchCounts], None] = lambda _counts: None,
) -> tuple[BatchOutcome, Pace | None]:
    """The outcome of a run and its pace; None where not all processes loaded their work in time.

    `each` is called after every exposure.
    """
    work = level2_work(mission)
    found = survey(
        work, mission, mission.numbers(), overlaps_of(mission, load_rig(mission.rig_path))
    )
    counted = CountedWork(work, notes, failure_share)
    known: list[tuple[int, float, float]] = []  # exposures done, wall and CPU seconds

    def progress(counts: BatchCounts) -> None:
        done = counts.done + counts.failed
        is_last = done == len(found.pending)
        if is_last or (not known and events_of(notes)["opened"] >= workers):
            known.append((done, time.monotonic(), tree_cpu_s()))
        each(counts)

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


def events_of(notes: Path) -> Counter[str]:
    return Counter(note.event for note in read_notes(notes))


def linked(pristine: Mission, root: Path) -> Mission:
    """A copy of a mission without products; frames are links, for nothing writes them."""

    def copied(source: str, target: str) -> None:
        if source.endswith(".tif"):
            os.link(source, target)
        else:
            shutil.copy2(source, target)

    shutil.rmtree(root, ignore_errors=True)  # what an ended program left
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


def without_kills(
    pristine: Mission, folder: Path, rounds: int, workers: int, hold: Hold
) -> dict[str, Any]:
    """Pace of two plain processes and of the cluster, in turn, and the ratios of medians.

    On a machine with other work the ratio of CPU times is the more reliable one.
    """
    paces: dict[str, list[dict[str, float]]] = {"two processes": [], "cluster": []}
    for k in range(rounds):
        for name, found in paces.items():
            run = f"{'plain' if name == 'two processes' else 'cluster'}-{k}"
            found.append(hold.once(run, partial(one_pace, pristine, folder / run, workers)))
    wall_ms = {name: [one["wall_ms"] for one in of] for name, of in paces.items()}
    cpu_ms = {name: [one["cpu_ms"] for one in of] for name, of in paces.items()}
    return {
        "wall_ms": wall_ms,
        "ratio": round(median(wall_ms["cluster"]) / median(wall_ms["two processes"]), 3),
        "bound": RATIO_MAX,
        "cpu_ms": cpu_ms,
        "cpu_ratio": round(median(cpu_ms["cluster"]) / median(cpu_ms["two processes"]), 3),
    }


def one_pace(pristine: Mission, root: Path, workers: int) -> dict[str, float]:
    """Pace of one run: of two processes in a folder named plain-N, else of a cluster."""
    mission, notes = linked(pristine, root), root.with_suffix(".txt")
    notes.unlink(missing_ok=True)
    if root.name.startswith("plain"):
        outcome, pace = computed(mission, LocalProcessExecutor(2), notes, 0.0, 2)
    else:
        with cluster(root.parent, workers, Killer()) as executor:
            outcome, pace = computed(mission, executor, notes, 0.0, workers)
    assert not outcome.failures, outcome.failures
    if pace is None:
        sys.exit("all was done before every process had loaded its work; give more --exposures")
    return vars(pace)


class Hold:
    """Results of steps in a folder, and the end of the time that this program may take.

    Args:
        folder: of the results.
        seconds: that the program may take.
    """

    def __init__(self, folder: Path, seconds: float) -> None:
        self.folder, self.limit_s = folder, time.monotonic() + seconds

    @property
    def is_over(self) -> bool:
        return time.monotonic() > self.limit_s

    def once(self, name: str, step: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The result of a step, computed now or by an earlier program.

        Raises:
            SystemExit: the time is over.
        """
        path = self.folder / f"{name}.json"
        if not path.exists():
            self.end_if_over()
            replace_file(path, canonical_bytes(step()))
        result: dict[str, Any] = json.loads(path.read_text())
        return result

    def end_if_over(self) -> None:
        """End the program where its time is over.

        Raises:
            SystemExit: it is.
        """
        if self.is_over:
            print("time is over; run the same command again", file=sys.stderr)
            sys.exit(CONTINUE_STATUS)


def with_kills(
    pristine: Mission, plain: Mission, options: argparse.Namespace, hold: Hold
) -> dict[str, Any]:
    """A run whose parts die; its figures, and sentences on what does not hold."""
    root, path = options.folder / "killed", options.folder / "killed.txt"
    if not path.exists():
        linked(pristine, root)
    copy, notes = Mission.open(root / pristine.id), NoteFile(path)
    plan = kill_plan(options.kills, options.scheduler_kills, options.exposures, options.seed)
    while pending := unfinished(copy):
        hold.end_if_over()
        before = events_of(path)
        done = before[attempt_notes.WORKER_KILLED] + before[attempt_notes.SCHEDULER_KILLED]
        killer = Killer(plan[done:], notes)
        notes.add(0, attempt_notes.STOPPED)  # an earlier program may have been killed itself
        with cluster(options.folder, options.workers, killer) as executor:
            finished = options.exposures - pending

            def each(
                counts: BatchCounts, finished: int = finished, killer: Killer = killer
            ) -> None:
                killer.exposures_done = finished + counts.done
                if killer.ident is None and not killer.is_ended.is_set():
                    killer.start()
                if hold.is_over and not killer.is_ended.is_set():
                    killer.is_ended.set()
                    raise KeyboardInterrupt

            outcome, _ = computed(copy, executor, path, STORE_FAILURE_SHARE, options.workers, each)
        notes.add(0, attempt_notes.STOPPED)
        replace_file(
            options.folder / f"killed-{time.time_ns()}.json",
            canonical_bytes(
                {**outcome.counts.as_json(), "failures": [f.cause for f in outcome.failures]}
            ),
        )
    attempts, noted = attempts_of(read_notes(path)), events_of(path)
    runs = [json.loads(one.read_text()) for one in sorted(options.folder.glob("killed-*.json"))]
    problems = attempt_notes.violations(attempts, options.workers)
    if compared(copy) != compared(plain):
        problems.append("products differ from those of two processes")
    again = {
        number: [attempt.end for attempt in them[:-1]]
        for number, them in attempt_notes.repeated(attempts).items()
    }
    return {
        "worker_kills": noted[attempt_notes.WORKER_KILLED],
        "scheduler_kills": noted[attempt_notes.SCHEDULER_KILLED],
        "runs": len(runs),
        "failures": [cause for run in runs for cause in run["failures"]],
        "computed": len(attempts),
        "computed_again": len(attempts) - options.exposures,
        "causes": dict(Counter(end for ends in again.values() for end in ends)),
        "most_attempts": max(map(len, again.values()), default=0) + 1,
        "read_failures": noted["read failed"],
        "write_failures": noted[attempt_notes.WRITE_FAILED],
        "recognized": noted["recognized"],
        "problems": problems,
    }


def shortfalls(
    calm: Mapping[str, Any], killed: Mapping[str, Any], planned: Mapping[str, int]
) -> list[str]:
    """What was measured and does not hold, or was not done as planned, one sentence each.

    Args:
        calm: result of `without_kills`.
        killed: result of `with_kills`.
        planned: kills by their name in `killed`.
    """
    problems = []
    if calm["ratio"] > calm["bound"]:
        problems.append(
            f"without kills the cluster took {calm['ratio']} of the time of two processes; the "
            f"limit is {calm['bound']}"
        )
    problems += [
        f"{name}: {killed[name]} of {count} planned"
        for name, count in planned.items()
        if killed[name] < count
    ]
    if failed := len(killed["failures"]):
        problems.append(f"{failed} exposures failed: {killed['failures'][0]}")
    return problems


def unfinished(mission: Mission) -> int:
    """Exposures without a manifest."""
    return sum(not product_manifests.committed_keys(mission, n) for n in mission.numbers())


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.killed_workers", description=__doc__
    )
    parser.add_argument("folder", type=Path, help="folder of missions, new or to be continued")
    parser.add_argument("--exposures", type=int, default=500)
    parser.add_argument("--workers", type=int, default=8)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--scheduler-kills", type=int, default=2)
    parser.add_argument(
        "--rounds", type=int, choices=range(1, 100), default=3, metavar="N",
        help="runs in turn without kills",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--side", type=int, default=144, help="pixels of a frame's side")
    parser.add_argument(
        "--hold-s", type=float, default=float("inf"), help="seconds of this program"
    )
    options = parser.parse_args()
    random.seed(options.seed)
    options.folder.mkdir(parents=True, exist_ok=True)
    hold = Hold(options.folder, options.hold_s)
    flown_at = options.folder / "flown"

    def fly() -> dict[str, Any]:
        shutil.rmtree(flown_at, ignore_errors=True)
        mission = flown(flown_at, options.exposures, options.side)
        return {"path": str(mission.path)}

    pristine = Mission.open(Path(hold.once("flown", fly)["path"]))
    calm = without_kills(pristine, options.folder, options.rounds, options.workers, hold)
    print(json.dumps(calm), file=sys.stderr)
    plain = Mission.open(options.folder / "plain-0" / pristine.id)
    killed = with_kills(pristine, plain, options, hold)
    planned = {"worker_kills": options.kills, "scheduler_kills": options.scheduler_kills}
    output: dict[str, Any] = {
        "machine": machine(),
        "load": os.getloadavg()[0],
        "exposures": options.exposures,
        "workers": options.workers,
        "seed": options.seed,
        "without_kills": calm,
        "with_kills": killed,
        "problems": [*killed["problems"], *shortfalls(calm, killed, planned)],
    }
    print(json.dumps(output))
    if output["problems"]:
        sys.exit(1)


if __name__ == "__main__":
    main()

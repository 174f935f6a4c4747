"""`python -m benchmarks.killed_workers FOLDER`: a mission on a cluster whose parts are killed.

A mission of small exposures that differ in their bytes is processed by two plain processes without
faults. Then a copy is processed by worker processes of a dask cluster, while workers and the
scheduler are killed at random and calls of the store fail. This program starts the scheduler
again, as systemd would; `syntopic worker` starts its own processes again. At the end all
products are compared.
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
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

from benchmarks.counted_work import CountedWork
from daemon.cli.benchmark.measurement import machine
from daemon.cli.process import as_flown
from daemon.configuration.model import ProcessingSection
from daemon.mission.layout import Mission
from daemon.mission.store import product_manifests
from daemon.planning.overlaps import overlaps_of
from daemon.postflight.batch.batch_run import BatchOutcome, run_batch
from daemon.postflight.batch.cluster_address import ClusterAddress
from daemon.postflight.batch.dask_executor import DaskExecutor
from daemon.postflight.batch.executor import BatchExecutor
from daemon.postflight.batch.level2_work import Level2Work, survey
from daemon.postflight.batch.local_processes import LocalProcessExecutor
from daemon.postflight.batch.software_identity import software_identity
from processing.rig import load_rig
from tests.daemon.diverging_camera import flown_mission

PORT = 18_790
STORE_FAILURE_SHARE = 0.01


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
            elif victims := computing_children(self.worker_command):
                with suppress(ProcessLookupError):
                    os.kill(random.choice(victims), signal.SIGKILL)
                    self.done[what] += 1

    def end(self) -> None:
        self.is_ended.set()
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


def computed(
    mission: Mission, executor: BatchExecutor, attempts: Path, failure_share: float
) -> tuple[BatchOutcome, float]:
    """The outcome of a run, and its seconds from the first product to the last."""
    work = level2_work(mission)
    found = survey(
        work, mission, mission.numbers(), overlaps_of(mission, load_rig(mission.rig_path))
    )
    counted = CountedWork(work, attempts, failure_share)
    outcome = run_batch(executor, counted, found.pending)
    times = [path.stat().st_mtime for path in mission.path.glob("manifests/L2/*/*.provenance.json")]
    return outcome, max(times) - min(times)


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
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    random.seed(options.seed)
    options.folder.mkdir(parents=True)
    flown = flown_mission(options.folder / "flown", range(1, options.exposures + 1))
    copy = Mission.open(Path(shutil.copytree(flown.path, options.folder / "killed" / flown.id)))
    plain, plain_s = computed(
        flown, LocalProcessExecutor(2), options.folder / "plain.txt", failure_share=0.0
    )
    assert len(plain.results) == options.exposures, plain.failures
    url = f"tcp://127.0.0.1:{PORT}"
    command = [sys.executable, "-m", "daemon", "worker", url, "--processes", str(options.workers)]
    with (options.folder / "workers.txt").open("wb") as log:
        workers = subprocess.Popen(command, stdout=log, stderr=log)
    killer = Killer(workers.pid, options.kills, options.scheduler_kills, options.mean_s)
    killer.start()
    attempts = options.folder / "killed.txt"
    try:
        outcome, killed_s = computed(
            copy, DaskExecutor(ClusterAddress(url)), attempts, STORE_FAILURE_SHARE
        )
    finally:
        killer.end()
        workers.send_signal(signal.SIGINT)
        workers.wait(60)
    noted = counts_of(attempts)
    output: dict[str, Any] = {
        "machine": machine(),
        "exposures": options.exposures,
        "workers": options.workers,
        "worker_kills": killer.done["worker"],
        "scheduler_kills": killer.done["scheduler"],
        "seed": options.seed,
        "failures": [failure.as_json() for failure in outcome.failures],
        "counts": outcome.counts.as_json(),
        "begun": noted["computed"],
        "begun_again": noted["computed"] - options.exposures,
        "store_failures": noted["read failed"] + noted["write failed"],
        "recognized": noted["recognized"],
        "identical": compared(copy) == compared(flown),
        "two_processes_s": round(plain_s, 2),
        "cluster_s": round(killed_s, 2),
    }
    print(json.dumps(output))


if __name__ == "__main__":
    main()

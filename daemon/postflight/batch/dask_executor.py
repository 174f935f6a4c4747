"""Executor on a dask.distributed cluster that the user started.

The scheduler places tasks and remembers nothing that counts: products are committed by their
manifests. When it dies and is started again at the same address, by whoever supervises it, the
tasks that were in work are submitted again, and what was finished meanwhile is recognized.
"""

from __future__ import annotations

import logging
import pickle
import queue
import time
import uuid
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, Final

import dask
import distributed
from distributed.versions import VersionMismatchWarning

from daemon.mission.exposure_batch import cause_of
from daemon.postflight.batch.cluster_address import (
    ClusterAddress,
    certificate_problem,
    is_loopback,
)
from daemon.postflight.batch.cluster_checks import (
    ClusterError,
    check_memory,
    check_scheduler,
    check_versions,
    unsuitable_workers,
)
from daemon.postflight.batch.dask_losses import TASK_PREFIX, ReturnLostTasks
from daemon.postflight.batch.dask_tasks import WorkRefused, run_on_worker
from daemon.postflight.batch.executor import (
    BatchTask,
    BatchWork,
    DataAbsentError,
    TaskFailed,
    TaskLost,
    TaskOutcome,
    is_passing,
)
from daemon.postflight.batch.local_processes import OPEN_TIMEOUT_S
from daemon.postflight.batch.memory_kills import ClusterLosses

CONNECT_TIMEOUT_S: Final = 15.0
WORKERS_TIMEOUT_S: Final = 60.0
RECONNECT_TIMEOUT_S: Final = 120.0
"""How long a scheduler may be away before the run ends."""
AWAY_TIMEOUT_S: Final = 120.0
"""How long no worker may be there before the run ends."""
RESULT_TIMEOUT_S: Final = 60.0
QUEUED_FACTOR: Final = 2
"""Tasks submitted for each thread of a worker: one in work, one waiting next to it."""


def security_of(address: ClusterAddress, role: str) -> distributed.Security | None:
    """The TLS settings of one side; None without encryption.

    Args:
        address: of the scheduler.
        role: client or worker.
    """
    if not address.is_encrypted:
        return None
    files = {f"tls_{role}_cert": str(address.certificate), f"tls_{role}_key": str(address.key)}
    return distributed.Security(tls_ca_file=str(address.ca), require_encryption=True, **files)


class DaskExecutor:
    """Tasks on the workers of a scheduler, as many as they have threads for.

    Args:
        address: of the scheduler.
        announce: takes a sentence once the cluster is ready.
        reconnect_timeout_s: how long it may be away before the run ends.
        away_timeout_s: how long no worker may be there before the run ends.
    """

    def __init__(
        self,
        address: ClusterAddress,
        *,
        announce: Callable[[str], None] = lambda _sentence: None,
        reconnect_timeout_s: float = RECONNECT_TIMEOUT_S,
        away_timeout_s: float = AWAY_TIMEOUT_S,
    ) -> None:
        self._address, self._reconnect_timeout_s = address, reconnect_timeout_s
        self._announce, self._away_timeout_s = announce, away_timeout_s
        self._run = uuid.uuid4().hex[:12]
        self._client: distributed.Client | None = None
        self._work = b""
        self._futures: dict[int, distributed.Future] = {}
        self._ended: queue.SimpleQueue[tuple[int, distributed.Future]] = queue.SimpleQueue()
        self._unsent: list[TaskOutcome] = []
        self._submitted = 0
        self._capacity, self._counted_s = 1, 0.0
        self._is_registration_due = False
        self._workers, self._threads, self._workers_seen_s = 0, 0, 0.0
        self._task_nbytes = 0
        self._suitable: dict[str, str] = {}  # what is wrong with a worker, by address
        self._restricted: dict[int, frozenset[str]] = {}
        self._losses = ClusterLosses()
        self.dashboard = ""

    @property
    def capacity(self) -> int:
        if time.monotonic() - self._counted_s > 1.0 and self._is_connected():
            self._count_threads()
        return self._capacity

    @property
    def description(self) -> str:
        count = f", {self._workers} workers" if self._workers else ""
        return f"cluster at {self._address.url}{count}"

    def start(self, work: BatchWork) -> None:
        """Connect, check versions and memory, and open the work on one worker.

        Raises:
            ClusterError: no scheduler, no worker, other versions, or too little memory.
            Exception: what `BatchWork.open` raised on a worker.
        """
        self._work = pickle.dumps(work)
        client = self._connect(CONNECT_TIMEOUT_S)
        self.dashboard = _dashboard_of(client, self._address)
        check_versions(client)
        try:
            client.wait_for_workers(1, timeout=WORKERS_TIMEOUT_S)
        except TimeoutError as error:
            raise ClusterError(
                f"no worker joined {self._address.url} within {WORKERS_TIMEOUT_S:.0f} s. "
                f"Run: syntopic worker {self._address.url}"
            ) from error
        check_versions(client)
        check_memory(client, work)
        self._task_nbytes = work.memory_nbytes
        self._suitable = dict.fromkeys(client.nthreads(), "")
        self._losses.note(client, self._suitable)
        client.register_plugin(ReturnLostTasks())
        self._workers_seen_s = time.monotonic()
        self._open(client)
        self._count_threads()
        dashboard = f"dashboard {self.dashboard}" if self.dashboard else "no dashboard"
        self._announce(f"{self.description}, {self._threads} threads; {dashboard}")

    def _open(self, client: distributed.Client) -> None:
        """Open the work on one worker before all others, so that kernels are compiled once.

        A worker that does not have the data is set aside, as long as others are there.

        Raises:
            ClusterError: workers died, or have other code.
            Exception: what `BatchWork.open` raised on a worker.
        """
        while True:
            opening: Any = client.submit(
                run_on_worker, self._work, None, pure=False, workers=self._permitted()
            )
            try:
                refused = opening.result(timeout=OPEN_TIMEOUT_S)
            except distributed.KilledWorker as error:
                raise ClusterError(
                    f"workers of {self._address.url} died while they loaded the work; the last one "
                    f"is {error.last_worker}. See its messages; the kernel may have ended it for "
                    "memory"
                ) from error
            except (ImportError, AttributeError, RuntimeError, TimeoutError) as error:
                raise ClusterError(
                    f"the cluster cannot load the code of this command ({error}). Install the same "
                    "version of syntopic[cluster] on all machines, and start workers with: "
                    "syntopic worker"
                ) from error
            if not isinstance(refused, WorkRefused):
                return
            if isinstance(refused.error, DataAbsentError) and refused.worker:
                self._set_aside(refused.worker, f"{refused.error}")
                if self._permitted():
                    continue
            raise refused.error

    def submit(self, task: BatchTask) -> None:
        if self._client is None or not self._is_connected():
            self._unsent.append(TaskLost(task.number, "scheduler", "the scheduler died"))
            return
        if self._is_registration_due:
            with suppress(OSError, TimeoutError):
                self._client.register_plugin(ReturnLostTasks())
                self._is_registration_due = False
        permitted = self._permitted()
        if permitted == []:
            self._unsent.append(TaskLost(task.number, "scheduler", "every worker was set aside"))
            return
        self._submitted += 1
        self._restricted[task.number] = frozenset(permitted or ())
        future = self._client.submit(
            run_on_worker,
            self._work,
            task,
            # Runs of one scheduler share its names; a task of another run is another task.
            key=f"{TASK_PREFIX}-{task.number}-{self._run}-{self._submitted}",
            pure=False,
            workers=permitted,
        )
        self._futures[task.number] = future
        future.add_done_callback(lambda ended: self._ended.put((task.number, ended)))

    def wait(self, timeout_s: float) -> list[TaskOutcome]:
        if not self._is_connected():
            self._unsent += self._reconnect()
        if self._unsent:
            unsent, self._unsent = self._unsent, []
            return unsent
        self._refuse_absent_workers()
        limit_s = time.monotonic() + timeout_s
        found: list[TaskOutcome] = []
        while not found and self._is_connected():
            try:
                ended = self._ended.get(timeout=max(0.0, min(0.5, limit_s - time.monotonic())))
            except queue.Empty:
                found += [*self._missed(), *self._decided()]
                if time.monotonic() >= limit_s:
                    break
                continue
            found += self._outcome(*ended)
            while not self._ended.empty():
                found += self._outcome(*self._ended.get())
            found += self._decided()
        return found

    def _decided(self) -> list[TaskOutcome]:
        """Losses whose cause is known."""
        client = self._client
        return [] if client is None else [*self._losses.decided(client, self._suitable)]

    def close(self, timeout_s: float) -> list[TaskOutcome]:
        found: list[TaskOutcome] = []
        limit_s = time.monotonic() + timeout_s
        if self._client is None:
            return found
        try:
            if self._is_connected():
                waiting = _not_begun(self._client, self._futures)
                self._client.cancel([self._futures.pop(number) for number in waiting])
            while self._futures and self._is_connected() and time.monotonic() < limit_s:
                found += self.wait(0.5)
        finally:
            self._drop_client()
        return found

    def _missed(self) -> list[TaskOutcome]:
        """Outcomes that no callback reported: the client reconnected by itself meanwhile."""
        ended = [(number, f) for number, f in self._futures.items() if f.status != "pending"]
        return [outcome for number, future in ended for outcome in self._outcome(number, future)]

    def _outcome(self, number: int, future: Any) -> list[TaskOutcome]:
        if number not in self._futures or self._futures[number] is not future:
            return []  # of a scheduler that is gone
        try:
            outcome: Any = future.result(timeout=RESULT_TIMEOUT_S)
        except distributed.KilledWorker as error:
            del self._futures[number]
            worker = str(getattr(error.last_worker, "address", error.last_worker))
            self._losses.add(
                TaskLost(number, "killed", f"its process was killed ({worker})", worker)
            )
            return []
        except (distributed.CancelledError, TimeoutError, OSError):
            del self._futures[number]
            self._is_registration_due = True  # it may be another scheduler at the same address
            return [TaskLost(number, "scheduler", "the scheduler lost it")]
        except Exception as error:  # noqa: BLE001 - it is the outcome of this task
            del self._futures[number]
            return [TaskFailed(number, error)]
        del self._futures[number]
        if isinstance(outcome, WorkRefused):
            return [self._refused(number, outcome)]
        return [outcome]

    def _refused(self, number: int, refused: WorkRefused) -> TaskOutcome:
        """A worker that joined later could not load the work.

        What passes is tried again as a failure of the task; any other worker is set aside.

        Raises:
            ClusterError: it is not known which worker it was.
        """
        cause = cause_of(refused.error)
        if is_passing(refused.error):
            return TaskFailed(number, refused.error)
        if not refused.worker:
            raise ClusterError(f"a worker cannot load the work: {cause}")
        self._set_aside(refused.worker, f"worker {refused.worker} cannot load the work: {cause}")
        return TaskLost(number, "scheduler", cause)

    def _set_aside(self, worker: str, problem: str) -> None:
        if not self._suitable.get(worker):
            self._announce(f"{problem} It gets no exposures of this run.")
        self._suitable[worker] = problem
        self._counted_s = 0.0

    def _permitted(self) -> list[str] | None:
        """The workers that may compute; None for all, where no worker was set aside."""
        if not any(self._suitable.values()):
            return None
        return [worker for worker, problem in self._suitable.items() if not problem]

    def _check_joined(self, present: Mapping[str, int]) -> None:
        """Check workers that joined; return tasks that no present worker may compute.

        Raises:
            OSError, TimeoutError: the scheduler does not answer.
        """
        if self._client is None or not self._task_nbytes:
            return
        for gone in self._suitable.keys() - present.keys():
            del self._suitable[gone]
        joined = present.keys() - self._suitable.keys()
        if joined:
            for worker, problem in unsuitable_workers(
                self._client, joined, self._task_nbytes
            ).items():
                if problem:
                    self._set_aside(worker, problem)
                else:
                    self._suitable[worker] = ""
            self._losses.note(self._client, joined)
        for number, future in list(self._futures.items()):
            restricted = self._restricted.get(number)
            if restricted and not restricted & present.keys() and future.status == "pending":
                self._client.cancel([self._futures.pop(number)])
                self._unsent.append(TaskLost(number, "scheduler", "its workers left"))

    def _reconnect(self) -> list[TaskOutcome]:
        """A new connection after the scheduler died; tasks in work are submitted again."""
        lost: list[TaskOutcome] = [
            TaskLost(number, "scheduler", "the scheduler died") for number in self._futures
        ]
        self._drop_client()
        limit_s = time.monotonic() + self._reconnect_timeout_s
        while True:
            try:
                client = self._connect(min(5.0, self._reconnect_timeout_s))
                client.wait_for_workers(1, timeout=max(1.0, limit_s - time.monotonic()))
                check_scheduler(client)
                client.register_plugin(ReturnLostTasks())
                self._workers_seen_s = time.monotonic()
                self._count_threads()
            except (ClusterError, TimeoutError, OSError) as error:
                self._drop_client()
                if time.monotonic() < limit_s:
                    time.sleep(0.5)
                    continue
                raise ClusterError(
                    f"the scheduler at {self._address.url} did not come back within "
                    f"{self._reconnect_timeout_s:.0f} s. Start it and its workers, and run the "
                    "same command again; complete exposures are not computed again"
                ) from error
            return lost

    def _connect(self, timeout_s: float) -> distributed.Client:
        # The client reports a lost scheduler by many messages; this executor reports it once.
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        with (
            dask.config.set({"distributed.comm.timeouts.connect": timeout_s}),
            warnings.catch_warnings(),
        ):
            # Versions are compared by `_check_versions`, in one sentence.
            warnings.simplefilter("ignore", VersionMismatchWarning)
            try:
                self._client = distributed.Client(
                    self._address.url,
                    security=security_of(self._address, "client"),
                    timeout=timeout_s,
                    set_as_default=False,
                    heartbeat_interval="2s",
                )
            except (OSError, TimeoutError) as error:
                if problem := certificate_problem(self._address):
                    raise ClusterError(problem) from error
                raise ClusterError(
                    f"no scheduler answers at {self._address.url}. "
                    f"Start one: dask scheduler --host 127.0.0.1 --dashboard-address 127.0.0.1:8787"
                ) from error
        return self._client

    def _drop_client(self) -> None:
        client, self._client = self._client, None
        self._futures.clear()
        if client is not None:
            client.close(timeout=2.0)

    def _is_connected(self) -> bool:
        return self._client is not None and self._client.status == "running"

    def _count_threads(self) -> None:
        self._counted_s = time.monotonic()
        if self._client is not None:
            try:
                present = dict(self._client.nthreads())
                self._check_joined(present)
            except (OSError, TimeoutError):
                return
            threads = [n for name, n in present.items() if not self._suitable.get(name)]
            self._threads = sum(threads)
            self._capacity = QUEUED_FACTOR * self._threads
            if threads:
                self._workers, self._workers_seen_s = len(threads), time.monotonic()

    def _refuse_absent_workers(self) -> None:
        """End the run where the scheduler answers and no worker has been there for long.

        Raises:
            ClusterError: no worker for the time allowed.
        """
        if time.monotonic() - self._counted_s > 1.0:
            self._count_threads()
        if self._threads or time.monotonic() - self._workers_seen_s < self._away_timeout_s:
            return
        aside = "".join(f". {problem}" for problem in self._suitable.values() if problem)
        raise ClusterError(
            f"all workers left {self._address.url}; none came back within "
            f"{self._away_timeout_s:.0f} s, with {len(self._futures)} exposures in work{aside}. "
            f"Run: syntopic worker {self._address.url}, and run the same command again; complete "
            "exposures are not computed again"
        )


def _dashboard_of(client: distributed.Client, address: ClusterAddress) -> str:
    link = str(client.dashboard_link or "")
    host = link.partition("://")[2].partition(":")[0]
    if link and not address.is_loopback and not is_loopback(host):
        return (
            f"{link} (open to the network: give dask scheduler --dashboard-address 127.0.0.1:8787)"
        )
    return link


def _not_begun(client: distributed.Client, futures: dict[int, distributed.Future]) -> list[int]:
    """Numbers whose task no worker has in work."""
    try:
        begun = {key for keys in client.processing().values() for key in keys}
    except (OSError, TimeoutError):
        return []
    threads = sum(client.nthreads().values())
    ordered = sorted(futures, key=lambda number: futures[number].key not in begun)
    return ordered[threads:]

"""The onboard service for benchmarks: it reports its processes, and runs with or without a worker.

Without, capture, ledger and Level-0 are as they fly, and there is no pipeline.
"""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.onboard.pipeline.pipeline_queue import Messages, PipelineQueue
from daemon.onboard.preflight.service_file import load
from daemon.onboard.service import service
from daemon.onboard.service.messages import Ping, Pong, Stop, WorkerBuilt
from daemon.onboard.service.processes import ServiceConnection
from daemon.onboard.service.startup import ProcessPlan, worker_process


class ReportingService(service.Service):
    """The service as in flight; it also reports the ids of its processes."""

    def _start(self, mission: Mission) -> None:
        super()._start(mission)
        children = self.supervisor._children.items()
        self._event("processes", pids={name: child.process.pid for name, child in children})


class NoPipeline(PipelineQueue):
    """Hands memory back as soon as an exposure is stored and sealed."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.is_ready = True

    def sealed(self, exposure: Exposure) -> Messages:
        """See `PipelineQueue.sealed`."""
        return self.finished(exposure.number)


def idle_worker(link: ServiceConnection, _settings: Any, _rings: Any) -> None:
    """In the place of `daemon.onboard.pipeline.worker.main`: it makes no image."""
    link.send(WorkerBuilt())
    while not isinstance(order := link.receive(timeout_s=1.0), Stop):
        if isinstance(order, Ping):
            link.send(Pong({}))


def _idle_worker(*arguments: Any) -> ProcessPlan:
    return worker_process(*arguments)._replace(target="benchmarks.capture_service:idle_worker")


def _print_event(event: Mapping[str, Any]) -> None:
    sys.stdout.write(json.dumps(event) + "\n")
    sys.stdout.flush()


def main() -> None:
    """`python -m benchmarks.capture_service service.toml [--pipeline]`: events, one a line."""
    path = Path(sys.argv[1])
    configuration, rig = load(path)
    flown = ReportingService(configuration, rig, path, _print_event)
    if "--pipeline" not in sys.argv[2:]:
        vars(service)["worker_process"] = _idle_worker
        vars(service)["PipelineQueue"] = NoPipeline
    sys.exit(asyncio.run(flown.run()))


if __name__ == "__main__":
    main()

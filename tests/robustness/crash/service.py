"""The onboard service with a pipeline that stands aside.

Run: `python -m tests.robustness.crash.service CONFIG`.

Service, capture, writer and drivers are those that fly. The worker reports at once that it is ready
and makes no image, so that a service that is killed every other second is in the air in between.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import typer

from daemon.cli.run import run
from daemon.onboard.service import service, startup
from daemon.onboard.service.messages import (
    BeginProcessing,
    FramesRead,
    Ping,
    Pong,
    Process,
    ProcessFailed,
    Stop,
    WorkerBuilt,
    WorkerReady,
)
from daemon.onboard.service.processes import ServiceConnection


def idle_worker(link: ServiceConnection, _settings: Any, _rings: Any) -> None:
    """In the place of `daemon.onboard.pipeline.worker.main`."""
    link.send(WorkerBuilt())
    while not isinstance(order := link.receive(timeout_s=1.0), Stop):
        if isinstance(order, Ping):
            link.send(Pong({}))
        elif isinstance(order, BeginProcessing):
            link.send(WorkerReady(0.0))
        elif isinstance(order, Process):
            number = order.exposure.number
            link.send(FramesRead(number))
            link.send(ProcessFailed(number, f"exposure {number}: no pipeline flies here"))


def _with_idle_worker(*arguments: Any) -> startup.ProcessPlan:
    plan = startup.worker_process(*arguments)
    return plan._replace(target="tests.robustness.crash.service:idle_worker")


if __name__ == "__main__":
    vars(service)["worker_process"] = _with_idle_worker
    try:
        run(Path(sys.argv[1]), json_lines=True)
    except typer.Exit as ended:
        sys.exit(ended.exit_code)

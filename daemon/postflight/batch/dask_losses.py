"""Part of the scheduler: a task of ours whose worker died is returned, not placed again.

A scheduler places a task again until `allowed-failures` + 1 workers died of it, which the command
would not know of. The command decides what is tried again (`daemon.postflight.batch.batch_run`),
so a task of its own is returned after the first one. Tasks of others on the same scheduler are as
they were.
"""

from __future__ import annotations

from typing import Any, ClassVar, Final

from distributed.diagnostics.plugin import SchedulerPlugin

TASK_PREFIX: Final = "syntopic-exposure"


class ReturnLostTasks(SchedulerPlugin):  # type: ignore[misc]  # distributed has no types
    """Counts earlier deaths for each task of ours, as many as the scheduler allows."""

    name: ClassVar = "syntopic-return-lost-tasks"
    idempotent: ClassVar = True

    def update_graph(self, scheduler: Any, *, tasks: list[Any], **_rest: Any) -> None:
        for key in tasks:
            if isinstance(key, str) and key.startswith(f"{TASK_PREFIX}-"):
                task = scheduler.tasks.get(key)
                if task is not None:
                    task.suspicious = max(task.suspicious, scheduler.allowed_failures)

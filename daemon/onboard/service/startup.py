"""Startup of a flight: its mission folder and its processes.

These functions only describe; `daemon.onboard.service.service` starts the processes.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from daemon.configuration.model import Configuration
from daemon.mission.layout import Mission
from daemon.onboard.capture.devices import device_specs, frame_nbytes
from daemon.onboard.capture.frame_ring import FrameRing
from daemon.onboard.capture.link_settings import paced_specs
from daemon.onboard.service.messages import WorkerSettings
from daemon.onboard.storage.writer import MirrorPlan
from daemon.products.processing_threads import thread_counts
from processing.rig import Rig, shipped_rigs


class ProcessPlan(NamedTuple):
    """A process of the service, as `Supervisor.spawn` takes it."""

    name: str
    target: str
    arguments: tuple[Any, ...]
    environment: Mapping[str, str]


def create_mission(
    configuration: Configuration, rig: Rig, config_path: Path, root: Path | None = None
) -> Mission:
    """A new mission, with copies of what it is flown by; below `root` where that is given.

    Raises:
        OSError: the disk refused.
    """
    rig_path = shipped_rigs().get(configuration.mission.rig, Path(configuration.mission.rig))
    plan_file = configuration.plan.file
    return Mission.create(
        root or configuration.mission.root,
        rig.name,
        rig_toml=rig_path.read_bytes(),
        service_toml=config_path.read_bytes(),
        plan=None if plan_file is None else (plan_file.suffix.lower(), plan_file.read_bytes()),
        started_utc=datetime.now(UTC),
        simulated=configuration.mission.simulated,
    )


def frame_rings(configuration: Configuration, rig: Rig) -> tuple[FrameRing, ...]:
    """The frame memory of every head, that the processes share."""
    return tuple(
        FrameRing.create(
            head.sensor, configuration.limits.exposures_in_memory, frame_nbytes(rig, head.sensor)
        )
        for head in configuration.head
    )


def worker_process(
    configuration: Configuration, mission: Mission | None, rings: tuple[FrameRing, ...]
) -> ProcessPlan:
    """The pipeline worker, with rig and plan of the mission, or as configured before there is one.

    It reports whether the pipeline can be built, and waits for `BeginProcessing`.
    """
    plan_file = configuration.plan.file if mission is None else mission.plan_path
    worker = WorkerSettings(
        rig=configuration.mission.rig if mission is None else str(mission.rig_path),
        radiometry=configuration.mission.radiometry,
        plan_file=plan_file,
        plan=configuration.plan,
        processing=configuration.processing,
    )
    many = thread_counts(configuration.processing.threads)
    return ProcessPlan("worker", "daemon.onboard.pipeline.worker:main", (worker, rings), many)


def capture_process(
    configuration: Configuration, rig: Rig, rings: tuple[FrameRing, ...]
) -> ProcessPlan:
    """The process of the devices."""
    specs = paced_specs(device_specs(configuration, rig), configuration, rig)
    return ProcessPlan(
        "capture", "daemon.onboard.capture.capture:main", (specs, rings), thread_counts(1)
    )


def writer_process(
    mission: Mission, rings: tuple[FrameRing, ...], mirror: MirrorPlan | None = None
) -> ProcessPlan:
    """The process of the disk, or of both disks of a mirrored mission."""
    arguments = (mission.path, rings, mirror)
    return ProcessPlan("writer", "daemon.onboard.storage.writer:main", arguments, thread_counts(1))


def watch_process(configuration: Configuration) -> ProcessPlan | None:
    """The process that serves page and API, if it is configured."""
    if configuration.watch is None:
        return None
    one = thread_counts(1)
    return ProcessPlan(
        "watch",
        "daemon.onboard.monitoring.monitoring_process:main",
        (configuration.watch, configuration.plan),
        one,
    )

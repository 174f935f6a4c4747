"""Messages between the service and its child processes: small frozen dataclasses.

Pixels are never sent; a frame is identified by its slot in the shared memory of its head. This
module has only light imports, so that every process can load it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from daemon.configuration.model import PlanSection, ProcessingSection
from daemon.mission.exposure import CaptureRecord, Exposure, FrameRecord
from daemon.mission.log.log_records import Message
from daemon.mission.store.disk_identity import Disk
from drivers.contract import TriggerPulse
from processing.radiometry.exposure_control import ExposureSettings


class EmitEvent(Protocol):
    """Emits an event: its kind and its content."""

    def __call__(self, event: str, **content: Any) -> None: ...


# To any child


@dataclass(frozen=True)
class Stop:
    """Release all resources and end."""


@dataclass(frozen=True)
class Ping:
    """Liveness request."""


# From any child


@dataclass(frozen=True)
class Pong:
    """Answer to `Ping`, with statistics by device."""

    statistics: Mapping[str, Mapping[str, int]]


# To and from watch


@dataclass(frozen=True)
class ServiceEvent:
    """Something happened: plain JSON types with a key "event"."""

    event: Mapping[str, Any]


@dataclass(frozen=True)
class ServiceCommand:
    """A command to the service; `by` is its author according to the token."""

    number: int
    name: str
    arguments: Mapping[str, Any]
    by: str
    role: str = ""
    address: str = ""


@dataclass(frozen=True)
class CommandRefused:
    """Commands that the watch process did not pass on, for the audit log.

    `count` is above 1 where several attempts share one entry.
    """

    name: str
    by: str
    role: str
    address: str
    sentence: str
    count: int = 1


@dataclass(frozen=True)
class InvalidMessages:
    """Invalid data from the page's process: count and problem."""

    count: int
    sentence: str


@dataclass(frozen=True)
class Answer:
    """Result of a command."""

    number: int
    done: bool
    sentence: str


# To capture


@dataclass(frozen=True)
class DeviceSpec:
    """A device to be opened: its kind, driver, name, and the settings of that driver.

    `output` is the trigger's output that a head is wired to, its cone.
    """

    kind: str
    driver: str
    name: str
    settings: Mapping[str, Any]
    output: str = ""


@dataclass(frozen=True)
class Fire:
    """Give pulse `sequence`, each output delayed from the same moment."""

    sequence: int
    delays_ns: Mapping[str, int]


@dataclass(frozen=True)
class ApplyExposureSettings:
    """Settings from the next pulse on, by head."""

    settings: Mapping[str, ExposureSettings]


@dataclass(frozen=True)
class Recycle:
    """Slots that may be reused, by head."""

    slots: Mapping[str, int]


# From capture; besides these it passes on every record of `drivers.contract`


@dataclass(frozen=True)
class Bound:
    """A device answered; `found` are the properties it reported (model, serial, ...)."""

    kind: str
    name: str
    found: Mapping[str, str]


@dataclass(frozen=True)
class BindFailed:
    """A device did not answer; opening it is retried."""

    kind: str
    name: str
    sentence: str


@dataclass(frozen=True)
class Fired:
    """The answer to `Fire`; `pulse` is None where none was given."""

    sequence: int
    pulse: TriggerPulse | None
    sentence: str


# To the writer


@dataclass(frozen=True)
class Store:
    """Make an exposure's frames durable; by head, the slots they lie in."""

    capture: CaptureRecord
    slots: Mapping[str, int]


@dataclass(frozen=True)
class Seal:
    """Write the final record of a stored exposure."""

    exposure: Exposure


@dataclass(frozen=True)
class AppendToLog:
    """Append a message to the flight log; with `is_durable` it is on the disk at once."""

    message: Message
    is_durable: bool = False


@dataclass(frozen=True)
class IndexProducts:
    """Note in the index that an exposure has products: file name to size in bytes."""

    number: int
    files: Mapping[str, int]
    verdict: str | None


@dataclass(frozen=True)
class WriteSmallFile:
    """Put a small file under a name below the root of every disk in use."""

    name: str
    data: bytes


@dataclass(frozen=True)
class EndMission:
    """The mission is complete: it is not resumed after `Stop`."""


@dataclass(frozen=True)
class DropDisk:
    """Drop this disk if another is in use; `why` is the reason."""

    disk: str
    why: str


@dataclass(frozen=True)
class ReleaseDisk:
    """Close everything on this disk, so that it can be unmounted."""

    disk: str


@dataclass(frozen=True)
class AcceptDisk:
    """Use whatever disk is at the place of this one, once it is up to date."""

    disk: str


# From the writer


@dataclass(frozen=True)
class DiskChanged:
    """A disk was dropped, was released or has joined; `in_use` are those in use from now on.

    `name` is the event's, `dropped_count` counts the faults of this run.
    """

    name: str
    disk: Disk
    sentence: str
    in_use: tuple[Disk, ...]
    dropped_count: int


@dataclass(frozen=True)
class DiskStatus:
    """How each disk is: plain JSON types."""

    disks: tuple[Mapping[str, Any], ...]


@dataclass(frozen=True)
class Stored:
    """The pixels are durable; `frames` now carry file and hash.

    `disks` are the ids of the disks that have them, empty where the mission has one disk.
    """

    number: int
    frames: tuple[FrameRecord, ...]
    duration_s: float
    disks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Sealed:
    """The record is durable."""

    number: int
    sha256: str


@dataclass(frozen=True)
class WriteFailed:
    """The disk refused; the exposure is not stored or not sealed.

    `is_transient`: the request is valid and may be retried when the disk has recovered.
    """

    number: int
    sentence: str
    is_transient: bool = False


# To the worker


@dataclass(frozen=True)
class WorkerSettings:
    """What a pipeline worker needs to know before there is a mission.

    `plan_file` is the flight plan whose requirements exposures are evaluated against.
    """

    rig: str
    radiometry: Path | None
    plan_file: Path | None
    plan: PlanSection
    processing: ProcessingSection


@dataclass(frozen=True)
class BeginProcessing:
    """Load the kernels, then process for this mission; for none where only that is tried."""

    mission: Path | None


@dataclass(frozen=True)
class UseMission:
    """Read and write the mission in this folder from now on: another disk is the leading one."""

    mission: Path


@dataclass(frozen=True)
class Process:
    """Process this exposure; `slots` by head, or None to read Level-0.

    While it is not sealed, its verdict may be sent, but no product is published;
    `RecordFinalized` follows.
    """

    exposure: Exposure
    slots: Mapping[str, int] | None
    is_sealed: bool = True


@dataclass(frozen=True)
class RecordFinalized:
    """The record of an exposure that was begun unsealed is final.

    Its products are published if the record is confirmed, and dropped if it is another one or none.
    """

    number: int
    is_confirmed: bool


# From the worker


@dataclass(frozen=True)
class WorkerBuilt:
    """The pipeline is built and its calibrations are read; it waits for `BeginProcessing`."""


@dataclass(frozen=True)
class WorkerRefused:
    """No pipeline can be built; the sentence states cause and action. The process ends."""

    sentence: str


@dataclass(frozen=True)
class WorkerReady:
    """Kernels are compiled and loaded; nothing compiles from here on."""

    warm_up_s: float


@dataclass(frozen=True)
class FramesRead:
    """The frames of this exposure are no longer needed in memory; it is still being processed."""

    number: int


@dataclass(frozen=True)
class ProductsStaged:
    """The products of an unsealed exposure wait on disk for `RecordFinalized`.

    The processor is free.
    """

    number: int


@dataclass(frozen=True)
class VerdictReady:
    """The verdict is known, its products are not written yet; `report` as in `Processed`."""

    number: int
    report: Mapping[str, Any]


@dataclass(frozen=True)
class Processed:
    """Products are written; `report` is the content of quality.json.

    `histograms` are counts of raw DN by sensor, as in histogram.json.
    """

    number: int
    report: Mapping[str, Any]
    files: Mapping[str, int]
    duration_s: float
    histograms: Mapping[str, tuple[int, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class ProcessFailed:
    """This exposure has no product; the sentence states cause and action.

    `report` is a quality report all the same, with the flag NOT_PROCESSED.
    """

    number: int
    sentence: str
    report: Mapping[str, Any] = field(default_factory=dict)


# To the triangulation


@dataclass(frozen=True)
class TriangulateExposure:
    """Take in this exposure, which has a sealed record and products."""

    number: int


@dataclass(frozen=True)
class FinishTriangulation:
    """No more exposures come: adjust the block and write its files."""


# From the triangulation


@dataclass(frozen=True)
class TriangulationFinished:
    """The answer to `FinishTriangulation`; `is_written`: the files are complete."""

    seconds: float
    is_written: bool

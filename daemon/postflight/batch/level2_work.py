"""The work of `syntopic process`: Level-2 of one exposure, committed by its manifest."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from daemon import DaemonError
from daemon.configuration.model import PlanSection, ProcessingSection
from daemon.mission.canonical_json import sha256_hex
from daemon.mission.exposure_batch import ExposureFailure
from daemon.mission.layout import Mission
from daemon.mission.store import level2, product_manifests, store
from daemon.orientation.exterior_orientation import mount_of
from daemon.orientation.ground_model import ground_of
from daemon.planning.overlaps import Overlaps, OverlapShares
from daemon.postflight.batch.batch_run import BatchOutcome
from daemon.postflight.batch.capacity import exposure_nbytes
from daemon.postflight.batch.executor import BatchTask, DataAbsentError
from daemon.postflight.batch.product_key import (
    frame_nbytes,
    input_identity,
    product_key,
    tree_sha256,
)
from daemon.postflight.batch.software_identity import software_identity
from daemon.products.band_images import radiance_folder
from daemon.products.exposure_products import (
    ExposureProducts,
    FlightGeometry,
    make_products,
)
from daemon.products.processor import Processor, processor_for
from daemon.products.shared_maps import share_maps
from processing.image.accelerator.devices import with_same_pixels
from processing.rig import Rig, load_rig


class VersionMismatchError(DaemonError):
    """A worker would compute other bytes than the command expects."""


class InputsChangedError(DaemonError):
    """An exposure was changed after the run began."""


@dataclass(frozen=True)
class Level2Payload:
    """Key of the products, empty where the inputs cannot be read, and overlaps of the exposure."""

    key: str
    overlap_shares: OverlapShares


@dataclass(frozen=True)
class Level2Work:
    """What all exposures of a run have in common; it can be pickled.

    `identity` is `software_identity` of the command: a worker with another one refuses the work.
    `folder_inode` is that of the folder where the command has it; None for no comparison.
    `threads` is of one process and takes the place of that of `processing`. `shares_maps`: the
    processes of one machine have one copy of the calibration maps.
    """

    mission: Path
    rig_file: Path | None
    processing: ProcessingSection
    plan: PlanSection
    radiometry: Path | None
    identity: Mapping[str, str]
    recomputes: bool = False
    threads: int = 1
    shares_maps: bool = False
    folder_inode: int | None = None

    @property
    def memory_nbytes(self) -> int:
        return exposure_nbytes(self.rig)

    @property
    def rig(self) -> Rig:
        return load_rig(self.rig_file or Mission(self.mission, self.mission.name).rig_path)

    def open(self) -> Level2Action:
        """Build the processor and load its kernels.

        Raises:
            DataAbsentError: this machine does not have the folder of the command.
            VersionMismatchError: code, libraries or CPU differ from those of the command.
            CalibrationError, ValueError: a calibration does not fit the rig.
        """
        if differences := identity_differences(self.identity, software_identity()):
            raise VersionMismatchError(
                f"worker on {socket.gethostname()} has {differences}. Install the same versions "
                "on all machines and use one CPU family; otherwise the bytes of products differ"
            )
        check_same_folder(self.mission, self.folder_inode)
        mission = Mission.open(self.mission, checks_subfolders=False)
        rig = load_rig(self.rig_file or mission.rig_path)
        device = with_same_pixels(self.processing.device)
        updated = {"threads": self.threads, "device": device}
        processing = self.processing.model_copy(update=updated)
        processor = processor_for(rig, mission, processing, self.radiometry)
        if self.shares_maps:
            share_maps(processor.pipeline.correctors)
        processor.warm_up()
        mount, _ = mount_of(mission)
        geometry = FlightGeometry(mount, self.plan, ground_of(rig, mount, self.plan))
        return Level2Action(self, mission, processor, geometry, self.common)

    @cached_property
    def common(self) -> dict[str, Any]:
        """The part of the key that all exposures of a run share."""
        mission = Mission(self.mission, self.mission.name)
        mount, _ = mount_of(mission)
        settings = self.processing.model_dump(mode="json", exclude={"threads"})
        settings.pop("parallel_exposures", None)
        return {
            "product": "L2",
            "software": dict(self.identity),
            "rig": sha256_hex((self.rig_file or mission.rig_path).read_bytes()),
            "checks_calibration": self.rig_file is None,
            "processing": settings,
            "mount": mount.model_dump(mode="json"),
            "plan": self.plan.model_dump(mode="json", exclude={"elevation"}),
            "elevation": tree_sha256(self.plan.elevation),
            "flight_plan": tree_sha256(mission.plan_path),
            "radiometry": tree_sha256(self.radiometry or radiance_folder(mission)),
        }


class Level2Action:
    """Computes, publishes and commits the products of one exposure at a time."""

    def __init__(
        self,
        work: Level2Work,
        mission: Mission,
        processor: Processor,
        geometry: FlightGeometry,
        common: Mapping[str, Any],
    ) -> None:
        self._work, self._mission, self._geometry = work, mission, geometry
        self._processor, self._common = processor, common
        self._calibration_sha256 = (
            "" if work.rig_file else sha256_hex(mission.rig_path.read_bytes())
        )

    @property
    def recomputes(self) -> bool:
        """Whether complete products are computed again."""
        return self._work.recomputes

    def clone(self) -> Level2Action:
        """Another action with separate buffers and shared calibrations."""
        return Level2Action(
            self._work, self._mission, self._processor.clone(), self._geometry, self._common
        )

    def __call__(self, task: BatchTask) -> dict[str, Any]:
        """The content of quality.json and the duration of the computation.

        Raises:
            ClaimedElsewhereError: another process computes this exposure now.
            InputsChangedError: the inputs are not those the key was computed from.
            Exception: the exposure cannot be processed.
        """
        payload: Level2Payload = task.payload
        number, mission = task.number, self._mission
        with product_manifests.claimed(mission, number):
            if not self._work.recomputes and product_manifests.is_complete(
                mission, number, payload.key
            ):
                return report_of(mission, number, payload.key)
            return self._compute(number, payload)

    def _compute(self, number: int, payload: Level2Payload) -> dict[str, Any]:
        started = time.monotonic()
        key, products = self.make(number, payload)
        manifest = product_manifests.publish(self._mission, number, key, products.contents)
        duration_s = round(time.monotonic() - started, 3)
        product_manifests.commit(self._mission, number, manifest, self.provenance(key, duration_s))
        return {**products.report, "duration_s": duration_s}

    def make(
        self,
        number: int,
        payload: Level2Payload,
        *,
        read: Callable[[Path], bytes] = Path.read_bytes,
        hash_of: Callable[[Path], str] = store.hash_file,
    ) -> tuple[str, ExposureProducts]:
        """Compute the products of one exposure and their key.

        Args:
            number: of the exposure.
            payload: its key as surveyed, and its overlaps.
            read: content of a frame's file.
            hash_of: SHA-256 of a file whose hash is not in a record.

        Raises:
            InputsChangedError: the inputs are not those the key was computed from.
            Exception: the exposure cannot be processed.
        """
        folder = self._mission.level0(number)
        frames, exposure = store.load_level0(
            folder, self._processor.rig, calibration_sha256=self._calibration_sha256, read=read
        )
        inputs = input_identity(folder, hash_of)
        key = product_key(self._common, inputs, asdict(payload.overlap_shares))
        if payload.key and key != payload.key:
            raise InputsChangedError(
                f"{folder} was changed after the run began; run the same command again"
            )
        products = make_products(
            self._processor,
            self._geometry,
            exposure,
            frames,
            overlap_shares=payload.overlap_shares,
        )
        return key, products

    def provenance(self, key: str, duration_s: float) -> dict[str, Any]:
        """Who computed products of this key, with what, and how long it took.

        Args:
            key: of the products.
            duration_s: of the computation.
        """
        return {
            "key": key,
            "host": socket.gethostname(),
            "process": os.getpid(),
            "thread": threading.get_native_id(),
            "duration_s": duration_s,
            "threads": self._work.threads,
            "finished_unix_s": int(time.time()),
            "versions": dict(self._work.identity),
        }


def check_same_folder(folder: Path, inode: int | None) -> None:
    """Compare a folder with the one that the command has at this path.

    A copy at the same path would be computed from, and its products would stay there.

    Args:
        folder: of a mission.
        inode: of the folder of the command; a network file system states the same one everywhere.

    Raises:
        DataAbsentError: there is no such folder, or another one.
    """
    if inode is None:
        return
    try:
        found = folder.stat().st_ino
    except FileNotFoundError:
        found = None
    if found != inode:
        what = (
            f"has no folder {folder}"
            if found is None
            else f"has another folder than the command at {folder} (inode {found}, not {inode})"
        )
        raise DataAbsentError(
            f"worker on {socket.gethostname()} {what}. Mount that of the command there, by a file "
            "system that keeps inodes, such as NFS, or transfer the mission to an object store."
        )


@dataclass(frozen=True)
class Level2Survey:
    """What of a mission is complete, by looking: keys by exposure, and what has to be read.

    `expected_s` is the mean duration of an exposure in earlier runs, None without any.
    """

    complete: Mapping[int, str]
    pending: tuple[BatchTask, ...]
    pending_nbytes: int
    expected_s: float | None


def survey(
    work: Level2Work, mission: Mission, numbers: Iterable[int], overlaps: Overlaps
) -> Level2Survey:
    """Find what is complete and what has to be computed.

    Args:
        work: of the run.
        mission: of the exposures.
        numbers: of the exposures that are requested.
        overlaps: of all exposures of the mission.
    """
    complete: dict[int, str] = {}
    pending: list[BatchTask] = []
    nbytes = 0
    durations_s: list[float] = []
    for number in dict.fromkeys(numbers):
        folder, shares, key = mission.level0(number), overlaps.of(number), ""
        try:
            inputs = input_identity(folder)
            key = product_key(work.common, inputs, asdict(shares))
        except (OSError, ValueError):
            inputs = {}  # the action states why
        duration_s = next(
            (
                product_manifests.duration_of(
                    product_manifests.provenance_of(mission, number, known)
                )
                for known in product_manifests.committed_keys(mission, number)
            ),
            None,
        )
        if duration_s is not None:
            durations_s.append(duration_s)
        if not work.recomputes and product_manifests.is_complete(mission, number, key):
            complete[number] = key
            continue
        pending.append(BatchTask(number, Level2Payload(key, shares)))
        nbytes += frame_nbytes(inputs, folder)
    expected_s = sum(durations_s) / len(durations_s) if durations_s else None
    return Level2Survey(complete, tuple(pending), nbytes, expected_s)


def report_of(mission: Mission, number: int, key: str) -> dict[str, Any]:
    """The quality report of complete products, with the duration of their computation.

    Raises:
        RecordError: the report is damaged.
    """
    report = level2.read_report(mission.level2(number)) or {}
    provenance = product_manifests.provenance_of(mission, number, key)
    return {**report, "duration_s": product_manifests.duration_of(provenance) or 0.0}


def identity_differences(expected: Mapping[str, str], found: Mapping[str, str]) -> str:
    """What differs between two identities, in words; empty where nothing does."""
    names = sorted(expected.keys() | found.keys())
    return ", ".join(
        f"{name} {found.get(name, 'none')[:24]} instead of {expected.get(name, 'none')[:24]}"
        for name in names
        if expected.get(name) != found.get(name)
    )


def replaced_meanwhile(
    mission: Mission, found: Level2Survey, outcome: BatchOutcome
) -> list[ExposureFailure]:
    """Exposures whose products another run replaced with those of other settings.

    Args:
        mission: of the exposures.
        found: as surveyed before the run.
        outcome: of the run.
    """
    keys = {task.number: task.payload.key for task in found.pending}
    return [
        ExposureFailure(
            number,
            "another run replaced its products with those of other settings; "
            "end that run and run the same command again",
        )
        for number in outcome.results
        if keys[number] and not product_manifests.is_complete(mission, number, keys[number])
    ]

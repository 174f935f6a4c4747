"""The work of `syntopic process` on a mission in an object store.

An exposure's frames are read from the store into memory, once, and never written to a disk. Its
products are committed in the store by a conditional put. There is no lock in a store: two runs may
compute one exposure at once; their bytes are the same, and one of them commits.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from daemon.mission.canonical_json import RecordError
from daemon.mission.layout import Mission
from daemon.mission.store.product_manifests import duration_of
from daemon.mission.transfer import store_products
from daemon.mission.transfer.object_store import ObjectStore
from daemon.mission.transfer.store_mission import (
    RECORDS,
    StoredMission,
    fetch_exposure,
    fetch_shared,
)
from daemon.mission.transfer.store_verification import read_store_manifest
from daemon.mission.transfer.transfer_manifest import CopiedFile, TransferError
from daemon.planning.overlaps import Overlaps
from daemon.postflight.batch.executor import BatchTask
from daemon.postflight.batch.level2_work import (
    Level2Action,
    Level2Payload,
    Level2Survey,
    Level2Work,
)
from daemon.postflight.batch.product_key import frame_nbytes, input_identity, product_key

READERS: Final = 4
"""Frames of one exposure that are read at a time."""
DURATIONS_MAX: Final = 50
"""Sidecars that are read to expect the duration of a run."""


@dataclass(frozen=True)
class StorePayload:
    """Key and overlaps of an exposure, and size and hash of each file of its Level-0 folder."""

    level2: Level2Payload
    files: Mapping[str, CopiedFile]


@dataclass(frozen=True)
class StoreLevel2Work:
    """Level-2 of a mission in a store; it can be pickled.

    `local` is the work on the folder without frames that the command fetched. Height model and
    radiometry in that folder are taken from the folder that each worker fetches.
    """

    url: str
    local: Level2Work
    threads: int = 1

    @property
    def memory_nbytes(self) -> int:
        return self.local.memory_nbytes

    def open(self) -> StoreLevel2Action:
        """Fetch the mission without its exposures, build the processor and load its kernels.

        Raises:
            VersionMismatchError: code, libraries or CPU differ from those of the command.
            ObjectStoreError: the store refused.
            CalibrationError, ValueError: a calibration does not fit the rig.
        """
        store = ObjectStore(self.url)
        manifest = read_store_manifest(store)
        if manifest is None:
            raise TransferError(f"{self.url}: its transfer.json is gone; run: syntopic transfer")
        scratch = tempfile.TemporaryDirectory(prefix="syntopic-store-")
        mission = fetch_shared(store, manifest, Path(scratch.name))
        return StoreLevel2Action(store, self._on(mission).open(), Mission.open(mission), scratch)

    def _on(self, mission: Path) -> Level2Work:
        """The local work with the mission's own files taken from another folder."""
        before = self.local.mission

        def moved(path: Path | None) -> Path | None:
            if path is None or not path.is_relative_to(before):
                return path
            return mission / path.relative_to(before)

        plan = self.local.plan.model_copy(update={"elevation": moved(self.local.plan.elevation)})
        return replace(
            self.local,
            mission=mission,
            folder_inode=None,
            plan=plan,
            radiometry=moved(self.local.radiometry),
            threads=self.threads,
        )


class StoreLevel2Action:
    """Computes, publishes and commits the products of one exposure at a time."""

    def __init__(
        self,
        store: ObjectStore,
        action: Level2Action,
        mission: Mission,
        scratch: tempfile.TemporaryDirectory[str],
    ) -> None:
        self._store, self._action, self._mission = store, action, mission
        self._scratch = scratch  # removed with the last action

    def clone(self) -> StoreLevel2Action:
        """Another action with separate buffers and shared calibrations."""
        return StoreLevel2Action(self._store, self._action.clone(), self._mission, self._scratch)

    def __call__(self, task: BatchTask) -> dict[str, Any]:
        """The content of quality.json and the duration of the computation.

        Raises:
            ObjectStoreError: the store refused.
            InputsChangedError: the inputs are not those the key was computed from.
            Exception: the exposure cannot be processed.
        """
        payload: StorePayload = task.payload
        if not payload.files:
            raise RecordError([f"{self._store.url}: has no exposure {task.number}"])
        store, number, key = self._store, task.number, payload.level2.key
        if not self._action.recomputes and store_products.is_stored(store, number, key):
            return store_products.stored_reports(store, {number: key})[number]
        started = time.monotonic()
        folder = self._mission.level0(number)
        fetch_exposure(store, self._mission.path, number, payload.files)
        try:
            frames = self._frames(number, payload.files)
            key, products = self._action.make(
                number,
                payload.level2,
                read=lambda path: frames.pop(path.name),
                hash_of=partial(_noted_sha256, payload.files),
            )
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        manifest, durations = store_products.publish_stored(store, number, key, products.contents)
        duration_s = round(time.monotonic() - started, 3)
        provenance = {**self._action.provenance(key, duration_s), **durations}
        provenance["duration_s"] = duration_s
        store_products.commit_stored(store, number, manifest, provenance)
        return {**products.report, "duration_s": duration_s}

    def _frames(self, number: int, files: Mapping[str, CopiedFile]) -> dict[str, bytes]:
        """The content of each frame; hashes are compared with the records where it is decoded."""
        below = self._mission.level0(number).relative_to(self._mission.path).as_posix()
        names = [name for name in files if name not in RECORDS]
        with ThreadPoolExecutor(READERS) as pool:
            blocks = pool.map(
                lambda name: self._store.read(f"{below}/{name}", files[name].nbytes), names
            )
            return dict(zip(names, blocks, strict=True))


def survey_stored(
    work: StoreLevel2Work,
    stored: StoredMission,
    mission: Mission,
    numbers: Iterable[int],
    overlaps: Overlaps,
) -> Level2Survey:
    """Find what is complete in a store and what has to be computed.

    Args:
        work: of the run.
        stored: the mission there.
        mission: its folder without frames here.
        numbers: of the exposures that are requested.
        overlaps: of all exposures of the mission.

    Raises:
        ObjectStoreError: the store refused.
    """
    found = store_products.list_products(stored.store)
    payloads: dict[int, StorePayload] = {}
    sizes: dict[int, int] = {}
    for number in dict.fromkeys(numbers):
        folder, shares, key = mission.level0(number), overlaps.of(number), ""
        files = stored.exposures.get(number, {})
        try:
            inputs = input_identity(folder, partial(_noted_sha256, files))
            key = product_key(work.local.common, inputs, asdict(shares))
        except (OSError, ValueError):
            inputs = {}  # the action states why
        payloads[number] = StorePayload(Level2Payload(key, shares), files)
        sizes[number] = frame_nbytes(inputs, folder)

    def is_complete(number: int) -> bool:
        key = payloads[number].level2.key
        if work.local.recomputes or not key or not found.is_committed(number, key):
            return False
        manifest = store_products.read_stored_manifest(stored.store, number, key)
        return manifest is not None and found.agrees(number, manifest)

    done = dict(zip(payloads, store_products.answers(is_complete, payloads), strict=True))
    pending = [number for number, is_done in done.items() if not is_done]
    return Level2Survey(
        {number: payloads[number].level2.key for number, is_done in done.items() if is_done},
        tuple(BatchTask(number, payloads[number]) for number in pending),
        sum(sizes[number] for number in pending),
        _expected_s(stored.store, found),
    )


def _noted_sha256(files: Mapping[str, CopiedFile], path: Path) -> str:
    return files[path.name].sha256 or ""


def _expected_s(store: ObjectStore, found: store_products.StoredProducts) -> float | None:
    """Mean duration of an exposure in earlier runs; None without any."""
    known = [one for one, _ in zip(found.committed(), range(DURATIONS_MAX), strict=False)]
    records = store_products.answers(
        lambda one: store_products.stored_provenance(store, *one), known
    )
    found_s = [duration_of(record) for record in records]
    durations = [duration_s for duration_s in found_s if duration_s is not None]
    return sum(durations) / len(durations) if durations else None

"""Level-0 on disk: frames become *stored*, then their record is *sealed*.

An exposure is stored when its folder has its final name, everything in it and above it is synced,
and the index has committed it (docs/reference/results/durability.md). Reading back is in
`daemon.mission.store.level0_folder`, checking in `daemon.mission.verification.verification`, what a
crash leaves behind in `daemon.mission.verification.recovery`.
"""

from __future__ import annotations

import hashlib
import sqlite3
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.canonical_json import plain_name, sha256_hex
from daemon.mission.catalog.catalog import Catalog
from daemon.mission.exposure import (
    CaptureRecord,
    Exposure,
    FrameRecord,
    capture_bytes,
    exposure_bytes,
)
from daemon.mission.layout import Mission
from daemon.mission.store import direct_io, durable
from daemon.mission.store.level0 import tiff_parts
from daemon.mission.store.level0_folder import (
    CAPTURE_FILE,
    EXPOSURE_FILE,
    hash_file,
    load_level0,
    read_capture,
    read_sealed,
)
from daemon.mission.verification.chain_file import ChainFile
from daemon.mission.verification.verification import VerifyReport, verify

__all__ = [
    "CaptureRecord",
    "Level0Writer",
    "StoreError",
    "VerifyReport",
    "hash_file",
    "load_level0",
    "read_capture",
    "read_sealed",
    "verify",
]


class StoreError(DaemonError):
    """A demand that would break what is stored; disk faults come as OSError instead."""


class Level0Writer:
    """Makes exposures durable. One per mission, after recovery has seen the disk.

    Frames are written and hashed by `threads` threads, so that hashing runs during disk writes.
    `step` is called after each file and before anything gets its final name; what it raises as
    OSError ends the work as a refusal of the disk does.
    """

    def __init__(
        self,
        mission: Mission,
        *,
        catalog: Catalog | None = None,
        chain: ChainFile | None = None,
        threads: int = 3,
        step: Callable[[], None] = lambda: None,
    ) -> None:
        self._mission = mission
        self._chain = chain or mission.open_chain()
        self._owns_chain = chain is None
        self._catalog = catalog or Catalog.open(mission.catalog_path)
        self._owns_catalog = catalog is None
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="level0")
        self._head_sha256 = self._catalog.last_record_sha256() or mission.genesis_sha256()
        self._unindexed: deque[Callable[[], None]] = deque()
        self._undecided: int | None = None
        self._step = step

    @property
    def unindexed(self) -> int:
        """Number of changes that the index or the chain file has refused so far.

        They are tried again with the next one. The folders are durable all the same, and recovery
        takes them into both.
        """
        return len(self._unindexed)

    @property
    def head_sha256(self) -> str:
        """Hash that the next sealed record will quote."""
        return self._head_sha256

    def write(
        self, capture: CaptureRecord, pixels: Mapping[str, NDArray[np.uint16]]
    ) -> tuple[FrameRecord, ...]:
        """Make an exposure's frames durable and note it; on return the exposure is *stored*.

        Args and errors are those of `write_frames`.
        """
        frames = self.write_frames(capture, pixels)
        self.note_stored(replace(capture, frames=frames))
        return frames

    def write_frames(
        self, capture: CaptureRecord, pixels: Mapping[str, NDArray[np.uint16]]
    ) -> tuple[FrameRecord, ...]:
        """Make an exposure's frames durable, without a word in chain file and index.

        Args:
            capture: what is known by now; `file` and `sha256` of its frames are filled in here.
            pixels: by sensor, one for every frame, shape (height, width), contiguous. They are
                read where they lie and must not change until this returns.

        Returns:
            The frames with file name and hash.

        Raises:
            OSError: the disk refused. Nothing of the exposure is left, unless the disk refused to
                take it away, too: then recovery sees to it. Nothing stored before is touched.
            StoreError: this number is stored already, or frames and pixels do not fit.
        """
        _check(capture, pixels)
        final = self._mission.level0(capture.number)
        if final.exists():
            raise StoreError(f"exposure {capture.number} is stored already; Level-0 is immutable")
        part = final.with_name(final.name + durable.PART_SUFFIX)
        durable.remove_tree(part)
        part.mkdir()
        try:
            frames = self._write_frames(part, capture, pixels)
            stored = replace(capture, frames=frames)
            durable.create_file(part / CAPTURE_FILE, [capture_bytes(stored)])
            self._step()
            durable.rename_directory(part, final)
        except OSError:
            # A disk that refused to write may refuse to clear, too; recovery sees to the rest.
            with suppress(OSError):
                _withdraw(part, final)
            raise
        return frames

    def note_stored(self, stored: CaptureRecord) -> None:
        """Note in chain file and index that an exposure's frames are durable."""
        sha256 = sha256_hex(capture_bytes(stored))
        self._commit(lambda: self._chain.stored(stored.number, sha256))
        self._commit(lambda: self._catalog.add_stored(stored))

    def withdraw(self, number: int) -> None:
        """Take back frames of which nothing was noted yet.

        Raises:
            OSError: the disk refused; recovery finds the exposure whole and keeps it.
        """
        final = self._mission.level0(number)
        _withdraw(final.with_name(final.name + durable.PART_SUFFIX), final)

    def seal(self, exposure: Exposure) -> str:
        """Write the final record of a stored exposure, once; on return it is *sealed*.

        An exposure of which no frame was stored (state "lost") gets its folder here. Sealing the
        same again changes nothing.

        Args:
            exposure: its `previous_sha256` is filled in where it is empty.

        Returns:
            SHA-256 of the record, which the next one quotes.

        Raises:
            OSError: the disk refused; the exposure stays unsealed.
            StoreError: sealed differently already, never stored, or the chain does not fit.
        """
        folder = self._mission.level0(exposure.number)
        if not folder.is_dir():
            if exposure.frames:
                raise StoreError(f"exposure {exposure.number} was never stored; store it first")
            self.write(_capture_of(exposure), {})
        self._decide()
        sealed = read_sealed(folder)
        if sealed is not None:
            known = sealed.exposure
            same = replace(exposure, previous_sha256=known.previous_sha256, disks=known.disks)
            if exposure_bytes(same) != exposure_bytes(sealed.exposure):
                raise StoreError(
                    f"exposure {exposure.number} is sealed already, with other content"
                )
            return sealed.sha256
        if exposure.previous_sha256 not in ("", self._head_sha256):
            raise StoreError(
                f"exposure {exposure.number} quotes {exposure.previous_sha256[:12]}; "
                f"the record sealed last is {self._head_sha256[:12]}"
            )
        self._check_frames(folder, exposure)
        final = replace(exposure, previous_sha256=self._head_sha256)
        data = exposure_bytes(final)
        self._step()
        self._undecided = exposure.number
        durable.replace_file(folder / EXPOSURE_FILE, data, mode=0o444)
        self._undecided = None
        sha256 = sha256_hex(data)
        self._head_sha256 = sha256
        self._commit(lambda: self._chain.sealed(final.number, sha256))
        self._commit(lambda: self._catalog.add_sealed(final, sha256))
        return sha256

    def note_products(self, number: int, files: Mapping[str, int], verdict: str | None) -> None:
        """Note in the index that an exposure was processed."""
        self._commit(lambda: self._catalog.add_products(number, files, verdict))

    def close(self) -> None:
        """Release threads, index and chain file; may be called twice."""
        self._pool.shutdown()
        if self._owns_chain:
            self._chain.close()
        if self._owns_catalog:
            self._catalog.close()

    def _write_frames(
        self, part: Path, capture: CaptureRecord, pixels: Mapping[str, NDArray[np.uint16]]
    ) -> tuple[FrameRecord, ...]:
        tasks: list[Future[FrameRecord]] = [
            self._pool.submit(self._write_frame, part, capture, frame, pixels[frame.sensor])
            for frame in capture.frames
        ]
        wait(tasks)
        return tuple(task.result() for task in tasks)

    def _write_frame(
        self, part: Path, capture: CaptureRecord, frame: FrameRecord, pixels: NDArray[np.uint16]
    ) -> FrameRecord:
        written = _write_frame(part, capture, frame, pixels)
        self._step()
        return written

    def _check_frames(self, folder: Path, exposure: Exposure) -> None:
        stored = read_capture(folder)
        on_disk = {(f.sensor, f.file, f.sha256) for f in stored.frames} if stored else set()
        if {(f.sensor, f.file, f.sha256) for f in exposure.frames} != on_disk:
            raise StoreError(
                f"exposure {exposure.number}: the record names other frames than were stored"
            )

    def _decide(self) -> None:
        """Take back a record whose last sync failed: a power cut may leave it or not.

        The next record must not be chained to an uncertain one, and this one is written again.

        Raises:
            OSError: the disk still refuses; nothing can be sealed.
        """
        if self._undecided is None:
            return
        folder = self._mission.level0(self._undecided)
        (folder / EXPOSURE_FILE).unlink(missing_ok=True)
        durable.sync_directory(folder)
        self._undecided = None

    def _commit(self, change: Callable[[], None]) -> None:
        """Into index or chain file, after what they refused; the folder is durable already."""
        self._unindexed.append(change)
        with suppress(sqlite3.Error, OSError):
            while self._unindexed:
                self._unindexed[0]()
                self._unindexed.popleft()


def _withdraw(part: Path, final: Path) -> None:
    """Take back what was not acknowledged: out of its final name first, then away."""
    if final.exists():
        final.rename(part)
        durable.sync_directory(final.parent)
    durable.remove_tree(part)


def _write_frame(
    part: Path, capture: CaptureRecord, frame: FrameRecord, pixels: NDArray[np.uint16]
) -> FrameRecord:
    name = f"{frame.sensor}.tif"
    parts = tiff_parts([pixels], _description(capture, frame))
    direct_io.create_file(part / name, parts)
    digest = hashlib.sha256()
    for piece in parts:
        digest.update(piece)
    return replace(frame, file=name, sha256=digest.hexdigest())


def _description(capture: CaptureRecord, frame: FrameRecord) -> dict[str, Any]:
    """Data of the head only, without later findings."""
    return {
        "syntopic": 1,
        "exposure": capture.number,
        "sensor": frame.sensor,
        "head_serial": frame.head_serial,
        "pixel_format": frame.pixel_format,
        "device_ns": None if frame.device_ns is None else str(frame.device_ns),
        "counter": frame.counter,
        "exposure_time_us": frame.exposure_time_us,
        "temperature_c": frame.temperature_c,
        "settings": dict(frame.settings),
        "simulated": capture.simulated,
    }


def _check(capture: CaptureRecord, pixels: Mapping[str, NDArray[np.uint16]]) -> None:
    named = [frame.sensor for frame in capture.frames]
    if sorted(named) != sorted(pixels):
        raise StoreError(
            f"exposure {capture.number}: frames of {', '.join(named) or 'no sensor'} but pixels of "
            f"{', '.join(pixels) or 'none'}; each frame brings its pixels, once"
        )
    for frame in capture.frames:
        if not plain_name(frame.sensor):
            raise StoreError(f"sensor {frame.sensor!r} cannot name a file")
        if pixels[frame.sensor].shape != (frame.height_px, frame.width_px):
            raise StoreError(
                f"exposure {capture.number}, {frame.sensor}: pixels of shape "
                f"{pixels[frame.sensor].shape}; {(frame.height_px, frame.width_px)} was announced"
            )


def _capture_of(exposure: Exposure) -> CaptureRecord:
    return CaptureRecord(
        number=exposure.number,
        trigger_sequence=exposure.trigger_sequence,
        trigger_mono_ns=exposure.trigger_mono_ns,
        trigger_sigma_ns=exposure.trigger_sigma_ns,
        boot_id=exposure.boot_id,
        missing=exposure.missing,
        line_id=exposure.line_id,
        strip_id=exposure.strip_id,
        calibration_id=exposure.calibration_id,
        calibration_sha256=exposure.calibration_sha256,
        configuration_sha256=exposure.configuration_sha256,
        software=exposure.software,
        simulated=exposure.simulated,
        flags=exposure.flags,
    )

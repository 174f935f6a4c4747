"""Two disks that are pulled, fail, fill and stall in turn, over many exposures.

`SYNTOPIC_TWO_DISKS_EXPOSURES` is their number (500 in `make soak`). Exposures long verified on both
disks are deleted here, which the product never does, so that the disks stay small.
"""

from __future__ import annotations

import errno
import json
import os
import random
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest

from daemon.mission.exposure import CaptureRecord
from daemon.mission.store import durable
from daemon.mission.store.level0_folder import hash_file, read_sealed
from processing.rig import find_rig
from tests.daemon.mission.faulty_disk import refusing, stalling
from tests.daemon.mission.loop_disk import LoopDisk, why_not
from tests.daemon.mission.test_mirrored import STALL_S, MirroredFlight
from tests.daemon.small_camera import capture_of, final_record, frame_record, pixels_of

pytestmark = pytest.mark.trust

KINDS = ("pulled", "full", "failing", "stalled")
EXPOSURES = int(os.environ.get("SYNTOPIC_TWO_DISKS_EXPOSURES", "500"))
BEFORE, WITHOUT = 2, 4
"""Exposures before each fault, and with one disk."""
DISK_NBYTES = 2_000_000_000
RETAINED = 10


class FolderDisk:
    """A folder whose calls are refused or wait (`faulty_disk`); for machines without root."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._fault = ExitStack()
        root.mkdir()

    def pull(self) -> None:
        self._fault.enter_context(refusing(self.root, errno.ENOENT))

    def fail(self) -> None:
        self._fault.enter_context(refusing(self.root, errno.EIO))

    def fill(self) -> None:
        self._fault.enter_context(refusing(self.root, errno.ENOSPC))

    def freeze(self) -> None:
        self._fault.enter_context(stalling(self.root))

    def end(self) -> None:
        self._fault.close()

    thaw = free = mount_again = end


class Flight:
    """Exposures on two disks, what was called stored, and where it was found afterwards."""

    def __init__(
        self,
        disks: dict[str, LoopDisk | FolderDisk],
        camera: Callable[[int], CaptureRecord],
        seed: int,
    ) -> None:
        self.disks = disks
        self.random = random.Random(seed)
        self._camera = camera
        self.flown = MirroredFlight({label: disk.root for label, disk in disks.items()})
        self.flown.joined()
        self.number = 0
        self.stored: dict[int, dict[str, str]] = {}
        self.lost = 0
        self.verified: Counter[str] = Counter()
        self._deleted = 0

    def expose(self) -> None:
        self.number += 1
        capture = self._camera(self.number)
        rng = np.random.default_rng(self.number)
        pixels = {
            f.sensor: rng.integers(0, 4096, (f.height_px, f.width_px), np.uint16)
            for f in capture.frames
        }
        storage = self.flown.storage
        try:
            frames, disks = storage.write(capture, pixels)
        except OSError:
            self.lost += 1
            return
        self.stored[self.number] = {frame.file: frame.sha256 for frame in frames}
        record = final_record(replace(capture, frames=frames))
        storage.seal(replace(record, disks=disks))
        storage.log.sync()
        storage.tick()

    def check(self, label: str) -> None:
        """All that was called stored is on this disk, bit by bit."""
        copy = self.flown.copy(label)
        for number, files in self.stored.items():
            record = read_sealed(copy.level0(number))
            assert record is not None and record.exposure.number == number
            for file, sha256 in files.items():
                assert hash_file(copy.level0(number) / file) == sha256, (label, number, file)
            self.verified[label] += 1

    def forget(self) -> None:
        """Delete what both disks were seen to have; a test's doing, never the product's."""
        for number in [n for n in self.stored if n <= self.number - RETAINED]:
            for label in self.disks:
                durable.remove_tree(self.flown.copy(label).level0(number))
            del self.stored[number]
            self._deleted += 1

    def suffer(self, kind: str, label: str) -> None:
        """One fault of one disk, somewhere within an exposure, and its end."""
        disk = self.disks[label]
        begin = {
            "pulled": disk.pull, "full": disk.fill, "failing": disk.fail, "stalled": disk.freeze,
        }[kind]  # fmt: skip
        end = {
            "pulled": disk.mount_again, "full": disk.free, "failing": disk.mount_again,
            "stalled": disk.thaw,
        }[kind]  # fmt: skip
        (left,) = set(self.disks) - {label}
        fault = threading.Timer(self.random.uniform(0.0, 0.05), begin)
        fault.start()
        try:
            for _ in range(WITHOUT):
                self.expose()
            fault.join()
            while len(self.flown.storage.in_use) == 2:
                self.expose()  # it began after the last one
            assert [disk.label for disk in self.flown.storage.in_use] == [left]
            self.check(left)
        finally:
            fault.join()
            end()
        self.flown.joined()
        self.expose()
        for both in self.disks:
            self.check(both)
        self.forget()


def fly(flight: Flight, exposures: int) -> dict[str, object]:
    faults: Counter[str] = Counter()
    begun_s = time.monotonic()
    fault_count = 0
    while flight.number < exposures:
        for _ in range(BEFORE):
            flight.expose()
        kind, label = KINDS[fault_count // 2 % len(KINDS)], list(flight.disks)[fault_count % 2]
        flight.suffer(kind, label)
        faults[f"{kind} {label}"] += 1
        fault_count += 1
    flight.flown.storage.end_mission()
    flight.flown.storage.close()
    dropped = [event for event in flight.flown.events if event.name == "disk-dropped"]
    assert len(dropped) == fault_count, "a disk was dropped without a fault, or not dropped at one"
    return {
        "exposures": flight.number,
        "not stored": flight.lost,
        "faults": dict(faults),
        "exposures hashed again": dict(flight.verified),
        "seconds": round(time.monotonic() - begun_s, 1),
    }


@pytest.fixture
def folder() -> Iterator[Path]:
    folder_made = Path(mkdtemp(prefix="syntopic-"))
    yield folder_made
    durable.remove_tree(folder_made)


def small(number: int) -> CaptureRecord:
    assert pixels_of(number)
    return capture_of(number)


def mini(number: int) -> CaptureRecord:
    """Frames of the sizes of `ultracam-x-mini`."""
    frames = tuple(
        replace(frame_record("SU00", number), sensor=s.name, width_px=s.width_px,
                height_px=s.height_px)
        for s in find_rig("ultracam-x-mini").sensors
    )  # fmt: skip
    return replace(capture_of(number), frames=frames, missing=())


def test_no_fault_of_one_disk_costs_an_exposure(folder: Path) -> None:
    roots = {"root": FolderDisk(folder / "a"), "mirror": FolderDisk(folder / "b")}
    outcome = fly(Flight({**roots}, small, seed=1), 8 * (BEFORE + WITHOUT))
    assert outcome["not stored"] == 0
    assert STALL_S < 1.0


@pytest.mark.soak
@pytest.mark.timeout(7200)
@pytest.mark.skipif(why_not() is not None, reason=f"a disk of its own: {why_not()}")
def test_no_fault_of_one_real_file_system_costs_an_exposure_over_hundreds(folder: Path) -> None:
    disks = {name: LoopDisk(folder, name, DISK_NBYTES) for name in ("root", "mirror")}
    try:
        outcome = fly(Flight({**disks}, mini, seed=2), EXPOSURES)
        print(json.dumps(outcome))
        assert outcome["not stored"] == 0
    finally:
        for disk in disks.values():
            disk.end()

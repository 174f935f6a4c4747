"""What a second disk costs: `python -m benchmarks.mirror FOLDER [EXPOSURES]`.

Stores exposures of the size of `ultracam-x` in a mission on one folder, and in one on two folders,
in turn. Two folders of one disk share its pace, so that this is the least favourable case; the
seconds of processor time do not depend on that. Prints one JSON object.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from tempfile import mkdtemp

import numpy as np

from daemon.mission.exposure import CaptureRecord, FrameRecord
from daemon.mission.layout import Mission
from daemon.mission.mirror.disk_rejoin import RejoinSettings
from daemon.mission.mirror.mirror_startup import begin_mirrored, find_disks
from daemon.mission.mirror.mirrored import MirroredStorage
from daemon.mission.store import durable
from daemon.mission.store.store import Level0Writer
from processing.rig import find_rig, shipped_rigs

RIG = "ultracam-x"
STALL_S = 30.0


def main() -> None:
    folder = Path(mkdtemp(prefix="mirror-", dir=sys.argv[1]))
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 4
    try:
        print(json.dumps(_measured(folder, count)))
    finally:
        durable.remove_tree(folder)


def _measured(folder: Path, count: int) -> dict[str, object]:
    sensors = find_rig(RIG).sensors
    memory = {
        s.name: np.random.default_rng(i).integers(0, 4096, (s.height_px, s.width_px), np.uint16)
        for i, s in enumerate(sensors)
    }
    nbytes = sum(pixels.nbytes for pixels in memory.values())
    roots = {"root": folder / "a", "mirror": folder / "b"}
    for root in (*roots.values(), folder / "single"):
        root.mkdir()
    single_disk = Level0Writer(_mission(folder / "single"))
    found = begin_mirrored(find_disks(roots), _mission)
    assert found.mission is not None
    rejoin = RejoinSettings(0.05, 0.05)
    storage = MirroredStorage(
        found.mission.id, found.disks, stall_s=STALL_S, rejoin=rejoin, emit=lambda _: None
    )
    while len(storage.in_use) < 2:
        storage.tick()
        time.sleep(0.01)
    seconds: dict[str, list[float]] = {"single": [], "mirrored": []}
    processor: dict[str, list[float]] = {"single": [], "mirrored": []}
    for number in range(1, count + 1):
        capture = _capture(number, memory)
        for name in seconds:
            begun_s, used_s = time.monotonic(), sum(os.times()[:2])
            if name == "single":
                single_disk.write(capture, memory)
            else:
                storage.write(capture, memory)
            seconds[name].append(time.monotonic() - begun_s)
            processor[name].append(sum(os.times()[:2]) - used_s)
    storage.close()
    single_disk.close()
    return {
        "rig": RIG,
        "exposures": count,
        "megabytes": round(nbytes / 1e6),
        "seconds": {name: _shown(found) for name, found in seconds.items()},
        "processor_seconds": {name: _shown(found) for name, found in processor.items()},
    }


def _shown(values: list[float]) -> dict[str, float]:
    return {"median": round(statistics.median(values), 2), "most": round(max(values), 2)}


def _mission(root: Path) -> Mission:
    return Mission.create(
        root,
        RIG,
        rig_toml=shipped_rigs()[RIG].read_bytes(),
        service_toml=b"",
        started_utc=datetime.now(UTC),
    )


def _capture(number: int, memory: dict[str, np.ndarray]) -> CaptureRecord:
    return CaptureRecord(number=number, frames=tuple(_frames(memory)))


def _frames(memory: dict[str, np.ndarray]) -> Iterator[FrameRecord]:
    blank = FrameRecord("", "", "", "", 0, 0, "Mono12", None, None, None, None, 0)
    for sensor, pixels in memory.items():
        height_px, width_px = pixels.shape
        yield replace(blank, sensor=sensor, width_px=width_px, height_px=height_px)


if __name__ == "__main__":
    main()

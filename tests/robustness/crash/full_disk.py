"""A flight on a small disk that fills and is freed.

Run: `python -m tests.robustness.crash.full_disk FOLDER`.

To be run in a user and mount namespace of its own (`unshare -Ur -m`): the disk is a tmpfs of 4 MB.
Prints what became of it as JSON.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from daemon.mission.exposure import Exposure
from daemon.mission.store.level0_folder import read_sealed
from daemon.onboard.service.messages import Seal, Sealed, ServiceEvent, WriteFailed
from daemon.onboard.storage import writer
from tests.daemon.small_camera import SENSORS, new_mission
from tests.robustness.crash import invariants
from tests.robustness.crash.scripted_flight import Ring, ScriptedService

DISK = "size=4m"
EXPOSURES = 15
FULL_AFTER = 4
FREED_AFTER_REFUSALS = 8


class SmallDiskService(ScriptedService):
    """Fills the disk after some exposures, and frees it after so many refused records."""

    filler = Path()
    refused_frames = 0
    refused_records = 0
    behind = 0

    def send(self, message: object) -> None:
        super().send(message)
        stored = len([a for a in self._answers if isinstance(a, Sealed)])
        if stored == FULL_AFTER and not self.filler.exists() and not self.refused_records:
            _fill(self.filler)
        if isinstance(message, WriteFailed):
            assert "No space left" in message.sentence, message.sentence
            self.refused_frames += not message.is_transient
            self.refused_records += message.is_transient
        if isinstance(message, ServiceEvent):
            self.behind = max(self.behind, message.event["behind"])
        if self.refused_records == FREED_AFTER_REFUSALS:
            self.filler.unlink(missing_ok=True)

    def _seal(self, record: Exposure) -> Iterator[object]:
        while True:
            yield Seal(record)
            if isinstance(self._last(Sealed, WriteFailed), Sealed):
                return
            answer = self._last(Sealed, WriteFailed)
            assert self.refused_records < 2 * FREED_AFTER_REFUSALS, answer


def _fill(path: Path) -> None:
    """To the last byte."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT, 0o644)
    for block in (4096, 1):
        try:
            while True:
                os.write(descriptor, bytes(block))
        except OSError:
            continue
    os.close(descriptor)


def main() -> None:
    folder = Path(sys.argv[1])
    subprocess.run(["mount", "-t", "tmpfs", "-o", DISK, "tmpfs", str(folder)], check=True)
    acks_path = folder.with_suffix(".acks")
    acks = os.open(acks_path, os.O_WRONLY | os.O_CREAT, 0o644)
    root = folder / "root"
    mission = new_mission(root)
    link: Any = SmallDiskService(
        mission, acks, range(1, EXPOSURES + 1), lands=True, durability="not all"
    )
    link.filler = folder / "filler"
    with mission.held():
        writer.main(link, mission.path, tuple(Ring(sensor) for sensor in SENSORS))
    acknowledged = invariants.Acknowledged(mission=mission.id)
    for line in acks_path.read_text().splitlines():
        acknowledged.add_line(line)
    lost = [
        number
        for number in mission.numbers()
        if (record := read_sealed(mission.level0(number))) and record.exposure.state == "lost"
    ]
    outcome = invariants.check_invariants(root, acknowledged, flies_on=True)
    figures = {
        "exposures": outcome.exposures - 1,
        "stored": sorted(acknowledged.stored),
        "sealed": sorted(acknowledged.sealed),
        "lost": lost,
        "refused_frames": link.refused_frames,
        "refused_records": link.refused_records,
        "index_behind": link.behind,
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()

"""A disk that is not in use is looked for, ever more rarely while it refuses."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from daemon.mission.layout import Mission
from daemon.mission.mirror.disk_rejoin import RejoiningDisk, RejoinSettings
from daemon.mission.mirror.resync import MirrorError, Resync
from daemon.mission.store.disk_identity import Disk

DELAY_S = 60.0
"""Before the first look: the thread waits for it with the event of before or with ours."""


class Woken(threading.Event):
    """Notes how long is waited for it, and lets the disk go after so many waits."""

    def __init__(self, waits: int) -> None:
        super().__init__()
        self.waits = waits
        self.waited_s: list[float | None] = []
        self.done = threading.Event()

    def wait(self, timeout: float | None = None) -> bool:
        if timeout == DELAY_S:
            return False
        self.waited_s.append(timeout)
        if len(self.waited_s) < self.waits:
            return False
        self.done.set()
        return super().wait()


def rejoining_disk(tmp_path: Path, source: Mission, polls: list[int]) -> RejoiningDisk:
    return RejoiningDisk(
        Disk("mirror", tmp_path, "1"),
        source.id,
        source=lambda: source,
        changes=lambda: 0,
        is_busy=lambda: False,
        is_free=lambda: polls.append(1) is None,
        open_log=str,
        first_missing=lambda _: 1,
        settings=RejoinSettings(poll_s=5.0, retry_max_s=30.0),
        delay_s=DELAY_S,
    )


def test_a_disk_that_refuses_is_polled_half_as_often_each_time(tmp_path: Path) -> None:
    source, polls = Mission(tmp_path / "m", "m"), list[int]()
    rejoining = rejoining_disk(tmp_path, source, polls)
    waits = Woken(5)
    rejoining._wake, first = waits, rejoining._wake
    first.set()
    assert waits.done.wait(10.0), "it never waits"
    assert waits.waited_s == [10.0, 20.0, 30.0, 30.0, 30.0]
    assert len(polls) == 5 and "no disk of Syntopic" in rejoining.problem
    assert rejoining.end(10.0)


def test_a_copy_is_not_brought_up_to_date_from_a_disk_that_leads_no_more(tmp_path: Path) -> None:
    source, other = Mission(tmp_path / "m", "m"), Mission(tmp_path / "n", "m")
    rejoining = rejoining_disk(tmp_path, source, [])
    with pytest.raises(MirrorError, match="another disk leads now"):
        rejoining._copy(Resync(other, rejoining.target, 1, lambda: None), other)
    assert rejoining.end(10.0)

"""A disk's own thread, and what a disk that was given up may still do: nothing that counts."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from daemon.mission.mirror.mirrored_log import LogFile
from daemon.mission.mirror.resync import Resync
from daemon.mission.store.disk_executor import STALL_STEP_S, DiskExecutor, DroppedError
from daemon.mission.store.disk_identity import Disk
from daemon.mission.store.store import Level0Writer, verify
from tests.daemon.small_camera import capture_of, fly, new_mission, pixels_of

pytestmark = pytest.mark.trust


def executor_for(tmp_path: Path) -> DiskExecutor:
    return DiskExecutor(Disk("mirror", tmp_path, "1"))


def test_waiting_is_counted_only_without_progress_and_at_most_one_step_per_check(
    tmp_path: Path,
) -> None:
    executor, go_on = executor_for(tmp_path), threading.Event()
    assert executor.update_waited(10.0) == 0.0, "nothing is pending"
    done = executor.submit(lambda: go_on.wait(10))
    executor.update_waited(1.0)
    assert executor.update_waited(10.0) == pytest.approx(2 * STALL_STEP_S)
    executor.step()
    assert executor.update_waited(0.1) == 0.0
    go_on.set()
    assert done.result(10) and executor.end(10.0)


def test_the_first_check_of_pending_work_counts_from_zero(tmp_path: Path) -> None:
    executor, go_on = executor_for(tmp_path), threading.Event()
    done = executor.submit(lambda: go_on.wait(10))
    assert executor.update_waited(0.1) == pytest.approx(0.1)
    go_on.set()
    assert done.result(10) and executor.end(10.0)


def test_an_abandoned_executor_starts_no_work_and_renames_no_file(tmp_path: Path) -> None:
    executor, begun, go_on = executor_for(tmp_path), threading.Event(), threading.Event()
    mission = new_mission(tmp_path / "root")
    writer = Level0Writer(mission, step=executor.step)

    def write() -> object:
        begun.set()
        go_on.wait(10)
        return writer.write(capture_of(1), pixels_of(1))

    writing, waiting = executor.submit(write), executor.submit(lambda: None)
    assert begun.wait(10)
    executor.abandon()
    go_on.set()
    for future in (writing, waiting, executor.submit(lambda: None)):
        with pytest.raises(DroppedError):
            future.result(10)
    assert executor.end(10.0) and mission.numbers() == []
    writer.close()


def test_frames_that_may_have_been_overwritten_in_memory_are_hashed_again(tmp_path: Path) -> None:
    source, target = new_mission(tmp_path / "a"), new_mission(tmp_path / "b")
    fly(source, [1, 2])
    fly(target, [1, 2])
    for number in (1, 2):
        frame = target.level0(number) / "SU00.tif"
        data = bytearray(frame.read_bytes())
        data[-1] ^= 1
        frame.chmod(0o644)
        frame.write_bytes(data)
    # Exposure 1 was acknowledged by the disk, 2 was under way when it was dropped.
    assert Resync(source, target, 2, lambda: None).run() == 1
    problems = verify(target).problems
    assert problems and all("000001" in problem for problem in problems)
    Resync(source, target, 1, lambda: None).run()
    assert verify(target).problems == ()


def test_a_log_has_no_hole_after_a_refusal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import os

    log = LogFile(tmp_path / "log.mcap")
    log.append(b"one")
    write = os.write

    def short(descriptor: int, data: bytes) -> int:
        if len(data) <= 2:
            raise OSError(28, "No space left on device")
        return write(descriptor, bytes(data[:1]))

    monkeypatch.setattr(os, "write", short)
    with pytest.raises(OSError, match="No space"):
        log.append(b"three")
    monkeypatch.setattr(os, "write", write)
    log.append(b"two")
    log.sync()
    log.close()
    assert (tmp_path / "log.mcap").read_bytes() == b"onethreetwo"

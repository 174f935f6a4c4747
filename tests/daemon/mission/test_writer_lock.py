"""Who holds a mission for writing, how often the lock is asked for, and what its file has."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from daemon.mission import writer_lock as lock_module
from daemon.mission.writer_lock import LOCK_FILE, MissionError, is_locked, writer_lock


def test_the_lock_of_a_held_mission_is_tried_five_times_and_its_holder_named(
    tmp_path: Path, monkeypatch
):
    waited: list[float] = []
    monkeypatch.setattr(lock_module.time, "sleep", waited.append)
    assert not is_locked(tmp_path)
    with writer_lock(tmp_path):
        assert is_locked(tmp_path)
        note = json.loads((tmp_path / LOCK_FILE).read_bytes())
        holder = f"process {note['pid']} on {note['host']}"
        with pytest.raises(MissionError, match=holder), writer_lock(tmp_path):
            pass
        assert waited == [0.01] * 4
        assert is_locked(tmp_path)
    assert not is_locked(tmp_path)
    assert (tmp_path / LOCK_FILE).read_bytes() == b""
    assert (tmp_path / LOCK_FILE).stat().st_mode & 0o777 == 0o644


def test_a_holder_that_left_no_note_is_not_named(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(lock_module.time, "sleep", lambda _: None)
    with writer_lock(tmp_path):
        for note in (b"", b"{}", b'{"pid": 7}', b"["):
            (tmp_path / LOCK_FILE).write_bytes(note)
            unnamed = pytest.raises(MissionError, match=r"is held by another process\. Wait")
            with unnamed, writer_lock(tmp_path):
                pass

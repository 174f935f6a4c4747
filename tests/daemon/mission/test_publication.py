"""A product folder is one writer's complete set at any instant, whoever else writes or dies."""

from __future__ import annotations

import errno
import os
import random
import signal
import subprocess
import sys
import textwrap
import time
from contextlib import suppress
from pathlib import Path

import pytest

from daemon.mission.store import publication
from daemon.mission.store.level2 import write_folder
from daemon.mission.store.publication import published, sweep

ROUNDS = 60
SOAK_ROUNDS = int(os.environ.get("SYNTOPIC_PUBLICATION_ROUNDS", "1000"))
FILES = tuple(f"{k:02d}.json" for k in range(11))

WRITERS = """
    import errno, os, sys, traceback
    from pathlib import Path
    os.fsync = lambda _descriptor: None  # no power cut here, and more rounds a second
    from daemon.mission.store import publication
    from daemon.mission.store.level2 import write_folder
    if sys.argv[2] == "renames":
        def refuse(one, other):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        publication._exchange = refuse
    final, files = Path(sys.argv[1]), sys.argv[3:]
    def publish_for_ever(writer):
        count = 0
        while True:
            count += 1
            write_folder(final, {name: [f"{writer} {count}".encode()] for name in files})
    for line in sys.stdin:
        writers = []
        for writer in line.split():
            pid = os.fork()
            if pid == 0:
                try:
                    publish_for_ever(writer)
                except BaseException:
                    print(traceback.format_exc(), flush=True)
                finally:
                    os._exit(1)
            writers.append(pid)
        print(*writers, flush=True)
        for _ in writers:
            os.wait()
        print("ended", flush=True)
"""


@pytest.fixture(params=["exchange", "renames"])
def step(request, monkeypatch):
    """How folders change places: in one step, and where the file system cannot do that."""
    if request.param == "renames":

        def refuse(*_names):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))

        monkeypatch.setattr(publication, "_exchange", refuse)
    return request.param


def written(final: Path) -> str:
    """What the one set in a folder holds; refuses a mixture and a part of a set."""
    contents = {path.name: path.read_text() for path in final.iterdir()}
    assert set(contents) == set(FILES)
    (content,) = set(contents.values())
    return content


@pytest.mark.trust
@pytest.mark.parametrize("how", ["exchange", "renames"])
def test_two_writers_killed_at_any_instant_leave_one_complete_set(tmp_path, how):
    kill_writers(tmp_path, how, ROUNDS)


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize("how", ["exchange", "renames"])
def test_a_thousand_rounds_of_kills_leave_one_complete_set_each(tmp_path, how):
    kill_writers(tmp_path, how, SOAK_ROUNDS)


def kill_writers(tmp_path, how, rounds):
    """Two processes publish under one name until each is killed, so many times."""
    rng = random.Random(20261122)
    final = tmp_path / "L2" / "000001"
    program = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(WRITERS), str(final), how, *FILES],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert program.stdin is not None and program.stdout is not None
    write_folder(final, {name: [b"first 0"] for name in FILES})
    found = set()
    for _ in range(rounds):
        program.stdin.write("a b\n")
        program.stdin.flush()
        writers = [int(pid) for pid in program.stdout.readline().split()]
        deadline = time.monotonic() + rng.uniform(0.002, 0.03)
        while time.monotonic() < deadline:
            # One step has no instant without a set.
            assert how == "renames" or final.is_dir()
        for pid in rng.sample(writers, 2):
            with suppress(ProcessLookupError):  # it failed and printed the cause
                os.kill(pid, signal.SIGKILL)
            time.sleep(rng.uniform(0.0, 0.003))
        assert "".join(iter(program.stdout.readline, "ended\n")) == ""
        sweep(final.parent)
        assert [path.name for path in final.parent.iterdir()] == ["000001"]
        found.add(written(final))
    program.stdin.close()
    assert program.wait(timeout=30) == 0
    assert {content.split()[0] for content in found} >= {"a", "b"}


@pytest.mark.trust
def test_a_sweep_leaves_a_living_writers_part_folder_alone(tmp_path, step):
    final = tmp_path / "000001"
    with published(final) as part:
        (part / "a").write_text("new")
        assert sweep(tmp_path) == [] and sweep(tmp_path, "000001") == []
        assert (part / "a").is_file()
    assert [p.name for p in tmp_path.iterdir()] == ["000001"]
    assert (final / "a").read_text() == "new"


@pytest.mark.trust
def test_what_a_dead_writer_left_is_swept_by_the_next_one(tmp_path, step):
    left = tmp_path / "000001.0123abcd.part"
    left.mkdir()
    (left / "half.tif").write_bytes(b"II")
    other = tmp_path / "000002.0123abcd.part"
    other.mkdir()
    write_folder(tmp_path / "000001", {"a": [b"1"]})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["000001", other.name]
    assert sweep(tmp_path) == [f"{tmp_path.name}/{other.name}: removed, its writer did not finish"]
    assert sweep(tmp_path) == []


def test_a_part_folder_with_the_name_of_an_earlier_version_is_swept(tmp_path):
    (tmp_path / "000003.part").mkdir()
    (tmp_path / "000004.replaced").mkdir()
    assert len(sweep(tmp_path)) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["000004"]


def test_a_folder_of_others_is_not_swept_by_name(tmp_path):
    (tmp_path / "fly-again.part").mkdir()
    write_folder(tmp_path / "fly-again", {"a": [b"1"]})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["fly-again", "fly-again.part"]


@pytest.mark.trust
def test_a_disk_that_refuses_leaves_the_earlier_set_and_nothing_else(tmp_path, step, monkeypatch):
    final = tmp_path / "000001"
    write_folder(final, {name: [b"earlier"] for name in FILES})

    def interrupted(_path):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with monkeypatch.context() as disk:
        disk.setattr(publication.durable, "sync_directory", interrupted)
        with pytest.raises(OSError, match="Input/output"):
            write_folder(final, {name: [b"later"] for name in FILES})
    assert written(final) == "earlier"
    assert [p.name for p in tmp_path.iterdir()] == ["000001"]


@pytest.mark.trust
def test_a_kill_between_two_renames_loses_no_set(tmp_path, monkeypatch):
    final = tmp_path / "000001"
    write_folder(final, {name: [b"earlier"] for name in FILES})
    real = Path.rename

    def refuse(*_names):
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

    monkeypatch.setattr(publication, "_exchange", refuse)
    for stop_at in (1, 2):
        calls = 0

        def rename(path, target, stop_at=stop_at):
            nonlocal calls
            calls += 1
            if calls >= stop_at:
                raise KeyboardInterrupt
            return real(path, target)

        with monkeypatch.context() as killed:
            killed.setattr(Path, "rename", rename)
            with pytest.raises(KeyboardInterrupt):
                write_folder(final, {name: [b"later"] for name in FILES})
        sweep(tmp_path)
        assert written(final) == "earlier"
        assert [p.name for p in tmp_path.iterdir()] == ["000001"]


def test_a_file_in_the_place_of_a_product_folder_is_replaced(tmp_path, step):
    (tmp_path / "000001").write_text("not a folder")
    write_folder(tmp_path / "000001", {name: [b"set"] for name in FILES})
    assert written(tmp_path / "000001") == "set"
    assert [p.name for p in tmp_path.iterdir()] == ["000001"]

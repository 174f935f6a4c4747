"""Files appear whole or not at all, whoever writes, fails or is killed at the same time."""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path

import pytest

from daemon.mission.store import durable
from tests.robustness.crash.kill_at_call import run_to_call

pytestmark = pytest.mark.trust

OLD, NEW = b"old" * 1000, b"new" * 2000


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def publish(path: Path) -> None:
    with durable.new_file(path) as part:
        part.write_bytes(NEW)


def replace(path: Path) -> None:
    durable.replace_file(path, NEW)


def test_a_file_is_old_or_new_after_a_kill_at_every_call(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    for write in (publish, replace):
        count = len(run_to_call(lambda w=write: w(path), None))
        seen = set()
        for last in range(1, count + 2):  # one call more: it removes what the last one left
            path.write_bytes(OLD)
            run_to_call(lambda w=write: w(path), last, torn=True)
            seen.add(path.read_bytes())
        assert seen == {OLD, NEW}
        # The next writer removes what the killed ones left.
        write(path)
        assert names_in(tmp_path) == ["report.html"]


@pytest.mark.parametrize("error", [OSError, ValueError, KeyboardInterrupt])
def test_a_failure_leaves_the_earlier_file_and_nothing_else(
    tmp_path: Path, error: type[BaseException]
) -> None:
    path = tmp_path / "report.html"
    path.write_bytes(OLD)
    with pytest.raises(error), durable.new_file(path) as part:
        part.write_bytes(NEW[:10])
        raise error
    assert path.read_bytes() == OLD
    assert names_in(tmp_path) == ["report.html"]


def test_a_writer_does_not_remove_or_publish_what_another_one_is_writing(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    with durable.new_file(path) as slow:
        slow.write_bytes(OLD[:10])
        publish(path)
        assert path.read_bytes() == NEW
        slow.write_bytes(OLD)
    assert path.read_bytes() == OLD
    assert names_in(tmp_path) == ["report.html"]


def test_many_writers_of_one_file_never_mix(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    contents = [bytes([65 + k]) * 50_000 for k in range(4)]
    path.write_bytes(contents[0])
    ended = threading.Event()
    wrong: list[object] = []

    def write(content: bytes) -> None:
        try:
            for _ in range(30):
                durable.replace_file(path, content)
        except OSError as error:
            wrong.append(error)

    def read() -> None:
        while not ended.is_set():
            if path.read_bytes() not in contents:
                wrong.append("a mixture")

    reader = threading.Thread(target=read)
    writers = [threading.Thread(target=write, args=(content,)) for content in contents]
    for thread in (reader, *writers):
        thread.start()
    for thread in writers:
        thread.join()
    ended.set()
    reader.join()
    assert wrong == []
    assert names_in(tmp_path) == ["report.html"]


def test_a_file_that_must_not_exist_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    with durable.new_file(path, replaces=False) as part:
        part.write_bytes(OLD)
    with pytest.raises(FileExistsError), durable.new_file(path, replaces=False):
        raise AssertionError("nothing is computed for a name that is taken")
    other = tmp_path / "other.toml"
    with pytest.raises(FileExistsError), durable.new_file(other, replaces=False) as part:
        part.write_bytes(NEW)
        other.write_bytes(OLD)  # somebody else is faster
    assert path.read_bytes() == other.read_bytes() == OLD
    assert names_in(tmp_path) == ["other.toml", "rig.toml"]


@pytest.mark.parametrize("is_there", [False, True])
def test_a_set_of_files_is_complete_where_its_last_file_is(tmp_path: Path, is_there: bool) -> None:
    def write(folder: Path) -> None:
        with durable.new_files(folder, last="project.toml") as part:
            for name in ("images.csv", "project.toml", "report.json"):
                (part / name).write_bytes(NEW)

    def write_project_folder(folder: Path) -> Path:
        if is_there:
            folder.mkdir()
            (folder / "mine.txt").write_bytes(OLD)
        return folder

    first = write_project_folder(tmp_path / "0")
    count = len(run_to_call(lambda: write(first), None))
    names = names_in(first)
    assert ("mine.txt" in names) == is_there and "project.toml" in names
    for last in range(1, count + 1):
        folder = write_project_folder(tmp_path / str(last))
        run_to_call(lambda f=folder: write(f), last)
        if (folder / "project.toml").exists():
            assert names_in(folder) == names
        for path in folder.glob("*"):
            assert path.read_bytes() == (OLD if path.name == "mine.txt" else NEW)
    # The next writer of the same folder removes what a killed one left.
    for last in range(1, count + 1):
        run_to_call(lambda: write(first), last)
        write(first)
        assert not [name for name in names_in(tmp_path) if name.startswith(".0.")]


def test_on_a_disk_without_hard_links_a_file_that_must_not_exist_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refusing(*_: object, **__: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refusing)
    for content in (OLD, NEW):
        part = tmp_path / "part"
        part.write_bytes(content)
        if content == OLD:
            durable._rename_to_free_name(part, tmp_path / "file")
        else:
            with pytest.raises(FileExistsError):
                durable._rename_to_free_name(part, tmp_path / "file")
    assert (tmp_path / "file").read_bytes() == OLD

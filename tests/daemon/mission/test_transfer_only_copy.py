"""What `syntopic transfer` must never do: remove, change or accept half of the only copy."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.layout import Mission, MissionError
from daemon.mission.store import file_tree as trees
from daemon.mission.store.file_tree import FileTree, TreeError
from daemon.mission.transfer.transfer import TransferError, transfer
from daemon.mission.transfer.transfer_manifest import EXCLUDED_FILES, MANIFEST_FILE, MOVED_FILE
from daemon.mission.transfer.transfer_removal import removing_path
from daemon.mission.verification.verification import verify
from tests.robustness.crash.kill_at_call import run_to_call
from tests.robustness.crash.kill_transfer import content_of, three_exposures

pytestmark = pytest.mark.trust


@pytest.fixture
def mission(tmp_path: Path) -> Mission:
    return three_exposures(tmp_path / "flown")


@pytest.fixture
def disk(tmp_path: Path) -> Path:
    return tmp_path / "disk"


def run(*arguments: object) -> dict[str, object]:
    """The command; its JSON object.

    Raises:
        DaemonError: as the command would print it.
    """
    done = CliRunner().invoke(app, ["transfer", *map(str, arguments), "--json"])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == 0, done.output
    answer: dict[str, object] = json.loads(done.stdout)
    return answer


def flip(path: Path, offset: int = -2) -> None:
    """Change one bit; size and modification time stay."""
    status = path.stat()
    data = bytearray(path.read_bytes())
    data[offset] ^= 1
    path.chmod(0o644)
    path.write_bytes(data)
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


def contents_of(folder: Path) -> dict[str, bytes]:
    return {str(p): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def removal_killed_at(mission: Mission, disk: Path, files_removed: int) -> None:
    """Kill the command after it removed so many files of the source."""

    def action() -> None:
        run(mission.path, disk, "--remove-source")

    parked = mission.path.with_name("kept")
    shutil.copytree(mission.path, parked)
    calls = run_to_call(action, None)
    last = len(calls) - calls[::-1].index("rename")
    shutil.rmtree(disk)
    parked.rename(mission.path)
    unlinks = [n for n, call in enumerate(calls, 1) if call == "unlink" and n > last]
    assert run_to_call(action, unlinks[files_removed]) == []


@pytest.mark.parametrize("files_removed", [1, 5, 12])
def test_a_second_run_after_a_killed_removal_keeps_the_complete_copy(
    mission: Mission, disk: Path, files_removed: int
) -> None:
    original = content_of(mission.path)
    removal_killed_at(mission, disk, files_removed)
    assert not mission.path.exists()
    left = content_of(removing_path(mission.path))
    assert 0 < len(left) < len(original)
    sealed = contents_of(disk)
    answer = run(mission.path, disk, "--remove-source")
    assert answer["source_removed"] is True and answer["copied"] == 0
    assert content_of(disk / mission.id) == original
    assert {n: b for n, b in contents_of(disk).items() if Path(n).name not in EXCLUDED_FILES} == {
        n: b for n, b in sealed.items() if Path(n).name not in EXCLUDED_FILES
    }
    assert not removing_path(mission.path).exists()
    assert verify(Mission.open(disk / mission.id)).is_intact
    # Once more, as after a kill in the very last call: still a success.
    assert run(mission.path, disk)["source_removed"] is True


def test_the_removal_is_not_resumed_with_a_damaged_or_another_copy(
    mission: Mission, disk: Path, tmp_path: Path
) -> None:
    removal_killed_at(mission, disk, 3)
    left = contents_of(mission.root)
    copy = disk / mission.id
    flip(copy / "L0/000002/SU00.tif")
    with pytest.raises(TransferError, match=r"L0/000002/SU00\.tif was changed since"):
        run(mission.path, disk)
    flip(copy / "L0/000002/SU00.tif")
    (copy / "L0/000003/SU00.tif").rename(tmp_path / "frame")
    with pytest.raises(TransferError, match=r"L0/000003/SU00\.tif is missing"):
        run(mission.path, disk)
    (tmp_path / "frame").rename(copy / "L0/000003/SU00.tif")
    for elsewhere in (tmp_path / "nothing", tmp_path / "empty"):
        (tmp_path / "empty" / mission.id).mkdir(parents=True, exist_ok=True)
        with pytest.raises(TransferError, match=re.escape(str(copy))):
            run(mission.path, elsewhere)
    other = tmp_path / "other"
    shutil.copytree(disk, other)
    note = other / mission.id / MANIFEST_FILE
    note.write_text(note.read_text().replace('"sealed_utc": "2', '"sealed_utc": "1'))
    with pytest.raises(TransferError, match="does not name this copy"):
        run(mission.path, other)
    with pytest.raises((TransferError, MissionError)):
        run(removing_path(mission.path), tmp_path / "third")
    assert {n: b for n, b in contents_of(mission.root).items() if not n.endswith(".held")} == {
        n: b for n, b in left.items() if not n.endswith(".held")
    }
    assert run(mission.path, disk)["source_removed"] is True


def test_what_is_in_the_source_and_not_in_the_sealed_copy_is_not_removed(
    mission: Mission, disk: Path
) -> None:
    removal_killed_at(mission, disk, 3)
    removing = removing_path(mission.path)
    (removing / "export/notes.txt").write_text("mine")
    left = content_of(removing)
    with pytest.raises(TransferError, match=r"export/notes\.txt is not in the sealed copy"):
        run(mission.path, disk)
    assert content_of(removing) == left
    (removing / "export/notes.txt").unlink()
    run(mission.path, disk)
    assert not removing.exists()


def test_a_sealed_copy_is_never_changed_by_a_later_run(mission: Mission, disk: Path) -> None:
    saved = mission.root.parent / "saved"
    shutil.copytree(mission.path, saved)
    run(mission.path, disk, "--remove-source")
    sealed = contents_of(disk)
    shutil.copytree(saved, mission.path)
    (mission.export_dir / "report.html").write_text("later")
    shutil.rmtree(mission.level0(2))
    for arguments in ([], ["--remove-source"]):
        with pytest.raises(TransferError, match="differs from the copy that was sealed"):
            run(mission.path, disk, *arguments)
        assert contents_of(disk) == sealed
    shutil.rmtree(mission.path)
    shutil.copytree(saved, mission.path)
    flip(mission.level0(1) / "SU00.tif")
    with pytest.raises(TransferError, match=r"L0/000001/SU00\.tif differs"):
        run(mission.path, disk, "--remove-source")
    shutil.rmtree(mission.path)
    shutil.copytree(saved, mission.path)
    answer = run(mission.path, disk)
    assert (answer["copied"], answer["source_removed"]) == (0, False)
    assert answer["sealed_utc"]
    assert mission.path.exists()
    assert run(mission.path, disk, "--remove-source")["source_removed"] is True
    assert not mission.path.exists()
    assert contents_of(disk) == sealed


@pytest.mark.parametrize(
    "name", ["L2/000001/quality.json", "export/report.html", "rig.toml", "L0/000001/SU00.tif"]
)
def test_a_flipped_bit_in_a_kept_file_is_found_before_the_source_goes(
    mission: Mission, disk: Path, name: str
) -> None:
    original = content_of(mission.path)
    run(mission.path, disk)
    flip(disk / mission.id / name)
    assert content_of(disk / mission.id) != original
    answer = run(mission.path, disk, "--remove-source")
    assert answer["copied"] == 1
    assert content_of(disk / mission.id) == original


def test_a_source_that_lost_frames_does_not_take_them_from_the_copy(
    mission: Mission, disk: Path
) -> None:
    original = content_of(mission.path)
    run(mission.path, disk)
    (mission.level0(2) / "SU00.tif").unlink()
    with pytest.raises(TransferError, match=r"has lost L0/000002/SU00\.tif"):
        run(mission.path, disk)
    assert content_of(disk / mission.id) == original
    shutil.copy(disk / mission.id / "L0/000002/SU00.tif", mission.level0(2))
    flip(mission.level0(3) / "SU00.tif")
    with pytest.raises(TransferError, match=r"L0/000003/SU00\.tif differs from the copy"):
        run(mission.path, disk, "--remove-source")
    (mission.level0(3) / "SU00.tif").write_bytes(b"short")
    with pytest.raises(TransferError, match=r"L0/000003/SU00\.tif differs from the copy"):
        run(mission.path, disk, "--remove-source")
    assert content_of(disk / mission.id) == original


@pytest.mark.parametrize("content", ["{}", "", '{"files": []}', "[" * 100_000, None])
def test_a_folder_that_is_not_ours_is_refused_and_left_alone(
    mission: Mission, disk: Path, content: str | None
) -> None:
    target = disk / mission.id
    target.mkdir(parents=True)
    (target / "thesis.doc").write_text("mine")
    if content is not None:
        (target / MANIFEST_FILE).write_text(content)
    before = contents_of(disk)
    with pytest.raises(TransferError, match=r"not made by a transfer|is damaged"):
        run(mission.path, disk, "--remove-source")
    assert contents_of(disk).items() - {(str(target / ".held"), b"")} == before.items()


def test_an_unrelated_file_in_a_copy_is_not_deleted(mission: Mission, disk: Path) -> None:
    run(mission.path, disk)
    (disk / mission.id / "export/notes.txt").write_text("mine")
    with pytest.raises(TransferError, match=r"export/notes\.txt is not part of this mission"):
        run(mission.path, disk)
    assert (disk / mission.id / "export/notes.txt").read_text() == "mine"
    assert mission.path.exists()


def test_links_in_the_target_are_not_followed(mission: Mission, disk: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "thesis.doc").write_text("mine")
    target = disk / mission.id
    disk.mkdir()
    target.symlink_to(elsewhere)
    with pytest.raises(TreeError, match="is a link"):
        run(mission.path, disk)
    target.unlink()
    run(mission.path, disk)
    shutil.rmtree(target / "L2")
    (target / "L2").symlink_to(elsewhere)
    with pytest.raises(TreeError, match="not a plain file or folder"):
        run(mission.path, disk)
    (target / "L2").unlink()
    shutil.move(target / "rig.toml", elsewhere / "rig.toml")
    (target / "rig.toml").symlink_to(elsewhere / "rig.toml")
    with pytest.raises(TreeError, match=r"rig\.toml is not a plain file"):
        run(mission.path, disk)
    (target / "rig.toml").unlink()
    os.mkfifo(target / "rig.toml")
    with pytest.raises(TreeError, match=r"rig\.toml is not a plain file"):
        run(mission.path, disk)
    assert sorted(p.name for p in elsewhere.iterdir()) == ["rig.toml", "thesis.doc"]


def test_a_folder_that_becomes_a_link_while_it_is_copied_is_not_followed(
    mission: Mission, disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody exchanges a folder between the check and the copy, in the source and in the copy."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "SU00.tif").write_bytes(b"secret")
    real = FileTree.copy_from
    exchanged = mission.path

    def exchange(
        tree: FileTree, source: FileTree, entry: trees.FileEntry, step: trees.ByteProgress
    ) -> str:
        if entry.name == "L0/000002/SU00.tif":
            place = exchanged / "L0/000002"
            place.rename(tmp_path / "moved")
            place.symlink_to(elsewhere)
        return real(tree, source, entry, step)

    monkeypatch.setattr(FileTree, "copy_from", exchange)
    with pytest.raises(TreeError, match="not a plain file or folder"):
        transfer(mission, disk, remove_source=True)
    shutil.rmtree(disk)
    (mission.path / "L0/000002").unlink()
    (tmp_path / "moved").rename(mission.path / "L0/000002")
    exchanged = disk / mission.id
    with pytest.raises(TreeError, match="not a plain file or folder"):
        transfer(mission, disk, remove_source=True)
    assert [p.name for p in elsewhere.iterdir()] == ["SU00.tif"]
    assert (elsewhere / "SU00.tif").read_bytes() == b"secret"
    assert verify(mission).is_intact


def test_the_source_itself_by_another_path_is_not_a_target(
    mission: Mission, tmp_path: Path
) -> None:
    before = content_of(mission.path)
    (tmp_path / "link").symlink_to(mission.root)
    with pytest.raises(TransferError, match="is where the mission is"):
        run(mission.path, tmp_path / "link", "--remove-source")
    with pytest.raises(TransferError, match="is where the mission is"):
        run(mission.path, mission.path / "export", "--remove-source")
    assert content_of(mission.path) == before


def test_a_copy_in_which_another_process_writes_is_not_touched(
    mission: Mission, disk: Path
) -> None:
    run(mission.path, disk)
    with Mission(disk / mission.id, mission.id).held(), pytest.raises(MissionError):
        run(mission.path, disk)


def test_a_source_changed_during_the_copy_is_kept(
    mission: Mission, disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from daemon.mission.transfer import transfer as module

    def verify_and_write(copy: Mission) -> object:
        (mission.export_dir / "late.csv").write_text("late")
        return verify(copy)

    monkeypatch.setattr(module, "verify", verify_and_write)
    with pytest.raises(TransferError, match="changed while it was copied"):
        run(mission.path, disk, "--remove-source")
    monkeypatch.undo()
    assert (mission.export_dir / "late.csv").exists()
    assert not (mission.path / MOVED_FILE).exists()
    run(mission.path, disk, "--remove-source")
    assert (disk / mission.id / "export/late.csv").read_text() == "late"


def test_a_mission_that_was_never_transferred_is_called_missing(disk: Path) -> None:
    disk.mkdir()
    with pytest.raises(MissionError, match="no such folder"):
        run(disk.parent / "20260101T000000Z-none", disk)

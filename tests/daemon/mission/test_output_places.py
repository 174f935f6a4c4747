"""Output places with content of somebody else are refused before anything is written."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from daemon.mission.layout import Mission
from daemon.mission.store.durable import remove_tree
from daemon.mission.store.output_places import (
    OutputPlaceError,
    refuse_foreign_file,
    refuse_foreign_files,
    refuse_mission_folder,
    refuse_occupied,
)

OWN = re.compile(r"map\.tif|tiles/\d+\.npy")


def test_a_folder_with_own_files_only_may_be_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    refuse_foreign_files(folder, OWN)
    (folder / "tiles").mkdir(parents=True)
    refuse_foreign_files(folder, OWN)
    (folder / "map.tif").write_text("own")
    (folder / "tiles/12.npy").write_text("own")
    refuse_foreign_files(folder, OWN)


@pytest.mark.parametrize("name", ["notes.txt", "tiles/notes.txt", "map.tif.old", "a/map.tif"])
def test_a_foreign_file_is_named_with_what_to_do(tmp_path: Path, name: str) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine")
    with pytest.raises(OutputPlaceError, match=re.escape(f"holds {name}")) as refused:
        refuse_foreign_files(tmp_path, OWN, cure="give another folder with --out")
    assert "Move it, or give another folder with --out" in str(refused.value)
    with pytest.raises(OutputPlaceError, match="Move it elsewhere"):
        refuse_foreign_files(tmp_path, OWN)


def test_a_link_to_a_folder_is_foreign_and_removed_as_a_link(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/map.tif").write_text("mine")
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "tiles").symlink_to(tmp_path / "mine")
    with pytest.raises(OutputPlaceError, match="holds tiles"):
        refuse_foreign_files(folder, OWN)
    remove_tree(folder / "tiles")
    assert not (folder / "tiles").is_symlink()
    assert (tmp_path / "mine/map.tif").read_text() == "mine"


def test_a_file_or_a_broken_link_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for name in ("file", "link"):
        for refuse in (refuse_occupied, lambda place: refuse_foreign_files(place, OWN)):
            with pytest.raises(OutputPlaceError, match="no folder"):
                refuse(tmp_path / name)
    with pytest.raises(OutputPlaceError, match="no file"):
        refuse_foreign_file(tmp_path, lambda _head: True)


def test_only_an_empty_folder_takes_new_files(tmp_path: Path) -> None:
    refuse_occupied(tmp_path / "new")
    refuse_occupied(tmp_path)
    (tmp_path / "points.csv").write_text("mine")
    with pytest.raises(OutputPlaceError, match=r"holds points\.csv"):
        refuse_occupied(tmp_path)


def test_a_file_is_replaced_where_it_begins_as_its_command_writes(tmp_path: Path) -> None:
    path = tmp_path / "protocol.txt"
    refuse_foreign_file(path, lambda _head: False)
    path.write_text("")
    refuse_foreign_file(path, lambda _head: False)
    path.write_text("BUNDLE a\n")
    refuse_foreign_file(path, lambda head: head.startswith(b"BUNDLE"))
    path.write_text("point,x_m\n")
    with pytest.raises(OutputPlaceError, match="was not written by this command"):
        refuse_foreign_file(path, lambda head: head.startswith(b"BUNDLE"))


@pytest.mark.parametrize(
    ("place", "is_right"),
    [("a/export/map", True), ("new", True), ("a-map", True), ("a", False), (".", False),
     ("a/L2", False), ("a/new", False), ("a/export", False), ("a/export/../L0/x", False),
     ("b/L0", False), ("b/export/map", True), ("link/L2", False)],
)  # fmt: skip
def test_results_are_in_the_export_of_a_mission_or_outside(
    tmp_path: Path, place: str, is_right: bool
) -> None:
    for name in "ab":
        (tmp_path / name / "export").mkdir(parents=True)
    (tmp_path / "b/mission.json").write_text("{}")
    (tmp_path / "link").symlink_to(tmp_path / "a")
    mission = Mission(tmp_path / "a", "a")
    if is_right:
        refuse_mission_folder(tmp_path / place, mission, cure="give another folder")
        return
    with pytest.raises(OutputPlaceError, match="mission"):
        refuse_mission_folder(tmp_path / place, mission, cure="give another folder")

"""`syntopic orthomosaic` replaces its own earlier results, and nothing else."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from benchmarks.orthomosaic import OrthoFlight
from daemon.cli import app
from daemon.mission.layout import Mission
from daemon.mission.store.output_places import OutputPlaceError
from daemon.orientation.georeference import Georeference
from daemon.postflight.orthomosaic import orthomosaic as making
from daemon.postflight.orthomosaic.inputs import (
    Ground,
    OrthoBlock,
    OrthomosaicError,
    block_for_orthomosaic,
)
from daemon.postflight.orthomosaic.orthomosaic import OrthomosaicSettings
from daemon.postflight.orthomosaic.work_folder import refuse_foreign_places, work_folder

pytestmark = pytest.mark.timeout(300)

RUN = CliRunner()


def run(flown: OrthoFlight, out: Path, *more: str, mission: Path | None = None) -> Result:
    return RUN.invoke(
        app,
        ["orthomosaic", str(mission or flown.mission),
         "--trajectory", str(flown.folder / "trajectory.csv"), "--image", "pan", "--bits", "16",
         "--gsd", "1.2", "--processes", "0", "--out", str(out), "--json", *more],
    )  # fmt: skip


def content(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def interrupted(flown: OrthoFlight, out: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Stored tiles of a run that ended before its files were written; the folder of them."""

    def stop(*_args: object, **_options: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(making, "tone_curves", stop)
        assert run(flown, out).exit_code != 0
    (tiles,) = out.with_name(out.name + ".work").iterdir()
    return tiles


@pytest.fixture(scope="module")
def mission(flown: OrthoFlight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    copy = tmp_path_factory.mktemp("own") / "mission"
    shutil.copytree(flown.mission, copy, ignore=shutil.ignore_patterns("export"))
    return copy


@pytest.mark.parametrize("place", ["", "..", "L0", "L2", "L2/000009", "export", "log/map"])
def test_the_mission_and_its_parts_are_no_place_for_results(flown, mission, place) -> None:
    before = content(mission)
    done = run(flown, mission / place, mission=mission)
    assert isinstance(done.exception, OutputPlaceError), done.exception
    assert "--out" in str(done.exception)
    assert content(mission) == before


def test_files_of_others_are_refused_where_results_and_tiles_are(flown, tmp_path) -> None:
    for name in ("own/notes.txt", "own.work/notes.txt", "own.work/sub/0-0.npy"):
        path = tmp_path / name
        path.parent.mkdir(parents=True)
        path.write_text("mine")
        done = run(flown, tmp_path / "own")
        assert isinstance(done.exception, OutputPlaceError)
        assert path.read_text() == "mine"
        shutil.rmtree(path.parents[len(Path(name).parts) - 2])
    file = tmp_path / "dtm.asc"
    file.write_text("heights")
    assert isinstance(run(flown, file).exception, OutputPlaceError)
    assert file.read_text() == "heights"


def test_earlier_results_are_replaced_and_neighbours_stay(flown, tmp_path) -> None:
    neighbours = [tmp_path / "film.part", tmp_path / "list.replaced", tmp_path / "other.work/x"]
    for path in neighbours:
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    linked = tmp_path / "disk"
    linked.mkdir()
    (tmp_path / "map").symlink_to(linked)
    for _ in range(2):
        done = run(flown, tmp_path / "map")
        assert done.exit_code == 0, done.output
        (linked / "pan-16.tif.aux.xml").write_text("statistics of GDAL")
    assert (tmp_path / "map").is_symlink() and (linked / "orthomosaic.json").is_file()
    assert [path.read_text() for path in neighbours] == ["mine"] * 3
    (linked / "notes.txt").write_text("mine")
    assert isinstance(run(flown, tmp_path / "map").exception, OutputPlaceError)
    assert (linked / "notes.txt").read_text() == "mine"


def test_two_commands_do_not_share_a_folder(flown, tmp_path) -> None:
    with work_folder(tmp_path / "map", "0" * 24 + "-pan-level") as tiles:
        done = run(flown, tmp_path / "map")
        assert isinstance(done.exception, OrthomosaicError)
        assert "another command makes an orthomosaic there" in str(done.exception)
        assert tiles.is_dir()
    assert not tiles.parent.exists()
    assert run(flown, tmp_path / "map").exit_code == 0


@pytest.mark.parametrize("damage", ["half", "empty", "changed", "unhashed"])
def test_a_damaged_tile_is_computed_again(flown, tmp_path, monkeypatch, damage) -> None:
    out = tmp_path / "map"
    assert run(flown, out).exit_code == 0
    right = content(out)
    shutil.rmtree(out)
    tiles = interrupted(flown, out, monkeypatch)
    tile = next(tiles.glob("*.npy"))
    data = bytearray(tile.read_bytes())
    if damage == "unhashed":
        tile.with_suffix(".sha256").unlink()
    elif damage == "changed":
        data[len(data) // 2] ^= 0xFF
        tile.write_bytes(data)
    else:
        tile.write_bytes(data[: len(data) // 2 if damage == "half" else 0])
    done = run(flown, out)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["tiles_computed"] == 1
    assert content(out) == right


def _changes(block: OrthoBlock) -> dict[str, OrthoBlock]:
    first, rest, grid = block.images[0], block.images[1:], block.grid
    moved = replace(first.pose, centre_m=first.pose.centre_m + 0.01)
    longer = replace(first.pose, f_mm=first.pose.f_mm + 0.01)
    shifted = replace(first.pose, principal_px=(1.0, 2.0))
    turned = replace(first.pose, rotation=np.roll(first.pose.rotation, 1, axis=0))
    other = Ground(block.ground.surface, "plane 421.0")
    images = [replace(first, pose=pose) for pose in (moved, longer, shifted, turned)]
    images += [replace(first, colour=()), replace(first, sources=first.sources[:1])]
    found = {f"image {k}": replace(block, images=(one, *rest)) for k, one in enumerate(images)}
    found |= {"missing image": replace(block, images=rest), "order": replace(
        block, images=(*rest, first))}  # fmt: skip
    for name, value in (("east_m", 0.1), ("north_m", 0.1), ("gsd_m", 0.01), ("width_px", 1),
                        ("height_px", 1)):  # fmt: skip
        changed = replace(grid, **{name: getattr(grid, name) + value})
        found[name] = replace(block, grid=changed)
    found["crs"] = replace(block, georeference=Georeference("EPSG:32632"))
    return found | {"ground": replace(block, ground=other)}


def test_every_input_and_setting_of_tiles_is_in_the_name_of_their_folder(flown) -> None:
    block = block_for_orthomosaic(
        Mission.open(flown.mission), trajectory_file=flown.folder / "trajectory.csv",
        plane_height_m=420.0,
    )  # fmt: skip
    bands, plain = ("pan", "red"), OrthomosaicSettings()
    names = {
        "as it is": making._key(block, bands, plain),
        "bands": making._key(block, ("pan",), plain),
        "order of bands": making._key(block, ("red", "pan"), plain),
        "levelling": making._key(block, bands, replace(plain, levelled=False)),
        **{what: making._key(one, bands, plain) for what, one in _changes(block).items()},
    }
    assert making._key(block, bands, replace(plain, depths=(8,))) == names["as it is"]
    same = [(a, b) for a in names for b in names if a < b and names[a] == names[b]]
    assert not same


def test_stored_tiles_count_as_disk_that_is_there(flown, tmp_path, monkeypatch) -> None:
    """A resumed run needs the rest: tiles are a third of what is written."""
    out = tmp_path / "map"
    tiles = interrupted(flown, out, monkeypatch)
    stored = sum(path.stat().st_size for path in tiles.glob("*.npy"))
    for free, fits in ((1.9 * stored, False), (2.1 * stored, True)):
        usage = shutil._ntuple_diskusage(int(9 * stored), 0, int(free))
        with monkeypatch.context() as patched:
            patched.setattr(making.shutil, "disk_usage", lambda _path, usage=usage: usage)
            done = run(flown, out)
        assert (done.exit_code == 0) is fits, done.exception
        assert fits or "GB free" in str(done.exception)


def test_places_are_refused_before_images_are_read(flown, tmp_path) -> None:
    with pytest.raises(OutputPlaceError, match="contains the mission"):
        refuse_foreign_places(flown.mission.parent, Mission.open(flown.mission))
    refuse_foreign_places(flown.mission / "export/orthomosaic", Mission.open(flown.mission))
    refuse_foreign_places(tmp_path / "new", Mission.open(flown.mission))

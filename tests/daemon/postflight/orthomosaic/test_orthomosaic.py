"""`syntopic orthomosaic`: held against the ideal orthoimage, interrupted, and misused."""

from __future__ import annotations

import json
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from typer.testing import CliRunner

from benchmarks.orthomosaic import (
    GroundTruth,
    OrthoFlight,
    command,
    displacements,
    owners,
)
from daemon.cli import app
from daemon.mission.layout import Mission
from daemon.postflight.orthomosaic import inputs
from daemon.postflight.orthomosaic import orthomosaic as making
from daemon.postflight.orthomosaic.cells import CELL_PX, cells_of, survey
from daemon.postflight.orthomosaic.ground_reach import corner_slope, ground_reach_m
from daemon.postflight.orthomosaic.inputs import block_for_orthomosaic
from daemon.postflight.orthomosaic.tiles import TILE_PX, TileJob, render_tile
from processing.geometry.rotation import rotation_matrix
from processing.geometry.terrain_rays import HeightModel
from processing.image.orthoimage.ground_grid import GroundGrid
from processing.image.orthoimage.ground_resampling import ImagePose
from processing.image.orthoimage.levelling import GainField

pytestmark = pytest.mark.timeout(300)

RUN = CliRunner()


def _arguments(flown: OrthoFlight, out: Path, *more: str) -> list[str]:
    return [
        str(flown.mission), "--trajectory", str(flown.folder / "trajectory.csv"),
        "--out", str(out), *more,
    ]  # fmt: skip


@pytest.fixture(scope="module")
def product(flown: OrthoFlight) -> tuple[Path, dict]:
    out = flown.folder / "ortho"
    model = ["--elevation", str(flown.folder / "dtm.asc")]
    return out, command("orthomosaic", *_arguments(flown, out, *model))


def test_pixels_are_where_the_ideal_orthoimage_has_them(flown, product) -> None:
    """Delivered orientations err by 13 cm from the attitude; the GSD is 15 cm."""
    out, report = product
    assert report["orientation"].startswith("delivered orientations")
    with rasterio.open(out / "pan-16.tif") as raster:
        pixels = raster.read(1)
    found = displacements(pixels, owners(out, report), GroundTruth(flown, report["crs"]), report)
    assert found["windows"] > 300 and found["seam_windows"] > 20
    assert found["rms_px"] < 2.0
    assert found["seam_rms_px"] < 2.0


def test_seams_do_not_show_after_levelling(product) -> None:
    steps = product[1]["seams"]
    for band, before in steps["step_rms_before"].items():
        assert before > 0.02, band
        assert steps["step_rms_after"][band] < 0.01, band


def test_files_are_cogs_in_the_system_of_the_orientations(product) -> None:
    out, report = product
    shapes = set()
    for image, count in (("pan", 1), ("rgb", 3), ("cir", 3)):
        for bits, kind in ((16, "uint16"), (8, "uint8")):
            with rasterio.open(out / f"{image}-{bits}.tif") as raster:
                assert raster.count == count and set(raster.dtypes) == {kind}
                assert raster.crs.to_epsg() == 32633
                assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
                assert raster.overviews(1)
                assert raster.nodata == 0
                assert raster.tags()["SYNTOPIC_SIMULATED"] == "YES"
                assert raster.transform.a == report["gsd_m"]
                shapes.add(raster.shape)
                data = raster.read(1) > 0
                assert 0.5 < data.mean() <= 1.0
    assert shapes == {(report["height_px"], report["width_px"])}
    with rasterio.open(out / "pan-16.tif") as raster:
        assert np.count_nonzero(raster.read(1)) == report["pixels_with_data"]


def test_seams_are_a_geopackage_that_gdal_reads(product) -> None:
    """Its areas cover the pixels with data, its lines lie between areas."""
    out, report = product
    with sqlite3.connect(out / "seams.gpkg") as connection:
        assert connection.execute("PRAGMA application_id").fetchone() == (0x47504B47,)
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert connection.execute("PRAGMA foreign_key_check").fetchall() == []
        areas = connection.execute("SELECT exposure FROM seam_areas").fetchall()
        pairs = connection.execute("SELECT image_a, image_b FROM seam_lines").fetchall()
    assert len(areas) == report["images_used"]
    assert len(pairs) == report["seams"]["lines"] >= len(areas) - 1
    with rasterio.open(out / "pan-16.tif") as raster:
        data = raster.read(1) > 0
    owner = owners(out, report)
    assert (owner[data] > 0).all()
    assert data[owner > 0].mean() > 0.999


def test_interrupted_and_repeated_gives_the_same_bytes(flown, product, monkeypatch) -> None:
    out, report = product
    again = flown.folder / "again"
    model = ["--elevation", str(flown.folder / "dtm.asc"), "--json"]
    real = making.make_tiles

    def interrupted(work, jobs, compute):
        real(work, jobs[: len(jobs) // 2], compute)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(making, "make_tiles", interrupted)
        done = RUN.invoke(app, ["orthomosaic", *_arguments(flown, again, *model)])
    assert done.exit_code != 0 and not again.exists()
    kept = list((flown.folder / "again.work").rglob("*.npy"))
    assert len(kept) == report["tiles_computed"] // 2 > 0
    # Half a tile, as a killed writer leaves it, is not taken for one.
    (kept[0].parent / f".{kept[0].name}.deadbeef.part").write_bytes(b"half")
    second = command("orthomosaic", *_arguments(flown, again, *model[:-1], "--threads", "1"))
    assert 0 < second["tiles_computed"] < report["tiles_computed"]
    assert not (flown.folder / "again.work").exists()
    for file in sorted(out.iterdir()):
        assert (again / file.name).read_bytes() == file.read_bytes(), file.name


def test_a_plane_states_what_relief_does(flown) -> None:
    out = flown.folder / "plane"
    done = RUN.invoke(
        app,
        ["orthomosaic", *_arguments(flown, out, "--ground-height", "440.0", "--image", "pan"),
         "--bits", "8", "--gsd", "0.6"],
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    words = " ".join(done.output.split())
    assert "ground 1 m above it is displaced by 0." in words and "--elevation" in words
    assert sorted(p.name for p in out.iterdir()) == [
        "orthomosaic.json", "pan-8.tif", "seams.gpkg",
    ]  # fmt: skip
    relief = json.loads((out / "orthomosaic.json").read_text())["relief"]
    assert 0.01 < relief["displacement_per_m_rms"] < relief["displacement_per_m_max"] < 0.3


def _block(flown: OrthoFlight, **options):
    return block_for_orthomosaic(
        Mission.open(flown.mission), trajectory_file=flown.folder / "trajectory.csv",
        plane_height_m=420.0, **options,
    )  # fmt: skip


def test_a_finer_grid_shows_the_same_ground(flown) -> None:
    """Also the corners of images, at an eighth of their sampling distance."""
    area_m2 = []
    for gsd_m in (0.16, 0.02):
        block = _block(flown, gsd_m=gsd_m)
        found = survey(block, ["pan"], [cells_of(block, one, ["pan"]) for one in block.images])
        area_m2.append((found.owner >= 0).sum() * (gsd_m * CELL_PX) ** 2)
    # Cells are taken where an image covers them whole; smaller ones come nearer to its edge.
    assert 1.0 < area_m2[1] / area_m2[0] < 1.1


def test_a_coarser_grid_shows_means_of_the_ground_and_not_points(flown) -> None:
    """Against means of ground pixels at the sampling distance of the images, by the same code."""
    factor, side = 4, 128
    block = _block(flown, gsd_m=0.15 * factor)
    east_m, north_m = block.images[0].nadir_m
    coarse = GroundGrid(east_m, north_m, 0.15 * factor, side, side)
    half = 0.15 * (factor - 1) / 2
    fine = GroundGrid(east_m - half, north_m + half, 0.15, side * factor, side * factor)
    bands, nodes = ("pan", *block.images[0].colour), np.zeros((5, 2, 2))
    gains = {0: GainField(0.0, 0.0, (64.0, 64.0), nodes, nodes)}

    def tile(grid: GroundGrid) -> np.ndarray:
        owner = np.zeros((grid.height_px // CELL_PX, grid.width_px // CELL_PX), np.int32)
        return render_tile(block, bands, TileJob(0, 0, 0, 0, grid, owner, gains)).astype(float)

    means = tile(fine).reshape(len(bands), side, factor, side, factor).mean(axis=(2, 4))
    found = tile(coarse)
    assert found.min() > 0.0
    detail = means.std(axis=(1, 2))
    difference = np.sqrt(np.mean((found - means) ** 2, axis=(1, 2)))
    assert (difference < 0.06 * detail).all()


def test_tiles_of_another_geometry_or_other_code_have_another_key(flown, monkeypatch) -> None:
    block = _block(flown)
    first = block.images[0]
    keys = {block.key(), _block(flown).key()}
    assert len(keys) == 1
    for changed in ({"f_mm": first.pose.f_mm + 0.01}, {"pixel_mm": first.pose.pixel_mm * 1.01}):
        image = replace(first, pose=replace(first.pose, **changed))
        keys.add(replace(block, images=(image, *block.images[1:])).key())
    monkeypatch.setattr(inputs, "software_identity", lambda: {"software": "another"})
    keys.add(block.key())
    assert len(keys) == 4


def test_a_view_to_the_horizon_is_refused_and_low_ground_widens_the_reach() -> None:
    turned = rotation_matrix(np.radians(65.0), 0.0, 0.0)
    down = ImagePose(100.0, 0.01, 8000, 6000, np.zeros(3), np.eye(3))
    assert corner_slope(down) == pytest.approx(0.5)
    assert corner_slope(replace(down, rotation=turned)) == np.inf
    heights = np.full((200, 200), 500.0)
    heights[:, 120:] = 0.0
    model = HeightModel(heights, 0.0, 1990.0, 10.0, -10.0)
    plain = ground_reach_m(down, (300.0, 1000.0), 1000.0, 500.0)
    assert plain == pytest.approx(275.0)
    assert ground_reach_m(down, (300.0, 1000.0), 1000.0, model) < 1.5 * plain
    assert ground_reach_m(down, (1200.0, 1000.0), 1000.0, model) == pytest.approx(550.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--ground-height", "99999"], "is not below all cameras"),
        (["--gsd", "-1"], "positive"),
        (["--gsd", "inf"], "positive"),
        (["--gsd", "100"], "Give a smaller --gsd, in metres"),
        (["--gsd", "2.5"], "smaller --gsd, in metres, such as 1.2"),
        (["--gsd", "0.0001"], "larger --gsd"),
        (["--bits", "12"], "16 or 8"),
        (["--image", "nir"], "pan, rgb or cir"),
        (["--ground-height", "400", "--elevation", "dtm.asc"], "exclude each other"),
        (["--elevation", "missing.tif"], "missing.tif"),
        (["--triangulation", "nowhere"], "nowhere"),
    ],
)
def test_wrong_options_are_refused_with_the_cure(flown, tmp_path, options, words) -> None:
    out = tmp_path / "refused"
    done = RUN.invoke(app, ["orthomosaic", *_arguments(flown, out, *options)])
    assert done.exit_code != 0
    assert words in " ".join(f"{done.output} {done.exception}".split())
    assert not out.exists()


def test_a_height_model_elsewhere_gives_no_image(flown, tmp_path) -> None:
    model = tmp_path / "elsewhere.asc"
    model.write_text("ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 50\n1 1\n1 1\n")
    out = tmp_path / "empty"
    done = RUN.invoke(app, ["orthomosaic", *_arguments(flown, out, "--elevation", str(model))])
    assert done.exit_code != 0 and "no image covers the ground" in str(done.exception)
    assert not out.exists()


def test_an_unreadable_image_is_listed_and_colour_that_is_missing_named(flown, tmp_path) -> None:
    mission = tmp_path / "mission"
    shutil.copytree(flown.mission, mission, ignore=shutil.ignore_patterns("export"))
    image = mission / "L2/000002/pan.tif"
    image.write_bytes(image.read_bytes()[:-2])
    (mission / "L2/000004/rgbn.tif").unlink()
    done = RUN.invoke(
        app,
        ["orthomosaic", str(mission), "--trajectory", str(flown.folder / "trajectory.csv"),
         "--gsd", "0.6", "--json"],
    )  # fmt: skip
    assert done.exit_code == 1, done.output
    report = json.loads(done.stdout)
    assert [one["exposure"] for one in report["failures"]] == [2]
    assert report["images"] == 5 and report["bands"] == ["pan"]
    assert "red: 1 of 5 images have none" in report["left_out"][0]
    assert set(report["files"]) == {"pan-16.tif", "pan-8.tif"}
    assert (mission / "export/orthomosaic/pan-8.tif").exists()


def test_other_pixels_are_not_mixed_with_stored_tiles(flown, tmp_path, monkeypatch) -> None:
    """Interrupted, then an image changes: the tiles that were stored are not used."""
    mission = tmp_path / "mission"
    shutil.copytree(flown.mission, mission, ignore=shutil.ignore_patterns("export"))
    options = ["orthomosaic", str(mission), "--trajectory", str(flown.folder / "trajectory.csv"),
               "--gsd", "0.6", "--image", "pan", "--bits", "16", "--json"]  # fmt: skip

    def interrupted(*_args, **_kwargs):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(making, "tone_curves", interrupted)
        assert RUN.invoke(app, options).exit_code != 0
    image = mission / "L2/000001/pan.tif"
    shutil.copyfile(mission / "L2/000003/pan.tif", image)
    done = RUN.invoke(app, options)
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    assert report["tiles_computed"] >= report["width_px"] * report["height_px"] / TILE_PX**2

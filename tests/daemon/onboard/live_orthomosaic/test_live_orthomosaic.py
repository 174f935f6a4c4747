"""The orthomosaic that grows in flight, held against the emulator's ideal orthoimage."""

from __future__ import annotations

import json
import resource
import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio
from typer.testing import CliRunner

from benchmarks.orthomosaic import lit
from daemon.cli import app
from daemon.mission.layout import Mission
from daemon.mission.store.level0 import read_tiff
from daemon.onboard.live_orthomosaic import mission_map
from daemon.onboard.live_orthomosaic.block_gains import owners_of
from daemon.onboard.live_orthomosaic.live_orthomosaic import BYTES_PER_EXPOSURE
from daemon.onboard.live_orthomosaic.map_ground import PlaneGround, plane_through
from daemon.onboard.live_orthomosaic.map_layout import tile_file
from daemon.onboard.live_orthomosaic.mission_map import MissionMap
from daemon.onboard.live_orthomosaic.tile_files import merged, relative_change
from daemon.onboard.monitoring.maps.pmtiles import PmtilesMap
from daemon.onboard.triangulation.mission_triangulation import MissionTriangulation
from daemon.orientation.exterior_orientation import sealed_exposures
from processing.image.orthoimage.levelling import levelled
from sim_hw.world.scene import open_scene
from tests.daemon.flown_block import read_record, write_image, write_record
from tests.daemon.onboard.conftest import EACH, LINES
from tests.daemon.onboard.live_orthomosaic.map_truth import MapTruth, displacements

GSD_M = 0.8
RUN = CliRunner()


@pytest.fixture
def copied(flown, tmp_path) -> Path:
    shutil.copytree(flown.mission, tmp_path / "mission", ignore=shutil.ignore_patterns("export"))
    return tmp_path / "mission"


@pytest.fixture
def truth(flown) -> MapTruth:
    scene = open_scene(flown.world.scene_settings, flown.mission.parent / "scenes")
    return MapTruth(flown.world, scene, flown.flight)


def _flown_map(
    mission: Path, ground: MapTruth | None = None, count: int = EACH * LINES
) -> tuple[MissionMap, list[dict]]:
    """Fly the block, or its first exposures; the events of each."""
    folder = Mission.open(mission)
    done = MissionTriangulation(folder)
    events: list[dict] = []
    growing = MissionMap(done, events.append, GSD_M)
    if ground is not None:
        growing._ground = lambda: ground
    read = sealed_exposures(folder).results
    for number in sorted(read)[:count]:
        blocks = done.block_count
        done.add(read[number])
        if done.block_count != blocks:
            growing.block_adjusted()
    done.land()
    return growing, events


def test_pixels_are_where_the_ideal_orthoimage_has_them(copied, truth) -> None:
    growing, _ = _flown_map(copied, truth)
    before = displacements(growing.live, truth)
    growing.block_adjusted()
    after = displacements(growing.live, truth)
    assert before["windows"] >= 80 and before["seam_windows"] >= 10
    assert before["rms_px"] < 0.3 and before["seam_rms_px"] < 0.42
    assert after["rms_px"] < 0.3 and after["seam_rms_px"] < 0.42


def test_without_a_height_model_the_plane_lies_through_the_tie_points(copied, truth) -> None:
    growing, events = _flown_map(copied)
    assert events[0]["ground"]["source"] == "plan"
    growing.block_adjusted()
    ground = growing.live.as_json()["ground"]
    assert ground["kind"] == "plane" and ground["source"] == "tie points"
    place = growing.live.frame
    there = (np.array([[place.latitude_deg]]), np.array([[place.longitude_deg]]))
    plane = growing.live.ground.heights_m(*there)
    assert plane == pytest.approx(truth.heights_m(*there), abs=2.0)
    assert displacements(growing.live, truth)["rms_px"] < 0.3


def test_each_exposure_publishes_coarse_tiles_first_and_at_most_60_kb(copied) -> None:
    _, events = _flown_map(copied)
    own = [event for event in events if "number" in event]
    assert [event["number"] for event in own] == list(range(1, EACH * LINES + 1))
    for event in own:
        zooms = [tile[0] for tile in event["tiles"]]
        assert zooms == sorted(zooms) and zooms[-1] == event["zoom"]
        assert 0 < sum(tile[4] for tile in event["tiles"]) <= BYTES_PER_EXPOSURE
        assert event["pending"] == 0
    versions = [tile[3] for event in events for tile in event["tiles"]]
    assert versions == list(range(1, len(versions) + 1))


def test_a_tile_that_hardly_changed_waits_for_the_end_of_the_line(copied) -> None:
    growing, _ = _flown_map(copied)
    files = growing.live.files
    growing.live.publish_levelled()
    tile = growing.live.tiles[0]
    signal = files.signal(tile)
    brighter = np.rint(signal * 1.01).astype(np.uint16)
    files.put(tile, brighter)
    assert growing.live._publish(0.02, 1e9) == []
    (sent,) = growing.live.publish_levelled()
    assert sent.tile == tile
    files.put(tile, np.rint(brighter * 1.03).astype(np.uint16))
    assert [one.tile for one in growing.live._publish(0.02, 1e9)] == [tile]
    files.put(tile, np.rint(brighter * 1.031).astype(np.uint16), has_moved=True)
    assert [one.tile for one in growing.live._publish(0.02, 1e9)] == [tile]


def test_seams_differ_by_less_than_one_percent_with_hot_spot_haze_and_changed_exposure(
    copied, truth
) -> None:
    exposures = np.random.default_rng(4).uniform(0.6, 1.0, EACH * LINES)
    for number, exposure in enumerate(exposures, 1):
        signal = read_tiff(copied / f"L2/{number:06d}/pan.tif").astype(np.float64)
        heading = np.pi if (number - 1) // EACH % 2 else 0.0
        shown = np.rint(lit(signal, heading, float(exposure)))
        write_image(copied, number, shown.clip(0, 65534).astype(np.uint16) & 0xFFFE)
    growing, _ = _flown_map(copied, truth)
    growing.block_adjusted()
    assert _seam_step(growing.live.images, is_levelled=False) > 0.1
    assert _seam_step(growing.live.images, is_levelled=True) < 0.01


def _seam_step(images, *, is_levelled: bool) -> float:
    """RMS of the relative difference of the two images of a seam in the cells along it."""
    rows = slice(min(i.covered[0].start for i in images), max(i.covered[0].stop for i in images))
    columns = slice(min(i.covered[1].start for i in images), max(i.covered[1].stop for i in images))
    shape = (rows.stop - rows.start, columns.stop - columns.start)
    signals = np.full((len(images), *shape), np.nan)
    for k, one in enumerate(images):
        r, c = one.covered
        signals[k][
            r.start - rows.start : r.stop - rows.start,
            c.start - columns.start : c.stop - columns.start,
        ] = levelled(one.levels, one.gain)[0] if is_levelled else one.levels.log_signal[0]
    owner = owners_of(images, rows, columns)
    taken = np.take_along_axis(signals, np.maximum(owner, 0)[None], axis=0)[0]
    step = np.expm1(signals - taken)
    number = np.arange(len(images))[:, None, None]
    along = np.zeros(step.shape, bool)
    along[:, 1:] |= owner[:-1] == number
    along[:, :-1] |= owner[1:] == number
    along[:, :, 1:] |= owner[:, :-1] == number
    along[:, :, :-1] |= owner[:, 1:] == number
    others = np.isfinite(step) & along & (number != owner)
    return float(np.sqrt(np.mean(step[others] ** 2)))


def test_landing_writes_a_cog_and_pmtiles_marked_preliminary_and_repeats_to_the_byte(
    copied,
) -> None:
    done = RUN.invoke(app, ["triangulate", str(copied), "--live", "--json"])
    assert done.exit_code == 0, done.output + str(done.exception)
    about = json.loads(done.stdout)["orthomosaic"]
    folder = copied / "export/live-orthomosaic"
    assert about["images"] == EACH * LINES and about["problems"] == []
    assert not (folder / "work").exists()
    state = json.loads((folder / "orthomosaic.json").read_text())
    assert state["is_preliminary"] and state["is_complete"] and state["simulated"]
    with rasterio.open(folder / "orthomosaic.tif") as raster:
        assert raster.tags()["SYNTOPIC_PRELIMINARY"] == "YES"
        assert raster.tags()["SYNTOPIC_SIMULATED"] == "YES"
        assert raster.crs.to_epsg() == 3857 and raster.dtypes == ("uint16",)
        assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert (raster.read(1) > 0).mean() > 0.05
        west, north = raster.transform.c, raster.transform.f
    tiles = PmtilesMap(folder / "orthomosaic.pmtiles")
    try:
        assert "preliminary" in tiles.description.name
        assert tiles.description.max_zoom == about["zoom"]
        files = sorted((folder / "tiles").rglob("*.webp"))
        for path in files:
            zoom, x, y = (int(v) for v in (*path.parts[-3:-1], path.stem))
            found = tiles.tile(zoom, x, y)
            assert found.data == path.read_bytes() and found.media_type == "image/webp"
        assert tiles.tile(about["zoom"], 0, 0) is None
    finally:
        tiles.close()
    bounds = tiles.description.bounds
    assert west == pytest.approx(bounds[0] * 20037508.342789244 / 180.0, abs=0.5)
    assert north > 0 and bounds[1] < 90
    products = ("orthomosaic.tif", "orthomosaic.pmtiles")
    first = {name: (folder / name).read_bytes() for name in products}
    again = RUN.invoke(app, ["triangulate", str(copied), "--live"])
    assert again.exit_code == 0 and "Preliminary orthomosaic of 10 images" in again.output
    assert {name: (folder / name).read_bytes() for name in products} == first


def test_versions_grow_over_a_restart(copied) -> None:
    first, events = _flown_map(copied)
    last = first.live.files.version
    again, events = _flown_map(copied)
    assert events[0]["tiles"][0][3] == last + 1
    tile = again.live.tiles[0]
    assert tile_file(again.folder, tile).exists()


def test_a_failed_disk_stops_the_map_until_the_end_of_the_line_and_it_catches_up(
    copied, monkeypatch
) -> None:
    sentences: list[str] = []
    events: list[dict] = []
    folder = Mission.open(copied)
    done = MissionTriangulation(folder)
    growing = MissionMap(done, events.append, GSD_M, sentences.append)
    read = sealed_exposures(folder).results

    def refuse(*_args: object) -> None:
        raise OSError("disk full")

    for number in range(1, EACH * LINES + 1):
        blocks = done.block_count
        with monkeypatch.context() as patch:
            if number in (2, 3):
                patch.setattr(mission_map.LiveOrthomosaic, "add", refuse)
            assert done.add(read[number]).orientation is not None
        if done.block_count != blocks:
            growing.block_adjusted()
    (sentence,) = sentences
    assert "disk full" in sentence and "syntopic orthomosaic" in sentence
    numbers = [event["number"] for event in events if "number" in event]
    assert numbers == [1, *range(EACH + 2, EACH * LINES + 1)]
    own = [event for event in events if event.get("number", 0) > EACH]
    assert [event["images"] for event in own] == [3, 6, 9, 10]
    assert max(sum(tile[4] for tile in event["tiles"]) for event in own) <= BYTES_PER_EXPOSURE
    versions = [tile[3] for event in events for tile in event["tiles"]]
    assert versions == sorted(set(versions))
    done.land()
    assert growing.deliver()
    state = json.loads((growing.folder / "orthomosaic.json").read_text())
    assert state["is_complete"] and state["images"] == EACH * LINES and not state["not_placed"]


def test_images_that_come_too_late_at_landing_are_named(copied, monkeypatch) -> None:
    folder = Mission.open(copied)
    done = MissionTriangulation(folder)
    growing = MissionMap(done, lambda _event: None, GSD_M)
    read = sealed_exposures(folder).results
    growing.has_failed = True
    for number in (1, 2, 3):
        done.add(read[number])
    (copied / "L2/000001/pan.tif").write_bytes(b"no image")
    monkeypatch.setattr(mission_map, "LANDING_S", -1.0)
    done.land()
    assert growing.deliver()
    assert growing.live.not_placed == dict.fromkeys((1, 2, 3), mission_map.BEHIND)
    monkeypatch.setattr(mission_map, "LANDING_S", 60.0)
    growing.live.not_placed.clear()
    assert growing.deliver() and len(growing.live.images) == 2
    assert "cannot be read again" in growing.live.not_placed[1]


def test_a_disk_that_is_full_when_the_cog_is_written_is_stated(copied) -> None:
    """GDAL reports it with an error of its own, which is no OSError."""
    growing, _ = _flown_map(copied, count=3)
    sentences: list[str] = []
    growing._on_failure = sentences.append
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, before[1]))
    try:
        assert not growing.deliver()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    (sentence,) = sentences
    assert "the GeoTIFF cannot be written" in sentence
    assert not list(growing.folder.rglob("*.plain.tif")) + list(growing.folder.glob(".*"))
    assert not (growing.folder / "orthomosaic.tif").exists()


def test_the_map_goes_on_where_the_mission_is(copied, tmp_path) -> None:
    """Another disk leads; its copy of the mission has no products."""
    growing, events = _flown_map(copied, count=3)
    elsewhere = tmp_path / "other"
    shutil.copytree(copied, elsewhere, ignore=shutil.ignore_patterns("export", "L2"))
    growing._done.mission = Mission(elsewhere, growing._done.mission.id)
    growing.use_mission()
    assert growing.deliver()
    state = json.loads((elsewhere / "export/live-orthomosaic/orthomosaic.json").read_text())
    assert state["is_complete"] and state["images"] == 3
    assert {f"{z}/{x}/{y}.webp" for e in events for z, x, y, *_ in e["tiles"]} == {
        str(path.relative_to(elsewhere / "export/live-orthomosaic/tiles"))
        for path in (elsewhere / "export").rglob("*.webp")
    }


def test_the_map_begins_again_where_the_earlier_disk_cannot_be_read(copied, tmp_path) -> None:
    growing, _ = _flown_map(copied, count=3)
    sentences: list[str] = []
    growing._on_failure = sentences.append
    shutil.rmtree(growing.folder / "work")
    growing.live.files._signals.clear()
    (growing.folder / "work").write_bytes(b"")
    elsewhere = tmp_path / "other"
    shutil.copytree(copied, elsewhere, ignore=shutil.ignore_patterns("export", "L2"))
    growing._done.mission = Mission(elsewhere, growing._done.mission.id)
    growing.use_mission()
    assert len(sentences) == 1 and growing.live is None
    assert growing.deliver()
    assert set(growing.live.not_placed) >= {1, 2, 3}


def test_exposures_that_are_not_in_the_map_are_named_with_the_reason(copied) -> None:
    record = read_record(copied, 2)
    del record["navigation"]
    write_record(copied, record)
    growing, _ = _flown_map(copied)
    growing.deliver()
    state = json.loads((growing.folder / "orthomosaic.json").read_text())
    assert state["not_placed"] == [{"exposure": 2, "reason": "no navigation"}]
    assert state["images"] == EACH * LINES - 1


def test_an_image_that_nothing_ties_is_placed_by_its_measured_orientation(copied) -> None:
    folder = Mission.open(copied)
    done = MissionTriangulation(folder)
    growing = MissionMap(done, lambda _event: None)
    done.add(sealed_exposures(folder).results[1])
    assert growing.live.as_json()["measured_only"] == 1


def test_a_plane_ignores_wrong_points_and_refuses_to_guess_from_few() -> None:
    random = np.random.default_rng(2)
    places = np.column_stack([
        48.0 + random.uniform(0, 0.02, 200), 15.0 + random.uniform(0, 0.02, 200), np.zeros(200),
    ])  # fmt: skip
    per = (111_000.0, 74_000.0)
    slope = 0.01
    places[:, 2] = 300.0 + slope * (places[:, 0] - 48.0) * per[0] + random.normal(0, 0.1, 200)
    places[::20, 2] += 80.0
    plane = plane_through(places, per)
    at = plane.heights_m(np.array([48.0, 48.02]), np.array([15.0, 15.0]))
    assert at == pytest.approx([300.0, 300.0 + slope * 0.02 * per[0]], abs=0.1)
    assert plane.relief_rms_m == pytest.approx(0.1, rel=0.3)
    assert plane_through(places[:20], per) is None
    assert PlaneGround(48.0, 15.0, 5.0).as_json()["source"] == "plan"


def test_change_and_merging_of_tiles() -> None:
    empty, full = np.zeros((256, 256), np.uint16), np.full((256, 256), 1000, np.uint16)
    half = full.copy()
    half[:128] = 0
    assert relative_change(None, full) == 1.0 and relative_change(empty, empty) == 0.0
    assert relative_change(half, full) == pytest.approx(0.5)
    assert relative_change(full, full * 0 + 1010) == pytest.approx(10 / 1010, rel=1e-4)
    together = merged([full, None, half, full])
    assert (together[:128, :128] == 1000).all() and (together[:128, 128:] == 0).all()
    assert (together[128:192, :128] == 0).all() and (together[192:, :128] == 1000).all()

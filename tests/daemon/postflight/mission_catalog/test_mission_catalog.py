"""A catalog over folders and a bucket, read by geopandas, GDAL and pystac, and queried."""

from __future__ import annotations

import json
import math
import shlex
from pathlib import Path

import pyarrow.parquet
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.layout import Mission
from daemon.mission.store.output_places import OutputPlaceError
from daemon.mission.transfer.object_store import ObjectStore
from daemon.mission.transfer.store_transfer import transfer_to_store
from tests.daemon.mission.stores.conftest import mission as mission
from tests.daemon.mission.stores.conftest import store as store
from tests.daemon.postflight.gis.test_stac import problems
from tests.daemon.small_camera import RIG_TOML

geopandas = pytest.importorskip("geopandas", reason="pip install 'syntopic[catalog]'")
pyogrio = pytest.importorskip("pyogrio")
pystac = pytest.importorskip("pystac")
pytestmark = pytest.mark.peer

EPOCH_NS = 1_479_300_000_000_000_000
STEP_DEG = 0.01
GROUND_M, HEIGHT_M = 400.0, 1400.0


def lay_out(root: Path, name: str, count: int, longitude_deg: float) -> Path:
    """Records of level images eastward of a place, one a hundredth of a degree; no frames."""
    path = root / name
    path.mkdir(parents=True)
    (path / "rig.toml").write_text(RIG_TOML)
    (path / "service.toml").write_text(f"[plan]\nground_height_m = {GROUND_M}\n")
    for number in range(1, count + 1):
        folder = path / f"L0/{number:06d}"
        folder.mkdir(parents=True)
        instant = EPOCH_NS + number * 60_000_000_000
        navigation = {
            "gps_ns": str(instant), "latitude_deg": 47.0,
            "longitude_deg": longitude_deg + (number - 1) * STEP_DEG, "height_m": HEIGHT_M,
            "roll_rad": 0.0, "pitch_rad": 0.0, "heading_rad": 0.0,
        }  # fmt: skip
        if number == count:
            del navigation["roll_rad"]
        record = {
            "number": number, "mark_gps_ns": str(instant), "mark_sigma_ns": 25,
            "mark_source": "event-mark", "line_id": "line 1", "navigation": navigation,
            "frames": [{"sensor": "SU00", "file": "SU00.tif", "sha256": f"{number:064x}"}],
        }  # fmt: skip
        (folder / "exposure.json").write_text(json.dumps(record))
        products = path / f"L2/{number:06d}"
        products.mkdir(parents=True)
        verdict = "refly" if number == 2 else "good"
        (products / "quality.json").write_text(json.dumps({"verdict": verdict}))
    return path


def run(*arguments: str, status: int = 0) -> dict:
    done = CliRunner().invoke(app, ["catalog", *arguments, "--json"])
    assert done.exit_code == status, done.output + repr(done.exception)
    return json.loads(done.stdout)


@pytest.fixture
def season(tmp_path: Path) -> Path:
    for name, count, longitude in (("a", 4, 16.0), ("b", 3, 17.0)):
        lay_out(tmp_path / "missions", name, count, longitude)
    done = run("build", str(tmp_path / "season"), str(tmp_path / "missions"))
    assert (done["missions"], done["exposures"], done["failures"]) == (2, 7, [])
    return tmp_path / "season"


def numbers(season: Path, *conditions: str) -> list[tuple[str, int]]:
    found = run("query", str(season), *conditions)["exposures"]
    return [(one["mission"], one["exposure"]) for one in found]


ALL = [("a", 1), ("a", 2), ("a", 3), ("a", 4), ("b", 1), ("b", 2), ("b", 3)]


def test_both_tables_hold_what_the_records_state(season: Path) -> None:
    table = geopandas.read_parquet(season / "exposures.parquet")
    package = pyogrio.read_dataframe(season / "exposures.gpkg")
    for one in (table, package):
        assert one.crs.to_epsg() == 4326 and len(one) == 7
        assert list(zip(one["mission"], one["exposure"], strict=True)) == ALL
        assert list(one["verdict"]) == ["good", "refly", "good", "good", "good", "refly", "good"]
    first = table.iloc[0]
    assert first["gps_ns"] == EPOCH_NS + 60_000_000_000
    assert package["gps_ns"][0] == str(EPOCH_NS + 60_000_000_000)
    assert first["utc"].timestamp() == pytest.approx((EPOCH_NS + 6e10) * 1e-9 + 315_964_800 - 18)
    assert first["gsd_m"] == pytest.approx(1000.0 * 7.2e-3 / 100.0)
    assert first["frame_sha256"] == f"SU00:{1:064x}" and first["sensors"] == "SU00"
    # 64 x 48 px of 7.2 um at 100 mm, 1000 m above the ground, about the point below.
    metric = table.geometry.to_crs(32633)
    assert metric[0].area == pytest.approx((64 * 0.072) * (48 * 0.072), rel=0.01)
    assert table.geometry[1].centroid.x == pytest.approx(16.01, abs=1e-6)
    assert table.geometry[3] is None, "without an attitude there is no footprint"
    metadata = pyarrow.parquet.read_schema(season / "exposures.parquet").metadata
    assert json.loads(metadata[b"geo"])["primary_column"] == "geometry"


def test_stac_clients_read_the_catalog(season: Path) -> None:
    catalog = pystac.Catalog.from_file(str(season / "catalog.json"))
    children = list(catalog.get_children())
    assert [one.id for one in children] == ["a", "b"]
    items = [item for one in children for item in one.get_items()]
    assert [item.id for item in items] == [
        "a-000001",
        "a-000002",
        "a-000003",
        "b-000001",
        "b-000002",
    ]
    for file in season.glob("*/*.json"):
        content = json.loads(file.read_text())
        assert problems(content) == [], file
    assert Path(items[0].assets["record"].href).is_file()


def test_queries_by_place_time_and_quality(season: Path, tmp_path: Path) -> None:
    assert numbers(season) == ALL
    assert numbers(season, "--bbox", "16.005", "46.9", "16.025", "47.1") == [("a", 2), ("a", 3)]
    ring = [[16.995, 46.9], [17.005, 46.9], [17.005, 47.1], [16.995, 47.1], [16.995, 46.9]]
    polygon = tmp_path / "block.geojson"
    polygon.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    assert numbers(season, "--polygon", str(polygon)) == [("b", 1)]
    utc = [one["utc"] for one in run("query", str(season), "--mission", "a")["exposures"]]
    assert numbers(season, "--mission", "a", "--since", utc[1], "--until", utc[2]) == [
        ("a", 2), ("a", 3),
    ]  # fmt: skip
    assert numbers(season, "--verdict", "refly") == [("a", 2), ("b", 2)]
    assert numbers(season, "--gsd-max", "0.0719") == []
    assert numbers(season, "--gsd-max", "0.0721") == ALL
    sun = geopandas.read_parquet(season / "exposures.parquet")["sun_elevation_deg"]
    limit = str(sun.sort_values().iloc[3])
    assert len(numbers(season, "--sun-min", limit)) == 4
    assert not math.isnan(sun.max())


def test_a_selection_is_what_process_takes(season: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(
        app, ["catalog", "query", str(season), "--verdict", "refly", "--commands"]
    )
    lines = [shlex.split(line) for line in done.stdout.splitlines()]
    places = [str(tmp_path / "missions" / name) for name in ("a", "b")]
    assert lines == [["syntopic", "process", place, "--only", "2"] for place in places]


def test_a_mission_in_a_store_is_processed_by_a_command_like_any_other(season: Path) -> None:
    table = geopandas.read_parquet(season / "exposures.parquet")
    table.loc[table["mission"] == "b", "place"] = "s3://survey/2026/b"
    table.to_parquet(season / "exposures.parquet")
    query = ["catalog", "query", str(season), "--verdict", "refly", "--commands"]
    done = CliRunner().invoke(app, query)
    places = [shlex.split(line)[2] for line in done.stdout.splitlines()]
    assert done.exit_code == 0 and len(places) == 2 and places[1] == "s3://survey/2026/b"


def test_a_bucket_and_a_folder_give_the_same_rows(
    season: Path, tmp_path: Path, mission: Mission, store
) -> None:
    url = store()
    transfer_to_store(mission, ObjectStore(url))
    local = run("build", str(tmp_path / "local"), str(mission.path))
    remote = run("build", str(tmp_path / "remote"), url)
    assert local["exposures"] == remote["exposures"] == 8
    tables = [
        geopandas.read_parquet(tmp_path / name / "exposures.parquet").drop(columns="place")
        for name in ("local", "remote")
    ]
    assert tables[0].equals(tables[1])
    one = run("build", str(tmp_path / "one"), f"{url}/{mission.id}", str(tmp_path / "missions"))
    assert (one["missions"], one["exposures"]) == (3, 15)


def test_a_damaged_mission_is_stated_and_the_others_are_there(season: Path, tmp_path: Path) -> None:
    (tmp_path / "missions/a/rig.toml").write_text("broken")
    record = tmp_path / "missions/b/L0/000001/exposure.json"
    record.write_text(record.read_text()[:40])
    done = run("build", str(season), status=1)
    assert (done["missions"], done["exposures"]) == (1, 2)
    assert len(done["failures"]) == 2
    assert str(tmp_path / "missions/a") in done["failures"][0]
    assert "000001" in done["failures"][1]


def test_the_same_mission_at_two_places_counts_once(season: Path, tmp_path: Path) -> None:
    lay_out(tmp_path / "copy", "a", 4, 16.0)
    done = run("build", str(season), str(tmp_path / "missions"), str(tmp_path / "copy"), status=1)
    assert done["exposures"] == 7 and "the same mission" in done["failures"][0]


def test_a_further_place_is_added_and_replaces_only_on_request(
    season: Path, tmp_path: Path
) -> None:
    other = lay_out(tmp_path / "other", "c", 2, 18.0)
    done = run("build", str(season), f"file://{other.parent}")
    assert (done["missions"], done["exposures"]) == (3, 9)
    again = run("build", str(season), str(other.parent))
    assert (again["missions"], again["exposures"], again["failures"]) == (3, 9, [])
    assert run("build", str(season))["missions"] == 3
    only = run("build", str(season), str(other.parent), "--replace")
    assert (only["missions"], only["exposures"]) == (1, 2)
    assert run("build", str(season))["missions"] == 1


def test_a_box_across_the_antimeridian_finds_both_sides(tmp_path: Path) -> None:
    lay_out(tmp_path / "missions", "east", 3, 179.98)
    lay_out(tmp_path / "missions", "west", 2, -179.97)
    lay_out(tmp_path / "missions", "across", 2, 180.0)
    lay_out(tmp_path / "missions", "far", 2, 10.0)
    season = tmp_path / "season"
    run("build", str(season), str(tmp_path / "missions"))
    both = [("across", 1), ("east", 1), ("east", 2), ("west", 1)]
    assert numbers(season, "--bbox", "179", "46", "-179", "48") == both
    assert numbers(season, "--bbox", "179.985", "46", "-179.99", "48") == [
        ("across", 1), ("east", 2),
    ]  # fmt: skip
    # A footprint across it reaches on neither side around the earth.
    assert numbers(season, "--bbox", "-10", "46", "20", "48") == [("far", 1)]
    table = geopandas.read_parquet(season / "exposures.parquet")
    across = table.geometry[table["mission"] == "across"].iloc[0]
    assert across.geom_type == "MultiPolygon" and across.area < 1e-6
    assert len(pyogrio.read_dataframe(season / "exposures.gpkg")) == 9


DEEP = "[" * 100_000
UTM = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}}
WGS84 = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}


def square(west: float, south: float, size: float, **members: object) -> str:
    ring = [(0, 0), (size, 0), (size, size), (0, size), (0, 0)]
    coordinates = [[[west + x, south + y] for x, y in ring]]
    return json.dumps({"type": "Polygon", "coordinates": coordinates, **members})


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (DEEP, "nested too deeply"),
        (square(500_000, 5_200_000, 9_000), "no degrees"),
        (square(16, 47, 100), "no degrees"),
        (square(16, 47, 1, crs=UTM), "EPSG::32633; GeoJSON is in WGS 84"),
        (square(16, 47, 1, crs={"type": "link"}), "GeoJSON is in WGS 84"),
        (square(30, 47, 1), "have no area in common"),
        ("[]", "no polygon"),
    ],
)
def test_a_polygon_that_cannot_be_meant_is_refused(
    season: Path, tmp_path: Path, text: str, sentence: str
) -> None:
    (tmp_path / "p.geojson").write_text(text)
    box = ["--bbox", "15", "46", "18", "48"] if "common" in sentence else []
    query = ["catalog", "query", str(season), "--polygon", str(tmp_path / "p.geojson"), *box]
    done = CliRunner().invoke(app, query)
    assert done.exit_code != 0 and sentence in str(done.exception), repr(done.exception)


def test_a_polygon_that_names_wgs84_is_taken(season: Path, tmp_path: Path) -> None:
    (tmp_path / "p.geojson").write_text(square(16.995, 46.9, 0.01 + 0.19, crs=WGS84))
    assert numbers(season, "--polygon", str(tmp_path / "p.geojson")) == [("b", 1), ("b", 2)]


@pytest.mark.parametrize(
    ("condition", "sentence"),
    [
        ("--bbox nan nan nan nan", "is not on the earth"),
        ("--bbox 16 48 17 47", "its south is above its north"),
        ("--bbox 16 47 190 48", "is not on the earth"),
        ("--bbox 16 47 17 inf", "is not on the earth"),
        ("--verdict bad", "give good, usable, refly"),
        ("--mission z", "has no mission z; it has a, b"),
        ("--since 2026-11-22 --until 2026-11-21", "is after --until"),
        ("--gsd-max nan", "positive number"),
        ("--gsd-max -1", "positive number"),
        ("--gsd-max 0", "positive number"),
        ("--sun-min nan", "from -90 to 90"),
        ("--sun-min 91", "from -90 to 90"),
    ],
)
def test_a_condition_that_no_exposure_can_fulfil_is_refused(
    season: Path, condition: str, sentence: str
) -> None:
    done = CliRunner().invoke(app, ["catalog", "query", str(season), *condition.split()])
    assert done.exit_code != 0 and sentence in str(done.exception), repr(done.exception)


@pytest.mark.parametrize("text", ["[]", "7", DEEP, '{"syntopic:sources": 3}'])
def test_a_file_that_is_no_catalog_is_not_replaced(tmp_path: Path, text: str) -> None:
    lay_out(tmp_path / "missions", "a", 2, 16.0)
    (tmp_path / "season").mkdir()
    (tmp_path / "season/catalog.json").write_text(text)
    command = ["catalog", "build", str(tmp_path / "season"), str(tmp_path / "missions")]
    done = CliRunner().invoke(app, command)
    assert done.exit_code != 0 and "is not empty and no catalog" in str(done.exception)
    assert (tmp_path / "season/catalog.json").read_text() == text


def test_files_of_others_next_to_a_catalog_are_not_removed(season: Path, tmp_path: Path) -> None:
    notes = season / "notes.txt"
    notes.write_text("mine")
    command = ["catalog", "build", str(season), str(tmp_path / "missions")]
    done = CliRunner().invoke(app, command)
    assert isinstance(done.exception, OutputPlaceError) and notes.read_text() == "mine"
    notes.unlink()
    assert run("build", str(season))["exposures"] == 7


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("build", "{tmp}/missions", "{tmp}/missions"), "no catalog"),
        (("build", "{tmp}/new"), "no place is given"),
        (("build", "{tmp}/season", "--replace"), "--replace needs the places"),
        (("build", "{tmp}/season", "http://host/x"), "file:///folder"),
        (("build", "{tmp}/new", "{tmp}/nothing"), "no mission"),
        (("query", "{tmp}/missions"), "catalog build"),
        (("query", "{tmp}/season", "--since", "yesterday"), "write it as"),
        (("query", "{tmp}/season", "--polygon", "{tmp}/missions/a/rig.toml"), "no polygon"),
    ],
)
def test_what_cannot_be_done_is_refused_in_a_sentence(
    season: Path, tmp_path: Path, arguments: tuple[str, ...], sentence: str
) -> None:
    done = CliRunner().invoke(app, ["catalog", *(a.format(tmp=tmp_path) for a in arguments)])
    assert done.exit_code != 0 and sentence in str(done.exception), done.exception
    assert (tmp_path / "missions/a/L0").is_dir()

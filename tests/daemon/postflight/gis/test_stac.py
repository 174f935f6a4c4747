"""The STAC collection of a mission, read by pystac and checked by stac-validator, offline."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import socket
from pathlib import Path

import numpy as np
import pyproj
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from sim_hw.world.true_camera import BODY_FROM_CAMERA
from tests.daemon.postflight.exchange.flown_block import FLIGHT
from tests.daemon.postflight.gis.conftest import CRS, Exported, run
from tests.daemon.postflight.gis.stac_schemas import FIELDS, schemas, write_schemas

pystac = pytest.importorskip("pystac")
rasterio = pytest.importorskip("rasterio", reason="pip install 'syntopic[geotiff]'")
pytestmark = pytest.mark.peer


@pytest.fixture(autouse=True)
def offline(monkeypatch) -> None:
    """No test of this file opens a connection."""

    def refuse(*_arguments: object) -> None:
        raise AssertionError("a connection was opened")

    monkeypatch.setattr(socket.socket, "connect", refuse)


def items_of(exported: Exported) -> list:
    collection = pystac.Collection.from_file(exported.stac["collection"])
    return sorted(collection.get_items(), key=lambda item: item.id)


def problems(content: dict) -> list[str]:
    """What the schemas say about an item or a collection."""
    from jsonschema import Draft7Validator
    from referencing import Registry, Resource
    from referencing.jsonschema import DRAFT7

    known = schemas()
    registry = Registry().with_resources(
        [(uri, Resource.from_contents(schema, DRAFT7)) for uri, schema in known.items()]
    )
    kind = {"Feature": "item"}.get(content["type"], content["type"].lower())
    core = f"https://schemas.stacspec.org/v1.1.0/{kind}-spec/json-schema/{kind}.json"
    return [
        f"{'/'.join(map(str, error.absolute_path))}: {error.message}"
        for uri in (core, *content.get("stac_extensions", ()))
        for error in Draft7Validator(known[uri], registry=registry).iter_errors(content)
    ]


def test_collection_and_items_are_valid_by_their_schemas(exported: Exported) -> None:
    collection = Path(exported.stac["collection"])
    files = [collection, *collection.parent.glob("*/*.json")]
    assert len(files) == 4
    for file in files:
        content = json.loads(file.read_text())
        assert content["stac_version"] == "1.1.0"
        assert problems(content) == [], file.name


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("properties", "view:off_nadir"), -1.0),
        (("properties", "view:off_nadr"), 1.0),
        (("properties",), {"datetime": "2026-11-22T00:00:00Z"}),
        (("links",), [{"rel": "root", "href": "a.json", "file:sise": 1}]),
        (("properties", "proj:epsg"), 32633),
        (("assets", "cog_pan", "file:checksum"), "00" * 32),
        (("assets", "cog_pan", "proj:shape"), [10.5, 1]),
        (("assets", "cog_pan", "proj:bbox"), [1.0, 2.0, 3.0, 4.0, 5.0]),
        (("assets", "cog_pan", "proj:transform"), [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]),
        (("properties", "datetime"), "yesterday"),
        (("stac_version",), "1.0.0"),
    ],
)
def test_a_wrong_field_is_noticed_by_the_schemas(exported: Exported, path, value) -> None:
    file = next(iter(Path(exported.stac["collection"]).parent.glob("*/*.json")))
    content = json.loads(file.read_text())
    place = content
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    assert problems(content)


def test_stac_validator_accepts_every_object(exported: Exported, tmp_path: Path) -> None:
    validate = pytest.importorskip("stac_validator.stac_validator").StacValidate
    addresses = write_schemas(tmp_path / "schemas")
    collection = Path(exported.stac["collection"])
    for file in (collection, *collection.parent.glob("*/*.json")):
        run = validate(str(file), schema_map=addresses, extensions=False)
        assert run.run(), run.message
        assert run.message[0]["valid_stac"] and run.message[0]["version"] == "1.1.0"
    broken = json.loads(collection.read_text())
    del broken["extent"]
    (tmp_path / "broken.json").write_text(json.dumps(broken))
    run = validate(str(tmp_path / "broken.json"), schema_map=addresses)
    assert not run.run()


def test_pystac_reads_extent_times_and_extensions(exported: Exported) -> None:
    from pystac.extensions.file import FileExtension
    from pystac.extensions.projection import ProjectionExtension
    from pystac.extensions.view import ViewExtension

    collection = pystac.Collection.from_file(exported.stac["collection"])
    items = items_of(exported)
    assert collection.license == "CC-BY-4.0" and len(items) == 3
    start, end = collection.extent.temporal.intervals[0]
    assert start == items[0].datetime and end == items[-1].datetime
    # GPS 2026-11-22 less 18 leap seconds; microseconds.
    marks = list(exported.flown.marks.values())
    assert (items[0].datetime.timestamp() + 18 - 315_964_800) == pytest.approx(marks[0] * 1e-9)
    for item in items:
        west, south, east, north = collection.extent.spatial.bboxes[0]
        assert west <= item.bbox[0] <= item.bbox[2] <= east
        assert south <= item.bbox[1] <= item.bbox[3] <= north
        assert item.get_collection().id == collection.id
        assert ProjectionExtension.ext(item).code is None
        assert set(item.stac_extensions) == set(FIELDS)
        view = ViewExtension.ext(item)
        assert 0.0 < view.off_nadir < 10.0
        asset = item.assets["cog_rgbn"]
        path = Path(item.get_self_href()).parent / asset.href
        assert FileExtension.ext(asset).size == path.stat().st_size
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        assert FileExtension.ext(asset).checksum == "1220" + digest
        with rasterio.open(path) as raster:
            assert ProjectionExtension.ext(asset).shape == list(raster.shape)
            assert [b["name"] for b in asset.extra_fields["bands"]] == list(raster.descriptions)
            assert asset.extra_fields["data_type"] == raster.dtypes[0]
        assert asset.extra_fields["proj:code"] == CRS
        assert "proj:transform" not in asset.extra_fields, "a perspective image has none"
    assert [item.properties["syntopic:verdict"] for item in items] == ["good", "refly", "usable"]
    assert "Simulated" in collection.description


def test_the_axis_of_an_item_is_that_of_the_emulated_aircraft(exported: Exported) -> None:
    for item, mark in zip(items_of(exported), exported.flown.marks.values(), strict=True):
        pose = FLIGHT.pose(mark)
        axis = -(pose.enu_from_body @ BODY_FROM_CAMERA)[:, 2]
        off_nadir = math.radians(item.properties["view:off_nadir"])
        azimuth = math.radians(item.properties["view:azimuth"])
        found = math.sin(off_nadir) * np.array([math.sin(azimuth), math.cos(azimuth), 0.0])
        # East and north of the emulator's world are those of its origin, some 100 m away.
        assert np.linalg.norm(found[:2] - axis[:2]) < math.radians(0.03)
        assert np.linalg.norm(axis[:2]) > math.radians(0.2), "the test needs a tilt"


def test_the_sun_stands_in_the_direction_of_the_point_below_it(exported: Exported) -> None:
    item = items_of(exported)[0]
    latitude, longitude, _ = FLIGHT.geodetic(FLIGHT.pose(exported.flown.marks[1]).position_enu_m)
    # The point below the sun by NOAA's formulas: declination and equation of time.
    instant = item.datetime
    day = instant.timetuple().tm_yday - 1 + (instant.hour - 12) / 24
    angle = 2 * math.pi / 365 * day
    declination = (
        0.006918 - 0.399912 * math.cos(angle) + 0.070257 * math.sin(angle)
        - 0.006758 * math.cos(2 * angle) + 0.000907 * math.sin(2 * angle)
    )  # fmt: skip
    minutes = 229.18 * (
        0.000075 + 0.001868 * math.cos(angle) - 0.032077 * math.sin(angle)
        - 0.014615 * math.cos(2 * angle) - 0.040849 * math.sin(2 * angle)
    )  # fmt: skip
    hours = instant.hour + instant.minute / 60 + instant.second / 3600
    below = (15 * (12 - hours - minutes / 60) + 180) % 360 - 180
    sphere = pyproj.Geod(a=1.0, b=1.0)
    azimuth, _, distance = sphere.inv(longitude, latitude, below, math.degrees(declination))
    assert item.properties["view:sun_azimuth"] == pytest.approx(azimuth % 360, abs=0.6)
    elevation = 90 - math.degrees(distance)
    assert item.properties["view:sun_elevation"] == pytest.approx(elevation, abs=0.6)


def test_an_orthoimage_has_its_transform_and_a_perspective_one_is_refused(
    exported: Exported, tmp_path: Path
) -> None:
    mission = tmp_path / "mission"
    shutil.copytree(exported.flown.path, mission)
    ortho = mission / "export/orthomosaic"
    ortho.mkdir()
    affine = rasterio.Affine(0.1, 0, 677_000.0, 0, -0.1, 5_215_000.0)
    with rasterio.open(
        ortho / "all.tif", "w", driver="GTiff", width=40, height=30, count=3, dtype="uint8",
        crs=CRS, transform=affine,
    ) as raster:  # fmt: skip
        raster.write(np.ones((3, 30, 40), np.uint8))
    options = ("--trajectory", str(exported.flown.trajectory), "--crs", CRS)
    done = run("export", "stac", str(mission), *options)
    assert done["orthoimages"] == 1
    collection = pystac.Collection.from_file(done["collection"])
    item = next(i for i in collection.get_items() if i.id.endswith("-all"))
    assert problems(json.loads(Path(item.get_self_href()).read_text())) == []
    asset = item.assets["orthoimage"]
    assert asset.extra_fields["proj:transform"] == list(affine)[:6]
    assert asset.extra_fields["proj:bbox"] == pytest.approx([677000, 5214997, 677004, 5215000])
    assert item.properties["proj:code"] == CRS and item.properties["gsd"] == pytest.approx(0.1)
    to_wgs = pyproj.Transformer.from_crs(CRS, 4326, always_xy=True)
    assert item.bbox[:2] == pytest.approx(to_wgs.transform(677000, 5214997), abs=2e-6)
    shutil.copy(mission / "export/cog/pan/000001_pan.tif", ortho / "perspective.tif")
    refused = CliRunner().invoke(app, ["export", "stac", str(mission), *options])
    assert refused.exit_code != 0 and "no orthoimage" in str(refused.exception)
    assert (mission / "export/stac/collection.json").exists(), "the earlier export is kept"


def test_links_hold_after_the_mission_is_moved(exported: Exported, tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere"
    shutil.copytree(exported.flown.path, moved)
    collection = pystac.Collection.from_file(str(moved / "export/stac/collection.json"))
    for item in collection.get_items():
        for asset in item.assets.values():
            assert str(moved) in asset.get_absolute_href()
            assert Path(asset.get_absolute_href()).is_file()
    for asset in collection.assets.values():
        assert Path(asset.get_absolute_href()).is_file()
    assert set(collection.assets) == {"gpkg", "kmz"}

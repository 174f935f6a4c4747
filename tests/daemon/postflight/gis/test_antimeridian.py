"""A mission across 180 degrees is the same mission as elsewhere: one box, one frame, two parts."""

from __future__ import annotations

import csv
import io
import json
import shutil
import zipfile
from dataclasses import dataclass
from xml.etree import ElementTree as Xml

import numpy as np
import pytest

from daemon.orientation.antimeridian import bbox_of, continuous, mean_longitude, polygon
from daemon.postflight.export.gis_layers import GisFeature, GisLayer
from daemon.postflight.export.kmz import KML, kmz_bytes
from tests.daemon.postflight.exchange.flown_block import FlownBlock
from tests.daemon.postflight.gis.conftest import Exported, run
from tests.daemon.postflight.gis.test_stac import problems

pystac = pytest.importorskip("pystac")
pyogrio = pytest.importorskip("pyogrio")
shapely = pytest.importorskip("shapely")
pytestmark = pytest.mark.peer

SQUARE = ((179.5, 1.0), (-179.0, 1.0), (-179.0, 2.0), (179.5, 2.0))


@dataclass(frozen=True)
class Turned:
    """The mission turned about the earth's axis, and by how many degrees."""

    flown: FlownBlock
    stac: dict
    gis: dict
    by_deg: float


@pytest.fixture(scope="module")
def turned(exported: Exported, tmp_path_factory) -> Turned:
    path = tmp_path_factory.mktemp("turned") / "mission"
    shutil.copytree(exported.flown.path, path)
    shutil.rmtree(path / "export")
    (path / "plan.geojson").unlink()
    trajectory = path / "trajectory.csv"
    rows = list(csv.DictReader(io.StringIO(trajectory.read_text())))
    by_deg = 180.0 - float(np.mean([float(row["longitude_deg"]) for row in rows]))
    for row in rows:
        longitude = float(row["longitude_deg"]) + by_deg
        row["longitude_deg"] = repr(longitude - 360.0 if longitude > 180.0 else longitude)
    assert len({row["longitude_deg"][0] for row in rows}) == 2, "east and west of 180 degrees"
    with trajectory.open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    flown = FlownBlock(path, exported.flown.rig, trajectory, exported.flown.marks)
    options = ("--trajectory", str(trajectory), "--crs", "EPSG:32660")
    gis = run("export", "gis", str(path), *options)
    return Turned(flown, run("export", "stac", str(path), *options), gis, by_deg)


def items_of(path: str) -> list:
    return sorted(pystac.Collection.from_file(path).get_items(), key=lambda item: item.id)


def test_items_have_two_parts_and_a_box_whose_west_is_larger(exported, turned) -> None:
    crossing = 0
    for item, other in zip(
        items_of(turned.stac["collection"]), items_of(exported.stac["collection"]), strict=True
    ):
        assert problems(item.to_dict(include_self_link=False)) == []
        west, south, east, north = item.bbox
        assert [south, north] == pytest.approx([other.bbox[1], other.bbox[3]], abs=1e-9)
        width = other.bbox[2] - other.bbox[0]
        assert (east - west) % 360.0 == pytest.approx(width, abs=1e-6)
        shape = shapely.geometry.shape(item.geometry)
        area = shapely.geometry.shape(other.geometry).area
        assert shape.is_valid and shape.area == pytest.approx(area, rel=1e-5)
        parts = list(getattr(shape, "geoms", [shape]))
        assert all(-180.0 <= part.bounds[0] <= part.bounds[2] <= 180.0 for part in parts)
        is_crossing = west > east
        assert len(parts) == (2 if is_crossing else 1)
        crossing += is_crossing
        centroid = item.properties["proj:centroid"]["lon"]
        there = other.properties["proj:centroid"]["lon"] + turned.by_deg
        assert (centroid - there + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-6)
    assert crossing > 0
    (box,) = pystac.Collection.from_file(turned.stac["collection"]).extent.spatial.bboxes
    assert box[0] > 179.0 and box[2] < -179.0, "of the mission, and not around the earth"


def test_layers_are_in_one_piece(exported, turned) -> None:
    for layer in ("footprints", "centres", "lines"):
        own = pyogrio.read_dataframe(turned.gis["folder"] + "/mission.gpkg", layer=layer)
        west, _, east, _ = own.total_bounds
        assert east - west < 0.1 and west < 180.0 < east
    other = pyogrio.read_dataframe(exported.gis["folder"] + "/mission.gpkg", layer="footprints")
    own = pyogrio.read_dataframe(turned.gis["folder"] + "/mission.gpkg", layer="footprints")
    assert own.area.to_list() == pytest.approx(other.area.to_list(), rel=1e-5)


def test_a_block_has_the_frame_of_its_own_place(exported, turned) -> None:
    """Turned about the earth's axis, the local frame and all places in it are the same."""
    found = []
    for flown, crs in ((exported.flown, "EPSG:32633"), (turned.flown, "EPSG:32660")):
        options = ("--trajectory", str(flown.trajectory), "--crs", crs, "--no-copies")
        run("export", "block", str(flown.path), "--to", "colmap", *options)
        folder = flown.path / "export/block/colmap"
        origin = json.loads((folder / "about.json").read_text())["origin"]
        rows = (folder / "sparse/images.txt").read_text().splitlines()[2::2]
        found.append((origin, np.array([row.split()[1:8] for row in rows], float)))
        shutil.rmtree(folder)
    (there, pose), (here, other) = found
    assert (here["longitude_deg"] - there["longitude_deg"]) % 360.0 == pytest.approx(
        turned.by_deg % 360.0, abs=1e-9
    )
    assert np.abs(pose - other).max() < 1e-6


def test_boxes_and_means_of_longitudes_next_to_each_other() -> None:
    assert bbox_of([SQUARE]) == [179.5, 1.0, -179.0, 2.0]
    assert bbox_of([((170.0, 0.0), (171.0, 1.0)), ((-171.0, 0.0), (-170.0, 3.0))]) == [
        170.0, 0.0, -170.0, 3.0,
    ]  # fmt: skip
    assert bbox_of([((1.0, 2.0), (3.0, 4.0)), ((-5.0, 2.0), (2.0, 9.0))]) == [-5.0, 2.0, 3.0, 9.0]
    everywhere = [((float(k), 0.0), (k + 31.0, 1.0)) for k in range(-180, 180, 30)]
    assert bbox_of(everywhere) == [-180.0, 0.0, 180.0, 1.0]
    assert mean_longitude([179.0, -179.5, -179.0]) == pytest.approx(-179.8333333)
    assert [place[0] for place in continuous(SQUARE)] == [179.5, 181.0, 181.0, 179.5]


@pytest.mark.parametrize("shift", [0, 1, 2, 3])
def test_a_polygon_is_cut_at_the_antimeridian_from_any_corner(shift) -> None:
    ring = (*SQUARE[shift:], *SQUARE[:shift])
    shape = shapely.geometry.shape(polygon(ring))
    assert shape.is_valid and shape.area == pytest.approx(1.5)
    assert sorted(part.bounds for part in shape.geoms) == [
        (-180.0, 1.0, -179.0, 2.0),
        (179.5, 1.0, 180.0, 2.0),
    ]
    assert polygon(None) is None
    assert polygon(((1.0, 2.0), (3.0, 2.0), (3.0, 4.0)))["type"] == "Polygon"


def shapes_of(kind: str, places: tuple[tuple[float, float], ...]) -> list[np.ndarray]:
    """Coordinates of each shape of a KMZ with one feature, (n, 2)."""
    layer = GisLayer("lines", "Lines", kind, {"line": "TEXT"}, (GisFeature(places, ("L1",)),))
    with zipfile.ZipFile(io.BytesIO(kmz_bytes("mission", [layer]))) as archive:
        root = Xml.fromstring(archive.read("doc.kml"))
    found = root.findall(f".//{{{KML}}}{kind}//{{{KML}}}coordinates")
    return [np.array([p.split(",") for p in one.text.split()], float) for one in found]


def test_shapes_of_a_kmz_are_cut_at_the_antimeridian() -> None:
    west, east = sorted(shapes_of("Polygon", SQUARE), key=lambda ring: ring[0, 0])
    for ring in (west, east):
        assert np.ptp(ring[:, 0]) < 1.01 and np.abs(ring).max() <= 180.0
        assert (ring[0] == ring[-1]).all()
    areas = [shapely.Polygon(ring).area for ring in (west, east)]
    assert areas == pytest.approx([1.0, 0.5])
    line = ((179.0, 0.0), (-179.0, 2.0), (-178.0, 2.0), (179.0, -4.0))
    parts = shapes_of("LineString", line)
    assert [part.tolist() for part in parts] == [
        [[179.0, 0.0], [180.0, 1.0]],
        [[-180.0, 1.0], [-179.0, 2.0], [-178.0, 2.0], [-180.0, -2.0]],
        [[180.0, -2.0], [179.0, -4.0]],
    ]
    (at_the_edge,) = shapes_of("LineString", ((180.0, 0.0), (-180.0, 1.0), (179.0, 2.0)))
    assert at_the_edge[:, 0].tolist() == [180.0, 180.0, 179.0]
    (ring,) = shapes_of("Polygon", ((1.0, 2.0), (3.0, 2.0), (3.0, 4.0)))
    assert ring.tolist() == [[1.0, 2.0], [3.0, 2.0], [3.0, 4.0], [1.0, 2.0]]
    (point,) = shapes_of("Point", ((-179.0, 2.0),))
    assert point.tolist() == [[-179.0, 2.0]]

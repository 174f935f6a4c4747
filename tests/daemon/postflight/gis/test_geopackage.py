"""GeoPackage and KMZ of a mission, read by GDAL (through pyogrio)."""

from __future__ import annotations

import io
import json
import shutil
import sqlite3
import zipfile
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
import pyproj
import pytest

from daemon.mission.layout import Mission
from daemon.mission.store.output_places import OutputPlaceError
from daemon.postflight.export.gis_export import export_gis
from daemon.postflight.export.gis_layers import LAYER_NAMES, GisFeature, GisLayer
from daemon.postflight.export.kmz import kmz_bytes
from tests.daemon.postflight.exchange.flown_block import FLIGHT
from tests.daemon.postflight.gis.conftest import CRS, Exported, run

pyogrio = pytest.importorskip("pyogrio")
shapely = pytest.importorskip("shapely")
pytestmark = pytest.mark.peer


@pytest.fixture(scope="module")
def package(exported: Exported) -> Path:
    return Path(exported.gis["folder"]) / "mission.gpkg"


def read(package: Path, layer: str):
    return pyogrio.read_dataframe(package, layer=layer)


def test_gdal_reads_every_layer_with_its_system_and_extent(package: Path) -> None:
    listed = {name for name, _ in pyogrio.list_layers(package)}
    assert listed == {*LAYER_NAMES, "layer_styles"}
    for layer in LAYER_NAMES:
        info = pyogrio.read_info(package, layer=layer)
        assert info["crs"] == "EPSG:4326" and info["features"] > 0, layer
        assert info["total_bounds"] == pytest.approx(read(package, layer).total_bounds)


def test_the_package_is_a_geopackage_by_its_header_and_an_intact_database(package: Path) -> None:
    header = package.read_bytes()[:100]
    assert header[68:72] == b"GPKG" and int.from_bytes(header[60:64], "big") == 10300
    with sqlite3.connect(package) as database:
        assert database.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        assert database.execute("PRAGMA foreign_key_check").fetchall() == []


def test_footprints_surround_the_point_below_and_have_their_verdicts(
    exported: Exported, package: Path
) -> None:
    footprints = read(package, "footprints")
    assert list(footprints["verdict"]) == ["good", "refly", "usable"]
    assert list(footprints["flags"]) == ["", "BLUR", ""]
    assert footprints["simulated"].all()
    centres = read(package, "centres")
    geod = pyproj.Geod(ellps="WGS84")
    for number, mark in exported.flown.marks.items():
        latitude, longitude, height = FLIGHT.geodetic(FLIGHT.pose(mark).position_enu_m)
        point = centres.geometry[number - 1]
        assert geod.inv(longitude, latitude, point.x, point.y)[2] < 0.5
        assert point.z == pytest.approx(height, abs=0.5)
        ring = footprints.geometry[number - 1]
        assert ring.is_valid and ring.exterior.is_ccw
        assert ring.contains(shapely.Point(longitude, latitude))
        # Area of the image on level ground, tilted by some degrees.
        area = abs(geod.geometry_area_perimeter(ring)[0])
        image, above_m = exported.flown.rig.virtual_image, height - 395.0
        level = image.width_px * image.height_px * (image.pitch_mm / image.f_mm * above_m) ** 2
        assert area == pytest.approx(level, rel=0.1)


def test_lines_gaps_and_density_are_those_of_the_mission(package: Path) -> None:
    lines = read(package, "lines")
    assert list(lines["kind"]) == ["planned", "flown"]
    # 2 and 4 s at 60 m/s.
    assert lines["length_m"].to_list() == pytest.approx([240.0, 120.0], abs=2.0)
    gaps = read(package, "gaps")
    assert (gaps["area_m2"] > 0).all() and set(gaps["line"]) == {"planned 1"}
    density = read(package, "tie_points")
    # 40 + 1 points in the first cell of 10 m, 3 in the last; neither t99 nor control is counted.
    assert sorted(density["points"]) == [3, 41]
    dense = density.loc[density["points"].idxmax()]
    assert dense["points_per_ha"] == pytest.approx(4100.0) and dense["rays_mean"] == 3.0
    metric = density.to_crs(32633).area
    assert metric.to_list() == pytest.approx([100.0, 100.0], rel=2e-3)
    west = density.geometry.bounds["minx"]
    assert west[density["points"].idxmax()] < west[density["points"].idxmin()]


def test_every_layer_has_a_default_style_whose_classes_are_its_values(package: Path) -> None:
    styles = read(package, "layer_styles").set_index("f_table_name")
    assert set(styles.index) == set(LAYER_NAMES) and styles["useAsDefault"].all()
    for layer, text in styles["styleQML"].items():
        root = Xml.fromstring(text.partition("\n")[2])
        renderer = root.find("renderer-v2")
        column = renderer.get("attr")
        frame = read(package, layer)
        symbols = {one.get("name") for one in renderer.iter("symbol")}
        used = {one.get("symbol") for one in (*renderer.iter("category"), *renderer.iter("range"))}
        assert used <= symbols and symbols
        if renderer.get("type") == "categorizedSymbol":
            values = {one.get("value") for one in renderer.iter("category")}
            assert set(frame[column]) <= values
        if renderer.get("type") == "graduatedSymbol":
            upper = max(float(one.get("upper")) for one in renderer.iter("range"))
            assert upper == pytest.approx(frame[column].max())


def test_the_kmz_opens_and_has_the_same_shapes(exported: Exported, package: Path) -> None:
    archive = package.with_name("mission.kmz")
    with zipfile.ZipFile(archive) as file:
        assert file.namelist() == ["doc.kml"] and file.testzip() is None
        document = file.read("doc.kml")
    path = exported.flown.path.parent / "doc.kml"
    path.write_bytes(document)
    for title, layer in (("Footprints", "footprints"), ("Flight lines", "lines")):
        shown = pyogrio.read_dataframe(path, layer=title)
        assert len(shown) == len(read(package, layer))
        mine = read(package, layer).geometry
        assert all(
            a.equals_exact(shapely.force_2d(b), 1e-8)
            for a, b in zip(mine, shown.geometry, strict=True)
        )
    assert b"SIMULATED" in document


def test_foreign_names_do_not_break_the_documents(tmp_path: Path) -> None:
    name = 'a"b<c>&\x00\x07 \u202e;DROP TABLE footprints'
    layer = GisLayer(
        "lines", "Lines", "LineString", {"line": "TEXT"},
        (GisFeature(((16.0, 47.0), (16.1, 47.1)), (name,)),),
    )  # fmt: skip
    from daemon.postflight.export.geopackage import write_geopackage

    write_geopackage(tmp_path / "x.gpkg", [layer])
    with sqlite3.connect(tmp_path / "x.gpkg") as database:
        assert database.execute("SELECT line FROM lines").fetchall() == [(name,)]
    with zipfile.ZipFile(io.BytesIO(kmz_bytes(name, [layer]))) as file:
        assert Xml.fromstring(file.read("doc.kml")) is not None
    one, other = kmz_bytes("x", [layer]), kmz_bytes("x", [layer])
    assert one == other


def test_without_plan_and_triangulation_the_layers_say_so(
    exported: Exported, tmp_path: Path
) -> None:
    mission = tmp_path / "mission"
    shutil.copytree(exported.flown.path, mission)
    (mission / "plan.geojson").unlink()
    shutil.rmtree(mission / "export")
    (mission / "export").mkdir()
    done = run("export", "gis", str(mission), "--trajectory", str(exported.flown.trajectory))
    layers = done["layers"]
    assert layers["gaps"]["features"] == layers["tie_points"]["features"] == 0
    assert "without a plan" in layers["gaps"]["note"]
    assert "syntopic triangulate" in layers["tie_points"]["note"]
    assert json.dumps(layers) and np.isfinite(layers["footprints"]["features"])


def test_a_project_of_qgis_next_to_the_layers_is_not_removed(exported: Exported) -> None:
    mission, folder = Mission.open(exported.flown.path), Path(exported.gis["folder"])
    options = {"crs": CRS, "trajectory_file": exported.flown.trajectory}
    project = folder / "project.qgz"
    project.write_text("mine")
    try:
        with pytest.raises(OutputPlaceError, match=r"project\.qgz"):
            export_gis(mission, **options)
        assert project.read_text() == "mine"
    finally:
        project.unlink()
    (folder / "mission.gpkg-wal").write_bytes(b"")
    assert export_gis(mission, **options).folder == folder

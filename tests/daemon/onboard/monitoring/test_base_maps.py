"""Base maps of every kind give their tiles, and damaged files end in a sentence."""

from __future__ import annotations

import base64
import gzip
import sqlite3
import struct
import time
from pathlib import Path

import cv2
import numpy as np
import pyproj
import pytest

from daemon.configuration.model import PlanSection, WatchSection
from daemon.onboard.monitoring.maps.hill_shade import shade
from daemon.onboard.monitoring.maps.map_library import MapLibrary, check_maps, open_map
from daemon.onboard.monitoring.maps.pmtiles import parse_directory, tile_id
from daemon.onboard.monitoring.maps.tiles import MVT, BaseMapError, mercator_bounds_m, tile_bounds
from daemon.onboard.preflight.check_results import CheckOutcome

PNG = cv2.imencode(".png", np.full((4, 4), 7, np.uint8))[1].tobytes()
PEER_PMTILES = base64.b64decode(
    "UE1UaWxlcwN/AAAAAAAAACEAAAAAAAAAoAAAAAAAAAA/AAAAAAAAAN8AAAAAAAAAAAAAAAAAAADfAAAAAAAA"
    "APoAAAAAAAAABQAAAAAAAAAFAAAAAAAAAAUAAAAAAAAAAQICAQABAC62lIAHVs0A0klrgPipMgAAAAAAAAAA"
    "AB+LCAAAAAAAAgNjZWCEAUddEw0DRgYgAAB6Uxm4FQAAAB+LCAAAAAAAAgOrVspLzE1VslJQKkhNLVLSUVBK"
    "LCkpykwqLcnMzwMJayRrKuTlJ+WnVCrVAgDuho9CLQAAAB+LCAAAAAAAAgOTYtAw0FEAIc03eatEOdmmbKiQ"
    "c1++yVDSvc3NVaHl1KGPbpubOKw83zPzRRoAANdnH0kuAAAAH4sIAAAAAAACA5Ni0DDUUTAAIk2He/Wl1jzn"
    "egPFWH5pcz0CAIZ4bHgaAAAAH4sIAAAAAAACA5Ni0DDUUTDQUTDUfN2vvXirrOu8H6fvuMRYzA7xNDy9GwAR"
    "Y7mDHwAAAB+LCAAAAAAAAgOTYtAw1FEAIU2tLR5zGN0j5zQGvgcAMZ6XZxYAAAAfiwgAAAAAAAIDk2LQMNRR"
    "ACIDzQ3/Pf56ihy46LX+ThRDwh9NgzIAR4lY6R0AAAA="
)
"""Written by the reference implementation (pmtiles 3.8.1): MVT, gzip, zoom 0 and 1."""


def mbtiles(path: Path, tiles: dict[tuple[int, int, int], bytes], **about: str) -> Path:
    """Tiles by zoom, column and row from the south."""
    database = sqlite3.connect(path)
    database.execute("CREATE TABLE metadata (name text, value text)")
    database.execute(
        "CREATE TABLE tiles (zoom_level int, tile_column int, tile_row int, tile_data blob)"
    )
    database.executemany("INSERT INTO metadata VALUES (?, ?)", {"format": "png", **about}.items())
    database.executemany(
        "INSERT INTO tiles VALUES (?, ?, ?, ?)", [(*k, v) for k, v in tiles.items()]
    )
    database.commit()
    database.close()
    return path


def geotiff(path: Path, values: np.ndarray, **about: object) -> Path:
    import rasterio
    from rasterio.transform import from_origin

    bands = values if values.ndim == 3 else values[None]
    profile = {
        "driver": "GTiff", "count": len(bands), "height": bands.shape[1], "width": bands.shape[2],
        "dtype": str(bands.dtype), "crs": "EPSG:32633", "tiled": True, "blockxsize": 128,
        "blockysize": 128, "transform": from_origin(500_000.0, 5_200_000.0, 2.0, 2.0), **about,
    }  # fmt: skip
    with rasterio.open(path, "w", **profile) as raster:
        raster.write(bands)
    return path


def tile_of(longitude: float, latitude: float, zoom: int) -> tuple[int, int, int]:
    count = 1 << zoom
    y = np.arcsinh(np.tan(np.radians(latitude)))
    return zoom, int((longitude + 180) / 360 * count), int((1 - y / np.pi) / 2 * count)


def test_rows_of_mbtiles_count_from_the_south(tmp_path: Path) -> None:
    north, south = PNG, PNG + b"south"
    path = mbtiles(
        tmp_path / "a.mbtiles", {(1, 0, 1): north, (1, 0, 0): south}, minzoom="1", maxzoom="1"
    )
    opened = open_map(path)
    found = opened.tile(1, 0, 0)
    assert found is not None
    assert (found.data, found.media_type, found.encoding) == (north, "image/png", "")
    second = opened.tile(1, 0, 1)
    assert second is not None
    assert second.data == south
    assert opened.tile(1, 1, 0) is None


def test_vector_tiles_keep_their_compression(tmp_path: Path) -> None:
    packed = gzip.compress(b"\x1a\x00")
    path = mbtiles(tmp_path / "v.mbtiles", {(0, 0, 0): packed}, format="pbf", name="roads")
    opened = open_map(path)
    assert (opened.description.kind, opened.description.name) == ("vector", "roads")
    assert (opened.description.min_zoom, opened.description.max_zoom) == (0, 0)
    found = opened.tile(0, 0, 0)
    assert found is not None
    assert (found.data, found.media_type, found.encoding) == (packed, MVT, "gzip")


def test_tiles_of_the_reference_implementation_are_read(tmp_path: Path) -> None:
    (tmp_path / "p.pmtiles").write_bytes(PEER_PMTILES)
    opened = open_map(tmp_path / "p.pmtiles")
    assert (opened.description.name, opened.description.attribution) == ("peer", "(c) nobody")
    for zoom, x, y in ((0, 0, 0), (1, 0, 0), (1, 0, 1), (1, 1, 1), (1, 1, 0)):
        found = opened.tile(zoom, x, y)
        assert found is not None
        assert str((zoom, x, y)).encode() in gzip.decompress(found.data)
        assert found.encoding == "gzip"


def test_ids_of_tiles_follow_the_curve() -> None:
    """Values of the specification's own table."""
    known = {(0, 0, 0): 0, (1, 0, 0): 1, (1, 0, 1): 2, (1, 1, 1): 3, (1, 1, 0): 4, (2, 0, 0): 5,
             (12, 3423, 1763): 19078479}  # fmt: skip
    assert {key: tile_id(*key) for key in known} == known


def test_a_geotiff_lies_where_its_coordinates_say(tmp_path: Path) -> None:
    values = np.full((512, 512), 60, np.uint8)
    values[100:140, 300:340] = 250
    opened = open_map(geotiff(tmp_path / "o.tif", values))
    to_geographic = pyproj.Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True)
    longitude, latitude = to_geographic.transform(500_000 + 2 * 320, 5_200_000 - 2 * 120)
    zoom = opened.description.max_zoom
    number = tile_of(longitude, latitude, zoom)
    found = opened.tile(*number)
    assert found is not None
    picture = cv2.imdecode(np.frombuffer(found.data, np.uint8), cv2.IMREAD_GRAYSCALE)
    left, bottom, right, top = mercator_bounds_m(*number)
    x, y = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:3857", always_xy=True).transform(
        longitude, latitude
    )
    column, row = int((x - left) / (right - left) * 256), int((top - y) / (top - bottom) * 256)
    assert picture[row, column] > 230
    size_px = 40 * 2 / np.cos(np.radians(latitude)) / ((right - left) / 256)
    assert picture[row, max(0, column - int(size_px))] < 100
    assert opened.tile(zoom, number[1] + 50, number[2]) is None


def test_values_of_16_bits_are_stretched_and_unknown_ones_transparent(tmp_path: Path) -> None:
    values = np.linspace(1000, 3000, 512 * 512).reshape(512, 512).astype(np.uint16)
    values[:, :200] = 0
    opened = open_map(geotiff(tmp_path / "o.tif", values, nodata=0))
    west, _, _, north = opened.description.bounds
    found = opened.tile(*tile_of(west + 0.004, north - 0.004, opened.description.max_zoom - 2))
    assert found is not None
    picture = cv2.imdecode(np.frombuffer(found.data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert found.media_type == "image/png"
    known = picture[picture[..., 3] > 0]
    assert 0 < len(known) < 256 * 256
    assert known[:, 0].max() > 200
    assert known[:, 0].min() < 150


def test_hills_are_bright_towards_the_north_west() -> None:
    y, x = np.mgrid[0:20, 0:20].astype(float)
    assert (
        shade(x * 5 + y * 5, 10.0).mean()
        > shade(x * 0, 10.0).mean()
        > shade(-x * 5 - y * 5, 10.0).mean()
    )
    hole = x.copy()
    hole[10, 10] = np.nan
    assert np.isnan(shade(hole, 10.0)).sum() == 8


def test_hill_shade_comes_from_the_height_model_of_the_plan(tmp_path: Path) -> None:
    y, x = np.mgrid[0:256, 0:256]
    heights = (200 + 80 * np.sin(x / 20) + 60 * np.cos(y / 15)).astype(np.float32)
    path = geotiff(tmp_path / "dem.tif", heights, blockxsize=256, blockysize=256)
    library = MapLibrary((), PlanSection(elevation=path, elevation_crs="EPSG:32633"))
    (about,) = library.descriptions()
    assert about["is_overlay"]
    west, _, _, north = about["bounds"]
    found = library.tile(0, *tile_of(west + 0.002, north - 0.002, about["max_zoom"]))
    assert found is not None
    picture = cv2.imdecode(np.frombuffer(found.data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert {0, 255} <= set(np.unique(picture[..., :3]))


@pytest.mark.trust
@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.mbtiles", b""),
        ("a.mbtiles", b"SQLite format 3\0" + bytes(200)),
        ("a.pmtiles", b""),
        ("a.pmtiles", b"PMTiles\x02" + bytes(119)),
        ("a.pmtiles", PEER_PMTILES[:90]),
        ("a.pmtiles", PEER_PMTILES[:130]),
        ("a.pmtiles", PEER_PMTILES[:97] + b"\x03" + PEER_PMTILES[98:]),
        ("a.pmtiles", PEER_PMTILES[:16] + struct.pack("<Q", 2**60) + PEER_PMTILES[24:]),
        ("a.pmtiles", PEER_PMTILES[:101] + b"\xff" + PEER_PMTILES[102:]),
        ("a.tif", b"II*\0" + bytes(20)),
        ("a.tif", b"/vsicurl/http://example.org/a.tif"),
        ("a.jpg", b"\xff\xd8\xff"),
    ],
)
def test_a_damaged_map_is_reported_with_its_name(tmp_path: Path, name: str, data: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(BaseMapError, match=name):
        open_map(path)
    (result,) = check_maps([path])
    assert result.outcome is CheckOutcome.FAIL
    assert name in result.sentence
    assert MapLibrary([path]).descriptions() == []


def test_metadata_that_lie_are_refused(tmp_path: Path) -> None:
    for number, about in enumerate(
        ({"format": "exe"}, {"minzoom": "x"}, {"maxzoom": "99"}, {"bounds": "1,2,3"},
         {"bounds": "10,0,-10,5"}, {"bounds": "nan,0,1,1"}, {"minzoom": "5", "maxzoom": "2"})
    ):  # fmt: skip
        path = mbtiles(tmp_path / f"{number}.mbtiles", {(0, 0, 0): PNG}, **about)
        with pytest.raises(BaseMapError):
            open_map(path)


def test_huge_or_wrong_tiles_are_left_out(tmp_path: Path) -> None:
    path = mbtiles(
        tmp_path / "a.mbtiles",
        {(1, 0, 0): PNG + bytes(3_000_000), (1, 1, 0): b"<svg onload=x>", (1, 0, 1): PNG},
    )
    library = MapLibrary([path])
    assert library.tile(0, 1, 0, 1) is None
    assert library.tile(0, 1, 1, 1) is None
    assert library.tile(0, 1, 0, 0) is not None


def test_a_view_that_never_ends_is_stopped(tmp_path: Path) -> None:
    path = mbtiles(tmp_path / "a.mbtiles", {(0, 0, 0): PNG}, minzoom="0", maxzoom="0")
    database = sqlite3.connect(path)
    database.executescript(
        "DROP TABLE tiles; CREATE VIEW tiles AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT "
        "i + 1 FROM n) SELECT random() % 2 + 9 AS zoom_level, 0 AS tile_column, 0 AS tile_row, "
        "'' AS tile_data FROM n"
    )
    database.close()
    begin_s = time.monotonic()
    with pytest.raises(BaseMapError, match="interrupted"):
        open_map(path).tile(0, 0, 0)
    assert time.monotonic() - begin_s < 20.0


def test_tiles_beyond_the_map_are_none(tmp_path: Path) -> None:
    path = mbtiles(
        tmp_path / "a.mbtiles", {(2, 2, 2): PNG}, bounds="10,45,12,47", minzoom="2", maxzoom="2"
    )
    library = MapLibrary([path])
    inside = tile_of(11.0, 46.0, 2)
    assert library.tile(0, *inside) is not None
    for zoom, x, y in ((3, 4, 2), (2, 0, 0), (2, -1, 1), (2, 4, 1), (-1, 0, 0), (40, 0, 0)):
        assert library.tile(0, zoom, x, y) is None
    assert library.tile(1, *inside) is None


def test_bounds_of_tiles_meet() -> None:
    assert tile_bounds(3, 2, 2)[2] == tile_bounds(3, 3, 2)[0]
    assert tile_bounds(3, 2, 2)[1] == pytest.approx(tile_bounds(3, 2, 3)[3])
    assert mercator_bounds_m(1, 1, 0)[0] == 0.0


def test_damaged_directories_are_errors_and_not_memory() -> None:
    for data in (b"\xff" * 12, b"\xff\xff\xff\xff\x0f", b"\x02\x01\x01", b"\x01\x00\x01\x01\x00"):
        with pytest.raises((ValueError, IndexError)):
            parse_directory(data)


def test_the_configuration_names_the_endings(tmp_path: Path) -> None:
    assert WatchSection(maps=[Path("a.mbtiles"), Path("b.TIF")]).maps == (
        Path("a.mbtiles"),
        Path("b.TIF"),
    )
    with pytest.raises(ValueError, match=r"a base map ends in \.mbtiles"):
        WatchSection(maps=[Path("a.png")])

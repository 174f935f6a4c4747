"""Foreign height models: one local file, GeoTIFF or grid, bounded; else an error message."""

from __future__ import annotations

import http.server
import os
import struct
import threading
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

rasterio = pytest.importorskip("rasterio", reason="needs the extra geotiff")

from daemon.mission.foreign_files import is_on_local_disk  # noqa: E402
from daemon.mission.layout import Mission  # noqa: E402
from daemon.orientation.elevation import ElevationError, read_elevation  # noqa: E402
from daemon.orientation.exterior_orientation import mount_of  # noqa: E402
from daemon.orientation.georeference import Georeference, GeoreferenceError  # noqa: E402

CRS = "EPSG:32633"
MEMORY_BYTES = 64_000_000


@pytest.fixture(scope="module")
def system() -> Georeference:
    return Georeference(CRS)


def geotiff(path: Path, heights: np.ndarray | None = None, **options) -> Path:
    heights = np.full((4, 5), 300.0, np.float32) if heights is None else heights
    place = rasterio.transform.from_origin(500_000.0, 5_200_000.0, 10.0, 10.0)
    profile = {
        "driver": "GTiff",
        "width": heights.shape[1],
        "height": heights.shape[0],
        "count": 1,
        "dtype": heights.dtype,
        "crs": CRS,
        "transform": place,
        **options,
    }
    with rasterio.open(path, "w", **profile) as raster:
        raster.write(heights, 1)
    return path


def asc(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


HEADER = "ncols 2\nnrows 2\nxllcorner 500000\nyllcorner 5200000\ncellsize 10\n"


class Contacts(http.server.BaseHTTPRequestHandler):
    """Notes every request."""

    requests: list[str] = []  # noqa: RUF012 - one list for all requests

    def do_GET(self) -> None:
        Contacts.requests.append(self.path)
        self.send_error(404)

    do_HEAD = do_GET  # noqa: N815 - the name that http.server calls

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        pass


@pytest.fixture
def server() -> Iterator[str]:
    Contacts.requests.clear()
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Contacts) as serving:
        thread = threading.Thread(target=serving.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{serving.server_address[1]}"
        serving.shutdown()
        thread.join(5.0)


def vrt(source: str) -> str:
    return (
        '<VRTDataset rasterXSize="5" rasterYSize="4"><SRS>EPSG:32633</SRS>'
        "<GeoTransform>500000,10,0,5200000,0,-10</GeoTransform>"
        '<VRTRasterBand dataType="Float32" band="1"><SimpleSource>'
        f'<SourceFilename relativeToVRT="0">{source}</SourceFilename>'
        "<SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"
    )


@pytest.mark.trust
@pytest.mark.parametrize("name", ["dem.tif", "dem.vrt"])
def test_a_height_model_that_names_a_network_file_opens_no_connection(
    tmp_path: Path, server: str, system: Georeference, name: str
) -> None:
    planted = tmp_path / name
    planted.write_text(vrt(f"/vsicurl/{server}/dem.tif"))
    with rasterio.Env(), pytest.raises(rasterio.errors.RasterioError):
        rasterio.open(planted).read(1)
    assert Contacts.requests, "without a bound on drivers GDAL does connect"
    Contacts.requests.clear()
    with pytest.raises(ElevationError, match="no GeoTIFF that can be read"):
        read_elevation(planted, system)
    assert Contacts.requests == []


def test_files_next_to_a_height_model_are_not_read(
    tmp_path: Path, server: str, system: Georeference
) -> None:
    good = geotiff(tmp_path / "dem.tif")
    for suffix in (".ovr", ".msk", ".aux.xml"):
        Path(f"{good}{suffix}").write_text(vrt(f"/vsicurl/{server}/dem.tif"))
    (tmp_path / "dem.tfw").write_text("1\n0\n0\n-1\n0\n0\n")
    model = read_elevation(good, system)
    assert model.step_x_m == 10.0 and model.height_m[0, 0] == 300.0
    assert Contacts.requests == []


NAMES = [
    "/vsicurl/http://127.0.0.1:1/dem.tif",
    "/vsizip/dem.zip/dem.tif",
    "http://127.0.0.1:1/dem.tif",
    "GTIFF_DIR:1:dem.tif",
    "/net/127.0.0.1/export/dem.tif",
    "../../../etc/passwd",
    "/proc/self/environ",
    "/dev/zero",
    "/dev/stdin",
    "dem\u0000.tif",
    "..",
    "/",
    "",
]


@pytest.mark.trust
@pytest.mark.parametrize("name", NAMES)
def test_a_mission_names_no_other_file_than_a_plain_local_one(
    tmp_path: Path, system: Georeference, name: str
) -> None:
    mission = Mission(tmp_path / "mission", "mission")
    (mission.path / "L0").mkdir(parents=True)
    quoted = name.replace("\0", "\\u0000")
    mission.service_path.write_text(
        f'[plan]\nelevation = "{quoted}"\nelevation_crs = "{CRS}"\n', encoding="utf-8"
    )
    _, plan = mount_of(mission)
    if plan.elevation is not None:
        assert plan.elevation.parent == mission.path or is_on_local_disk(plan.elevation)
        with pytest.raises(ElevationError):
            read_elevation(plan.elevation, system)


def test_a_path_below_a_network_mount_or_through_a_link_is_not_local(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert is_on_local_disk(tmp_path)
    (tmp_path / "link").symlink_to("/etc")
    assert not is_on_local_disk(tmp_path / "link" / "passwd")
    for kind in ("autofs", "nfs4", "cifs", "fuse.sshfs", "proc"):
        mounts = [("/", "ext4"), (str(tmp_path), kind)]
        monkeypatch.setattr(
            "daemon.mission.foreign_files._mounts", lambda mounts=mounts: iter(mounts)
        )
        assert not is_on_local_disk(tmp_path / "far" / "dem.tif"), kind


def test_a_pipe_or_a_folder_as_height_model_is_refused_without_blocking(
    tmp_path: Path, system: Georeference
) -> None:
    os.mkfifo(tmp_path / "dem.tif")
    for path in (tmp_path / "dem.tif", tmp_path, Path("/dev/zero")):
        with pytest.raises(ElevationError, match="is no file but a pipe, a device or a folder"):
            read_elevation(path, system)


@pytest.mark.trust
def test_a_sparse_model_of_60000_by_60000_is_refused_within_bounds(
    tmp_path: Path, system: Georeference
) -> None:
    path = geotiff(tmp_path / "seed.tif", BIGTIFF="YES", SPARSE_OK="TRUE")
    place = rasterio.transform.from_origin(500_000.0, 5_200_000.0, 1.0, 1.0)
    options = {"width": 60_000, "height": 60_000, "count": 1, "dtype": "float32", "crs": CRS}
    with rasterio.open(
        path, "w", driver="GTiff", transform=place, SPARSE_OK="TRUE", tiled=True, **options
    ):
        pass
    assert path.stat().st_size < 2_000_000
    tracemalloc.start()
    with pytest.raises(ElevationError, match=r"60000 x 60000 heights; .* cut it to the area"):
        read_elevation(path, system)
    assert tracemalloc.get_traced_memory()[1] < MEMORY_BYTES
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (HEADER.replace("ncols 2", "ncols 60000000").replace("nrows 2", "nrows 60"), "heights; a"),
        (HEADER.replace("nrows 2", "nrows -2") + "1 2 3 4", "heights; a height model has"),
        (HEADER.replace("nrows 2", "nrows inf") + "1 2 3 4", "no ESRI ASCII grid"),
        (HEADER + "1 2 3", "other than 4 heights"),
        (HEADER + "1 2 3 4 5", "other than 4 heights"),
        (HEADER + "1 2 hunter:x:0 4", "no ESRI ASCII grid"),
        (HEADER + "nan nan inf -inf", "none of them known"),
        (HEADER + "1 2 3 1e300", "the earth has none such"),
        (HEADER.replace("cellsize 10", "cellsize 0") + "1 2 3 4", "metres are needed"),
        (HEADER.replace("cellsize 10", "cellsize nan") + "1 2 3 4", "metres are needed"),
        (HEADER.replace("500000", "1e300") + "1 2 3 4", "metres are needed"),
        ("x" * 5000, "no ESRI ASCII grid"),
        ("", "no ESRI ASCII grid"),
    ],
)
def test_a_grid_that_is_none_is_refused_and_quotes_nothing(
    tmp_path: Path, system: Georeference, text: str, sentence: str
) -> None:
    with pytest.raises(ElevationError, match=sentence) as refused:
        read_elevation(asc(tmp_path / "dem.asc", text), system)
    assert "hunter" not in str(refused.value)


def test_a_grid_and_a_geotiff_say_the_same(tmp_path: Path, system: Georeference) -> None:
    grid = read_elevation(asc(tmp_path / "a.asc", HEADER + "1 2\n3 -9999\n"), system)
    values = np.array([[1, 2], [3, -9999]], np.float32)
    place = rasterio.transform.from_origin(500_000.0, 5_200_020.0, 10.0, 10.0)
    tiff = read_elevation(geotiff(tmp_path / "a.tif", values, transform=place), system)
    assert (grid.x_m, grid.y_m, grid.step_y_m) == (tiff.x_m, tiff.y_m, tiff.step_y_m)
    assert np.array_equal(grid.height_m, tiff.height_m)
    masked = read_elevation(
        geotiff(tmp_path / "b.tif", values, transform=place, nodata=-9999), system
    )
    assert np.isnan(masked.height_m[1, 1]) and masked.height_m[1, 0] == 3.0


@pytest.mark.parametrize(
    "options",
    [
        {"transform": rasterio.transform.Affine(0.0, 0, 5e5, 0, 0.0, 5e6)},
        {"transform": rasterio.transform.Affine(1e300, 0, 5e5, 0, -1e300, 5e6)},
        {"transform": rasterio.transform.Affine(10, 0, 1e300, 0, -10, 5e6)},
        {"transform": rasterio.transform.Affine(10, 3, 5e5, 3, -10, 5e6)},
        {"crs": "EPSG:4326"},
        {"crs": None},
        {"count": 200},
        {"dtype": "complex64"},
    ],
    ids=str,
)
def test_a_geotiff_with_absurd_tags_is_refused(
    tmp_path: Path, system: Georeference, options: dict[str, object]
) -> None:
    with pytest.raises(ElevationError):
        read_elevation(geotiff(tmp_path / "dem.tif", **options), system)


def test_a_block_larger_than_the_model_is_refused(tmp_path: Path, system: Georeference) -> None:
    data = bytearray(
        geotiff(tmp_path / "dem.tif", tiled=True, blockxsize=16, blockysize=16).read_bytes()
    )
    for tag in (322, 323):  # TileWidth, TileLength
        at = data.find(struct.pack("<HHI", tag, 3, 1))
        assert at > 0
        data[at : at + 12] = struct.pack("<HHII", tag, 4, 1, 16_384)
    (tmp_path / "dem.tif").write_bytes(data)
    with pytest.raises(ElevationError):
        read_elevation(tmp_path / "dem.tif", system)


@pytest.mark.parametrize(
    "crs",
    [
        "+init=/etc/passwd:1",
        "+proj=utm +zone=33 +nadgrids=http://x/y",
        "file:///etc/passwd",
        "x" * 9,
    ],
)
def test_a_coordinate_system_is_a_code_and_nothing_that_proj_would_open(crs: str) -> None:
    with pytest.raises(GeoreferenceError, match="write it as EPSG"):
        Georeference(crs)

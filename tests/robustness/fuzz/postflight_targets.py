"""Readers of files that commands take after landing."""

from __future__ import annotations

import functools
import json
import struct
from io import BytesIO

import numpy as np

from tests.robustness.fuzz.target import Target, scratch_file, scratch_folder


@functools.cache
def _georeference() -> object:
    from daemon.orientation.georeference import Georeference

    return Georeference("EPSG:32633")


def elevation_tiff() -> Target:
    import rasterio

    from daemon.orientation.elevation import ElevationError, read_elevation

    path = scratch_folder() / "seed.tif"
    place = rasterio.Affine(10, 0, 5e5, 0, -10, 5e6)
    with rasterio.open(
        path, "w", driver="GTiff", width=4, height=3, count=1, dtype="float32",
        crs="EPSG:32633", transform=place, nodata=-9999,
    ) as raster:  # fmt: skip
        raster.write(np.full((3, 4), 300.0, np.float32), 1)
    system = _georeference()
    return Target(
        # `_georeference` imports late and states no type.
        lambda data: read_elevation(scratch_file("d.tif", data), system),  # type: ignore[arg-type]
        (ElevationError,),
        (path.read_bytes(),),
    )


def elevation_ascii() -> Target:
    from daemon.orientation.elevation import ElevationError, read_elevation

    seed = (
        b"ncols 2\nnrows 2\nxllcorner 500000\nyllcenter 5200000\nxllcenter 1\ncellsize 10\n"
        b"NODATA_value -9999\n1 2.5\n-9999 4e1\n"
    )
    system = _georeference()
    return Target(
        # `_georeference` imports late and states no type.
        lambda data: read_elevation(scratch_file("d.asc", data), system),  # type: ignore[arg-type]
        (ElevationError,),
        (seed,),
    )


def radiometry() -> Target:
    from processing.radiometry.calibration import CalibrationError, load_radiometry

    maps = {key: np.ones((2, 3), np.float32) for key in ("bias_dn", "dark_dn_per_s", "gain")}
    scalars = {"doubling_k": np.float64(6.0), "reference_c": np.float64(20.0)}
    buffer = BytesIO()
    np.savez(buffer, **maps, **scalars, defect=np.zeros((2, 3), np.uint8))
    return Target(
        lambda data: load_radiometry(scratch_file("SU00.npz", data)),
        (CalibrationError,),
        (buffer.getvalue(),),
    )


def trajectory_csv() -> Target:
    from daemon.orientation.trajectory import TrajectoryError, read_trajectory

    seed = (
        b"gps_ns,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg\n"
        b"1447400000000000000,47.0,15.0,1000,0,0,90\n1447400001000000000,47.0,15.1,1000,0,0,90\n"
    )
    return Target(
        lambda data: read_trajectory(
            scratch_file("t.csv", data), around_gps_ns=1_447_400_000_000_000_000
        ),
        (TrajectoryError,),
        (seed,),
    )


def trajectory_sbet() -> Target:
    from daemon.orientation.trajectory import TrajectoryError, read_trajectory

    seed = b"".join(struct.pack("<17d", float(t), 0.8, 0.26, 900.0, *[0.1] * 13) for t in (1, 2, 3))
    return Target(
        lambda data: read_trajectory(
            scratch_file("t.out", data), around_gps_ns=1_447_400_000_000_000_000
        ),
        (TrajectoryError,),
        (seed,),
    )


def xmp() -> Target:
    from daemon.postflight.importers.xmp import XmpError, read_xmp
    from tests.daemon.rededge_data import packet

    def parse(data: bytes) -> object:
        found = read_xmp(data, "a.tif")
        return found.numbers("VignettingPolynomial", 6), found.number("CentralWavelength")

    return Target(parse, (XmpError,), (packet(),))


def dbat_script() -> Target:
    from daemon.postflight.adjustment.csv_tables import ProjectError
    from daemon.postflight.importers.dbat import import_dbat

    seed = (
        b"<document><meta><name>n</name></meta><input><cameras><camera><name>c</name>"
        b"<image>4000,3000</image><sensor>auto,4.5</sensor><model>3</model><focal>8</focal>"
        b'</camera></cameras><images><file format="id,path">i.csv</file></images>'
        b'<image_pts><file format="im,id,x,y,sxy">p.csv</file></image_pts>'
        b'<ctrl_pts><file format="id,label,x,y,z">c.csv</file></ctrl_pts></input></document>'
    )
    scratch_file("i.csv", b"1,a.jpg\n")
    scratch_file("p.csv", b"1,2,3.0,4.0,0.1\n")
    scratch_file("c.csv", b"2,a,1,2,3\n")
    return Target(lambda data: import_dbat(scratch_file("s.xml", data)), (ProjectError,), (seed,))


def adjustment_project() -> Target:
    from daemon.postflight.adjustment.csv_tables import ProjectError
    from daemon.postflight.adjustment.project_file import read_project_file

    seed = b'format = 1\nname = "n"\n[[camera]]\nname = "c"\nf_mm = 50\nfree = ["k1"]\n'
    return Target(
        lambda data: read_project_file(scratch_file("p.toml", data)), (ProjectError,), (seed,)
    )


def adjustment_table() -> Target:
    from daemon.postflight.adjustment.csv_tables import ProjectError, read_table

    def parse(data: bytes) -> object:
        return read_table(scratch_file("t.csv", data), ("point",), ("x_m",)).numbers("x_m")

    return Target(parse, (ProjectError,), (b'# remark\npoint,x_m\na,1.5\n"b,c",\n',))


def laboratory_series() -> Target:
    from daemon.postflight.calibration.laboratory.laboratory_series import SeriesError, read_series
    from daemon.postflight.calibration.laboratory.radiometric import RadiometricSeries
    from processing.rig import RigError, shipped_rigs

    def parse(data: bytes) -> object:
        return read_series(scratch_file("series.json", data).parent, RadiometricSeries)

    (scratch_folder() / "rig.toml").write_bytes(shipped_rigs()["rededge"].read_bytes())
    content = {"format": 1, "kind": "radiometric", "date": "2026-01-01", "images": [{"file": "a"}]}
    return Target(parse, (SeriesError, RigError), (json.dumps(content).encode(),))


def catalog() -> Target:
    import sqlite3

    from daemon.mission.catalog.catalog import Catalog, CatalogError

    path = scratch_folder() / "seed.db"
    path.unlink(missing_ok=True)
    Catalog.open(path).close()
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
    connection.close()

    def parse(data: bytes) -> None:
        opened = Catalog.read(scratch_file("m.db", data))
        try:
            list(opened.events())
        finally:
            opened.close()

    return Target(parse, (CatalogError,), (path.read_bytes(),))

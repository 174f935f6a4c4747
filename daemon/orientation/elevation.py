"""Height models from files: ESRI ASCII grids, and GeoTIFFs where rasterio is installed.

A model is taken in the coordinate and height system of the orientation it is used with; what says
otherwise is refused, never reprojected by guess.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from daemon.errors import DaemonError
from daemon.orientation.georeference import Georeference
from drivers.extras import require
from processing.geometry.terrain_rays import HeightModel

MODEL_MAX_BYTES = 2_000_000_000
_ASCII_KEYS = ("ncols", "nrows", "cellsize")


class ElevationError(DaemonError):
    """A height model that cannot be used; the sentence names file, finding and cure."""


def read_elevation(path: Path, georeference: Georeference) -> HeightModel:
    """Read a height model.

    Raises:
        ElevationError: no such file, damaged, or in another coordinate system.
    """
    try:
        if path.stat().st_size > MODEL_MAX_BYTES:
            raise ElevationError(f"{path}: larger than {MODEL_MAX_BYTES / 1e9:.0f} GB; cut it")
        return _ascii(path) if path.suffix.lower() == ".asc" else _geotiff(path, georeference)
    except OSError as error:
        raise ElevationError(f"{path}: cannot be read ({error})") from error


def _ascii(path: Path) -> HeightModel:
    """ncols, nrows, xllcorner or xllcenter, yllcorner or yllcenter, cellsize, NODATA_value."""
    try:
        words = path.read_text(encoding="ascii").split()
        keys: dict[str, float] = {}
        at = 0
        while words[at][0].isalpha():
            keys[words[at].lower()] = float(words[at + 1])
            at += 2
        shape = (int(keys["nrows"]), int(keys["ncols"]))
        heights = np.array(words[at:], dtype=np.float64).reshape(shape)
        cell = keys["cellsize"]
        centred = "xllcenter" in keys
        x = keys["xllcenter"] if centred else keys["xllcorner"] + cell / 2.0
        y = keys["yllcenter"] if centred else keys["yllcorner"] + cell / 2.0
    except (UnicodeDecodeError, ValueError, KeyError, IndexError) as error:
        raise ElevationError(
            f"{path}: no ESRI ASCII grid ({error}); it begins with {', '.join(_ASCII_KEYS)}, "
            "xllcorner, yllcorner and holds as many heights as rows times columns"
        ) from error
    nodata = keys.get("nodata_value")
    if nodata is not None:
        heights[heights == nodata] = np.nan
    return _checked(path, HeightModel(heights, x, y + (shape[0] - 1) * cell, cell, -cell))


def _geotiff(path: Path, georeference: Georeference) -> HeightModel:
    require("geotiff", "geodesy")
    import pyproj
    import rasterio

    try:
        with rasterio.open(path) as raster:
            heights = raster.read(1, masked=True).astype(np.float64).filled(np.nan)
            place, system = raster.transform, raster.crs
    except rasterio.errors.RasterioError as error:
        raise ElevationError(f"{path}: {error}") from error
    if system is None:
        raise ElevationError(f"{path}: no coordinate system in it; assign {georeference.name}")
    own = pyproj.CRS.from_wkt(system.to_wkt())
    plan = own.sub_crs_list[0] if own.is_compound else own
    wanted = georeference.crs
    wanted = wanted.sub_crs_list[0] if wanted.is_compound else wanted
    if not plan.equals(wanted, ignore_axis_order=True) and plan.to_epsg() != wanted.to_epsg():
        raise ElevationError(
            f"{path} is in {plan.name}, the orientation in {wanted.name}: give --crs "
            f"{system.to_string()}, or bring it there (gdalwarp -t_srs {georeference.name})"
        )
    if place.b or place.d:
        raise ElevationError(f"{path}: its rows are turned against the grid; warp it north up")
    return _checked(
        path,
        HeightModel(heights, place.c + place.a / 2, place.f + place.e / 2, place.a, place.e),
    )


def _checked(path: Path, model: HeightModel) -> HeightModel:
    if min(model.height_m.shape) < 2 or not np.isfinite(model.height_m).any():
        raise ElevationError(f"{path}: {model.height_m.shape} heights, none of them known")
    return model

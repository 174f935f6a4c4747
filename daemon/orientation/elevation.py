"""Height models from files: ESRI ASCII grids, and GeoTIFFs where rasterio is installed.

A model is taken in the coordinate and height system of the orientation it is used with; a model
in another system is refused, never reprojected by guess. A model comes from others: GDAL sees one
open plain file, reads it as GeoTIFF only, and looks at nothing next to it.
"""

from __future__ import annotations

import math
import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from daemon import DaemonError
from daemon.mission.foreign_files import ForeignFileError, open_regular_file
from daemon.orientation.geodesy import CRS, CRSError
from daemon.orientation.georeference import Georeference
from drivers.base.extras import require
from processing.geometry.terrain_rays import HeightModel

MODEL_MAX_BYTES = 2_000_000_000
MODEL_MAX_CELLS = 100_000_000
"""In memory a cell takes 8 bytes: 800 MB."""
BANDS_MAX = 4
HEIGHT_LIMITS_M = (-12_000.0, 10_000.0)
CELL_LIMITS_M = (0.01, 100_000.0)
COORDINATE_LIMIT_M = 1e8
_ASCII_KEYS = ("ncols", "nrows", "cellsize")
_ASCII_HEADER = {*_ASCII_KEYS, "nodata_value"} | {
    f"{axis}ll{place}" for axis in "xy" for place in ("corner", "center")
}
_ASCII_HEADER_MAX_BYTES = 4096
_GDAL_SINGLE_FILE = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_PAM_ENABLED": "NO",
    "GDAL_GEOREF_SOURCES": "INTERNAL",
    "GDAL_NUM_THREADS": "1",
}


class ElevationError(DaemonError):
    """A height model that cannot be used; the message names file, finding and remedy."""


def read_elevation(path: Path, georeference: Georeference) -> HeightModel:
    """Read a height model.

    Raises:
        ElevationError: no plain file, damaged, too large, or in another coordinate system.
    """
    try:
        with open_regular_file(path, MODEL_MAX_BYTES) as descriptor:
            if path.suffix.lower() == ".asc":
                return _ascii(path, descriptor)
            return _geotiff(path, descriptor, georeference)
    except (ForeignFileError, OSError) as error:
        raise ElevationError(f"height model {error}") from error


def _ascii(path: Path, descriptor: int) -> HeightModel:
    """ncols, nrows, xllcorner or xllcenter, yllcorner or yllcenter, cellsize, NODATA_value."""
    try:
        keys, begin = _ascii_header(os.pread(descriptor, _ASCII_HEADER_MAX_BYTES, 0))
        shape = (int(keys["nrows"]), int(keys["ncols"]))
        _check_cells(path, *shape)
        cell = keys["cellsize"]
        centred = "xllcenter" in keys
        x = keys["xllcenter"] if centred else keys["xllcorner"] + cell / 2.0
        y = keys["yllcenter"] if centred else keys["yllcorner"] + cell / 2.0
        heights = _ascii_heights(descriptor, begin, math.prod(shape)).reshape(shape)
    except (ArithmeticError, ValueError, KeyError) as error:
        raise ElevationError(
            f"{path}: no ESRI ASCII grid ({error}); it begins with {', '.join(_ASCII_KEYS)}, "
            "xllcorner, yllcorner and holds as many heights as rows times columns"
        ) from error
    nodata = keys.get("nodata_value")
    if nodata is not None:
        heights[heights == nodata] = np.nan
    return _checked(path, HeightModel(heights, x, y + (shape[0] - 1) * cell, cell, -cell))


def _ascii_header(head: bytes) -> tuple[dict[str, float], int]:
    """The values by key in lower case, and at which byte the heights begin."""
    keys: dict[str, float] = {}
    at = 0
    for line in head.splitlines(keepends=True):
        fields = line.decode("ascii").split()
        if fields and (len(fields) != 2 or fields[0].lower() not in _ASCII_HEADER):
            return keys, at
        if fields:
            keys[fields[0].lower()] = float(fields[1])
        at += len(line)
    return keys, at


def _ascii_heights(descriptor: int, begin: int, count: int) -> np.ndarray[Any, Any]:
    """Exactly this many numbers, parsed one at a time."""
    with os.fdopen(os.dup(descriptor), "rb") as file, warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # how numpy reports other words
        file.seek(begin)
        try:
            heights = np.fromfile(file, np.float64, count, sep=" ")
        except DeprecationWarning as error:
            raise ValueError("a height is no number") from error
        if len(heights) != count or file.read(_ASCII_HEADER_MAX_BYTES).strip():
            raise ValueError(f"it holds other than {count} heights")
    return heights


def _geotiff(path: Path, descriptor: int, georeference: Georeference) -> HeightModel:
    require("geotiff")
    import rasterio

    # The descriptor, not the path: a name such as /vsicurl/... never reaches GDAL.
    opened = f"/proc/self/fd/{descriptor}"
    try:
        with (
            rasterio.Env(**_GDAL_SINGLE_FILE),
            rasterio.open(opened, driver="GTiff", sharing=False) as raster,
        ):
            _check_raster(path, raster)
            heights = raster.read(1, out_dtype="float64")
            heights[raster.read_masks(1) == 0] = np.nan
            place, system = raster.transform, raster.crs
            own = None if system is None else CRS.from_wkt(system.to_wkt())
    except (rasterio.errors.RasterioError, CRSError, ValueError) as error:
        found = str(error).replace(opened, path.name)
        raise ElevationError(
            f"{path}: no GeoTIFF that can be read ({found}). A height model is a GeoTIFF or an "
            "ESRI ASCII grid (gdal_translate -of GTiff)"
        ) from error
    if own is None:
        raise ElevationError(f"{path}: no coordinate system in it; assign {georeference.name}")
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


def _check_raster(path: Path, raster: Any) -> None:
    """Refuse what would take more memory than its cells, before GDAL reads one."""
    _check_cells(path, raster.height, raster.width)
    if raster.count > BANDS_MAX or np.dtype(raster.dtypes[0]).kind not in "iuf":
        raise ElevationError(
            f"{path}: {raster.count} bands of {raster.dtypes[0]}; heights are one band of numbers"
        )
    block = math.prod(raster.block_shapes[0])
    if block > max(raster.height * raster.width, 1 << 20):
        raise ElevationError(
            f"{path}: one of its blocks states {block} cells; that is more than all"
        )


def _check_cells(path: Path, rows: int, columns: int) -> None:
    if not (rows >= 2 and columns >= 2 and rows * columns <= MODEL_MAX_CELLS):
        raise ElevationError(
            f"{path}: {columns} x {rows} heights; a height model has 2 x 2 at least and "
            f"{MODEL_MAX_CELLS} in all at most: cut it to the area that is flown, or make it "
            "coarser (gdalwarp -te, -tr)"
        )


def _checked(path: Path, model: HeightModel) -> HeightModel:
    steps = (abs(model.step_x_m), abs(model.step_y_m))
    low, high = CELL_LIMITS_M
    placed = max(abs(model.x_m), abs(model.y_m)) <= COORDINATE_LIMIT_M
    if not (low <= min(steps) and max(steps) <= high and placed):
        raise ElevationError(
            f"{path}: begins at {model.x_m:g}, {model.y_m:g} with cells of {model.step_x_m:g} x "
            f"{model.step_y_m:g}; metres are needed, cells between {low:g} and {high:g}"
        )
    heights = model.height_m
    heights[~np.isfinite(heights)] = np.nan
    if np.isnan(heights).all():
        raise ElevationError(f"{path}: {heights.shape} heights, none of them known")
    minimum, maximum = float(np.nanmin(heights)), float(np.nanmax(heights))
    if not (HEIGHT_LIMITS_M[0] <= minimum and maximum <= HEIGHT_LIMITS_M[1]):
        raise ElevationError(
            f"{path}: heights from {minimum:g} to {maximum:g} m; the earth has none such: declare "
            "the nodata value (gdal_edit.py -a_nodata)"
        )
    return model

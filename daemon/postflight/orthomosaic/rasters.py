"""Files of an orthomosaic: Cloud Optimized GeoTIFFs of PAN, RGB and CIR, in 16 and 8 bits.

Tiles are copied one by one into a plain GeoTIFF, from which GDAL makes the COG.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.mission.store.durable import sync_file
from daemon.orientation.georeference import Georeference
from daemon.postflight.orthomosaic.tiles import TilePlan, tile_file
from daemon.products.cog_file import CogLayout, new_cog
from processing.radiometry.tone_curve import (
    VALUE_COUNT,
    ToneCurve,
    histogram,
    lookup_table,
    mission_curve,
)

Array = NDArray[Any]

IMAGES: Final[Mapping[str, tuple[str, ...]]] = {
    "pan": ("pan",),
    "rgb": ("red", "green", "blue"),
    "cir": ("nir", "red", "green"),
}
BLOCK_PX: Final = 512


def tone_curves(
    folder: Path, plan: TilePlan, bands: Sequence[str]
) -> tuple[Mapping[str, ToneCurve], int]:
    """Curves of PAN and of the colour bands from all tiles, and how many pixels have data."""
    sums = {band: np.zeros(VALUE_COUNT, np.int64) for band in bands}
    for column, row, _, _ in plan.tiles:
        tile = np.load(tile_file(folder, column, row), mmap_mode="r")
        for band, plane in zip(bands, tile, strict=True):
            sums[band] += histogram(np.ascontiguousarray(plane))
    pan = mission_curve({"pan": sums["pan"]})
    colours = {band: counts for band, counts in sums.items() if band != "pan"}
    colour = mission_curve(colours) if colours else pan
    curves = {band: pan if band == "pan" else colour for band in bands}
    return curves, int(sums["pan"].sum())


def write_cog(
    final: Path,
    work: Path,
    plan: TilePlan,
    tiles: Path,
    bands: Sequence[str],
    image: str,
    *,
    curves: Mapping[str, ToneCurve] | None,
    georeference: Georeference,
    tags: Mapping[str, str],
) -> int:
    """Write one COG.

    Args:
        final: the file, in a folder that is not published yet.
        work: folder for the plain GeoTIFF.
        bands: of the stored tiles.
        image: of `IMAGES`.
        curves: by band, for 8 bits; None: 16 bits, linear.
        tags: texts of the file.

    Returns:
        Its size in bytes.

    Raises:
        MissingExtraError: rasterio is not installed.
        OSError: the disk refused.
    """
    names = IMAGES[image]
    index = [list(bands).index(name) for name in names]
    tables = None if curves is None else [lookup_table(curves[name], name) for name in names]
    grid = plan.grid
    half = grid.gsd_m / 2.0
    horizontal = georeference.crs
    horizontal = horizontal.sub_crs_list[0] if horizontal.is_compound else horizontal
    layout = CogLayout(
        width_px=grid.width_px,
        height_px=grid.height_px,
        crs=horizontal.to_wkt(),
        west_m=grid.east_m - half,
        north_m=grid.north_m + half,
        pixel_m=grid.gsd_m,
        bands=names,
        dtype="uint16" if tables is None else "uint8",
        block_px=BLOCK_PX,
    )
    with new_cog(final, work / f"{final.stem}.plain.tif", layout, tags) as write:
        for column, row, _, _ in plan.tiles:
            tile = np.load(tile_file(tiles, column, row), mmap_mode="r")
            planes = [np.asarray(tile[k]) for k in index]
            if tables is not None:
                planes = [table[plane] for table, plane in zip(tables, planes, strict=True)]
            write(np.stack(planes), column, row)
    sync_file(final)
    return final.stat().st_size

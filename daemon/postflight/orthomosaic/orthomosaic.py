"""Orthomosaic of a mission at full resolution: survey, tiles, files, published as one folder."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from daemon.mission.canonical_json import canonical_bytes
from daemon.mission.store import durable
from daemon.mission.store.publication import published
from daemon.postflight.batch.batch_run import StepCompute, in_this_process
from daemon.postflight.orthomosaic.cells import CellSurvey, cell_grid, refuse_coarse_grid, survey
from daemon.postflight.orthomosaic.inputs import OrthoBlock, described_ground
from daemon.postflight.orthomosaic.orthomosaic_work import (
    OrthomosaicRequest,
    OrthomosaicWork,
    make_tiles,
    survey_images,
    work_of,
)
from daemon.postflight.orthomosaic.rasters import IMAGES, tone_curves, write_cog
from daemon.postflight.orthomosaic.seam_file import write_seams
from daemon.postflight.orthomosaic.tiles import TilePlan, missing_tiles, plan_tiles, stored_nbytes
from daemon.postflight.orthomosaic.triangulated import OrthomosaicError
from daemon.postflight.orthomosaic.work_folder import refuse_foreign_places, work_folder
from processing.image.orthoimage.ground_grid import GroundGrid
from processing.radiometry.tone_curve import curve_as_json

SEAM_FILE: Final = "seams.gpkg"
REPORT_FILE: Final = "orthomosaic.json"
DEPTHS: Final = (16, 8)
_BYTES_PER_SAMPLE: Final = 2
_DISK_SHARE: Final = 3.0
"""Tiles, a plain GeoTIFF of one image, and the finished files, in bytes of the tiles."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class OrthomosaicSettings:
    """What is made: `images` of `rasters.IMAGES`, `depths` of 16 and 8, gains levelled or one."""

    images: tuple[str, ...] = tuple(IMAGES)
    depths: tuple[int, ...] = DEPTHS
    levelled: bool = True


def make_orthomosaic(
    request: OrthomosaicRequest,
    block: OrthoBlock,
    final: Path,
    settings: OrthomosaicSettings,
    *,
    compute: StepCompute = lambda _step: in_this_process,
    progress: Progress = lambda _done, _total: None,
) -> dict[str, Any]:
    """Make the orthomosaic in a folder; an earlier one there is replaced when all is complete.

    An interrupted run leaves its tiles next to the folder; repeated with the same inputs it
    continues and gives the same bytes.

    Args:
        request: by which the block was collected.
        block: what was found.
        final: folder of the results.
        settings: what is made.
        compute: where images are looked at and tiles are made, by step.
        progress: called with the count of files written and of all.

    Returns:
        The report, as in `orthomosaic.json`, with `files` and `tiles_computed` in addition.

    Raises:
        OutputPlaceError: the folder holds something else.
        OrthomosaicError: no image covers the ground, ground pixels are too large for the images,
            one cannot be read, the disk is too small, or another command makes the same
            orthomosaic.
        OSError: the disk refused.
    """
    final = final.resolve()
    refuse_foreign_places(final, block.mission)
    refuse_coarse_grid(block)
    bands, left_out = _bands(block, settings.images)
    with work_folder(final, _key(block, bands, settings)) as tiles:
        work_on = work_of(request, block, bands, tiles)
        return _write_files(work_on, block, final, settings, left_out, compute, progress)


def _key(block: OrthoBlock, bands: Sequence[str], settings: OrthomosaicSettings) -> str:
    """Name of the folder of tiles: all that they depend on."""
    gains = "level" if settings.levelled else "plain"
    return f"{block.key()[:24]}-{'-'.join(bands)}-{gains}"


def _write_files(
    work_on: OrthomosaicWork,
    block: OrthoBlock,
    final: Path,
    settings: OrthomosaicSettings,
    left_out: Sequence[str],
    compute: StepCompute,
    progress: Progress,
) -> dict[str, Any]:
    bands, tiles = work_on.bands, work_on.folder
    seen = survey_images(work_on, block, compute("survey of the images"))
    found = survey(block, bands, seen, level=settings.levelled)
    if not (found.owner >= 0).any():
        raise OrthomosaicError(
            "no image covers the ground of the grid: is the ground in the height system of the "
            "orientations, and does the height model reach below the images?"
        )
    plan = plan_tiles(block, found)
    missing = missing_tiles(found, plan, tiles)
    _refuse_full_disk(final.parent, plan.grid, len(bands), stored_nbytes(tiles))
    make_tiles(work_on, missing, compute("tiles"))
    curves, pixels = tone_curves(tiles, plan, bands)
    report = _report(block, found, plan, settings, left_out)
    report["pixels_with_data"] = pixels
    report["tone_curves"] = {
        name: curve_as_json(curves[IMAGES[name][0]])
        for name in ("pan", "rgb") if IMAGES[name][0] in curves
    }  # fmt: skip
    tags = {f"SYNTOPIC_{mark.upper()}": "YES" for mark in block.marks}
    images = [name for name in settings.images if not set(IMAGES[name]) - set(bands)]
    files: dict[str, int] = {}
    with published(final) as part:
        total = len(images) * len(settings.depths)
        for image in images:
            for depth in settings.depths:
                name = f"{image}-{depth}.tif"
                files[name] = write_cog(
                    part / name, tiles.parent, plan, tiles, bands, image,
                    curves=curves if depth == 8 else None,
                    georeference=block.georeference, tags=tags,
                )  # fmt: skip
                progress(len(files), total)
        report["seams"]["lines"] = write_seams(
            part / SEAM_FILE, found.owner, cell_grid(block.grid),
            [(image.name, image.exposure) for image in block.images], block.georeference,
        )  # fmt: skip
        durable.create_file(part / REPORT_FILE, [canonical_bytes(report)], mode=0o644)
    return report | {"files": files, "tiles_computed": len(missing)}


def _bands(block: OrthoBlock, images: Sequence[str]) -> tuple[tuple[str, ...], list[str]]:
    """PAN and the colour bands that every image has, and sentences on what is left out."""
    wanted = dict.fromkeys(band for name in images for band in IMAGES[name] if band != "pan")
    bands, left_out = ["pan"], []
    for band in wanted:
        absent = [image.name for image in block.images if band not in image.colour]
        if absent and block.is_of_photographs:
            left_out.append(f"{band}: photographs have none")
        elif absent:
            left_out.append(
                f"{band}: {len(absent)} of {len(block.images)} images have none at Level-2, "
                f"{absent[0]} the first; process them again"
            )
        else:
            bands.append(band)
    return tuple(bands), left_out


def _refuse_full_disk(folder: Path, grid: GroundGrid, bands: int, stored_nbytes: int) -> None:
    pixels = grid.width_px * grid.height_px
    needed = pixels * bands * _BYTES_PER_SAMPLE * _DISK_SHARE - stored_nbytes
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise OrthomosaicError(
            f"{folder}: {free / 1e9:.1f} GB free; {grid.width_px} x {grid.height_px} pixels of "
            f"{bands} bands need up to {needed / 1e9:.1f} GB. Free space, or give a larger --gsd"
        )


def _report(
    block: OrthoBlock,
    found: CellSurvey,
    plan: TilePlan,
    settings: OrthomosaicSettings,
    left_out: Sequence[str],
) -> dict[str, Any]:
    grid = plan.grid
    report: dict[str, Any] = {
        "format": 1,
        "mission": block.mission.id,
        **dict.fromkeys(block.marks, True),
        "orientation": block.orientation,
        "crs": block.georeference.name,
        "height_system": block.georeference.height_system,
        "ground": described_ground(block.ground) | block.ground_check.as_json(),
        "findings": [one.as_json() for one in block.ground_check.findings],
        "gsd_m": grid.gsd_m,
        "width_px": grid.width_px,
        "height_px": grid.height_px,
        "first_pixel_m": [grid.east_m, grid.north_m],
        "images": len(block.images),
        "images_used": len(np.unique(found.owner[found.owner >= 0])),
        "levelled": settings.levelled,
        "bands": list(found.bands),
        "left_out": list(left_out),
        "seams": {
            "step_rms_before": {band: steps[0] for band, steps in found.seam_rms.items()},
            "step_rms_after": {band: steps[1] for band, steps in found.seam_rms.items()},
        },
        "failures": [failure.as_json() for failure in block.failures],
    }
    if isinstance(block.ground.surface, float):
        report["relief"] = _relief(block, found)
    return report


def _relief(block: OrthoBlock, found: CellSurvey) -> dict[str, Any]:
    """What relief over a plane displaces: metres outward for each metre of height."""
    grid = cell_grid(block.grid)
    rows, columns = np.nonzero(found.owner >= 0)
    owner = found.owner[rows, columns]
    nadir = np.array([image.nadir_m for image in block.images])[owner]
    above = np.array([image.height_m for image in block.images])[owner] - block.ground.surface
    d = np.hypot(grid.columns_m[columns] - nadir[:, 0], grid.rows_m[rows] - nadir[:, 1]) / above
    rms, worst = float(np.sqrt(np.mean(d**2))), float(d.max())
    spread = block.ground.relief_rms_m
    return {
        "displacement_per_m_rms": rms,
        "displacement_per_m_max": worst,
        "expected_rms_m": None if spread is None else rms * spread,
    }


def relief_sentence(report: dict[str, Any]) -> str | None:
    """What the plane costs, for a person; None with a height model."""
    relief = report.get("relief")
    if relief is None:
        return None
    text = (
        f"Ground is a plane at {report['ground']['height_m']:.2f} m: ground 1 m above it is "
        f"displaced by {relief['displacement_per_m_rms']:.3f} m RMS, "
        f"{relief['displacement_per_m_max']:.3f} m at most"
    )
    if relief["expected_rms_m"] is not None:
        text += (
            f"; tie points lie {report['ground']['relief_rms_m']:.2f} m RMS off the plane, "
            f"which displaces by {relief['expected_rms_m'] / report['gsd_m']:.2f} px RMS"
        )
    return text + ". Give --elevation for a height model."

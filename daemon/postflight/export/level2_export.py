"""Level-2 for other programs: Cloud Optimized GeoTIFFs, and JPEGs with EXIF and XMP.

The geometry stays that of the image: nothing is rectified. A COG carries ground control points on
level ground, from trajectory and mount, so that it is roughly in place; its orientation is
in its tags.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.exposure import Exposure
from daemon.mission.exposure_batch import ExposureFailure, for_each_exposure
from daemon.mission.layout import Mission
from daemon.mission.store.durable import make_directories, new_file, replace_file
from daemon.mission.store.level0 import read_description, refuse_decompression_bomb
from daemon.mission.store.level2 import jpeg_bytes
from daemon.orientation.exterior_orientation import ExteriorOrientation, sealed_exposures
from daemon.orientation.georeference import Georeference
from daemon.orientation.orientation_inputs import read_orientation_inputs
from daemon.postflight.export.exif import PictureMetadata, metadata_texts, with_metadata
from drivers.base.extras import require
from processing.geometry.orientation import BODY_FROM_CAMERA, ENU_FROM_NED, on_level_ground
from processing.geometry.rotation import roll_pitch_heading
from processing.rig import Rig

KINDS = ("cog", "jpeg")
JPEG_QUALITY = 92
GRID = 5
"""Ground control points along each side of a COG."""

_REMARK = (
    "perspective image, not rectified; oriented by trajectory and mount; altitude above the "
    "ellipsoid of WGS 84"
)


class PictureError(DaemonError):
    """Nothing to export; the message states what is missing."""


@dataclass(frozen=True)
class Level2Image:
    """One raster of Level-2 and its orientation."""

    path: Path
    name: str
    eo: ExteriorOrientation
    f_mm: float
    pixel_mm: float
    exposure_time_s: float | None


def export_pictures(
    mission: Mission,
    kind: str,
    *,
    crs: str | None = None,
    trajectory_file: Path | None = None,
    mount_file: Path | None = None,
    only: Sequence[int] = (),
    progress: Callable[[int], None] = lambda _done: None,
) -> tuple[list[Path], tuple[ExposureFailure, ...]]:
    """Write every raster of Level-2 as `kind` into `export/<kind>/`.

    Returns:
        The files, and the exposures that could not be exported.

    Raises:
        PictureError: no Level-2, no orientation, or rasterio is missing.
        TrajectoryError, GeoreferenceError: as their modules say.
    """
    read = sealed_exposures(mission)
    exposures = {
        number: exposure
        for number, exposure in read.results.items()
        if exposure.mark_gps_ns is not None and (not only or number in only)
    }
    unreadable = [f for f in read.failures if not only or f.exposure in only]
    inputs = read_orientation_inputs(
        mission,
        list(exposures.values()),
        crs=crs,
        trajectory_file=trajectory_file,
        mount_file=mount_file,
    )
    rig = inputs.rig
    folder = mission.export_dir / kind
    make_directories(folder)

    def export_one(number: int) -> list[Path]:
        exposure, written = exposures[number], []
        for picture in _pictures(mission, rig, exposure, inputs.oriented([exposure])):
            shot = _shot(rig, picture, inputs.crs, simulated=exposure.simulated)
            if kind == "cog":
                final = folder / f"{picture.name}.tif"
                _cog(picture, shot, inputs.georeference, inputs.ground_height_m, final)
            else:
                final = folder / f"{picture.name}.jpg"
                replace_file(final, with_metadata(_jpeg(picture.path), shot))
            written.append(final)
        return written

    done = for_each_exposure(exposures, export_one, progress)
    files = [path for written in done.results.values() for path in written]
    failures = (*unreadable, *done.failures)
    if not files:
        causes = "".join(f"; {cause}" for cause in dict.fromkeys(one.cause for one in failures))
        raise PictureError(
            f"{mission.path}: no exposure has both Level-2 and an orientation; run "
            "`syntopic process` first, and give --trajectory where no receiver knew the attitude"
            f"{causes}"
        )
    return files, failures


def _pictures(
    mission: Mission, rig: Rig, exposure: Exposure, oriented: Sequence[ExteriorOrientation]
) -> Iterator[Level2Image]:
    folder = mission.level2(exposure.number)
    times = {
        f.sensor: f.exposure_time_us * 1e-6
        for f in exposure.frames
        if f.exposure_time_us is not None
    }
    for eo in oriented:
        cone = rig.cone(eo.cone)
        seconds = times.get(cone.sensors[0].name)
        image = rig.virtual_image
        if image is not None:
            if not eo.is_virtual:
                continue
            for file, ratio in (("pan.tif", 1.0), ("rgbn.tif", float(image.colour_ratio))):
                if (folder / file).exists():
                    name = f"{eo.name}_{file.removesuffix('.tif')}"
                    yield Level2Image(
                        folder / file, name, eo, image.f_mm, image.pitch_mm * ratio, seconds
                    )
        elif (folder / f"{eo.cone}.tif").exists():
            sensor = cone.sensors[0]
            yield Level2Image(
                folder / f"{eo.cone}.tif", eo.name, eo, cone.lens.f_mm, sensor.pitch_mm, seconds
            )


def _shot(rig: Rig, picture: Level2Image, crs: str, *, simulated: bool) -> PictureMetadata:
    eo = picture.eo
    body = ENU_FROM_NED.T @ eo.enu_from_camera @ BODY_FROM_CAMERA.T
    roll, pitch, yaw = (math.degrees(angle) for angle in roll_pitch_heading(body))
    yaw %= 360.0
    east, north, height = (float(v) for v in eo.centre_m)
    return PictureMetadata(
        camera=rig.title or rig.name,
        serial=rig.cone(eo.cone).sensors[0].serial,
        name=picture.name,
        gps_ns=eo.gps_ns,
        latitude_deg=eo.latitude_deg,
        longitude_deg=eo.longitude_deg,
        height_m=eo.height_m,
        position_sigma_m=eo.horizontal_sigma_m,
        f_mm=picture.f_mm,
        pixel_um=picture.pixel_mm * 1e3,
        exposure_time_s=picture.exposure_time_s,
        yaw_pitch_roll_deg=(yaw, pitch, roll),
        omega_phi_kappa_deg=eo.omega_phi_kappa_deg,
        centre_m=(east, north, height),
        crs=crs,
        remark=("SIMULATED: " if simulated else "")
        + ("" if rig.is_calibrated else "UNCALIBRATED: ")
        + _REMARK,
    )


def _cog(
    picture: Level2Image,
    shot: PictureMetadata,
    georeference: Georeference,
    ground_m: float,
    final: Path,
) -> None:
    require("geotiff")
    from rasterio.io import MemoryFile
    from rasterio.shutil import copy

    planes = _planes(picture.path)
    count, height, width = planes.shape
    bands = read_description(picture.path).get("bands", [])
    with MemoryFile() as memory:
        with memory.open(
            driver="GTiff",
            width=width,
            height=height,
            count=count,
            dtype="uint16",
            nodata=0,
            gcps=_ground_control(picture, georeference, ground_m, width, height),
            crs=georeference.crs.to_wkt(),
        ) as raster:
            raster.write(planes)
            raster.update_tags(**metadata_texts(shot))
            for number, band in enumerate(bands[:count], 1):
                raster.set_band_description(number, str(band))
        with memory.open() as raster, new_file(final) as part:
            copy(
                raster, str(part), driver="COG", COMPRESS="DEFLATE", PREDICTOR="2", BLOCKSIZE="512",
                OVERVIEW_RESAMPLING="AVERAGE",
            )  # fmt: skip


def _ground_control(
    picture: Level2Image, georeference: Georeference, ground_m: float, width: int, height: int
) -> list[Any]:
    """Positions of grid pixels on level ground; rows and columns count from the corner."""
    from rasterio.control import GroundControlPoint

    columns, rows = np.meshgrid(np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID))
    xy = np.stack(
        [
            (columns.ravel() - (width - 1) / 2.0) * picture.pixel_mm,
            ((height - 1) / 2.0 - rows.ravel()) * picture.pixel_mm,
        ],
        axis=1,
    )
    # The plane is as far below in the grid's heights as below the ellipsoid's.
    level = float(picture.eo.centre_m[2]) - (picture.eo.height_m - ground_m)
    ground = on_level_ground(picture.eo.centre_m, picture.eo.rotation, xy, picture.f_mm, level)
    return [
        GroundControlPoint(row=r + 0.5, col=c + 0.5, x=float(p[0]), y=float(p[1]), z=float(p[2]))
        for c, r, p in zip(columns.ravel(), rows.ravel(), ground, strict=True)
        if np.isfinite(p).all()
    ]


def _planes(path: Path) -> NDArray[np.uint16]:
    """(bands, h, w) uint16, the saturation bit taken out."""
    from tifffile import TiffFile

    with TiffFile(path) as tiff:
        refuse_decompression_bomb(tiff.pages[0], path)
        planes = np.asarray(tiff.pages[0].asarray())
    planes = planes if planes.ndim == 3 else planes[None]
    return np.asarray(planes & np.uint16(0xFFFE), np.uint16)


def _jpeg(path: Path) -> bytes:
    """8 bits: red, green, blue where there are three bands, else grey; one stretch for all."""
    planes = _planes(path)
    chosen = planes[:3] if len(planes) >= 3 else planes[:1]
    sample = chosen[:, ::8, ::8]
    seen = sample[sample > 0]
    low, high = np.percentile(seen, (0.5, 99.5)) if seen.size else (0.0, 1.0)
    unit = np.clip((chosen.astype(np.float32) - low) / max(float(high - low), 1.0), 0.0, 1.0)
    grey = (255.0 * unit**0.6).astype(np.uint8)
    picture = grey[0] if len(grey) == 1 else np.ascontiguousarray(np.moveaxis(grey, 0, -1))
    return jpeg_bytes(picture, quality=JPEG_QUALITY)

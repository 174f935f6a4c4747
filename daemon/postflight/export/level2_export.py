"""Pictures for other programs: Level-2 and Level-3 as rasters, and JPEGs with EXIF and XMP.

The geometry stays that of the image: nothing is rectified. A COG carries ground control points on
level ground, from trajectory and mount, so that it is roughly in place; its orientation is
in its tags.
"""

from __future__ import annotations

import math
import uuid
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission, exposure_name
from daemon.mission.store.level0 import read_description
from daemon.orientation.exterior_orientation import ExteriorOrientation
from daemon.orientation.georeference import Georeference
from daemon.postflight.export.exif import PictureMetadata, RigPlace, with_metadata
from daemon.postflight.export.picture_files import (
    SUFFIXES,
    jpeg_picture,
    left_out_of_jpeg,
    read_planes,
    write_raster,
)
from daemon.products.level3 import IMAGES as LEVEL3_IMAGES
from daemon.products.level3 import level3_root
from processing.geometry.orientation import BODY_FROM_CAMERA, ENU_FROM_NED, on_level_ground
from processing.geometry.rotation import omega_phi_kappa, roll_pitch_heading, rotation_matrix
from processing.radiometry.demosaic import demosaic
from processing.rig import Rig

Array = NDArray[np.float64]
KINDS = tuple(SUFFIXES)
ONE_INSTANT_NS = 1_000_000
"""From the first mid-exposure of a rig's heads to the last; at 3 degrees a second they turn by
0.05 mrad meanwhile."""
GRID = 5
"""Ground control points along each side of a COG."""

VISION_FROM_CAMERA = np.diag([1.0, -1.0, -1.0])
_RAW_REMARK = (
    "raw frame with the distortion of its lens; oriented by trajectory and mount; altitude above "
    "the ellipsoid of WGS 84"
)
_REMARK = (
    "perspective image, not rectified; oriented by trajectory and mount; altitude above the "
    "ellipsoid of WGS 84"
)


class PictureError(DaemonError):
    """Nothing to export; the message states what is missing."""


@dataclass(frozen=True)
class Level2Image:
    """One raster of Level-2 and its orientation.

    `product` is the folder of a stitched product, whose images are cameras of no rig; it is empty
    for a head's own image. Pixels of a raw frame are behind `colour_filter_array`, and its
    principal point (column, row) is `principal_point_px`.
    """

    path: Path
    name: str
    eo: ExteriorOrientation
    f_mm: float
    pixel_mm: float
    exposure_time_s: float | None
    bands: tuple[str, ...] = ()
    size_px: tuple[int, int] = (0, 0)
    is_perspective: bool = True
    product: str = ""
    colour_filter_array: str = "none"
    principal_point_px: tuple[float, float] | None = None


def pictures_of(
    mission: Mission,
    rig: Rig,
    exposure: Exposure,
    oriented: Sequence[ExteriorOrientation],
    level: int,
    depth: int,
) -> Iterator[Level2Image]:
    """Rasters of an exposure that are there and oriented.

    Args:
        mission: of the exposure.
        rig: of the mission.
        exposure: whose rasters.
        oriented: orientations of its cones.
        level: 2, or 3 for pansharpened RGB and CIR.
        depth: 16 or 8 bits of Level-3.

    Raises:
        RasterError: a description cannot be read.
    """
    folder = mission.level2(exposure.number)
    if level == 3:
        folder = level3_root(mission) / exposure_name(exposure.number)
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
            ratio = float(image.colour_ratio)
            files = [("pan.tif", 1.0), ("rgbn.tif", ratio)]
            if level == 3:
                files = [(f"{name}-{depth}.tif", 1.0) for name in LEVEL3_IMAGES]
            for file, scale in files:
                if (folder / file).exists():
                    product = file.removesuffix(".tif")
                    pitch_mm = image.pitch_mm * scale
                    found = _image(
                        folder / file, f"{eo.name}_{product}", eo, image.f_mm, pitch_mm, seconds
                    )
                    yield replace(found, product=product)
        elif level == 2 and (folder / f"{eo.cone}.tif").exists():
            path, pitch_mm = folder / f"{eo.cone}.tif", cone.sensors[0].pitch_mm
            yield _image(path, eo.name, eo, cone.lens.f_mm, pitch_mm, seconds)


def _image(
    path: Path,
    name: str,
    eo: ExteriorOrientation,
    f_mm: float,
    pixel_mm: float,
    seconds: float | None,
) -> Level2Image:
    """With its bands as the file names them, and its size."""
    from tifffile import TiffFile

    with TiffFile(path) as tiff:
        page = tiff.pages[0]
        size = (int(page.imagewidth), int(page.imagelength))
    bands = tuple(str(band) for band in read_description(path).get("bands", ("pan",)))
    return Level2Image(path, name, eo, f_mm, pixel_mm, seconds, bands, size)


def jpeg_with_metadata(picture: Level2Image, shot: PictureMetadata) -> bytes:
    """A JPEG of 8 bits with EXIF and XMP; its remark names the bands that are left out."""
    if missing := left_out_of_jpeg(picture.bands):
        remark = f"{shot.remark}; without {', '.join(missing)}: a JPEG holds three bands"
        shown = len(picture.bands) - len(missing)
        shot = replace(
            shot,
            remark=remark,
            bands=shot.bands[:shown],
            wavelengths_nm=shot.wavelengths_nm[:shown],
        )
    planes = read_planes(picture.path)
    if picture.colour_filter_array != "none":
        colours = np.zeros((3, *planes.shape[1:]), np.uint16)
        demosaic(planes[0], picture.colour_filter_array, out=colours)
        planes = colours
    return with_metadata(jpeg_picture(planes, picture.bands), shot)


def metadata_of(
    rig: Rig,
    picture: Level2Image,
    crs: str,
    *,
    simulated: bool,
    mission_id: str = "",
    roll_pitch_yaw_sigma_deg: tuple[float, float, float] | None = None,
) -> PictureMetadata:
    """Metadata of a picture from its orientation and the rig file."""
    eo = picture.eo
    body = ENU_FROM_NED.T @ eo.enu_from_camera @ BODY_FROM_CAMERA.T
    roll, pitch, yaw = (math.degrees(angle) for angle in roll_pitch_heading(body))
    east, north, height = (float(v) for v in eo.centre_m)
    shown = [cone for cone in rig.cones if set(cone.bands) & set(picture.bands)]
    if not eo.is_virtual and any(cone.name == eo.cone for cone in rig.cones):
        shown = [rig.cone(eo.cone)]
    lenses = {cone.lens.serial for cone in shown}
    f_numbers = {cone.lens.f_number for cone in shown}
    return PictureMetadata(
        camera=rig.title or rig.name,
        serial=rig.serial,
        name=picture.name,
        gps_ns=eo.gps_ns,
        latitude_deg=eo.latitude_deg,
        longitude_deg=eo.longitude_deg,
        height_m=eo.height_m,
        position_sigma_m=eo.horizontal_sigma_m,
        f_mm=picture.f_mm,
        pixel_um=picture.pixel_mm * 1e3,
        exposure_time_s=picture.exposure_time_s,
        yaw_pitch_roll_deg=(yaw % 360.0, pitch, roll),
        omega_phi_kappa_deg=eo.omega_phi_kappa_deg,
        centre_m=(east, north, height),
        crs=crs,
        remark=("SIMULATED: " if simulated else "")
        + ("" if rig.is_calibrated else "UNCALIBRATED: ")
        + (_REMARK if picture.is_perspective else _RAW_REMARK),
        width_px=picture.size_px[0],
        height_px=picture.size_px[1],
        f_number=f_numbers.pop() if len(f_numbers) == 1 else None,
        height_sigma_m=eo.vertical_sigma_m,
        roll_pitch_yaw_sigma_deg=roll_pitch_yaw_sigma_deg,
        bands=picture.bands,
        wavelengths_nm=_wavelengths(rig, picture.bands),
        rig=_rig_place(rig, eo, mission_id),
        lens_serial=lenses.pop() if len(lenses) == 1 else "",
        is_perspective=picture.is_perspective,
        principal_point_px=picture.principal_point_px,
    )


def _wavelengths(rig: Rig, bands: Sequence[str]) -> tuple[float, ...]:
    """Of every band, or nothing where one is not known."""
    known = {
        band: wavelength
        for cone in rig.cones
        for band, wavelength in zip(cone.bands, cone.wavelengths_nm, strict=False)
    }
    return tuple(known[band] for band in bands) if all(band in known for band in bands) else ()


def _rig_place(rig: Rig, eo: ExteriorOrientation, mission_id: str) -> RigPlace | None:
    """Index and rotation of a head whose images are its own; None for stitched images, and where
    heads expose one after the other: they share a place and not an attitude."""
    names = [cone.name for cone in rig.cones]
    if eo.is_virtual or len(names) < 2 or eo.cone not in names:
        return None
    instants_ns = [cone.mark_to_mid_exposure_ns for cone in rig.cones]
    if max(instants_ns) - min(instants_ns) > ONE_INSTANT_NS:
        return None
    reference = rig.cone(rig.master_cone or rig.reference_cone)
    turn = rotation_matrix(*reference.rotation_rad).T @ rotation_matrix(
        *rig.cone(eo.cone).rotation_rad
    )
    return rig_place(
        rig.title or rig.name,
        names.index(eo.cone),
        names.index(reference.name),
        turn,
        f"{mission_id}/{eo.exposure}",
    )


def rig_place(
    name: str, index: int, reference: int, reference_from_camera: Array, capture: str
) -> RigPlace:
    """Place of a camera in a rig.

    Args:
        name: of the rig.
        index: of the camera; every camera has its own.
        reference: index of the reference camera.
        reference_from_camera: rotation (3, 3) in axes x right, y up, z back.
        capture: text that all cameras of one exposure have in common.
    """
    turn = VISION_FROM_CAMERA @ reference_from_camera @ VISION_FROM_CAMERA
    omega, phi, kappa = (math.degrees(angle) for angle in omega_phi_kappa(turn))
    identity = uuid.uuid5(uuid.NAMESPACE_URL, f"syntopic:{capture}")
    return RigPlace(name, index, reference, (omega, phi, kappa), str(identity))


def write_picture(
    kind: str,
    picture: Level2Image,
    shot: PictureMetadata,
    georeference: Georeference,
    ground_m: float,
    final: Path,
) -> None:
    """Write one raster with tags and ground control points.

    Args:
        kind: "cog", "tiff" or "jp2".
        picture: what is written.
        shot: its metadata.
        georeference: system of the ground control points.
        ground_m: height of the ground above the ellipsoid.
        final: the file.

    Raises:
        RasterError: the raster cannot be read.
        OSError: the disk refused.
    """
    planes = read_planes(picture.path)
    _, height, width = planes.shape
    points = _ground_control(picture, georeference, ground_m, width, height)
    write_raster(kind, final, planes, shot, control_points=points, crs=georeference.crs.to_wkt())


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

"""Inputs of an orthomosaic: images with their pose, the ground, and the grid.

Orientations are those of a triangulation, or those delivered with the mission. What an image looks
like on the ground is computed in `processing.image.orthoimage`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import daemon
from daemon.configuration.model import PlanSection
from daemon.mission.canonical_json import canonical_bytes, sha256_hex
from daemon.mission.exposure_batch import ExposureFailure, for_each_exposure
from daemon.mission.layout import Mission
from daemon.mission.store.level0 import check_tiff, read_description
from daemon.orientation.antimeridian import mean_longitude
from daemon.orientation.elevation import read_elevation
from daemon.orientation.exterior_orientation import mount_of
from daemon.orientation.georeference import Georeference
from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.batch.software_identity import code_sha256, software_identity
from daemon.postflight.importers.photographs import is_of_photographs
from daemon.postflight.orthomosaic.ground_check import GroundCheck, check_ground
from daemon.postflight.orthomosaic.ground_reach import (
    DEPRESSION_MIN_DEG,
    corner_slope,
    ground_reach_m,
)
from daemon.postflight.orthomosaic.photographs import (
    BANDS,
    adjusted_heads,
    check_photograph,
    source_of,
)
from daemon.postflight.orthomosaic.triangulated import (
    ObjectPoints,
    OrthomosaicError,
    adjusted_orientations,
    object_points,
    only_triangulation,
    refuse_other_mission,
)
from daemon.postflight.triangulation.triangulation import block_of
from processing.geometry.orientation import grid_from_enu
from processing.geometry.rotation import rotation_matrix
from processing.geometry.terrain_rays import HeightModel
from processing.image.orthoimage.ground_grid import GroundGrid, GroundSurface, ground_surface
from processing.image.orthoimage.ground_resampling import ImagePose
from processing.pipelines.perspective import perspective_of
from processing.rig import Cone, VirtualImage, load_rig

Array = NDArray[np.float64]

_CODE: Final = {daemon: ("postflight/orthomosaic",)}
"""What computes an orthomosaic, in addition to what computes Level-2."""
MARKS: Final = ("simulated", "uncalibrated")
SIDE_MAX_PX: Final = 400_000
"""A grid with a longer side is refused: the GSD is meant in metres."""


@dataclass(frozen=True)
class OrthoImage:
    """A stitched image with its pose in the local frame.

    `colour` are the bands of its colour raster; `marks` what its description marks it as, such as
    simulated or uncalibrated; `sources` are the files of its pixels; `head` is the one that took it
    where it is a photograph, None where it is stitched.
    """

    name: str
    exposure: int
    pose: ImagePose
    nadir_m: tuple[float, float]
    height_m: float
    colour: tuple[str, ...]
    marks: tuple[str, ...]
    sources: tuple[Path, ...]
    head: Cone | None = None


@dataclass(frozen=True)
class Ground:
    """Heights in the grid's system: a model, or a plane, and what is known of relief over it."""

    surface: HeightModel | float
    sha256: str
    relief_rms_m: float | None = None


@dataclass(frozen=True)
class OrthoBlock:
    """Everything that an orthomosaic is computed from.

    `orientation` is the sentence that states where orientations come from; `failures` are images
    that cannot be read or have no orientation, and are not in the block. `image` is of the first
    head of photographs. `ground_check` states whether the ground fits.
    """

    mission: Mission
    image: VirtualImage
    images: tuple[OrthoImage, ...]
    georeference: Georeference
    frame: LocalFrame
    ground: Ground
    grid: GroundGrid
    orientation: str
    failures: tuple[ExposureFailure, ...]
    ground_check: GroundCheck

    @property
    def is_of_photographs(self) -> bool:
        """Whether images are photographs, not stitched."""
        return any(image.head is not None for image in self.images)

    @property
    def marks(self) -> tuple[str, ...]:
        """Marks of any image; that the mission is simulated is one."""
        found = {mark for image in self.images for mark in image.marks}
        if self.mission.is_simulated:
            found.add("simulated")
        return tuple(mark for mark in MARKS if mark in found)

    def surface(self, grid: GroundGrid) -> GroundSurface:
        """Surface under a part of the grid, in the local frame."""

        def cartesian(points_m: Array) -> Array:
            return self.frame.from_geodetic(*self.georeference.geodetic(points_m).T)

        return ground_surface(grid, self.ground.surface, cartesian)

    def key(self) -> str:
        """Hash of all inputs and of the code; the pixels of Level-2 by size and time of their
        files."""
        files = [
            [image.name, file.name, status.st_size, str(status.st_mtime_ns)]
            for image in self.images
            for file in image.sources
            for status in [file.stat()]
        ]
        poses = [
            [
                i.name, i.pose.f_mm, i.pose.pixel_mm, *i.pose.principal,
                *i.pose.centre_m.tolist(), *i.pose.rotation.ravel(),
            ]
            for i in self.images
        ]  # fmt: skip
        grid = self.grid
        facts = {
            "format": 2,
            "software": software_identity() | {"orthomosaic": code_sha256(_CODE)},
            "colour": [self.image.colour_ratio, [i.colour for i in self.images]],
            "files": files,
            "poses": [[v if isinstance(v, str) else float(v).hex() for v in p] for p in poses],
            "crs": self.georeference.name,
            "ground": self.ground.sha256,
            "heads": sorted({repr(image.head) for image in self.images}),
            "grid": [grid.east_m, grid.north_m, grid.gsd_m, grid.width_px, grid.height_px],
        }
        return sha256_hex(canonical_bytes(facts))


def block_for_orthomosaic(
    mission: Mission,
    *,
    triangulation: Path | None = None,
    elevation: Path | None = None,
    plane_height_m: float | None = None,
    gsd_m: float | None = None,
    crs: str | None = None,
    trajectory_file: Path | None = None,
    mount_file: Path | None = None,
) -> OrthoBlock:
    """Collect the inputs of an orthomosaic.

    Args:
        triangulation: folder of `syntopic triangulate`; None: the mission's only one, else the
            delivered orientations. Photographs have none delivered.
        elevation: height model; None: that of the flight, else a plane.
        plane_height_m: height of a plane in the height system of the grid, in place of a model.
        gsd_m: of the grid; None: the mean of the images.

    Raises:
        OrthomosaicError: no usable images, no orientations, or a ground that does not fit.
    """
    folder = triangulation or only_triangulation(mission)
    image, heads = _geometry(mission, folder)
    if folder is not None:
        georeference, names, place, angles = adjusted_orientations(folder, crs)
        orientation = f"adjusted orientations of {folder.name}"
        geodetic = georeference.geodetic(place)
        failures = refuse_other_mission(mission, folder, names, geodetic)
        points = object_points(folder)
    else:
        block = block_of(mission, crs=crs, trajectory_file=trajectory_file, mount_file=mount_file)
        georeference, failures = Georeference(block.crs), block.failures
        names = [eo.name for eo in block.oriented]
        place = np.array([eo.centre_m for eo in block.oriented])
        angles = np.array([eo.omega_phi_kappa_deg for eo in block.oriented])
        orientation = (
            "delivered orientations: the mission has no triangulation. Run syntopic triangulate "
            "for adjusted ones"
        )
        geodetic, points = georeference.geodetic(place), None
    frame = LocalFrame(float(geodetic[:, 0].mean()), mean_longitude(geodetic[:, 1].tolist()))
    images, unread = _images(
        mission, image, heads, georeference, frame, names, place, geodetic, angles
    )
    offset_m = float(np.median(place[:, 2] - geodetic[:, 2]))
    _, plan = mount_of(mission)
    ground = _ground(plan, georeference, elevation, plane_height_m)
    is_given = elevation is not None or plane_height_m is not None
    missing = plan.elevation if ground is None and not is_given else None
    if ground is None and points is not None:
        ground = _plane_of_points(points, offset_m)
    if ground is None:
        ground = _plane(plan.ground_height_m + offset_m, None)
    grid = _grid(images, ground, gsd_m)
    check = check_ground(
        ground.surface, georeference, frame, [one.pose for one in images], points, missing
    )
    return OrthoBlock(
        mission, image, images, georeference, frame, ground, grid, orientation,
        (*failures, *unread), check,
    )  # fmt: skip


def _geometry(mission: Mission, folder: Path | None) -> tuple[VirtualImage, tuple[Cone, ...]]:
    """Size and interior orientation of the images, and the heads of photographs."""
    rig = load_rig(mission.rig_path)
    if rig.virtual_image is not None:
        return rig.virtual_image, ()
    if not is_of_photographs(rig):
        raise OrthomosaicError(
            f"rig {rig.name} stitches no PAN image; an orthomosaic is made of stitched images or "
            "of photographs (syntopic import photographs)"
        )
    if folder is None:
        raise OrthomosaicError(
            f"{mission.path}: photographs have no orientation; run syntopic triangulate first"
        )
    heads = adjusted_heads(folder)
    return perspective_of(heads[0]), heads


def _images(
    mission: Mission,
    image: VirtualImage,
    heads: tuple[Cone, ...],
    georeference: Georeference,
    frame: LocalFrame,
    names: Sequence[str],
    place: Array,
    geodetic: Array,
    angles_deg: Array,
) -> tuple[tuple[OrthoImage, ...], tuple[ExposureFailure, ...]]:
    # The image of a head has the head's name behind the number.
    of_head = {head.name: head for head in heads}
    at = {}
    for k, name in enumerate(names):
        number, _, suffix = name.partition("_")
        if number.isdecimal() and (suffix in of_head if heads else not suffix):
            at[int(number)] = (k, of_head.get(suffix))
    if not at:
        raise OrthomosaicError(
            "no orientation is that of a stitched image; an orthomosaic is made of stitched images"
        )
    centre = frame.from_geodetic(*geodetic.T)

    def oriented(number: int) -> OrthoImage:
        k, head = at[number]
        own = image if head is None else perspective_of(head)
        sources, bands, marks = (
            _stitched(mission, number, image)
            if head is None
            else _photograph(mission, number, head)
        )
        latitude, longitude, height = (float(v) for v in geodetic[k])
        azimuth = georeference.place(latitude, longitude, height).azimuth_of_north_rad
        enu = grid_from_enu(azimuth).T @ rotation_matrix(*np.radians(angles_deg[k]))
        rotation = frame.local_from_enu(latitude, longitude) @ enu
        pose = ImagePose(own.f_mm, own.pitch_mm, own.width_px, own.height_px, centre[k], rotation)
        if not math.isfinite(corner_slope(pose)):
            raise OrthomosaicError(
                f"a corner looks less than {DEPRESSION_MIN_DEG:.0f} degrees below the horizon; an "
                "orthomosaic is made of images that look down"
            )
        east, north, up = (float(v) for v in place[k])
        return OrthoImage(names[k], number, pose, (east, north), up, bands, marks, sources, head)

    read = for_each_exposure(sorted(at), oriented)
    if not read.results:
        causes = "; ".join(f"exposure {one.exposure}: {one.cause}" for one in read.failures)
        raise OrthomosaicError(f"{mission.path}: no stitched image can be read; {causes}")
    return tuple(read.results.values()), read.failures


Source = tuple[tuple[Path, ...], tuple[str, ...], tuple[str, ...]]
"""Files of an image, bands of its colour, and its marks."""


def _stitched(mission: Mission, number: int, image: VirtualImage) -> Source:
    pan = mission.level2(number) / "pan.tif"
    check_tiff(pan, width_px=image.width_px, height_px=image.height_px)
    described, bands = read_description(pan), _bands(mission, number)
    marks = tuple(mark for mark in MARKS if described.get(mark) is True)
    return (pan, *([pan.with_name("rgbn.tif")] if bands else [])), bands, marks


def _photograph(mission: Mission, number: int, head: Cone) -> Source:
    check_photograph(mission, number, head)
    return (source_of(mission, number),), BANDS, ("uncalibrated",)


def _bands(mission: Mission, number: int) -> tuple[str, ...]:
    path = mission.level2(number) / "rgbn.tif"
    if not path.exists():
        return ()
    bands = read_description(path).get("bands")
    return tuple(bands) if isinstance(bands, list) and len(bands) > 1 else ()


def _ground(
    plan: PlanSection,
    georeference: Georeference,
    elevation: Path | None,
    plane_height_m: float | None,
) -> Ground | None:
    """The ground as asked for, else the height model of the flight; None: neither is there."""
    if elevation is not None and plane_height_m is not None:
        raise OrthomosaicError("--elevation and --ground-height exclude each other; give one")
    if plane_height_m is not None:
        return _plane(plane_height_m, None)
    if elevation is None and plan.elevation is not None and plan.elevation.is_file():
        elevation = plan.elevation
    if elevation is None:
        return None
    model = read_elevation(elevation, georeference)
    return Ground(model, sha256_hex(elevation.read_bytes()))


def _plane(height_m: float, relief_rms_m: float | None) -> Ground:
    return Ground(height_m, f"plane {height_m!r}", relief_rms_m)


def _plane_of_points(points: ObjectPoints, offset_m: float) -> Ground:
    """A plane at the median height of the adjusted object points, and their RMS about it.

    Args:
        offset_m: heights of the grid's system less those above the ellipsoid.
    """
    height = points.geodetic[:, 2] + offset_m
    middle = float(np.median(height))
    spread = np.abs(height - middle)
    kept = spread <= np.percentile(spread, 99.0)
    return _plane(round(middle, 3), float(np.sqrt(np.mean(spread[kept] ** 2))))


def _grid(images: Sequence[OrthoImage], ground: Ground, gsd_m: float | None) -> GroundGrid:
    """Grid over what the images see, its corner at a multiple of the GSD."""
    model = ground.surface
    level = float(np.nanmean(model.height_m)) if isinstance(model, HeightModel) else model
    above = np.array([one.height_m - level for one in images])
    if not (above > 1.0).all():
        raise OrthomosaicError(
            f"the ground at {level:.1f} m is not below all cameras; is the height model in the "
            "height system of the orientations?"
        )
    pixel = np.array([one.pose.pixel_mm / one.pose.f_mm for one in images])
    gsd = gsd_m or float(f"{(above * pixel).mean():.4g}")
    reach = np.array([ground_reach_m(i.pose, i.nadir_m, i.height_m, model) for i in images])
    at = np.array([one.nadir_m for one in images])
    low, high = (at - reach[:, None]).min(axis=0), (at + reach[:, None]).max(axis=0)
    first = math.floor(low[0] / gsd)
    top = math.ceil(high[1] / gsd)
    width, height = math.ceil(high[0] / gsd) - first, top - math.floor(low[1] / gsd)
    if max(width, height) > SIDE_MAX_PX:
        raise OrthomosaicError(
            f"{width} x {height} ground pixels of {gsd:g} m; a side has {SIDE_MAX_PX} at most. "
            "Give a larger --gsd, in metres"
        )
    return GroundGrid((first + 0.5) * gsd, (top - 0.5) * gsd, gsd, width, height)


def described_ground(ground: Ground) -> dict[str, Any]:
    """The ground as JSON types."""
    if isinstance(ground.surface, HeightModel):
        return {"kind": "height model", "sha256": ground.sha256}
    return {"kind": "plane", "height_m": ground.surface, "relief_rms_m": ground.relief_rms_m}

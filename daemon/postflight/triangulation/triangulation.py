"""Aerial triangulation of a mission: matched, adjusted with direct georeferencing as start.

The result is an adjustment project like any other (docs/reference/formats.md), with all its tables,
and the orientations in the requested coordinate system. Matching is in
`processing.matching.block_matching`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.exposure import Exposure
from daemon.mission.exposure_batch import ExposureFailure, for_each_exposure
from daemon.mission.layout import Mission
from daemon.mission.store.level0 import check_tiff
from daemon.onboard.triangulation.findings import LOST, NOT_PROCESSED
from daemon.onboard.triangulation.measured_images import camera_temperature_c
from daemon.orientation.antimeridian import mean_longitude
from daemon.orientation.exterior_orientation import (
    ExteriorOrientation,
    MissingOrientation,
    sealed_exposures,
)
from daemon.orientation.local_frame import LocalFrame
from daemon.orientation.navigation_sigmas import NavigationSigmas
from daemon.orientation.orientation_inputs import read_orientation_inputs
from daemon.postflight.adjustment.project import CheckPoints, Project
from daemon.postflight.adjustment.project_file import ProjectFile
from daemon.postflight.triangulation.head_arrangement import HeadArrangement, arrangement_of
from daemon.postflight.triangulation.measured_points import MeasuredPoints, no_measured_points
from daemon.postflight.triangulation.stitching_of_exposures import stitching_patterns_of
from processing.bundle.flown_network import (
    MOUNTING,
    FlownExposures,
    GnssDrift,
    GnssLines,
    MeasuredOrientations,
    flown_exposures,
)
from processing.bundle.gauss_newton import Progress
from processing.bundle.network import (
    CameraModel,
    ImagePoints,
    Images,
    Network,
    Points,
)
from processing.bundle.residual_weights import (
    REJECT_BEYOND,
    TIE_SIGMA_PX,
    block_settings,
    weighted_by_residuals,
)
from processing.bundle.self_calibration import SetName, parts_of, with_self_calibration
from processing.matching.block_matching import BlockMatching, BlockTiePoints, image_mm
from processing.pipelines.perspective import perspective_of
from processing.rig import Rig, VirtualImage, load_rig

Array = NDArray[np.float64]


class TriangulationError(DaemonError, ValueError):
    """A mission that cannot be triangulated; the message states what is missing."""


@dataclass(frozen=True)
class TriangulationSettings:
    """Options of a triangulation.

    `parameters` is the set of additional parameters, `interior` whether it holds the interior
    orientation. `sigmas` are those of navigation and mounting. `drift`: what is unknown of the GNSS
    positions of each line. `patterns`: what stitching may have left in each image is an unknown of
    it.
    """

    parameters: SetName = "none"
    interior: bool = False
    sigmas: NavigationSigmas = field(default_factory=NavigationSigmas)
    drift: GnssDrift = "none"
    patterns: bool = True
    reject_beyond: float = REJECT_BEYOND
    matching: BlockMatching = field(default_factory=BlockMatching)


@dataclass(frozen=True)
class ImageBlock:
    """Images of one geometry, stitched or of heads, with a start orientation in a local frame.

    `failures` are exposures whose record or images cannot be read; they are not in the block.
    `skipped` are exposures without image, instant or orientation, with the reason. `temperature_c`
    (n,) is that of the camera, NaN if unknown.
    """

    mission: Mission
    rig: Rig
    image: VirtualImage
    oriented: tuple[ExteriorOrientation, ...]
    crs: str
    frame: LocalFrame
    station_m: Array
    rotation: Array
    ground_m: float
    failures: tuple[ExposureFailure, ...] = ()
    skipped: Mapping[int, str] = field(default_factory=dict)
    temperature_c: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(eo.name for eo in self.oriented)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras: the stitched one, or one for each head."""
        heads = dict.fromkeys(eo.cone for eo in self.oriented if not eo.is_virtual)
        return tuple(heads) or ("stitched",)

    @property
    def arrangement(self) -> HeadArrangement:
        """Exposures, and the heads of the images."""
        return arrangement_of(self.rig, self.oriented, self.station_m, self.rotation)

    @property
    def lines(self) -> tuple[str, ...]:
        return tuple(eo.line_id for eo in self.oriented)

    @property
    def gsd_m(self) -> float:
        """Mean size of a pixel on the ground."""
        height = float(self.station_m[:, 2].mean()) - self.ground_m
        return height * self.image.pitch_mm / self.image.f_mm


def block_of(
    mission: Mission,
    *,
    crs: str | None = None,
    trajectory_file: Path | None = None,
    mount_file: Path | None = None,
    heads: Sequence[str] = (),
) -> ImageBlock:
    """Orient the exposures that have a stitched PAN image, or the images of heads.

    Args:
        heads: cones whose own images make the block, with the same pixels and principal distance;
            none: the stitched images.

    Raises:
        TriangulationError: a rig without such images, or fewer than two of them.
        TrajectoryError, GeoreferenceError: as their modules say.
    """
    rig = load_rig(mission.rig_path)
    image = _common_image(rig, heads)
    files = [f"{name}.tif" for name in heads or ("pan",)]
    read = sealed_exposures(mission)
    skipped: dict[int, str] = {}
    candidates = {}
    for number, exposure in read.results.items():
        reason = _why_not(mission, number, exposure, files)
        if reason:
            skipped[number] = reason
        else:
            candidates[number] = exposure

    def with_usable_images(number: int) -> Exposure:
        for file in files:
            check_tiff(
                mission.level2(number) / file, width_px=image.width_px, height_px=image.height_px
            )
        return candidates[number]

    usable = for_each_exposure(candidates, with_usable_images)
    exposures = list(usable.results.values())
    failures = (*read.failures, *usable.failures)
    if len(exposures) < 2:
        raise TriangulationError(
            f"{mission.path}: {len(exposures)} sealed exposures with {', '.join(files)} and a "
            "time; a block takes two or more. Run `syntopic process` first"
            + "".join(f"; exposure {one.exposure}: {one.cause}" for one in failures)
        )
    inputs = read_orientation_inputs(
        mission, exposures, crs=crs, trajectory_file=trajectory_file, mount_file=mount_file
    )
    oriented = []
    for exposure in exposures:
        for eo in inputs.of(exposure):
            if isinstance(eo, MissingOrientation):
                skipped[eo.exposure] = eo.reason
            elif eo.cone in heads if heads else eo.is_virtual:
                oriented.append(eo)
    skipped = {k: v for k, v in skipped.items() if k not in {eo.exposure for eo in oriented}}
    if len(oriented) < 2:
        raise TriangulationError(
            f"{mission.path}: {len(oriented)} exposures have an attitude; direct georeferencing is "
            "the start of a block: give --trajectory with one that has it"
        )
    latitude = np.array([eo.latitude_deg for eo in oriented])
    longitude = np.array([eo.longitude_deg for eo in oriented])
    frame = LocalFrame(float(latitude.mean()), mean_longitude(longitude.tolist()))
    station = frame.from_geodetic(latitude, longitude, np.array([eo.height_m for eo in oriented]))
    rotation = np.array(
        [
            frame.local_from_enu(eo.latitude_deg, eo.longitude_deg) @ eo.enu_from_camera
            for eo in oriented
        ]
    )
    return ImageBlock(
        mission, rig, image, tuple(oriented), inputs.crs, frame, station, rotation,
        inputs.ground_height_m, failures, skipped,
        np.array([camera_temperature_c(usable.results[eo.exposure]) for eo in oriented]),
    )  # fmt: skip


def _why_not(mission: Mission, number: int, exposure: Exposure, files: Sequence[str]) -> str:
    """Why an exposure takes no part; empty if it does."""
    if exposure.state == "lost" or not exposure.frames:
        return LOST
    if exposure.mark_gps_ns is None:
        return "no instant"
    if not all((mission.level2(number) / file).exists() for file in files):
        return NOT_PROCESSED
    return ""


def _common_image(rig: Rig, heads: Sequence[str]) -> VirtualImage:
    """The geometry of all images of a block."""
    if not heads:
        if rig.virtual_image is None:
            raise TriangulationError(
                f"rig {rig.name} stitches no PAN image; name heads whose own images make a block: "
                f"--head, of {', '.join(cone.name for cone in rig.cones)}"
            )
        return rig.virtual_image
    known = {} if rig.virtual_image else {c.name: perspective_of(c) for c in rig.cones}
    images = {known.get(name) for name in heads}
    image = images.pop()
    if image is None or images:
        raise TriangulationError(
            f"--head {', '.join(heads)}: a block is made of images of heads with the same pixels "
            f"and principal distance; {rig.name} has "
            f"{', '.join(known) or 'stitched images, no heads'}"
        )
    return image


def project_of(
    block: ImageBlock,
    tied: BlockTiePoints,
    options: TriangulationSettings,
    *,
    surveyed: MeasuredPoints | None = None,
) -> Project:
    """Everything as an adjustment project in the local frame.

    Raises:
        TriangulationError: no tie points, or a set that the rig cannot have.
    """
    if not len(tied.image):
        raise TriangulationError(
            "no tie points were found: do the images overlap, and is the orientation right to a "
            "few pixels? Try --search with more pixels"
        )
    surveyed = surveyed or no_measured_points()
    pitch = block.image.pitch_mm
    ties = tied.points
    names = (*(f"t{k}" for k in range(ties)), *surveyed.names)
    xyz = np.full((len(names), 3), np.nan)
    sigma = np.full((len(names), 3), np.nan)
    control = np.array([role == "control" for role in surveyed.roles], dtype=bool)
    xyz[ties:][control] = surveyed.xyz_m[control]
    sigma[ties:][control] = surveyed.sigma_m[control]
    image = np.concatenate([tied.image, surveyed.image])
    point = np.concatenate([tied.point, surveyed.point + ties])
    px = np.concatenate([tied.px, surveyed.px])
    spread = np.concatenate([np.full(len(tied.image), TIE_SIGMA_PX), surveyed.sigma_px]) * pitch
    arrangement = block.arrangement
    file = _file(block, arrangement, options)
    try:
        cameras = tuple(
            with_self_calibration(
                CameraModel(name, block.image.f_mm, pixel_mm=pitch),
                options.parameters,
                parts_of(block.rig) if options.parameters.startswith("sensors") else (),
                master_cone=block.rig.master_cone,
                interior=options.interior,
            )
            for name in block.cameras
        )
    except ValueError as error:
        raise TriangulationError(str(error)) from error
    flown = _flown(block, arrangement, options)
    exposure, head = arrangement.exposure, arrangement.head
    network = Network(
        cameras=cameras,
        stations=flown.stations,
        attitudes=flown.attitudes,
        images=Images(block.names, exposure, exposure, head, head),
        points=Points(names, xyz, sigma, np.zeros(len(names), bool)),
        image_points=ImagePoints(
            image, point, image_mm(block.image, px), np.stack([spread, spread], axis=1)
        ),
        heads=flown.heads,
        gnss=flown.gnss,
        measured_attitudes=flown.measured_attitudes,
        patterns=stitching_patterns_of(block.mission, block.oriented) if options.patterns else (),
    )
    settings = replace(block_settings(options.reject_beyond), variance_components=True)
    checks = CheckPoints(
        tuple(name for name, c in zip(surveyed.names, control, strict=True) if not c),
        surveyed.xyz_m[~control],
        surveyed.sigma_m[~control],
    )
    return Project(file.name, file, network, settings, checks)


def _flown(
    block: ImageBlock, arrangement: HeadArrangement, options: TriangulationSettings
) -> FlownExposures:
    """Observations and unknowns of navigation, as in flight."""
    names = tuple(dict.fromkeys(block.lines))
    own = [block.oriented[k] for k in arrangement.first]
    lines = GnssLines(
        tuple(line or "line" for line in names),
        np.array([names.index(eo.line_id) for eo in own], dtype=np.int64),
        np.array([eo.gps_ns - own[0].gps_ns for eo in own]) * 1e-9,
        options.drift,
    )
    sigmas = options.sigmas
    measured = MeasuredOrientations(
        arrangement.position_m,
        arrangement.rotation,
        np.array([sigmas.of_position(eo) for eo in own]),
        np.tile(sigmas.about_camera_rad, (len(own), 1)),
    )
    return flown_exposures(
        arrangement.names, measured, sigmas.prior, lines=lines, heads=arrangement.heads
    )


def weight_by_residuals(project: Project, ties: int, progress: Progress | None = None) -> Project:
    """The project with the sigma of matched coordinates as matching shows it.

    Raises:
        NetworkError, RankDefectError: as `processing.bundle.adjust.adjust`.
    """
    network = weighted_by_residuals(
        project.network, project.settings, project.network.image_points.point < ties, progress
    )
    return replace(
        project, network=network, settings=replace(project.settings, variance_components=False)
    )


def _file(
    block: ImageBlock, arrangement: HeadArrangement, options: TriangulationSettings
) -> ProjectFile:
    camera: dict[str, Any] = {
        "f_mm": block.image.f_mm,
        "pixel_um": block.image.pitch_um,
        "width_px": block.image.width_px,
        "height_px": block.image.height_px,
        "parameters": options.parameters,
        "interior": options.interior,
    }
    if options.parameters.startswith("sensors"):
        camera["rig"] = "rig.toml"
    return ProjectFile.model_validate(
        {
            "format": 1,
            "name": f"{block.mission.id}, {options.parameters}",
            "adjust": {
                "robust": True,
                "reject_beyond": options.reject_beyond,
                "gnss": options.drift,
                "image_sigma_um": TIE_SIGMA_PX * block.image.pitch_um,
            },
            "camera": [{"name": name} | camera for name in block.cameras],
            "head": [
                {
                    "name": name,
                    "rotation": "free",
                    "offset": "free",
                    "rotation_sigma_deg": options.sigmas.boresight_mdeg * 1e-3,
                    "offset_sigma_m": options.sigmas.lever_arm_m,
                }
                for name in [place.name for place in arrangement.heads] or [MOUNTING]
            ],
        }
    )

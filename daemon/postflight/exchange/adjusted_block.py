"""The block of an adjustment project: adjusted cameras, orientations and points, and measurements.

The project is adjusted as `syntopic adjust` does. What no other program has (rays that are bent,
motion within an exposure, patterns of stitching) is refused, not left out.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.adjustment.adjusted_project import used_network
from daemon.postflight.adjustment.contradictions import SUSPICIOUS_SIGMA0
from daemon.postflight.adjustment.project import Project, read_project
from daemon.postflight.adjustment.project_file import CameraSection
from daemon.postflight.exchange.block import (
    Block,
    BlockCamera,
    BlockError,
    BlockImage,
    BlockPoints,
)
from daemon.postflight.exchange.block_check import check_block
from daemon.postflight.exchange.coordinate_unit import frame_next_to
from processing.bundle.adjust import Adjustment
from processing.bundle.camera_model import ideal_mm, perspective_mm, principal_distance_mm
from processing.bundle.camera_orientations import camera_orientations
from processing.bundle.network import CameraModel, Network, NetworkError
from processing.bundle.rank_diagnosis import RankDefectError
from processing.bundle.staged_adjustment import adjust_in_stages
from processing.geometry.forward_distortion import ForwardDistortion

Array = NDArray[np.float64]

FREE_SCALE = (
    "the project is a free network without frame.json: its scale and axes are those of its "
    "starting values, also where files state metres"
)
_GRID = 25
"""Pairs of rays and pixels along each side of a camera."""
_GROWN_FROM_PX = 1e-3
"""A corner that a correction moves out by less does not make the format larger."""


def block_of_project(path: Path, *, without_distortion: bool = False) -> tuple[Block, float]:
    """Adjust a project, and take its result as a block.

    Args:
        path: project.toml, or its folder.
        without_distortion: measurements are corrected, and cameras are pinholes whose formats grow
            on all sides as far as corrected images need it; notes state by how much.

    Returns:
        The block, without measurements that the adjustment left out, and sigma0.

    Raises:
        ProjectError: the project cannot be read.
        BlockError: it cannot be adjusted, contradicts itself, or has what no block has.
    """
    file = path / "project.toml" if path.is_dir() else path
    project = read_project(file)
    _refuse_what_no_block_has(file, project)
    try:
        result = adjust_in_stages(project.network, project.settings)
    except (NetworkError, RankDefectError) as error:
        raise BlockError(f"{file}: {error}; `syntopic adjust` names the causes") from error
    if result.problems or result.sigma0 > SUSPICIOUS_SIGMA0:
        raise BlockError(
            f"{file}: its adjustment has sigma0 {result.sigma0:.3g}, its observations contradict "
            "each other; `syntopic adjust` names the likely mistakes"
        )
    block = _block(file, project, result)
    if without_distortion:
        block = _corrected(block, used_network(result), result)
    check_block(file, block)
    return block, result.sigma0


def _refuse_what_no_block_has(file: Path, project: Project) -> None:
    network = project.network
    found = [
        what
        for what, there in (
            ("earth curvature or refraction", not network.rays.is_straight),
            ("motion of exposures", network.motion is not None),
            ("patterns of stitching", any(one is not None for one in network.patterns)),
            ("points at infinity", bool(network.points.at_infinity.any())),
        )
        if there
    ]
    if found:
        raise BlockError(
            f"{file}: has {', '.join(found)}, which files of other programs have not; export a "
            "project without"
        )
    for section in project.file.camera:
        if section.pixel_um is None or section.width_px is None or section.height_px is None:
            raise BlockError(
                f"{file}: camera {section.name} states no pixel size or format; add pixel_um, "
                "width_px and height_px"
            )


def _block(file: Path, project: Project, result: Adjustment) -> Block:
    network = used_network(result)
    cameras = tuple(
        _camera(section, camera, result.state.interior[k], result.state.terms[k])
        for k, (section, camera) in enumerate(
            zip(project.file.camera, network.cameras, strict=True)
        )
    )
    posed = camera_orientations(result)
    images = tuple(
        BlockImage(
            name,
            int(network.images.camera[k]),
            int(network.images.station[k]) + 1,
            posed.station_m[k],
            posed.rotation[k],
        )
        for k, name in enumerate(network.images.names)
    )
    frame = frame_next_to(file)
    return Block(
        project.name or file.parent.name,
        cameras,
        images,
        frame,
        points=_points(network, cameras, result.state.points),
        notes=(FREE_SCALE,) if project.file.adjust.minimum_norm and frame is None else (),
        is_metric=True,
    )


def _camera(
    section: CameraSection, camera: CameraModel, interior: Array, terms: Array
) -> BlockCamera:
    """The camera by pairs of pixels and rays, to which another program's model is fitted."""
    width, height = section.width_px or 0, section.height_px or 0
    pitch = (section.pixel_um or 0.0) * 1e-3
    columns, rows = np.meshgrid(
        np.linspace(-0.5, width - 0.5, _GRID), np.linspace(-0.5, height - 0.5, _GRID)
    )
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    middle = np.array([(width - 1) / 2.0, (height - 1) / 2.0])
    rays = _rays(camera, interior, terms, (pixels - middle) * [pitch, -pitch])
    f_mm, x_mm, y_mm = perspective_mm(camera, interior)
    f_px = f_mm / pitch
    cx_px, cy_px = (width - 1) / 2.0 + x_mm / pitch, (height - 1) / 2.0 - y_mm / pitch
    model = ForwardDistortion(f_px, f_px, cx_px, cy_px)
    return BlockCamera(
        section.name, width, height, model, pitch, ("pan",), rays=rays, pixels=pixels
    )


def _rays(camera: CameraModel, interior: Array, terms: Array, xy_mm: Array) -> Array:
    """x / z and y / z, y down, of measured coordinates, (n, 2)."""
    try:
        ideal = ideal_mm(camera, interior, terms, xy_mm)
    except NetworkError as error:
        raise BlockError(f"camera {camera.name}: {error}") from error
    return np.asarray(ideal / principal_distance_mm(camera, interior) * [1.0, -1.0])


def _corrected(block: Block, network: Network, result: Adjustment) -> Block:
    """The block of images without distortion."""
    points = block.points
    px = points.px.copy()
    of = np.array([image.camera for image in block.images], np.int64)[points.image]
    cameras, notes = [], []
    for k, (camera, own) in enumerate(zip(block.cameras, network.cameras, strict=True)):
        size, pitch = np.array([camera.width_px, camera.height_px]), camera.pitch_mm or 1.0
        model, middle = camera.model, (size - 1) / 2.0
        xy_mm = (px[of == k] - middle) * [pitch, -pitch]
        rays = _rays(own, result.state.interior[k], result.state.terms[k], xy_mm)
        centre = np.array([model.cx_px, model.cy_px])
        edge = centre + model.fx_px * (camera.rays if camera.rays is not None else rays)
        beyond = np.maximum(-0.5 - edge.min(axis=0), edge.max(axis=0) - (size - 0.5))
        grown = np.ceil(np.maximum(beyond - _GROWN_FROM_PX, 0.0)).astype(int)
        px[of == k] = centre + model.fx_px * rays + grown
        width, height = (size + 2 * grown).tolist()
        cx_px, cy_px = (centre + grown).tolist()
        cameras.append(
            replace(
                camera,
                width_px=width,
                height_px=height,
                model=ForwardDistortion(model.fx_px, model.fx_px, cx_px, cy_px),
                rays=None,
                pixels=None,
            )
        )
        largest_px = float(np.abs(edge - (edge if camera.pixels is None else camera.pixels)).max())
        notes.append(
            f"camera {camera.name}: measurements are corrected for distortion, by "
            f"{largest_px:.3f} px at most; format without distortion {width} x {height} px"
        )
    return replace(
        block, cameras=tuple(cameras), points=replace(points, px=px), notes=(*block.notes, *notes)
    )


def _points(network: Network, cameras: tuple[BlockCamera, ...], xyz_m: Array) -> BlockPoints:
    """Points with two measurements or more, and these in pixels."""
    table = network.image_points
    rays = np.bincount(table.point, minlength=len(network.points.names))
    kept = np.flatnonzero((rays >= 2) & np.isfinite(xyz_m).all(axis=1))
    number = np.full(len(network.points.names), -1)
    number[kept] = np.arange(len(kept))
    own = number[table.point] >= 0
    image = table.image[own]
    of = network.images.camera[image]
    pitch = np.array([camera.pitch_mm or 1.0 for camera in cameras])[of]
    size = np.array([(camera.width_px, camera.height_px) for camera in cameras], float)[of]
    px = (size - 1.0) / 2.0 + table.xy_mm[own] * [1.0, -1.0] / pitch[:, None]
    return BlockPoints(
        xyz_m[kept],
        tuple(network.points.names[k] for k in kept),
        image,
        number[table.point[own]],
        px,
    )

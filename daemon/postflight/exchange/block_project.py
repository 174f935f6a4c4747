"""An adjustment project of an imported block: cameras, orientations, object and image points.

Distortion of the other program is converted to the ten parameters by fit. Where it does not fit,
Brown's model is kept as it is (`opencv`); of other models the measurements are corrected, and the
camera has no distortion. Without standard deviations of positions the project is a free network.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.orientation.local_frame import FRAME_FILE
from daemon.postflight.adjustment.project import CheckPoints
from daemon.postflight.adjustment.project_file import AdjustSection, CameraSection, ProjectFile
from daemon.postflight.adjustment.project_writer import write_project
from daemon.postflight.exchange.block import FIT_LIMIT_PX, Block, BlockCamera, BlockError
from daemon.postflight.exchange.block_check import (
    check_block,
    distance_notes,
    project_name,
    upward_notes,
)
from daemon.postflight.exchange.bundler import read_bal, read_bundler
from daemon.postflight.exchange.colmap import read_colmap
from daemon.postflight.exchange.completeness import completeness_notes
from daemon.postflight.exchange.inpho_reader import read_inpho
from daemon.postflight.exchange.metashape_reader import read_metashape
from daemon.postflight.exchange.opensfm import read_opensfm
from daemon.postflight.exchange.photogrammetry_reader import read_bingo, read_patb
from daemon.postflight.exchange.pix4d_reader import read_pix4d
from daemon.postflight.exchange.position_scale import scale_by_photographs, scale_notes
from daemon.postflight.exchange.reprojections import refuse_other_convention
from processing.bundle.network import (
    INTERIOR,
    Attitudes,
    CameraModel,
    Gnss,
    ImagePoints,
    Images,
    Model,
    Network,
    Points,
    Stations,
    no_gnss,
)
from processing.geometry.forward_distortion import ForwardDistortion, rays_from_measured_px
from processing.geometry.lens import lens_correction
from processing.rig import Lens

Array = NDArray[np.float64]

READERS: Mapping[str, Callable[[Path], Block]] = {
    "colmap": read_colmap,
    "opensfm": read_opensfm,
    "metashape": read_metashape,
    "bundler": read_bundler,
    "bal": read_bal,
    "bingo": read_bingo,
    "patb": read_patb,
    "pix4d": read_pix4d,
    "inpho": read_inpho,
}
NOMINAL_PITCH_MM = 1e-3
"""Of cameras whose file states no pixel size: a residual in um is one in px."""
NO_POINTS = (
    "the file has no image measurements: the project holds cameras and orientations alone, and "
    "`syntopic adjust` needs points.csv and image_points.csv"
)
_TERMS = ("k1", "k2", "k3", "p1", "p2", "b1", "b2")
_GRID = 25


@dataclass(frozen=True)
class ImportedBlock:
    """The block as read, and the largest residual of each camera's fit, px."""

    block: Block
    residuals_px: Mapping[str, float]


def import_block(
    path: Path,
    program: str,
    out: Path,
    *,
    sigma_px: float = 0.5,
    position_sigma_m: tuple[float, float, float] | None = None,
    is_metric: bool = False,
    photographs: Path | None = None,
) -> ImportedBlock:
    """Write an adjustment project of another program's files.

    Args:
        path: file or folder of the program.
        program: key of `READERS`.
        out: folder of the project; it must be new.
        sigma_px: standard deviation of image coordinates.
        position_sigma_m: of the projection centres as observations, x, y, z; None: free network.
        is_metric: coordinates are in metres, although the files do not state it.
        photographs: folder of the images, whose positions in EXIF show the unit of coordinates.

    Raises:
        BlockError: files that cannot be read, numbers that no camera, image or point has, a
            distortion that cannot be converted, measurements of another convention, or standard
            deviations in metres for positions that are not known to be in metres.
        ProjectError: `out` holds a project.
    """
    block = READERS[program](path)
    check_block(path, block)
    block = replace(block, notes=(*completeness_notes(path, program, block), *block.notes))
    if position_sigma_m is not None and not (block.is_metric or is_metric):
        raise BlockError(
            f"{path}: its positions are not known to be in metres ({'; '.join(block.notes)}), so "
            "that --position-sigma in metres does not hold; leave it out, georeference the block "
            "in the other program, or state with --metric that its coordinates are in metres"
        )
    notes = _unit_notes(path, block, photographs, is_metric=is_metric)
    notes += refuse_other_convention(path, block, sigma_px)
    block = replace(
        block, notes=(*block.notes, *notes, *upward_notes(block), *distance_notes(block))
    )
    pitches = [camera.pitch_mm or NOMINAL_PITCH_MM for camera in block.cameras]
    fits = [_lens_of(c, pitch) for c, pitch in zip(block.cameras, pitches, strict=True)]
    block, fits, models, corrected = _carried(block, pitches, fits)
    lenses = [lens for lens, _ in fits]
    network = _network(block, pitches, lenses, models, sigma_px, position_sigma_m)
    file = ProjectFile(
        format=1,
        name=f"{block.name}, imported from {program}",
        adjust=AdjustSection(robust=True, minimum_norm=position_sigma_m is None),
        camera=tuple(
            _section(camera, pitch, lens, model, has_format=number not in corrected)
            for number, (camera, pitch, lens, model) in enumerate(
                zip(block.cameras, pitches, lenses, models, strict=True)
            )
        ),
    )
    none = CheckPoints((), np.zeros((0, 3)), np.zeros((0, 3)))
    write_project(out, file, network, none)
    if block.frame is not None:
        stated = {
            "latitude_deg": block.frame.latitude_deg,
            "longitude_deg": block.frame.longitude_deg,
        }
        (out / FRAME_FILE).write_text(json.dumps(stated) + "\n", encoding="utf-8")
    if not len(block.points.image):
        block = replace(block, notes=(*block.notes, NO_POINTS))
    residuals = {c.name: worst for c, (_, worst) in zip(block.cameras, fits, strict=True)}
    return ImportedBlock(block, residuals)


def _unit_notes(
    path: Path, block: Block, photographs: Path | None, *, is_metric: bool
) -> tuple[str, ...]:
    """What positions of photographs show about the unit of coordinates.

    Raises:
        BlockError: it is not the stated one, or no photograph is of the block.
    """
    if photographs is None:
        return ()
    scale = scale_by_photographs(photographs, block)
    if scale is None:
        return (
            f"positions in EXIF of {photographs} do not show the unit of coordinates: fewer than "
            "three, or too near to each other",
        )
    return scale_notes(path, scale, is_metric=block.is_metric or is_metric)


def _lens_of(camera: BlockCamera, pitch_mm: float) -> tuple[Lens, float]:
    """The lens that corrects what the model distorts, about its principal point, and its residual.

    The residual is infinite where the model has no inverse in parts of the image.
    """
    model = camera.model
    lens = Lens(f_mm=model.fy_px * pitch_mm)
    if model.is_pinhole and model.fx_px == model.fy_px:
        return lens, 0.0
    columns, rows = np.meshgrid(
        np.linspace(-0.5, camera.width_px - 0.5, _GRID),
        np.linspace(-0.5, camera.height_px - 0.5, _GRID),
    )
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    rays = rays_from_measured_px(model, pixels)
    if not np.isfinite(rays).all():
        return lens, math.inf
    up = np.array([pitch_mm, -pitch_mm])
    measured = (pixels - [model.cx_px, model.cy_px]) * up
    delta = rays * [lens.f_mm, -lens.f_mm] - measured
    design = np.stack(
        [lens_correction(_with(lens, {name: 1.0}), measured).ravel() for name in _TERMS], axis=1
    )
    size = np.linalg.norm(design, axis=0)
    solution, *_ = np.linalg.lstsq(design / size, delta.ravel(), rcond=None)
    values = dict(zip(_TERMS, (float(v) for v in solution / size), strict=True))
    lens = _with(lens, values)
    return lens, float(np.abs(lens_correction(lens, measured) - delta).max()) / pitch_mm


def _carried(
    block: Block, pitches: list[float], fits: list[tuple[Lens, float]]
) -> tuple[Block, list[tuple[Lens, float]], list[Model], set[int]]:
    """The block, lenses and models, where the ten parameters do not fit a distortion.

    Brown's model is kept: its coefficients go into the lens without a unit. For others the
    measurements are corrected; the last are these cameras, of which the format does not hold.

    Raises:
        BlockError: a measurement that no ray has in the other program's model.
    """
    px = block.points.px.copy()
    of = np.array([image.camera for image in block.images], dtype=np.int64)[block.points.image]
    notes = list(block.notes)
    found = list(fits)
    models: list[Model] = ["australis"] * len(fits)
    corrected: set[int] = set()
    for number, (camera, pitch, (_, worst_px)) in enumerate(
        zip(block.cameras, pitches, fits, strict=True)
    ):
        if worst_px <= FIT_LIMIT_PX:
            continue
        model, own = camera.model, of == number
        rays = rays_from_measured_px(model, px[own])
        if not np.isfinite(rays).all():
            lost = int(np.isnan(rays).any(axis=1).sum())
            raise BlockError(
                f"camera {camera.name}: its distortion has no inverse at {lost} of {len(rays)} "
                "measurements; adjust it in the other program with fewer parameters"
            )
        finding = (
            f"fits the ten parameters within {worst_px:.3f} px only, {FIT_LIMIT_PX:g} px is the "
            "limit"
            if math.isfinite(worst_px)
            else "has no inverse in the corners"
        )
        if not any((model.skew_px, model.k4, model.k5, model.k6, model.radial_r8)):
            models[number] = "opencv"
            found[number] = _brown(model, pitch), 0.0
            notes.append(
                f"camera {camera.name}: its distortion {finding}. The camera keeps its own model, "
                "opencv"
            )
            continue
        px[own] = [model.cx_px, model.cy_px] + model.fy_px * rays
        found[number] = Lens(f_mm=model.fy_px * pitch), 0.0
        corrected.add(number)
        notes.append(
            f"camera {camera.name}: its distortion {finding}. The measurements are corrected for "
            "it, and the camera of the project has none"
        )
    block = replace(block, points=replace(block.points, px=px), notes=tuple(notes))
    return block, found, models, corrected


def _brown(model: ForwardDistortion, pitch_mm: float) -> Lens:
    """Coefficients of the project's model `opencv`; b1 is what fx differs from fy by."""
    return Lens(
        f_mm=model.fy_px * pitch_mm,
        k1=model.k1,
        k2=model.k2,
        k3=model.k3,
        p1=model.p1,
        p2=model.p2,
        b1=model.fy_px / model.fx_px - 1.0,
    )


def _with(lens: Lens, values: Mapping[str, float]) -> Lens:
    changed: dict[str, Any] = dict(values)
    return replace(lens, **changed)


def _principal_point_mm(camera: BlockCamera, pitch_mm: float) -> tuple[float, float]:
    model = camera.model
    return (
        (model.cx_px - (camera.width_px - 1) / 2.0) * pitch_mm,
        ((camera.height_px - 1) / 2.0 - model.cy_px) * pitch_mm,
    )


def _section(
    camera: BlockCamera, pitch_mm: float, lens: Lens, model: Model, *, has_format: bool
) -> CameraSection:
    xp_mm, yp_mm = _principal_point_mm(camera, pitch_mm)
    return CameraSection(
        name=camera.name,
        f_mm=lens.f_mm,
        xp_mm=xp_mm,
        yp_mm=yp_mm,
        model=model,
        pixel_um=pitch_mm * 1e3,
        width_px=camera.width_px if has_format else None,
        height_px=camera.height_px if has_format else None,
    )


def _network(
    block: Block,
    pitches: list[float],
    lenses: list[Lens],
    models: list[Model],
    sigma_px: float,
    position_sigma_m: tuple[float, float, float] | None,
) -> Network:
    names = tuple(project_name(image.name) for image in block.images)
    n, points = len(names), block.points
    cameras = []
    for camera, pitch, lens, model in zip(block.cameras, pitches, lenses, models, strict=True):
        xp_mm, yp_mm = _principal_point_mm(camera, pitch)
        interior = np.array([getattr(lens, _FIELDS.get(key, key)) for key in INTERIOR])
        cameras.append(
            CameraModel(
                camera.name, lens.f_mm, xp_mm, yp_mm, model, interior=interior, pixel_mm=pitch
            )
        )
    place = np.array([image.centre_m for image in block.images])
    of = np.array([image.camera for image in block.images], dtype=np.int64)
    seen = np.bincount(points.point, minlength=len(points.xyz_m))
    kept = np.flatnonzero(seen >= 2)
    renumbered = np.full(len(points.xyz_m), -1)
    renumbered[kept] = np.arange(len(kept))
    used = renumbered[points.point] >= 0
    image = points.image[used]
    pitch_of = np.array(pitches)[of[image]] if len(image) else np.zeros(0)
    half = np.array([((c.width_px - 1) / 2.0, (c.height_px - 1) / 2.0) for c in block.cameras])
    about = (points.px[used] - half[of[image]]) * np.array([1.0, -1.0]) if len(image) else points.px
    every = np.arange(n)
    gnss = no_gnss()
    if position_sigma_m is not None:
        gnss = Gnss(
            every, every, place, np.tile(position_sigma_m, (n, 1)), np.zeros((n, 3)),
            np.full(n, -1), np.zeros(n),
        )  # fmt: skip
    return Network(
        cameras=tuple(cameras),
        stations=Stations(names, place, np.zeros(n, bool)),
        attitudes=Attitudes(
            names, np.array([one.rotation for one in block.images]), np.zeros(n, bool)
        ),
        images=Images(names, every, every, of, np.full(n, -1)),
        points=Points(
            tuple(points.names[k] for k in kept),
            points.xyz_m[kept],
            np.full((len(kept), 3), np.nan),
            np.zeros(len(kept), bool),
        ),
        image_points=ImagePoints(
            image,
            renumbered[points.point[used]],
            about * pitch_of[:, None],
            np.repeat(sigma_px * pitch_of[:, None], 2, axis=1),
        ),
        gnss=gnss,
    )


_FIELDS = {"dx0": "dx0_mm", "dy0": "dy0_mm", "df": "df_mm"}

"""The adjustment of a block of photographs: network, report section, adjusted rig.

Principal distance and distortion are estimated with the orientations. The principal point is held,
except where control points determine it.
Positions of EXIF are observations; their standard deviations are estimated as variance components,
and with control their common shift, such as that between heights above the ellipsoid and the geoid.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.adjustment.project import CheckPoints, Project
from daemon.postflight.adjustment.project_file import AdjustSection, CameraSection, ProjectFile
from daemon.postflight.triangulation.control_mistakes import shift_to_control, unmeasured
from daemon.postflight.triangulation.ground_control import GroundControl, no_control
from daemon.postflight.triangulation.held_interior import (
    FreePrincipalPoint,
    with_principal_point,
)
from daemon.postflight.triangulation.photograph_block import (
    AREA,
    PhotographBlock,
    provisional_camera,
)
from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.camera_model import perspective_mm
from processing.bundle.initial_values import completed
from processing.bundle.network import (
    INTERIOR,
    Attitudes,
    CameraModel,
    Gnss,
    ImagePoints,
    Images,
    Network,
    NetworkError,
    Points,
    Stations,
)
from processing.bundle.normal_equations import reduced_equations
from processing.bundle.rank_diagnosis import RankDefectError
from processing.bundle.residual_weights import REJECT_BEYOND
from processing.rig import Rig

Array = NDArray[np.float64]

TIE_SIGMA_PX: Final = 0.7
ITERATIONS_MAX: Final = 300
"""Blocks of few lines without control come to rest slowly."""
_CONTROL_OF_PRINCIPAL_POINT: Final = 3
EXIF_LINE: Final = "EXIF"
"""The positions of EXIF as one line, whose common shift against the control is unknown."""
OWN_INTERIOR_MIN: Final = 5
"""Cameras of fewer photographs keep a priori standard deviations of the interior orientation."""
_LENS_FIELDS: Final = {"dx0": "dx0_mm", "dy0": "dy0_mm", "df": "df_mm"}


def photograph_project(
    found: PhotographBlock,
    control: GroundControl,
    *,
    position_sigma_m: tuple[float, float, float],
    reject_beyond: float,
    tie_sigma_px: tuple[float, float] = (TIE_SIGMA_PX, TIE_SIGMA_PX),
) -> Project:
    """Everything as an adjustment project in the local frame.

    Args:
        found: oriented photographs.
        control: control and check points.
        position_sigma_m: of the positions of EXIF, east, north, up.
        reject_beyond: rejection limit in sigmas.
        tie_sigma_px: of matched columns and rows.
    """
    shift_m = shift_to_control(found, control)
    has_shift = _places_block(control)
    block, tied = found.block, found.tied
    n = len(block.names)
    is_control = np.array([role == "control" for role in control.roles], dtype=bool)
    names = (*(f"t{k}" for k in range(tied.points)), *control.names)
    xyz = np.concatenate([found.xyz_m + shift_m, np.full((len(control.names), 3), np.nan)])
    sigma = np.full((len(names), 3), np.nan)
    xyz[tied.points :][is_control] = control.xyz_m[is_control]
    sigma[tied.points :][is_control] = control.sigma_m[is_control]
    px = np.concatenate([tied.px, control.px])
    image = np.concatenate([tied.image, control.image])
    spread = np.concatenate(
        [np.tile(tie_sigma_px, (len(tied.image), 1)), np.tile(control.sigma_px, (2, 1)).T]
    )
    spread *= np.array([size.pitch_mm for size in found.sizes])[found.camera_of[image], None]
    cameras = _cameras(found)
    if _determines_principal_point(control):
        cameras = with_principal_point(
            cameras, [max(size.width_px, size.height_px) for size in found.sizes]
        )
    every = np.arange(n)
    placed = np.flatnonzero(np.isfinite(found.position_m[:, 0]))
    network = Network(
        cameras=cameras,
        stations=Stations(block.names, block.station_m + shift_m, np.zeros(n, bool)),
        attitudes=Attitudes(block.names, block.rotation, np.zeros(n, bool)),
        images=Images(block.names, every, every, found.camera_of, np.full(n, -1)),
        points=Points(names, xyz, sigma, np.zeros(len(names), bool)),
        image_points=ImagePoints(
            image,
            np.concatenate([tied.point, control.point + tied.points]),
            found.image_mm(image, px),
            spread,
        ),
        gnss=Gnss(
            station=placed,
            attitude=placed,
            position_m=found.position_m[placed],
            sigma_m=np.tile(position_sigma_m, (len(placed), 1)),
            lever_m=np.zeros((len(placed), 3)),
            line=np.zeros(len(placed), np.int64) if has_shift else np.full(len(placed), -1),
            time_s=np.zeros(len(placed)),
            lines=(EXIF_LINE,) if has_shift else (),
            drift="shift" if has_shift else "none",
        ),
    )
    settings = AdjustmentSettings(
        robust=True,
        reject_beyond=reject_beyond,
        variance_components=True,
        max_iterations=ITERATIONS_MAX,
    )
    file = ProjectFile(
        format=1,
        name=f"{block.mission.id}, photographs",
        adjust=AdjustSection(
            robust=True,
            reject_beyond=reject_beyond,
            variance_components=True,
            gnss="shift" if has_shift else "none",
            image_sigma_um=TIE_SIGMA_PX * block.image.pitch_um,
        ),
        camera=tuple(
            CameraSection(
                name=camera.name,
                f_mm=size.f_mm,
                pixel_um=size.pitch_um,
                width_px=size.width_px,
                height_px=size.height_px,
                free=tuple(name for name in INTERIOR if name in camera.free),
                sigma=dict(camera.sigma),
            )
            for camera, size in zip(cameras, found.sizes, strict=True)
        ),
    )
    checks = CheckPoints(
        tuple(name for name, c in zip(control.names, is_control, strict=True) if not c),
        control.xyz_m[~is_control],
        control.sigma_m[~is_control],
    )
    return Project(file.name, file, network, settings, checks)


def adjusted_photographs(
    found: PhotographBlock,
    control: GroundControl,
    *,
    position_sigma_m: tuple[float, float, float],
    reject_beyond: float,
    progress: Callable[[str, int, float], None] | None = None,
) -> tuple[Project, Adjustment, tuple[str, ...]]:
    """Adjust, with fewer unknowns where the photographs determine no more.

    Args:
        found: oriented photographs.
        control: control and check points.
        position_sigma_m: of the positions of EXIF, east, north, up.
        reject_beyond: rejection limit in sigmas.
        progress: see `adjust`.

    Returns:
        Project, adjustment, and a sentence where less was estimated.

    Raises:
        NetworkError: no adjustment converges.
        RankDefectError: directions without information.
    """
    project = photograph_project(
        found,
        control,
        position_sigma_m=position_sigma_m,
        reject_beyond=reject_beyond,
        tie_sigma_px=residual_sigma_px(found, position_sigma_m, progress),
    )
    trials = (
        (project, ""),
        (
            _with_fixed_accuracies(project),
            "these photographs determine no accuracies: those of image points and positions are "
            "not estimated, and standard deviations rest on those given, times sigma0",
        ),
        (
            _with_held_interior(_with_fixed_accuracies(project)),
            "these photographs determine no interior orientation: that of the start (EXIF, and "
            "what the photographs add) is held, and standard deviations do not contain its errors",
        ),
    )
    for trial, sentence in trials:
        try:
            result = adjust(completed(trial.network), trial.settings, progress=progress)
        except (NetworkError, RankDefectError):
            if trial is trials[-1][0]:
                raise
            continue
        return trial, result, (sentence,) if sentence else ()
    raise AssertionError("the last trial returns or raises")


def residual_sigma_px(
    found: PhotographBlock,
    position_sigma_m: tuple[float, float, float],
    progress: Callable[[str, int, float], None] | None = None,
) -> tuple[float, float]:
    """Standard deviations of matched columns and rows, px, as their residuals show them.

    The block is adjusted without control: measurements of control keep their own standard
    deviation, and would otherwise be scaled with matched points that are many times better.
    Positions of EXIF would be rejected where matched points are better than they are stated: a
    sigma0 below 1 makes their residuals large.

    Args:
        found: oriented photographs.
        position_sigma_m: of the positions of EXIF, east, north, up.
        progress: see `adjust`.

    Returns:
        Columns and rows; `TIE_SIGMA_PX` where the photographs do not determine them.
    """
    alone = photograph_project(
        found, no_control(), position_sigma_m=position_sigma_m, reject_beyond=REJECT_BEYOND
    )
    settings = replace(alone.settings, reject_beyond=None)
    try:
        result = adjust(completed(alone.network), settings, progress=progress)
    except (NetworkError, RankDefectError):
        return TIE_SIGMA_PX, TIE_SIGMA_PX
    x, y = (float(np.sqrt(result.factors.get(name, 1.0))) for name in ("image x", "image y"))
    return TIE_SIGMA_PX * x, TIE_SIGMA_PX * y


def _with_fixed_accuracies(project: Project) -> Project:
    adjust_section = project.file.adjust.model_copy(update={"variance_components": False})
    return replace(
        project,
        file=project.file.model_copy(update={"adjust": adjust_section}),
        settings=replace(project.settings, variance_components=False),
    )


def _with_held_interior(project: Project) -> Project:
    cameras = tuple(
        replace(camera, free=frozenset(), sigma={}) for camera in project.network.cameras
    )
    sections = tuple(
        section.model_copy(
            update={"free": (), "sigma": {}}
            | dict(zip(INTERIOR, (float(v) for v in camera.interior), strict=True))
        )
        for section, camera in zip(project.file.camera, cameras, strict=True)
    )
    return replace(
        project,
        file=project.file.model_copy(update={"camera": sections}),
        network=replace(project.network, cameras=cameras),
    )


def _cameras(found: PhotographBlock) -> tuple[CameraModel, ...]:
    """Cameras of many photographs without a priori values, those of few with them."""
    count = np.bincount(found.camera_of, minlength=len(found.cameras))
    rig = found.block.rig
    return tuple(
        replace(camera, sigma={})
        if own >= OWN_INTERIOR_MIN or len(count) == 1
        else provisional_camera(rig.cone(camera.name))
        for camera, own in zip(found.cameras, count, strict=True)
    )


def adjusted_rig(rig: Rig, result: Adjustment) -> Rig:
    """The rig with the adjusted interior orientations; it stays uncalibrated."""
    values: dict[str, dict[str, Any]] = {
        camera.name: {
            _LENS_FIELDS.get(name, name): float(value)
            for name, value in zip(INTERIOR, interior, strict=True)
        }
        for camera, interior in zip(result.network.cameras, result.state.interior, strict=True)
    }
    cones = [replace(c, lens=replace(c.lens, **values.get(c.name, {}))) for c in rig.cones]
    return replace(rig, cones=tuple(cones))


def photographs_section(
    found: PhotographBlock,
    control: GroundControl,
    result: Adjustment,
    free: Sequence[FreePrincipalPoint] | None = None,
) -> dict[str, Any]:
    """The section `photographs` of the report; lengths in px and m as named.

    Args:
        found: oriented photographs.
        control: control and check points.
        result: of the adjustment.
        free: the same with estimated principal points; None where they cannot be estimated.

    Keys from `f_exif_px` to `f_hardly_separated_from_point` are those of the first camera;
    `cameras` has them of each.
    """
    block = found.block
    cameras = [
        _camera_section(found, result, k, None if free is None else free[k])
        for k in range(len(found.cameras))
    ]
    height_m = float(result.state.station[:, 2].mean() - np.nanmedian(result.state.points[:, 2]))
    gnss = result.network.gnss
    away = result.state.station[gnss.station] - gnss.position_m
    if len(gnss.lines):
        away = away + result.state.shift[0]
    controls = _measured_control(result)
    correlation, ground_sigma_m = f_and_ground_height(result)
    return {
        "files": dict(found.files),
        "oriented": len(block.names),
        "left_out": list(found.left_out),
        "wrong_positions": list(found.wrong_positions),
        "unused_control": list(control.unused),
        "height_source": found.height_source,
        **cameras[0],
        "cameras": cameras,
        "height_above_ground_m": height_m,
        "height_per_percent_m": 0.01 * height_m,
        "position_shift_m": [float(v) for v in result.state.shift[0]] if len(gnss.lines) else None,
        "position_rms_m": [float(v) for v in np.sqrt(np.mean(away**2, axis=0))],
        "roll_sigma_deg": roll_sigma_deg(gnss.position_m, float(np.sqrt(np.mean(away[:, 2] ** 2)))),
        "positions_on_a_line": are_on_a_line(gnss.position_m),
        "position_extent_m": float(np.linalg.norm(np.ptp(gnss.position_m, axis=0))),
        "scale_sigma_percent": 100.0 * scale_sigma(gnss.position_m, away),
        "off_nadir_deg": float(
            np.degrees(np.median(np.arccos(np.clip(result.state.attitude[:, 2, 2], -1.0, 1.0))))
        ),
        "control_points": controls,
        "control_not_measured": unmeasured(control),
        "control_rejected": [
            name
            for name, axes in zip(result.network.points.names, result.excluded.control, strict=True)
            if axes.any()
        ],
        "control_measurements_rejected": _rejected_measurements(result),
        "f_ground_correlation": correlation,
        "ground_sigma_of_f_m": ground_sigma_m,
        "f_and_height_separated": 0.0 < ground_sigma_m <= height_m / cameras[0]["f_px"],
    }


def _camera_section(
    found: PhotographBlock, result: Adjustment, camera: int, free: FreePrincipalPoint | None
) -> dict[str, Any]:
    """Principal distance of a camera, px, and what its held principal point does to it."""
    size = found.sizes[camera]
    model, interior = found.cameras[camera], result.state.interior[camera]
    f_mm = perspective_mm(model, interior)[0]
    sigma_px = _interior_sigmas(result, camera).get("df", 0.0) / size.pitch_mm
    sigma_px *= (f_mm / model.f_mm) ** 2
    return {
        "camera": found.cameras[camera].name,
        "photographs": int((found.camera_of == camera).sum()),
        "f_exif_px": size.f_mm / size.pitch_mm,
        "f_px": f_mm / size.pitch_mm,
        "f_sigma_px": sigma_px,
        "principal_point_free": None if free is None else vars(free),
        "principal_point_estimated": int(result.layout.interior[camera][0]) >= 0,
        "f_depends_on_principal_point": free is not None and free.contradicts(sigma_px),
        "f_hardly_separated_from_point": free is not None and free.widens(sigma_px),
    }


def roll_sigma_deg(position_m: Array, height_rms_m: float) -> float:
    """How well heights of positions fix the roll of a block about its main direction.

    Args:
        position_m: shape (n, 3).
        height_rms_m: of their heights against the block; at least 1 m is taken.

    Returns:
        Standard deviation, degrees; 90 where they fix nothing.

    Example:
        >>> line = np.array([[0.0, 0.0, 0.0], [50.0, 10.0, 0.0], [100.0, 0.0, 0.0]])
        >>> round(roll_sigma_deg(line, 2.0), 1)
        13.8
    """
    across = np.linalg.svd(position_m[:, :2] - position_m[:, :2].mean(axis=0), compute_uv=False)
    return float(np.degrees(np.arctan2(max(height_rms_m, 1.0), across[1])))


def are_on_a_line(position_m: Array) -> bool:
    """Whether positions (n, 3) spread over a line rather than an area."""
    along, across = np.linalg.svd(position_m[:, :2] - position_m[:, :2].mean(axis=0))[1]
    return bool(across <= AREA * along)


def scale_sigma(position_m: Array, residual_m: Array) -> float:
    """How well positions fix the scale of a block without control.

    Args:
        position_m: shape (n, 3).
        residual_m: of the block against them, shape (n, 3).

    Returns:
        Relative standard deviation.

    Example:
        >>> square = np.array([[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]], float)
        >>> round(scale_sigma(square, np.full((4, 3), 2.0)), 3)
        0.219
    """
    spread_m = float(np.linalg.norm(position_m - position_m.mean(axis=0)))
    # A similarity of seven parameters is in the residuals.
    redundancy = max(residual_m.size - 7, 1)
    return float(np.sqrt(np.sum(residual_m**2) / redundancy)) / max(spread_m, 1e-9)


def f_and_ground_height(result: Adjustment) -> tuple[float, float]:
    """How far principal distances decide the mean height of the object points.

    Args:
        result: adjusted photographs, df of each camera among the unknowns.

    Returns:
        Correlation of f with the mean height (of several the multiple correlation), and the
        standard deviation of that height that comes from f alone, m.
    """
    own = [int(columns[INTERIOR.index("df")]) for columns in result.layout.interior]
    if min(own) < 0:
        return 0.0, 0.0
    of_f = result.cofactor[np.ix_(own, own)]
    reduced = reduced_equations(result.equations, result.layout)
    points = len(result.layout.eliminated_points)
    mean = np.zeros((points, 3))
    mean[:] = reduced.point_factor[:, 2, :] / points
    by_column = np.zeros(result.layout.columns)
    by_column[reduced.sparse_columns] = -(reduced.coupling_sparse.T @ mean.ravel())
    by_column[reduced.dense_columns] = -(reduced.coupling_dense.T @ mean.ravel())
    both = -(by_column @ result.cofactor[:, own])
    of_height = float(by_column @ result.cofactor @ by_column + (mean**2).sum())
    explained = float(np.sqrt(both @ np.linalg.solve(of_f, both)))
    sign = float(np.sign(both[0])) if len(own) == 1 else 1.0
    return sign * explained / float(np.sqrt(of_height)), result.sigma0 * explained


def _places_block(control: GroundControl) -> bool:
    """Whether control fixes a shift: a point in two photographs, or three points."""
    is_control = np.array([role == "control" for role in control.roles], dtype=bool)
    views = np.bincount(control.point, minlength=len(control.names))[is_control]
    return bool((views >= 2).any() or (views >= 1).sum() >= 3)


def _determines_principal_point(control: GroundControl) -> bool:
    """Whether three control points are each measured in two photographs."""
    is_control = np.array([role == "control" for role in control.roles], dtype=bool)
    views = np.bincount(control.point, minlength=len(control.names))[is_control]
    return bool((views >= 2).sum() >= _CONTROL_OF_PRINCIPAL_POINT)


def _measured_control(result: Adjustment) -> int:
    """Control points with an image measurement that was used."""
    table = result.network.image_points
    seen = np.bincount(table.point[result.weight > 0.0], minlength=len(result.network.points.names))
    is_control = np.isfinite(result.network.points.sigma_m).any(axis=1)
    return int((is_control & (seen > 0)).sum())


def _rejected_measurements(result: Adjustment) -> list[dict[str, Any]]:
    """Control points of which half of the image measurements or more are rejected."""
    table, names = result.network.image_points, result.network.points.names
    measured = np.bincount(table.point, minlength=len(names))
    rejected = np.bincount(table.point[result.excluded.image], minlength=len(names))
    is_control = np.isfinite(result.network.points.sigma_m).any(axis=1)
    return [
        {"point": names[k], "rejected": int(rejected[k]), "measured": int(measured[k])}
        for k in np.flatnonzero(is_control & (rejected > 0) & (2 * rejected >= measured))
    ]


def _interior_sigmas(result: Adjustment, camera: int) -> dict[str, float]:
    """Standard deviations of an estimated interior orientation, internal units."""
    columns = result.layout.interior[camera]
    variance = np.clip(np.diag(result.cofactor), 0.0, None)
    return {
        name: result.sigma0 * float(np.sqrt(variance[column]))
        for name, column in zip(INTERIOR, columns, strict=True)
        if column >= 0
    }

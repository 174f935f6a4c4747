"""The adjustment of a block of photographs: network, report section, adjusted rig.

All parameters of the interior orientation are estimated with the orientations. Positions of EXIF
are observations; their standard deviations are estimated as variance components.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.adjustment.project import CheckPoints, Project
from daemon.postflight.adjustment.project_file import AdjustSection, CameraSection, ProjectFile
from daemon.postflight.importers.photographs import CONE
from daemon.postflight.triangulation.ground_control import GroundControl
from daemon.postflight.triangulation.photograph_block import FREE, PhotographBlock
from processing.bundle.adjust import Adjustment, AdjustmentSettings
from processing.bundle.network import (
    INTERIOR,
    Attitudes,
    Gnss,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)
from processing.matching.block_matching import image_mm
from processing.rig import Rig

Array = NDArray[np.float64]

TIE_SIGMA_PX: Final = 0.7
CONTROL_MIN: Final = 3
_LENS_FIELDS: Final = {"dx0": "dx0_mm", "dy0": "dy0_mm", "df": "df_mm"}


def photograph_project(
    found: PhotographBlock,
    control: GroundControl,
    *,
    position_sigma_m: tuple[float, float, float],
    reject_beyond: float,
) -> Project:
    """Everything as an adjustment project in the local frame.

    Args:
        found: oriented photographs.
        control: control and check points.
        position_sigma_m: of the positions of EXIF, east, north, up.
        reject_beyond: rejection limit in sigmas.
    """
    block, tied = found.block, found.tied
    n, pitch = len(block.names), block.image.pitch_mm
    is_control = np.array([role == "control" for role in control.roles], dtype=bool)
    names = (*(f"t{k}" for k in range(tied.points)), *control.names)
    xyz = np.concatenate([found.xyz_m, np.full((len(control.names), 3), np.nan)])
    sigma = np.full((len(names), 3), np.nan)
    xyz[tied.points :][is_control] = control.xyz_m[is_control]
    sigma[tied.points :][is_control] = control.sigma_m[is_control]
    px = np.concatenate([tied.px, control.px])
    spread = np.concatenate([np.full(len(tied.image), TIE_SIGMA_PX), control.sigma_px]) * pitch
    every = np.arange(n)
    placed = np.flatnonzero(np.isfinite(found.position_m[:, 0]))
    network = Network(
        cameras=(replace(found.camera, sigma={}),),
        stations=Stations(block.names, block.station_m, np.zeros(n, bool)),
        attitudes=Attitudes(block.names, block.rotation, np.zeros(n, bool)),
        images=Images(block.names, every, every, np.zeros(n, np.int64), np.full(n, -1)),
        points=Points(names, xyz, sigma, np.zeros(len(names), bool)),
        image_points=ImagePoints(
            np.concatenate([tied.image, control.image]),
            np.concatenate([tied.point, control.point + tied.points]),
            image_mm(block.image, px),
            np.stack([spread, spread], axis=1),
        ),
        gnss=Gnss(
            station=placed,
            attitude=placed,
            position_m=found.position_m[placed],
            sigma_m=np.tile(position_sigma_m, (len(placed), 1)),
            lever_m=np.zeros((len(placed), 3)),
            line=np.full(len(placed), -1),
            time_s=np.zeros(len(placed)),
        ),
    )
    settings = AdjustmentSettings(
        robust=True, reject_beyond=reject_beyond, variance_components=True
    )
    file = ProjectFile(
        format=1,
        name=f"{block.mission.id}, photographs",
        adjust=AdjustSection(
            robust=True,
            reject_beyond=reject_beyond,
            variance_components=True,
            image_sigma_um=TIE_SIGMA_PX * block.image.pitch_um,
        ),
        camera=(
            CameraSection(
                name=CONE,
                f_mm=block.image.f_mm,
                pixel_um=block.image.pitch_um,
                width_px=block.image.width_px,
                height_px=block.image.height_px,
                free=FREE,
            ),
        ),
    )
    checks = CheckPoints(
        tuple(name for name, c in zip(control.names, is_control, strict=True) if not c),
        control.xyz_m[~is_control],
        control.sigma_m[~is_control],
    )
    return Project(file.name, file, network, settings, checks)


def adjusted_rig(rig: Rig, result: Adjustment) -> Rig:
    """The rig with the adjusted interior orientation; it stays uncalibrated."""
    values: dict[str, Any] = {
        _LENS_FIELDS.get(name, name): float(value)
        for name, value in zip(INTERIOR, result.state.interior[0], strict=True)
    }
    cone = rig.cone(CONE)
    return replace(rig, cones=(replace(cone, lens=replace(cone.lens, **values)),))


def photographs_section(
    found: PhotographBlock, control: GroundControl, result: Adjustment
) -> dict[str, Any]:
    """The section `photographs` of the report; lengths in px and m as named."""
    block = found.block
    pitch = block.image.pitch_mm
    interior = dict(zip(INTERIOR, (float(v) for v in result.state.interior[0]), strict=True))
    sigma = _interior_sigmas(result)
    f_mm = block.image.f_mm - interior["df"]
    height_m = float(result.state.station[:, 2].mean() - np.nanmedian(result.state.points[:, 2]))
    gnss = result.network.gnss
    away = result.state.station[gnss.station] - gnss.position_m
    controls = int(np.isfinite(result.network.points.sigma_m).any(axis=1).sum())
    return {
        "files": dict(found.files),
        "oriented": len(block.names),
        "left_out": list(found.left_out),
        "unused_control": list(control.unused),
        "f_exif_px": block.image.f_mm / pitch,
        "f_px": f_mm / pitch,
        "f_sigma_px": sigma["df"] / pitch,
        "height_above_ground_m": height_m,
        "height_per_percent_m": 0.01 * height_m,
        "position_rms_m": [float(v) for v in np.sqrt(np.mean(away**2, axis=0))],
        "control_points": controls,
        "f_and_height_separated": controls >= CONTROL_MIN,
    }


def photograph_cautions(section: Mapping[str, Any]) -> list[str]:
    """What a reader has to know about the result, one sentence each."""
    found = list(section["left_out"])
    if not section["f_and_height_separated"]:
        found.append(
            f"f and height are not separated without control: a change of f by 1 % "
            f"({0.01 * section['f_px']:.0f} px) moves the ground by "
            f"{section['height_per_percent_m']:.2f} m. Give three control points or more "
            "(--points)"
        )
    drift = abs(section["f_px"] / section["f_exif_px"] - 1.0)
    if drift > 0.05:
        found.append(
            f"f was adjusted by {100 * drift:.0f} % against EXIF ({section['f_exif_px']:.0f} px to "
            f"{section['f_px']:.0f} px)"
        )
    return found


def _interior_sigmas(result: Adjustment) -> dict[str, float]:
    """Standard deviations of the estimated interior orientation, internal units."""
    columns = result.layout.interior[0]
    variance = np.clip(np.diag(result.cofactor), 0.0, None)
    return {
        name: result.sigma0 * float(np.sqrt(variance[column]))
        for name, column in zip(INTERIOR, columns, strict=True)
        if column >= 0
    }

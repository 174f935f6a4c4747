"""Cameras of an adjustment project: a section of project.toml becomes a camera model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from daemon.mission.foreign_files import within
from daemon.postflight.adjustment.project_file import CameraSection
from processing.bundle.network import INTERIOR, CameraModel
from processing.bundle.self_calibration import parts_of, with_self_calibration
from processing.rig import RigError, find_rig, shipped_rigs


def camera_of(section: CameraSection, folder: Path, problems: list[str]) -> CameraModel:
    """Camera model of a section.

    Args:
        section: of project.toml.
        folder: of project.toml, for the path of a rig.
        problems: sentences are added for what cannot be used.
    """
    camera = CameraModel(
        section.name,
        section.f_mm,
        section.xp_mm,
        section.yp_mm,
        section.model,
        np.array([getattr(section, name) for name in INTERIOR]),
        frozenset(section.free),
        dict(section.sigma),
        pixel_mm=None if section.pixel_um is None else section.pixel_um * 1e-3,
    )
    try:
        rig = None
        if section.rig is not None:
            shipped = section.rig in shipped_rigs()
            named = section.rig if shipped else str(within(folder, section.rig, "camera.rig"))
            rig = find_rig(named)
        camera = with_self_calibration(
            camera,
            section.parameters,
            () if rig is None else parts_of(rig),
            master_cone="" if rig is None else rig.master_cone,
            interior=section.interior,
            base_mm=section.base_mm,
        )
    except RigError as error:
        problems += list(error.problems)
    except ValueError as error:
        problems.append(str(error))
    return _with_selected_parameters(camera, section, problems)


def _with_selected_parameters(
    camera: CameraModel, section: CameraSection, problems: list[str]
) -> CameraModel:
    """Without the parameters that were dropped, and with the values of terms that are known."""
    names = {t.name for t in camera.terms}
    foreign = [n for n in section.without if n not in names and n not in camera.free]
    foreign += [n for n in section.terms if n not in names]
    if foreign:
        problems.append(f"camera {camera.name}: {foreign} are not parameters of its set")
    terms = tuple(
        replace(t, value=section.terms.get(t.name, t.value))
        for t in camera.terms
        if t.name not in section.without
    )
    left = {t.name for t in terms}
    gauges = tuple(g for g in camera.gauges if set(g) <= left)
    return replace(
        camera, free=camera.free - frozenset(section.without), terms=terms, gauges=gauges
    )

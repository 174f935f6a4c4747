"""Rotations between heads refined by the frames of a mission, before an image is proposed."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import numpy as np

from daemon import DaemonError
from daemon.mission.layout import Mission
from daemon.mission.store.level0 import RasterError, read_tiff
from processing.geometry.rotation import omega_phi_kappa, rotation_matrix, vectors_from_rotations
from processing.matching.board_corners import grey_picture
from processing.matching.head_ties import MIN_TIES, HeadRotation, rotation_between
from processing.rig import Cone, Rig

INSTANTS: Final = 4


class HeadRefinementError(DaemonError, ValueError):
    """A mission whose frames do not connect the heads; the message states what is missing."""


def refined_rotations(rig: Rig, mission: Path) -> tuple[Rig, dict[str, Any]]:
    """Refine the rotations of all heads against the master, or the first.

    Args:
        rig: heads of one sensor.
        mission: its Level-0 frames are used, a few exposures spread over it.

    Returns:
        The rig, and by head: turned_deg, ties, rms_px.

    Raises:
        HeadRefinementError: too few tie points.
    """
    folder = Mission.open(mission)
    numbers = folder.numbers()
    chosen = [numbers[k * len(numbers) // INSTANTS] for k in range(INSTANTS)] if numbers else []
    pictures = {
        cone.name: [_picture(folder, number, cone) for number in dict.fromkeys(chosen)]
        for cone in rig.cones
    }
    reference = rig.cone(rig.master_cone) if rig.master_cone else rig.cones[0]
    rotations = {reference.name: rotation_matrix(*reference.rotation_rad)}
    found: dict[str, Any] = {}
    between: dict[tuple[str, str], HeadRotation] = {}
    for a, b in combinations(rig.cones, 2):
        pairs = [
            (p, q)
            for p, q in zip(pictures[a.name], pictures[b.name], strict=True)
            if p is not None and q is not None
        ]
        one = rotation_between((a, b), pairs)
        if one is not None:
            between[a.name, b.name] = one
    while True:
        # The pair with most tie points continues the chain.
        open_pairs = [p for p in between if len(set(p) & set(rotations)) == 1]
        if not open_pairs:
            break
        pair = max(open_pairs, key=lambda p: between[p].ties)
        known, new = pair if pair[0] in rotations else pair[::-1]
        link = between[pair]
        step = link.rotation if known == pair[0] else link.rotation.T
        rotations[new] = rotations[known] @ step
        turned = rotation_matrix(*rig.cone(new).rotation_rad).T @ rotations[new]
        angle = math.degrees(float(np.linalg.norm(vectors_from_rotations(turned))))
        found[new] = {"turned_deg": angle, "ties": link.ties, "rms_px": link.rms_px}
    missing = [cone.name for cone in rig.cones if cone.name not in rotations]
    if missing:
        raise HeadRefinementError(
            f"{', '.join(missing)}: fewer than {MIN_TIES} tie points with the other heads in "
            f"{len(set(chosen))} exposures of {folder.id}; leave out --mission, or give one over "
            "textured ground whose heads overlap"
        )
    cones = tuple(_turned(cone, rotations[cone.name]) for cone in rig.cones)
    return replace(rig, cones=cones), found


def _turned(cone: Cone, rotation: np.ndarray[Any, np.dtype[np.float64]]) -> Cone:
    omega, phi, kappa = (float(v) for v in omega_phi_kappa(rotation))
    return replace(cone, rotation_rad=(omega, phi, kappa))


def _picture(folder: Mission, number: int, cone: Cone) -> Any:
    sensor = cone.sensors[0]
    path = folder.level0(number) / f"{sensor.name}.tif"
    try:
        pixels = read_tiff(path, width_px=sensor.width_px, height_px=sensor.height_px)
    except (OSError, RasterError):
        return None
    return grey_picture(pixels, sensor.colour_filter_array)

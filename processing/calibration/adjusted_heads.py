"""A rig with lenses, sensor places and mountings of an adjustment, and their standard deviations.

Each head has one sensor; the adjustment has a camera for each head (model `centred`) and mountings
against one reference head.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from processing.bundle.adjust import Adjustment
from processing.bundle.network import INTERIOR
from processing.geometry.rotation import omega_phi_kappa, rotation_matrix
from processing.rig import Cone, Rig


def with_adjusted_heads(
    rig: Rig,
    cones: Sequence[Cone],
    result: Adjustment,
    oriented: Collection[str],
    reference: str,
    *,
    variance_factor: float = 1.0,
) -> Rig:
    """The rig with new lenses and mountings, with standard deviations as far as it holds them.

    Args:
        rig: before.
        cones: the heads of the adjustment, with the adjusted lenses.
        result: the adjustment.
        oriented: heads that are oriented relative to the reference.
        reference: head whose rotation and place are as they were.
        variance_factor: what cofactors are multiplied with.

    Returns:
        The rig; heads that are not among `cones` are as they were.
    """
    new = {cone.name: cone for cone in cones}
    base = rig.cone(reference)
    base_rotation = rotation_matrix(*base.rotation_rad)
    for k, head in enumerate(result.network.heads):
        if head.name not in oriented:
            continue
        rotation = base_rotation @ result.state.head_rotation[k]
        right, forward, up = base_rotation @ result.state.head_offset[k] * 1e3
        at = base.position_mm
        omega, phi, kappa = (float(v) for v in omega_phi_kappa(rotation))
        columns = result.layout.head_rotation[k]
        trace = float(np.trace(result.cofactor[np.ix_(columns, columns)]))
        spread = math.sqrt(variance_factor * trace / 3.0)
        new[head.name] = replace(
            new[head.name],
            rotation_rad=(omega, phi, kappa),
            position_mm=(at[0] + float(forward), at[1] + float(right), at[2] - float(up)),
            rotation_sigma_urad=max(round(spread * 1e6, 3), 0.001),
        )
    for k, camera in enumerate(result.network.cameras):
        cone = new[camera.name]
        unit = math.sqrt(variance_factor)
        sigma = [unit * interior_sigma(result, k, name) for name in ("dx0", "dy0", "df")]
        sensor = replace(cone.sensors[0], position_sigma_um=round(1e3 * max(sigma[:2]), 4))
        ppm = max(round(1e6 * sigma[2] / cone.lens.f_mm, 3), 0.001)
        new[camera.name] = replace(
            cone, sensors=(sensor,), lens=replace(cone.lens, f_sigma_ppm=ppm)
        )
    return replace(rig, cones=tuple(new.get(cone.name, cone) for cone in rig.cones))


def interior_sigma(result: Adjustment, camera: int, name: str) -> float:
    """Square root of the cofactor of a parameter of the interior orientation.

    Args:
        result: the adjustment.
        camera: its index.
        name: one of the Australis ten.

    Returns:
        In the parameter's unit; 0 where it was held.
    """
    column = int(result.layout.interior[camera][INTERIOR.index(name)])
    return math.sqrt(float(result.cofactor[column, column])) if column >= 0 else 0.0

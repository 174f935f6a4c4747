"""Exposures of a block and the heads of its images; heads that expose together are rigid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.orientation.exterior_orientation import ExteriorOrientation
from processing.bundle.flown_network import HeadPlace
from processing.geometry.orientation import BODY_FROM_CAMERA
from processing.geometry.rotation import rotation_matrix
from processing.rig import Rig

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SYNCHRONOUS_NS: Final = 50_000
"""Heads that expose within this time move by a few millimetres between them."""


@dataclass(frozen=True)
class HeadArrangement:
    """Who shares an orientation.

    Attributes:
        names: of the e exposures.
        exposure, head: (n,) of each image.
        first: (e,) an image of each exposure.
        heads: their calibrated places; none: stitched images, one camera.
        position_m, rotation: (e, 3), (e, 3, 3) measured, of what represents an exposure: the
            stitched camera, or axes as the rig's at the place of the first head.
    """

    names: tuple[str, ...]
    exposure: Indices
    head: Indices
    first: Indices
    heads: tuple[HeadPlace, ...]
    position_m: Array
    rotation: Array


def arrangement_of(
    rig: Rig, oriented: Sequence[ExteriorOrientation], station_m: Array, rotation: Array
) -> HeadArrangement:
    """Exposures and heads of the images of a block.

    Images of heads that are not synchronous are exposures of their own, with the mounting of their
    head in common.

    Args:
        rig: with calibrated places of its heads.
        oriented: the n images.
        station_m: (n, 3) their projection centres.
        rotation: (n, 3, 3) from camera.
    """
    n = len(oriented)
    image_names, every = tuple(eo.name for eo in oriented), np.arange(n)
    if all(eo.is_virtual for eo in oriented):
        return HeadArrangement(
            image_names, every, np.zeros(n, dtype=np.int64), every, (), station_m, rotation
        )
    order = tuple(dict.fromkeys(eo.cone for eo in oriented))
    reference_mm = np.array(rig.cone(order[0]).position_mm)
    places = []
    for name in order:
        cone = rig.cone(name)
        offset_m = BODY_FROM_CAMERA.T @ (np.array(cone.position_mm) - reference_mm) * 1e-3
        places.append(HeadPlace(name, rotation_matrix(*cone.rotation_rad), offset_m))
    head = np.array([order.index(eo.cone) for eo in oriented], dtype=np.int64)
    turn = np.array([rotation[k] @ places[head[k]].rotation.T for k in range(n)])
    position = np.array([station_m[k] - turn[k] @ places[head[k]].offset_m for k in range(n)])
    numbers = np.array([eo.exposure for eo in oriented])
    instants = np.array([eo.gps_ns for eo in oriented])
    shared, first, exposure = np.unique(numbers, return_index=True, return_inverse=True)
    if any(np.ptp(instants[exposure == e]) > SYNCHRONOUS_NS for e in range(len(shared))):
        return HeadArrangement(image_names, every, head, every, tuple(places), position, turn)
    return HeadArrangement(
        tuple(f"{number:06d}" for number in shared),
        exposure.astype(np.int64),
        head,
        first.astype(np.int64),
        tuple(places),
        position[first],
        turn[first],
    )

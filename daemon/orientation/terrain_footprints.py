"""Footprints on a height model: the image's edge followed to the ground, as a ring of positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from daemon.orientation.exterior_orientation import ExteriorOrientation
from daemon.orientation.georeference import Georeference
from daemon.orientation.orientation_files import image_extent_mm
from processing.geometry.terrain_rays import HeightModel, on_terrain
from processing.rig import Rig

ALONG_EDGE = 8
"""Points on each side of the image."""

Ring = Sequence[tuple[float, float]]


def rings_on_terrain(
    oriented: Sequence[ExteriorOrientation],
    rig: Rig,
    model: HeightModel,
    georeference: Georeference,
) -> Mapping[str, Ring | None]:
    """Rings (longitude, latitude), counter-clockwise, by image; None where an edge misses the model
    or the horizon is seen."""
    found: dict[str, Ring | None] = {}
    for eo in oriented:
        cone = rig.cone(eo.cone)
        left, bottom, right, top = image_extent_mm(rig, cone, is_virtual=eo.is_virtual)
        f_mm = rig.virtual_image.f_mm if eo.is_virtual and rig.virtual_image else cone.lens.f_mm
        corners = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
        share = np.arange(ALONG_EDGE)[:, None] / ALONG_EDGE
        edge = np.concatenate(
            [a + (b - a) * share for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)]
        )
        rays = np.column_stack([edge, np.full(len(edge), -f_mm)]) @ eo.rotation.T
        ground = on_terrain(eo.centre_m, rays, model)
        found[eo.name] = (
            [georeference.position(*(float(v) for v in p)) for p in ground]
            if np.isfinite(ground).all()
            else None
        )
    return found

"""Height of an exposure above the ground: over a height model, where one is configured.

The mean over the image's footprint is what converging heads are projected onto
(docs/explanation/mathematics/virtual-camera.md#ground-plane).
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from daemon.configuration.model import MountSection, PlanSection
from daemon.mission.exposure import NavigationRecord
from daemon.orientation.elevation import read_elevation
from daemon.orientation.footprints import footprint_corners
from daemon.orientation.georeference import Georeference
from processing.rig import Rig

SAMPLES: Final = 9
"""Of a footprint, along and across."""
MIN_KNOWN_SHARE: Final = 0.5
"""Where the model covers less than this share of the footprint, it is not used."""


class GroundModel:
    """A height model under a camera.

    Args:
        elevation: the model's file, in `crs`.
        ground_height_m: above the ellipsoid, as planned: where the search for the footprint starts.

    Raises:
        ElevationError, GeoreferenceError: a model or a coordinate system that cannot be used.
    """

    def __init__(
        self, rig: Rig, mount: MountSection, elevation: Path, crs: str, *, ground_height_m: float
    ) -> None:
        self._rig, self._mount, self._plan_ground_m = rig, mount, ground_height_m
        self._system = Georeference(crs)
        self._model = read_elevation(elevation, self._system)

    def height_above_m(self, there: NavigationRecord) -> float | None:
        """Height of the camera above the mean of the terrain it sees.

        None without a height or an attitude, and where the model does not know half of the
        footprint.
        """
        if there.height_m is None:
            return None
        own = self._system.place(there.latitude_deg, there.longitude_deg, there.height_m)
        # Heights of the model may count from the geoid, those of navigation do not.
        model_less_ellipsoid_m = own.height_m - there.height_m
        ground_m = self._plan_ground_m
        for _ in range(2):  # the footprint itself depends on the ground's height
            corners = footprint_corners(self._rig, self._mount, there, ground_m)
            if corners is None:
                return None
            flat = [self._system.place(lat, lon, ground_m) for lon, lat in corners]
            a, b, c, d = np.array([[place.east_m, place.north_m] for place in flat])
            u, v = np.meshgrid(*[np.linspace(0.0, 1.0, SAMPLES)] * 2)
            u, v = u.reshape(-1, 1), v.reshape(-1, 1)
            at = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * d + u * c)
            heights = self._model.at(at)
            known = heights[np.isfinite(heights)]
            if len(known) < MIN_KNOWN_SHARE * len(heights):
                return None
            mean_m = float(known.mean())
            ground_m = mean_m - model_less_ellipsoid_m
        return own.height_m - mean_m


def ground_of(rig: Rig, mount: MountSection, plan: PlanSection) -> GroundModel | None:
    """The ground by the configured height model; None where there is none."""
    if plan.elevation is None:
        return None
    at = plan.ground_height_m
    return GroundModel(rig, mount, plan.elevation, plan.elevation_crs, ground_height_m=at)

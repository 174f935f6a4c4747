"""Tie points of a block against the height model that the flight was planned with."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.configuration.model import PlanSection
from daemon.onboard.triangulation.findings import HeightModelCheck, height_limit_m
from daemon.orientation.local_frame import LocalFrame
from daemon.planning.relief import TerrainRelief, relief_of

Array = NDArray[np.float64]

_HEIGHT_SAMPLES: Final = 400


def read_relief(plan: PlanSection) -> tuple[TerrainRelief | None, HeightModelCheck | None]:
    """The height model, or a check that states why there is none; neither if none is configured."""
    try:
        return relief_of(plan), None
    except (OSError, DaemonError, ValueError) as error:
        return None, HeightModelCheck(problem=str(error))


def check_heights(
    relief: TerrainRelief, frame: LocalFrame, xyz_m: Array, sigma_m: Array
) -> HeightModelCheck | None:
    """Compare tie points (n, 3) with their standard deviations (n, 3); None without points."""
    if not len(xyz_m):
        return None
    step = max(1, len(xyz_m) // _HEIGHT_SAMPLES)
    differences = []
    for latitude, longitude, height in frame.to_geodetic(xyz_m[::step]):
        place = relief.system.place(float(latitude), float(longitude), float(height))
        model = relief.model.at(np.array([[place.east_m, place.north_m]]))
        differences.append(place.height_m - float(model[0]))
    known = np.array(differences)
    known = known[np.isfinite(known)]
    if not len(known):
        return HeightModelCheck(problem="it does not cover the block")
    median, sigma = float(np.median(known)), float(np.median(sigma_m[:, 2]))
    off = np.abs(known - median) > height_limit_m(sigma)
    return HeightModelCheck(median, sigma, share_off=float(off.mean()))

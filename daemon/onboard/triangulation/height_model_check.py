"""Tie points of a block against the height model that the flight was planned with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.configuration.model import PlanSection
from daemon.orientation.georeference import Georeference
from daemon.orientation.local_frame import LocalFrame
from daemon.planning.relief import TerrainRelief, relief_of

Array = NDArray[np.float64]

_HEIGHT_SAMPLES: Final = 400
HEIGHT_MODEL_SIGMAS: Final = 3.0
HEIGHT_MODEL_MIN_M: Final = 5.0
HEIGHT_UNITS: Final = {
    3.2808: "feet",
    0.001: "kilometres",
    100.0: "centimetres",
    1e3: "millimetres",
}
"""Units by the factor of their numbers to those in metres."""
HEIGHT_UNIT_TOLERANCE: Final = 0.02


@dataclass(frozen=True)
class HeightModelCheck:
    """Tie points against the configured height model: median difference and its standard deviation
    in m; `share_off` of the points differ from the median by more than the limit of a wrong model;
    `problem` where the model cannot be used. `uncovered` is the share of points where the model has
    no height; `factor` is the median of its heights over those of points."""

    difference_m: float | None = None
    sigma_m: float | None = None
    problem: str = ""
    share_off: float = 0.0
    uncovered: float = 0.0
    factor: float | None = None

    @property
    def is_contradicted(self) -> bool:
        """Whether tie points lie farther from the model than the limit, in the median."""
        return self.difference_m is not None and abs(self.difference_m) > self.limit_m

    @property
    def unit(self) -> str | None:
        """The unit that explains the heights of a model that is contradicted; else None."""
        if not self.is_contradicted or self.factor is None:
            return None
        for factor, unit in HEIGHT_UNITS.items():
            if abs(self.factor / factor - 1.0) < HEIGHT_UNIT_TOLERANCE:
                return unit
        return None

    @property
    def limit_m(self) -> float:
        """The largest difference that is not a contradiction."""
        return height_limit_m(self.sigma_m or 0.0)


def height_limit_m(sigma_m: float) -> float:
    """The largest difference from a height model that is not a contradiction.

    Args:
        sigma_m: median standard deviation of tie points in height.
    """
    return max(HEIGHT_MODEL_MIN_M, HEIGHT_MODEL_SIGMAS * sigma_m)


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
    return compare_heights(relief.model.at, relief.system, frame.to_geodetic(xyz_m), sigma_m[:, 2])


def compare_heights(
    heights_at: Callable[[Array], Array], system: Georeference, geodetic: Array, sigma_m: Array
) -> HeightModelCheck | None:
    """Compare points with a height model; None without points.

    Args:
        heights_at: heights of the model, m, at places (n, 2) in the system; NaN where unknown.
        system: of the model.
        geodetic: latitude, longitude, deg, and height above the ellipsoid, m, of points (n, 3).
        sigma_m: standard deviations of their heights, (n,).
    """
    if not len(geodetic):
        return None
    step = max(1, len(geodetic) // _HEIGHT_SAMPLES)
    points, model = [], []
    for latitude, longitude, height in geodetic[::step]:
        place = system.place(float(latitude), float(longitude), float(height))
        points.append(place.height_m)
        model.append(float(heights_at(np.array([[place.east_m, place.north_m]]))[0]))
    is_known = np.isfinite(model)
    if not is_known.any():
        return HeightModelCheck(problem="it does not cover the block", uncovered=1.0)
    known, found = np.array(points)[is_known], np.array(model)[is_known]
    difference = known - found
    median, sigma = float(np.median(difference)), float(np.median(sigma_m))
    off = np.abs(difference - median) > height_limit_m(sigma)
    is_high = np.abs(known) > height_limit_m(sigma)
    return HeightModelCheck(
        median,
        sigma,
        share_off=float(off.mean()),
        uncovered=float(1.0 - is_known.mean()),
        factor=float(np.median(found[is_high] / known[is_high])) if is_high.any() else None,
    )

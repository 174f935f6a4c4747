"""Tie points of a block against the height model that the flight was planned with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.configuration.model import PlanSection
from daemon.orientation.georeference import Georeference
from daemon.orientation.local_frame import LocalFrame
from daemon.planning.relief import TerrainRelief, relief_of
from processing.geometry.terrain_rays import HeightModel

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
ARRANGEMENTS: Final[Mapping[str, Callable[[Array, Array], tuple[Array, Array]]]] = {
    "its rows were in reverse order": lambda u, v: (u, 1.0 - v),
    "its columns were in reverse order": lambda u, v: (1.0 - u, v),
    "it were turned by 180 degrees": lambda u, v: (1.0 - u, 1.0 - v),
    "its rows and columns were exchanged": lambda u, v: (v, u),
    "it were turned by 90 degrees to the left": lambda u, v: (v, 1.0 - u),
    "it were turned by 90 degrees to the right": lambda u, v: (1.0 - v, u),
    "its rows and columns were exchanged and reversed": lambda u, v: (1.0 - v, 1.0 - u),
}
"""What may have happened to the grid of a model: where the height of a place is in it, as shares of
its columns and rows."""
ARRANGEMENT_SHARE: Final = 0.4
"""Another arrangement explains the scatter of the differences where this is left of it."""
ARRANGEMENT_MIN_M: Final = 2.0
"""A smaller scatter may be of trees and buildings."""
ARRANGEMENT_MIN_POINTS: Final = 30


@dataclass(frozen=True)
class HeightModelCheck:
    """Tie points against the configured height model: median difference and its standard deviation
    in m; `share_off` of the points differ from the median by more than the limit of a wrong model;
    `problem` where the model cannot be used. `uncovered` is the share of points where the model has
    no height; `factor` is the median of its heights over those of points. `scatter_m` is the
    standard deviation of a difference by its median, and `arranged_m` with the grid of the model as
    `arrangement` states, one of `ARRANGEMENTS`, where that explains the differences."""

    difference_m: float | None = None
    sigma_m: float | None = None
    problem: str = ""
    share_off: float = 0.0
    uncovered: float = 0.0
    factor: float | None = None
    scatter_m: float = 0.0
    arrangement: str = ""
    arranged_m: float = 0.0

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

    def arrangement_sentence(self, option: str) -> str:
        """What the arrangement of the model's grid explains, and the correction.

        Args:
            option: with which another model is given.
        """
        return (
            f"Heights of tie points scatter by {self.scatter_m:.1f} m about the height model, and "
            f"by {self.arranged_m:.1f} m as if {self.arrangement}. Correct the grid, or give "
            f"another height model ({option})."
        )

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
    return compare_heights(relief.model, relief.system, frame.to_geodetic(xyz_m), sigma_m[:, 2])


def compare_heights(
    surface: HeightModel | Callable[[Array], Array],
    system: Georeference,
    geodetic: Array,
    sigma_m: Array,
) -> HeightModelCheck | None:
    """Compare points with a height model; None without points.

    Args:
        surface: the model, or heights, m, at places (n, 2) in the system; NaN where unknown.
        system: of the model.
        geodetic: latitude, longitude, deg, and height above the ellipsoid, m, of points (n, 3).
        sigma_m: standard deviations of their heights, (n,).
    """
    if not len(geodetic):
        return None
    step = max(1, len(geodetic) // _HEIGHT_SAMPLES)
    places = [system.place(*map(float, point)) for point in geodetic[::step]]
    places_m = np.array([(place.east_m, place.north_m) for place in places])
    points = np.array([place.height_m for place in places])
    model = surface.at(places_m) if isinstance(surface, HeightModel) else surface(places_m)
    is_known = np.isfinite(model)
    if not is_known.any():
        return HeightModelCheck(problem="it does not cover the block", uncovered=1.0)
    known, found = points[is_known], model[is_known]
    difference = known - found
    median, sigma = float(np.median(difference)), float(np.median(sigma_m))
    off = np.abs(difference - median) > height_limit_m(sigma)
    is_high = np.abs(known) > height_limit_m(sigma)
    scatter_m = _scatter_m(difference)
    arranged_m, arrangement = scatter_m, ""
    if isinstance(surface, HeightModel) and scatter_m > max(
        ARRANGEMENT_MIN_M, HEIGHT_MODEL_SIGMAS * sigma
    ):
        arranged_m, arrangement = _arrangement(surface, places_m, points, scatter_m)
    return HeightModelCheck(
        median,
        sigma,
        share_off=float(off.mean()),
        uncovered=float(1.0 - is_known.mean()),
        factor=float(np.median(found[is_high] / known[is_high])) if is_high.any() else None,
        scatter_m=scatter_m,
        arrangement=arrangement,
        arranged_m=arranged_m,
    )


def _scatter_m(differences: Array) -> float:
    return 1.4826 * float(np.median(np.abs(differences - np.median(differences))))


def _arrangement(
    model: HeightModel, places_m: Array, points: Array, scatter_m: float
) -> tuple[float, str]:
    """The scatter with the arrangement of the grid that explains the heights, and its name."""
    rows, columns = model.height_m.shape
    steps = np.array([model.step_x_m, model.step_y_m])
    extent = steps * (columns - 1, rows - 1)
    first = np.array([model.x_m, model.y_m])
    shares = (places_m - first) / extent
    scatters = {}
    for name, arranged in ARRANGEMENTS.items():
        at = np.stack(arranged(shares[:, 0], shares[:, 1]), axis=1) * extent + first
        difference = points - model.at(at)
        difference = difference[np.isfinite(difference)]
        if len(difference) >= ARRANGEMENT_MIN_POINTS:
            scatters[name] = _scatter_m(difference)
    best = min(scatters, key=lambda name: scatters[name], default="")
    if not best or scatters[best] > ARRANGEMENT_SHARE * scatter_m:
        return scatter_m, ""
    return scatters[best], best

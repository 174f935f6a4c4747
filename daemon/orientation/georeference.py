"""From WGS 84 to the requested coordinate system, by PROJ, never by a guess.

What PROJ can only do roughly, because a grid is not installed, is an error that names the grid.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.orientation.geodesy import (
    CRS,
    ELLIPSOID,
    GEODETIC,
    CRSError,
    Transformer,
    TransformerGroup,
)

_CODE = re.compile(r"[A-Za-z]{2,10}:\w{1,10}(\+([A-Za-z]{2,10}:)?\w{1,10})?", re.ASCII)
STEP_DEG = 1e-3
"""Half the length, about 110 m, of the piece of meridian whose direction is taken.

The factors of PROJ (`get_factors`) know the projection alone: in EPSG:31287 their convergence is
wrong by 7.5 seconds of arc, for the datum, in EPSG:2053 by 180 degrees, for the axes.
"""


class GeoreferenceError(DaemonError):
    """A coordinate system that cannot be served; the message states what is missing."""


@dataclass(frozen=True)
class ProjectedPoint:
    """A point in the target system: east, north and height in metres, and where true north is.

    `azimuth_of_north_rad` is clockwise from grid north; `scale` is grid length over true length.
    """

    east_m: float
    north_m: float
    height_m: float
    azimuth_of_north_rad: float
    scale: float


class Georeference:
    """Transforms WGS 84 positions into one projected coordinate system.

    Args:
        crs: such as "EPSG:25833" (heights stay above the ellipsoid) or "EPSG:25833+7837".

    Raises:
        GeoreferenceError: no such system, not a projected one in metres, or a grid is missing.
    """

    def __init__(self, crs: str) -> None:
        try:
            # Other texts that PROJ takes name files and addresses, and a mission may say them.
            if _CODE.fullmatch(crs) is None:
                raise CRSError("no code of an authority")
            self.crs = CRS.from_user_input(crs)
        except CRSError as error:
            raise GeoreferenceError(
                f"{crs[:100]} is no coordinate system PROJ knows; "
                "write it as EPSG:25833 or EPSG:25833+7837"
            ) from error
        self.name = crs
        _refuse_unfit(self.crs, crs)
        self._transformer = accurate_transformer(self.crs, crs)
        self.operation = str(self._transformer.description)
        self.accuracy_m = float(self._transformer.accuracy)

    @property
    def height_system(self) -> str:
        """Height reference, in words."""
        vertical = [part for part in self.crs.sub_crs_list if part.is_vertical]
        return str(vertical[0].name) if vertical else "ellipsoid of WGS 84"

    def place(self, latitude_deg: float, longitude_deg: float, height_m: float) -> ProjectedPoint:
        """Transform a position, height above the ellipsoid.

        Raises:
            GeoreferenceError: it is outside the area of the system.
        """
        north_of, south_of = latitude_deg + STEP_DEG, latitude_deg - STEP_DEG
        east, north, height = self._transform(longitude_deg, latitude_deg, height_m)
        above = self._transform(longitude_deg, north_of, height_m)
        below = self._transform(longitude_deg, south_of, height_m)
        along = (above[0] - below[0], above[1] - below[1])
        return ProjectedPoint(
            east_m=east,
            north_m=north,
            height_m=height,
            azimuth_of_north_rad=math.atan2(along[0], along[1]),
            scale=math.hypot(*along) / float(ELLIPSOID.inv(0.0, south_of, 0.0, north_of)[2]),
        )

    def position(self, east_m: float, north_m: float, height_m: float) -> tuple[float, float]:
        """Longitude and latitude, deg, of a point in the system."""
        longitude, latitude, _ = self._transformer.transform(
            east_m, north_m, height_m, direction="INVERSE"
        )
        return float(longitude), float(latitude)

    def geodetic(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Latitude, longitude, deg, and ellipsoidal height, m, (n, 3), of points in the system."""
        longitude, latitude, height = self._transformer.transform(
            points_m[:, 0], points_m[:, 1], points_m[:, 2], direction="INVERSE"
        )
        return np.stack([latitude, longitude, height], axis=-1)

    def _transform(
        self, longitude_deg: float, latitude_deg: float, height_m: float
    ) -> tuple[float, float, float]:
        x, y, z = self._transformer.transform(longitude_deg, latitude_deg, height_m)
        if not all(map(math.isfinite, (x, y, z))):
            raise GeoreferenceError(
                f"{latitude_deg:.6f} N {longitude_deg:.6f} E is outside the area of {self.name}"
            )
        return float(x), float(y), float(z)


def accurate_transformer(crs: CRS, name: str) -> Transformer:
    """From longitude, latitude (deg) and ellipsoidal height of WGS 84 to a system, not roughly.

    Args:
        crs: projected or geographic, with a height system or not; without one heights stay above
            the ellipsoid of WGS 84.
        name: what the user wrote.

    Raises:
        GeoreferenceError: a grid is missing, or PROJ knows no accurate operation.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what it warns of is the error below
        group = TransformerGroup(GEODETIC, crs, always_xy=True, allow_ballpark=False)
    if not group.transformers or not group.best_available:
        raise GeoreferenceError(_missing_grids(name, group.unavailable_operations))
    transformer: Transformer = group.transformers[0]
    return transformer


def _refuse_unfit(crs: CRS, name: str) -> None:
    horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
    if not horizontal.is_projected:
        raise GeoreferenceError(
            f"{name} ({crs.name}) is not projected; omega, phi and kappa need a map grid, "
            "such as a UTM zone"
        )
    units = {axis.unit_name for axis in crs.axis_info}
    if units != {"metre"}:
        raise GeoreferenceError(f"{name} ({crs.name}) counts in {', '.join(sorted(units))}, not m")


def _missing_grids(name: str, unavailable: Sequence[object]) -> str:
    for operation in unavailable:
        grids = [grid for grid in getattr(operation, "grids", []) if not grid.available]
        if grids:
            files = ", ".join(grid.short_name for grid in grids)
            commands = "; ".join(f"pyproj sync --file {grid.short_name}" for grid in grids)
            return (
                f"{name}: PROJ has no {files}, without which heights or positions would be wrong "
                f"by metres. Fetch it where there is a network ({commands}), or leave the height "
                "system out for ellipsoidal heights"
            )
    return f"{name}: PROJ knows no accurate way there from WGS 84 with ellipsoidal heights"

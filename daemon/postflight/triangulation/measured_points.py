"""Surveyed points of a block: where they are on the ground, and where in the images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.adjustment.csv_tables import CsvTable, read_table
from daemon.postflight.adjustment.plausibility import check_rows, check_sigmas

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MEASURED_SIGMA_PX = 0.3
GEODETIC = ("latitude_deg", "longitude_deg", "height_m")
SIGMAS = ("sx_m", "sy_m", "sz_m")


class MeasuredPointsError(DaemonError, ValueError):
    """Tables of points that cannot be used; the message states what is wrong."""


@dataclass(frozen=True)
class MeasuredPoints:
    """Points with their places and measurements.

    Attributes:
        names, roles: (p,) the latter `control` or `check`.
        xyz_m, sigma_m: (p, 3) in the local frame.
        image, point: (m,) of each measurement.
        px: (m, 2) column and row.
        sigma_px: (m,).
    """

    names: tuple[str, ...]
    roles: tuple[str, ...]
    xyz_m: Array
    sigma_m: Array
    image: Indices
    point: Indices
    px: Array
    sigma_px: Array


def no_measured_points() -> MeasuredPoints:
    """No points."""
    none, empty = np.zeros(0, np.int64), np.zeros((0, 3))
    return MeasuredPoints((), (), empty, empty, none, none, np.zeros((0, 2)), np.zeros(0))


def read_measured_points(
    images: Sequence[str], frame: LocalFrame, points_file: Path | None, measured_file: Path | None
) -> MeasuredPoints:
    """Read the two tables; without them there are no points.

    Args:
        images: names of the block's images.
        frame: the block's local frame.

    Raises:
        MeasuredPointsError: one table without the other, or tables with mistakes.
        daemon.postflight.adjustment.csv_tables.ProjectError: a table that cannot be read.
    """
    if points_file is None or measured_file is None:
        if points_file is not None or measured_file is not None:
            raise MeasuredPointsError(
                "--points and --measured go together: where points are on the ground, and where "
                "in the images"
            )
        return no_measured_points()
    table = read_table(points_file, ("point", "role", *GEODETIC), SIGMAS)
    names = table.names("point")
    roles = table.text("role")
    for role, line in zip(roles, table.lines, strict=True):
        if role not in ("control", "check"):
            table.add_problem(line, f"role is {role!r}; control or check is right")
    place = np.array([table.numbers(c) for c in GEODETIC])
    sigma = np.array([table.numbers(c, 0.02) for c in SIGMAS]).T.reshape(-1, 3)
    seen = read_table(measured_file, ("image", "point", "column_px", "row_px"), ("sigma_px",))
    image = _index(seen, "image", images)
    point = _index(seen, "point", names)
    px = np.array([seen.numbers("column_px"), seen.numbers("row_px")]).T.reshape(-1, 2)
    spread = np.array(seen.numbers("sigma_px", MEASURED_SIGMA_PX))
    check_rows(table)
    check_rows(seen)
    check_sigmas(seen, ("sigma_px",))
    _check_repeated(seen)
    problems = [*table.problems, *seen.problems]
    if problems or not np.isfinite(place).all() or not np.isfinite(px).all():
        raise MeasuredPointsError("; ".join(problems) or "an empty cell where a number is needed")
    return MeasuredPoints(
        tuple(names), tuple(roles), frame.from_geodetic(*place), sigma, image, point, px, spread
    )


def _check_repeated(seen: CsvTable) -> None:
    """Report a point that is measured twice in an image."""
    first: dict[tuple[str, str], int] = {}
    pairs = zip(seen.text("image"), seen.text("point"), strict=True)
    for pair, line in zip(pairs, seen.lines, strict=True):
        if pair in first:
            seen.add_problem(
                line,
                f"image {pair[0]} measures point {pair[1]} a second time (line {first[pair]}); "
                "leave one out",
            )
        first.setdefault(pair, line)


def _index(table: CsvTable, column: str, names: Sequence[str]) -> Indices:
    at = {name: k for k, name in enumerate(names)}
    found = []
    for name, line in zip(table.text(column), table.lines, strict=True):
        if name not in at:
            table.add_problem(line, f"{column} {name!r} is not there")
        found.append(at.get(name, 0))
    return np.array(found, dtype=np.int64)

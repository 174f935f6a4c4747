"""Bounds of coordinates and standard deviations: values that no measurement has.

A sigma that is wrong by a unit only is found from the residuals (`variance_factors`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.adjustment.csv_tables import UNUSED, CsvTable

Array = NDArray[np.float64]

MAX_COORDINATE_M: Final = 1e8
"""Geocentric and map coordinates are below."""

_SMALLEST: Final = 1e-10
_LARGEST: Final = 100.0
"""Sigmas over the extent of the values, or over the value."""

_SMALLEST_UM: Final = 1e-4
_LARGEST_UM: Final = 1e5
_SMALLEST_DEG: Final = 1e-9
_LARGEST_DEG: Final = 360.0


def check_coordinates(table: CsvTable, columns: Sequence[str]) -> None:
    """Report coordinates that are no place on Earth.

    Args:
        table: problems are added to it.
        columns: of coordinates, m.
    """
    for column in columns:
        values = np.array(table.numbers(column))
        for row in np.flatnonzero(np.abs(np.nan_to_num(values)) > MAX_COORDINATE_M):
            table.add_problem(
                table.lines[row],
                f"{column} is {values[row]:g}; coordinates are within {MAX_COORDINATE_M:g} m",
            )


def extent_m(*tables: CsvTable | None) -> float:
    """Largest extent of the coordinates of tables, 0 where they have none.

    Args:
        tables: with columns `x_m`, `y_m` and `z_m`.
    """
    largest = 0.0
    for column in ("x_m", "y_m", "z_m"):
        values = [v for table in tables if table is not None for v in table.numbers(column)]
        known = np.array(values)
        known = known[np.abs(np.nan_to_num(known, nan=np.inf)) <= MAX_COORDINATE_M]
        largest = max(largest, float(np.ptp(known)) if len(known) else 0.0)
    return largest


def check_metres(
    table: CsvTable, columns: Sequence[str], extent: float, rows: Sequence[int] | None = None
) -> None:
    """Report sigmas of coordinates that are too small or too large for their extent.

    Args:
        table: problems are added to it.
        columns: of sigmas, m; 0 holds where the table allows it.
        extent: of the coordinates, m; with 0 nothing is compared.
        rows: that are looked at; None: all.
    """
    if not extent > 0.0:
        return
    of = f"coordinates that extend over {extent:.4g} m"
    is_held = rows is not None
    small = "write 0 to hold the coordinate" if is_held else "a receiver reaches millimetres"
    large = "leave it empty for a free coordinate" if is_held else f"write {UNUSED}"
    for column in columns:
        values = np.array(table.sigmas(column))
        _check(
            table, column, values, (_SMALLEST * extent, _LARGEST * extent),
            (f"{of}; {small}", f"{of}; {large}"), rows,
        )  # fmt: skip


def check_distance_sigmas(table: CsvTable) -> None:
    """Report sigmas of distances that are too small or too large for the distance.

    Args:
        table: problems are added to it.
    """
    distance = np.array(table.numbers("distance_m"))
    sigma = np.array(table.sigmas("sigma_m"))
    for row in np.flatnonzero(distance > 0.0):
        bounds = (_SMALLEST * distance[row], _LARGEST * distance[row])
        of = f"a distance of {distance[row]:g} m"
        _check(table, "sigma_m", sigma, bounds, (of, of), [int(row)])


def check_image_sigmas(table: CsvTable) -> None:
    """Report sigmas of image coordinates that no measurement has.

    Args:
        table: problems are added to it.
    """
    of = "image coordinates"
    for column in ("sx_um", "sy_um"):
        values = np.array(table.numbers(column))
        _check(table, column, values, (_SMALLEST_UM, _LARGEST_UM), (of, of), None)


def check_degrees(table: CsvTable, columns: Sequence[str]) -> None:
    """Report sigmas of attitudes that no instrument has.

    Args:
        table: problems are added to it.
        columns: of sigmas, degrees.
    """
    of = "attitudes"
    for column in columns:
        values = np.array(table.sigmas(column))
        bounds = (_SMALLEST_DEG, _LARGEST_DEG)
        _check(table, column, values, bounds, (of, f"{of}; write {UNUSED}"), None)


def _check(
    table: CsvTable,
    column: str,
    values: Array,
    bounds: tuple[float, float],
    of: tuple[str, str],
    rows: Sequence[int] | None,
) -> None:
    """Positive finite values outside bounds; what is not positive is reported elsewhere."""
    own = np.zeros(len(values), bool)
    own[slice(None) if rows is None else list(rows)] = True
    known = np.nan_to_num(values, nan=0.0, posinf=0.0)
    for row in np.flatnonzero(own & (known > 0.0) & (known < bounds[0])):
        table.add_problem(table.lines[row], f"{column} is {values[row]:g}, too small for {of[0]}")
    for row in np.flatnonzero(own & (known > bounds[1])):
        table.add_problem(table.lines[row], f"{column} is {values[row]:g}, too large for {of[1]}")

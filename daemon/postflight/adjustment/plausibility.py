"""Mistakes in a project that a reader would see: units, repeated rows, values that cannot be.

Each is a sentence with file and line.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.adjustment.csv_tables import UNUSED, CsvTable
from daemon.postflight.adjustment.project_file import CameraSection
from processing.bundle.network import CameraModel, ImagePoints, Images

Array = NDArray[np.float64]

_MAX_TANGENT = 4.0
"""Of the angle between a ray and the camera axis: 76 degrees."""

_MIN_TANGENT = 2e-3
_MIN_POINTS = 4
_OUTSIDE = 0.1
"""Of the longer side, from the edge of the image: as far off a measurement may be a blunder of the
matching, which data snooping finds."""

_MANY_OUTSIDE = 0.2
"""Share of a camera's measurements from which its format is wrong, or their origin."""


def check_sigmas(table: CsvTable, columns: Sequence[str]) -> None:
    """Report sigmas that are not positive.

    Args:
        table: of observations; problems are added to it.
        columns: its columns of sigmas; an empty cell is not reported.
    """
    for column in columns:
        for value, line in zip(table.sigmas(column), table.lines, strict=True):
            if value <= 0.0:
                table.add_problem(line, f"{column} is {value:g}; a sigma is positive")


def check_observations(table: CsvTable, columns: Sequence[str], names: Sequence[str]) -> None:
    """Report a table without rows, sigmas that are missing or not positive, and repeated rows.

    Args:
        table: of observations; problems are added to it.
        columns: its columns of sigmas.
        names: what each row observes.
    """
    check_rows(table)
    check_sigmas(table, columns)
    for column in columns:
        for value, line in zip(table.text(column), table.lines, strict=True):
            if not value:
                table.add_problem(line, f"{column} is empty; a sigma, or {UNUSED}, is right")
    first: dict[str, int] = {}
    for name, line in zip(names, table.lines, strict=True):
        if name in first:
            table.add_problem(
                line,
                f"{name} is observed a second time (line {first[name]}); it would count twice: "
                "leave one out",
            )
        first.setdefault(name, line)


def check_rows(table: CsvTable, *, is_needed: bool = False) -> None:
    """Report a table that has names of columns only.

    Args:
        table: problems are added to it.
        is_needed: whether no project is without it.
    """
    advice = f"add a row for each of the {table.columns[0]}s"
    if not is_needed:
        advice = "remove the table from [files] if it has none"
    if not table.rows:
        table.add_problem(table.header, f"no rows; {advice}")


def check_image_points(
    table: CsvTable, points: ImagePoints, images: Images, cameras: Sequence[CameraModel]
) -> None:
    """Report repeated image points, and coordinates of another unit.

    Args:
        table: of image points; problems are added to it.
        points: its rows, in order.
        images: which camera an image has.
        cameras: their principal distances and points.
    """
    if not table.rows:
        table.add_problem(table.header, "no rows; an adjustment needs image points")
        return
    check_sigmas(table, ("sx_um", "sy_um"))
    names = list(zip(table.text("image"), table.text("point"), strict=True))
    first: dict[tuple[str, str], int] = {}
    for name, line in zip(names, table.lines, strict=True):
        if name in first:
            table.add_problem(
                line,
                f"image {name[0]} measures point {name[1]} a second time (line {first[name]}); "
                "it would count twice: leave one out",
            )
        first.setdefault(name, line)
    of = images.camera[points.image]
    for index, camera in enumerate(cameras):
        rows = np.flatnonzero(of == index)
        if len(rows) < _MIN_POINTS or not camera.f_mm > 0.0:
            continue
        centred = points.xy_mm[rows] - np.array([camera.xp_mm, camera.yp_mm])
        tangent = np.linalg.norm(centred, axis=1) / camera.f_mm
        worst = int(np.argmax(tangent))
        where = table.lines[int(rows[worst])]
        measured = points.xy_mm[rows[worst]]
        about = (
            f"{measured[0]:g}, {measured[1]:g} mm is {tangent[worst]:.3g} principal distances of "
            f"camera {camera.name} from its principal point"
        )
        if tangent[worst] > _MAX_TANGENT:
            table.add_problem(
                where, f"{about}; are these pixels (column_px, row_px) or micrometres?"
            )
        elif tangent[worst] < _MIN_TANGENT:
            table.add_problem(where, f"{about}, and no other point is farther; are these metres?")


def check_format(
    table: CsvTable, points: ImagePoints, images: Images, cameras: Sequence[CameraSection]
) -> None:
    """Report image points far outside the format of their camera.

    The format is that of the pixels about the origin of coordinates or about the principal point:
    files of other programs count millimetres from a corner.

    Args:
        table: of image points; problems are added to it.
        points: its rows, in order.
        images: which camera an image has.
        cameras: their sections; those without pixels, width and height are not checked.
    """
    of = images.camera[points.image]
    names = table.text("image"), table.text("point")
    for index, camera in enumerate(cameras):
        if camera.pixel_um is None or camera.width_px is None or camera.height_px is None:
            continue
        rows = np.flatnonzero(of == index)
        size_mm = np.array([camera.width_px, camera.height_px]) * camera.pixel_um * 1e-3
        reach = size_mm / 2.0 + _OUTSIDE * size_mm.max()
        off = [
            (np.abs(points.xy_mm[rows] - origin) > reach).any(axis=1)
            for origin in (np.zeros(2), np.array([camera.xp_mm, camera.yp_mm]))
        ]
        outside = rows[off[0] & off[1]]
        about = (
            f"outside the format of camera {camera.name}, {camera.width_px} x {camera.height_px} "
            f"px of {camera.pixel_um:g} um ({size_mm[0]:.5g} x {size_mm[1]:.5g} mm)"
        )
        if len(outside) >= max(_MIN_POINTS, _MANY_OUTSIDE * len(rows)):
            table.add_problem(
                table.lines[int(outside[0])],
                f"{len(outside)} of {len(rows)} image points, this one first, are far {about}: "
                "correct width_px, height_px or pixel_um, exchange width and height, or count "
                "coordinates from the middle of the image",
            )
            continue
        for row in outside:
            x, y = points.xy_mm[row]
            table.add_problem(
                table.lines[row],
                f"image {names[0][row]} measures point {names[1][row]} at {x:.6g}, {y:.6g} mm, far "
                f"{about}: correct the coordinates, or leave the row out",
            )


def check_control(table: CsvTable, roles: Sequence[str], xyz_m: Array) -> None:
    """Report control points with the coordinates of another.

    Args:
        table: of object points; problems are added to it.
        roles: of its rows.
        xyz_m: their coordinates, shape (n, 3), m.
    """
    names = table.text("point")
    first: dict[tuple[float, ...], int] = {}
    for row, (role, own) in enumerate(zip(roles, xyz_m, strict=True)):
        if role != "control" or not np.isfinite(own).all():
            continue
        key = tuple(float(v) for v in own)
        if key in first:
            table.add_problem(
                table.lines[row],
                f"control point {names[row]} has the coordinates of {names[first[key]]} (line "
                f"{table.lines[first[key]]}); one of them is another point",
            )
        first.setdefault(key, row)


def check_distances(table: CsvTable) -> None:
    """Report distances that are not positive or end where they begin.

    Args:
        table: of distances; problems are added to it.
    """
    pairs = zip(table.text("point_a"), table.text("point_b"), strict=True)
    names = [f"the distance between {' and '.join(sorted(pair))}" for pair in pairs]
    check_observations(table, ("sigma_m",), names)
    ends = zip(table.text("point_a"), table.text("point_b"), table.lines, strict=True)
    for a, b, line in ends:
        if a == b:
            table.add_problem(line, f"a distance from {a} to itself")
    for value, line in zip(table.numbers("distance_m"), table.lines, strict=True):
        if not value > 0.0:
            table.add_problem(line, f"distance_m is {value:g}; a distance is positive")

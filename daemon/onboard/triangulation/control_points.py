"""Control and check points that were given beforehand, compared with the block of a flight.

They take no part in the adjustment. Where their image coordinates are given, too, a point is
intersected from the adjusted images. Otherwise only its height is compared, with the surface of the
tie points around it.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.onboard.triangulation.findings import TriangulationFinding
from daemon.orientation.local_frame import LocalFrame
from processing.bundle.measured_points import measured_point, projected_mm
from processing.matching.block_matching import image_mm
from processing.pipelines.live_triangulation import LiveTriangulation

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

ROLES: Final = ("control", "check")
SURVEYED_SIGMA_M: Final = 0.02
MEASURED_SIGMA_PX: Final = 0.3
NEAREST: Final = 12
"""Tie points of the surface at a point."""
NEAREST_MIN: Final = 6
REACH_SHARE: Final = 0.1
"""Of the height above ground: tie points farther away do not show the ground at a point."""
CONTRADICTED_SIGMAS: Final = 4.0
_FILE_MAX_BYTES: Final = 5_000_000


class ControlPointsError(DaemonError, ValueError):
    """A table that cannot be used; the message names each mistake with its line."""


@dataclass(frozen=True)
class SurveyedPoints:
    """Points on the ground.

    Attributes:
        names, roles: of each; a role is `control` or `check`.
        geodetic: (n, 3), latitude and longitude, deg, height above the ellipsoid, m.
        sigma_m: (n, 3), east, north, up.
    """

    names: tuple[str, ...]
    roles: tuple[str, ...]
    geodetic: Array
    sigma_m: Array


@dataclass(frozen=True)
class ImageMeasurements:
    """Where exposures (m,) show points (m,): (m, 2) pixels of the stitched image, (m,) sigma."""

    exposure: Indices
    point: Indices
    px: Array
    sigma_px: Array


@dataclass(frozen=True)
class PointResidual:
    """Block minus survey at one point.

    Attributes:
        difference_m, sigma_m: east, north, up, and the standard deviation of the difference by the
            covariance of the block; None for what is not known.
        image_px: RMS of measured minus projected surveyed place, px; None without measurements.
        rays: images that measured it; 0: by the surface of `ties` tie points.
        reason: why nothing is known.
    """

    name: str
    role: str
    difference_m: tuple[float | None, float | None, float | None] = (None, None, None)
    sigma_m: tuple[float | None, float | None, float | None] = (None, None, None)
    image_px: float | None = None
    rays: int = 0
    ties: int = 0
    reason: str = ""

    def as_json(self) -> dict[str, Any]:
        return {**vars(self), "difference_m": [*self.difference_m], "sigma_m": [*self.sigma_m]}

    @property
    def is_contradicted(self) -> bool:
        """Whether a coordinate differs by more than `CONTRADICTED_SIGMAS`."""
        return any(
            d is not None and s is not None and abs(d) > CONTRADICTED_SIGMAS * s
            for d, s in zip(self.difference_m, self.sigma_m, strict=True)
        )


def read_surveyed(path: Path) -> SurveyedPoints:
    """The table of `syntopic triangulate --points`.

    Raises:
        ControlPointsError: with every mistake.
    """
    columns = ("point", "role", "latitude_deg", "longitude_deg", "height_m")
    rows, problems = _rows(path, columns)
    names = [row["point"] for _, row in rows]
    place = np.full((len(rows), 3), np.nan)
    sigma = np.full((len(rows), 3), SURVEYED_SIGMA_M)
    for k, (line, row) in enumerate(rows):
        if row["role"] not in ROLES:
            problems.append(f"line {line}: role is {row['role']!r}; control or check is right")
        if not row["point"] or names.index(row["point"]) != k:
            problems.append(f"line {line}: point {row['point']!r} is empty or given twice")
        for axis, column in enumerate(columns[2:]):
            place[k, axis] = _number(row, column, line, problems)
        for axis, column in enumerate(("sx_m", "sy_m", "sz_m")):
            if row.get(column):
                sigma[k, axis] = _number(row, column, line, problems)
        if abs(place[k, 0]) > 90.0 or abs(place[k, 1]) > 180.0 or not (sigma[k] > 0.0).all():
            problems.append(f"line {line}: latitude, longitude or a sigma is out of range")
    if problems or not rows:
        raise ControlPointsError(f"{path}: {'; '.join(problems[:10]) or 'it has no point'}")
    return SurveyedPoints(tuple(names), tuple(row["role"] for _, row in rows), place, sigma)


def read_measurements(path: Path, names: Sequence[str]) -> ImageMeasurements:
    """The table of `syntopic triangulate --measured`.

    Args:
        path: the file; images are named by the number of the exposure.
        names: of the points.

    Raises:
        ControlPointsError: with every mistake.
    """
    rows, problems = _rows(path, ("image", "point", "column_px", "row_px"))
    at = {name: k for k, name in enumerate(names)}
    values = np.full((len(rows), 5), math.nan)
    values[:, 4] = MEASURED_SIGMA_PX
    for k, (line, row) in enumerate(rows):
        values[k, 0] = _number(row, "image", line, problems)
        if row["point"] not in at:
            problems.append(f"line {line}: point {row['point']!r} is not there")
        values[k, 1] = at.get(row["point"], 0)
        for axis, column in ((2, "column_px"), (3, "row_px")):
            values[k, axis] = _number(row, column, line, problems)
        if row.get("sigma_px"):
            values[k, 4] = _number(row, "sigma_px", line, problems)
        if not values[k, 4] > 0.0:
            problems.append(f"line {line}: sigma_px is positive")
    if problems:
        raise ControlPointsError(f"{path}: {'; '.join(problems[:10])}")
    return ImageMeasurements(
        values[:, 0].astype(np.int64), values[:, 1].astype(np.int64), values[:, 2:4], values[:, 4]
    )


def residuals_of(
    live: LiveTriangulation,
    frame: LocalFrame,
    surveyed: SurveyedPoints,
    measured: ImageMeasurements | None = None,
) -> tuple[PointResidual, ...]:
    """Residuals at all points, by the last adjustment of the block."""
    if live.last is None:
        none = "no block was adjusted"
        pairs = zip(surveyed.names, surveyed.roles, strict=True)
        return tuple(PointResidual(name, role, reason=none) for name, role in pairs)
    place = frame.from_geodetic(*surveyed.geodetic.T)
    numbers = [live.images[k].number for k in live.last_images]
    index = {number: k for k, number in enumerate(numbers)}
    station = np.array([live.orientations[k].position_m for k in live.last_images])
    rotation = np.array([live.orientations[k].rotation for k in live.last_images])
    covariance = live.last.cameras.covariance() if measured is not None else np.zeros((0, 0))
    _, ties, ties_sigma = live.tied_points()
    found = []
    for p, (name, role) in enumerate(zip(surveyed.names, surveyed.roles, strict=True)):
        turn = frame.local_from_enu(*(float(v) for v in surveyed.geodetic[p, :2])).T
        if measured is not None:
            own = np.flatnonzero(measured.point == p)
            own = own[[int(n) in index for n in measured.exposure[own]]]
            image = np.array([index[int(n)] for n in measured.exposure[own]], np.int64)
            xy = image_mm(live.image, measured.px[own])
            pitch = live.image.pitch_mm
            point = measured_point(
                live.image.f_mm, station, rotation, image, xy, measured.sigma_px[own] * pitch
            )
            if point is not None:
                inner = turn @ point.covariance(covariance) @ turn.T
                spread = np.sqrt(np.diag(inner) + surveyed.sigma_m[p] ** 2)
                shown = projected_mm(live.image.f_mm, station[image], rotation[image], place[p])
                rms = float(np.sqrt(np.mean(np.sum(((xy - shown) / pitch) ** 2, axis=1))))
                found.append(
                    PointResidual(
                        name, role, _three(turn @ (point.xyz_m - place[p])), _three(spread),
                        rms, len(image),
                    )
                )  # fmt: skip
                continue
        above_m = float(station[:, 2].mean() - place[p, 2])
        found.append(
            _by_surface(name, role, place[p], ties, ties_sigma, surveyed.sigma_m[p, 2], above_m)
        )
    return tuple(found)


def control_json(residuals: Sequence[PointResidual]) -> dict[str, Any] | None:
    """Summary and points, as JSON types; None without points."""
    if not residuals:
        return None
    plan = [r for r in residuals if r.difference_m[0] is not None]
    height = [r for r in residuals if r.difference_m[2] is not None]
    return {
        "points": len(residuals),
        "in_plan": len(plan),
        "in_height": len(height),
        "rms_m": [_rms([r.difference_m[axis] for r in plan]) for axis in (0, 1)]
        + [_rms([r.difference_m[2] for r in height])],
        "expected_m": [_rms([r.sigma_m[axis] for r in plan]) for axis in (0, 1)]
        + [_rms([r.sigma_m[2] for r in height])],
        "rms_px": _rms([r.image_px for r in plan]),
        "residuals": [r.as_json() for r in residuals],
    }


def control_findings(
    residuals: Sequence[PointResidual], *, problem: str = ""
) -> list[TriangulationFinding]:
    """What contradicts the points, or why they cannot be used.

    Args:
        residuals: of all points.
        problem: of their tables.
    """
    if problem:
        return [
            TriangulationFinding(
                "CONTROL_NOT_READ",
                f"Control points cannot be used: {problem}. The accuracy is stated without them.",
            )
        ]
    wrong = [r for r in residuals if r.is_contradicted]
    known = [r for r in residuals if r.difference_m[2] is not None]
    if residuals and not known:
        return [
            TriangulationFinding(
                "CONTROL_NOT_IN_BLOCK",
                f"None of {len(residuals)} control points can be compared: {residuals[0].reason}. "
                "Check their coordinates.",
            )
        ]
    if not wrong:
        return []
    heights = [float(r.difference_m[2] or 0.0) for r in known]
    names = ", ".join(r.name for r in wrong[:8]) + (", ..." if len(wrong) > 8 else "")
    return [
        TriangulationFinding(
            "CONTROL_CONTRADICTED",
            f"{len(wrong)} of {len(known)} control points contradict the block ({names}); in "
            f"height the block lies {float(np.median(heights)):+.2f} m from all points (median). "
            "Check their coordinates, and whether their heights count from the ellipsoid.",
        )
    ]


def _by_surface(
    name: str,
    role: str,
    place: Array,
    ties: Array,
    ties_sigma: Array,
    survey_sigma_m: float,
    above_m: float,
) -> PointResidual:
    """Height of the plane through the nearest tie points, minus that of the point."""
    distance = np.hypot(*(ties[:, :2] - place[:2]).T) if len(ties) else np.zeros(0)
    near = np.argsort(distance)[:NEAREST]
    near = near[distance[near] < REACH_SHARE * above_m]
    step = (ties[near] - place) / max(REACH_SHARE * above_m, 1.0)
    is_around = len(near) > 0 and bool(
        ((step[:, :2].min(axis=0) < 0.0) & (step[:, :2].max(axis=0) > 0.0)).all()
    )
    if len(near) < NEAREST_MIN or not is_around:
        return PointResidual(
            name, role, ties=len(near),
            reason=f"{len(near)} tie points lie within {REACH_SHARE * above_m:.0f} m around it",
        )  # fmt: skip
    design = np.column_stack([np.ones(len(near)), step[:, :2]])
    height = ties[near, 2] - place[2]
    cofactor = np.linalg.pinv(design.T @ design)
    plane = cofactor @ design.T @ height
    scatter = height - design @ plane
    # Terrain about the plane; what all tie points have in common is their own sigma.
    terrain = float(scatter @ scatter) / (len(near) - 3)
    sigma = math.sqrt(
        terrain * (1.0 + cofactor[0, 0])
        + float(np.median(ties_sigma[near, 2])) ** 2
        + survey_sigma_m**2
    )
    return PointResidual(
        name, role, (None, None, float(plane[0])), (None, None, sigma), ties=len(near)
    )


def _rows(
    path: Path, columns: Sequence[str]
) -> tuple[list[tuple[int, Mapping[str, str]]], list[str]]:
    """Rows with their lines, and what is wrong with the file."""
    try:
        text = read_regular_file(path, _FILE_MAX_BYTES).decode("utf-8-sig")
    except (ForeignFileError, OSError, UnicodeDecodeError) as error:
        raise ControlPointsError(f"{path}: {error}") from error
    table = csv.reader(io.StringIO(text))
    header: list[str] = []
    rows: list[tuple[int, Mapping[str, str]]] = []
    problems: list[str] = []
    try:
        for cells in table:
            values = [cell.strip() for cell in cells]
            if not any(values) or values[0].startswith("#"):
                continue
            if not header:
                header = values
                absent = [column for column in columns if column not in header]
                if absent:
                    raise ControlPointsError(f"{path}: no column {', '.join(absent)}")
            elif len(values) != len(header):
                problems.append(f"line {table.line_num}: {len(values)} cells for {len(header)}")
            else:
                rows.append((table.line_num, dict(zip(header, values, strict=True))))
    except csv.Error as error:
        raise ControlPointsError(f"{path} line {table.line_num}: {error}") from error
    if not header:
        raise ControlPointsError(f"{path}: it is empty")
    return rows, problems


def _number(row: Mapping[str, str], column: str, line: int, problems: list[str]) -> float:
    try:
        value = float(row[column])
        if not math.isfinite(value):
            raise ValueError
    except ValueError:
        problems.append(f"line {line}: {column} is {row[column]!r}; a number is right")
        return 0.0
    return value


def _three(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


def _rms(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if known else None

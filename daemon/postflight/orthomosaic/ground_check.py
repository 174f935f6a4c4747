"""The ground of an orthomosaic against adjusted object points and against what the images see.

Limits are those of the check in flight (`daemon.onboard.triangulation.height_model_check`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.onboard.triangulation.findings import (
    GROUND_CHANGED_SHARE,
    TriangulationFinding,
)
from daemon.onboard.triangulation.height_model_check import HeightModelCheck, compare_heights
from daemon.orientation.georeference import Georeference
from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.orthomosaic.triangulated import ObjectPoints
from processing.geometry.terrain_rays import HeightModel
from processing.image.orthoimage.ground_resampling import ImagePose

Array = NDArray[np.float64]

UNCOVERED_SHARE: Final = 0.01
"""Of the ground that the images see."""
DIFFERENCE_M: Final = 1.0
DIFFERENCE_SIGMAS: Final = 3.0
_RAYS: Final = 5
"""Along each side of an image, at which it is asked whether the model has a height."""


@dataclass(frozen=True)
class GroundCheck:
    """What is wrong with the ground.

    Attributes:
        findings: named, with sentence and cure.
        heights: the comparison with object points; None without any.
        uncovered: share of the ground that images see and the model has no height for.
        unseen: images of which that is all.
    """

    findings: tuple[TriangulationFinding, ...] = ()
    heights: HeightModelCheck | None = None
    uncovered: float | None = None
    unseen: int = 0

    @property
    def is_wrong(self) -> bool:
        """Whether object points contradict the ground."""
        return any(one.name.endswith("_CONTRADICTED") for one in self.findings)

    def as_json(self) -> dict[str, Any]:
        """Figures as JSON types; lengths in m."""
        found: dict[str, Any] = {}
        if self.uncovered is not None:
            found |= {"uncovered": round(self.uncovered, 4), "images_without_ground": self.unseen}
        if self.heights is not None and self.heights.difference_m is not None:
            found["points_above_m"] = round(self.heights.difference_m, 2)
            found["points_off"] = round(self.heights.share_off, 3)
        return found


def check_ground(
    surface: HeightModel | float,
    georeference: Georeference,
    frame: LocalFrame,
    poses: Sequence[ImagePose],
    points: ObjectPoints | None,
    missing: Path | None = None,
) -> GroundCheck:
    """Compare the ground with object points, and a model with what the images see.

    Args:
        surface: heights of a model, or of a plane, in the system.
        georeference: of the surface.
        frame: of the poses.
        poses: of all images.
        points: adjusted object points; None without a triangulation.
        missing: the height model of the flight, if it is not there.
    """
    found = []
    heights = None
    if missing is not None:
        found.append(
            TriangulationFinding(
                "HEIGHT_MODEL_MISSING",
                f"The height model of the flight, {missing}, is not there. Give --elevation FILE.",
            )
        )
    if points is not None:
        heights = compare_heights(
            _heights_of(surface), georeference, points.geodetic, points.sigma_m
        )
    if not isinstance(surface, HeightModel):
        found += _of_plane(heights, points)
        return GroundCheck(tuple(found), heights)
    level = _level(surface, georeference, points)
    shares = np.array([_uncovered(surface, level, georeference, frame, pose) for pose in poses])
    uncovered, unseen = float(shares.mean()), int((shares == 1.0).sum())
    if uncovered > UNCOVERED_SHARE:
        without = f", and {unseen} of {len(shares)} images see none that has" if unseen else ""
        found.append(
            TriangulationFinding(
                "HEIGHT_MODEL_INCOMPLETE",
                f"The height model has no height for {100.0 * uncovered:.0f} % of the ground that "
                f"the images see{without}. The orthomosaic has no data there. Give a model of the "
                "whole block with --elevation.",
            )
        )
    found += _of_model(heights, georeference)
    return GroundCheck(tuple(found), heights, uncovered, unseen)


def _heights_of(surface: HeightModel | float) -> Any:
    if isinstance(surface, HeightModel):
        return surface
    return lambda places: np.full(len(places), surface)


def _of_plane(
    check: HeightModelCheck | None, points: ObjectPoints | None
) -> list[TriangulationFinding]:
    if check is None or points is None or check.difference_m is None:
        return []
    # Relief is no contradiction: half of the points lie higher than a right plane.
    relief_m = float(np.std(points.geodetic[:, 2]))
    if not check.is_contradicted or abs(check.difference_m) <= relief_m:
        return []
    unit = "" if check.unit is None else f", as if its height were in {check.unit}"
    return [
        TriangulationFinding(
            "GROUND_HEIGHT_CONTRADICTED",
            f"Tie points lie {check.difference_m:+.1f} m from the plane (median, limit "
            f"{check.limit_m:.1f} m){unit}. Leave --ground-height out for the plane of the tie "
            "points, or give --elevation FILE.",
        )
    ]


def _of_model(
    check: HeightModelCheck | None, georeference: Georeference
) -> list[TriangulationFinding]:
    if check is None or check.difference_m is None:
        return []
    share = f"{100.0 * check.share_off:.0f} %"
    if check.arrangement:
        text = check.arrangement_sentence("--elevation")
        return [TriangulationFinding("HEIGHT_MODEL_CONTRADICTED", text)]
    if not check.is_contradicted:
        if check.share_off < GROUND_CHANGED_SHARE:
            return _of_difference(check)
        return [
            TriangulationFinding(
                "GROUND_CHANGED",
                f"{share} of the tie points lie more than {check.limit_m:.1f} m from the height "
                "model, the others fit: it is older than the ground there, or without its "
                "buildings and trees. Do not rely on places there, or give a newer model with "
                "--elevation.",
            )
        ]
    begin = (
        f"Tie points lie {check.difference_m:+.1f} m from the height model (median, limit "
        f"{check.limit_m:.1f} m)"
    )
    if check.unit is not None:
        text = f"{begin}, as if its heights were in {check.unit}. Convert them to metres."
    elif check.share_off < GROUND_CHANGED_SHARE:
        text = (
            f"{begin}, everywhere by about the same: its heights count from another zero, such as "
            "the geoid, or it shows other ground. Those of the orientations count from: "
            f"{georeference.height_system}. Convert the model, or triangulate in its system, such "
            "as --crs EPSG:25833+7837."
        )
    else:
        text = (
            f"{begin}, {share} of them by other amounts: the model shows other ground, or lies "
            "elsewhere. Check its coordinate system, its origin and the order of its rows."
        )
    return [TriangulationFinding("HEIGHT_MODEL_CONTRADICTED", text)]


def _of_difference(check: HeightModelCheck) -> list[TriangulationFinding]:
    """A model that fits within the limit, and lies off the points nevertheless."""
    sigma = check.sigma_m or 0.0
    if check.difference_m is None or abs(check.difference_m) <= max(
        DIFFERENCE_M, DIFFERENCE_SIGMAS * sigma
    ):
        return []
    return [
        TriangulationFinding(
            "HEIGHT_MODEL_DIFFERS",
            f"Tie points lie {check.difference_m:+.1f} m from the height model (median; their "
            f"standard deviation is {sigma:.1f} m): places far from the nadir of their image are "
            "displaced. Trees and buildings that the model leaves out do this, or a model that is "
            "slightly elsewhere. Check its zero and its origin.",
        )
    ]


def _level(surface: HeightModel, georeference: Georeference, points: ObjectPoints | None) -> float:
    """Height above the ellipsoid of the ground, roughly."""
    if points is not None:
        return float(np.median(points.geodetic[:, 2]))
    height, width = surface.height_m.shape
    middle = np.array(
        [[
            surface.x_m + surface.step_x_m * (width - 1) / 2.0,
            surface.y_m + surface.step_y_m * (height - 1) / 2.0,
            float(np.nanmean(surface.height_m)),
        ]]
    )  # fmt: skip
    return float(georeference.geodetic(middle)[0, 2])


def _uncovered(
    surface: HeightModel,
    level_m: float,
    georeference: Georeference,
    frame: LocalFrame,
    pose: ImagePose,
) -> float:
    """Share of an image's rays that meet the level ground where the model has no height."""
    x, y = pose.principal
    columns, rows = np.meshgrid(
        (np.arange(_RAYS) + 0.5) / _RAYS * pose.width_px - 0.5,
        (np.arange(_RAYS) + 0.5) / _RAYS * pose.height_px - 0.5,
    )
    down = np.full(columns.size, -pose.f_mm / pose.pixel_mm)
    rays = np.column_stack([(columns - x).ravel(), (y - rows).ravel(), down]) @ pose.rotation.T
    above = float(frame.to_geodetic(pose.centre_m[None])[0, 2]) - level_m
    up = frame.local_from_enu(*map(float, frame.to_geodetic(pose.centre_m[None])[0, :2]))[:, 2]
    points = pose.centre_m + rays * (above / np.maximum(-rays @ up, 1e-9))[:, None]
    unknown = 0
    for latitude, longitude, height in frame.to_geodetic(points):
        place = georeference.place(float(latitude), float(longitude), float(height))
        unknown += not np.isfinite(surface.at(np.array([[place.east_m, place.north_m]]))[0])
    return unknown / len(points)

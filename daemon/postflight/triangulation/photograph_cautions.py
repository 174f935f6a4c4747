"""What a reader has to know about an adjusted block of photographs, one sentence each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from daemon.postflight.triangulation.photograph_project import OWN_INTERIOR_MIN

_ROLL_MAX_DEG: Final = 1.0
_SCALE_MAX_PERCENT: Final = 1.0
_OFF_NADIR_MAX_DEG: Final = 30.0
_CONTROL_OF_PLACE: Final = 3
"""Control points that place a block without positions."""
_HEIGHTS: Final = {
    "none": (
        "EXIF has no heights: positions are taken at 0 m, so that all heights are below the flight "
        "and lines of different height tilt the block. Give control points (--points)"
    ),
    "RelativeAltitude": (
        "heights are above the takeoff point (RelativeAltitude of XMP), not above the ellipsoid. "
        "Control points place them (--points)"
    ),
}


def photograph_cautions(section: Mapping[str, Any]) -> list[str]:
    """Cautions of the report.

    Args:
        section: that of the photographs, as `photographs_section` returns it.

    Returns:
        Complete sentences.
    """
    found = [*section["left_out"], *section["wrong_positions"]]
    found += section["control_not_measured"]
    if section["position_shift_m"] is None and section["height_source"] in _HEIGHTS:
        found.append(_HEIGHTS[section["height_source"]])
    unused = section["unused_control"]
    if unused:
        found.append(
            f"{len(unused)} measurements of control are in photographs that are not in the block: "
            f"{'; '.join(unused[:5])}{'; ...' if len(unused) > 5 else ''}"
        )
    if section["control_rejected"]:
        found.append(
            f"control rejected by the adjustment: {', '.join(section['control_rejected'])}; check "
            "coordinates and measurements of these points"
        )
    if section["control_measurements_rejected"]:
        listed = ", ".join(
            f"{one['point']} {one['rejected']} of {one['measured']}"
            for one in section["control_measurements_rejected"]
        )
        found.append(
            f"measurements of control rejected by the adjustment: {listed}; check the coordinates "
            "of these points and where the photographs show them"
        )
    if not section["f_and_height_separated"] and section["ground_sigma_of_f_m"] > 0.0:
        used = section["control_points"]
        how = f"by {used} control points" if used else "without control"
        found.append(
            f"f and height are not separated {how}: a change of f by 1 % "
            f"({0.01 * section['f_px']:.0f} px) moves the ground by "
            f"{section['height_per_percent_m']:.2f} m, and the standard deviation of f, "
            f"{section['f_sigma_px']:.1f} px, by {section['ground_sigma_of_f_m']:.2f} m "
            f"(correlation {section['f_ground_correlation']:.2f}). Give three control points or "
            "more, spread over the block (--points)"
        )
    if section["principal_point_free"] is None and section["f_sigma_px"] > 0.0:
        found.append(
            "the principal point is held in the middle, and these photographs do not determine it: "
            "stated standard deviations hold for these parameters only. Lines across, two heights "
            "or control points determine it"
        )
    if section["control_points"] < _CONTROL_OF_PLACE:
        found += _placing_cautions(section)
    if section["off_nadir_deg"] > _OFF_NADIR_MAX_DEG:
        found.append(
            f"photographs look {section['off_nadir_deg']:.0f} degrees off the vertical (median), "
            "as around an object: in an orthomosaic objects lean and hide the ground behind them. "
            "Vertical photographs show it"
        )
    for camera in section["cameras"]:
        found += _camera_cautions(camera, is_only=len(section["cameras"]) == 1)
    return found


def _placing_cautions(section: Mapping[str, Any]) -> list[str]:
    """How little positions fix attitude and scale of the block."""
    found = []
    extent = f"{section['position_extent_m']:.0f} m"
    if section["roll_sigma_deg"] > _ROLL_MAX_DEG:
        degrees = f"{section['roll_sigma_deg']:.1f} degrees"
        slope = "so that the ground may slope by as much"
        found.append(
            f"positions of EXIF are nearly on one line: they fix the roll of the block about it to "
            f"{degrees} only, {slope}. Fly a second line or give three control points (--points)"
            if section["positions_on_a_line"]
            else f"positions of EXIF are within {extent}: their heights fix the tilt of the block "
            f"to {degrees} only, {slope}. Fly over a larger area or give three control points "
            "(--points)"
        )
    if section["scale_sigma_percent"] > _SCALE_MAX_PERCENT:
        found.append(
            f"positions of EXIF are within {extent}: they fix the scale of the block to "
            f"{section['scale_sigma_percent']:.1f} % only, and lengths and heights err by as much. "
            "Fly over a larger area or give three control points (--points)"
        )
    return found


def _camera_cautions(section: Mapping[str, Any], *, is_only: bool) -> list[str]:
    of = "" if is_only else f"{section['camera']}: "
    found = []
    if not is_only and section["photographs"] < OWN_INTERIOR_MIN:
        found.append(
            f"{of}{section['photographs']} photographs do not determine an interior orientation of "
            "their own; the one from EXIF is an observation"
        )
    if section["f_depends_on_principal_point"]:
        free = section["principal_point_free"]
        x, y = free["point_px"]
        found.append(
            f"{of}the principal point is held in the middle; estimated, it moves by {x:.0f} "
            f"columns and {y:.0f} rows and changes f by {free['change_px']:+.0f} px, "
            f"{abs(free['change_px']) / section['f_sigma_px']:.0f} times the standard deviation of "
            "f: stated standard deviations hold for these parameters only. Lines across, two "
            "heights or control points separate them"
        )
    elif section["f_hardly_separated_from_point"]:
        free = section["principal_point_free"]
        x, y = free["point_sigma_px"]
        found.append(
            f"{of}the standard deviation of f, {section['f_sigma_px']:.2f} px, holds for a "
            f"principal point in the middle; with an estimated one it is {free['f_sigma_px']:.2f} "
            f"px, for these photographs determine the point to {x:.1f} columns and {y:.1f} rows "
            "only. Take the larger one where the camera's principal point is not known; "
            "photographs turned by 90 degrees, two heights or control points separate them"
        )
    drift = abs(section["f_px"] / section["f_exif_px"] - 1.0)
    if drift > 0.05:
        found.append(
            f"{of}f was adjusted by {100 * drift:.0f} % against EXIF "
            f"({section['f_exif_px']:.0f} px to {section['f_px']:.0f} px)"
        )
    return found

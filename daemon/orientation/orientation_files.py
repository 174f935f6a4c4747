"""Exterior orientations in the forms that other programs read: CSV, PAT-B, BINGO's angles.

One file of every set states coordinate system, heights, angles and trajectory;
for formats without comments it is a separate file (`about.txt`).
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from daemon.configuration.model import MountSection
from daemon.orientation.exterior_orientation import ExteriorOrientation, MissingOrientation
from daemon.orientation.georeference import Georeference
from processing.geometry.rotation import phi_omega_kappa
from processing.rig import VIRTUAL_CAMERA, Cone, Rig

GON_PER_RAD = 200.0 / math.pi
PATB_CONE_STEP = 100
"""A PAT-B photo number is that of the exposure times this, plus the cone's place in the rig."""

CSV_COLUMNS = (
    *("image", "exposure", "cone", "line", "strip", "gps_ns"),
    *("east_m", "north_m", "height_m"),
    *("omega_deg", "phi_deg", "kappa_deg", "latitude_deg", "longitude_deg"),
    *("ellipsoidal_height_m", "grid_scale", "method", "horizontal_sigma_m", "vertical_sigma_m"),
)


@dataclass(frozen=True)
class OrientationSetInfo:
    """Properties common to a set of orientations."""

    mission: str
    rig: Rig
    simulated: bool
    trajectory: str
    mount: MountSection
    georeference: Georeference
    footprints: str = "on level ground"


def header_lines(about: OrientationSetInfo) -> list[str]:
    """Notes on the use of the numbers; one fact a line."""
    system, mount = about.georeference, about.mount
    antenna = ", ".join(f"{value:g}" for value in mount.antenna_m)
    boresight = ", ".join(f"{value:g}" for value in mount.boresight_deg)
    accuracy = f"{system.accuracy_m:g} m" if system.accuracy_m >= 0 else "not known"
    return [
        f"exterior orientation of mission {about.mission}, rig {about.rig.name}",
        *(["SIMULATED: emulated hardware, no survey"] if about.simulated else []),
        *([] if about.rig.is_calibrated else ["UNCALIBRATED: the camera's geometry is nominal"]),
        f"trajectory: {about.trajectory}",
        f"coordinate system: {system.name} ({system.crs.name}), metres",
        f"heights: {system.height_system}",
        f"transformation from WGS 84: {system.operation}, accuracy {accuracy}",
        "angles: R = Rx(omega) Ry(phi) Rz(kappa), from camera to grid; kappa counts from the grid",
        "camera axes: x right, y forward (nominal flight direction), z up; image plane at z = -f",
        "not corrected for earth curvature, refraction and the scale of the grid (grid_scale)",
        f"lever arm to the antenna, body forward right down, m: {antenna}",
        f"boresight roll pitch heading, deg: {boresight}",
    ]


def csv_text(about: OrientationSetInfo, oriented: Sequence[ExteriorOrientation]) -> str:
    """Comma-separated, the header behind `#`."""
    text = io.StringIO()
    text.writelines(f"# {line}\n" for line in header_lines(about))
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for eo in oriented:
        omega, phi, kappa = eo.omega_phi_kappa_deg
        writer.writerow(
            [
                *(eo.name, eo.exposure, eo.cone, eo.line_id, eo.strip_id, eo.gps_ns),
                *(f"{value:.4f}" for value in eo.centre_m),
                *(f"{angle:.7f}" for angle in (omega, phi, kappa)),
                *(f"{eo.latitude_deg:.10f}", f"{eo.longitude_deg:.10f}", f"{eo.height_m:.4f}"),
                *(f"{eo.scale:.9f}", eo.method),
                *(_metres(eo.horizontal_sigma_m), _metres(eo.vertical_sigma_m)),
            ]
        )
    return text.getvalue()


def _metres(value: float | None) -> str:
    """Empty where it is not known."""
    return "" if value is None else f"{value:.4f}"


def patb_text(about: OrientationSetInfo, oriented: Sequence[ExteriorOrientation]) -> str:
    """PAT-B: three records a photo (I16,16x,3F16.5 / 5F16.12 / 4F16.12), R by rows."""
    lines = []
    for eo in oriented:
        east, north, height = (float(value) for value in eo.centre_m)
        r = [float(value) for value in eo.rotation.reshape(-1)]
        lines.append(
            f"{patb_number(about.rig, eo):16d}{'':16}{east:16.5f}{north:16.5f}{height:16.5f}"
        )
        lines.append("".join(f"{value:16.12f}" for value in r[:5]))
        lines.append("".join(f"{value:16.12f}" for value in r[5:]))
    return "\n".join(lines) + "\n"


def bingo_text(about: OrientationSetInfo, oriented: Sequence[ExteriorOrientation]) -> str:
    """Name, X, Y, Z, and phi, omega, kappa in gon of R = Ry(phi) Rx(omega) Rz(kappa)."""
    lines = []
    for eo in oriented:
        place = "".join(f" {value:14.4f}" for value in eo.centre_m)
        angles = "".join(f" {angle * GON_PER_RAD:12.6f}" for angle in phi_omega_kappa(eo.rotation))
        lines.append(f"{eo.name}{place}{angles}")
    return "\n".join(lines) + "\n"


def about_text(
    about: OrientationSetInfo,
    oriented: Sequence[ExteriorOrientation],
    missing: Sequence[MissingOrientation],
) -> str:
    """The header, what each file of the set is, and which exposures are not in it."""
    numbers = [f"  {patb_number(about.rig, eo)}  {eo.name}" for eo in oriented]
    absent = [f"  {one.exposure:06d} {one.cone}: {one.reason}" for one in missing]
    return "\n".join(
        [
            *header_lines(about),
            "",
            "orientation.csv      omega, phi, kappa in degrees",
            "orientation.ori      PAT-B: photo number, X, Y, Z; rotation, image to grid, by rows",
            "orientation.bingo    phi, omega, kappa in gon, R = Ry(phi) Rx(omega) Rz(kappa)",
            f"footprints.geojson   {about.footprints}, WGS 84",
            "items.json           the same as STAC items with their images",
            "",
            "not oriented:" if absent else "all exposures are oriented",
            *absent,
            "",
            "PAT-B photo numbers:",
            *numbers,
            "",
        ]
    )


def patb_number(rig: Rig, eo: ExteriorOrientation) -> int:
    """The number PAT-B knows an image by."""
    names = [*(cone.name for cone in rig.cones), VIRTUAL_CAMERA]
    return eo.exposure * PATB_CONE_STEP + names.index(eo.cone)


def image_extent_mm(rig: Rig, cone: Cone, *, is_virtual: bool) -> tuple[float, float, float, float]:
    """Left, bottom, right, top of the image in its plane, mm: the stitched one or all sensors'."""
    virtual = rig.virtual_image
    if is_virtual and virtual is not None:
        half_width = virtual.width_px * virtual.pitch_mm / 2
        half_height = virtual.height_px * virtual.pitch_mm / 2
        return -half_width, -half_height, half_width, half_height
    halves = [(s, s.width_px * s.pitch_mm / 2, s.height_px * s.pitch_mm / 2) for s in cone.sensors]
    return (
        min(s.x_mm - width for s, width, _ in halves),
        min(s.y_mm - height for s, _, height in halves),
        max(s.x_mm + width for s, width, _ in halves),
        max(s.y_mm + height for s, _, height in halves),
    )


def certificate(rig: Rig) -> Mapping[str, object]:
    """The virtual camera as it goes into other programs: a frame camera without distortion.

    Axes and signs are stated in words, because every program has its own.
    """
    virtual = rig.virtual_image
    if virtual is None:
        return {}
    width_mm, height_mm = virtual.width_px * virtual.pitch_mm, virtual.height_px * virtual.pitch_mm
    return {
        "camera": rig.title,
        "rig": rig.name,
        "serial_numbers": {s.name: s.serial for s in rig.sensors if s.serial},
        "lenses": {cone.name: cone.lens.serial for cone in rig.cones if cone.lens.serial},
        "calibration": {"id": rig.calibration_id, "date": rig.calibration_date},
        "principal_distance_mm": virtual.f_mm,
        "principal_point_mm": [0.0, 0.0],
        "distortion": "none: removed when the image was made",
        "width_px": virtual.width_px,
        "height_px": virtual.height_px,
        "pixel_size_um": virtual.pitch_um,
        "format_mm": [width_mm, height_mm],
        "axes": (
            "x to the right, y up (nominal flight direction), origin at the principal point, which "
            "is the centre of the image; column = x / pixel + (width - 1) / 2, "
            "row = (height - 1) / 2 - y / pixel, whole numbers at pixel centres; the camera looks "
            "along -z"
        ),
        "valid": (
            "for images stitched with this calibration, as long as quality.json of an exposure "
            "does not say CALIBRATION_EXPIRED"
        )
        if rig.is_calibrated
        else "not: the rig is uncalibrated, its values are nominal",
    }

"""`syntopic calibrate platform`: mountings found by flown exposures become a rig file.

The averaging is in `processing.calibration.platform`; here the missions are read, and the
report is built.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.layout import Mission
from daemon.postflight.calibration.calibration_report import (
    CalibrationReport,
    Plot,
    Previous,
    Quantity,
    ReportTable,
    changes_between,
    serial_warnings,
)
from daemon.postflight.calibration.rig_writer import rig_toml
from daemon.postflight.calibration.thermal_calibration import stitching_of
from daemon.postflight.plots import Curve, chart_svg
from processing.calibration.platform import (
    MIN_EXPOSURES,
    CalibratedConeMounting,
    PlatformCalibration,
    confounding_effect,
    min_exposures,
    shift_px,
)
from processing.mosaic.stitch_record import StitchRecord
from processing.rig import Rig, load_rig

Array = NDArray[np.float64]

KIND = "platform"
UNCERTAIN_MOUNTING_RAD = 20e-6
"""Rotation between exposures, beyond what tie points explain, that is reported."""
_ANGLES = ("omega", "phi", "kappa")


class PlatformCalibrationError(DaemonError, ValueError):
    """Missions a platform cannot be calibrated from; the message states what would be right."""


@dataclass(frozen=True)
class PlatformMissions:
    """The stitching of missions flown with one rig file; `skipped` are messages."""

    rig: Rig
    missions: tuple[str, ...]
    records: tuple[StitchRecord, ...]
    skipped: tuple[str, ...]


def read_missions(missions: Sequence[Path]) -> PlatformMissions:
    """The stitching records of missions, flights or laboratory images alike.

    Raises:
        PlatformCalibrationError: different calibrations, or too few exposures.
        processing.rig.RigError: a mission's rig file cannot be used.
    """
    rig: Rig | None = None
    records, skipped, names = [], [], []
    for path in missions:
        mission = Mission.open(path)
        own = load_rig(mission.rig_path)
        rig = rig or own
        if own != rig:
            raise PlatformCalibrationError(
                f"{mission.id} was flown with {own.name} {own.calibration_id!r}, the missions "
                f"before it with {rig.name} {rig.calibration_id!r}; give missions of one rig file"
            )
        names.append(mission.id)
        for number in mission.numbers():
            record = stitching_of(mission, number)
            if isinstance(record, str):
                skipped.append(record)
            else:
                records.append(record)
    if rig is not None and rig.virtual_image is None:
        raise PlatformCalibrationError(
            f"{rig.name} has no [virtual_image], and its images are not stitched; use `syntopic "
            "calibrate flight` for its lenses and the angles of its heads"
        )
    minimum = MIN_EXPOSURES if rig is None else min_exposures(rig)
    if rig is None or len(records) < minimum:
        raise PlatformCalibrationError(
            f"{len(records)} exposures with a stitching record; {minimum} at least are "
            "needed: process the missions first (syntopic process MISSION)"
        )
    return PlatformMissions(rig, tuple(names), tuple(records), tuple(skipped))


def quantities_of(calibration: PlatformCalibration) -> tuple[Quantity, ...]:
    """The angles of every cone with their standard deviations, degrees."""
    return tuple(
        Quantity(cone.cone, name, "deg", math.degrees(angle), math.degrees(sigma))
        for cone in calibration.cones
        for name, angle, sigma in zip(_ANGLES, cone.angles_rad, cone.angles_sigma_rad, strict=True)
    )


def quantities_of_rig(rig: Rig) -> tuple[Quantity, ...]:
    """The same as the rig file flown with has them."""
    return tuple(
        Quantity(
            cone.name,
            name,
            "deg",
            math.degrees(angle),
            math.degrees(cone.rotation_sigma_urad * 1e-6),
        )
        for cone in rig.cones
        for name, angle in zip(_ANGLES, cone.rotation_rad, strict=True)
    )


def report_of(
    flown: PlatformMissions,
    calibration: PlatformCalibration,
    *,
    calibration_id: str,
    date: str,
    previous: Previous | None,
) -> CalibrationReport:
    """The calibration report; compared with the rig flown with, or a previous one."""
    rig, quantities = flown.rig, quantities_of(calibration)
    before = quantities_of_rig(rig) if previous is None else previous.quantities
    return CalibrationReport(
        kind=KIND,
        title=f"Platform calibration of {rig.name}",
        calibration_id=calibration_id,
        date=date,
        facts=(
            ("missions", ", ".join(flown.missions)),
            ("exposures", str(len(flown.records))),
            ("passed over", str(len(flown.skipped))),
            ("flown with", rig.calibration_id),
            ("datum", _datum(rig)),
        ),
        serials=rig.serials,
        quantities=quantities,
        figures={
            "exposures": {c.cone: len(c.corrections) for c in calibration.cones},
            "rotation_urad": {
                c.cone: [float(v) for v in c.correction_rad * 1e6] for c in calibration.cones
            },
            "turn_sigma_urad": {
                c.cone: [float(v) for v in c.correction_sigma_rad * 1e6] for c in calibration.cones
            },
            "with_places_urad": {
                c.cone: [float(v) for v in np.sqrt(np.diag(c.covariance)) * 1e6]
                for c in calibration.cones
            },
            "shift_px": {c.cone: shift_px(rig, c.correction_rad) for c in calibration.cones},
            "missing": list(calibration.missing),
        },
        verdicts=tuple(_verdict(rig, cone) for cone in calibration.cones),
        warnings=_warnings(flown, calibration, previous, rig.serials),
        tables=(
            _angles(calibration),
            _rotations(rig, calibration),
            _inseparable_parameters(flown, calibration),
        ),
        plots=tuple(_plot(cone) for cone in calibration.cones),
        previous=rig.calibration_id if previous is None else previous.calibration_id,
        changes=changes_between(before, quantities),
    )


def rig_file(rig: Rig, flown: PlatformMissions, *, date: str) -> bytes:
    """The new rig file; it states its origin."""
    remark = (
        f"{rig.name}, by `syntopic calibrate platform` on {date} from {len(flown.records)} "
        f"exposures of\n{', '.join(flown.missions)}, in place of calibration "
        f"{flown.rig.calibration_id}.\nIt counts only where it is configured. Angles of the cones "
        "are new; all else is as it was."
    )
    return rig_toml(rig, remark=remark)


def _datum(rig: Rig) -> str:
    if rig.has_virtual_camera:
        return "the mean turn of the PAN heads against the calibration flown with is zero"
    return f"the layer of the master cone {rig.master_cone}"


def _verdict(rig: Rig, cone: CalibratedConeMounting) -> str:
    return (
        f"cone {cone.cone}: rotated by {np.linalg.norm(cone.correction_rad) * 1e6:.1f} urad "
        f"({shift_px(rig, cone.correction_rad):.2f} px), known to "
        f"{float(np.max(cone.correction_sigma_rad)) * 1e6:.1f} urad from {len(cone.corrections)} "
        "exposures"
    )


def _warnings(
    flown: PlatformMissions,
    calibration: PlatformCalibration,
    previous: Previous | None,
    serials: dict[str, str],
) -> list[str]:
    warnings = [] if previous is None else serial_warnings(previous, serials)
    if not flown.rig.is_calibrated:
        warnings.append(
            f"{flown.rig.name} is uncalibrated: the angles hold for its nominal lenses, and it "
            "stays "
            "uncalibrated. Calibrate the lenses (syntopic calibrate flight, or calibrate board), "
            "and process the mission again with the new rig file"
        )
    if calibration.missing:
        warnings.append(
            f"no or too few exposures contain cone {', '.join(calibration.missing)} (across the "
            "flight axis their height above ground must be known): its angles are unchanged"
        )
    warnings += [
        f"cone {c.cone}: {c.left_out} of {c.left_out + len(c.used)} exposures left out, far off "
        "the others"
        for c in calibration.cones
        if c.left_out
    ]
    if flown.rig.timing == "syntopic":
        warnings.append(
            "the cones fire one after the other: the rotation of the aircraft in between is part "
            "of the angles as far as it does not average out; fly long and calm, and lines both "
            "ways, which take out the crab of the wind. A speed, delay or crab that is always "
            "off the same way stays in (see the table)"
        )
    warnings += [
        f"cone {c.cone} rotates by up to {float(np.max(c.unexplained_rad)) * 1e6:.0f} urad from "
        "exposure to exposure, more than tie points explain: a loose head"
        for c in calibration.cones
        if flown.rig.timing != "syntopic"
        and flown.rig.cone(c.cone).role == "pan"
        and (c.unexplained_rad > UNCERTAIN_MOUNTING_RAD).any()
    ]
    return warnings


def _angles(calibration: PlatformCalibration) -> ReportTable:
    rows = [
        (
            cone.cone,
            *(
                text
                for angle, sigma in zip(cone.angles_rad, cone.angles_sigma_rad, strict=True)
                for text in (f"{math.degrees(angle):.5f}", f"{math.degrees(sigma):.5f}")
            ),
        )
        for cone in calibration.cones
    ]
    return ReportTable(
        "Angles of the cones, deg (R = Rx(omega) Ry(phi) Rz(kappa))",
        ("cone", "omega", "\u00b1", "phi", "\u00b1", "kappa", "\u00b1"),
        rows,
        "With how well the place of the sensor in its head is calibrated.",
    )


def _rotations(rig: Rig, calibration: PlatformCalibration) -> ReportTable:
    rows = [
        (
            cone.cone,
            *(
                text
                for rotation, sigma in zip(
                    cone.correction_rad, cone.correction_sigma_rad, strict=True
                )
                for text in (f"{rotation * 1e6:.2f}", f"{sigma * 1e6:.2f}")
            ),
            f"{shift_px(rig, cone.correction_rad):.3f}",
            " ".join(f"{s * 1e6:.1f}" for s in cone.scatter_rad),
        )
        for cone in calibration.cones
    ]
    axes = ("about x", "\u00b1", "about y", "\u00b1", "about z", "\u00b1")
    return ReportTable(
        "Turns against the calibration flown with, urad (x right, y forward, z up)",
        ("cone", *axes, "px", "scatter of one exposure"),
        rows,
        "Sensors' places in their heads taken as calibrated.",
    )


def _inseparable_parameters(
    flown: PlatformMissions, calibration: PlatformCalibration
) -> ReportTable:
    rows = []
    for cone in calibration.cones:
        used = [flown.records[k] for k in cone.used]
        found = confounding_effect(flown.rig, flown.rig.cone(cone.cone), used)
        parts = (found.places, found.speed, found.crab, found.height)
        rows.append((cone.cone, *(_about(part) for part in parts)))
    return ReportTable(
        "Errors indistinguishable from a rotation, urad about x, y, z",
        ("cone", "places, one sigma", "speed or delay 1 %", "crab 1 deg", "height 1 %"),
        rows,
        "Places are within the standard deviations of the angles; so is 2 % of height. A turn of "
        "all cones together, and a move of all sensors of the datum together, cannot be seen: "
        "they are the boresight's (syntopic calibrate boresight) and the laboratory's.",
    )


def _about(correction_rad: Array) -> str:
    return " ".join("0" if v == 0.0 else f"{v * 1e6:.2f}" for v in correction_rad)


def _plot(cone: CalibratedConeMounting) -> Plot:
    x = np.array(cone.used, np.float64) + 1.0
    curves = [
        Curve(f"about {axis}", x, cone.corrections[:, k] * 1e6, joined=False)
        for k, axis in enumerate("xyz")
    ]
    title = f"Cone {cone.cone}: rotations of single exposures"
    return Plot(title, chart_svg(title, ("exposure", "urad"), curves))

"""The report and the rig file of a calibration from a flight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from daemon.postflight.calibration.calibration_report import (
    CalibrationReport,
    Plot,
    Previous,
    ReportTable,
    changes_between,
    correlation_table,
    serial_warnings,
)
from daemon.postflight.calibration.flight.findings import FlightFindings
from daemon.postflight.calibration.flight.frames import FlightFrames
from daemon.postflight.calibration.head_parameters import (
    covariance_of,
    estimated_parameters,
    parameter_table,
    quantities_of,
)
from daemon.postflight.calibration.laboratory.laboratory_series import part_serials
from daemon.postflight.calibration.rig_writer import rig_toml
from daemon.postflight.plots import vectors_svg
from processing.bundle.adjustment_results import systematic_residuals
from processing.calibration.flight.adjustment import FlightCalibration
from processing.rig import Rig

KIND: Final = "flight"
_CELLS: Final = (12, 8)
_NAMES: Final = {"dx0": "x", "dy0": "y", "df": "f"}


def flight_report(
    found: FlightCalibration,
    frames: FlightFrames,
    findings: FlightFindings,
    *,
    calibration_id: str,
    date: str,
    previous: Previous | None,
) -> CalibrationReport:
    """Build the report."""
    quantities, rows = quantities_of(found), estimated_parameters(found)
    serials = part_serials(found.rig, {found.rig.cone(h).sensors[0].name for h in found.heads})
    result = found.adjustment
    gnss = result.network.gnss
    turned = np.einsum("nij,nj->ni", result.state.attitude[gnss.attitude], gnss.lever_m)
    away = result.state.station[gnss.station] + turned - gnss.position_m
    return CalibrationReport(
        kind=KIND,
        title=f"Calibration of {found.rig.name} from a flight",
        calibration_id=calibration_id,
        date=date,
        facts=(
            ("missions", ", ".join(frames.missions)),
            ("exposures", f"{found.exposures} of {frames.available}"),
            ("rig", f"{found.before.name}, calibration {found.before.calibration_id}"),
            ("heads", ", ".join(found.heads)),
            ("datum", f"positions of the exposures; mounting of {found.reference} as it was"),
            ("state", "uncalibrated" if findings.blocking else "calibrated"),
        ),
        serials=serials,
        quantities=quantities,
        figures={
            "sigma_px": found.sigma_px,
            "exposures": found.exposures,
            "images": len(result.network.images.names),
            "points": len(result.network.points.names),
            "image_points": len(result.network.image_points.image),
            "redundancy": result.redundancy,
            "position_rms_m": [float(v) for v in np.sqrt(np.mean(away**2, axis=0))],
            "common_points": {f"{a} {b}": n for (a, b), n in found.common.items()},
            "share_of_prior": {head: found.shares_of_prior(head) for head in found.heads},
            "distortion_sigma_px": {h: found.distortion_sigma_px(h) for h in found.heads},
            "pointing_sigma_px": {h: found.pointing_sigma_px(h) for h in found.oriented_heads},
            "stays_uncalibrated": bool(findings.blocking),
        },
        verdicts=_verdicts(found, findings),
        warnings=[
            *findings.blocking,
            *findings.warnings,
            *([] if previous is None else serial_warnings(previous, serials)),
        ],
        tables=(
            parameter_table(rows, quantities),
            _separation(found),
            correlation_table(rows, covariance_of(found, rows)),
        ),
        plots=tuple(_plot(found, k) for k in range(len(found.heads))),
        previous=None if previous is None else previous.calibration_id,
        changes=() if previous is None else changes_between(previous.quantities, quantities),
    )


def calibrated_rig(
    found: FlightCalibration, frames: FlightFrames, findings: FlightFindings, *, date: str
) -> Rig:
    """The new rig, at the temperatures of the flight; without a date where something is open."""
    cones = []
    for cone in found.rig.cones:
        mean_c = frames.temperature_c.get(cone.probe)
        if cone.name in found.heads and mean_c is not None:
            sensor = replace(cone.sensors[0], calibration_c=mean_c)
            cone = replace(cone, calibration_c=mean_c, sensors=(sensor,))
        cones.append(cone)
    return replace(
        found.rig, cones=tuple(cones), calibration_date="" if findings.blocking else date
    )


def rig_file(
    rig: Rig, found: FlightCalibration, frames: FlightFrames, *, date: str, blocking: Sequence[str]
) -> bytes:
    """The new rig file; it states its origin and what is still provisional."""
    lines = [
        f"{rig.name}, {', '.join(found.heads)} by `syntopic calibrate flight` on {date}",
        f"from {found.exposures} exposures of {', '.join(frames.missions)},",
        f"in place of calibration {found.before.calibration_id}.",
        "It takes effect only after it is configured. Standard deviations and correlations:",
        "calibration.json and covariance.npz next to it.",
    ]
    if not rig.is_calibrated:
        lines += ["The rig is uncalibrated, there is no [calibration]:", *blocking]
    return rig_toml(rig, remark="\n".join(lines))


def _verdicts(found: FlightCalibration, findings: FlightFindings) -> list[str]:
    sentences = [
        f"{found.exposures} exposures, {len(found.adjustment.network.image_points.image)} image "
        f"points that fit to {found.sigma_px:.2f} px"
    ]
    for head in found.heads:
        f_mm, sigma = found.rig.cone(head).lens.f_mm, found.sigmas(head)["df"]
        sentence = (
            f"{head}: f {f_mm:.3f} mm \u00b1 {sigma:.3f}, distortion at the corners \u00b1 "
            f"{found.distortion_sigma_px(head):.2f} px"
        )
        if head in found.oriented_heads:
            sentence += (
                f", direction against {found.reference} \u00b1 {found.pointing_sigma_px(head):.2f} "
                "px"
            )
        sentences.append(sentence)
    sentences.append(
        "The rig stays uncalibrated, for the reasons below"
        if findings.blocking
        else "The rig file is calibrated; it takes effect after it is configured"
    )
    return sentences


def _separation(found: FlightCalibration) -> ReportTable:
    shares = {head: found.shares_of_prior(head) for head in found.heads}
    names = list(dict.fromkeys(name for own in shares.values() for name in own))
    return ReportTable(
        "Standard deviations over those of a lens that nobody calibrated",
        ("head", *(_NAMES.get(name, name) for name in names)),
        [
            (head, *(f"{own[name]:.3f}" if name in own else "" for name in names))
            for head, own in shares.items()
        ],
        "Beforehand: f to 2 %, distortion to 5 % and the principal point to 2 % of the distance of "
        "a corner. Near one, the flight contributes nothing.",
    )


def _plot(found: FlightCalibration, camera: int) -> Plot:
    head = found.heads[camera]
    sensor = found.rig.cone(head).sensors[0]
    pattern = systematic_residuals(found.adjustment, camera, _CELLS)
    half = (sensor.width_px * sensor.pitch_mm / 2.0, sensor.height_px * sensor.pitch_mm / 2.0)
    title = f"{head}: mean residuals of {_CELLS[0]} x {_CELLS[1]} parts of the image"
    return Plot(
        title,
        vectors_svg(
            title,
            pattern.places_mm,
            pattern.mean_mm / sensor.pitch_mm,
            half=half,
            unit=("px", 1.0),
        ),
    )

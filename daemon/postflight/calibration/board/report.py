"""The report of a calibration from a board: parameters, covariance, coverage, plots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from daemon.postflight.calibration.board.findings import BoardFindings, bend_mm
from daemon.postflight.calibration.calibration_report import (
    CalibrationReport,
    Plot,
    Previous,
    Quantity,
    ReportTable,
    changes_between,
    correlation_table,
    serial_warnings,
)
from daemon.postflight.calibration.head_parameters import (
    covariance_of,
    estimated_parameters,
    parameter_table,
    quantities_of,
)
from daemon.postflight.calibration.laboratory.laboratory_series import part_serials
from daemon.postflight.calibration.rig_writer import rig_toml
from daemon.postflight.plots import Curve, chart_svg, histogram_svg, svg_of, vectors_svg
from processing.bundle.adjustment_results import image_residuals_mm
from processing.calibration.board.adjustment import BoardCalibration
from processing.rig import Rig

Array = NDArray[np.float64]

KIND: Final = "board"


def board_report(
    found: BoardCalibration,
    findings: BoardFindings,
    *,
    calibration_id: str,
    date: str,
    source: str,
    stays_uncalibrated: bool,
    previous: Previous | None,
) -> CalibrationReport:
    """Build the report."""
    quantities = quantities_of(found)
    rows = estimated_parameters(found)
    serials = part_serials(found.rig, {found.rig.cone(h).sensors[0].name for h in found.heads})
    warnings = [*findings.blocking, *findings.warnings]
    if previous is not None:
        warnings += serial_warnings(previous, serials)
    bend, bend_sigma = bend_mm(found)
    return CalibrationReport(
        kind=KIND,
        title=f"Calibration of {found.rig.name} from pictures of a board",
        calibration_id=calibration_id,
        date=date,
        facts=[
            ("pictures", source),
            ("board", found.board.text),
            ("rig", f"{found.before.name}, calibration {found.before.calibration_id}"),
            ("heads", ", ".join(found.heads)),
            ("relative orientation", ", ".join(found.relative.mountings) or "none"),
            ("state", "uncalibrated" if stays_uncalibrated else "calibrated"),
        ],
        serials=serials,
        quantities=quantities,
        figures={
            "sigma_px": found.sigma_px,
            "sigma_px_alone": dict(found.single_sigma_px),
            "redundancy": found.adjustment.redundancy,
            "unknowns": found.adjustment.unknowns,
            "observations": found.adjustment.observations,
            "views": {h: c.views for h, c in findings.coverage.items()},
            "corners": {h: c.corners for h, c in findings.coverage.items()},
            "missing": {h: list(c.missing) for h, c in findings.coverage.items()},
            "left_out": list(found.left_out),
            "common_exposures": {f"{a} {b}": n for (a, b), n in found.relative.common.items()},
            "unconnected": list(found.relative.unconnected),
            "board_bend_mm": bend,
            "board_bend_sigma_mm": bend_sigma,
            "stays_uncalibrated": stays_uncalibrated,
            "near_focus": {
                h: {
                    "distance_m": f.distance_m,
                    "f_mm": f.f_mm,
                    "shift_mm": f.shift_mm,
                    "shift_px": f.shift_px,
                    "blur_px": f.blur_px,
                }
                for h, f in findings.focus.items()
            },
        },
        verdicts=_verdicts(found, findings, quantities, stays_uncalibrated=stays_uncalibrated),
        warnings=warnings,
        tables=[
            parameter_table(rows, quantities),
            correlation_table(rows, covariance_of(found, rows)),
            _coverage(findings),
            _focus(findings),
        ],
        plots=_plots(found, findings),
        previous=None if previous is None else previous.calibration_id,
        changes=() if previous is None else changes_between(previous.quantities, quantities),
    )


def _verdicts(
    found: BoardCalibration,
    findings: BoardFindings,
    quantities: Sequence[Quantity],
    *,
    stays_uncalibrated: bool,
) -> list[str]:
    sentences = [
        f"{len(found.views)} pictures, redundancy {found.adjustment.redundancy}; standard "
        "deviation "
        f"of a corner's coordinate {found.sigma_px:.4f} px."
    ]
    sigma = {(q.where, q.what): q.sigma or 0.0 for q in quantities}
    for name in found.heads:
        cone = found.rig.cone(name)
        sentence = (
            f"{name}: principal distance {cone.lens.f_mm:.4f} \u00b1 {sigma[name, 'f']:.4f} mm, "
            f"principal point \u00b1 {1e3 * max(sigma[name, 'x'], sigma[name, 'y']):.2f} um"
        )
        if name in found.relative.mountings:
            worst = max(sigma[name, what] for what in ("omega", "phi", "kappa"))
            sentence += f"; angles against {found.reference} \u00b1 {worst:.5f} deg"
        sentences.append(f"{sentence}.")
    for name, focus in findings.focus.items():
        sentences.append(
            f"{name}: a lens of {focus.f_mm:.3f} mm that is focused at {focus.distance_m:.2f} m "
            "has a "
            f"principal distance longer by {focus.shift_mm:.3f} mm than one focused at infinity "
            f"({focus.shift_px:.1f} px at the corner). Focus as in flight, fix the focus ring, and "
            f"do not touch it afterwards; focused at infinity the board is blurred by "
            f"{focus.blur_px:.1f} px at this aperture."
        )
    sentences.append(
        "The rig stays uncalibrated: products are usable at best, with the flag UNCALIBRATED."
        if stays_uncalibrated
        else "Every head has a calibrated lens and orientation: the flag UNCALIBRATED is gone. The "
        "boresight against the inertial unit is another calibration (syntopic calibrate boresight)."
    )
    return sentences


def calibrated_rig(
    found: BoardCalibration,
    findings: BoardFindings,
    *,
    date: str,
    temperature_c: float | None,
    focused_m: float | None,
) -> tuple[Rig, bool]:
    """The new rig, and whether it stays uncalibrated.

    A rig that was calibrated stays so with new values of the heads that took part. One without a
    calibration becomes calibrated when every head has a lens and an orientation.
    """
    cones = []
    for cone in found.rig.cones:
        if cone.name in found.heads:
            if focused_m is not None:
                focus = findings.focus[cone.name]
                ppm = math.hypot(cone.lens.f_sigma_ppm, 2e5 * focus.shift_mm / focus.f_mm)
                lens = replace(cone.lens, f_mm=focus.f_mm, f_sigma_ppm=round(ppm, 3))
                cone = replace(cone, lens=lens)
            if temperature_c is not None:
                sensor = replace(cone.sensors[0], calibration_c=temperature_c)
                cone = replace(cone, calibration_c=temperature_c, sensors=(sensor,))
        cones.append(cone)
    rig = replace(found.rig, cones=tuple(cones))
    stays_uncalibrated = bool(findings.blocking) and not (
        rig.is_calibrated and focused_m is None and not found.relative.unconnected
    )
    return replace(rig, calibration_date="" if stays_uncalibrated else date), stays_uncalibrated


def rig_file(rig: Rig, found: BoardCalibration, *, date: str, blocking: Sequence[str]) -> bytes:
    """The new rig file; it states its origin and what is still provisional."""
    lines = [
        f"{rig.name}, lenses of {', '.join(found.heads)} by `syntopic calibrate board` on {date},",
        f"in place of calibration {found.before.calibration_id}.",
        "It counts only where it is configured. Standard deviations and correlations:",
        "calibration.json and covariance.npz next to it.",
    ]
    if not rig.is_calibrated:
        lines += ["The rig is uncalibrated, there is no [calibration]:", *blocking]
    return rig_toml(rig, remark="\n".join(lines))


def _coverage(findings: BoardFindings) -> ReportTable:
    return ReportTable(
        "Coverage",
        ("head", "views", "corners", "corners by part of the image", "missing"),
        [
            (
                head,
                c.views,
                c.corners,
                " | ".join(" ".join(str(n) for n in row) for row in c.cells),
                "; ".join(c.missing) or "nothing",
            )
            for head, c in findings.coverage.items()
        ],
        "Nine parts of the image, upper row first.",
    )


def _focus(findings: BoardFindings) -> ReportTable:
    return ReportTable(
        "Near focus",
        ("head", "distance m", "f at infinity mm", "f longer by mm", "px at the corner", "blur px"),
        [
            (head, f.distance_m, f.f_mm, f.shift_mm, f.shift_px, f.blur_px)
            for head, f in findings.focus.items()
        ],
        "1/f = 1/s + 1/s': by how much a focus at this distance lengthens the principal distance, "
        "and the blur of the board where the lens is focused at infinity.",
    )


def _plots(found: BoardCalibration, findings: BoardFindings) -> list[Plot]:
    result, plots = found.adjustment, []
    residual = image_residuals_mm(result)
    of_image = result.network.images.camera[result.network.image_points.image]
    for k, name in enumerate(found.heads):
        cone = found.rig.cone(name)
        sensor, own = cone.sensors[0], of_image == k
        half = (sensor.width_px * sensor.pitch_mm / 2.0, sensor.height_px * sensor.pitch_mm / 2.0)
        middle = np.array([sensor.x_mm, sensor.y_mm])
        rms = float(np.sqrt(np.mean(residual[own] ** 2))) / sensor.pitch_mm
        plots.append(
            Plot(
                f"{name}: residuals",
                vectors_svg(
                    f"{name}: residuals of {int(own.sum())} corners, RMS {rms:.4f} px",
                    result.network.image_points.xy_mm[own] - middle,
                    residual[own] / sensor.pitch_mm,
                    half=half,
                    unit=("px", 1.0),
                ),
            )
        )
        plots.append(Plot(f"{name}: coverage", _coverage_svg(found, name, findings)))
        r = np.linspace(0.0, math.hypot(*half), 60)
        radial = 1e3 * r**3 * (cone.lens.k1 + r**2 * (cone.lens.k2 + r**2 * cone.lens.k3))
        title = f"{name}: radial distortion"
        plots.append(
            Plot(title, chart_svg(title, ("radius mm", "correction um"), [Curve("", r, radial)]))
        )
    pitch = np.array([found.rig.cone(h).sensors[0].pitch_mm for h in found.heads])[of_image]
    plots.append(
        Plot(
            "Residuals of coordinates",
            histogram_svg(
                "residuals of image coordinates", "px", residual / pitch[:, None], bins=60
            ),
        )
    )
    return plots


def _coverage_svg(found: BoardCalibration, head: str, findings: BoardFindings) -> str:
    """Corners of all views in the image, and where the board was tilted to."""
    sensor = found.rig.cone(head).sensors[0]
    own = [(v, p) for v, p in zip(found.views, found.poses, strict=True) if v.head == head]

    def draw(figure: Figure) -> None:
        image, tilts = figure.subplots(1, 2, width_ratios=(2.0, 1.2))
        for view, _ in own:
            image.plot(*view.corners.px.T, ".", markersize=2.5)
        image.add_patch(Rectangle((0, 0), sensor.width_px, sensor.height_px, fill=False))
        image.set(
            xlim=(0, sensor.width_px), ylim=(sensor.height_px, 0), aspect="equal",
            xticks=[k * sensor.width_px / 3 for k in (1, 2)],
            yticks=[k * sensor.height_px / 3 for k in (1, 2)],
            xticklabels=[], yticklabels=[],
        )  # fmt: skip
        image.set_title(f"{head}: {findings.coverage[head].corners} corners, {len(own)} views")
        for _, pose in own:
            angle = math.radians(pose.towards_deg)
            tilt, roll = pose.tilt_deg, math.radians(pose.roll_deg)
            x, y = tilt * math.cos(angle), tilt * math.sin(angle)
            ends = 5.0 * np.array([math.cos(roll), math.sin(roll)])
            tilts.plot([x, x + ends[0]], [y, y + ends[1]], "-", linewidth=1.2)
            tilts.plot([x], [y], "o", markersize=3.5, color=tilts.lines[-1].get_color())
        for radius in (15.0, 55.0):
            circle: Any = np.linspace(0.0, 2.0 * math.pi, 80)
            tilts.plot(radius * np.cos(circle), radius * np.sin(circle), ":", color="#8a97a5")
        tilts.set(xlim=(-60, 60), ylim=(-60, 60), aspect="equal")
        tilts.set_title("tilt, degrees; roll as a line")

    return svg_of(draw, (7.6, 3.8))

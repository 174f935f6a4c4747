"""`syntopic calibrate rig`: relative orientations and lenses of a block become a rig file.

The averaging is in `processing.calibration.relative_orientation`; here are its report and files.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from daemon import DaemonError
from daemon.postflight.adjustment.project import Project
from daemon.postflight.calibration.calibration_report import (
    CalibrationReport,
    Cell,
    Plot,
    Previous,
    Quantity,
    ReportTable,
    changes_between,
    serial_warnings,
)
from daemon.postflight.calibration.rig_writer import rig_toml
from daemon.postflight.plots import Curve, chart_svg
from processing.bundle.adjust import Adjustment
from processing.bundle.adjustment_results import parameters_of
from processing.bundle.network import INTERIOR
from processing.calibration.relative_orientation import RelativeOrientations
from processing.geometry.rotation import omega_phi_kappa
from processing.rig import Rig

GRAD = 200.0 / math.pi
MOVED = 2.0
"""Mean square of single exposures about the average above which the rig moved within the block."""

_ANGLES = ("phi", "omega", "kappa")
_LENS_FIELD = {"dx0": "dx0_mm", "dy0": "dy0_mm", "df": "df_mm"}


class RigCalibrationError(DaemonError, ValueError):
    """A block without observations of this rig; the message states what is missing."""


def calibrated_rig(
    rig: Rig, result: Adjustment, found: RelativeOrientations, *, calibration_id: str, date: str
) -> Rig:
    """The rig with the block's relative orientations and lenses.

    Raises:
        RigCalibrationError: cameras that are no cones of the rig, or lenses a rig file cannot hold.
    """
    cones = {cone.name: cone for cone in rig.cones}
    cameras = {camera.name: k for k, camera in enumerate(result.network.cameras)}
    heads = {head.head: head for head in found.heads}
    foreign = sorted((set(cameras) | set(heads) | {found.reference}) - set(cones))
    if foreign:
        raise RigCalibrationError(
            f"cameras {', '.join(foreign)} of the block are no cones of rig {rig.name} "
            f"({', '.join(cones)}); give them the same names"
        )
    if rig.master_cone != found.reference:
        raise RigCalibrationError(
            f"the reference is {found.reference!r}, rig {rig.name} counts angles against "
            f"{rig.master_cone!r}; give --reference {rig.master_cone}"
        )
    calibrated = []
    for cone in rig.cones:
        if cone.name in heads:
            omega, phi, kappa = omega_phi_kappa(heads[cone.name].rotation).tolist()
            sigma = found.sigma_rad([h.head for h in found.heads].index(cone.name))
            spread = math.sqrt(float(np.mean(sigma**2))) * 1e6
            cone = replace(
                cone, rotation_rad=(omega, phi, kappa), rotation_sigma_urad=round(spread, 3)
            )
        if cone.name in cameras:
            camera = result.network.cameras[cameras[cone.name]]
            if camera.model != "australis" or camera.terms or len(cone.sensors) != 1:
                raise RigCalibrationError(
                    f"camera {camera.name}: a rig file holds the Australis ten of a head with one "
                    'sensor; use model = "australis" and no further parameters'
                )
            values = dict(zip(INTERIOR, result.state.interior[cameras[cone.name]], strict=True))
            changed: dict[str, Any] = {
                _LENS_FIELD.get(name, name): float(v) for name, v in values.items()
            }
            sensor = replace(cone.sensors[0], x_mm=0.0 - camera.xp_mm, y_mm=0.0 - camera.yp_mm)
            lens = replace(cone.lens, f_mm=camera.f_mm, **changed, residual_grid=None)
            cone = replace(cone, lens=lens, sensors=(sensor,))
        calibrated.append(cone)
    return replace(
        rig, calibration_id=calibration_id, calibration_date=date, cones=tuple(calibrated)
    )


def quantities_of(result: Adjustment, found: RelativeOrientations) -> tuple[Quantity, ...]:
    """phi, omega, kappa of every head in grads, and what was estimated of the lenses."""
    listed = []
    for k, head in enumerate(found.heads):
        angles, sigma = found.angles(k)
        listed += [
            Quantity(head.head, name, "grad", float(a) * GRAD, float(s) * GRAD)
            for name, a, s in zip(_ANGLES, angles, sigma, strict=True)
        ]
    listed += [Quantity(p.camera, p.name, p.unit, p.value, p.sigma) for p in parameters_of(result)]
    return tuple(listed)


def report_of(
    project: Project,
    result: Adjustment,
    found: RelativeOrientations,
    rig: Rig,
    *,
    date: str,
    previous: Previous | None,
) -> CalibrationReport:
    """The calibration report, as printed and written."""
    quantities = quantities_of(result, found)
    warnings = [] if previous is None else serial_warnings(previous, rig.serials)
    warnings += result.problems
    if math.isfinite(found.squares) and found.squares > MOVED:
        warnings.append(
            f"single exposures scatter about the averages {math.sqrt(found.squares):.1f} times as "
            "much as their orientations are known to: heads moved within the block, or blunders "
            "are left"
        )
    return CalibrationReport(
        kind="rig",
        title=f"Relative orientation of {rig.name} against {found.reference}",
        calibration_id=rig.calibration_id,
        date=date,
        facts=(
            ("block", project.name),
            ("images", str(len(result.network.images.names))),
            ("sigma0 of the block", f"{result.sigma0:.3f}"),
            (
                "how",
                "heads as parameters of the adjustment"
                if not found.redundancy
                else "every image oriented for itself, averaged over exposures with the whole "
                "covariance",
            ),
            (
                "single exposures about the average, mean square in their covariance",
                f"{found.squares:.2f}" if found.redundancy else "not known",
            ),
        ),
        serials=rig.serials,
        quantities=quantities,
        figures={
            "sigma0": result.sigma0,
            "squares": found.squares if found.redundancy else None,
            "exposures": {head.head: head.exposures for head in found.heads},
            "phi_omega_kappa_deg": {
                head.head: [float(v) for v in np.degrees(found.angles(k)[0])]
                for k, head in enumerate(found.heads)
            },
            "sigma_deg": {
                head.head: [float(v) for v in np.degrees(found.angles(k)[1])]
                for k, head in enumerate(found.heads)
            },
        },
        warnings=warnings,
        tables=(
            _table(found, "grad", GRAD),
            _table(found, "deg", math.degrees(1.0)),
            _spread(found),
        ),
        plots=_plots(found),
        previous=None if previous is None else previous.calibration_id,
        changes=() if previous is None else changes_between(previous.quantities, quantities),
    )


def rig_file(rig: Rig, project: Project, found: RelativeOrientations, *, date: str) -> bytes:
    """The rig file, with angles as the table of the paper lists them in its remark."""
    lines = [
        f"{rig.name}, by `syntopic calibrate rig` on {date} from {project.name}.",
        "It counts only where it is configured.",
        "rotation_rad is omega, phi, kappa of R = Rx Ry Rz; in grads with phi first, R = Ry Rx Rz:",
    ]
    for k, head in enumerate(found.heads):
        angles, sigma = found.angles(k)
        listed = "  ".join(
            f"{name} {a * GRAD:.4f} +- {s * GRAD:.4f}"
            for name, a, s in zip(_ANGLES, angles, sigma, strict=True)
        )
        lines.append(f"  {head.head}: {listed}, {head.exposures} exposures")
    return rig_toml(rig, remark="\n".join(lines))


def _table(found: RelativeOrientations, unit: str, factor: float) -> ReportTable:
    rows: list[tuple[Cell, ...]] = []
    for k, head in enumerate(found.heads):
        angles, sigma = found.angles(k)
        cells = [
            f"{a * factor:.4f} \u00b1 {s * factor:.4f}" for a, s in zip(angles, sigma, strict=True)
        ]
        rows.append((head.head, *cells, head.exposures))
    return ReportTable(
        f"Heads against {found.reference}, {unit}",
        ("head", "phi", "omega", "kappa", "exposures"),
        rows,
        "R = Ry(phi) Rx(omega) Rz(kappa), reference from head.",
    )


def _plots(found: RelativeOrientations) -> tuple[Plot, ...]:
    """Deviations of single exposures from the averages, head by head."""
    return tuple(
        Plot(
            f"Head {head.head}: single exposures less average",
            chart_svg(
                f"Head {head.head}",
                ("exposure", "mgrad"),
                [
                    Curve(
                        name,
                        [float(k + 1) for k in range(len(head.single_angles_rad))],
                        head.single_angles_rad[:, axis] * GRAD * 1e3,
                        joined=False,
                    )
                    for axis, name in enumerate(("about x", "about y", "about z"))
                ],
            ),
        )
        for head in found.heads
        if len(head.single_angles_rad) > 1
    )


def _spread(found: RelativeOrientations) -> ReportTable:
    rows: list[tuple[Cell, ...]] = [
        (
            head.head,
            *(float(v) * 1e3 for v in found.sigma_rad(k) * GRAD),
            *(float(v) * 1e3 if math.isfinite(v) else None for v in head.spread_rad * GRAD),
        )
        for k, head in enumerate(found.heads)
    ]
    return ReportTable(
        "About the head's own axes, mgrad",
        ("head", "sigma x", "sigma y", "sigma z", "single x", "single y", "single z"),
        rows,
        "Single: standard deviation of single exposures. Averages weigh exposures with their whole "
        "covariance: what all have in common (principal points) can move them beyond the scatter.",
    )

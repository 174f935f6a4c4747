"""The report of a rig's calibration in the test field: places, lenses, cones, covariance, plots."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.calibration.calibration_report import (
    CalibrationReport,
    Plot,
    Previous,
    Quantity,
    ReportTable,
    correlation_table,
)
from daemon.postflight.calibration.laboratory.calibration_field import RigCalibration
from daemon.postflight.calibration.laboratory.field_network import LENS_FREE
from daemon.postflight.calibration.laboratory.head_geometry import LENS_KEYS
from daemon.postflight.calibration.laboratory.laboratory_report import of_series
from daemon.postflight.calibration.laboratory.laboratory_series import LaboratorySeries
from daemon.postflight.plots import histogram_svg, map_svg, vectors_svg
from processing.bundle.adjustment_results import image_residuals_mm, systematic_residuals
from processing.bundle.network import INTERIOR
from processing.rig import Rig

Array = NDArray[np.float64]

_CELLS: Final = (16, 12)

_KINDS: Final = {
    "shift-x": ("x", "um", 1e3),
    "shift-y": ("y", "um", 1e3),
    "rotation": ("rotation", "urad", 1e6),
    "scale": ("scale", "ppm", 1e6),
    "perspective-x": ("skew x", "ppm/mm", 1e6),
    "perspective-y": ("skew y", "ppm/mm", 1e6),
}


@dataclass(frozen=True)
class EstimatedParameter:
    """One estimated number with its column in the adjustment. `value` and `before` in the
    adjustment's units (mm, rad, 1, m), `factor` of `unit` to one of these."""

    where: str
    what: str
    unit: str
    factor: float
    value: float
    before: float
    column: int


def estimated_parameters(found: RigCalibration) -> list[EstimatedParameter]:
    """All parameters of the rig, as the rig file has them."""
    result, rows = found.adjustment, []
    new, old = found.rig, found.before
    for k, cone in enumerate(new.cones):
        before = old.cone(cone.name)
        if not result.network.cameras[k].terms:
            continue
        for name in LENS_FREE:
            column = int(result.layout.interior[k][INTERIOR.index(name)])
            unit = "mm^-2" if name == "k1" else "mm^-4" if name == "k2" else "mm^-1"
            value = float(getattr(cone.lens, LENS_KEYS[name]))
            was = float(getattr(before.lens, LENS_KEYS[name]))
            rows.append(
                EstimatedParameter(f"cone {cone.name}", name, unit, 1.0, value, was, column)
            )
        names = [t.name for t in result.network.cameras[k].terms]
        for name, column in zip(names, result.layout.terms[k].tolist(), strict=True):
            sensor, kind = name.rsplit(" ", 1)
            what, unit, factor = _KINDS[kind]
            a, b = new.sensor(sensor), old.sensor(sensor)
            value, was = {
                "shift-x": (a.x_mm, b.x_mm),
                "shift-y": (a.y_mm, b.y_mm),
                "rotation": (a.rotation_rad, b.rotation_rad),
                "scale": (a.scale - 1.0, b.scale - 1.0),
                "perspective-x": (a.skew_per_mm[0], b.skew_per_mm[0]),
                "perspective-y": (a.skew_per_mm[1], b.skew_per_mm[1]),
            }[kind]
            rows.append(EstimatedParameter(sensor, what, unit, factor, value, was, int(column)))
        for axis, what in enumerate(("omega", "phi", "kappa")):
            column = int(result.layout.head_rotation[k, axis])
            if column >= 0:
                rows.append(
                    EstimatedParameter(
                        f"cone {cone.name}",
                        what,
                        "urad",
                        1e6,
                        cone.rotation_rad[axis],
                        before.rotation_rad[axis],
                        column,
                    )
                )
    return rows


def covariance_of(found: RigCalibration, rows: Sequence[EstimatedParameter]) -> Array:
    """Covariance (n, n) in the adjustment's units. A cone's angles are small about its own axes:
    their rotation vector and omega, phi, kappa are taken as one."""
    columns = np.array([r.column for r in rows])
    result = found.adjustment
    return np.asarray(result.sigma0**2 * result.cofactor[np.ix_(columns, columns)])


def covariance_bytes(rows: Sequence[EstimatedParameter], covariance: Array) -> bytes:
    """`covariance.npz`: names, values and covariance in mm, rad and ones."""
    stream = io.BytesIO()
    np.savez(
        stream,
        names=np.array([f"{r.where} {r.what}" for r in rows]),
        values=np.array([r.value for r in rows]),
        covariance=covariance,
    )
    return stream.getvalue()


def field_report(
    series: LaboratorySeries[Any],
    found: RigCalibration,
    *,
    calibration_id: str,
    date: str,
    previous: tuple[Path, Previous] | None,
) -> CalibrationReport:
    """Build the report."""
    rows = estimated_parameters(found)
    covariance = covariance_of(found, rows)
    sigma = np.sqrt(np.diag(covariance))
    quantities = [
        Quantity(r.where, r.what, r.unit, r.value * r.factor, float(s) * r.factor)
        for r, s in zip(rows, sigma, strict=True)
    ]
    probes = [
        Quantity(f"probe {name}", "temperature", "degC", value, None)
        for name, value in found.temperatures_c.items()
    ]
    rig, result = found.rig, found.adjustment
    residual = image_residuals_mm(result)
    good = np.isfinite(residual).all(axis=1)
    warnings = list(result.problems)
    taken = [c for k, c in enumerate(rig.cones) if result.network.cameras[k].terms]
    missing = {c.probe for c in taken if c.probe} - set(found.temperatures_c)
    if len(taken) < len(rig.cones):
        absent = ", ".join(c.name for c in rig.cones if c not in taken)
        warnings.append(f"no frames of {absent}: left as they were")
        if not found.before.is_calibrated:
            warnings.append(f"{rig.name} stays uncalibrated: calibrate {absent} as well")
    if missing:
        warnings.append(
            f"no temperature of {', '.join(sorted(missing))}: the new places are taken to hold at "
            "the old calibration's temperature"
        )
    point_count = int(good.sum())
    report = CalibrationReport(
        kind="lab",
        title=f"Laboratory calibration of {rig.name}",
        calibration_id=calibration_id,
        date=date,
        facts=[
            ("exposures", str(len(result.network.stations.names))),
            ("targets", str(len(result.network.points.names))),
            ("image points", f"{point_count}, {found.rejected} left out"),
            *((f"probe {n}", f"{v:.2f} degC") for n, v in found.temperatures_c.items()),
        ],
        serials={},
        quantities=[*quantities, *probes],
        figures={
            "sigma_px": found.sigma_px,
            "sigma0": result.sigma0,
            "redundancy": result.redundancy,
            "unknowns": result.unknowns,
            "observations": result.observations,
            "image_points": point_count,
            "rejected": found.rejected,
        },
        verdicts=[
            f"{point_count} image points, redundancy {result.redundancy}; sigma of an image "
            f"coordinate {found.sigma_px:.4f} px, sigma0 {result.sigma0:.3f}.",
            "Datum: principal distance and point of every cone as they were, the first CCD of "
            "each cone not rotated, the master cone not rotated.",
        ],
        warnings=warnings,
        tables=[_parameters(rows, sigma), correlation_table(rows, covariance), _cones(found)],
        plots=_plots(found, rows, covariance),
    )
    return of_series(
        report,
        series,
        sensors={sensor.name for cone in taken for sensor in cone.sensors},
        previous=previous,
        compared=quantities,
    )


def _parameters(rows: Sequence[EstimatedParameter], sigma: Array) -> ReportTable:
    return ReportTable(
        "Parameters",
        ("where", "what", "value", "before", "change", "sigma", "unit", "change / sigma"),
        [
            (
                r.where,
                r.what,
                r.value * r.factor,
                r.before * r.factor,
                float(f"{(r.value - r.before) * r.factor:.4g}"),
                float(f"{s * r.factor:.3g}"),
                r.unit,
                float(f"{(r.value - r.before) / s:.1f}"),
            )
            for r, s in zip(rows, sigma.tolist(), strict=True)
        ],
        "Places and rotations of CCDs in their layers, scale less one, skew: x, y of a CCD about "
        "its centre times (1 + skew x u + skew y v).",
    )


def _cones(found: RigCalibration) -> ReportTable:
    result = found.adjustment
    residual = image_residuals_mm(result)
    table, rows = result.network.image_points, []
    of_image = result.network.images.camera[table.image]
    for k, cone in enumerate(found.rig.cones):
        own = residual[of_image == k]
        own = own[np.isfinite(own).all(axis=1)]
        pitch = cone.sensors[0].pitch_mm
        rows.append(
            (
                cone.name,
                len(own),
                float(np.sqrt(np.mean(own[:, 0] ** 2))) / pitch if len(own) else None,
                float(np.sqrt(np.mean(own[:, 1] ** 2))) / pitch if len(own) else None,
                float(np.hypot(*own.T).max()) / pitch if len(own) else None,
            )
        )
    return ReportTable(
        "What is left", ("cone", "image points", "RMS x px", "RMS y px", "largest px"), rows
    )


def _plots(
    found: RigCalibration, rows: Sequence[EstimatedParameter], covariance: Array
) -> list[Plot]:
    result, plots = found.adjustment, []
    for k, cone in enumerate(found.rig.cones):
        if not result.network.cameras[k].terms:
            continue
        pattern = systematic_residuals(result, k, _CELLS)
        half = _half_extent(found.rig, k)
        plots.append(
            Plot(
                f"Cone {cone.name}: mean residuals",
                vectors_svg(
                    f"cone {cone.name}: mean residuals over the field",
                    pattern.places_mm,
                    pattern.mean_mm,
                    half=half,
                    unit=("um", 1e3),
                ),
            )
        )
    residual = 1e3 * image_residuals_mm(result)
    plots.append(
        Plot(
            "Residuals of coordinates",
            histogram_svg("residuals of image coordinates", "um", residual, bins=60),
        )
    )
    spread = np.sqrt(np.diag(covariance))
    correlation = np.abs(covariance / spread[:, None] / spread)
    size = max(1, 480 // len(rows))
    plots.append(
        Plot(
            "Correlations",
            map_svg("correlations, absolute", np.kron(correlation, np.ones((size, size))), "(|r|)"),
            "Rows and columns in the order of the table of parameters.",
        )
    )
    return plots


def _half_extent(rig: Rig, cone: int) -> tuple[float, float]:
    sensors = rig.cones[cone].sensors
    return (
        max(abs(s.x_mm) + s.width_px * s.pitch_mm / 2.0 for s in sensors) * 1.02,
        max(abs(s.y_mm) + s.height_px * s.pitch_mm / 2.0 for s in sensors) * 1.02,
    )

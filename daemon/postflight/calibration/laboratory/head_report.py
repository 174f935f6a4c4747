"""The report of a head's geometric calibration, and the rig file that holds it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from daemon.postflight.calibration.calibration_report import (
    CalibrationReport,
    Plot,
    Previous,
    Quantity,
    ReportTable,
)
from daemon.postflight.calibration.laboratory.head_geometry import LENS_KEYS, HeadGeometry
from daemon.postflight.calibration.laboratory.laboratory_report import of_series
from daemon.postflight.calibration.laboratory.laboratory_series import LaboratorySeries
from daemon.postflight.plots import Curve, chart_svg, histogram_svg, vectors_svg
from processing.bundle.adjustment_results import AdjustedParameter, exposures_of, parameters_of
from processing.bundle.network import INTERIOR
from processing.rig import Rig

RESIDUAL_BAR_PX: Final = 1.0 / 20.0
"""Seeds: residual of a single head's calibration, less than 1/20 px."""


def quantities_of(head: HeadGeometry) -> list[Quantity]:
    """The estimated parameters, in the units of the rig file."""
    return [
        Quantity(head.cone.name, p.name, p.unit, p.value, p.sigma)
        for p in parameters_of(head.adjustment)
    ]


def calibrated_rig(
    rig: Rig, heads: Sequence[HeadGeometry], *, calibration_id: str, date: str
) -> Rig:
    """The rig with the new lenses. Places of the sensors are taken as they were, and from now on
    hold at the temperature of this calibration, as do the lenses."""
    found = {h.cone.name: h for h in heads}
    cones = []
    for cone in rig.cones:
        head = found.get(cone.name)
        if head is not None:
            at = round(head.temperature_c, 2)
            cone = replace(
                cone,
                lens=head.lens,
                calibration_c=at,
                sensors=tuple(replace(s, calibration_c=at) for s in cone.sensors),
            )
        cones.append(cone)
    return replace(rig, cones=tuple(cones), calibration_id=calibration_id, calibration_date=date)


def head_report(
    series: LaboratorySeries[Any],
    heads: Sequence[HeadGeometry],
    *,
    calibration_id: str,
    date: str,
    previous: tuple[Path, Previous] | None,
) -> CalibrationReport:
    """Build the report."""
    quantities = [q for head in heads for q in quantities_of(head)]
    verdicts, warnings = [], []
    for head in heads:
        sentence = (
            f"{head.cone.name}: {len(head.measured_mm)} targets in {len(head.series)} series leave "
            f"{head.residual_px:.4f} px = {head.residual_px * head.sensor.pitch_um:.3f} um (root "
            f"mean square of a coordinate) to the ten parameters, {head.grid_residual_px:.4f} px "
            "with the grid"
        )
        if head.residual_px < RESIDUAL_BAR_PX:
            verdicts.append(f"{sentence}; below 1/20 px.")
        else:
            warnings.append(f"{sentence}; 1/20 px is the bar.")
        warnings += _warnings(head)
    report = CalibrationReport(
        kind="head",
        title=f"Heads of {series.rig.name}: geometric calibration",
        calibration_id=calibration_id,
        date=date,
        facts=[
            ("heads", ", ".join(h.cone.name for h in heads)),
            *((f"temperature of {h.cone.name}", f"{h.temperature_c:.2f} degC") for h in heads),
        ],
        serials={},
        quantities=quantities,
        figures={h.cone.name: _figures(h) for h in heads},
        verdicts=verdicts,
        warnings=warnings,
        tables=[_parameters(heads), _correlations(heads), _series(heads), _fit(heads)],
        plots=[plot for head in heads for plot in _plots(head)],
    )
    sensors = {h.sensor.name for h in heads}
    return of_series(report, series, sensors=sensors, previous=previous)


def _warnings(head: HeadGeometry) -> list[str]:
    found = []
    if head.matching.failed:
        found.append(
            f"{head.cone.name}: {len(head.matching.failed)} targets matched no other; look at "
            "their images"
        )
    found += [f"{head.cone.name}: {problem}" for problem in head.adjustment.problems]
    rejected = int(head.adjustment.rejected.sum())
    if rejected:
        found.append(f"{head.cone.name}: {rejected} targets left out as blunders")
    if head.adjustment.redundancy < 20:
        found.append(
            f"{head.cone.name}: redundancy {head.adjustment.redundancy}; take more targets"
        )
    return found


def _parameters(heads: Sequence[HeadGeometry]) -> ReportTable:
    rows: list[tuple[str | float | None, ...]] = []
    for head in heads:
        for p in parameters_of(head.adjustment):
            before = float(getattr(head.cone.lens, LENS_KEYS[p.name]))
            rows.append(
                (
                    head.cone.name,
                    p.name,
                    p.value,
                    float(f"{p.sigma:.3g}"),
                    p.unit,
                    float(f"{p.t:.1f}"),
                    before,
                    _at_corner_um(head, p),
                    ", ".join(f"{name} {r:+.3f}" for name, r in p.high_correlations) or None,
                )
            )
    return ReportTable(
        "Parameters",
        (
            "head",
            "parameter",
            "value",
            "sigma",
            "unit",
            "t",
            "in the rig file",
            "sigma at the corner, um",
            "correlated beyond 0.95",
        ),
        rows,
        "Heier et al. (2002), eq. 5.1, ideal from measured, about the origin of the "
        "layer; principal distance as in the rig file, its change is df.",
    )


def _at_corner_um(head: HeadGeometry, p: AdjustedParameter) -> float:
    """Displacement of the corner of the field by one sigma of a parameter."""
    half = np.array([head.sensor.width_px, head.sensor.height_px]) * head.sensor.pitch_mm / 2.0
    x, y = (float(v) for v in half)
    r2 = x * x + y * y
    effect = {
        "dx0": 1.0,
        "dy0": 1.0,
        "df": math.sqrt(r2) / head.cone.lens.f_mm,
        "k1": r2**1.5,
        "k2": r2**2.5,
        "k3": r2**3.5,
        "p1": math.hypot(r2 + 2 * x * x, 2 * x * y),
        "p2": math.hypot(r2 + 2 * y * y, 2 * x * y),
        "b1": x,
        "b2": y,
    }
    return float(f"{1e3 * effect[p.name] * p.sigma:.3g}")


def _correlations(heads: Sequence[HeadGeometry]) -> ReportTable:
    rows: list[tuple[str | float | None, ...]] = []
    names: tuple[str, ...] = ()
    for head in heads:
        result = head.adjustment
        columns = result.layout.interior[0]
        free = np.flatnonzero(columns >= 0)
        names = tuple(INTERIOR[k] for k in free)
        own = result.cofactor[np.ix_(columns[free], columns[free])]
        spread = np.sqrt(np.diag(own))
        for name, row in zip(names, own / spread[:, None] / spread, strict=True):
            rows.append((f"{head.cone.name} {name}", *(f"{v:+.2f}" for v in row)))
    return ReportTable("Correlations", ("", *names), rows)


def _series(heads: Sequence[HeadGeometry]) -> ReportTable:
    rows: list[tuple[str | float | None, ...]] = [
        (
            o.name,
            *(float(f"{math.degrees(a):.6f}") for a in o.angles_rad),
            *(float(f"{1e6 * s:.3g}") for s in o.angles_sigma_rad),
        )
        for head in heads
        for o in exposures_of(head.adjustment)
    ]
    return ReportTable(
        "Orientation of each series: three unknowns",
        ("series", "omega deg", "phi deg", "kappa deg", "sigma urad", "sigma urad", "sigma urad"),
        rows,
    )


def _fit(heads: Sequence[HeadGeometry]) -> ReportTable:
    rows = [
        (
            h.cone.name,
            len(h.measured_mm),
            h.adjustment.redundancy,
            float(np.nanmedian(h.matching.sigma_px)),
            h.matching.closure_px,
            1e3 * h.sigma_mm,
            1e3 * h.sigma_mm * _factor(h),
            h.residual_px,
            float(np.hypot(*h.residual_mm.T).max()) / h.sensor.pitch_mm,
            h.grid_residual_px,
        )
        for h in heads
    ]
    return ReportTable(
        "What is left",
        (
            "head",
            "targets",
            "redundancy",
            "matching sigma px",
            "closure px",
            "expected um",
            "found um",
            "residual RMS px",
            "largest px",
            "with the grid px",
        ),
        rows,
        "Expected: matching and collimator angles. Found: from the residuals and the redundancy; "
        "standard deviations of parameters rest on it. With the grid: at targets the grid was not "
        "made of.",
    )


def _factor(head: HeadGeometry) -> float:
    """Sigma of a coordinate as found, over the expected one."""
    used = head.adjustment.network.image_points.sigma_mm[0, 0]
    return float(used) / head.sigma_mm * head.adjustment.sigma0


def _figures(head: HeadGeometry) -> dict[str, Any]:
    return {
        "targets": len(head.measured_mm),
        "series": len(head.series),
        "redundancy": head.adjustment.redundancy,
        "sigma_um": 1e3 * head.sigma_mm * _factor(head),
        "expected_sigma_um": 1e3 * head.sigma_mm,
        "residual_px": head.residual_px,
        "residual_with_grid_px": head.grid_residual_px,
        "matching_sigma_px": float(np.nanmedian(head.matching.sigma_px)),
        "temperature_c": head.temperature_c,
        "rejected": int(head.adjustment.rejected.sum()),
    }


def _plots(head: HeadGeometry) -> list[Plot]:
    name, lens, sensor = head.cone.name, head.lens, head.sensor
    half = (sensor.width_px * sensor.pitch_mm / 2.0, sensor.height_px * sensor.pitch_mm / 2.0)
    middle = np.array([sensor.x_mm, sensor.y_mm])
    r = np.linspace(0.0, math.hypot(*half), 60)
    radial = 1e3 * r**3 * (lens.k1 + r**2 * (lens.k2 + r**2 * lens.k3))
    grid = head.grid
    nodes = np.stack(np.meshgrid(grid.x_mm, grid.y_mm), axis=-1).reshape(-1, 2)
    return [
        Plot(
            f"{name}: residuals",
            vectors_svg(
                f"{name}: residuals to the ten parameters, RMS {head.residual_px:.4f} px",
                head.measured_mm - middle,
                head.residual_mm,
                half=half,
                unit=("um", 1e3),
            ),
        ),
        Plot(
            f"{name}: residual grid",
            vectors_svg(
                f"{name}: grid on top of the ten parameters",
                nodes - middle,
                grid.delta_mm.reshape(-1, 2),
                half=half,
                unit=("um", 1e3),
            ),
        ),
        Plot(
            f"{name}: radial distortion",
            chart_svg(
                f"{name}: radial distortion (eq. 5.2)",
                ("radius mm", "correction um"),
                [Curve("", r, radial)],
            ),
        ),
        Plot(
            f"{name}: residuals of coordinates",
            histogram_svg(
                f"{name}: residuals of coordinates", "um", 1e3 * head.residual_mm, bins=40
            ),
        ),
    ]

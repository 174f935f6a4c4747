"""The protocol of an adjustment as plain text, by section."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.mission.store.durable import new_file
from daemon.postflight.adjustment.head_time_report import time_rows
from daemon.postflight.adjustment.project import CheckPoints
from processing.bundle.adjust import Adjustment
from processing.bundle.adjustment_results import (
    PointDifferences,
    check_point_differences,
    control_residuals,
    exposures_of,
    image_residuals_mm,
)
from processing.bundle.correlations import high_correlations

Array = NDArray[np.float64]

_MAX_CORRELATIONS = 10_000
"""Of two kinds of unknowns; a large block has more, of neighbouring exposures."""

_TITLE = "BUNDLE ADJUSTMENT"
_LARGEST = 50
_GRAD = 400.0 / 360.0


def is_protocol(head: bytes) -> bool:
    """Whether a file that begins so was written by `write_protocol`."""
    return head.startswith(f"{_TITLE} ".encode())


def write_protocol(
    path: Path, result: Adjustment, checks: CheckPoints, report: Mapping[str, Any]
) -> None:
    """Write the protocol.

    Args:
        path: the file; its folder is created if it is missing.
        result: the adjustment.
        checks: independent coordinates.
        report: what `report_of` made of the same adjustment.
    """
    with new_file(path) as part, part.open("w", encoding="utf-8") as file:
        for line in _lines(result, checks, report):
            file.write(line.rstrip() + "\n")


def _lines(result: Adjustment, checks: CheckPoints, report: Mapping[str, Any]) -> Iterator[str]:
    yield f"{_TITLE} {report['name']}"
    yield from _section("1 Summary")
    yield from _summary(result, report)
    yield from _section("2 Observations")
    yield from _table(
        ("kind", "count", "redundancy", "RMS", "largest", "unit", "variance factor"),
        (
            (
                g["name"], str(g["count"]), _fixed(g["redundancy"], 1), _digits(g["rms"], 4),
                _digits(g["worst"], 4), g["unit"], _digits(g["variance_factor"], 4),
            )
            for g in report["groups"]
        ),
    )  # fmt: skip
    yield from _section("3 Interior orientation")
    for c in report["cameras"]:
        x, y = c["principal_point_mm"]
        yield (
            f"{c['name']}: principal distance {c['principal_distance_mm']:.6f} mm, principal point "
            f"{x:.6f} {y:.6f} mm, {c['parameters']} parameters"
        )
    yield from _table(
        ("camera", "parameter", "value", "sigma", "unit", "t"),
        (
            (p["camera"], p["name"], _digits(p["value"], 8), _digits(p["sigma"], 3), p["unit"],
             _fixed(p["t"], 1))
            for p in report["parameters"]
        ),
    )  # fmt: skip
    yield from _section("4 Exterior orientation (omega, phi, kappa in grads)")
    yield from _orientations(result)
    if report["heads"]:
        yield from _section("5 Heads (omega, phi, kappa in grads; offset in m)")
        yield from _table(
            ("head", "omega", "phi", "kappa", "sigmas", "x", "y", "z", "sigmas"),
            (
                (
                    h["name"], *(_fixed(v, 5) for v in h["angles_grad"]),
                    " ".join(_fixed(v, 5) for v in h["angles_sigma_grad"]),
                    *(_fixed(v, 4) for v in h["offset_m"]),
                    " ".join(_fixed(v, 4) for v in h["offset_sigma_m"]),
                )
                for h in report["heads"]
            ),
        )  # fmt: skip
    if report["times"]["heads"]:
        yield from _table(
            ("head", "delay ms", "readout ms", "jitter ms"), time_rows(report["times"])
        )
        yield from report["times"]["not_separated"]
    if report["gnss_lines"]:
        yield from _section("6 GNSS shift (m) and drift (m/s) of lines")
        yield from _table(
            ("line", "shift X", "Y", "Z", "sigmas", "drift X", "Y", "Z"),
            (
                (
                    g["line"], *(_fixed(v, 4) for v in g["shift_m"]),
                    " ".join(_fixed(v, 4) for v in g["shift_sigma_m"]),
                    *(_digits(v, 4) for v in g["drift_m_per_s"]),
                )
                for g in report["gnss_lines"]
            ),
        )  # fmt: skip
    yield from _section("7 Object points (m)")
    yield from _points(result)
    for number, title, found in (
        (8, "Control points, adjusted less given (m); a priori sigmas", control_residuals(result)),
        (
            9,
            "Check points, adjusted less given (m); predicted sigmas",
            check_point_differences(result, checks.names, checks.xyz_m, checks.sigma_m),
        ),
    ):
        if found.names:
            yield from _section(f"{number} {title}")
            yield from _differences(found)
    yield from _section(f"10 Largest standardised residuals (at most {_LARGEST})")
    yield from _residuals(result)
    yield from _section("11 Observations left out")
    left = [f"{r['point']} in {r['image']}" for r in report["rejected"]]
    yield from [*left, *report["excluded"]] or ["none"]
    if report["left_out"]:
        yield "Object points that their rays do not fix: " + ", ".join(report["left_out"])
    yield from _section(f"12 Correlations beyond {report['correlations']['limit']}")
    yield from _correlations(result)
    yield from _section("13 Reliability")
    yield from _reliability(report["reliability"])
    yield from _section("14 Residuals by area of the ground")
    areas = report["areas"]
    yield f"squares of {_digits(areas['size_m'], 4)} m; residuals in um along X and Y"
    yield from _table(
        ("X", "Y", "image points", "RMS", "mean X", "mean Y"),
        (
            (_digits(a["x_m"], 9), _digits(a["y_m"], 9), str(a["count"]), _fixed(a["rms_um"], 3),
             _fixed(a["mean_x_um"], 3), _fixed(a["mean_y_um"], 3))
            for a in areas["cells"]
        ),
    )  # fmt: skip


def _summary(result: Adjustment, report: Mapping[str, Any]) -> Iterator[str]:
    settings = result.settings
    yield f"sigma0 a posteriori       {_digits(report['sigma0'], 6)}"
    test = report["global_test"]
    if test["limits"]:
        low, high = test["limits"]
        yield (
            f"global test, 99 %         {low:.4g} to {high:.4g}: "
            + ("passed" if test["passed"] else "failed")
        )
    for name in ("observations", "unknowns", "redundancy", "iterations", "rounds"):
        yield f"{name:<25} {report[name]}"
    for name in ("images", "object_points", "image_points"):
        yield f"{name.replace('_', ' '):<25} {report[name]}"
    datum = f"free network, {settings.free_datum}" if settings.minimum_norm else "by observations"
    yield f"datum                     {datum}"
    yield f"robust weights            {settings.weight_function if settings.robust else 'none'}"
    yield from (*report["problems"], *report["cautions"], *report["not_determined"])


def _orientations(result: Adjustment) -> Iterator[str]:
    found = exposures_of(result)
    places = _decimals(np.array([o.position_sigma_m for o in found]))
    names = ("image", "X", "Y", "Z", "omega", "phi", "kappa", "sX", "sY", "sZ", "so", "sp", "sk")
    yield from _table(
        names,
        (
            (
                o.name,
                *(_fixed(v, places) for v in o.position_m),
                *(_fixed(math.degrees(v) * _GRAD, 6) for v in o.angles_rad),
                *(_fixed(v, places) for v in o.position_sigma_m),
                *(_fixed(math.degrees(v) * _GRAD, 6) for v in o.angles_sigma_rad),
            )
            for o in found
        ),
    )


def _points(result: Adjustment) -> Iterator[str]:
    count = len(result.network.points.names)
    taken = result.network.image_points.point[result.weight > 0.0]
    rays = np.bincount(taken, minlength=count)
    variance = np.einsum("nii->ni", result.point_cofactor)
    sigma = result.sigma0 * np.sqrt(np.clip(variance, 0.0, None))
    adjusted = np.flatnonzero(np.isfinite(variance).all(axis=1))
    places = _decimals(sigma[adjusted])
    yield from _table(
        ("point", "X", "Y", "Z", "sX", "sY", "sZ", "rays"),
        (
            (
                result.network.points.names[k],
                *(_fixed(v, places) for v in result.state.points[k]),
                *(_fixed(v, places) for v in sigma[k]),
                str(int(rays[k])),
            )
            for k in adjusted
        ),
    )
    if len(adjusted):
        mean = np.sqrt(np.mean(sigma[adjusted] ** 2, axis=0))
        yield "root mean square of the sigmas: " + " ".join(_fixed(v, places) for v in mean)


def _differences(found: PointDifferences) -> Iterator[str]:
    places = _decimals(found.sigma_m)
    yield from _table(
        ("point", "dX", "dY", "dZ", "sX", "sY", "sZ"),
        (
            (name, *(_fixed(v, places) for v in own), *(_fixed(v, places) for v in sigma))
            for name, own, sigma in zip(found.names, found.difference_m, found.sigma_m, strict=True)
        ),
    )
    with np.errstate(all="ignore"):
        rms = np.sqrt(np.nanmean(found.difference_m**2, axis=0))
    yield "root mean square: " + " ".join(_fixed(v, places) for v in rms)


def _residuals(result: Adjustment) -> Iterator[str]:
    rows, network = result.equations, result.network
    size = np.abs(result.standardised)
    own = np.flatnonzero((rows.group < 2) & np.isfinite(size))
    own = own[np.argsort(-size[own], kind="stable")][:_LARGEST]
    residual = image_residuals_mm(result) * 1e3
    table = network.image_points
    yield from _table(
        ("image", "point", "axis", "residual um", "redundancy", "standardised"),
        (
            (
                network.images.names[table.image[rows.source[k]]],
                network.points.names[table.point[rows.source[k]]],
                "xy"[rows.group[k]],
                _fixed(residual[rows.source[k], rows.group[k]], 3),
                _fixed(result.redundancy_number[k], 3),
                _fixed(result.standardised[k], 2),
            )
            for k in own
        ),
    )


def _correlations(result: Adjustment) -> Iterator[str]:
    groups = high_correlations(result, listed=_MAX_CORRELATIONS)
    if not groups:
        yield "none"
    for g in groups:
        where = "the same owner" if g.is_of_one else "different owners"
        yield f"{g.first_kind} and {g.second_kind} of {where}: {g.count}"
        for c in g.largest:
            yield f"  {c.first}, {c.second}: {c.value:.4f}"
        if g.count > len(g.largest):
            yield f"  {g.count - len(g.largest)} smaller ones are not listed"


def _reliability(reliability: Mapping[str, Any]) -> Iterator[str]:
    yield (
        f"limit {_digits(reliability['limit'], 4)} ({reliability['test']}), power "
        f"{reliability['power']:.2f}; minimal detectable bias (MDB)"
    )
    keys = ("detectable_median", "detectable_max", "bias_to_noise_max", "point_shift_max_m")
    yield from _table(
        ("kind", "not controlled", "MDB median", "max", "bias/noise", "point m", "unit", "weakest"),
        (
            (g["name"], f"{g['uncontrolled']} of {g['count']}", *(_digits(g[k], 3) for k in keys),
             g["unit"], g["weakest"] or "")
            for g in reliability["groups"]
        ),
    )  # fmt: skip


def _section(title: str) -> list[str]:
    return ["", title, "-" * len(title)]


def _table(names: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Columns as wide as their cells, the first to the left, the others to the right."""
    cells = [list(names), *([*row] for row in rows)]
    width = [max(len(row[k]) for row in cells) for k in range(len(names))]
    for row in cells:
        yield "  ".join(
            cell.ljust(width[k]) if k == 0 else cell.rjust(width[k]) for k, cell in enumerate(row)
        )


def _decimals(values: Array) -> int:
    """Decimals that show three digits of the median of positive values, at least three."""
    positive = values[np.isfinite(values) & (values > 0.0)]
    if not positive.size:
        return 4
    return int(np.clip(2 - math.floor(math.log10(float(np.median(positive)))), 3, 10))


def _fixed(value: float | None, digits: int) -> str:
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.{digits}f}"


def _digits(value: float | None, digits: int) -> str:
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.{digits}g}"

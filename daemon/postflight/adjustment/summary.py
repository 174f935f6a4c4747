"""Summary of an adjustment: one object for programs, tables and messages for people."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.adjustment.cautions import cautions_of, global_test
from daemon.postflight.adjustment.head_time_report import print_times, times_of
from daemon.postflight.adjustment.project import CheckPoints
from daemon.postflight.adjustment.reliability_report import reliability_summary, unit_of
from daemon.terminal.console import Console, light_table
from processing.bundle.adjust import Adjustment
from processing.bundle.adjustment_results import (
    NARROW_DEG,
    PointDifferences,
    check_point_differences,
    control_residuals,
    heads_of,
    narrow_points,
    parameters_of,
)
from processing.bundle.camera_model import perspective_mm
from processing.bundle.correlations import CORRELATION_LIMIT, high_correlations
from processing.bundle.data_snooping import names_of
from processing.bundle.residual_areas import residual_areas
from processing.bundle.self_calibration import parameter_count

Array = NDArray[np.float64]

_GRADS_PER_RAD = 200.0 / math.pi
_MAX_LISTED = 20


def report_of(
    result: Adjustment, checks: CheckPoints, *, name: str, seconds: float, peak_mib: float
) -> dict[str, Any]:
    """Everything but the bulk tables, as JSON would hold it; NaN becomes null."""
    network = result.network
    table = network.image_points
    against = check_point_differences(result, checks.names, checks.xyz_m, checks.sigma_m)
    control = control_residuals(result)
    limits, passed = global_test(result)
    content: dict[str, Any] = _plain(
        {
            "name": name,
            "sigma0": result.sigma0,
            "global_test": {"limits": limits, "passed": passed},
            "cautions": cautions_of(result, against),
            "redundancy": result.redundancy,
            "observations": result.observations,
            "unknowns": result.unknowns,
            "images": len(np.unique(table.image)),
            "image_points": int((result.weight > 0.0).sum()),
            "object_points": len(network.points.names) - int(result.left_out.sum()),
            "iterations": len(result.iterations) - 1,
            "seconds": round(seconds, 2),
            "peak_mib": round(peak_mib, 1),
            "groups": [
                {
                    "name": g.name,
                    "count": g.count,
                    "redundancy": g.redundancy,
                    "variance_factor": g.factor,
                    "rms": g.rms * unit_of(g.name)[1],
                    "worst": g.worst * unit_of(g.name)[1],
                    "unit": unit_of(g.name)[0],
                }
                for g in result.groups
            ],
            "cameras": [
                {
                    "name": camera.name,
                    "principal_distance_mm": f_mm,
                    "principal_point_mm": [xp_mm, yp_mm],
                    "parameters": parameter_count(camera),
                }
                for k, camera in enumerate(network.cameras)
                for f_mm, xp_mm, yp_mm in [perspective_mm(camera, result.state.interior[k])]
            ],
            "parameters": [
                {
                    "camera": p.camera,
                    "name": p.name,
                    "unit": p.unit,
                    "value": p.value,
                    "sigma": p.sigma,
                    "t": p.t,
                    "correlated": dict(p.high_correlations),
                    "dispensable": p.is_insignificant,
                }
                for p in parameters_of(result)
            ],
            "heads": [
                {
                    "name": h.name,
                    "angles_deg": np.degrees(h.angles_rad),
                    "angles_sigma_deg": np.degrees(h.angles_sigma_rad),
                    "angles_grad": h.angles_rad * _GRADS_PER_RAD,
                    "angles_sigma_grad": h.angles_sigma_rad * _GRADS_PER_RAD,
                    "offset_m": h.position_m,
                    "offset_sigma_m": h.position_sigma_m,
                }
                for h in heads_of(result)
            ],
            "times": times_of(result),
            "gnss_lines": _lines(result),
            "control": _agreement(control),
            "checks": _agreement(against),
            "rejected": [
                {
                    "image": network.images.names[table.image[k]],
                    "point": network.points.names[table.point[k]],
                }
                for k in np.flatnonzero(result.rejected)
            ],
            "excluded": names_of(network, result.excluded),
            "rounds": result.rounds,
            "problems": result.problems,
            "reliability": reliability_summary(result),
            "correlations": _correlations(result),
            "areas": _areas(result),
            "left_out": [network.points.names[k] for k in np.flatnonzero(result.left_out)],
            "narrow_points": [
                {"point": name, "angle_deg": angle} for name, angle in narrow_points(result)
            ],
            "not_determined": [d.sentence for d in result.rank_defects],
        }
    )
    return content


def print_report(console: Console, report: Mapping[str, Any]) -> None:
    """The report as tables of 80 columns."""
    console.print(
        f"{report['name']}: {report['images']} images, {report['object_points']} object "
        f"points, {report['image_points']} image points",
        highlight=False,
    )
    console.print(
        f"sigma0 {_number(report['sigma0'], 5)}, redundancy {report['redundancy']}, "
        f"{report['observations']} observations, {report['unknowns']} unknowns, "
        f"{report['iterations']} iterations, {report['seconds']} s, {report['peak_mib']} MiB",
        highlight=False,
    )
    test = report["global_test"]
    if test["limits"]:
        low, high = test["limits"]
        console.print(
            f"Global test: sigma0 is {'inside' if test['passed'] else 'outside'} {low:.4g} to "
            f"{high:.4g}, the interval of 99 % for sigmas that are right",
            highlight=False,
        )
    for sentence in report["cautions"]:
        console.print(sentence, style="yellow", markup=False, highlight=False)
    groups = light_table(
        "Observations", ("",), ("count", "redundancy", "RMS", "worst", "unit", "variance factor")
    )
    for g in report["groups"]:
        factor = "" if g["variance_factor"] is None else f"{g['variance_factor']:.3f}"
        groups.add_row(
            g["name"], str(g["count"]), f"{g['redundancy']:.1f}", f"{g['rms']:.4g}",
            f"{g['worst']:.4g}", g["unit"], factor,
        )  # fmt: skip
    console.print(groups)
    if report["parameters"]:
        table = light_table(
            "Interior orientation", ("camera", "parameter"), ("value", "sigma", "unit", "t", "")
        )
        for p in report["parameters"]:
            table.add_row(
                p["camera"], p["name"], f"{p['value']:.6g}", _number(p["sigma"], 3), p["unit"],
                "-" if p["t"] is None else f"{p['t']:.1f}",
                "may be dropped" if p["t"] is not None and p["t"] < 2.0 else "",
            )  # fmt: skip
        console.print(table)
        _print_correlations(console, report)
    for c in report["cameras"]:
        x, y = c["principal_point_mm"]
        console.print(
            f"{c['name']}: principal distance {c['principal_distance_mm']:.6f} mm, principal point "
            f"{x:.6f} {y:.6f} mm",
            highlight=False,
        )
    if report["heads"]:
        table = light_table("Heads against the rig", ("",), ("omega", "phi", "kappa", "unit"))
        for h in report["heads"]:
            for unit, digits in (("deg", 5), ("grad", 5)):
                cells = [
                    f"{v:.{digits}f}" + ("" if s is None else f" ± {s:.{digits}f}")
                    for v, s in zip(h[f"angles_{unit}"], h[f"angles_sigma_{unit}"], strict=True)
                ]
                table.add_row(h["name"], *cells, unit)
        console.print(table)
    print_times(console, report["times"])
    for key, title in (("control", "Control points"), ("checks", "Check points")):
        a = report[key]
        if a["count"]:
            rms, predicted = a["rms_m"], a["predicted_m"]
            console.print(
                f"{title}: {a['count']}, RMS "
                + " ".join("-" if v is None else f"{v:.4f}" for v in rms)
                + " m, "
                + ("predicted " if key == "checks" else "a priori ")
                + " ".join("-" if v is None else f"{v:.4f}" for v in predicted)
                + " m",
                highlight=False,
            )
    if report["rejected"]:
        listed = ", ".join(
            f"{r['point']} in {r['image']}" for r in report["rejected"][:_MAX_LISTED]
        )
        console.print(f"{len(report['rejected'])} image points left out: {listed}", markup=False)
    if report["excluded"]:
        listed = ", ".join(report["excluded"][:_MAX_LISTED])
        console.print(
            f"{len(report['excluded'])} other observations left out: {listed}",
            markup=False,
            highlight=False,
        )
    if report["rounds"]:
        console.print(
            f"Data snooping: {report['rounds']} rounds, "
            f"{len(report['rejected']) + len(report['excluded'])} observations left out, "
            + ("not final" if report["problems"] else "none left beyond the limit"),
            highlight=False,
        )
    _print_wide_correlations(console, report["correlations"])
    _print_reliability(console, report["reliability"])
    if report["left_out"]:
        listed = ", ".join(report["left_out"][:_MAX_LISTED])
        console.print(
            f"{len(report['left_out'])} object points that their rays do not fix: {listed}",
            markup=False,
        )
    if report["narrow_points"]:
        listed = ", ".join(
            f"{p['point']} ({p['angle_deg']:.2g} deg)"
            for p in report["narrow_points"][:_MAX_LISTED]
        )
        console.print(
            f"{len(report['narrow_points'])} object points have rays less than {NARROW_DEG:g} "
            f"degree apart, their depth is weak: {listed}",
            markup=False,
            highlight=False,
        )
    for sentence in report["problems"]:
        console.print(sentence, style="red", markup=False, highlight=False)
    for sentence in report["not_determined"]:
        console.print(sentence, markup=False, highlight=False)


def _print_correlations(console: Console, report: Mapping[str, Any]) -> None:
    printed = set()
    for p in report["parameters"]:
        for other, value in p["correlated"].items():
            pair = (p["camera"], *sorted((p["name"], other)))
            if pair not in printed:
                printed.add(pair)
                console.print(
                    f"{p['camera']}: {p['name']} and {other} correlate by {value:.3f}: hardly "
                    "separable, one may be dropped",
                    highlight=False,
                )


def _print_wide_correlations(console: Console, correlations: Mapping[str, Any]) -> None:
    for g in correlations["groups"]:
        largest = g["largest"][0]
        console.print(
            f"{g['count']} correlations beyond {correlations['limit']:g} of {g['first_kind']} and "
            f"{g['second_kind']}{' of one owner' if g['is_of_one'] else ''}, largest "
            f"{largest['first']} and {largest['second']}: {largest['value']:.4f}",
            markup=False,
            highlight=False,
        )


def _print_reliability(console: Console, reliability: Mapping[str, Any]) -> None:
    tests = f", {reliability['tests']} tests" if reliability["tests"] else ""
    console.print(
        f"Reliability: limit {_number(reliability['limit'], 4)} ({reliability['test']}{tests}), "
        f"power {reliability['power']:.0%}",
        highlight=False,
    )
    columns = ("uncontrolled", "MDB median", "MDB max", "unit", "bias/noise", "point m")
    table = light_table("Minimal detectable bias", ("",), columns)
    for g in reliability["groups"]:
        figures = ("detectable_median", "detectable_max", "bias_to_noise_max", "point_shift_max_m")
        median, largest, ratio, shift = (_number(g[key], 3) for key in figures)
        table.add_row(
            g["name"],
            f"{g['uncontrolled']} of {g['count']}",
            median,
            largest,
            g["unit"],
            ratio,
            shift,
        )
    console.print(table)


def _correlations(result: Adjustment) -> dict[str, Any]:
    groups = high_correlations(result)
    return {
        "limit": CORRELATION_LIMIT,
        "count": sum(g.count for g in groups),
        "groups": [
            {
                "first_kind": g.first_kind,
                "second_kind": g.second_kind,
                "is_of_one": g.is_of_one,
                "count": g.count,
                "largest": [
                    {"first": c.first, "second": c.second, "value": c.value} for c in g.largest
                ],
            }
            for g in groups
        ],
    }


def _areas(result: Adjustment) -> dict[str, Any]:
    areas = residual_areas(result)
    rows = zip(areas.centre_m, areas.count, areas.rms_mm * 1e3, areas.mean_mm * 1e3, strict=True)
    return {
        "size_m": areas.size_m,
        "cells": [
            {"x_m": x, "y_m": y, "count": n, "rms_um": rms, "mean_x_um": vx, "mean_y_um": vy}
            for (x, y), n, rms, (vx, vy) in rows
        ],
    }


def _lines(result: Adjustment) -> list[dict[str, Any]]:
    gnss, layout = result.network.gnss, result.layout
    spread = result.sigma0 * np.sqrt(np.clip(result.cofactors.diagonal(), 0.0, None))

    def sigma(columns: NDArray[np.int64]) -> list[float]:
        return [float(spread[c]) if c >= 0 else math.nan for c in columns]

    if gnss.drift == "none":
        return []
    return [
        {
            "line": line,
            "shift_m": result.state.shift[k],
            "shift_sigma_m": sigma(layout.shift[k]),
            "drift_m_per_s": result.state.drift[k],
            "drift_sigma_m_per_s": sigma(layout.drift[k]),
        }
        for k, line in enumerate(gnss.lines)
    ]


def _agreement(found: PointDifferences) -> dict[str, Any]:
    if not found.names:
        return {"count": 0, "rms_m": [], "predicted_m": [], "squares": math.nan}
    with np.errstate(all="ignore"):
        rms = np.sqrt(np.nanmean(found.difference_m**2, axis=0))
        predicted = np.sqrt(np.nanmean(found.sigma_m**2, axis=0))
    return {
        "count": len(found.names),
        "rms_m": rms,
        "predicted_m": predicted,
        "squares": found.squares,
    }


def _number(value: float | None, digits: int) -> str:
    """Significant digits, or a dash where there is no value."""
    return "-" if value is None else f"{value:.{digits}g}"


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value

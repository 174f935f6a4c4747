"""The report of a radiometric calibration: EMVA 1288 figures, defects, model and checks."""

from __future__ import annotations

import math
from collections.abc import Sequence
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
from daemon.postflight.calibration.laboratory.laboratory_report import of_series
from daemon.postflight.calibration.laboratory.laboratory_series import LaboratorySeries
from daemon.postflight.calibration.laboratory.radiometric import HeadCalibration
from daemon.postflight.calibration.laboratory.radiometric_maps import maps_against
from daemon.postflight.plots import Curve, chart_svg, histogram_svg, map_svg
from processing.calibration.radiometric.defects import relative_response

RATIO_BAR: Final = 1.05
"""Corrected flat fields within 5 % of photon transfer are limited by shot noise."""
_SAME_TEMPERATURE_K: Final = 2.0


def quantities_of(head: HeadCalibration) -> list[Quantity]:
    """Values of this sensor that the next calibration is compared with."""
    where, t = head.sensor.name, head.transfer
    pixels = float((head.defects.mask == 0).sum())
    level = float(np.median(head.dark.dark_dn_per_s))
    found = [
        Quantity(where, "system gain K", "DN/e", t.gain_dn_per_e, t.gain_sigma),
        Quantity(where, "dark noise", "e", t.temporal_dark_noise_e, t.dark_noise_sigma_e),
        Quantity(where, "saturation", "e", t.saturation_e, None),
        Quantity(where, "dynamic range", "dB", 20.0 * math.log10(t.dynamic_range), None),
        Quantity(where, "linearity error", "%", t.linearity_percent, None),
        Quantity(where, "PRNU", "%", 100.0 * head.prnu.total, 100.0 * head.prnu.sigma),
        Quantity(where, "DSNU", "DN", head.dsnu_dn.total, head.dsnu_dn.sigma),
        Quantity(
            where,
            "dark signal doubling",
            "K",
            head.dark.doubling_k,
            head.dark.doubling_sigma_k,
        ),
        Quantity(
            where,
            "median dark signal",
            "DN/s",
            level,
            math.hypot(
                1.2533 * head.dark.dark_sigma_dn_per_s / math.sqrt(pixels),
                head.dark.common_sigma * level,
            ),
        ),
        Quantity(where, "defect pixels", "px", float((head.defects.mask != 0).sum()), None),
    ]
    if head.response_per_k is not None:
        value, sigma = head.response_per_k
        found.append(Quantity(where, "response", "%/K", 100.0 * value, 100.0 * sigma))
    return found


def radiometric_report(
    series: LaboratorySeries[Any],
    heads: Sequence[HeadCalibration],
    *,
    calibration_id: str,
    date: str,
    apertures: Sequence[float],
    previous: tuple[Path, Previous] | None,
) -> CalibrationReport:
    """Build the report."""
    quantities = [q for head in heads for q in quantities_of(head)]
    worst = max((c.ratio for h in heads for _, c in h.checks), default=None)
    verdicts = [
        f"{len(heads)} sensors from {sum(h.frames for h in heads)} frames; maps for "
        + ", ".join(f"f/{f:g}" for f in apertures)
        + "."
    ]
    warnings = []
    if worst is None:
        warnings.append('No image was set apart (`use` = "check"): nothing was verified.')
    else:
        sentence = (
            f"Corrected flat fields leave at most {worst:.3f} of what photon transfer predicts"
        )
        if worst <= RATIO_BAR:
            verdicts.append(f"{sentence}: limited by shot noise.")
        else:
            warnings.append(f"{sentence}; up to {RATIO_BAR:g} is limited by shot noise.")
    for head in heads:
        warnings += _warnings(head)
    tables = [_emva(heads), _defects(heads), _functional(heads), _checks(heads)]
    if previous is not None:
        compared = maps_against(previous[0], heads, apertures[0])
        if compared is not None:
            tables.append(compared)
    report = CalibrationReport(
        kind="radiometric",
        title=f"Radiometric calibration of {series.rig.name}",
        calibration_id=calibration_id,
        date=date,
        facts=[
            ("sensors", ", ".join(h.sensor.name for h in heads)),
            ("frames", str(sum(h.frames for h in heads))),
        ],
        serials={},
        quantities=quantities,
        figures={h.sensor.name: _figures(h) for h in heads},
        verdicts=verdicts,
        warnings=warnings,
        tables=tables,
        plots=[plot for head in heads for plot in _plots(head)],
    )
    sensors = {h.sensor.name for h in heads}
    return of_series(report, series, sensors=sensors, previous=previous)


def _warnings(head: HeadCalibration) -> list[str]:
    found = []
    name = head.sensor.name
    if head.response_per_k is None:
        found.append(
            f"{name}: flat sets of one temperature; the maps hold one response for all temperatures"
        )
    if head.dark.misfit > 1.2:
        found.append(
            f"{name}: the dark model leaves {head.dark.misfit:.2f} of the frames' noise; look for "
            "light leaks or a probe that is not at the sensor"
        )
    given, k = head.sensor.electrons_per_dn, head.transfer.gain_dn_per_e
    if abs(1.0 / k - given) > 0.02 * given:
        found.append(
            f"{name}: the rig file has electrons_per_dn = {given:g}, measured is {1.0 / k:.4g}"
        )
    return found


def _emva(heads: Sequence[HeadCalibration]) -> ReportTable:
    rows = []
    for h in heads:
        t = h.transfer
        rows.append(
            (
                h.sensor.name,
                f"{t.gain_dn_per_e:.6f} ± {t.gain_sigma:.6f}",
                f"{t.temporal_dark_noise_e:.2f} ± {t.dark_noise_sigma_e:.2f}",
                f"{t.saturation_e:.0f}",
                f"{t.absolute_threshold_e:.1f}",
                f"{t.dynamic_range:.0f} = {20 * math.log10(t.dynamic_range):.1f} dB",
                f"{t.snr_max:.0f} = {20 * math.log10(t.snr_max):.1f} dB",
                f"{t.linearity_percent:.3f}",
                f"{100 * h.prnu.total:.3f} ({100 * h.prnu.column:.3f} {100 * h.prnu.row:.3f} "
                f"{100 * h.prnu.pixel:.3f})",
                f"{h.dsnu_dn.total / t.gain_dn_per_e:.2f} ({h.dsnu_dn.column / t.gain_dn_per_e:.2f}"
                f" {h.dsnu_dn.row / t.gain_dn_per_e:.2f} {h.dsnu_dn.pixel / t.gain_dn_per_e:.2f})",
            )
        )
    return ReportTable(
        "In the manner of EMVA 1288",
        (
            "sensor",
            "K DN/e",
            "dark noise e",
            "saturation e",
            "threshold e",
            "dynamic range",
            "best SNR",
            "linearity error %",
            "PRNU % (columns, rows, pixels)",
            "DSNU e (columns, rows, pixels)",
        ),
        rows,
        "Saturation is the step of the ladder with the largest variance. Linearity: mean "
        "deviation from the line of least relative deviations, 5 to 95 % of saturation. PRNU and "
        "DSNU of good pixels, high-passed: what the lens makes of even light is in the gain, not "
        "in PRNU.",
    )


def _defects(heads: Sequence[HeadCalibration]) -> ReportTable:
    rows = []
    for h in heads:
        d = h.defects
        columns = "; ".join(
            f"{c.column}: {c.first_row}-{c.last_row} ({c.cause})" for c in d.columns[:8]
        )
        more = f" and {len(d.columns) - 8} more" if len(d.columns) > 8 else ""
        rows.append(
            (
                h.sensor.name,
                int((d.mask != 0).sum()),
                d.single_pixels,
                f"{len(d.clusters)} ({', '.join(str(c) for c in d.clusters[:6])})",
                f"{len(d.columns)}: {columns}{more}" if d.columns else "0",
                ", ".join(f"{cause} {n}" for cause, n in d.by_cause.items()),
            )
        )
    return ReportTable(
        "Defects",
        ("sensor", "pixels", "single", "clusters (px)", "columns: rows", "stand out by"),
        rows,
    )


def _functional(heads: Sequence[HeadCalibration]) -> ReportTable:
    rows = []
    for h in heads:
        a = h.aperture
        per_k = "–"
        if h.response_per_k is not None:
            per_k = f"{100 * h.response_per_k[0]:+.4f} ± {100 * h.response_per_k[1]:.4f}"
            per_k += "" if h.follows_temperature else " (taken as none)"
        rows.append(
            (
                h.sensor.name,
                f"{h.dark.doubling_k:.3f} ± {h.dark.doubling_sigma_k:.3f}",
                f"{float(np.median(h.dark.dark_dn_per_s)):.4g}",
                f"{h.dark.misfit:.3f}",
                per_k,
                ", ".join(f"{c:+.4f}" for c in a.coefficients),
                ", ".join(f"f/{f:g} {m:.3f}" for f, m in a.misfit_percent.items()) or "–",
                ", ".join(f"f/{f:g} {v:.4f}" for f, v in a.illumination.items()),
            )
        )
    return ReportTable(
        "Functional model",
        (
            "sensor",
            "dark doubles every K",
            f"median dark DN/s at {heads[0].dark.reference_c:g} degC" if heads else "",
            "misfit, sigmas",
            "response %/K",
            "aperture: r2, r4, r6, r8",
            "misfit %",
            "light against 1/N2",
        ),
        rows,
        "Light field at f-number N over that at the base N0: 1 + ((N0/N)^2 - 1) * polynomial in "
        "(r / farthest pixel)^2. With N TDI shifts, dark and response are means over the N + 1 "
        "pixels a charge visited.",
    )


def _checks(heads: Sequence[HeadCalibration]) -> ReportTable:
    rows = [
        (h.sensor.name, title, c.mean_dn, c.residual_dn, c.ratio)
        for h in heads
        for title, c in h.checks
    ]
    return ReportTable(
        "Frames set apart, corrected",
        ("sensor", "condition", "signal DN", "residual DN", "residual over photon transfer"),
        rows,
        "Corrected by the pass used in flight, nothing smooth taken off, defects not counted.",
    )


def _figures(head: HeadCalibration) -> dict[str, Any]:
    d, t, a = head.defects, head.transfer, head.aperture
    return {
        "linearity_deviation_percent": [
            None if math.isnan(v) else float(v) for v in t.deviation_percent
        ],
        "ladder_signal_dn": [float(v) for v in head.ladder.signal_dn],
        "ladder_variance_dn2": [float(v) for v in head.ladder.variance_dn2],
        "gain_noise": head.gain_noise,
        "bias_sigma_dn": head.dark.bias_sigma_dn,
        "dark_sigma_dn_per_s": head.dark.dark_sigma_dn_per_s,
        "dark_misfit": head.dark.misfit,
        "defects": {
            "single": d.single_pixels,
            "clusters": list(d.clusters),
            "columns": [[c.column, c.first_row, c.last_row] for c in d.columns],
        },
        "aperture": {
            "base_f_number": a.base_f_number,
            "reach_mm": a.reach_mm,
            "coefficients": [float(c) for c in a.coefficients],
            "misfit_percent": {f"{f:g}": m for f, m in a.misfit_percent.items()},
        },
        "checks": [
            {
                "condition": title,
                "mean_dn": c.mean_dn,
                "residual_dn": c.residual_dn,
                "ratio": c.ratio,
            }
            for title, c in head.checks
        ],
    }


def _plots(head: HeadCalibration) -> list[Plot]:
    name, t, ladder = head.sensor.name, head.transfer, head.ladder
    line = np.array([1.0, t.saturation_dn])
    model = t.variance_dn2(line, ladder.dark_dn2)
    grid = np.geomspace(1.0, t.saturation_dn, 60)
    signal = np.maximum(ladder.signal_dn, 1e-9)
    ratio = signal / np.sqrt(ladder.variance_dn2)
    good = head.defects.mask == 0
    relative = relative_response(head.signal_per_light)
    dark_curves = []
    left = sorted(head.dark_levels, key=lambda level: level[1])
    while left:
        # Sets of one temperature of the chamber, which is never quite the same.
        own = sorted(level for level in left if level[1] - left[0][1] < _SAME_TEMPERATURE_K)
        left = [level for level in left if level not in own]
        label = f"{np.mean([t for _, t, _ in own]):.1f} degC"
        dark_curves.append(Curve(label, [s for s, _, _ in own], [dn for _, _, dn in own]))
    return [
        Plot(
            f"{name}: photon transfer",
            chart_svg(
                f"{name}: temporal variance against signal",
                ("signal DN", "variance DN²"),
                [
                    Curve("measured", ladder.signal_dn, ladder.variance_dn2, joined=False),
                    Curve(f"K = {t.gain_dn_per_e:.5f} DN/e", line, model),
                ],
            ),
        ),
        Plot(
            f"{name}: linearity",
            chart_svg(
                f"{name}: deviation from the line, mean {t.linearity_percent:.3f} %",
                ("signal DN", "deviation %"),
                [
                    Curve("measured", ladder.signal_dn, t.deviation_percent, joined=False),
                    Curve("", [0.0, t.saturation_dn], [0.0, 0.0], dashed=True),
                ],
            ),
        ),
        Plot(
            f"{name}: signal to noise",
            chart_svg(
                f"{name}: signal to noise",
                ("signal DN", "ratio"),
                [
                    Curve("measured", signal, ratio, joined=False),
                    Curve("model", grid, grid / np.sqrt(t.variance_dn2(grid, ladder.dark_dn2))),
                ],
                log=True,
            ),
        ),
        Plot(
            f"{name}: dark signal",
            chart_svg(
                f"{name}: doubles every {head.dark.doubling_k:.2f} K",
                ("exposure time s", "mean above bias DN"),
                dark_curves,
            ),
        ),
        Plot(
            f"{name}: response of pixels",
            histogram_svg(
                f"{name}: response against its surroundings",
                "relative difference",
                relative,
                bins=120,
                log=True,
            ),
            "Logarithmic: a single pixel is visible; an outlier is a defect.",
        ),
        Plot(
            f"{name}: dark signal of pixels",
            histogram_svg(
                f"{name}: dark signal",
                "DN/s",
                head.dark.dark_dn_per_s[good],
                bins=120,
                log=True,
            ),
            "Good pixels only.",
        ),
        Plot(f"{name}: gain", map_svg(f"{name}: gain", head.gain, "")),
    ]

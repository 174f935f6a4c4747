"""Figures of the quality report that come from pixels and stitching, by their documented names.

Figures from the conditions alone are in `processing.geometry.conditions`; what the figures mean for
the crew is decided in `processing.quality.report`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.image.balance import Balance
from processing.image.colour import BandRegistration
from processing.image.sharpness import bright_level, sharpness
from processing.matching.tie_points import PAN_TO_COLOUR, PAN_TO_PAN, TiePoints
from processing.mosaic.estimated_dc import EstimatedDc, combined_dc
from processing.mosaic.free_mosaic import Mosaic
from processing.mosaic.validity import Validity
from processing.quality.report import Figure
from processing.quality.valid_area import ValidArea
from processing.radiometry.level1 import FrameStatistics
from processing.rig import Rig, Sensor

Array = NDArray[Any]


def frame_figures(
    sensors: Sequence[Sensor],
    frames: Sequence[Array],
    rows: Sequence[tuple[int, int]],
    statistics: Sequence[FrameStatistics],
) -> dict[str, Figure]:
    """Brightness, saturation and sharpness of the PAN sensors that are there.

    Args:
        frames: Level-1 words, one per sensor.
        rows: first and last exposed row, one pair per sensor.
    """
    if not sensors:
        return {}
    worst = max(range(len(sensors)), key=lambda k: statistics[k].saturated_fraction)
    detail = [
        sharpness(s, frame, exposed)
        for s, frame, exposed in zip(sensors, frames, rows, strict=True)
    ]
    ways = [[pair[k] for pair in detail if pair[k] is not None] for k in (0, 1)]
    medians = [float(np.median(np.array(way, np.float64))) for way in ways if way]
    return {
        "mean_dn": float(np.mean([s.mean_dn for s in statistics])),
        "saturated_fraction": float(np.mean([s.saturated_fraction for s in statistics])),
        "saturated_worst_fraction": statistics[worst].saturated_fraction,
        "saturated_worst_sensor": sensors[worst].name,
        "bright_fraction": bright_level(sensors, frames),
        "sharpness": min(medians) if medians else None,
    }


def stitching_figures(
    rig: Rig,
    tie_points: TiePoints,
    mosaic: Mosaic,
    *,
    validity: Validity | None,
    balance: Balance,
    bands: Sequence[BandRegistration],
    present: Collection[str],
) -> dict[str, Figure]:
    """Tie points, adjustment, displaced sensor, balance and colour registration.

    Overlaps of sensors that are not `present` do not count as poor in tie points.
    """
    displacement_figures = mosaic.redundancy > 0
    unknowns = dict.fromkeys(name.split(".")[0] for name in mosaic.undetermined)
    figures: dict[str, Figure] = {
        "method": mosaic.method,
        "sigma0": mosaic.sigma0 if displacement_figures else None,
        "sigma0_px": mosaic.sigma0_px if displacement_figures else None,
        "sigma0_um": mosaic.sigma0_um if displacement_figures else None,
        "redundancy": mosaic.redundancy,
        "outliers": int(np.count_nonzero(mosaic.outliers)),
        "undetermined": ", ".join(unknowns) or None,
        "balance_spread": balance.spread,
        "gain_outlier": None if balance.outlier is None else balance.outlier[0],
        "gain_outlier_signal": None if balance.outlier is None else balance.outlier[1],
    }
    figures |= _tie_point_counts(rig, tie_points, mosaic, present)
    figures |= _displacement(validity)
    for band in bands:
        figures[f"{band.band}_points"] = band.points
        figures[f"{band.band}_rms_px"] = band.rms_px
    return figures


def valid_area_figures(area: ValidArea) -> dict[str, Figure]:
    """The band with the smallest valid share, and that share; no band where all are whole."""
    shares = {band: area.share(band) for band in area.gaps}
    worst = min(shares, key=lambda band: shares[band], default=None)
    return {
        "valid_worst_fraction": 1.0 if worst is None else shares[worst],
        "valid_worst_band": worst,
    }


def estimated_dc_figures(estimates: Sequence[EstimatedDc]) -> dict[str, Figure]:
    """dC by stitching over all cones with an estimate, and the cones whose probes disagree."""
    combined = combined_dc(estimates)
    return {
        "dc_estimated_k": None if combined is None else combined[0],
        "dc_estimated_sigma_k": None if combined is None else combined[1],
        "dc_disagreement": ", ".join(e.cone for e in estimates if e.disagrees) or None,
    }


def _tie_point_counts(
    rig: Rig, tie_points: TiePoints, mosaic: Mosaic, present: Collection[str]
) -> dict[str, Figure]:
    used = ~mosaic.outliers
    pan = {s.name for cone in rig.pan_cones for s in cone.sensors if s.name in present}
    overlaps = {
        pair: count for pair, count in mosaic.used.items() if pair[0] in pan and pair[1] in pan
    }
    colour = used & (tie_points.kind == PAN_TO_COLOUR)
    figures: dict[str, Figure] = {
        "tie_points_pp": int(np.count_nonzero(used & (tie_points.kind == PAN_TO_PAN))),
        "tie_points_pc": int(np.count_nonzero(colour)),
    }
    if overlaps:
        poorest = min(overlaps, key=lambda pair: overlaps[pair])
        figures["tie_points_min_overlap"] = overlaps[poorest]
        figures["tie_points_min_overlap_name"] = "-".join(poorest)
    if rig.virtual_image is not None and colour.any():
        squares = np.sum(mosaic.residuals_px[colour] ** 2, axis=1)
        figures["green_rms_px"] = float(np.sqrt(squares.mean())) / rig.virtual_image.colour_ratio
    return figures


def _displacement(validity: Validity | None) -> Mapping[str, Figure]:
    if validity is None or not validity.hypotheses:
        return {"displaced_sensor": None}
    first = validity.hypotheses[0]
    figures: dict[str, Figure] = {
        "displaced_sensor": None,
        "displacement_test": first.statistic / validity.limit,
        "relative_displacements": ", ".join(
            f"{pair.sensor_a}-{pair.sensor_b}" for pair in validity.relative if pair.significant
        )
        or None,
    }
    if validity.probe_bias is not None:
        figures |= {
            "misread_probe": validity.probe_bias.probe,
            "misread_k": validity.probe_bias.bias_k,
            "misread_sigma_k": validity.probe_bias.sigma_k,
        }
    if validity.displaced is not None:
        figures |= {
            "displaced_sensor": None if validity.several_displaced else validity.displaced.sensor,
            "displaced_alternatives": ", ".join(validity.alternatives) or None,
            "displaced_several": 1 if validity.several_displaced else None,
            "displacement_x_px": validity.displaced.dx_px,
            "displacement_y_px": validity.displaced.dy_px,
            "displacement_sigma_px": max(
                validity.displaced.sigma_x_px, validity.displaced.sigma_y_px
            ),
        }
    return figures

"""The report of an adjustment as one HTML page with its drawings in it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from daemon.postflight.adjustment.adjustment_plots import (
    ResidualPanel,
    areas_svg,
    block_svg,
    pattern_svg,
)
from daemon.postflight.adjustment.project import CheckPoints
from daemon.terminal.console import visible_value
from processing.bundle.adjust import Adjustment
from processing.bundle.adjustment_results import (
    check_point_differences,
    control_residuals,
    systematic_residuals,
)
from processing.bundle.residual_areas import residual_areas

_CELLS = (16, 11)
_MIN_POINTS = 200
_MIN_AREAS = 4


def report_page(result: Adjustment, checks: CheckPoints, report: Mapping[str, Any]) -> str:
    """The page; `report` is what `report_of` made of the same adjustment."""
    network, table = result.network, result.network.image_points
    panels = []
    for index, camera in enumerate(network.cameras):
        own = network.images.camera[table.image] == index
        if int((own & (result.weight > 0.0)).sum()) < _MIN_POINTS:
            continue
        pattern = systematic_residuals(result, index, _CELLS)
        middle = (table.xy_mm[own].max(axis=0) + table.xy_mm[own].min(axis=0)) / 2.0
        half = (table.xy_mm[own].max(axis=0) - table.xy_mm[own].min(axis=0)) / 2.0
        centred = type(pattern)(pattern.places_mm - middle, pattern.mean_mm, pattern.count)
        worst = float(np.hypot(*pattern.mean_mm.T).max()) * 1e3
        title = f"{camera.name}: at most {worst:.3g} um"
        panels.append(ResidualPanel(title, centred, (float(half[0]), float(half[1]))))
    drawings = []
    if panels:
        drawings.append(pattern_svg(panels, "Mean image residuals (computed less measured)"))
    if np.isfinite(result.point_cofactor).all(axis=(1, 2)).any():
        against = check_point_differences(result, checks.names, checks.xyz_m, checks.sigma_m)
        drawings.append(block_svg(result, control_residuals(result), against, "From above"))
    areas = residual_areas(result)
    if len(areas.count) >= _MIN_AREAS:
        drawings.append(areas_svg(areas, "Image residuals by area of the ground"))
    loader = jinja2.FileSystemLoader(Path(__file__).parents[1] / "templates")
    environment = jinja2.Environment(
        loader=loader,
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=visible_value,
    )
    page = environment.get_template("adjustment.html")
    # The template takes drawings as they are: they are our own and escape what comes from files.
    return page.render(r=report, drawings=drawings)

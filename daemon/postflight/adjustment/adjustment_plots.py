"""Plots of an adjustment: systematic image residuals, and the block from above.

Source of the first picture: Ladstädter et al. (2010), fig. 10.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from daemon.postflight.plots import (
    FAINT,
    INK,
    VECTOR,
    field_of_vectors,
    legend,
    lines,
    scale_bar,
    svg_of,
)
from processing.bundle.adjust import Adjustment
from processing.bundle.adjustment_results import PointDifferences, ResidualPattern
from processing.bundle.residual_areas import ResidualAreas

Array = NDArray[np.float64]

_CONTROL: Final = "#2f6fb3"
_CHECK: Final = "#2d8a57"
_MAX_POINTS: Final = 6000


@dataclass(frozen=True)
class ResidualPanel:
    """One picture of mean residuals; `half_mm` are half width and height of the image."""

    title: str
    pattern: ResidualPattern
    half_mm: tuple[float, float]


def pattern_svg(panels: Sequence[ResidualPanel], title: str) -> str:
    """Mean image residuals of one or more adjustments or cameras, side by side in one scale.

    y is up, in flight direction; the bar below each shows the scale.
    """
    longest = max([float(np.hypot(*p.pattern.mean_mm.T).max(initial=0.0)) for p in panels] + [1e-9])
    high = max(panel.half_mm[1] / panel.half_mm[0] for panel in panels)

    def draw(figure: Figure) -> None:
        figure.suptitle(title, weight="bold", x=0.01, ha="left")
        for plot, panel in zip(
            figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True
        ):
            pattern = panel.pattern
            field_of_vectors(
                plot, pattern.places_mm, pattern.mean_mm, panel.half_mm, longest, ("um", 1e3)
            )
            plot.set_title(panel.title, weight="normal")

    return svg_of(draw, (0.4 + 5.2 * len(panels), 1.4 + 5.0 * high))


def block_svg(
    result: Adjustment, control: PointDifferences, checks: PointDifferences, title: str
) -> str:
    """The block from above: projection centres, object points, control and check points.

    Differences at control and check points are vectors in plan and bars in height, in one scale.
    """
    images = np.unique(result.network.image_points.image[result.weight > 0.0])
    station = result.state.station[np.unique(result.network.images.station[images])]
    good = np.flatnonzero(np.isfinite(result.point_cofactor).all(axis=(1, 2)))
    near = ~result.network.points.at_infinity[good]
    ground = result.state.points[good[near]]
    everything = np.concatenate([station, ground])[:, :2]
    span = np.maximum(np.ptp(everything, axis=0), 1e-9)
    size = float(span.max())
    differences = [
        a.difference_m[np.isfinite(a.difference_m).all(axis=1)] for a in (control, checks)
    ]
    longest = max([float(np.abs(d).max(initial=0.0)) for d in differences] + [1e-12])
    enlarge = 0.06 * size / longest
    bar_m = float(10.0 ** np.floor(np.log10(longest)))
    names = {name: k for k, name in enumerate(result.network.points.names)}

    def draw(figure: Figure) -> None:
        plot = figure.subplots()
        step = max(1, len(ground) // _MAX_POINTS)
        plot.plot(*ground[::step, :2].T, ".", color=FAINT, markersize=1.0, label="object points")
        plot.plot(*station[:, :2].T, "+", color=INK, markersize=5.0, label="projection centres")
        for found, colour, label in ((control, _CONTROL, "control"), (checks, _CHECK, "checks")):
            if not found.names:
                continue
            at = result.state.points[[names[name] for name in found.names]][:, :2]
            off = np.nan_to_num(found.difference_m) * enlarge
            plot.plot(*at.T, "^", color=colour, markersize=6.0, fillstyle="none", label=label)
            lines(plot, at, at + off[:, :2], VECTOR)
            aside = at + np.array([0.012 * size, 0.0])
            lines(plot, aside, aside + np.column_stack([np.zeros(len(off)), off[:, 2]]), colour)
        plot.set(aspect="equal", xticks=[], yticks=[])
        plot.set_title(title)
        width = float(np.ptp(plot.get_xlim()))
        scale_bar(plot, bar_m * enlarge / width, f"{bar_m:g} m at points; red plan, bar height")
        legend(figure, plot)

    return svg_of(draw, (8.0, 1.4 + 7.0 * float(span[1] / size)))


def areas_svg(areas: ResidualAreas, title: str) -> str:
    """Areas of the ground in grey by their root mean square, with the mean residual as vector."""
    longest = max(float(np.hypot(*areas.mean_mm.T).max(initial=0.0)), 1e-12)
    low, high = areas.centre_m.min(axis=0), areas.centre_m.max(axis=0)
    span = high - low + areas.size_m
    index = np.round((areas.centre_m - low) / areas.size_m).astype(int)
    shape = index.max(axis=0) + 1
    image = np.full((shape[1], shape[0]), np.nan)
    image[index[:, 1], index[:, 0]] = areas.rms_mm * 1e3
    enlarge = 0.8 * areas.size_m / longest
    bar_mm = float(10.0 ** np.floor(np.log10(longest)))

    def draw(figure: Figure) -> None:
        plot = figure.subplots()
        left, bottom = low - 0.5 * areas.size_m
        edges = (float(left), float(left + span[0]), float(bottom), float(bottom + span[1]))
        shown = plot.imshow(image, cmap="Greys", origin="lower", extent=edges, vmin=0.0)
        figure.colorbar(shown, ax=plot, label="RMS um")
        lines(plot, areas.centre_m, areas.centre_m + enlarge * areas.mean_mm, VECTOR)
        plot.set(aspect="equal", xticks=[], yticks=[])
        plot.set_title(title)
        scale_bar(plot, bar_mm * enlarge / float(span[0]), f"{bar_mm * 1e3:g} um mean residual")

    return svg_of(draw, (8.0, 1.4 + 6.0 * float(span[1] / span.max())))

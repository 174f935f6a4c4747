"""Plots of reports and benchmarks as SVG text, drawn by matplotlib (the extra `plots`).

The same input gives the same bytes: no date, no random identifiers, text as text. What is drawn in
flight is in `processing.mosaic.mosaic_plots` and does without matplotlib.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from numpy.typing import NDArray

Values = Sequence[float] | NDArray[np.float64]
Array = NDArray[Any]

COLOURS: Final = ("#1f5fa8", "#c4572b", "#2d8a57", "#8a4fa3", "#a88312", "#3d8f95")
INK: Final = "#1b2733"
FAINT: Final = "#8a97a5"
VECTOR: Final = "#b3361e"
SIZE_IN: Final = (7.6, 4.2)
_MAP_PX: Final = 720
_MAX_DOTS: Final = 4000
_STYLE: Final[Any] = {
    "svg.hashsalt": "syntopic",
    "svg.fonttype": "none",
    "text.parse_math": False,
    "font.size": 9.0,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.edgecolor": FAINT,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.prop_cycle": cycler(color=COLOURS),
    "grid.color": "#e6eaee",
    "legend.frameon": False,
}


@dataclass(frozen=True)
class Curve:
    """Points of one colour; `joined` draws a line through them, else they are dots."""

    label: str
    x: Values
    y: Values
    joined: bool = True
    dashed: bool = False


def svg_of(draw: Callable[[Figure], None], size_in: tuple[float, float] = SIZE_IN) -> str:
    """An SVG element of what `draw` puts into a figure of that width and height, inches."""
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=size_in, layout="constrained")
        draw(figure)
        text = io.StringIO()
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(text, format="svg", metadata=nothing)
    return text.getvalue()[text.getvalue().index("<svg") :]


def chart_svg(
    title: str,
    axes: tuple[str, str],
    curves: Sequence[Curve],
    *,
    log: bool = False,
    bars: Sequence[tuple[float, str]] = (),
) -> str:
    """Curves on common axes.

    Args:
        title: heading of the chart.
        axes: what is along x and along y, with units.
        curves: drawn in this order, each in a colour of its own.
        log: both axes logarithmic; what is not positive is left out.
        bars: levels drawn across, with their names.
    """

    def draw(figure: Figure) -> None:
        plot = figure.subplots()
        if log:
            logarithmic(plot)
        for curve in curves:
            x, y = _drawable(curve, log=log)
            if not curve.joined:
                step = max(1, math.ceil(len(x) / _MAX_DOTS))
                plot.plot(x[::step], y[::step], "o", markersize=3.5, label=curve.label)
            else:
                style = "--" if curve.dashed else "-"
                plot.plot(x, y, style, linewidth=1.4, label=curve.label)
        for level, name in bars:
            level_line(plot, level, name)
        titles(plot, title, *axes)
        legend(figure, plot)

    return svg_of(draw)


def histogram_svg(
    title: str, label: str, values: Array, *, bins: int = 60, log: bool = False
) -> str:
    """How often values occur; `log` has a logarithmic axis of counts, as EMVA 1288 requires."""
    flat = np.asarray(values, float).ravel()
    flat = flat[np.isfinite(flat)]

    def draw(figure: Figure) -> None:
        plot = figure.subplots()
        if flat.size:
            plot.hist(flat, bins=bins, histtype="step", log=log, linewidth=1.4)
        if log:
            plot.yaxis.set_major_formatter(FuncFormatter(_plain))
        titles(plot, title, label, "count")

    return svg_of(draw)


def map_svg(title: str, values: Array, label: str) -> str:
    """A map (rows, columns) in grey, from its 0.5th to its 99.5th percentile, with its scale."""
    shrink = max(1, math.ceil(max(values.shape) / _MAP_PX))
    height, width = values.shape[0] // shrink, values.shape[1] // shrink
    cut = np.asarray(values[: height * shrink, : width * shrink], float)
    small = np.nanmean(cut.reshape(height, shrink, width, shrink), axis=(1, 3))
    low, high = (float(v) for v in np.nanpercentile(small, [0.5, 99.5]))
    if not high > low:
        high = low + 1.0

    def draw(figure: Figure) -> None:
        plot = figure.subplots()
        shown = plot.imshow(small, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
        plot.set_axis_off()
        figure.colorbar(shown, ax=plot, label=label, shrink=0.8)
        plot.set_title(title)

    return svg_of(draw, (7.4, 1.2 + 6.0 * height / width))


def vectors_svg(
    title: str,
    xy: Array,
    vector: Array,
    *,
    half: tuple[float, float],
    unit: tuple[str, float],
) -> str:
    """Vectors (n, 2) at places (n, 2) about the middle of a field of `half` width and height.

    y is up. `unit` names the unit of vectors and how many of it one of them is.
    """
    length = np.hypot(vector[:, 0], vector[:, 1]) if len(vector) else np.zeros(0)
    longest = max(float(np.percentile(length, 98)) if len(length) else 0.0, 1e-12)
    step = max(1, math.ceil(len(xy) / _MAX_DOTS))

    def draw(figure: Figure) -> None:
        plot = figure.subplots()
        field_of_vectors(plot, xy[::step], vector[::step], half, longest, unit)
        plot.set_title(title)

    return svg_of(draw, (7.4, 1.0 + 7.0 * half[1] / half[0]))


def field_of_vectors(
    plot: Axes,
    xy: Array,
    vector: Array,
    half: tuple[float, float],
    longest: float,
    unit: tuple[str, float],
) -> None:
    """Draw vectors as lines, a long one a 24th of the width, and a scale bar below them."""
    enlarge = half[0] / 12.0 / longest
    lines(plot, xy, xy + enlarge * vector, VECTOR)
    plot.plot(xy[:, 0], xy[:, 1], ".", color=INK, markersize=1.5)
    plot.set(xlim=(-half[0], half[0]), ylim=(-half[1], half[1]), aspect="equal")
    plot.set(xticks=[], yticks=[], facecolor="#f6f8fa")
    bar = 10.0 ** math.floor(math.log10(longest * unit[1])) / unit[1]
    scale_bar(plot, bar * enlarge / (2.0 * half[0]), f"{bar * unit[1]:g} {unit[0]}")


def lines(plot: Axes, start: Array, end: Array, colour: str) -> None:
    """Draw lines from places (n, 2) to places (n, 2), one path for all of them."""
    gap = np.full(len(start), np.nan)
    x, y = (np.stack([start[:, k], end[:, k], gap], axis=1).ravel() for k in (0, 1))
    plot.plot(x, y, color=colour, linewidth=0.9)


def scale_bar(plot: Axes, share: float, label: str) -> None:
    """A bar below the axes, as long as that share of their width, with its length."""
    plot.annotate(
        "", (0.0, -0.035), (share, -0.035), xycoords="axes fraction", textcoords="axes fraction",
        arrowprops={
            "arrowstyle": "-",
            "color": VECTOR,
            "linewidth": 2.0,
            "shrinkA": 0,
            "shrinkB": 0,
        },
        annotation_clip=False,
    )  # fmt: skip
    plot.text(share + 0.012, -0.035, label, va="center", transform=plot.transAxes)


def level_line(plot: Axes, level: float, name: str) -> None:
    """A dashed line across, such as a limit, with its name at the right."""
    plot.axhline(level, color=FAINT, linestyle="--", linewidth=1.0)
    across = plot.get_yaxis_transform()
    plot.text(0.995, level, name, color=FAINT, ha="right", va="bottom", transform=across)


def logarithmic(plot: Axes) -> None:
    """Both axes logarithmic, with plain numbers."""
    plot.set(xscale="log", yscale="log")
    for axis in (plot.xaxis, plot.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(_plain))


def titles(plot: Axes, title: str, x_label: str, y_label: str) -> None:
    """Name a chart and its axes."""
    plot.set(xlabel=x_label, ylabel=y_label)
    plot.set_title(title)


def legend(figure: Figure, plot: Axes) -> None:
    """Name the curves that have a label, above the chart."""
    found, names = plot.get_legend_handles_labels()
    if names:
        figure.legend(found, names, loc="outside upper right", ncols=min(len(names), 4))


def _drawable(curve: Curve, *, log: bool) -> tuple[Array, Array]:
    x, y = np.asarray(curve.x, float), np.asarray(curve.y, float)
    valid = np.isfinite(x) & np.isfinite(y)
    if log:
        valid &= (x > 0.0) & (y > 0.0)
    return x[valid], y[valid]


def _plain(value: float, _position: int) -> str:
    return f"{value:g}"

"""Plain SVG drawings of an adjustment: systematic image residuals, and the block from above.

The drawings have no scripts and no embedded fonts. Source of the first picture:
Ladstädter et al. (2010), fig. 10.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.adjust import Adjustment
from processing.bundle.adjustment_results import PointDifferences, ResidualPattern

Array = NDArray[np.float64]

_INK: Final = "#1c2733"
_FAINT: Final = "#8796a5"
_VECTOR: Final = "#b3361e"
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

    All vectors have one scale; the bar below shows it. y is up, in flight direction.
    """
    gap, wide = 40.0, 510.0
    longest = max([float(np.hypot(*p.pattern.mean_mm.T).max(initial=0.0)) for p in panels] + [1e-9])
    enlarge = 26.0 / longest
    bar_mm = float(10.0 ** np.floor(np.log10(longest)))
    high = max(wide * p.half_mm[1] / p.half_mm[0] for p in panels)
    width = len(panels) * (wide + gap) + gap
    body = [_text(gap, 30, title, 17, weight="bold")]
    for k, panel in enumerate(panels):
        left, top = gap + k * (wide + gap), 72.0
        unit = wide / (2.0 * panel.half_mm[0])
        body.append(_text(left, 58, panel.title, 12))
        body.append(
            f'<rect x="{left}" y="{top}" width="{wide}" '
            f'height="{2.0 * panel.half_mm[1] * unit:.1f}" fill="#f6f8fa" stroke="{_FAINT}"/>'
        )
        for place, vector in zip(panel.pattern.places_mm, panel.pattern.mean_mm, strict=True):
            x = left + (float(place[0]) + panel.half_mm[0]) * unit
            y = top + (panel.half_mm[1] - float(place[1])) * unit
            body.append(_arrow(x, y, float(vector[0]) * enlarge, -float(vector[1]) * enlarge))
    body += _bar(gap, 72.0 + high + 28.0, bar_mm * enlarge, f"{bar_mm * 1e3:g} um")
    return _svg(width, high + 125.0, body)


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
    low, high = everything.min(axis=0), everything.max(axis=0)
    span = np.maximum(high - low, 1e-9)
    size, gap = 760.0, 40.0
    unit = size / float(span.max())
    differences = [
        a.difference_m[np.isfinite(a.difference_m).all(axis=1)] for a in (control, checks)
    ]
    longest = max([float(np.abs(d).max(initial=0.0)) for d in differences] + [1e-12])
    enlarge = 45.0 / longest
    bar_m = float(10.0 ** np.floor(np.log10(longest)))

    def at(xyz: Array) -> tuple[float, float]:
        return (
            gap + (float(xyz[0]) - float(low[0])) * unit,
            60.0 + (float(high[1]) - float(xyz[1])) * unit,
        )

    body = [_text(gap, 30, title, 17, weight="bold")]
    step = max(1, len(ground) // _MAX_POINTS)
    for point in ground[::step]:
        x, y = at(point)
        body.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="0.7" fill="{_FAINT}"/>')
    for place in station:
        x, y = at(place)
        body.append(f'<path d="M{x - 3:.1f} {y:.1f}h6M{x:.1f} {y - 3:.1f}v6" stroke="{_INK}"/>')
    names = {name: k for k, name in enumerate(result.network.points.names)}
    for found, colour in ((control, _CONTROL), (checks, _CHECK)):
        for name, difference in zip(found.names, found.difference_m, strict=True):
            x, y = at(result.state.points[names[name]])
            body.append(
                f'<path d="M{x - 4:.1f} {y + 3:.1f}h8l-4 -7z" fill="none" stroke="{colour}"/>'
            )
            dx, dy, dz = np.nan_to_num(difference) * enlarge
            body.append(_line(x, y, x + float(dx), y - float(dy), _VECTOR))
            body.append(_line(x + 7.0, y, x + 7.0, y - float(dz), colour))
    bottom = 60.0 + float(span[1]) * unit + 30.0
    body += _bar(gap, bottom, bar_m * enlarge, f"{bar_m:g} m at points")
    legend = "+ projection centres; triangles: control (blue), checks (green); red plan, bar height"
    body.append(_text(gap + 260.0, bottom + 4.0, legend, 12, _INK))
    return _svg(max(float(span[0]) * unit, 760.0) + 2.0 * gap, bottom + 30.0, body)


def _arrow(x: float, y: float, dx: float, dy: float) -> str:
    return _line(x, y, x + dx, y + dy, _VECTOR) + (
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1.2" fill="{_INK}"/>'
    )


def _line(x: float, y: float, to_x: float, to_y: float, colour: str) -> str:
    return (
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{to_x:.1f}" y2="{to_y:.1f}" stroke="{colour}" '
        'stroke-width="1.2"/>'
    )


def _bar(x: float, y: float, length: float, label: str) -> list[str]:
    return [
        f'<line x1="{x}" y1="{y:.1f}" x2="{x + length:.1f}" y2="{y:.1f}" stroke="{_VECTOR}" '
        'stroke-width="2"/>',
        _text(x + length + 8.0, y + 4.0, label, 12),
    ]


def _text(
    x: float, y: float, content: str, size: int, colour: str = _INK, *, weight: str = "normal"
) -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" font-weight="{weight}" '
        f'fill="{colour}">{escape(content)}</text>'
    )


def _svg(width: float, height: float, body: Sequence[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" '
        f'width="{width:.0f}" height="{height:.0f}" font-family="DejaVu Sans, sans-serif">'
        '<rect width="100%" height="100%" fill="#ffffff"/>' + "".join(body) + "</svg>\n"
    )

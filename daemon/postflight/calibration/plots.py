"""Plots of calibration reports as plain SVG: lines and dots on axes, and maps as pictures.

Strings only; a map of pixels is a PNG within the SVG, so that the report needs no other file.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Values = Sequence[float] | NDArray[np.float64]
Array = NDArray[Any]

COLOURS: Final = ("#1f5fa8", "#c4572b", "#2d8a57", "#8a4fa3", "#a88312", "#3d8f95")
_INK: Final = "#1b2733"
_FAINT: Final = "#8a97a5"
_WIDE, _HIGH = 760.0, 420.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 84.0, 740.0, 56.0, 360.0
_MAP_PX: Final = 720
_MAX_DOTS: Final = 4000


@dataclass(frozen=True)
class Curve:
    """Points of one colour; `joined` draws a line through them, else they are dots."""

    label: str
    x: Values
    y: Values
    joined: bool = True
    dashed: bool = False


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
        axes: what is along x and along y, with units.
        log: both axes logarithmic; what is not positive is left out.
        bars: levels drawn across, with their names.
    """
    pairs = [_finite(c, log=log) for c in curves]
    every_x = np.concatenate([p[0] for p in pairs] or [np.zeros(0)])
    every_y = np.concatenate([p[1] for p in pairs] + [np.array([b for b, _ in bars], float)])
    if not every_x.size:
        every_x, every_y = np.array([1.0, 10.0]), np.array([1.0, 10.0])
    x_span, y_span = _span(every_x, log=log), _span(every_y, log=log)
    body = [_text(_LEFT, 22, title, 15, weight="bold")]
    for value in _ticks(x_span, log=log):
        x = _at(value, x_span, _LEFT, _RIGHT, log=log)
        body.append(_line(x, _TOP, x, _BOTTOM, "#e6eaee"))
        body.append(_text(x, _BOTTOM + 16, f"{value:g}", 11, anchor="middle"))
    for value in _ticks(y_span, log=log):
        y = _at(value, y_span, _BOTTOM, _TOP, log=log)
        body.append(_line(_LEFT, y, _RIGHT, y, "#e6eaee"))
        body.append(_text(_LEFT - 6, y + 4, f"{value:g}", 11, anchor="end"))
    body.append(_text(_RIGHT, _BOTTOM + 34, axes[0], 12, anchor="end"))
    body.append(_text(_LEFT, _TOP - 8, axes[1], 12))
    for level, name in bars:
        y = _at(level, y_span, _BOTTOM, _TOP, log=log)
        body.append(_line(_LEFT, y, _RIGHT, y, _FAINT, dash="5 4"))
        body.append(_text(_RIGHT - 4, y - 4, name, 11, _FAINT, anchor="end"))
    at = _RIGHT
    for k, (curve, (xs, ys)) in enumerate(zip(curves, pairs, strict=True)):
        colour = COLOURS[k % len(COLOURS)]
        places = [
            (_at(a, x_span, _LEFT, _RIGHT, log=log), _at(b, y_span, _BOTTOM, _TOP, log=log))
            for a, b in zip(xs, ys, strict=True)
        ]
        if curve.joined and places:
            way = " L ".join(f"{a:.1f} {b:.1f}" for a, b in places)
            dash = ' stroke-dasharray="5 4"' if curve.dashed else ""
            body.append(
                f'<path d="M {way}" fill="none" stroke="{colour}" stroke-width="1.6"{dash}/>'
            )
        elif places:
            step = max(1, math.ceil(len(places) / _MAX_DOTS))
            body += [
                f'<circle cx="{a:.1f}" cy="{b:.1f}" r="2.6" fill="{colour}"/>'
                for a, b in places[::step]
            ]
        if curve.label:
            body.append(_text(at, _TOP - 24, curve.label, 12, colour, anchor="end"))
            at -= 7.0 * len(curve.label) + 16.0
    return _svg(_WIDE, _HIGH, body)


def histogram_svg(
    title: str, label: str, values: Array, *, bins: int = 60, log: bool = False
) -> str:
    """How often values occur; `log` gives the logarithm of the counts, as EMVA 1288 requires."""
    flat = np.asarray(values, float).ravel()
    flat = flat[np.isfinite(flat)]
    counts, edges = np.histogram(flat, bins=bins) if flat.size else (np.zeros(1), np.arange(2.0))
    high = np.log10(np.maximum(counts, 0.5)) if log else counts.astype(float)
    x = np.repeat(edges, 2)
    low = math.log10(0.5) if log else 0.0
    y = np.concatenate([[low], np.repeat(high, 2), [low]])
    what = "log10 of count" if log else "count"
    return chart_svg(title, (label, what), [Curve("", x, y)])


def map_svg(title: str, values: Array, label: str) -> str:
    """A map (rows, columns) in grey, from its 0.5th to its 99.5th percentile, with its scale."""
    import cv2

    shrink = max(1, math.ceil(max(values.shape) / _MAP_PX))
    height, width = values.shape[0] // shrink, values.shape[1] // shrink
    cut = np.asarray(values[: height * shrink, : width * shrink], float)
    small = np.nanmean(cut.reshape(height, shrink, width, shrink), axis=(1, 3))
    low, high = (float(v) for v in np.nanpercentile(small, [0.5, 99.5]))
    if not high > low:
        high = low + 1.0
    grey = np.clip(255.0 * (np.nan_to_num(small, nan=low) - low) / (high - low), 0, 255)
    _, png = cv2.imencode(".png", grey.astype(np.uint8))
    data = base64.b64encode(png.tobytes()).decode("ascii")
    scale = 700.0 / width
    shown = height * scale
    body = [
        _text(20, 26, title, 15, weight="bold"),
        f'<image x="20" y="40" width="700" height="{shown:.1f}" '
        f'preserveAspectRatio="none" href="data:image/png;base64,{data}"/>',
        _text(20, shown + 62, f"black {low:.4g}, white {high:.4g} {label}", 12, _FAINT),
    ]
    return _svg(740.0, shown + 76.0, body)


def vectors_svg(
    title: str,
    xy: Array,
    vector: Array,
    *,
    half: tuple[float, float],
    unit: tuple[str, float],
    note: str = "",
) -> str:
    """Vectors (n, 2) at places (n, 2) about the middle of a field of `half` width and height.

    y is up. `unit` names the unit of vectors and how many of it one of them is.
    """
    wide = 700.0
    scale = wide / (2.0 * half[0])
    high = 2.0 * half[1] * scale
    length = np.hypot(vector[:, 0], vector[:, 1]) if len(vector) else np.zeros(0)
    longest = max(float(np.percentile(length, 98)) if len(length) else 0.0, 1e-12)
    enlarge = 30.0 / longest
    body = [
        _text(20, 26, title, 15, weight="bold"),
        f'<rect x="20" y="44" width="{wide}" height="{high:.1f}" fill="#f6f8fa" '
        f'stroke="{_FAINT}"/>',
    ]
    step = max(1, math.ceil(len(xy) / _MAX_DOTS))
    parts = []
    for (x, y), (dx, dy) in zip(xy[::step], vector[::step], strict=True):
        px, py = 20 + (float(x) + half[0]) * scale, 44 + (half[1] - float(y)) * scale
        parts.append(f"M{px:.1f} {py:.1f}l{float(dx) * enlarge:.1f} {-float(dy) * enlarge:.1f}")
    body.append(
        f'<path d="{" ".join(parts)}" fill="none" stroke="#b3361e" stroke-width="0.9" '
        'stroke-linecap="round"/>'
    )
    bar = 10.0 ** math.floor(math.log10(longest * unit[1])) / unit[1]
    foot = 44 + high + 24
    body.append(_line(20, foot, 20 + bar * enlarge, foot, _INK))
    scale_text = f"{bar * unit[1]:g} {unit[0]}"
    body.append(_text(28 + bar * enlarge, foot + 4, f"{scale_text}   {note}", 12))
    return _svg(740.0, foot + 22.0, body)


def _finite(curve: Curve, *, log: bool) -> tuple[Array, Array]:
    x, y = np.asarray(curve.x, float), np.asarray(curve.y, float)
    valid = np.isfinite(x) & np.isfinite(y)
    if log:
        valid &= (x > 0.0) & (y > 0.0)
    return x[valid], y[valid]


def _span(values: Array, *, log: bool) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    if log:
        return low / 1.2, high * 1.2
    if high - low < 1e-12 * max(abs(high), 1.0):
        return low - 1.0, high + 1.0
    slack = 0.05 * (high - low)
    return low - slack, high + slack


def _at(value: float, span: tuple[float, float], first: float, last: float, *, log: bool) -> float:
    low, high = span
    if log:
        value, low, high = math.log(value), math.log(low), math.log(high)
    return first + (value - low) / (high - low) * (last - first)


def _ticks(span: tuple[float, float], *, log: bool) -> list[float]:
    low, high = span
    if log:
        powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        few = high / low < 50.0
        ticks = [m * 10.0**p for p in powers for m in ((1, 2, 5) if few else (1,))]
        return [t for t in ticks if low <= t <= high]
    step = 10.0 ** math.floor(math.log10((high - low) / 6.0))
    for factor in (1.0, 2.0, 5.0, 10.0):
        if factor * step >= (high - low) / 6.0:
            step *= factor
            break
    first = math.ceil(low / step - 1e-9)
    count = math.floor((high - first * step) / step + 1e-9)
    return [round((first + k) * step, 12) for k in range(count + 1)]


def _svg(width: float, height: float, body: Sequence[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" '
        f'width="{width:.0f}" height="{height:.0f}" '
        'font-family="system-ui, DejaVu Sans, sans-serif">'
        '<rect width="100%" height="100%" fill="#ffffff"/>' + "".join(body) + "</svg>"
    )


def _line(x1: float, y1: float, x2: float, y2: float, stroke: str, *, dash: str = "") -> str:
    dashed = f' stroke-dasharray="{dash}"' if dash else ""
    return (
        f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{stroke}"{dashed}/>'
    )


def _text(
    x: float,
    y: float,
    content: str,
    size: float,
    fill: str = _INK,
    *,
    anchor: str = "start",
    weight: str = "normal",
) -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" fill="{fill}" '
        f'text-anchor="{anchor}" font-weight="{weight}">{escape(content)}</text>'
    )

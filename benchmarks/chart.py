"""A small line chart as SVG: axes, lines, dots and notes, nothing that needs a library."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Values = Sequence[float] | NDArray[np.float64]

WIDE, HIGH = 760.0, 420.0
LEFT, RIGHT, TOP, BOTTOM = 70.0, 740.0, 50.0, 360.0
GREY = "#888888"


@dataclass
class Chart:
    """One pair of axes; values outside of them are drawn at their border."""

    title: str
    x_label: str
    y_label: str
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    _body: list[str] = field(default_factory=list)
    _labels: list[tuple[str, str]] = field(default_factory=list)

    def line(
        self,
        x: Values,
        y: Values,
        colour: str,
        *,
        label: str | None = None,
        dashed: bool = False,
        thin: bool = False,
    ) -> None:
        """A line through points; with a label it is named above the axes."""
        way = " L ".join(f"{self._x(a):.1f} {self._y(b):.1f}" for a, b in zip(x, y, strict=True))
        if label is not None:
            self._labels.append((label, colour))
        if not len(x):
            return
        dash = ' stroke-dasharray="5 4"' if dashed else ""
        width = 1 if thin or dashed else 2
        self._body.append(
            f'<path d="M {way}" fill="none" stroke="{colour}" stroke-width="{width}"{dash}/>'
        )

    def dots(self, x: Values, y: Values, colour: str, *, filled: bool = True) -> None:
        fill = colour if filled else "#ffffff"
        for a, b in zip(x, y, strict=True):
            self._body.append(
                f'<circle cx="{self._x(a):.1f}" cy="{self._y(b):.1f}" r="3" stroke="{colour}" '
                f'fill="{fill}"/>'
            )

    def level(self, y: float, label: str) -> None:
        """A dashed line across, such as a bar to be reached."""
        self._body.append(_line(LEFT, self._y(y), RIGHT, self._y(y), GREY, dashed=True))
        self._body.append(_text(RIGHT - 4, self._y(y) - 4, label, "end", GREY))

    def mark(self, x: float, label: str) -> None:
        """A dashed line upright."""
        self._body.append(_line(self._x(x), TOP, self._x(x), BOTTOM, GREY, dashed=True))
        self._body.append(_text(self._x(x) + 4, TOP + 12, label, fill=GREY))

    def note(self, content: str) -> None:
        self._body.append(_text(LEFT, HIGH - 8, content, fill="#555555"))

    def svg(self) -> str:
        parts = [_text(LEFT, 20.0, self.title)]
        for value in _ticks(*self.x_range):
            parts.append(_line(self._x(value), TOP, self._x(value), BOTTOM, "#eeeeee"))
            parts.append(_text(self._x(value), BOTTOM + 16, f"{value:g}", "middle"))
        for value in _ticks(*self.y_range):
            parts.append(_line(LEFT, self._y(value), RIGHT, self._y(value), "#eeeeee"))
            parts.append(_text(LEFT - 6, self._y(value) + 4, f"{value:g}", "end"))
        parts.append(_text(RIGHT, BOTTOM + 32, self.x_label, "end"))
        parts.append(_text(LEFT, TOP - 6, self.y_label))
        at = RIGHT
        for label, colour in reversed(self._labels):
            parts.append(_text(at, TOP - 6, label, "end", colour))
            at -= 7.0 * len(label) + 14.0
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDE:.0f} {HIGH:.0f}" '
            f'width="{WIDE:.0f}" height="{HIGH:.0f}" '
            'font-family="system-ui, DejaVu Sans, sans-serif">'
            '<rect width="100%" height="100%" fill="#ffffff"/>'
            + "".join([*parts, *self._body])
            + "</svg>\n"
        )

    def _x(self, value: float) -> float:
        return _place(value, self.x_range, LEFT, RIGHT)

    def _y(self, value: float) -> float:
        return _place(value, self.y_range, BOTTOM, TOP)


def _place(value: float, span: tuple[float, float], first: float, last: float) -> float:
    share = (value - span[0]) / (span[1] - span[0])
    return first + min(max(share, 0.0), 1.0) * (last - first)


def _ticks(low: float, high: float) -> list[float]:
    rough = (high - low) / 6.0
    step = 10.0 ** math.floor(math.log10(rough))
    for factor in (1.0, 2.0, 5.0, 10.0):
        if factor * step >= rough:
            step *= factor
            break
    first = math.ceil(low / step - 1e-9)
    count = math.floor((high - first * step) / step + 1e-9)
    return [round((first + k) * step, 12) for k in range(count + 1)]


def _line(x1: float, y1: float, x2: float, y2: float, stroke: str, *, dashed: bool = False) -> str:
    dash = ' stroke-dasharray="4 3"' if dashed else ""
    return (
        f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{stroke}"{dash}/>'
    )


def _text(x: float, y: float, content: str, anchor: str = "start", fill: str = "#333333") -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="12" fill="{fill}" '
        f'text-anchor="{anchor}">{content}</text>'
    )

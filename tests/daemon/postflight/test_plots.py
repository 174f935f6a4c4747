"""Plots of reports: the same bytes for the same input, names as they are, nothing from outside."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ET
from itertools import pairwise

import numpy as np
import pytest

from daemon.postflight.plots import (
    Curve,
    chart_svg,
    field_of_vectors,
    histogram_svg,
    map_svg,
    svg_of,
    vectors_svg,
)

VALUES = np.array([1.0, np.nan, 3.0, -1.0])
DRAWING = (
    "from daemon.postflight.plots import *; import sys; "
    "sys.stdout.write(chart_svg('t', ('x', 'y'), [Curve('c', [1.0, 2.0], [3.0, 4.0], "
    "joined=False)]))"
)


def texts(svg: str) -> list[str]:
    return [e.text or "" for e in ET.fromstring(svg).iter() if e.tag.endswith("text")]


def test_plots_draw_what_is_finite_and_stand_alone() -> None:
    drawings = [
        chart_svg("t", ("x", "y"), [Curve("", VALUES, VALUES)], log=True, bars=[(2.0, "bar")]),
        chart_svg("t", ("x", "y"), []),
        histogram_svg("t", "DN", VALUES, log=True),
        histogram_svg("t", "DN", np.array([np.nan])),
        map_svg("t", np.arange(12.0).reshape(3, 4), "DN"),
        map_svg("t", np.zeros((3, 4)), "DN"),
        vectors_svg("t", np.eye(2), np.eye(2), half=(2.0, 1.0), unit=("um", 1e3)),
        vectors_svg("t", np.empty((0, 2)), np.empty((0, 2)), half=(2.0, 1.0), unit=("um", 1e3)),
    ]
    for svg in drawings:
        assert svg.startswith("<svg") and svg.rstrip().endswith("</svg>")
        assert "t" in texts(svg)
        assert " nan" not in svg.lower()
        assert 'href="http' not in svg


def test_a_plot_has_the_same_bytes_in_another_process_and_no_date() -> None:
    runs = [
        subprocess.run(
            [sys.executable, "-c", DRAWING], capture_output=True, text=True, timeout=60, check=True
        ).stdout
        for _ in range(2)
    ]
    assert runs[0] == runs[1] and runs[0].startswith("<svg")
    assert "<dc:date" not in runs[0] and "Matplotlib v" not in runs[0]


@pytest.mark.parametrize("name", ["a$x$b", "<&>", r"\frac", "ä ²"])
def test_names_from_files_are_shown_as_they_are(name: str) -> None:
    curve = Curve(name, [1.0, 2.0], [1.0, 2.0])
    shown = texts(chart_svg(name, (name, name), [curve], bars=[(1.5, name)]))
    assert shown.count(name) == 5


def test_logarithmic_axes_have_plain_numbers() -> None:
    shown = texts(chart_svg("t", ("x", "y"), [Curve("", [1.0, 900.0], [0.1, 50.0])], log=True))
    assert {"1", "10", "100", "0.1"} <= set(shown)


def test_the_scale_bar_is_as_long_as_vectors_of_its_length() -> None:
    drawn = []

    def draw(figure) -> None:
        plot = figure.subplots()
        ends = np.array([[2.0e-3, 0.0]])
        field_of_vectors(plot, np.zeros((1, 2)), ends, (60.0, 40.0), 2.0e-3, ("um", 1e3))
        vector = plot.get_lines()[0].get_xdata()
        bar = plot.texts[0].xy[0] - plot.texts[0].get_position()[0]
        drawn.append((vector[1] - vector[0], abs(bar) * 120.0, plot.texts[1].get_text()))

    svg_of(draw)
    length, bar, label = drawn[0]
    assert label == "1 um"
    assert length == pytest.approx(2.0 * bar)


def test_curves_beyond_the_colours_still_differ() -> None:
    curves = [Curve(str(k), [0.0, 1.0], [k, k]) for k in range(4)]
    colours = [
        e.attrib["style"]
        for e in ET.fromstring(chart_svg("t", ("x", "y"), curves)).iter()
        if e.tag.endswith("path") and "stroke-width: 1.4" in e.attrib.get("style", "")
    ]
    assert all(a != b for a, b in pairwise(colours)) and len(colours) >= 4

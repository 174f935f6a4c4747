"""Styles of the layers of a mission, in the form of QGIS (QML).

Verdicts, kinds of lines and the density of tie points have colours; other layers have one symbol.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree as Xml

from daemon.postflight.export.gis_layers import GisLayer

QGIS_VERSION = "3.22.0"
VERDICT_COLOURS = {"good": "46,160,67", "usable": "219,171,9", "refly": "215,58,73"}
UNKNOWN_COLOUR = "128,128,128"
_LINE_COLOURS = {"planned": "110,110,110", "flown": "31,111,235"}
_DENSITY_COLOURS = ("254,229,217", "252,174,145", "251,106,74", "222,45,38", "165,15,21")
_GAP_COLOUR = "215,58,73"


@dataclass(frozen=True)
class _Class:
    """A class of a legend: its value or range, and its colour."""

    label: str
    colour: str
    value: str = ""
    range_: tuple[float, float] = (0.0, 0.0)


def style_of(layer: GisLayer) -> str:
    """The QML document of a layer.

    Args:
        layer: its name chooses the style; the density is divided by its values.

    Returns:
        The document as text.
    """
    root = Xml.Element("qgis", version=QGIS_VERSION, styleCategories="Symbology")
    if layer.name in ("footprints", "centres"):
        classes = [_Class(name, colour, name) for name, colour in VERDICT_COLOURS.items()]
        _categorized(root, layer, "verdict", [*classes, _Class("not known", UNKNOWN_COLOUR)])
    elif layer.name == "lines":
        classes = [_Class(name, colour, name) for name, colour in _LINE_COLOURS.items()]
        _categorized(root, layer, "kind", classes)
    elif layer.name == "tie_points":
        _graduated(root, layer, "points_per_ha")
    else:
        renderer = Xml.SubElement(root, "renderer-v2", type="singleSymbol")
        _symbol(Xml.SubElement(renderer, "symbols"), layer, "0", _GAP_COLOUR)
    Xml.SubElement(root, "layerGeometryType").text = {
        "Point": "0", "LineString": "1", "Polygon": "2",
    }[layer.kind]  # fmt: skip
    Xml.indent(root, " ")
    text = Xml.tostring(root, encoding="unicode")
    return f"<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n{text}\n"


def _categorized(
    root: Xml.Element, layer: GisLayer, column: str, classes: Sequence[_Class]
) -> None:
    renderer = Xml.SubElement(root, "renderer-v2", type="categorizedSymbol", attr=column)
    categories = Xml.SubElement(renderer, "categories")
    symbols = Xml.SubElement(renderer, "symbols")
    for index, one in enumerate(classes):
        Xml.SubElement(
            categories, "category", render="true", symbol=str(index), value=one.value,
            label=one.label, type="string",
        )  # fmt: skip
        _symbol(symbols, layer, str(index), one.colour)


def _graduated(root: Xml.Element, layer: GisLayer, column: str) -> None:
    renderer = Xml.SubElement(
        root, "renderer-v2", type="graduatedSymbol", attr=column, graduatedMethod="GraduatedColor"
    )
    index = list(layer.columns).index(column)
    values = [float(value) for one in layer.features if (value := one.values[index]) is not None]
    most = max(values, default=1.0)
    ranges = Xml.SubElement(renderer, "ranges")
    symbols = Xml.SubElement(renderer, "symbols")
    count = len(_DENSITY_COLOURS)
    for k, colour in enumerate(_DENSITY_COLOURS):
        low, high = most * k / count, most * (k + 1) / count
        Xml.SubElement(
            ranges, "range", render="true", symbol=str(k), lower=f"{low:.6f}",
            upper=f"{high:.6f}", label=f"{low:.3g} to {high:.3g} per ha",
        )  # fmt: skip
        _symbol(symbols, layer, str(k), colour)


def _symbol(symbols: Xml.Element, layer: GisLayer, name: str, colour: str) -> None:
    kind, symbol_layer = {
        "Point": ("marker", "SimpleMarker"),
        "LineString": ("line", "SimpleLine"),
        "Polygon": ("fill", "SimpleFill"),
    }[layer.kind]
    options = {
        "Point": {"color": f"{colour},255", "name": "circle", "size": "2.0", "size_unit": "MM"},
        "LineString": {"line_color": f"{colour},255", "line_width": "0.5", "line_width_unit": "MM"},
        "Polygon": {
            **{"color": f"{colour},60", "outline_color": f"{colour},255", "style": "solid"},
            **{"outline_width": "0.3", "outline_width_unit": "MM", "outline_style": "solid"},
        },
    }[layer.kind]
    symbol = Xml.SubElement(symbols, "symbol", type=kind, name=name, alpha="1", clip_to_extent="1")
    drawn = Xml.SubElement(
        symbol, "layer", {"class": symbol_layer, "enabled": "1", "locked": "0", "pass": "0"}
    )
    listed = Xml.SubElement(drawn, "Option", type="Map")
    for key, value in options.items():
        Xml.SubElement(listed, "Option", type="QString", name=key, value=value)

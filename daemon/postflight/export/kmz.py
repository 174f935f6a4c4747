"""Layers as KMZ, for Google Earth and other viewers of KML.

Shapes are clamped to the ground, and cut at the antimeridian. Colours are those of the GeoPackage's
styles.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence
from xml.etree import ElementTree as Xml

from daemon.orientation.antimeridian import line_parts, polygon
from daemon.postflight.export.gis_layers import GisFeature, GisLayer, Kind, Places
from daemon.postflight.export.qgis_styles import UNKNOWN_COLOUR, VERDICT_COLOURS

KML = "http://www.opengis.net/kml/2.2"
_STAMP = (1980, 1, 1, 0, 0, 0)
"""Time of the document in the archive: the same layers give the same bytes."""
_STYLES = {**VERDICT_COLOURS, "": UNKNOWN_COLOUR}


def kmz_bytes(title: str, layers: Sequence[GisLayer]) -> bytes:
    """A KMZ archive with one folder a layer.

    Args:
        title: name of the document.
        layers: their values become ExtendedData of each placemark.

    Returns:
        The archive.

    Source: OGC 12-007r2, KML 2.3, in the elements of KML 2.2.
    """
    root = Xml.Element("kml", xmlns=KML)
    document = Xml.SubElement(root, "Document")
    Xml.SubElement(document, "name").text = _printable(title)
    for verdict, colour in _STYLES.items():
        _style(document, f"verdict-{verdict}", colour)
    for layer in layers:
        folder = Xml.SubElement(document, "Folder")
        Xml.SubElement(folder, "name").text = layer.title
        if layer.note:
            Xml.SubElement(folder, "description").text = _printable(layer.note)
        for feature in layer.features:
            _placemark(folder, layer, feature)
    text = Xml.tostring(root, encoding="utf-8", xml_declaration=True)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(zipfile.ZipInfo("doc.kml", _STAMP), text, zipfile.ZIP_DEFLATED)
    return archive.getvalue()


def _placemark(folder: Xml.Element, layer: GisLayer, feature: GisFeature) -> None:
    values = dict(zip(layer.columns, feature.values, strict=True))
    mark = Xml.SubElement(folder, "Placemark")
    name = next(str(value) for value in feature.values if value is not None)
    Xml.SubElement(mark, "name").text = _printable(name)
    verdict = values.get("verdict")
    known = verdict if verdict in VERDICT_COLOURS else ""
    if layer.name == "gaps":
        known = "refly"
    Xml.SubElement(mark, "styleUrl").text = f"#verdict-{known}"
    data = Xml.SubElement(mark, "ExtendedData")
    for column, value in values.items():
        if value is not None and value != "":
            entry = Xml.SubElement(data, "Data", name=column)
            Xml.SubElement(entry, "value").text = _printable(str(value))
    parts = _parts(layer.kind, feature.places)
    parent = mark if len(parts) == 1 else Xml.SubElement(mark, "MultiGeometry")
    for places in parts:
        shape = Xml.SubElement(parent, layer.kind)
        if layer.kind == "LineString":
            Xml.SubElement(shape, "tessellate").text = "1"
        if layer.kind == "Polygon":
            shape = Xml.SubElement(Xml.SubElement(shape, "outerBoundaryIs"), "LinearRing")
        # A photograph's height above the ellipsoid is among its data: KML counts from the geoid.
        Xml.SubElement(shape, "coordinates").text = " ".join(
            f"{longitude:.9f},{latitude:.9f}" for longitude, latitude in places
        )


def _parts(kind: Kind, places: Places) -> list[Sequence[tuple[float, float]]]:
    """Shapes that do not cross the antimeridian: KML's longitudes end there. Rings are closed."""
    if kind == "Point":
        return [places]
    if kind == "LineString":
        return list(line_parts(places))
    whole = polygon(places)
    if whole is None or whole["type"] == "Polygon":
        return [(*places, places[0])]
    return [rings[0] for rings in whole["coordinates"]]


def _style(document: Xml.Element, name: str, colour: str) -> None:
    red, green, blue = (int(part) for part in colour.split(","))
    style = Xml.SubElement(document, "Style", id=name)
    line = Xml.SubElement(style, "LineStyle")
    Xml.SubElement(line, "color").text = f"ff{blue:02x}{green:02x}{red:02x}"
    Xml.SubElement(line, "width").text = "2"
    fill = Xml.SubElement(style, "PolyStyle")
    Xml.SubElement(fill, "color").text = f"3c{blue:02x}{green:02x}{red:02x}"


def _printable(text: str) -> str:
    """XML 1.0 has no control characters; names of lines come from plans of others."""
    return "".join(c if c.isprintable() else " " for c in text)

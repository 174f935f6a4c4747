"""Segments to be flown again, in the forms that crews and autopilots load."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from typing import Any
from xml.sax.saxutils import escape

from daemon.planning.reflight_planning import Hole, Segment

MAVLINK_WAYPOINT, MAVLINK_TRIGGER_DISTANCE = 16, 206
FRAME_RELATIVE, FRAME_MISSION = 3, 2
HEADER_QGC = "QGC WPL 110"


def segment_name(segment: Segment) -> str:
    return f"{segment.line.id}: {segment.from_m:.0f} m to {segment.to_m:.0f} m"


def hole_json(hole: Hole) -> dict[str, Any]:
    """A hole as the page draws it: places as latitude and longitude, degrees."""
    return {
        "area_m2": round(hole.area_m2, 1),
        "images": hole.images,
        "needed": hole.needed,
        "bands": list(hole.bands),
        "rings": [
            [[round(p.latitude_deg, 8), round(p.longitude_deg, 8)] for p in ring]
            for ring in hole.rings
        ],
    }


def geojson(segments: Sequence[Segment], *, simulated: bool = False) -> str:
    """A FeatureCollection of LineStrings; also a plan that can be read again."""
    features: list[dict[str, Any]] = [
        {
            "type": "Feature",
            "properties": {
                "id": f"{one.line.id} {one.from_m:.0f}-{one.to_m:.0f}",
                "strip": one.line.strip or one.line.id,
                "from_m": round(one.from_m, 1),
                "to_m": round(one.to_m, 1),
                "reasons": list(one.reasons),
                "area_m2": round(one.area_m2, 1),
                **({"simulated": True} if simulated else {}),
            },
            "geometry": {
                "type": "LineString",
                "coordinates": [
                    [round(p.longitude_deg, 8), round(p.latitude_deg, 8)]
                    for p in (one.start, one.end)
                ],
            },
        }
        for one in segments
    ]
    return json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n"


def kml(segments: Sequence[Segment], *, simulated: bool = False) -> str:
    """Placemarks with LineStrings (OGC KML 2.2)."""
    title = "Fly again (SIMULATED: emulated hardware, no survey)" if simulated else "Fly again"
    marks = [
        "<Placemark><name>{name}</name><description>{why}</description><LineString>"
        "<coordinates>{a[1]:.8f},{a[0]:.8f} {b[1]:.8f},{b[0]:.8f}</coordinates>"
        "</LineString></Placemark>".format(
            name=escape(segment_name(one)),
            why=escape("; ".join(one.reasons)),
            a=one.start,
            b=one.end,
        )
        for one in segments
    ]
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document><name>{title}</name>\n'
        + "\n".join(marks)
        + "\n</Document></kml>\n"
    )


def mavlink_mission(segments: Sequence[Segment], *, height_m: float, distance_m: float) -> str:
    """A mission in the plain text that ground stations load ("QGC WPL 110").

    For each segment: its start, triggering by distance on, its end, triggering off.

    Args:
        height_m: above the home position.
        distance_m: between two exposures.
    """
    rows: list[tuple[int, int, tuple[float, ...]]] = []
    for one in segments:
        for point, distance in ((one.start, distance_m), (one.end, 0.0)):
            place = (0.0, 0.0, 0.0, 0.0, point.latitude_deg, point.longitude_deg, height_m)
            rows.append((FRAME_RELATIVE, MAVLINK_WAYPOINT, place))
            trigger = (distance, 0.0, 1.0 if distance else 0.0, 0.0, 0.0, 0.0, 0.0)
            rows.append((FRAME_MISSION, MAVLINK_TRIGGER_DISTANCE, trigger))
    lines = [
        "\t".join([str(i), "0", str(frame), str(command), *(f"{v:.8f}" for v in values), "1"])
        for i, (frame, command, values) in enumerate(rows)
    ]
    return "\n".join([HEADER_QGC, *lines]) + "\n"


TABLE_COLUMNS = (
    *("line", "strip", "kind", "from_m", "to_m", "length_m", "area_m2"),
    *("start_latitude_deg", "start_longitude_deg", "end_latitude_deg", "end_longitude_deg"),
    *("simulated", "reasons"),
)
"""Columns of the table, documented in docs/reference/flight/reflight-files.md."""


def table(segments: Sequence[Segment], *, simulated: bool = False) -> str:
    """A table of the segments: CSV after RFC 4180, UTF-8, a header, SI units, WGS 84 degrees.

    A text that a spreadsheet would run as a formula begins with an apostrophe.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\r\n")
    writer.writerow(TABLE_COLUMNS)
    for one in segments:
        writer.writerow(
            [
                _harmless(one.line.id),
                _harmless(one.line.strip or one.line.id),
                one.kind,
                *(f"{metres:.1f}" for metres in (one.from_m, one.to_m, one.to_m - one.from_m)),
                f"{one.area_m2:.1f}",
                *(f"{degrees:.8f}" for place in (one.start, one.end) for degrees in place),
                int(simulated),
                _harmless("; ".join(one.reasons)),
            ]
        )
    return text.getvalue()


def _harmless(text: str) -> str:
    return f"'{text}" if text[:1] in ("=", "+", "-", "@", "\t", "\r") else text

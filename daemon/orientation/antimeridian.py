"""Longitudes of one mission next to each other, and GeoJSON across the antimeridian.

A ring of a mission is far narrower than 180 degrees: longitudes that jump by more cross the
antimeridian.

Source: RFC 7946, sections 3.1.9 and 5.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

Ring = Sequence[tuple[float, float]]
HALF_DEG = 180.0


def near(longitude_deg: float, reference_deg: float) -> float:
    """A longitude within 180 degrees of a reference; it may be beyond 180.

    Example:
        >>> near(-179.5, 179.0)
        180.5
    """
    if abs(longitude_deg - reference_deg) <= HALF_DEG:
        return longitude_deg
    return (longitude_deg - reference_deg + HALF_DEG) % 360.0 - HALF_DEG + reference_deg


def wrapped(longitude_deg: float) -> float:
    """A longitude from -180 to 180.

    Example:
        >>> wrapped(180.5)
        -179.5
    """
    if abs(longitude_deg) <= HALF_DEG:
        return longitude_deg
    return (longitude_deg + HALF_DEG) % 360.0 - HALF_DEG


def continuous(ring: Ring) -> list[tuple[float, float]]:
    """Places (longitude, latitude) without a jump, from the first one on; none of none."""
    return [(near(longitude, ring[0][0]), latitude) for longitude, latitude in ring]


def mean_longitude(longitudes_deg: Sequence[float]) -> float:
    """Mean of longitudes that are next to each other.

    Example:
        >>> mean_longitude([179.0, -179.5])
        179.75
    """
    first = longitudes_deg[0]
    return wrapped(sum(near(one, first) for one in longitudes_deg) / len(longitudes_deg))


def crosses(ring: Ring) -> bool:
    """Whether a ring has places on both sides of the antimeridian."""
    return any(abs(longitude) > HALF_DEG for longitude, _ in continuous(ring))


def polygon(corners: Ring | None) -> dict[str, Any] | None:
    """A GeoJSON polygon of (longitude, latitude), two parts where it crosses the antimeridian.

    Returns:
        None without corners.
    """
    if corners is None:
        return None
    ring = continuous(corners)
    east = max(longitude for longitude, _ in ring) > HALF_DEG
    west = min(longitude for longitude, _ in ring) < -HALF_DEG
    if not (east or west):
        return {"type": "Polygon", "coordinates": [_closed(ring)]}
    edge = HALF_DEG if east else -HALF_DEG
    parts = [
        [(longitude - turn, latitude) for longitude, latitude in _part(ring, edge, sign)]
        for sign in (-1.0, 1.0)
        for turn in (2.0 * edge if sign * edge > 0.0 else 0.0,)
    ]
    return {
        "type": "MultiPolygon",
        "coordinates": [[_closed(part)] for part in parts if len(part) > 2],
    }


def line_parts(line: Ring) -> list[list[tuple[float, float]]]:
    """A line of (longitude, latitude) cut at the antimeridian; one part where it does not cross.

    Example:
        >>> line_parts([(179.0, 0.0), (-179.0, 2.0)])
        [[(179.0, 0.0), (180.0, 1.0)], [(-180.0, 1.0), (-179.0, 2.0)]]
    """
    parts = [[line[0]]]
    for longitude, y1 in line[1:]:
        x0, y0 = parts[-1][-1]
        x1 = near(longitude, x0)
        if abs(x1) > HALF_DEG:
            edge = HALF_DEG if x1 > 0.0 else -HALF_DEG
            y = y0 + (y1 - y0) * (edge - x0) / (x1 - x0)
            parts[-1].append((edge, y))
            parts.append([(-edge, y)])
            x1 = wrapped(x1)
        parts[-1].append((x1, y1))
    return parts


def bbox_of(rings: Sequence[Ring]) -> list[float]:
    """West, south, east, north of rings, degrees; west is larger where they cross 180 degrees."""
    latitudes = [latitude for ring in rings for _, latitude in ring]
    south, north = min(latitudes), max(latitudes)
    arcs = [[longitude for longitude, _ in continuous(ring)] for ring in rings]
    west, east = min(map(min, arcs)), max(map(max, arcs))
    if not any(crosses(ring) for ring in rings) and east - west <= HALF_DEG:
        return [west, south, east, north]
    # The widest gap between arcs is outside of the box.
    turned = sorted((wrapped(min(arc)), max(arc) - min(arc)) for arc in arcs)
    ends, gaps = turned[0][0] + turned[0][1], []
    for (start, width), (following, _) in pairwise([*turned, (turned[0][0] + 360.0, 0.0)]):
        ends = max(ends, start + width)
        gaps.append((following - ends, following, ends))
    gap, west, east = max(gaps)
    if gap <= 0.0:
        return [-HALF_DEG, south, HALF_DEG, north]
    return [wrapped(west), south, wrapped(east), north]


def _part(ring: Ring, edge: float, sign: float) -> list[tuple[float, float]]:
    """What of a ring lies on one side of a meridian: beyond it for sign 1, before it for -1."""
    found: list[tuple[float, float]] = []
    for (x0, y0), (x1, y1) in pairwise([*ring, ring[0]]):
        if sign * (x0 - edge) >= 0.0:
            found.append((x0, y0))
        if (x0 - edge) * (x1 - edge) < 0.0:
            found.append((edge, y0 + (y1 - y0) * (edge - x0) / (x1 - x0)))
    return found


def _closed(ring: Ring) -> list[list[float]]:
    rounded = [[round(longitude, 9), round(latitude, 9)] for longitude, latitude in ring]
    return [*rounded, rounded[0]]

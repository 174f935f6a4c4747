"""Guidance as the service sends it, and base maps below it, for the tests of the page."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from daemon.planning.guidance import GuidanceLimits, guide
from daemon.planning.model import PlannedLine, Point
from drivers.contract import NavSample
from tests.daemon.onboard.flight.test_flight import nav as any_sample
from tests.daemon.onboard.monitoring.test_base_maps import geotiff, mbtiles, tile_of
from tests.daemon.onboard.monitoring.vector_tiles import vector_tile

LIMITS = GuidanceLimits(25.0, below_m=40.0, above_m=60.0)
SPEED_MPS = 55.0

Ends = Sequence[Sequence[float]]
"""Longitude and latitude of both ends of a line, degrees."""


def guidance_frame(
    lines: Mapping[str, Ends],
    along_share: float,
    *,
    east_deg: float = 0.0,
    height_m: float = 1395.0,
) -> dict[str, Any]:
    """Guidance on the first of the lines, flown at SPEED_MPS; the second one is next."""
    first, second = _planned(lines)[:2]
    start, end = first.start, first.end
    sample = replace(
        any_sample(0.0),
        latitude_deg=start.latitude_deg + along_share * (end.latitude_deg - start.latitude_deg),
        longitude_deg=start.longitude_deg + east_deg,
        height_m=height_m, velocity_ned_mps=(SPEED_MPS, 0.0, 0.0), heading_rad=0.05,
    )  # fmt: skip
    return _frame(first, sample, second, is_captured=True)


def approach_frame(lines: Mapping[str, Ends]) -> dict[str, Any]:
    """Guidance between two lines: 1.2 km before the start of the second one, which runs south."""
    second, third = _planned(lines)[1:3]
    assert second.start.latitude_deg > second.end.latitude_deg
    towards_rad = math.radians(190.0)
    sample = replace(
        any_sample(0.0),
        latitude_deg=second.start.latitude_deg + 0.0108,
        longitude_deg=second.start.longitude_deg + 0.0028,
        height_m=1391.0,
        velocity_ned_mps=(
            SPEED_MPS * math.cos(towards_rad), SPEED_MPS * math.sin(towards_rad), 0.0
        ),
        heading_rad=towards_rad + 0.05,
    )  # fmt: skip
    return _frame(second, sample, third, is_captured=False)


def _planned(lines: Mapping[str, Ends]) -> list[PlannedLine]:
    return [
        PlannedLine(name, Point(a[1], a[0]), Point(b[1], b[0])) for name, (a, b) in lines.items()
    ]


def _frame(
    line: PlannedLine, sample: NavSample, following: PlannedLine, *, is_captured: bool
) -> dict[str, Any]:
    """The event of the service for a sample; the line is flown from its start to its end."""
    found = guide(
        line, sample, is_reversed=False, places_m=tuple(range(0, 1200, 68)),
        planned_height_m=1395.0, limits=LIMITS, next_line=(following, False),
    )  # fmt: skip
    assert found is not None
    return {
        "event": "guidance", "sample_mono_ns": str(time.monotonic_ns() - 40_000_000),
        "receiver": "gnss", "fix": "3d", "latitude_deg": sample.latitude_deg,
        "longitude_deg": sample.longitude_deg, "height_m": sample.height_m,
        "is_captured": is_captured, "is_deviating": is_captured and bool(found.exceeded),
        "limits": asdict(LIMITS), **found.as_json(),
    }  # fmt: skip


def vector_map(folder: Path) -> Path:
    """A map of vector tiles about the lines of the tests, with markup in its attribution."""
    _, x, y = tile_of(15.432, 47.075, 14)
    south = (1 << 14) - 1 - y
    tiles = {(14, x + i, south + k): vector_tile() for i in range(-3, 4) for k in range(-3, 4)}
    return mbtiles(
        folder / "roads.mbtiles", tiles, format="pbf", minzoom="14", maxzoom="14", name="roads",
        attribution="<b>made</b> up", bounds="15,46.5,16,47.5",
    )  # fmt: skip


def aerial_map(folder: Path, origin: tuple[float, float] = (529_660.0, 5_216_500.0)) -> Path:
    """Fields and roads as a GeoTIFF, 8 km x 5.2 km about the lines of the tests.

    `origin` is its north-western corner, UTM zone 33, m.
    """
    random = np.random.default_rng(7)
    fields = random.integers((70, 100, 60), (130, 150, 100), (26, 40, 3)).astype(np.uint8)
    ground = cv2.resize(fields, (2000, 1300), interpolation=cv2.INTER_NEAREST)
    for k in range(0, 1300, 200):
        cv2.line(ground, (0, k + 60), (2000, k - 50), (170, 165, 150), 4)
    cv2.line(ground, (760, 0), (1080, 1300), (190, 185, 170), 7)
    from rasterio.transform import from_origin

    return geotiff(
        folder / "fields.tif",
        np.moveaxis(ground, 2, 0).copy(),
        transform=from_origin(*origin, 4.0, 4.0),
    )

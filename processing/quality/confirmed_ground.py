"""How much of a frame another head confirms: below a part of another exposure would stay unseen.

Points that match show that two heads see the same ground there. Water, haze and clouds have none,
near infrared has few.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.image.colour import BandRegistration
from processing.matching.tie_points import TiePoints
from processing.quality.figures.image import ConfirmedGroundFigures
from processing.rig import Rig, Sensor

Array = NDArray[Any]

CELLS: Final = 8
"""Along each side of a frame: a region of a quarter of its width and height holds at least one."""


def confirmed_ground_figures(
    rig: Rig,
    present: Collection[str],
    tie_points: TiePoints,
    registrations: Sequence[BandRegistration],
) -> ConfirmedGroundFigures:
    """The frame of which other heads confirm least.

    Args:
        rig: the camera.
        present: sensors with a frame.
        tie_points: matches of PAN with PAN and with the colour master.
        registrations: matches of the bands with the colour master.

    Returns:
        Share of its cells with a matched point, and its name; empty without a frame.
    """
    points = {r.sensor: [r.matched_at] for r in registrations}
    for number, name in enumerate(tie_points.names):
        points.setdefault(name, []).extend(
            (
                tie_points.raw_a[tie_points.sensor_a == number],
                tie_points.raw_b[tie_points.sensor_b == number],
            )
        )
    shares = {
        sensor.name: _confirmed_share(sensor, points.get(sensor.name, []))
        for sensor in rig.sensors
        if sensor.name in present
    }
    if not shares:
        return ConfirmedGroundFigures()
    least = min(shares, key=lambda name: shares[name])
    return ConfirmedGroundFigures(shares[least], least)


def _confirmed_share(sensor: Sensor, points: Sequence[Array]) -> float:
    """Share of the cells of a frame in which a point matches."""
    at = np.concatenate([np.zeros((0, 2)), *points])
    size = np.array([sensor.width_px, sensor.height_px])
    cells = np.clip(at * CELLS // size, 0, CELLS - 1).astype(np.int64)
    return len(np.unique(cells[:, 1] * CELLS + cells[:, 0])) / CELLS**2

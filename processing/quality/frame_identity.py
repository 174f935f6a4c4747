"""Identification of the head of a frame: frames of heads of one kind may be exchanged.

Two indicators: the fixed pattern of the pixels' response, which no two sensors share, where heads
are calibrated for it; and the place of the colour master's layer, where it fits another head's
calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement, vip_mm_from_raw
from processing.image.colour import BandRegistration
from processing.matching.tie_points import PAN_TO_COLOUR, TiePoints
from processing.quality.figures.image import IdentityFigures
from processing.radiometry.corrector import Corrector
from processing.radiometry.demosaic import is_bayer
from processing.radiometry.level1 import exposed_rows
from processing.rig import Rig, Sensor

Array = NDArray[Any]

PIXELS: Final = 30_000
MIN_ROWS: Final = 8
"""Of a frame, evenly over its height, that are looked at."""
SCREEN: Final = 4
"""Every so many of these rows are looked at first: they suffice where the pattern is clear."""
OWN_PATTERN_LIMIT: Final = 6.0
OTHER_PATTERN_LIMIT: Final = 8.0
"""Correlation with a pattern over its standard deviation: below `OWN` it is not the frame's, above
`OTHER` it is."""
MAX_TEXTURE: Final = 3.0
"""Times the usual change between pixels: edges count no more."""
MIN_POINTS: Final = 100
ENOUGH_POINTS: Final = 1000
"""Spread over all that there are, of which the median is taken."""
MIN_OFFSET_PX: Final = 1.5
_SPREAD_STEP_PX: Final = 4
"""One of so many columns shows the usual change."""
MAX_OFFSET_SHARE: Final = 0.4
MAX_OFFSET_PX: Final = 1.3
"""How far points of green may lie off by the calibration of the head they came from: PAN pixels,
three sigmas of a mounting, and of what they do by their own one."""


class FixedPatterns:
    """The calibrated response of pixels as it shows between neighbours, computed once."""

    def __init__(self, correctors: Mapping[str, Corrector]) -> None:
        """Nothing is computed yet.

        Args:
            correctors: with the calibrated response of the pixels, by sensor name.
        """
        self._correctors = correctors
        self._known: dict[tuple[str, int], Array] = {}

    def of(self, name: str, shifts: int) -> Array | None:
        """Pattern of a sensor's response in the rows looked at.

        Args:
            name: of the sensor.
            shifts: TDI shifts, over which the response is averaged.

        Returns:
            Second differences along the rows as a share of the response, (rows, width - 2), or
            width - 4 where pixels of one colour are two apart; None for a sensor without a
            calibrated response.
        """
        corrector = self._correctors.get(name)
        if corrector is None or corrector.response is None:
            return None
        if (name, shifts) not in self._known:
            rows = _rows(corrector.sensor, shifts)
            visited = rows[:, None] - corrector.sensor.tdi_row_sign * np.arange(shifts + 1)
            response = corrector.response[visited].mean(axis=1, dtype=np.float32)
            self._known[name, shifts] = _relative_change(response, _pace(corrector.sensor))
        return self._known[name, shifts]


def heads_by_pattern(
    rig: Rig,
    frames: Mapping[str, Array],
    patterns: FixedPatterns,
    tdi_shifts: Mapping[str, int],
) -> dict[str, str]:
    """Find frames that show another head's fixed pattern and not their own.

    Args:
        rig: the camera.
        frames: Level-0 frames by sensor name, (h, w) uint16, DN.
        patterns: of the pixels' response.
        tdi_shifts: of each frame, by sensor name; none where it is absent.

    Returns:
        The sensor a frame came from, by the sensor it is stored for.
    """
    found = {}
    for sensor in rig.sensors:
        name = sensor.name
        if name not in frames:
            continue
        shifts = tdi_shifts.get(name, 0)
        own = patterns.of(name, shifts)
        if own is None:
            continue
        rows = _rows(sensor, shifts)
        few = _change_of(sensor, frames[name][rows[::SCREEN]])
        if _correlation_significance(few, own[::SCREEN]) >= OWN_PATTERN_LIMIT:
            continue
        change = _change_of(sensor, frames[name][rows])
        if _correlation_significance(change, own) >= OWN_PATTERN_LIMIT:
            continue
        others = {
            other.name: _correlation_significance(change, pattern)
            for other in rig.sensors
            if other.name != name
            and _format(sensor) == _format(other)
            and (pattern := patterns.of(other.name, shifts)) is not None
        }
        best = max(others, key=lambda n: others[n], default=None)
        if best is not None and others[best] > OTHER_PATTERN_LIMIT:
            found[name] = best
    return found


def identity_figures(
    rig: Rig,
    by_pattern: Mapping[str, str],
    placements: Mapping[str, SensorPlacement],
    tie_points: TiePoints,
    bands: Sequence[BandRegistration],
) -> IdentityFigures:
    """Name frames that came from another head than the one they are stored for.

    Args:
        rig: the camera.
        by_pattern: of `heads_by_pattern`; where it is empty, the place of green decides.
        placements: by calibration and TDM, by sensor name.
        tie_points: with the colour master.
        bands: how the others lie against it.

    Returns:
        Such frames, the heads they came from, and by what; empty without one.
    """
    if by_pattern:
        return pattern_figures(by_pattern)
    found = _by_place(rig, placements, tie_points, bands)
    return IdentityFigures(tuple(found), tuple(found.values()), "geometry" if found else None)


def pattern_figures(by_pattern: Mapping[str, str]) -> IdentityFigures:
    """Name frames that show another head's fixed pattern.

    Args:
        by_pattern: of `heads_by_pattern`.

    Returns:
        Such frames and the heads they came from; empty without one.
    """
    shown_by = "fixed pattern" if by_pattern else None
    return IdentityFigures(tuple(by_pattern), tuple(by_pattern.values()), shown_by)


def _format(sensor: Sensor) -> tuple[int, int, str]:
    return sensor.width_px, sensor.height_px, sensor.colour_filter_array


def _pace(sensor: Sensor) -> int:
    """Pixels from one to the next of its colour along a row."""
    return 2 if is_bayer(sensor) else 1


def _rows(sensor: Sensor, shifts: int) -> Array:
    first, last = exposed_rows(sensor, shifts)
    count = max(MIN_ROWS, PIXELS // sensor.width_px)
    rows: Array = np.linspace(first, last, count).astype(np.int64)
    return rows


def _change_of(sensor: Sensor, lines: Array) -> Array:
    """Relative change along lines of a Level-0 frame."""
    signal = lines.astype(np.float32) / sensor.raw_units_per_dn - sensor.black_dn
    return _relative_change(signal, _pace(sensor))


def _relative_change(lines: Array, pace: int) -> Array:
    """Second differences along lines over what they are of, edges cut off."""
    middle = lines[:, pace:-pace]
    change = lines[:, 2 * pace :] - 2.0 * middle + lines[:, : -2 * pace]
    change /= np.maximum(middle, np.float32(20.0))
    most = MAX_TEXTURE * np.float32(np.median(np.abs(change[:, ::_SPREAD_STEP_PX])))
    limited: Array = np.clip(change, -most, most)
    return limited


def _correlation_significance(change: Array, pattern: Array) -> float:
    """Correlation of two fields over its standard deviation."""
    product = float(np.sum(change * pattern, dtype=np.float64))
    squares = np.sum(change * change, dtype=np.float64) * np.sum(pattern**2, dtype=np.float64)
    return product / float(np.sqrt(max(squares, 1e-30))) * float(np.sqrt(change.size))


def _by_place(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    tie_points: TiePoints,
    bands: Sequence[BandRegistration],
) -> dict[str, str]:
    """The colour master and the head whose calibration its frame fits, each named for the other."""
    image = rig.virtual_image
    if rig.colour_master_cone is None or image is None:
        return {}
    green = rig.cone(rig.colour_master_cone).sensors[0]
    to_green = np.flatnonzero(tie_points.kind == PAN_TO_COLOUR)
    if len(to_green) < MIN_POINTS:
        return {}
    points = tie_points.only(to_green[:: max(1, len(to_green) // ENOUGH_POINTS)])
    pan_mm = np.empty_like(points.raw_a)
    for k in np.unique(points.sensor_a):
        here = points.sensor_a == k
        pan_mm[here] = vip_mm_from_raw(placements[points.names[k]], points.raw_a[here])

    def off_px(name: str) -> float:
        separation_px = vip_mm_from_raw(placements[name], points.raw_b) - pan_mm
        return float(np.median(np.hypot(separation_px[:, 0], separation_px[:, 1]))) / image.pitch_mm

    own = off_px(green.name)
    if own < MIN_OFFSET_PX:
        return {}
    moved = {b.sensor: float(np.hypot(*b.band_from_green[:2, 2])) / image.pitch_mm for b in bands}
    others = {
        sensor.name: off_px(sensor.name)
        for cone in rig.colour_cones
        for sensor in cone.sensors
        if moved.get(sensor.name, 0.0) > MIN_OFFSET_PX
        and (sensor.width_px, sensor.height_px) == (green.width_px, green.height_px)
    }
    best = min(others, key=lambda n: others[n], default=None)
    if best is None or others[best] > min(MAX_OFFSET_PX, MAX_OFFSET_SHARE * own):
        return {}
    return {green.name: best, best: green.name}

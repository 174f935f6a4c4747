"""Exposure times of frames: the common one of comparable frames, and factors that bring signals to
it.

Also names the frames whose exposure time is not known or cannot be. The signal itself is scaled in
`processing.radiometry.level1`.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Collection, Mapping

from processing.geometry.conditions import by_sensor_name
from processing.quality.figures.circumstances import (
    ExposureScaleFigures,
    UnknownExposureFigures,
)
from processing.rig import Rig

EXPOSURE_TIME_TOLERANCE = 0.02
"""Exposure times of cones that differ by less are those of one setting."""
MAX_EXPOSURE_SCALE = 2.05
PLAUSIBLE_EXPOSURE_TIMES_S = (1e-6, 10.0)
MAX_EXPOSURE_RATIO = 16.0
"""Four stops: heads of one kind that are set further apart do not see the same ground."""


def implausible_exposure_times(rig: Rig, exposure_time_s: Mapping[str, float]) -> tuple[str, ...]:
    """Frames whose exposure time cannot be: the record or the head is wrong.

    Outside `PLAUSIBLE_EXPOSURE_TIMES_S`, or, of three or more PAN or colour frames, more than
    `MAX_EXPOSURE_RATIO` times as long or short as their median.

    Args:
        rig: the camera.
        exposure_time_s: by sensor name.

    Returns:
        Names of the sensors, in the order of the rig.

    Example:
        >>> from processing.rig import find_rig
        >>> rig = find_rig("ultracam-x-mini")
        >>> times_s = {sensor.name: 0.002 for sensor in rig.sensors}
        >>> implausible_exposure_times(rig, times_s | {"SU10": 1e-8, "R": 0.05})
        ('SU10', 'R')
    """
    shortest_s, longest_s = PLAUSIBLE_EXPOSURE_TIMES_S
    possible = {n: t for n, t in exposure_time_s.items() if shortest_s <= t <= longest_s}
    implausible = exposure_time_s.keys() - possible.keys()
    for cones in (rig.pan_cones, rig.colour_cones):
        known = {n: t for cone in cones for n, t in by_sensor_name(cone, possible).items()}
        if len(known) < 3:
            continue
        usual = statistics.median_low(known.values())
        implausible |= {
            name
            for name, time_s in known.items()
            if max(time_s / usual, usual / time_s) > MAX_EXPOSURE_RATIO
        }
    return tuple(sensor.name for sensor in rig.sensors if sensor.name in implausible)


def reference_exposure_times(rig: Rig, exposure_times: Mapping[str, float]) -> dict[str, float]:
    """Common exposure time to which the signal of each frame is scaled.

    The median of its cone where that is the median of all PAN cones, or of all colour cones, to
    within `EXPOSURE_TIME_TOLERANCE`; else the median of those. A cone exposed less than half as
    long keeps its own: its highlights would leave the range of words. Of two frames in the middle
    of a cone that nearer to the median of the cones counts.

    Args:
        rig: the camera.
        exposure_times: positive, by sensor name, in any unit.

    Returns:
        Reference by sensor name, in the unit of `exposure_times`, for the sensors that have one.
    """
    references: dict[str, float] = {}
    for cones in (rig.pan_cones, rig.colour_cones):
        of_cones = {
            cone.name: statistics.median_low(known.values())
            for cone in cones
            if (known := by_sensor_name(cone, exposure_times))
        }
        if not of_cones:
            continue
        usual = statistics.median_low(of_cones.values())
        for cone in cones:
            own = usual
            if known := by_sensor_name(cone, exposure_times):
                middle = (
                    statistics.median_low(known.values()),
                    statistics.median_high(known.values()),
                )
                own = min(middle, key=lambda time: abs(math.log(time / usual)))
            is_unscaled = (
                abs(own / usual - 1.0) <= EXPOSURE_TIME_TOLERANCE
                or own < usual / MAX_EXPOSURE_SCALE
            )
            for name in by_sensor_name(cone, exposure_times):
                references[name] = own if is_unscaled else usual
    return references


def exposure_scales(rig: Rig, exposure_time_s: Mapping[str, float]) -> dict[str, float]:
    """Factors on the signal of each frame that make all frames comparable.

    Exactly 1 where the frames of a cone have one exposure time, and that of the other cones.

    Args:
        rig: the camera.
        exposure_time_s: positive, by sensor name.

    Returns:
        Factors by sensor name. A frame whose exposure time is not known has none.

    Example:
        Cone 0 exposed 1.5 ms, another PAN cone of the same rig 1 ms.

        >>> from processing.rig import find_rig
        >>> times_s = {"SU00": 0.0015, "SU10": 0.001, "SU20": 0.001, "SU30": 0.001}
        >>> scales = exposure_scales(find_rig("ultracam-x-mini"), times_s)
        >>> round(scales["SU00"], 3), scales["SU10"]
        (0.667, 1.0)
    """
    references = reference_exposure_times(rig, exposure_time_s)
    return {name: reference / exposure_time_s[name] for name, reference in references.items()}


def exposure_scale_figures(scales: Mapping[str, float]) -> ExposureScaleFigures:
    """The frame whose level was corrected most, and by what factor.

    Args:
        scales: positive factors by sensor name, from `exposure_scales`.

    Returns:
        Name and factor of the scale farthest from 1; no name where all are 1, neither where empty.

    Example:
        >>> figures = exposure_scale_figures({"SU00": 1.0, "SU01": 1.25, "SU02": 0.5})
        >>> figures.exposure_scaled_sensor, figures.exposure_scale
        ('SU02', 0.5)
    """
    name = max(scales, key=lambda n: abs(math.log(scales[n])), default=None)
    if name is None:
        return ExposureScaleFigures()
    return ExposureScaleFigures(None if scales[name] == 1.0 else name, scales[name])


def unknown_exposure_figures(
    rig: Rig, present: Collection[str], exposure_time_s: Mapping[str, float]
) -> UnknownExposureFigures:
    """Colour frames whose exposure time is not known while that of other frames is.

    Overlaps show the level of a PAN head; nothing in one exposure shows that of a colour head.

    Args:
        rig: the camera.
        present: names of the sensors that sent a frame.
        exposure_time_s: by sensor name, what the record states.

    Returns:
        Names of those colour sensors; none where no frame has an exposure time.
    """
    if not any(name in exposure_time_s for name in present):
        return UnknownExposureFigures()
    colour = [s.name for cone in rig.colour_cones for s in cone.sensors if s.name in present]
    return UnknownExposureFigures(tuple(n for n in colour if n not in exposure_time_s))

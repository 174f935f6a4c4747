"""Whether the ground causes a step of signal along a line of a frame: what other heads show there.

A shared supply or clock changes several frames at once, and so do rows of plants and roofs. These
lie at one place of the ground, that at one line of each sensor.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement, raw_from_vip_mm, vip_mm_from_raw
from processing.geometry.topology import exact_colour_ratio
from processing.radiometry.level1 import exposed_rows
from processing.rig import Rig

Array = NDArray[Any]
Axis = Literal["rows", "columns"]

SAMPLES: Final = 120
"""Places along a line, at most."""
MAX_SHARED: Final = 0.5
"""Of the step that another head may show where the ground is not its cause."""
MIN_BANDS: Final = 2
MIN_FRAMES: Final = 3
"""Frames that step at the same line, none of which sees the line of another."""
MIN_ALONE: Final = 2
"""Colour frames whose steps no other head shows, each at a place of its own."""
SAME_LINE_PX: Final = 6.0
"""Lines of several frames that are so near in the virtual image, PAN pixels, may be one edge."""
SAME_LINES: Final = 0.5
"""Of the stepping lines of two frames, the share that has the same numbers."""
MIN_SPACINGS: Final = 8
EVEN_SHARE: Final = 0.7
"""Of so many distances between the stepping lines of a frame, the share that is the same."""
LINES: Final = 12
"""Stepping lines of a frame that are compared with other heads."""
WINDOW_PX: Final = 12.0
"""Tie points so near a step of signal are drawn to it, pixels of the frame that has the step."""
_WHOLE: Final = 0.8
_HALF: Final = 0.5
"""Share of a line that a head has to see: of an edge, of a line over the whole frame."""


@dataclass(frozen=True)
class GroundView:
    """The frames of an exposure (Level-1 words by sensor name) and where they lie."""

    rig: Rig
    placements: Mapping[str, SensorPlacement]
    frames: Mapping[str, Array]

    def is_pan(self, name: str) -> bool:
        """Whether a sensor is of a PAN head.

        Args:
            name: of the sensor.

        Returns:
            False for colour.
        """
        return self.rig.cone_of(name).role == "pan"

    def reach_px(self, name: str) -> float:
        """How far from a line of a frame its sides are compared, pixels of the frame.

        Of PAN that is beyond the pixel of a colour head that the line goes through.

        Args:
            name: of the sensor.

        Returns:
            Pixels.
        """
        ratio = max(round(exact_colour_ratio(self.rig) or 1.0), 1)
        return 1.5 * ratio + 1.0 if self.is_pan(name) else 2.5


@dataclass(frozen=True)
class LineStep:
    """Between line `at` of a frame and the next along `axis` the signal changes by `relative`."""

    sensor: str
    axis: Axis
    at: int
    relative: float


def sides_of(axis: Axis, at: int, along: Array, away_px: float) -> tuple[Array, Array]:
    """Places on both sides of the edge between a line and the next.

    Args:
        axis: the lines are rows or columns.
        at: the last line before the edge.
        along: places along the line, (n,), px.
        away_px: distance from the edge.

    Returns:
        (column, row) before and after it, each (n, 2).

    Example:
        >>> sides_of("rows", 10, np.array([3.0]), 2.5)
        (array([[3., 8.]]), array([[ 3., 13.]]))
    """
    before, after = (
        np.stack((along, across) if axis == "rows" else (across, along), axis=1)
        for across in (np.full_like(along, at + 0.5 + side) for side in (-away_px, away_px))
    )
    return before, after


def signal_change(
    frame: Array,
    placement: SensorPlacement,
    sides: tuple[Array, Array],
    reach: int,
    *,
    least: float = _WHOLE,
) -> float | None:
    """Change of signal from one row of places to the other, of itself.

    Each place counts by the mean of the pixels within `reach`; 2 x 2 of a colour filter array.

    Args:
        frame: Level-1 words, (h, w) uint16.
        placement: of its sensor.
        sides: raw (column, row) of the places, each (n, 2).
        reach: pixels around each place.
        least: share of the places that the frame has to see, 0 to 1.

    Returns:
        Difference of the medians over their mean; None where the frame sees too few places.
    """
    sensor = placement.sensor
    bayer = sensor.colour_filter_array != "none"
    first, last = exposed_rows(sensor, placement.tdi_shifts)
    around = range(2) if bayer else range(-reach, reach + 1)
    values = []
    for places in sides:
        inside: Array = np.asarray(np.isfinite(places).all(axis=1))
        at = np.rint(np.where(inside[:, None], places, 0.0)).astype(np.int64)
        inside &= (at[:, 0] >= 2) & (at[:, 0] < sensor.width_px - 2)
        inside &= (at[:, 1] >= first + 2) & (at[:, 1] <= last - 2)
        at = np.where(inside[:, None], at, 2)
        pixels = np.stack([frame[at[:, 1] + y, at[:, 0] + x] for y in around for x in around])
        inside &= ((pixels & 1) == 0).all(axis=0) & (pixels > 0).all(axis=0)
        values.append(np.where(inside, pixels.mean(axis=0), np.nan))
    both = np.isfinite(values[0]) & np.isfinite(values[1])
    if np.count_nonzero(both) < max(least * len(sides[0]), 1):
        return None
    before, after = (float(np.median(side[both])) for side in values)
    return (after - before) / max(0.5 * (after + before), 1.0)


def read_out_frames(
    steps: Mapping[str, Sequence[LineStep]], view: GroundView | None
) -> frozenset[str]:
    """The frames whose steps the ground cannot cause.

    They step at the same lines as others that see other ground, or other heads show the same
    ground without the step: PAN sees the sum of what colour heads see, so its change lies between
    the smallest and the largest of theirs. One colour alone may have an edge of its own; several
    at different places are none.

    Args:
        steps: of each frame along one axis, by sensor name.
        view: frames and places; None where heads share no ground.

    Returns:
        Names of the sensors.
    """
    found = _at_same_lines(steps, view)
    if view is None:
        return frozenset(found | _equally_spaced(steps))
    alone = set()
    for name, of_frame in steps.items():
        shares = _shares_of_heads(of_frame, view)
        if _is_contradicted(name, shares, view):
            found.add(name)
        elif _is_alone(shares, view):
            alone.add(name)
    return frozenset(found | alone if len(alone) >= MIN_ALONE else found)


def is_ground(steps: Sequence[LineStep], view: GroundView) -> bool:
    """Whether most of the other heads show the steps of a frame at their places of the ground.

    What the frame shows there is step and ground; what of that another head shows is ground.

    Args:
        steps: of one frame along one axis.
        view: frames and places.

    Returns:
        False where no other head sees enough of them.
    """
    shares = []
    for step in _separate(steps, view):
        own, seen = _changes(step, view)
        shares += [1.0 - (own - change) / step.relative for change in seen.values()]
    return bool(shares) and float(np.median(shares)) > MAX_SHARED


def is_drawn_by_step(
    view: GroundView,
    steps: Collection[LineStep],
    sensor: str,
    band: tuple[Axis, int, int],
) -> bool:
    """Whether a narrow band of one frame lies where another frame has a step of signal.

    Tie points between both are drawn to the step: the band is not shifted.

    Args:
        view: frames and places.
        steps: of all frames.
        sensor: the frame with the band.
        band: its lines are rows or columns, the first and the last.

    Returns:
        True where a step explains the band.
    """
    axis, first, last = band
    own = view.rig.sensor(sensor)
    length = own.width_px if axis == "rows" else own.height_px
    along = np.linspace(0.0, length - 1.0, SAMPLES)
    ground = [
        vip_mm_from_raw(view.placements[sensor], side)
        for side in sides_of(axis, first, along, 0.0)[:1] + sides_of(axis, last, along, 0.0)[:1]
    ]
    for step in steps:
        if step.sensor == sensor:
            continue
        other = view.rig.sensor(step.sensor)
        with np.errstate(invalid="ignore"):
            raw = np.stack([raw_from_vip_mm(view.placements[step.sensor], g) for g in ground])
        inside = np.isfinite(raw).all(axis=(0, 2)) & (raw >= 0.0).all(axis=(0, 2))
        inside &= (raw <= (other.width_px - 1, other.height_px - 1)).all(axis=(0, 2))
        if not inside.any():
            continue
        across = raw[:, inside, 1 if step.axis == "rows" else 0] - (step.at + 0.5)
        if np.median(np.abs(across).max(axis=0)) < WINDOW_PX:
            return True
    return False


def _at_same_lines(steps: Mapping[str, Sequence[LineStep]], view: GroundView | None) -> set[str]:
    """Frames of a group that step at the same lines, where enough of them see other ground."""
    lines = {name: {step.at for step in of_frame} for name, of_frame in steps.items()}
    found: set[str] = set()
    for name, own in lines.items():
        group = [
            other
            for other, theirs in lines.items()
            if len(own & theirs) >= SAME_LINES * max(len(own), len(theirs))
        ]
        if len(group) >= MIN_FRAMES and _edges_on_ground(steps, group, view) >= MIN_FRAMES:
            found.add(name)
    return found


def _equally_spaced(steps: Mapping[str, Sequence[LineStep]]) -> set[str]:
    """Frames of a group with the same even number of lines from step to step.

    Heads that look into different directions see rows of plants at different distances.
    """
    spacings: dict[int, set[str]] = {}
    for name, of_frame in steps.items():
        apart = np.diff(sorted(step.at for step in of_frame))
        if len(apart) >= MIN_SPACINGS:
            usual = int(np.median(apart))
            if np.mean(apart == usual) >= EVEN_SHARE:
                spacings.setdefault(usual, set()).add(name)
    return {name for group in spacings.values() if len(group) >= MIN_FRAMES for name in group}


def _edges_on_ground(
    steps: Mapping[str, Sequence[LineStep]], group: Sequence[str], view: GroundView | None
) -> int:
    """At how many places of the ground the lines of these frames lie."""
    if view is None:
        return len(group)
    shared = set.intersection(*({step.at for step in steps[name]} for name in group))
    if not shared:
        return 0
    at, image = min(shared), view.rig.virtual_image
    places = []
    for name in group:
        sensor, axis = view.rig.sensor(name), steps[name][0].axis
        middle = (sensor.width_px - 1) / 2.0, (sensor.height_px - 1) / 2.0
        raw = (middle[0], at + 0.5) if axis == "rows" else (at + 0.5, middle[1])
        vip_mm = vip_mm_from_raw(view.placements[name], np.array([raw]))[0]
        places.append(float(vip_mm[1] if axis == "rows" else vip_mm[0]))
    pitch_mm = image.pitch_mm if image is not None else 1.0
    apart = np.diff(np.sort(places)) / pitch_mm
    return 1 + int(np.count_nonzero(apart > SAME_LINE_PX))


def _shares_of_heads(steps: Sequence[LineStep], view: GroundView) -> dict[str, float]:
    """What of the steps of a frame other colour heads, by name, and all PAN heads, "", show."""
    by_head: dict[str, list[float]] = {}
    for step in _separate(steps, view):
        own, seen = _changes(step, view)
        for head, change in seen.items():
            by_head.setdefault(head, []).append(change / own)
    return {head: float(np.median(some)) for head, some in by_head.items()}


def _separate(steps: Sequence[LineStep], view: GroundView) -> list[LineStep]:
    """The largest steps of a frame that are compared with other heads."""
    reach = view.reach_px(steps[0].sensor) + 1.0
    lines = np.array([step.at for step in steps])
    # Between lines that step near each other, the sides of one lie beyond the next.
    separate = [s for s in steps if np.count_nonzero(np.abs(lines - s.at) < reach) == 1]
    return sorted(separate, key=lambda step: -abs(step.relative))[:LINES]


def _is_contradicted(name: str, shares: Mapping[str, float], view: GroundView) -> bool:
    """Whether PAN changes by more or less than all colours do."""
    colours = [share for head, share in shares.items() if head]
    if view.is_pan(name):
        return len(colours) >= MIN_BANDS and max(colours) < MAX_SHARED
    every = sum(1 for cone in view.rig.cones if cone.role == "colour")
    if "" not in shares or len(colours) + 1 < max(every, MIN_BANDS):
        return False
    return shares[""] < MAX_SHARED * min(1.0, *colours)


def _is_alone(shares: Mapping[str, float], view: GroundView) -> bool:
    """Whether neither PAN nor another colour shows the steps of a colour frame."""
    every = sum(1 for cone in view.rig.cones if cone.role == "colour")
    return len(shares) == every and max(map(abs, shares.values())) < MAX_SHARED


def _changes(step: LineStep, view: GroundView) -> tuple[float, dict[str, float]]:
    """The change of the frame at one step, and what other colour heads, by name, and all PAN heads
    together, "", show there; nothing where the frame does not show it."""
    sensor = view.rig.sensor(step.sensor)
    length = sensor.width_px if step.axis == "rows" else sensor.height_px
    along = np.linspace(2.0, length - 3.0, SAMPLES)
    sides = sides_of(step.axis, step.at, along, view.reach_px(step.sensor))
    own_reach = 1 if view.is_pan(step.sensor) else 0
    placement = view.placements[step.sensor]
    own = signal_change(view.frames[step.sensor], placement, sides, own_reach, least=_HALF)
    # Of narrow bands of lines the sides may lie beyond the band: such a line shows nothing.
    if own is None or own * np.sign(step.relative) < _HALF * abs(step.relative):
        return 0.0, {}
    ground = tuple(vip_mm_from_raw(placement, side) for side in sides)
    found: dict[str, float] = {}
    pan: list[float] = []
    for name, frame in view.frames.items():
        if name == step.sensor:
            continue
        of_pan = view.is_pan(name)
        with np.errstate(invalid="ignore"):
            before, after = (raw_from_vip_mm(view.placements[name], side) for side in ground)
        # Many PAN frames see a line of a colour frame, a part each.
        least = 0.15 if of_pan else _HALF
        seen = signal_change(
            frame, view.placements[name], (before, after), 1 if of_pan else 0, least=least
        )
        if seen is not None and of_pan:
            pan.append(seen)
        elif seen is not None:
            found[name] = seen
    if pan:
        found[""] = float(np.median(pan))
    return own, found

"""Lines that read-out shifts, planted in any head, and at the ends of frames, too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.silent_errors.exposures import EmulatedExposure
from benchmarks.silent_errors.planting import (
    Array,
    Fault,
    Random,
    any_of,
    colour_sensors,
    of_frame,
    pan_sensors,
)

END_PX = 40
"""Rows at an end of a frame, of which a row inserted leaves so many at least."""


def slip(emulated: EmulatedExposure, lines: float, random: Random) -> Fault:
    """Rows or columns of a frame that are those 1 to 4 px away, at either end or anywhere."""
    name = any_of(random, [*pan_sensors(emulated.rig), *colour_sensors(emulated.rig)])
    axis = int(random.integers(0, 2))
    sensor = emulated.rig.sensor(name)
    size = (sensor.height_px, sensor.width_px)[axis]
    count = min(round(lines), size // 2)
    first, by = int(random.integers(8, size - count - 8)), int(random.integers(1, 5))
    first = any_of(random, (first, first, 0, size - count))
    last = first + count
    # At the end of a frame there is nothing beyond that it could show.
    off = -by if last == size else by

    def change(frame: Array) -> Array:
        rows = frame if axis == 0 else frame.T
        rows[first:last] = rows.copy()[np.arange(first, last) + off]
        return frame

    def content(raw: Array) -> Array:
        at = raw[:, 1 - axis]
        inside = (at >= first - 0.5) & (at < last - 0.5)
        moved = raw.copy()
        moved[inside, 1 - axis] += off
        return moved

    description = f"{count} {('rows', 'columns')[axis]} from {first} on are those {off:+d} further"
    fault = of_frame(emulated, name, change, description)
    return replace(fault, emulated=replace(fault.emulated, content={name: content}))


def row_inserted(emulated: EmulatedExposure, _: float, random: Random) -> Fault:
    """One row twice, the rest of the frame one row further on."""
    name = any_of(random, [*pan_sensors(emulated.rig), *colour_sensors(emulated.rig)])
    row = int(random.integers(END_PX, emulated.rig.sensor(name).height_px - END_PX))

    def change(frame: Array) -> Array:
        frame[row + 1 :] = frame[row:-1].copy()
        return frame

    def content(raw: Array) -> Array:
        moved = raw.copy()
        moved[raw[:, 1] > row + 0.5, 1] -= 1.0
        return moved

    fault = of_frame(emulated, name, change, f"row {row} twice, the rest one row further on")
    return replace(fault, emulated=replace(fault.emulated, content={name: content}))

"""Scenes of healthy exposures that are hard to evaluate: water, fields, shadows, traffic, haze."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.quality.report import NO_FLAGS, Flag

Array = NDArray[Any]
Tone = Callable[[Array, Array, np.random.Generator], Array]
"""What illumination or reflectance is multiplied by at columns and rows of the virtual image."""

SHADOW: Final = 0.35
"""Light in the shadow of a cloud, against sunlight."""
_WATER: Final = Flag.TIE_POINTS | Flag.UNDEREXPOSED | Flag.BLUR


@dataclass(frozen=True)
class CleanScene:
    """Settings of the world, a tone over its ground, and the flags that the scene itself raises."""

    description: str
    world: Mapping[str, object] = field(default_factory=dict)
    tone: Tone | None = None
    expected: Flag = NO_FLAGS


def _shadow(columns: Array, rows: Array, random: np.random.Generator) -> Array:
    """The shadow of one cumulus: a wavy outline, and a penumbra of 2 to 30 px."""
    middle = random.uniform(0.2, 0.8, 2) * (2800.0, 1900.0)
    x, y = columns - middle[0], rows - middle[1]
    angle, reach = np.arctan2(y, x), np.hypot(x, y)
    edge = float(random.uniform(250.0, 900.0))
    outline = np.full(angle.shape, edge)
    for waves in range(2, 9):
        phase = float(random.uniform(0.0, 2.0 * np.pi))
        outline += 0.2 * edge / waves * np.sin(waves * angle + phase)
    soft = float(np.exp(random.uniform(np.log(2.0), np.log(30.0))))
    lit = 0.5 + 0.5 * np.tanh((reach - outline) / soft)
    return np.asarray(SHADOW + (1.0 - SHADOW) * lit)


def _fields(columns: Array, rows: Array, random: np.random.Generator) -> Array:
    """Fields of even tone whose edges run nearly along rows and columns of the image."""
    azimuth = float(random.normal(0.0, np.radians(3.0)))
    along = columns * np.cos(azimuth) + rows * np.sin(azimuth)
    across = rows * np.cos(azimuth) - columns * np.sin(azimuth)
    number = np.zeros(columns.shape, np.int64)
    for at, span in ((along, 4200.0), (across, 3200.0)):
        edges = np.sort(random.uniform(-300.0, span, int(random.integers(4, 12))))
        number = number * 16 + np.searchsorted(edges, at)
    tones = random.uniform(0.6, 1.4, 512)
    return np.asarray(tones[number % 512])


SCENES: Final[Mapping[str, CleanScene]] = {
    "landscape": CleanScene("fields, villages and woods"),
    "fields": CleanScene("edges of fields along rows and columns", tone=_fields),
    "shadow": CleanScene("the shadow of a cloud", tone=_shadow),
    "traffic": CleanScene("motorways with moving vehicles", {"ground": "traffic"}),
    "haze": CleanScene("3 km visibility", {"ground": "haze"}, expected=Flag.BLUR | Flag.TIE_POINTS),
    "coast": CleanScene("a shore and calm water", {"ground": "coast"}, expected=_WATER),
    "water": CleanScene("the sea in a breeze", {"ground": "open-water"}, expected=_WATER),
    "cloud": CleanScene("a cloud over a sensor", {}, expected=Flag.TIE_POINTS | Flag.OVEREXPOSED),
}

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


EDGE_PIXELS: Final = 3.0
"""Own pixels of a head over which lens and pixel spread an edge; a tenth to nine tenths lie in 1.8
of them."""


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
    soft_px = EDGE_PIXELS * float(np.hypot(*(x[0, 1] - x[0, 0] for x in (columns, rows))))
    fields = []
    for at, span in ((along, 4200.0), (across, 3200.0)):
        edges = np.sort(random.uniform(-300.0, span, int(random.integers(4, 12))))
        fields.append(_fields_along(at, edges, soft_px))
    tones = random.uniform(0.6, 1.4, 512)
    (i, of_i), (j, of_j) = fields
    upper = tones[i * 16 + j] * (1.0 - of_j) + tones[i * 16 + j + 1] * of_j
    lower = tones[(i + 1) * 16 + j] * (1.0 - of_j) + tones[(i + 1) * 16 + j + 1] * of_j
    return np.asarray(upper * (1.0 - of_i) + lower * of_i)


def _fields_along(at: Array, edges: Array, soft_px: float) -> tuple[Array, Array]:
    """Number of the field before the nearest edge, and the share of the one behind it."""
    middles = 0.5 * (edges[1:] + edges[:-1])
    nearest = np.searchsorted(middles, at)
    share = np.clip((at - edges[nearest]) / soft_px + 0.5, 0.0, 1.0)
    return nearest, share * share * (3.0 - 2.0 * share)


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

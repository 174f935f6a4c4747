"""Levels of the colour bands against PAN, exposure by exposure, and a band that changes alone.

PAN sees what the bands see, each with a share p that is the camera's: sum p L_band / L_pan is one
over any ground. Ground that turns from fields to water moves several ratios, a head that changes
moves one. One exposure cannot decide: woods have half the red of bare soil.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from processing.quality.common_windows import CommonWindows
from processing.quality.figures.image import BandLevelFigures
from processing.rig import Rig

MIN_WINDOWS: Final = 200
MIN_CHANGE: Final = 0.5
"""Natural logarithm of the change of one ratio: a factor of 1.65."""
MAX_OTHERS: Final = 0.06
"""Of every other ratio meanwhile."""
MIN_OTHERS: Final = 2


@dataclass(frozen=True)
class LevelStep:
    """From exposure `before` to `exposure` the level of a band against PAN changes by `factor`."""

    band: str
    before: int
    exposure: int
    factor: float

    @property
    def sentence(self) -> str:
        """What happened, and what to do."""
        return (
            f"From exposure {self.before} to {self.exposure} the level of {self.band} against PAN "
            f"changes by a factor of {self.factor:.2f} while the other bands keep theirs: exposure "
            "time, aperture or gain of its head changed and is not in the record. Colours are "
            "wrong up to the next such change. Check the settings of the head."
        )


def level_figures(rig: Rig, ground: CommonWindows | None) -> BandLevelFigures | None:
    """Level of each band against PAN on the same ground.

    Args:
        rig: the camera.
        ground: windows that heads share; None where there are none.

    Returns:
        Median signal over that of PAN by band, for bands with enough windows; None without PAN.
    """
    if ground is None or not ground.pan.any():
        return None
    seen = np.isfinite(ground.mean[ground.pan])
    total = np.where(seen, ground.mean[ground.pan], 0.0).sum(axis=0)
    pan = total / np.where(seen.any(axis=0), seen.sum(axis=0), np.nan)
    level_by_band: dict[str, float | None] = {}
    for name, mean, of_pan in zip(ground.names, ground.mean, ground.pan, strict=True):
        both = np.isfinite(mean) & np.isfinite(pan) & (pan > 0.0)
        bands = rig.cone_of(name).bands
        if not of_pan and len(bands) == 1 and np.count_nonzero(both) >= MIN_WINDOWS:
            level_by_band[bands[0]] = float(np.median(mean[both] / pan[both]))
    return BandLevelFigures(level_by_band)


def level_steps(levels: Mapping[int, Mapping[str, float]]) -> tuple[LevelStep, ...]:
    """Bands whose level changes alone from one exposure of a flight to the next.

    Args:
        levels: signal over that of PAN by band, by exposure number; exposures without any are left
            out.

    Returns:
        Steps in the order of the exposures.
    """
    numbers = sorted(number for number, of_bands in levels.items() if of_bands)
    steps = []
    for before, exposure in itertools.pairwise(numbers):
        old, new = levels[before], levels[exposure]
        change = {
            band: math.log(new[band] / old[band])
            for band in old.keys() & new.keys()
            if old[band] > 0.0 and new[band] > 0.0
        }
        for band, moved in change.items():
            others = [abs(other) for name, other in change.items() if name != band]
            if len(others) < MIN_OTHERS or max(others) > MAX_OTHERS:
                continue
            if abs(moved) >= MIN_CHANGE:
                steps.append(LevelStep(band, before, exposure, math.exp(moved)))
    return tuple(steps)

"""A colour band whose level against PAN changes alone from one exposure of a flight to another.

PAN sees what the bands see, each with a share p that is the camera's: sum p L_band / L_pan is one
over any ground. Ground that turns from fields to water moves several ratios, a head that changes
moves one. One exposure cannot decide: woods have half the red of bare soil.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

Levels = Mapping[str, float]
"""Signal over that of PAN by band (`processing.quality.band_levels`)."""

MIN_CHANGE: Final = 0.5
"""Natural logarithm of the change of one ratio: a factor of 1.65."""
MAX_OTHERS: Final = 0.06
"""Of every other ratio meanwhile."""
MIN_OTHERS: Final = 2
HISTORY: Final = 5
"""Earlier exposures that a new one is compared with: their ground is nearest to its own."""


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


class LevelHistory:
    """Levels of the last exposures of a flight, with which each new one is compared."""

    def __init__(self) -> None:
        self._levels: dict[int, Levels] = {}

    def add(self, exposure: int, levels: Levels) -> tuple[LevelStep, ...]:
        """Compare an exposure with those before it, and retain its levels.

        After a step only the exposures from it on are compared with.

        Args:
            exposure: its number.
            levels: signal over that of PAN by band; without any, nothing is compared.

        Returns:
            Bands that changed alone.
        """
        if not levels:
            return ()
        steps = changed_bands(self._levels, exposure, levels)
        if steps:
            self._levels.clear()
        self._levels[exposure] = levels
        for number in sorted(self._levels)[:-HISTORY]:
            del self._levels[number]
        return steps


def changed_bands(
    earlier: Mapping[int, Levels], exposure: int, levels: Levels
) -> tuple[LevelStep, ...]:
    """Bands whose level changed alone against exposures of like ground.

    Ground is alike where all other bands have the levels of the new exposure. A band changed where
    half of these exposures show it.

    Args:
        earlier: signal over that of PAN by band, by exposure number.
        exposure: number of the new exposure.
        levels: its signal over that of PAN by band.

    Returns:
        A step for each such band, from the latest exposure that shows it.

    Example:
        >>> fields = {"red": 0.8, "green": 0.9, "blue": 0.6}
        >>> changed_bands({1: fields}, 2, {**fields, "red": 0.4})
        (LevelStep(band='red', before=1, exposure=2, factor=0.5),)
    """
    steps = []
    for band in levels:
        moves = {
            number: move
            for number, old in earlier.items()
            if number < exposure and (move := _single_change(band, old, levels)) is not None
        }
        changed = [number for number, move in moves.items() if abs(move) >= MIN_CHANGE]
        if changed and 2 * len(changed) >= len(moves):
            before = max(changed)
            steps.append(LevelStep(band, before, exposure, math.exp(moves[before])))
    return tuple(steps)


def level_steps(levels: Mapping[int, Levels]) -> tuple[LevelStep, ...]:
    """Bands whose level changes alone during a flight.

    Args:
        levels: signal over that of PAN by band, by exposure number; exposures without any are left
            out.

    Returns:
        Steps in the order of the exposures.
    """
    history = LevelHistory()
    return tuple(step for number in sorted(levels) for step in history.add(number, levels[number]))


def _single_change(band: str, old: Levels, new: Levels) -> float | None:
    """Natural logarithm of a band's change; None where other bands changed too, or are too few."""
    change = {
        name: math.log(new[name] / old[name])
        for name in old.keys() & new.keys()
        if old[name] > 0.0 and new[name] > 0.0
    }
    others = [abs(move) for name, move in change.items() if name != band]
    if band not in change or len(others) < MIN_OTHERS or max(others) > MAX_OTHERS:
        return None
    return change[band]

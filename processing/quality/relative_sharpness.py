"""Sharpness of PAN heads against each other, where two of them see the same ground.

The figure over a whole frame depends on what lies below; in an overlap both heads have the same
ground, so that a head out of focus, with dew or with smear of its own shows less of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement, nominal_placements
from processing.geometry.topology import Overlap, overlaps
from processing.image.sharpness import sharpness
from processing.matching.tie_point_search import overlap_pixels
from processing.quality.figures.image import RelativeSharpnessFigures
from processing.rig import Rig

Array = NDArray[Any]
Shares = tuple[float | None, float | None]
"""Of the finest detail along and across track."""

SMOOTH: Final = 0.25
"""The share of the finest detail of a surface without any (`processing.image.sharpness`)."""
MIN_RATIO: Final = 0.6
"""Of its neighbours' fine detail. Lenses differ by a tenth from axis to corner."""
MAX_SHARE: Final = 0.55
"""Of the finest detail, along both directions: lenses leave 0.48 at most in healthy exposures."""
MIN_DETAIL: Final = 0.05
"""Beyond a smooth surface, that the sharper head shows: below, there is nothing to compare."""


def relative_sharpness_figures(
    rig: Rig, placements: Mapping[str, SensorPlacement], frames: Mapping[str, Array]
) -> RelativeSharpnessFigures | None:
    """The PAN head that shows least of its neighbours' fine detail, if it is clearly less.

    Args:
        rig: the camera.
        placements: of the sensors, by name; of them the TDI shifts.
        frames: Level-1 words by sensor name, (h, w) uint16.

    Returns:
        Sensor and its detail over that of its neighbours, and the noisiest head; empty where no
        head is clearly less sharp or noisy, None where none can be compared.

    Source: docs/explanation/mathematics/quality.md#sharpness.
    """
    common = [o for o in overlaps(rig) if o.sensor_a in frames and o.sensor_b in frames]
    shares: dict[tuple[str, Overlap], Shares] = {}
    for name in {name for o in common for name in (o.sensor_a, o.sensor_b)}:
        areas = _overlap_areas(rig, name, placements[name].tdi_shifts)
        for overlap in common:
            if overlap in areas:
                left, right, top, low = areas[overlap]
                shares[name, overlap] = sharpness(
                    rig.sensor(name), frames[name], (top, low), (left, right)
                )
    noisy = _noisiest(common, shares)
    ratios: dict[str, list[float]] = {}
    for overlap in common:
        a, b = overlap.sensor_a, overlap.sensor_b
        if noisy is not None and noisy[0] in (a, b):
            continue
        for of_a, of_b in zip(shares[a, overlap], shares[b, overlap], strict=True):
            if of_a is None or of_b is None:
                continue
            detail_a, detail_b = max(of_a - SMOOTH, 1e-3), max(of_b - SMOOTH, 1e-3)
            if max(detail_a, detail_b) > MIN_DETAIL:
                ratios.setdefault(a, []).append(detail_a / detail_b)
                ratios.setdefault(b, []).append(detail_b / detail_a)
    # Blurred is who is so against most neighbours; along one direction is enough.
    worst = {name: _typical(found) for name, found in ratios.items()}
    noisy_sensor, noisy_share = noisy or (None, None)
    of_noise = RelativeSharpnessFigures(noisy_sensor=noisy_sensor, noisy_share=noisy_share)
    if not worst:
        return None if noisy is None else of_noise
    name = min(worst, key=lambda n: worst[n])
    if worst[name] >= MIN_RATIO:
        return of_noise
    return RelativeSharpnessFigures(name, worst[name], noisy_sensor, noisy_share)


@lru_cache(maxsize=256)
def _overlap_areas(
    rig: Rig, name: str, tdi_shifts: int
) -> Mapping[Overlap, tuple[int, int, int, int]]:
    """First and last column, first and last row of a sensor in each of its overlaps.

    As calibrated: which pixels of thousands are looked at may differ by some.
    """
    own = [o for o in overlaps(rig) if name in (o.sensor_a, o.sensor_b)]
    placement = nominal_placements(rig, {}, {name: tdi_shifts}, use_drift=False)[name]
    return dict(zip(own, overlap_pixels(placement, own), strict=True))


def _noisiest(
    common: Sequence[Overlap], shares: Mapping[tuple[str, Overlap], Shares]
) -> tuple[str, float] | None:
    """The head with more of the finest detail than a lens leaves, where a neighbour has far less.

    Noise of single pixels or lines is such detail; next to it a healthy neighbour seems blurred.
    """
    found = []
    for overlap in common:
        for own, other in (
            (overlap.sensor_a, overlap.sensor_b),
            (overlap.sensor_b, overlap.sensor_a),
        ):
            pairs = list(zip(shares[own, overlap], shares[other, overlap], strict=True))
            if all(
                mine is not None
                and its is not None
                and mine > MAX_SHARE
                and its - SMOOTH < MIN_RATIO * (mine - SMOOTH)
                for mine, its in pairs
            ):
                found.append((own, min(mine for mine, _ in pairs if mine is not None)))
    return max(found, key=lambda head: head[1], default=None)


def _typical(found: list[float]) -> float:
    """The lower quartile of ratios: half of the directions of half of the neighbours."""
    return math.exp(float(np.quantile(np.log(found), 0.25)))

"""The adjustment from other starting values where the first do not converge.

The interior orientation is held first and estimated then; orientations from few known points, of
which a plane has two, are replaced by relative orientation of the images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.gauss_newton import Progress
from processing.bundle.initial_values import completed
from processing.bundle.network import Network, NetworkError
from processing.bundle.rank_diagnosis import RankDefectError
from processing.bundle.starting_values import relatively_oriented, starting_values


def adjust_in_stages(
    network: Network, settings: AdjustmentSettings, *, progress: Progress | None = None
) -> Adjustment:
    """Adjust from the first starting values that converge.

    Args:
        network: observations; stations, attitudes and points may be NaN.
        settings: see `AdjustmentSettings`.
        progress: as of `adjust`.

    Returns:
        The adjustment; its network holds the starting values that were used.

    Raises:
        NetworkError: that of the first starting values, where none of the others converge.
        RankDefectError: that of the first starting values.

    Source: docs/explanation/mathematics/bundle.md#other-starting-values.
    """
    begin = starting_values(network)
    try:
        return adjust(begin, settings, progress=progress)
    except NetworkError as error:
        first = error
    for start in _other_starts(network, begin, settings):
        try:
            return adjust(start(), settings, progress=progress)
        except (NetworkError, RankDefectError):
            continue
    raise first


def _other_starts(
    network: Network, begin: Network, settings: AdjustmentSettings
) -> Iterator[Callable[[], Network]]:
    is_free = any(camera.free for camera in network.cameras)
    if is_free:
        yield lambda: interior_held_first(begin, settings)
    oriented = relatively_oriented(network)
    if oriented is None:
        return
    other = completed(oriented)
    yield lambda: other
    if is_free:
        yield lambda: interior_held_first(other, settings)


def interior_held_first(begin: Network, settings: AdjustmentSettings) -> Network:
    """Starting values from an adjustment with the starting values of the interior orientation.

    Args:
        begin: with starting values.
        settings: of the adjustment; observations are neither tested nor weighted by variance
            components in it.

    Returns:
        The network with adjusted orientations, and adjusted points that are not observed.

    Raises:
        NetworkError: as of `adjust`.
        RankDefectError: as of `adjust`.
    """
    held = tuple(replace(camera, free=frozenset()) for camera in begin.cameras)
    plain = replace(settings, significance=None, reject_beyond=None, variance_components=False)
    state = adjust(replace(begin, cameras=held), plain).state
    points = begin.points
    return replace(
        begin,
        stations=replace(begin.stations, position_m=state.station),
        attitudes=replace(begin.attitudes, rotation=state.attitude),
        points=replace(
            points, xyz_m=np.where(np.isnan(points.sigma_m), state.points, points.xyz_m)
        ),
    )

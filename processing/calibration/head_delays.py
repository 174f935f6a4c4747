"""Delays of heads against the marks, from a block with delays between heads and a trajectory.

The block gives delays against the instant of its orientations, the comparison with the trajectory
gives that instant against the marks. Both depend on the same images: their covariance is joint.

Source: docs/explanation/mathematics/boresight.md#delays-of-heads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.adjust import Adjustment
from processing.bundle.network import Network
from processing.calibration.boresight import PARAMETERS, BoresightCalibration

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_TIME: Final = PARAMETERS.index("time offset")


@dataclass(frozen=True)
class HeadDelays:
    """Delays of the h heads `names` of an adjusted block against the marks.

    `delay_s` (h,) and `covariance` (h, h), NaN where the time offset is not determined.
    """

    names: tuple[str, ...]
    delay_s: Array
    covariance: Array

    @property
    def sigma_s(self) -> Array:
        """(h,) standard deviations."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def attitudes_of_stations(network: Network, stations: Sequence[int]) -> Indices:
    """The attitude that represents an exposure: the shared one, else that of its first image.

    Args:
        network: its images.
        stations: by index, shape (n,).

    Returns:
        Attitudes by index, shape (n,); -1 for a station without images.
    """
    found: dict[int, int] = {}
    for station, own in zip(network.images.station, network.images.attitude, strict=True):
        found.setdefault(int(station), int(own))
    return np.array([found.get(int(s), -1) for s in stations], dtype=np.int64)


def orientation_columns(adjusted: Adjustment, stations: Sequence[int]) -> Indices:
    """Columns of position and attitude of exposures, six of each, -1 where held.

    Args:
        adjusted: the block.
        stations: by index, shape (n,).

    Returns:
        Shape (6n,).
    """
    layout = adjusted.layout
    attitudes = attitudes_of_stations(adjusted.network, stations)
    both = np.concatenate([layout.station[list(stations)], layout.attitude[attitudes]], axis=1)
    both[attitudes < 0] = -1
    return both.ravel()


def joint_covariance(
    adjusted: Adjustment, exposures: Sequence[int], found: BoresightCalibration, columns: Indices
) -> Array:
    """Covariance of the ten parameters of the mounting and of unknowns of the block.

    Args:
        adjusted: the block whose orientations were compared.
        exposures: stations that were compared, by index, in this order.
        found: the comparison.
        columns: unknowns of the block, shape (c,); -1 is held and has no covariance.

    Returns:
        Shape (10 + c, 10 + c): the ten first.
    """
    of_images = orientation_columns(adjusted, exposures)
    variance = adjusted.sigma0**2
    own = np.flatnonzero(columns >= 0)
    result = np.zeros((10 + len(columns), 10 + len(columns)))
    result[:10, :10] = found.covariance
    block = variance * adjusted.cofactor[np.ix_(columns[own], columns[own])]
    result[np.ix_(10 + own, 10 + own)] = block
    cross = found.by_image @ (variance * adjusted.cofactor[np.ix_(of_images, columns[own])])
    result[:10, 10 + own] = cross
    result[10 + own, :10] = cross.T
    return result


def head_delays(
    adjusted: Adjustment, exposures: Sequence[int], found: BoresightCalibration
) -> HeadDelays:
    """Delays of the heads of a block against the marks.

    Args:
        adjusted: with the motion of its rig.
        exposures: stations that were compared, by index, in this order.
        found: the comparison with the trajectory.

    Returns:
        One delay for each head of the network: the time offset and the head's own.
    """
    layout = adjusted.layout
    joint = joint_covariance(adjusted, exposures, found, layout.head_delay)
    total = joint[10:, 10:] + joint[_TIME, _TIME] + joint[_TIME, 10:] + joint[10:, _TIME, None]
    if not found.determined[_TIME]:
        total = np.full_like(total, np.nan)
    return HeadDelays(
        tuple(head.name for head in adjusted.network.heads),
        found.mounting.time_offset_s + adjusted.state.head_delay,
        total,
    )

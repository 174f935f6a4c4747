"""Where the rig is while an image is exposed: delays, jitter and readout of a moving camera.

Position and attitude of an exposure hold for one instant. A head that exposes later, or whose rows
are read one after the other, is somewhere else by then. The motion between is that of the
trajectory, to the second order in time.

Source: docs/explanation/mathematics/bundle.md#time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from processing.bundle.network import Motion, Network
from processing.bundle.unknowns import ParameterLayout, ParameterValues
from processing.geometry.rotation import rotations_from_vectors

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class RowMotion:
    """Motion of the rig from the instant of an exposure to that of an image row, n image points.

    Attributes:
        shift_m: (n, 3) of the rig's origin, object axes.
        rotation: (n, 3, 3) rig axes at the exposure's instant from rig axes at that of the row.
        velocity_mps: (n, 3) at the row's instant, object axes.
        rate_rad_per_s: (n, 3) at the row's instant, about the rig's axes at that instant.
        by_readout: (n,) derivative of the row's instant by the readout time.
    """

    shift_m: Array
    rotation: Array
    velocity_mps: Array
    rate_rad_per_s: Array
    by_readout: Array


def moved(motion: Motion, station: Indices, after_s: Array) -> tuple[Array, Array, Array, Array]:
    """Motion of the rig within a time.

    Args:
        motion: at the instants of the stations.
        station: which of them, shape (n,).
        after_s: time since then, shape (n,), s.

    Returns:
        Shift, shape (n, 3), m; rotation, shape (n, 3, 3); velocity, shape (n, 3), m/s; rate about
        the axes of the rotated rig, shape (n, 3), rad/s.

    Source: docs/explanation/mathematics/bundle.md#time.

    Example:
        50 m/s for 20 ms.

        >>> zero = np.zeros((1, 3))
        >>> motion = Motion(np.array([[0.0, 50.0, 0.0]]), zero, zero, zero)
        >>> moved(motion, np.array([0]), np.array([0.02]))[0]
        array([[0., 1., 0.]])
    """
    t = np.asarray(after_s, dtype=np.float64)[:, None]
    acceleration, change = motion.acceleration_mps2[station], motion.rate_change_rad_per_s2[station]
    velocity = motion.velocity_mps[station] + acceleration * t
    shift = motion.velocity_mps[station] * t + 0.5 * acceleration * t**2
    angle = motion.rate_rad_per_s[station] * t + 0.5 * change * t**2
    rate = motion.rate_rad_per_s[station] + change * t
    across = np.cross(angle, rate)
    rate = rate - 0.5 * across + np.cross(angle, across) / 6.0
    return shift, rotations_from_vectors(angle), velocity, rate


def advanced(motion: Motion, after_s: float) -> Motion:
    """The motion at instants that are later.

    Args:
        motion: at the instants of the stations.
        after_s: time since then, s.

    Returns:
        Velocities and rates after that time; rates about the axes of the rotated rig.

    Example:
        50 m/s that grow by 2 m/s each second are 50.04 m/s after 20 ms.

        >>> zero, forward = np.zeros((1, 3)), np.array([[0.0, 1.0, 0.0]])
        >>> advanced(Motion(50.0 * forward, 2.0 * forward, zero, zero), 0.02).velocity_mps
        array([[ 0.  , 50.04,  0.  ]])
    """
    n = len(motion.velocity_mps)
    _, _, velocity, rate = moved(motion, np.arange(n), np.full(n, after_s))
    return replace(motion, velocity_mps=velocity, rate_rad_per_s=rate)


def row_motion(
    network: Network, state: ParameterValues, image: Indices, y_mm: Array
) -> RowMotion | None:
    """Motion from the exposure's instant to that of each image point's row.

    Args:
        network: heads with their timing, and the motion of the rig.
        state: delays, readout times and jitter.
        image: images of the image points, shape (n,).
        y_mm: measured coordinates from the middle of the frame, shape (n,), mm.

    Returns:
        The motion; None where the network has none, or no image a head.
    """
    if network.motion is None:
        return None
    head = network.images.head[image]
    mounted = head >= 0
    if not mounted.any():
        return None
    own = np.clip(head, 0, None)
    height_mm = np.array([h.timing.frame_height_mm for h in network.heads])[own]
    by_readout = np.where(mounted, -y_mm / height_mm, 0.0)
    after_s = np.where(mounted, state.head_delay[own] + state.jitter[image], 0.0)
    after_s = after_s + by_readout * np.where(mounted, state.readout[own], 0.0)
    station = network.images.station[image]
    return RowMotion(*moved(network.motion, station, after_s), by_readout)


def time_columns(
    layout: ParameterLayout, network: Network, image: Indices, by_time: Array, by_readout: Array
) -> list[tuple[Indices, Array]]:
    """Columns of delay, jitter and readout time, and their derivatives.

    Args:
        layout: columns.
        network: images and their heads.
        image: images of the image points, shape (n,).
        by_time: derivatives of both coordinates by the row's instant, shape (n, 2), mm/s.
        by_readout: as of `RowMotion`.

    Returns:
        Columns, shape (n, 1), -1 where held, and derivatives, shape (n, 2, 1), of each.
    """
    head = network.images.head[image]
    own = np.clip(head, 0, None)
    there = head >= 0
    by = by_time[:, :, None]
    return [
        (np.where(there, layout.head_delay[own], -1)[:, None], by),
        (layout.jitter[image][:, None], by),
        (np.where(there, layout.readout[own], -1)[:, None], by * by_readout[:, None, None]),
    ]

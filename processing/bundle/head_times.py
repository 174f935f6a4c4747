"""Delays, readout times and jitter of heads from a block, and what confounds them.

Source: docs/explanation/mathematics/bundle.md#time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.adjust import Adjustment
from processing.bundle.network import INTERIOR

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

CORRELATION_LIMIT: Final = 0.95
"""Beyond this multiple correlation a time is not separated from other parameters of its head."""
MIN_SIGMA_S: Final = 1e-4
"""A time known better than this is separated well enough, whatever it correlates with."""
AXES: Final = ("right", "forward", "up")
_REMEDIES: Final = {
    "lever arm": "a delay acts like a lever arm along the flight; fly turns in both directions or "
    "two speeds, or hold the lever arm",
    "rotation": "a delay acts like a rotation at a constant rate; fly turns in both directions",
}


@dataclass(frozen=True)
class HeadTime:
    """Times of one head, s; a standard deviation is NaN where the value is held.

    `jitter_s`: root mean square of the delays of its images, `jitter_sigma_s` the median standard
    deviation of one of them, NaN where the head has no jitter.
    """

    name: str
    delay_s: float
    delay_sigma_s: float
    readout_s: float
    readout_sigma_s: float
    jitter_s: float
    jitter_sigma_s: float


def head_times(adjusted: Adjustment) -> tuple[HeadTime, ...]:
    """Delay against the instant of the orientations, readout time and jitter of every head.

    Args:
        adjusted: the block.

    Returns:
        All heads, in the order of the network; none where no image depends on the motion of the
        rig.
    """
    network, layout, state = adjusted.network, adjusted.layout, adjusted.state
    variance = adjusted.sigma0**2 * np.clip(adjusted.cofactors.diagonal(), 0.0, None)

    def sigma(column: int) -> float:
        return float(np.sqrt(variance[column])) if column >= 0 else np.nan

    if not any(head.timing.uses_motion for head in network.heads):
        return ()
    found = []
    for k, head in enumerate(network.heads):
        own = np.flatnonzero((network.images.head == k) & (layout.jitter >= 0))
        jitter = jitter_sigma = np.nan
        if own.size:
            jitter = float(np.sqrt(np.mean(state.jitter[own] ** 2)))
            jitter_sigma = float(np.sqrt(np.median(variance[layout.jitter[own]])))
        found.append(
            HeadTime(
                head.name,
                float(state.head_delay[k]),
                sigma(int(layout.head_delay[k])),
                float(state.readout[k]),
                sigma(int(layout.readout[k])),
                jitter,
                jitter_sigma,
            )
        )
    return tuple(found)


def jitter_sigmas(adjusted: Adjustment) -> dict[str, float]:
    """Standard deviation of the images' own delays of each head, from the block.

    Args:
        adjusted: with jitter as unknowns of images.

    Returns:
        Variance component of each head with jitter, as a standard deviation, s, by name. No
        redundancy leaves the given standard deviation as it is.

    Source: docs/explanation/mathematics/bundle.md#time.
    """
    network, rows = adjusted.network, adjusted.equations
    of_jitter = rows.group == rows.groups.index("jitter")
    found = {}
    for k, head in enumerate(network.heads):
        if head.timing.jitter_sigma_s is None:
            continue
        own = of_jitter.copy()
        own[of_jitter] = network.images.head[rows.source[of_jitter]] == k
        redundancy = float(adjusted.redundancy_number[own].sum())
        squares = float(np.sum(adjusted.residual[own] ** 2))
        factor = squares / redundancy if redundancy > 1e-3 else 1.0
        found[head.name] = head.timing.jitter_sigma_s * float(np.sqrt(factor))
    return found


def confounded_times(adjusted: Adjustment) -> tuple[str, ...]:
    """Sentences on delays and readout times that the flight hardly separates from something else.

    Args:
        adjusted: with delays or readout times of heads as unknowns.

    Returns:
        One sentence per pair of a time and the lever arm, rotation or interior orientation of its
        head whose multiple correlation with it is beyond `CORRELATION_LIMIT`, with a remedy. A
        time with a standard deviation of 0.1 ms or less is not named.

    Source: docs/explanation/mathematics/bundle.md#time.
    """
    layout, network, found = adjusted.layout, adjusted.network, []
    for k, head in enumerate(network.heads):
        cameras = np.unique(network.images.camera[network.images.head == k])
        groups = {
            "lever arm": (layout.head_offset[k], AXES),
            "rotation": (layout.head_rotation[k], ("about x", "about y", "about z")),
            **{
                f"camera {network.cameras[c].name}": (layout.interior[c], INTERIOR) for c in cameras
            },
        }
        for what, time in (("delay", layout.head_delay[k]), ("readout time", layout.readout[k])):
            if time < 0:
                continue
            sigma_s = adjusted.sigma0 * float(np.sqrt(max(adjusted.cofactor[time, time], 0.0)))
            if sigma_s <= MIN_SIGMA_S:
                continue
            for group, (columns, names) in groups.items():
                strength, partner = _multiple_correlation(adjusted, int(time), columns)
                if strength <= CORRELATION_LIMIT:
                    continue
                remedy = _REMEDIES.get(group, "hold the parameters of the camera")
                found.append(
                    f"{what} of head {head.name} and its {group} ({names[partner]}) are not "
                    f"separated (correlation {strength:.3f}, sigma {sigma_s * 1e3:.2g} ms): "
                    f"{remedy}"
                )
    return tuple(found)


def _multiple_correlation(adjusted: Adjustment, time: int, columns: Indices) -> tuple[float, int]:
    """Of an unknown with others together, and which of them it correlates with most."""
    free = np.flatnonzero(columns >= 0)
    if not free.size:
        return 0.0, 0
    at = np.concatenate([[time], columns[free]])
    own = adjusted.cofactor[np.ix_(at, at)]
    spread = np.sqrt(np.clip(np.diag(own), 1e-300, None))
    correlation = own / spread / spread[:, None]
    with_others = correlation[0, 1:]
    explained = float(with_others @ np.linalg.pinv(correlation[1:, 1:]) @ with_others)
    strongest = int(np.argmax(np.abs(with_others)))
    return float(np.sqrt(np.clip(explained, 0.0, 1.0))), int(free[strongest])

"""Relative poses of heads from pictures of one instant, and instants that contradict the others.

Source: docs/explanation/mathematics/lens.md#calibration-from-a-board.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.calibration.board.views import BoardView, ViewPose
from processing.geometry.rotation import vectors_from_rotations

Array = NDArray[np.float64]
Pose = tuple[Array, Array]

_ANGLE_RAD: Final = math.radians(0.3)
_DISTANCE_SHARE: Final = 0.015
_SPREADS: Final = 8.0


@dataclass(frozen=True)
class RelativePoses:
    """Heads oriented relative to the reference.

    `mountings` are rotation and offset, m, by head; `unconnected` heads have none. `common` counts
    instants by pair of heads. `contradicting` are indices of views that do not show the board at
    the instant of the reference, with a sentence each.
    """

    mountings: Mapping[str, Pose]
    unconnected: tuple[str, ...]
    common: Mapping[tuple[str, str], int]
    contradicting: Mapping[int, str]


def relative_poses(
    heads: Sequence[str], views: Sequence[BoardView], poses: Sequence[ViewPose]
) -> RelativePoses:
    """Orient heads relative to the first, directly or through others.

    Args:
        heads: names, the reference first.
        views: all of them.
        poses: of these views.

    Returns:
        Mountings of the heads that share instants, and what contradicts them.
    """
    by_exposure: dict[str, dict[str, int]] = defaultdict(dict)
    for k, view in enumerate(views):
        by_exposure[view.exposure][view.head] = k
    found: dict[str, Pose] = {heads[0]: (np.eye(3), np.zeros(3))}
    common: dict[tuple[str, str], int] = {}
    contradicting: dict[int, str] = {}
    queue = [heads[0]]
    while queue:
        known = queue.pop(0)
        for head in heads:
            pairs = [
                (exposure, own[known], own[head])
                for exposure, own in by_exposure.items()
                if known in own and head in own and known != head
            ]
            if not pairs or head in found:
                continue
            common[known, head] = len(pairs)
            single = [_relative(poses[a], poses[b]) for _, a, b in pairs]
            distance = float(np.median([poses[a].distance_m for _, a, _ in pairs]))
            chosen, wrong = _contradictions(single, distance)
            for k in wrong:
                exposure, _, b = pairs[k]
                contradicting[b] = _sentence(exposure, known, head, single[chosen], single[k])
            if len(wrong) * 2 >= len(pairs) and len(pairs) > 1:
                continue
            rotation, offset = single[chosen]
            before_rotation, before_offset = found[known]
            found[head] = (before_rotation @ rotation, before_offset + before_rotation @ offset)
            queue.append(head)
    del found[heads[0]]
    unconnected = tuple(head for head in heads[1:] if head not in found)
    return RelativePoses(found, unconnected, common, contradicting)


def _relative(first: ViewPose, second: ViewPose) -> Pose:
    """Pose of the second head in the axes of the first."""
    rotation = first.rotation @ second.rotation.T
    return rotation, first.place_m - rotation @ second.place_m


def _apart(one: Pose, other: Pose) -> tuple[float, float]:
    """Angle and distance between two relative poses, rad and m."""
    angle = float(np.linalg.norm(vectors_from_rotations(one[0].T @ other[0])))
    return angle, float(np.linalg.norm(one[1] - other[1]))


def _contradictions(single: Sequence[Pose], distance_m: float) -> tuple[int, list[int]]:
    """The pose that most others are near to, and those that are far off."""
    apart = np.array([[_apart(a, b) for b in single] for a in single])
    score = np.median(apart[..., 0] / _ANGLE_RAD + apart[..., 1] / distance_m / _DISTANCE_SHARE, 1)
    chosen = int(np.argmin(score))
    off = apart[chosen]
    spread = 1.4826 * np.median(off, axis=0)
    limit = np.maximum(_SPREADS * spread, [_ANGLE_RAD, _DISTANCE_SHARE * distance_m])
    if len(single) == 2:
        limit = np.array([3 * _ANGLE_RAD, 3 * _DISTANCE_SHARE * distance_m])
    return chosen, [int(k) for k in np.flatnonzero((off > limit).any(axis=1))]


def _sentence(exposure: str, known: str, head: str, usual: Pose, own: Pose) -> str:
    angle, distance = _apart(usual, own)
    swapped = (usual[0].T, -usual[0].T @ usual[1])
    swapped_angle, swapped_distance = _apart(swapped, own)
    text = (
        f"exposure {exposure}: {head} against {known} differs by {math.degrees(angle):.2f} degrees "
        f"and {distance * 1e3:.1f} mm from the other exposures"
    )
    if swapped_angle < 0.2 * angle + _ANGLE_RAD and swapped_distance < 0.3 * distance + 2e-3:
        return f"{text}: the pictures of the two heads are swapped"
    return f"{text}: its pictures are not of one instant"

"""Nominal places and angles of the heads of an arrangement.

Body axes x forward, y right, z down; camera axes x right, y forward, z up; rotations (omega, phi,
kappa) of R = Rx Ry Rz, camera to master.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from daemon.initialization.answers import Answers, Arrangement

_OBLIQUE_NAMES = ("nadir", "forward", "right", "backward", "left")


@dataclass(frozen=True)
class NominalMounting:
    """Name, projection centre in the body frame, and angles against the master, of a head."""

    name: str
    position_mm: tuple[float, float, float]
    rotation_deg: tuple[float, float, float]


@dataclass(frozen=True)
class RigMounting:
    """All heads; the master; roll and pitch of the master's body axes against the vehicle's."""

    heads: tuple[NominalMounting, ...]
    master: str
    boresight_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)


def mounting_of(answers: Answers) -> RigMounting:
    """Nominal mounting: heads at equal distances, turned about one axis by equal angles.

    The middle of the field looks to the nadir. With an even number of heads none does; the
    boresight then turns the master.
    """
    count, angle, distance = len(answers.heads), answers.angle_deg, answers.distance_mm
    if answers.arrangement is Arrangement.NADIR_OBLIQUE:
        return _oblique(count, angle, distance)
    names = _names(answers.arrangement, count)
    master = (count - 1) // 2
    middle = (count - 1) / 2.0
    heads = []
    for index, name in enumerate(names):
        # Steps to the right, or to the front.
        is_across = answers.arrangement is not Arrangement.FORE_AFT
        step = index - middle if is_across else middle - index
        from_master = index - master if is_across else master - index
        if is_across:
            position = (0.0, step * distance, 0.0)
            rotation = (0.0, _signless(-from_master * angle), 0.0)
        else:
            position = (step * distance, 0.0, 0.0)
            rotation = (_signless(from_master * angle), 0.0, 0.0)
        heads.append(NominalMounting(name, position, rotation))
    tilt = (master - middle) * angle
    if answers.arrangement is Arrangement.FORE_AFT:
        # The master looks forward: its nose is up.
        boresight = (0.0, _signless(-tilt), 0.0)
    else:
        # A camera that looks left has its right side down.
        boresight = (_signless(-tilt), 0.0, 0.0)
    return RigMounting(tuple(heads), names[master], boresight)


def _names(arrangement: Arrangement, count: int) -> list[str]:
    if count == 1:
        return ["head"]
    if count == 2:
        return ["left", "right"] if arrangement is Arrangement.SIDE_BY_SIDE else ["front", "back"]
    return [f"head{number}" for number in range(1, count + 1)]


def _oblique(count: int, angle: float, distance: float) -> RigMounting:
    """The nadir head, and oblique ones whose upper edge of the image points outwards."""
    d, a = distance, angle
    around = (
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((d, 0.0, 0.0), (a, 0.0, 0.0)),
        ((0.0, d, 0.0), (0.0, -a, -90.0)),
        ((-d, 0.0, 0.0), (-a, 0.0, 180.0)),
        ((0.0, -d, 0.0), (0.0, a, 90.0)),
    )
    heads = tuple(
        NominalMounting(name, *place)
        for name, place in zip(_OBLIQUE_NAMES[:count], around[:count], strict=True)
    )
    return RigMounting(heads, "nadir")


def _signless(value: float) -> float:
    """Zero without a sign."""
    return value or 0.0


def radians(rotation_deg: tuple[float, float, float]) -> tuple[float, ...]:
    """Angles in rad, rounded to nanoradians."""
    return tuple(round(math.radians(angle), 9) for angle in rotation_deg)

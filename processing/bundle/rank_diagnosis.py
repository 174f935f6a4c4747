"""Parameters that a network cannot determine, in words.

Directions without information in the reduced normal matrix are compared with the seven datum
motions of the block; the remainder is described by the unknowns that take part.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from processing import ProcessingError
from processing.bundle.free_datum import motion_columns
from processing.bundle.network import Network
from processing.bundle.normal_equations import ReducedEquations
from processing.bundle.reduced_solution import weak_directions
from processing.bundle.unknowns import ParameterLayout, ParameterValues, Unknown

Array = NDArray[np.float64]

_SAME: Final = 1e-4
_MIN_PARTICIPATION: Final = 0.02
"""Share of a direction (in units of each unknown's own information) that is worth naming."""

_MAX_NAMED: Final = 6

_DATUM_MOTIONS: Final = (
    ("position in X", "control points, GNSS positions or a fixed station would fix it"),
    ("position in Y", "control points, GNSS positions or a fixed station would fix it"),
    ("height", "control points, GNSS positions or a fixed station would fix it"),
    ("tilt about X", "height control or GNSS positions away from one line would fix it"),
    ("tilt about Y", "height control or GNSS positions away from one line would fix it"),
    ("rotation about Z", "two control points or GNSS positions would fix it"),
    ("scale", "a distance, two control points or GNSS positions would fix it"),
)


_COMBINED: Final = (
    "a rotation of the whole block about a line through its control cannot be determined: control "
    "points (of a tilt: their heights) or GNSS positions away from that line would fix it"
)


@dataclass(frozen=True)
class RankDefect:
    """One undetermined direction: a sentence, and the unknowns in it with their shares."""

    sentence: str
    shares: tuple[tuple[str, float], ...]


class RankDefectError(ProcessingError, ValueError):
    """A network with undetermined unknowns."""

    def __init__(self, found: Sequence[RankDefect]) -> None:
        self.rank_defects = tuple(found)
        super().__init__("; ".join(defect.sentence for defect in found))


def rank_defects(
    network: Network,
    layout: ParameterLayout,
    state: ParameterValues,
    reduced: ReducedEquations,
    *,
    directions: Array | None = None,
) -> tuple[RankDefect, ...]:
    """Name every direction of the unknowns that has no information.

    Args:
        network: what was to be adjusted.
        layout: its columns.
        state: its values.
        reduced: its reduced equations.
        directions: what has no information, orthonormal in the scaled unknowns, shape (c, k); None:
            found here, the weakest at least.

    Returns:
        Datum motions of the whole block first, then the other directions.

    Source: docs/explanation/mathematics/bundle.md#rank-and-free-networks.
    """
    if directions is None:
        directions = weak_directions(reduced.matrix)
    none = directions
    if not none.shape[1]:
        return ()
    found: list[RankDefect] = []
    named: list[Array] = []
    motions: list[Array] = []
    for (what, hint), motion in zip(_DATUM_MOTIONS, motion_columns(layout, state)[0], strict=True):
        scaled = motion * reduced.scale
        length = float(np.linalg.norm(scaled))
        if length == 0.0:
            continue
        motions.append(scaled / length)
        inside = none.T @ scaled / length
        if 1.0 - float(inside @ inside) < _SAME:
            found.append(RankDefect(f"{what} of the whole block cannot be determined: {hint}", ()))
            named.append(inside)
    if named:
        none = none @ linalg.null_space(np.array(named))
    if motions and none.shape[1]:
        none, combined = _combined(none, np.array(motions).T)
        found += [
            RankDefect(_COMBINED, _sentence(direction, layout.unknowns).shares)
            for direction in combined.T
        ]
    found += [_sentence(direction, layout.unknowns) for direction in _separated(none).T]
    return tuple(found)


def _combined(none: Array, motions: Array) -> tuple[Array, Array]:
    """Directions that are no motion of the whole block, and those that are a combined one."""
    span = linalg.orth(motions)
    _, share, turned = np.linalg.svd(span.T @ none)
    inside = np.zeros(none.shape[1], bool)
    inside[: len(share)] = 1.0 - share**2 < _SAME
    return none @ turned.T[:, ~inside], none @ turned.T[:, inside]


def _separated(basis: Array) -> Array:
    """Directions of the same space that share as few unknowns as possible (pivoted reduction)."""
    if not basis.shape[1]:
        return basis
    _, _, pivots = linalg.qr(basis.T, pivoting=True, mode="economic")
    chosen = pivots[: basis.shape[1]]
    separated = np.linalg.solve(basis[chosen].T, basis.T).T
    return np.asarray(separated / np.linalg.norm(separated, axis=0))


def _sentence(direction: Array, unknowns: Sequence[Unknown]) -> RankDefect:
    share = direction**2 / float(direction @ direction)
    by_kind: dict[tuple[str, str], float] = defaultdict(float)
    owners: dict[tuple[str, str], list[str]] = defaultdict(list)
    for column in np.argsort(-share):
        unknown = unknowns[int(column)]
        by_kind[unknown.kind, unknown.component] += float(share[column])
        if share[column] > 1e-3 * share.max():
            owners[unknown.kind, unknown.component].append(unknown.owner)
    phrases: list[str] = []
    shares: list[tuple[str, float]] = []
    for key, value in sorted(by_kind.items(), key=lambda item: -item[1]):
        if value < _MIN_PARTICIPATION or len(phrases) >= _MAX_NAMED:
            continue
        kind, component = key
        who = owners[key]
        phrases.append(
            f"{component} of {kind} {who[0]}"
            if len(who) == 1
            else f"{component} of {len(who)} {_plural(kind)} ({', '.join(who[:3])}"
            + (", ...)" if len(who) > 3 else ")")
        )
        shares.append((phrases[-1], value))
    things = {(u.kind, u.owner) for u, part in zip(unknowns, share, strict=True) if part > 1e-3}
    if len(phrases) > 1 and len(things) == 1 and next(iter(things))[0] != "camera":
        kind, owner = next(iter(things))
        sentence = f"{kind} {owner} cannot be determined: it has too few observations"
    elif len(phrases) == 1:
        sentence = f"{phrases[0]} cannot be determined: no observation depends on it"
    else:
        sentence = (
            f"{' and '.join([', '.join(phrases[:-1]), phrases[-1]])} cannot be "
            "separated: a change of one is compensated by the others; fix one of them or add an "
            "observation that separates them"
        )
    return RankDefect(sentence, tuple(shares))


def _plural(kind: str) -> str:
    return f"{kind}s"

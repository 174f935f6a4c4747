"""A block of photographs is placed by positions of EXIF, or states why these do not place it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.postflight.triangulation.photograph_block import _placed
from daemon.postflight.triangulation.photograph_project import roll_sigma_deg
from daemon.postflight.triangulation.triangulation import TriangulationError
from processing.bundle.incremental_orientation import OrientedBlock
from processing.geometry.rotation import rotation_matrix

Array = NDArray[np.float64]


def flown(*, seed: int = 1) -> tuple[OrientedBlock, Array]:
    """Two lines of six nadir photographs in a frame of their own, and positions to 1 m."""
    random = np.random.default_rng(seed)
    place = np.array([[30.0 * (k % 6), 40.0 * (k // 6), 280.0] for k in range(12)])
    turn = rotation_matrix(0.4, -0.3, 1.0)
    own = OrientedBlock(
        station=(place - 100.0) @ turn / 25.0,
        rotation=np.repeat(turn.T[None], 12, axis=0),
        xyz=np.zeros((0, 3)),
        interior=np.zeros((1, 10)),
        used=np.zeros(0, bool),
        seen=np.zeros(12, np.int64),
    )
    return own, place + random.normal(0.0, 1.0, place.shape)


def test_photographs_come_to_their_positions_and_look_down() -> None:
    own, position = flown()
    placed, wrong = _placed(own, position)
    assert np.abs(placed.station - position).max() < 4.0 and not wrong.any()
    assert placed.rotation[:, 2, 2].min() > 0.99


def test_one_wrong_position_is_not_used() -> None:
    own, position = flown()
    truth = position[7].copy()
    position[7] += [60.0, -30.0, 0.0]
    placed, wrong = _placed(own, position)
    assert np.flatnonzero(wrong).tolist() == [7]
    assert np.abs(placed.station[7] - truth).max() < 5.0


@pytest.mark.parametrize("count", [2, 4])
def test_positions_of_another_day_are_not_used_and_named(count) -> None:
    """A third of them two kilometres away, all by the same shift."""
    own, position = flown()
    truth = position.copy()
    away = np.arange(12)[1::3][:count]
    position[away] += [1500.0, 1100.0, 0.0]
    placed, wrong = _placed(own, position)
    assert np.flatnonzero(wrong).tolist() == away.tolist()
    assert np.abs(placed.station - truth).max() < 5.0


def test_photographs_without_a_position_are_placed_with_the_others() -> None:
    own, position = flown()
    truth = position[[2, 5]].copy()
    position[[2, 5]] = np.nan
    placed, wrong = _placed(own, position)
    assert np.abs(placed.station[[2, 5]] - truth).max() < 5.0 and not wrong.any()


def test_a_single_line_hardly_fixes_the_roll() -> None:
    """Against the mean square of the roll of lines fitted to heights with errors of 2 m."""
    random = np.random.default_rng(4)
    line = np.column_stack([20.0 * np.arange(12), random.normal(0.0, 5.0, 12), np.zeros(12)])
    design = np.column_stack([line[:, :2], np.ones(12)])
    slopes = [
        np.linalg.lstsq(design, random.normal(0.0, 2.0, 12), rcond=None)[0][1] for _ in range(2000)
    ]
    expected = np.degrees(np.sqrt(np.mean(np.square(slopes))))
    assert roll_sigma_deg(line, 2.0) == pytest.approx(expected, rel=0.1)
    two = np.concatenate([line, line + np.array([0.0, 60.0, 0.0])])
    assert roll_sigma_deg(two, 2.0) < 1.0 < roll_sigma_deg(line, 2.0)


def test_positions_of_other_photographs_are_refused() -> None:
    own, position = flown()
    with pytest.raises(TriangulationError, match="contradict each other by"):
        _placed(own, np.random.default_rng(3).permutation(position))


def test_a_single_line_is_placed_where_control_will_determine_its_roll() -> None:
    """By photographs that look down within a few degrees; without control it is refused."""
    own, _ = flown()
    line = replace(own, station=own.station[:6], rotation=own.rotation[:6])
    straight = np.array([[30.0 * k, 0.0, 280.0] for k in range(6)])
    known = straight + np.random.default_rng(2).normal(0.0, 0.05, (6, 3))
    with pytest.raises(TriangulationError, match=r"second line, or give control points .*--points"):
        _placed(line, known)
    tilted = np.array([rotation_matrix(0.06, 0.02 * (-1) ** k, 0.0) for k in range(6)])
    line = replace(line, rotation=line.rotation @ tilted)
    placed, wrong = _placed(line, known, has_control=True)
    assert np.abs(placed.station - known).max() < 0.5 and not wrong.any()
    assert placed.rotation[:, 2, 2].min() > np.cos(np.radians(6.0))


def test_photographs_that_would_look_upward_are_refused() -> None:
    """Mirrored by exchanged coordinates or a wrong sign; nearly on a line, the roll is open."""
    own, position = flown()
    for mirrored in (position[:, [1, 0, 2]], position * [-1.0, 1.0, 1.0]):
        with pytest.raises(TriangulationError, match=r"look upward .* longitude are exchanged"):
            _placed(own, mirrored)
    narrow = position * [1.0, 0.1, 1.0]
    turned = replace(own, station=own.station @ np.diag([1.0, 0.1, 1.0]))
    with pytest.raises(TriangulationError, match="do not determine the attitude"):
        _placed(turned, narrow * [-1.0, 1.0, 1.0])

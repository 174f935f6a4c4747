"""Gauss-Newton iterations of a network: steps that always lower the sum of squares.

The selection of observations is in `adjust`, robust weights are in `robust_weights`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing import ProcessingError
from processing.bundle.equations import BehindCameraError, Equations, equations
from processing.bundle.free_datum import free_motions, scaled_directions
from processing.bundle.network import Network, NetworkError
from processing.bundle.normal_equations import (
    GaussNewtonStep,
    ReducedEquations,
    SingularError,
    point_normals,
    reduced_equations,
    solve,
)
from processing.bundle.rank_diagnosis import RankDefectError, rank_defects
from processing.bundle.unknowns import ParameterLayout, ParameterValues, apply_corrections

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Progress = Callable[[str, int, float], None]

_CONVERGED: Final = 1e-14
"""Predicted decrease over the sum of squares: far below the printed precision."""

_OBJECTIVE_CONVERGED: Final = 1e-10
"""Predicted decrease, in squared a priori sigmas, below the printed precision."""

_SLOW_CONVERGED: Final = 1e-6
"""After the last iteration: every unknown is within a thousandth of its a priori sigma."""

_MAX_HALVINGS: Final = 12
_WEAK_AFTER: Final = 12
"""Iterations after which a point with rays that are nearly parallel is set aside if it moves."""

_WEAK_INFORMATION: Final = 1e-3
"""Smallest over largest eigenvalue of a point's normal matrix: rays about 3 degrees apart."""

_FLAT: Final = 1e-12
_MAX_OWN_SHARE: Final = 0.1
_WEAK_MOVE: Final = 1e-3
"""Correction of a point over its distance from a camera that saw it."""


class WeakPointsError(ProcessingError, ValueError):
    """Object points with rays so nearly parallel that iterations do not find their place."""

    def __init__(self, points: Indices) -> None:
        self.points = points
        super().__init__(f"{len(points)} object points have rays that are nearly parallel")


@dataclass
class Run:
    """Variables of a running adjustment: state, weights, history."""

    network: Network
    layout: ParameterLayout
    state: ParameterValues
    weight: Array
    report_progress: Progress
    history: list[float]
    max_iterations: int
    minimum_norm: bool

    def rows(self, state: ParameterValues, *, derivatives: bool = True) -> Equations:
        """Rows at a state.

        Args:
            state: where misclosures are computed.
            derivatives: as of `equations`.

        Returns:
            The rows, with the weights of the run.
        """
        return equations(self.network, self.layout, state, self.weight, derivatives=derivatives)


def iterate(run: Run) -> tuple[Equations, ReducedEquations]:
    """Iterate to convergence; `run.state` is then the solution.

    Args:
        run: variables of the adjustment; its state and history are changed.

    Returns:
        The rows and reduced equations at the solution.

    Raises:
        NetworkError: no convergence, or an object point behind a camera that saw it.
        RankDefectError: directions without information.
        WeakPointsError: object points that keep the others from converging.
    """
    for iteration in range(run.max_iterations + 1):
        rows = front(run, run.state)
        objective = float(rows.misclosure @ rows.misclosure)
        run.history.append(objective)
        run.report_progress("iteration", iteration, objective)
        _refuse_flat(run, rows)
        reduced = reduced_equations(rows, run.layout)
        step = solved(run, reduced)
        if step.predicted_decrease <= max(_CONVERGED * objective, _OBJECTIVE_CONVERGED):
            return rows, reduced
        if iteration >= min(_WEAK_AFTER, run.max_iterations):
            _refuse_moving(run, rows, step.dpoints)
        if iteration == run.max_iterations and step.predicted_decrease <= _SLOW_CONVERGED:
            return rows, reduced
        run.state = take_step(run, step.dx, step.dpoints, objective, step.predicted_decrease)
    raise NetworkError(
        [
            f"no convergence after {run.max_iterations} iterations; starting values are "
            "far off, or blunders too large: try robust weights"
        ]
    )


def solved(run: Run, reduced: ReducedEquations) -> GaussNewtonStep:
    """Corrections of a run.

    Args:
        run: variables of the adjustment; with `minimum_norm` its free motions are left out.
        reduced: its reduced equations.

    Returns:
        The step.

    Raises:
        RankDefectError: directions without information.
    """
    directions = None
    if run.minimum_norm:
        directions = scaled_directions(free_motions(run.layout, run.state, reduced), reduced)
    try:
        return solve(reduced, run.layout.constraints, directions=directions)
    except SingularError as error:
        raise RankDefectError(
            rank_defects(run.network, run.layout, run.state, error.reduced, singular=True)
        ) from None


def front(run: Run, state: ParameterValues) -> Equations:
    """Rows at a state whose object points are in front of the cameras.

    Args:
        run: variables of the adjustment.
        state: where misclosures are computed.

    Returns:
        The rows with derivatives.

    Raises:
        NetworkError: an object point behind a camera that saw it, by name.
    """
    try:
        return run.rows(state)
    except BehindCameraError as error:
        table, names = run.network.image_points, run.network
        first = int(error.image_points[0])
        raise NetworkError(
            [
                f"{len(error.image_points)} image points see their object point behind the camera, "
                f"first point {names.points.names[table.point[first]]} in image "
                f"{names.images.names[table.image[first]]}: better starting values are needed"
            ]
        ) from None


def take_step(
    run: Run, dx: Array, dpoints: Array, objective: float, predicted_decrease: float
) -> ParameterValues:
    """The full step, or shorter ones of single points or of all until the sum of squares falls.

    Args:
        run: variables of the adjustment; not changed.
        dx: corrections of the columns, shape (c,).
        dpoints: corrections of the eliminated points, shape (p, 3), m.
        objective: sum of squares before the step.
        predicted_decrease: by the linear model.

    Returns:
        The state after the step.
    """
    length = 1.0
    own = np.ones(len(dpoints))
    before = _by_point(run, run.rows(run.state, derivatives=False))
    for _ in range(_MAX_HALVINGS):
        state = apply_corrections(run.state, run.layout, length * dx, own[:, None] * dpoints)
        try:
            rows = run.rows(state, derivatives=False)
        except BehindCameraError as error:
            who = run.layout.eliminated[run.network.image_points.point[error.image_points]]
            behind = np.unique(who[who >= 0])
            own[behind] *= 0.5
            if not len(behind) or len(behind) > _MAX_OWN_SHARE * len(own):
                length, own = 0.5 * length, 0.5 * own
            continue
        value = float(rows.misclosure @ rows.misclosure)
        if (
            value <= objective - 1e-4 * length * predicted_decrease
            or predicted_decrease < 1e-7 * objective
        ):
            return state
        # A point that a few rays fix badly must not shorten the step of all others.
        worse = _by_point(run, rows) > before + 0.5 * (value - objective)
        if 0 < worse.sum() <= _MAX_OWN_SHARE * len(own) and value > objective:
            own[worse] *= 0.5
        else:
            length, own = 0.5 * length, 0.5 * own
    return state


def _by_point(run: Run, rows: Equations) -> Array:
    """Sum of squares of the rows of each eliminated point."""
    there = rows.point >= 0
    squares = rows.misclosure[there] ** 2
    count = len(run.layout.eliminated_points)
    return np.bincount(rows.point[there], weights=squares, minlength=count).astype(np.float64)


def _refuse_flat(run: Run, rows: Equations) -> None:
    """Points that have no information left in a direction, to working precision."""
    values = np.linalg.eigvalsh(point_normals(rows, run.layout))
    flat = values[:, 0] <= _FLAT * values[:, 2]
    if flat.any():
        raise WeakPointsError(run.layout.eliminated_points[flat])


def _refuse_moving(run: Run, rows: Equations, dpoints: Array) -> None:
    """Points of nearly parallel rays that still move, if they are few."""
    points = run.layout.eliminated_points
    values = np.linalg.eigvalsh(point_normals(rows, run.layout))
    table, images = run.network.image_points, run.network.images
    distance = np.full(len(run.layout.locked), np.inf)
    ray = run.state.points[table.point] - run.state.station[images.station[table.image]]
    np.minimum.at(distance, table.point, np.linalg.norm(ray, axis=1))
    moving = np.linalg.norm(dpoints, axis=1) > _WEAK_MOVE * distance[points]
    weak = moving & (values[:, 0] < _WEAK_INFORMATION * values[:, 2])
    if weak.any():
        raise WeakPointsError(points[weak])

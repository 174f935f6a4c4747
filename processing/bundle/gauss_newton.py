"""Gauss-Newton iterations of a network: steps that always lower the sum of squares, robust weights.

The selection of observations is in `adjust`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.equations import BehindCameraError, Equations, equations
from processing.bundle.network import Network, NetworkError
from processing.bundle.normal_equations import (
    ReducedEquations,
    SingularError,
    reduced_equations,
    solve,
)
from processing.bundle.rank_diagnosis import RankDefectError, rank_defects
from processing.bundle.unknowns import ParameterLayout, ParameterValues, apply_corrections

Array = NDArray[np.float64]
Progress = Callable[[str, int, float], None]

_CONVERGED: Final = 1e-14
"""Predicted decrease over the sum of squares: far below the printed precision."""

_OBJECTIVE_CONVERGED: Final = 1e-10
"""Predicted decrease, in squared a priori sigmas, below the printed precision."""

_HUBER: Final = 2.0
_MAX_HALVINGS: Final = 8


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
    """
    for iteration in range(run.max_iterations + 1):
        rows = _front(run, run.state)
        objective = float(rows.misclosure @ rows.misclosure)
        run.history.append(objective)
        run.report_progress("iteration", iteration, objective)
        reduced = reduced_equations(rows, run.layout)
        try:
            step = solve(reduced, run.layout.constraints, minimum_norm=run.minimum_norm)
        except SingularError as error:
            raise RankDefectError(
                rank_defects(run.network, run.layout, run.state, error.reduced, singular=True)
            ) from None
        if step.predicted_decrease <= max(_CONVERGED * objective, _OBJECTIVE_CONVERGED):
            return rows, reduced
        run.state = _take_step(run, step.dx, step.dpoints, objective, step.predicted_decrease)
    raise NetworkError(
        [
            f"no convergence after {run.max_iterations} iterations; starting values are "
            "far off, or blunders too large: try robust weights"
        ]
    )


def _front(run: Run, state: ParameterValues) -> Equations:
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


def _take_step(
    run: Run, dx: Array, dpoints: Array, objective: float, predicted_decrease: float
) -> ParameterValues:
    """The full step, or a half of it as often as needed for the sum of squares to fall."""
    length = 1.0
    for _ in range(_MAX_HALVINGS):
        state = apply_corrections(run.state, run.layout, length * dx, length * dpoints)
        try:
            rows = run.rows(state, derivatives=False)
            value = float(rows.misclosure @ rows.misclosure)
            if (
                value <= objective - 1e-4 * length * predicted_decrease
                or predicted_decrease < 1e-7 * objective
            ):
                return state
        except BehindCameraError:
            pass
        length *= 0.5
    return apply_corrections(run.state, run.layout, length * dx, length * dpoints)


def robust_weights(run: Run) -> None:
    """Huber weights on whole image points, renewed at every iteration.

    Args:
        run: variables of the adjustment; its state and weights are changed.

    Raises:
        NetworkError: an object point behind a camera that saw it.
        RankDefectError: directions without information.
    """
    points = run.network.image_points
    for iteration in range(run.max_iterations):
        rows = _front(run, run.state)
        objective = float(rows.misclosure @ rows.misclosure)
        run.report_progress("robust iteration", iteration, objective)
        reduced = reduced_equations(rows, run.layout)
        try:
            step = solve(reduced, run.layout.constraints, minimum_norm=run.minimum_norm)
        except SingularError as error:
            raise RankDefectError(
                rank_defects(run.network, run.layout, run.state, error.reduced, singular=True)
            ) from None
        run.state = _take_step(run, step.dx, step.dpoints, objective, step.predicted_decrease)
        before = run.weight
        plain = replace(run, weight=np.where(run.weight > 0.0, 1.0, 0.0))
        rows = plain.rows(run.state, derivatives=False)
        size = np.zeros(len(points.image))
        image_rows = rows.group < 2
        np.add.at(size, rows.source[image_rows], rows.misclosure[image_rows] ** 2)
        seen = size > 0.0
        unit = 1.4826 * np.median(np.sqrt(size[seen] / 2.0)) / 0.8 if seen.any() else 1.0
        size = np.sqrt(size / 2.0) / max(float(unit), 1e-12)
        run.weight = np.where(before > 0.0, np.minimum(1.0, _HUBER / np.maximum(size, 1e-9)), 0.0)
        if np.abs(run.weight - before).max() < 1e-2 and step.predicted_decrease < 1e-6 * objective:
            return

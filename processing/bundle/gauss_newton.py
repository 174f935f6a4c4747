"""Gauss-Newton iterations of a network, damped where a step does not lower the sum of squares.

The selection of observations is in `adjust`, robust weights are in `robust_weights`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing import ProcessingError
from processing.bundle.equation_rows import Equations
from processing.bundle.equations import equations
from processing.bundle.free_datum import FreeDatum, free_motions, scaled_directions
from processing.bundle.image_rows import BehindCameraError
from processing.bundle.network import Network, NetworkError
from processing.bundle.normal_equations import ReducedEquations, point_normals, reduced_equations
from processing.bundle.rank_diagnosis import RankDefectError, rank_defects
from processing.bundle.reduced_solution import (
    GaussNewtonStep,
    SingularError,
    cofactor_matrix,
    solve,
)
from processing.bundle.step_control import (
    RECIPROCAL_BELOW,
    Damping,
    Rays,
    corrected_state,
    held_depths,
    lowering_step,
    rays_of,
    weakest_share,
)
from processing.bundle.unknowns import ParameterLayout, ParameterValues

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Progress = Callable[[str, int, float], None]

_CONVERGED: Final = 1e-14
"""Predicted decrease over the sum of squares: far below the printed precision."""

_OBJECTIVE_CONVERGED: Final = 1e-10
"""Predicted decrease, in squared a priori sigmas, below the printed precision."""

_SLOW_CONVERGED: Final = 1e-6
"""After the last iteration: every unknown is within a thousandth of its a priori sigma, or of its
a posteriori sigma where residuals are larger than expected."""

_WEAK_INFORMATION: Final = 1e-3
"""Smallest over largest eigenvalue of a point's normal matrix: rays about 3 degrees apart."""

_USELESS_TIME_S: Final = 0.1
"""A priori standard deviation of a delay that is not determined: the motion within it is not that
of the second order, and iterations do not converge."""

_SECOND_DIFFERENCE: Final = 0.1
"""Share of a step at which its second order is taken."""

_BENT_BELOW: Final = 0.1
"""Predicted decrease over the sum of squares: far from a solution the second order misleads."""

_MAX_NARROW: Final = 0.1
"""Share of points of nearly parallel rays up to which steps are bent: these go to infinity."""

_BENT_LENGTHS: Final = (1.0, 0.5, 0.2)
"""Of a step that is bent by its second order."""

_FLAT: Final = 1e-12
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
    free_datum: FreeDatum = "unknowns"
    datum_names: tuple[str, ...] = ()

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
    damping = Damping()
    rays = rays_of(run.network, run.layout)
    for iteration in range(run.max_iterations + 1):
        rows = front(run, run.state)
        objective = float(rows.misclosure @ rows.misclosure)
        run.history.append(objective)
        run.report_progress("iteration", iteration, objective)
        trial = _Trial(run, rows, rays)
        reduced, step = trial.step(damping.value)
        if iteration == 0 and not run.minimum_norm:
            _refuse_unseparated_times(run, reduced)
        small = max(_CONVERGED * objective, _OBJECTIVE_CONVERGED)
        if damping.value > 0.0 and step.predicted_decrease <= 1e6 * small:
            damping.value = 0.0
            reduced, step = trial.step(0.0)
        last = iteration == run.max_iterations
        variance = max(1.0, objective / max(len(rows.misclosure), 1))
        slow = last and step.predicted_decrease <= _SLOW_CONVERGED * variance
        if step.predicted_decrease <= small or slow:
            trial.refuse_held()
            return rows, reduced
        if last:
            trial.refuse_moving(step.dpoints)
        elif not trial.take(step, damping):
            break
        # Not held while the next are computed: they are the largest arrays of an adjustment.
        del rows, trial, reduced, step
    raise NetworkError(
        [
            f"no convergence after {len(run.history) - 1} iterations; starting values are "
            "far off, or blunders too large: try robust weights"
        ]
    )


def _refuse_unseparated_times(run: Run, reduced: ReducedEquations) -> None:
    """Name delays and readout times that the motion of the rig does not separate from the rest."""
    layout = run.layout
    times = np.concatenate([layout.head_delay, layout.readout])
    times = times[times >= 0]
    if not times.size:
        return
    cofactor = cofactor_matrix(reduced)
    lost = times[np.sqrt(cofactor.diagonal()[times]) > _USELESS_TIME_S]
    if not lost.size:
        return
    unit = np.zeros((layout.columns, len(lost)))
    unit[lost, np.arange(len(lost))] = 1.0
    directions = np.linalg.qr((cofactor @ unit) * reduced.scale[:, None])[0]
    raise RankDefectError(
        rank_defects(run.network, layout, run.state, reduced, directions=directions)
    )


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


class _Trial:
    """Steps from one state: their reduced equations, and the points that must not move freely."""

    def __init__(self, run: Run, rows: Equations, rays: Rays) -> None:
        self._run, self._rows, self._rays = run, rows, rays
        normals = point_normals(rows, run.layout)
        self._share = weakest_share(normals)
        self._reciprocal = rays.free & (self._share < RECIPROCAL_BELOW)
        narrow = rays.free & (self._share < _WEAK_INFORMATION)
        self._is_wide = narrow.sum() <= _MAX_NARROW * len(narrow)
        self._held = held_depths(rows, run.layout, run.state, rays, normals)
        flat = (self._share <= _FLAT) & ~self._held.any(axis=1)
        if flat.any():
            raise WeakPointsError(run.layout.eliminated_points[flat])

    def step(self, damping: float) -> tuple[ReducedEquations, GaussNewtonStep]:
        """Reduced equations with damping, and the corrections."""
        return self._solved(self._rows, damping)

    def _solved(self, rows: Equations, damping: float) -> tuple[ReducedEquations, GaussNewtonStep]:
        held = self._held if self._held.any() else None
        run, directions = self._run, None
        reduced = reduced_equations(rows, run.layout, damping, held)
        if run.minimum_norm:
            motions = free_motions(run.layout, run.state, reduced)
            directions = scaled_directions(motions, reduced)
        try:
            return reduced, solve(reduced, directions=directions)
        except SingularError:
            # Again, for a factor of blocks is written in the place of the matrix.
            reduced = reduced_equations(rows, run.layout, damping, held)
            found = rank_defects(run.network, run.layout, run.state, reduced)
            raise RankDefectError(found) from None

    def take(self, step: GaussNewtonStep, damping: Damping, *, bends: bool = True) -> bool:
        """Take the step, or a damped one that lowers the sum of squares; whether there is one.

        Before a step is damped more, it is bent by its second order: along a curved valley, as of a
        principal distance and heights, short straight steps would be needed.
        """
        run = self._run
        objective = float(self._rows.misclosure @ self._rows.misclosure)
        while True:
            tried = step
            found = self._lowering(step)
            near = step.predicted_decrease < _BENT_BELOW * objective
            if found is None and bends and near and self._is_wide:
                for tried in self._bent(step, damping.value):
                    found = self._lowering(tried)
                    if found is not None:
                        break
            if found is not None:
                run.state, value = found
                damping.adapt(objective - value, tried.predicted_decrease)
                return True
            if not damping.raise_():
                return False
            _, step = self.step(damping.value)

    def _lowering(self, step: GaussNewtonStep) -> tuple[ParameterValues, float] | None:
        run = self._run
        return lowering_step(
            lambda state: run.rows(state, derivatives=False),
            run.network,
            run.layout,
            run.state,
            step,
            self._rays,
            self._reciprocal,
            self._rows,
        )

    def _bent(self, step: GaussNewtonStep, damping: float) -> list[GaussNewtonStep]:
        """The step with its second-order correction, from second differences of misclosures.

        Empty where these are not known; otherwise whole and shorter ways along the parabola.

        Source: Transtrum and Sethna (2012), section 3.
        """
        run, share = self._run, np.ones(len(step.dpoints))
        sides = []
        for length in (_SECOND_DIFFERENCE, -_SECOND_DIFFERENCE):
            part = GaussNewtonStep(length * step.dx, length * step.dpoints, 0.0)
            state = corrected_state(
                run.state, run.layout, part, self._rays, self._reciprocal, share,
                rotates=not run.network.constraints,
            )  # fmt: skip
            try:
                sides.append(run.rows(state, derivatives=False).misclosure)
            except BehindCameraError:
                return []
        second = sides[0] - 2.0 * self._rows.misclosure + sides[1]
        rows = replace(self._rows, misclosure=second / _SECOND_DIFFERENCE**2)
        _, bend = self._solved(rows, damping)
        return [
            GaussNewtonStep(
                t * step.dx + 0.5 * t**2 * bend.dx,
                t * step.dpoints + 0.5 * t**2 * bend.dpoints,
                t * (2.0 - t) * step.predicted_decrease,
            )
            for t in _BENT_LENGTHS
        ]

    def refuse_held(self) -> None:
        """Points whose rays meet nowhere in front of the cameras."""
        held = self._held.any(axis=1)
        if held.any():
            raise WeakPointsError(self._run.layout.eliminated_points[held])

    def refuse_moving(self, dpoints: Array) -> None:
        """Points of nearly parallel rays that still move."""
        points = self._run.layout.eliminated_points
        mean, _ = self._rays.centres(self._run.state)
        distance = np.linalg.norm(self._run.state.points[points] - mean, axis=1)
        moving = np.linalg.norm(dpoints, axis=1) > _WEAK_MOVE * distance
        weak = self._rays.free & moving & (self._share < _WEAK_INFORMATION)
        if weak.any():
            raise WeakPointsError(points[weak])


def robust_step(run: Run, rows: Equations, damping: Damping) -> GaussNewtonStep:
    """Take one damped step of a run whose weights change.

    Args:
        run: variables of the adjustment; its state is changed if a step lowers the sum of squares.
        rows: at the state.
        damping: is adapted.

    Returns:
        The step of the linear model.

    Raises:
        RankDefectError: directions without information.
        WeakPointsError: object points without information in a direction.
    """
    trial = _Trial(run, rows, rays_of(run.network, run.layout))
    _, step = trial.step(damping.value)
    trial.take(step, damping, bends=False)
    return step

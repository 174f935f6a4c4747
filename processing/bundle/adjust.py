"""The adjustment: Gauss-Newton with step control, robust weights, data snooping, components.

A pure function of a network. It returns the adjusted network with all its statistics.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.adjusted_statistics import statistics_of
from processing.bundle.critical_values import TestName, critical_value, number_of_tests
from processing.bundle.data_snooping import (
    Excluded,
    contradicted,
    fitting_again,
    nothing_excluded,
)
from processing.bundle.equation_rows import Equations
from processing.bundle.free_datum import (
    FreeDatum,
)
from processing.bundle.gauss_newton import (
    Progress,
    Run,
    WeakPointsError,
    iterate,
)
from processing.bundle.network import Network, NetworkError, validate
from processing.bundle.normal_equations import ReducedEquations
from processing.bundle.rank_diagnosis import RankDefect
from processing.bundle.reduced_solution import Cofactor
from processing.bundle.robust_weights import WeightFunction, robust_exclusions
from processing.bundle.statistics import ObservationGroup, groups_of
from processing.bundle.step_control import points_in_front
from processing.bundle.undetermined_points import undetermined_points
from processing.bundle.unknowns import (
    ParameterLayout,
    ParameterValues,
    in_blocks,
    initial_values,
    layout_of,
)
from processing.bundle.variance_components import are_changing, estimable_factors, rescaled

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_MIN_POINTS: Final = 4
_MIN_SHARE: Final = 0.3
_MAX_COMPONENT_ROUNDS: Final = 12
_MAX_WHOLE: Final = 15_000


@dataclass(frozen=True)
class AdjustmentSettings:
    """How to adjust.

    Attributes:
        max_iterations: of each Gauss-Newton run.
        robust: first with weights that fall with the residual, so that blunders pull less.
        weight_function: the weights of `robust`.
        reject_beyond: observations whose standardised residual (residual over its own standard
            deviation) exceeds this are left out, worst first; None: see `significance`.
        significance: of data snooping, the probability that a block without blunders loses any
            observation; the limit follows from the number of tests. None, and no
            `reject_beyond`: no data snooping.
        test: `pope`, standard deviations of residuals a posteriori; `baarda`, a priori.
        power: probability with which a minimal detectable bias is found.
        max_rounds: of data snooping; to reach it is a problem of the adjustment.
        variance_components: scale the sigmas of each kind of observation by its residuals.
        minimum_norm: undetermined directions raise no error; the shortest correction is used.
        free_datum: datum of a free network: `unknowns` is the shortest correction of the scaled
            unknowns, the others are inner constraints on object points, stations or all of them.
        datum_names: the points and stations of those inner constraints; empty: all.
        dense_columns: with more unknowns in addition to the eliminated object points, the reduced
            matrix is stored in blocks, and so is what is needed of its inverse.
        retained: object points that are not eliminated, so that `cofactor` of the result holds
            their covariances with each other and with all other unknowns.
    """

    max_iterations: int = 50
    robust: bool = False
    weight_function: WeightFunction = "huber"
    reject_beyond: float | None = None
    significance: float | None = None
    test: TestName = "pope"
    power: float = 0.8
    max_rounds: int = 100
    variance_components: bool = False
    minimum_norm: bool = False
    free_datum: FreeDatum = "unknowns"
    datum_names: tuple[str, ...] = ()
    retained: tuple[str, ...] = ()
    dense_columns: int = 2_000

    @property
    def is_snooping(self) -> bool:
        """Whether data snooping is requested."""
        return self.reject_beyond is not None or self.significance is not None

    @property
    def uses_a_priori_sigma(self) -> bool:
        """Whether residuals are tested against a priori standard deviations."""
        return self.test == "baarda"


@dataclass(frozen=True)
class Adjustment:
    """An adjusted network.

    Attributes:
        network, layout, settings: what was adjusted.
        state: adjusted values.
        sigma0: a posteriori standard deviation of unit weight.
        redundancy, observations, unknowns: counts; constraints count as observations.
        iterations: weighted sum of squares before each iteration and at the end.
        cofactors: (c, c) of the columns; times sigma0 squared it is the covariance. Of a
            large block (`dense_columns`) a `BandCofactor`, which is indexed alike.
        point_cofactor: (points, 3, 3) m squared, zero for held coordinates, NaN for points
            left out.
        equations: the last rows; `residual` (m,) in sigmas of each row, `redundancy_number` (m,).
        influence: (m, 3) m, change of the row's own object point by one sigma of the row.
        weight: (image points,) zero for what was rejected.
        rejected: (image points,) left out by data snooping.
        excluded: everything that data snooping left out, image points among it.
        rounds: adjustments that data snooping needed; 0 without it.
        reject_limit: critical value of data snooping in the end; None without it.
        tests: number of distinct tests it holds for; 0 where the limit was given.
        problems: why the result is not final; empty when it is.
        left_out: (points,) object points that their rays do not fix.
        factors: variance factor applied to each kind of observation.
        groups: statistics of each kind of observation.
        rank_defects: undetermined directions (only with `minimum_norm`).
    """

    network: Network
    layout: ParameterLayout
    settings: AdjustmentSettings
    state: ParameterValues
    sigma0: float
    redundancy: int
    observations: int
    unknowns: int
    iterations: tuple[float, ...]
    cofactors: Cofactor
    point_cofactor: Array
    equations: Equations
    residual: Array
    redundancy_number: Array
    influence: Array
    weight: Array
    rejected: Flags
    left_out: Flags
    factors: Mapping[str, float]
    groups: tuple[ObservationGroup, ...]
    excluded: Excluded
    rounds: int = 0
    reject_limit: float | None = None
    tests: int = 0
    problems: tuple[str, ...] = ()
    rank_defects: tuple[RankDefect, ...] = field(default=())

    @cached_property
    def cofactor(self) -> Array:
        """The whole of `cofactors`, (c, c); for blocks of up to 15,000 columns.

        Raises:
            NetworkError: it would not fit into memory.
        """
        if isinstance(self.cofactors, np.ndarray):
            return self.cofactors
        columns = len(self.cofactors)
        if columns > _MAX_WHOLE:
            raise NetworkError(
                [
                    f"the covariance matrix of {columns} unknowns does not fit into memory; at "
                    f"most {_MAX_WHOLE} have one. Standard deviations and covariances of single "
                    "exposures and points are in the result"
                ]
            )
        return np.asarray(self.cofactors @ np.eye(columns))

    @property
    def test_sigma0(self) -> float:
        """Standard deviation of unit weight that residuals are tested with."""
        return 1.0 if self.settings.uses_a_priori_sigma else self.sigma0

    @property
    def standardised(self) -> Array:
        """Residuals over their own standard deviations, (m,); a priori with Baarda's test."""
        spread = self.test_sigma0 * np.sqrt(np.clip(self.redundancy_number, 1e-12, None))
        return np.asarray(self.residual / np.where(spread > 0.0, spread, 1.0))


def adjust(
    network: Network,
    settings: AdjustmentSettings | None = None,
    *,
    progress: Progress | None = None,
) -> Adjustment:
    """Adjust a network by least squares.

    Args:
        network: observations and starting values.
        settings: see `AdjustmentSettings`; None: its defaults.
        progress: called with what is done, the iteration, and the weighted sum of squares.

    Returns:
        Adjusted values with their cofactors, residuals and statistics.

    Raises:
        NetworkError: tables that do not fit, starting values far off, no convergence, or fewer
            observations than unknowns.
        RankDefectError: a parameter cannot be determined; the message names it.

    Source: docs/explanation/mathematics/bundle.md#adjustment.
    """
    validate(network)
    settings = settings or AdjustmentSettings()
    _validate_settings(settings)
    selection = _Selection(network, nothing_excluded(network), nothing_excluded(network))
    state = points_in_front(network, initial_values(network))
    report_progress = progress or (lambda _what, _iteration, _value: None)
    history: list[float] = []
    robust = settings.robust
    weak = np.zeros(len(network.points.names), dtype=bool)
    began = state
    while True:
        active = selection.active()
        weight = np.where(selection.excluded.image, 0.0, 1.0)
        left_out = undetermined_points(active, state, weight) | weak
        if weak.any():
            _refuse_without_points(~undetermined_points(network, began), left_out)
        layout = layout_of(active, left_out, settings.retained)
        if layout.columns > settings.dense_columns:
            layout = in_blocks(network, layout)
        run = Run(
            active,
            layout,
            state,
            weight,
            report_progress,
            history,
            max_iterations=settings.max_iterations,
            minimum_norm=settings.minimum_norm,
            free_datum=settings.free_datum,
            datum_names=settings.datum_names,
        )
        try:
            if robust:
                found = robust_exclusions(run, settings.weight_function)
                selection.excluded = selection.excluded.joined(found)
                state, robust = run.state, False
                continue
            rows, reduced = iterate(run)
        except WeakPointsError as error:
            weak[error.points] = True
            state = run.state
            # Robust iterations leave no history.
            squares = history[-1] if history else 0.0
            report_progress(f"weak points set aside: {int(weak.sum())}", len(history), squares)
            continue
        solved = statistics_of(run, network, rows, reduced)
        state = run.state
        result = Adjustment(
            network=network,
            layout=layout,
            settings=settings,
            state=state,
            iterations=tuple(history),
            weight=run.weight,
            rejected=selection.excluded.image,
            left_out=left_out,
            factors=dict(selection.factors),
            groups=groups_of(
                solved.equations,
                solved.residual,
                solved.redundancy_number,
                selection.factors,
            ),
            excluded=selection.excluded,
            **vars(solved),
        )
        what = selection.advance(result, reduced)
        if what is None:
            return replace(
                result,
                problems=tuple(selection.problems),
                rounds=selection.snooping_rounds,
                reject_limit=selection.limit,
                tests=selection.tests,
            )
        report_progress(what, selection.rounds, history[-1])


def _refuse_without_points(determined: Flags, left_out: Flags) -> None:
    """Refuse a block of which nearly parallel rays leave next to no object points."""
    before, left = int(determined.sum()), int((determined & ~left_out).sum())
    if left < max(_MIN_POINTS, _MIN_SHARE * before):
        raise NetworkError(
            [
                f"rays are nearly parallel: {before - left} of {before} object points have "
                "no place in front of the cameras; images with larger distances between them, or "
                "better starting values, are needed"
            ]
        )


def _validate_settings(settings: AdjustmentSettings) -> None:
    problems = []
    if settings.reject_beyond is not None and settings.significance is not None:
        problems.append("reject_beyond and significance are both given; one of them sets the limit")
    for name, value in (("significance", settings.significance), ("power", settings.power)):
        if value is not None and not 0.0 < value < 1.0:
            problems.append(f"{name} is {value:g}; it is between 0 and 1")
    if not settings.minimum_norm and (settings.free_datum != "unknowns" or settings.datum_names):
        problems.append("free_datum and datum_names are of a free network: set minimum_norm, too")
    elif settings.datum_names and settings.free_datum == "unknowns":
        problems.append(
            "datum_names name points or stations of a datum, and free_datum is unknowns: set it to "
            "points, stations, all or dependent"
        )
    if problems:
        raise NetworkError(problems)


@dataclass
class _Selection:
    """Which observations take part with which variance factors, from round to round."""

    given: Network
    excluded: Excluded
    readmitted: Excluded
    factors: dict[str, float] = field(default_factory=dict)
    rounds: int = 0
    snooping_rounds: int = 0
    component_rounds: int = 0
    limit: float | None = None
    tests: int = 0
    problems: list[str] = field(default_factory=list)

    def active(self) -> Network:
        """The network to adjust next."""
        return self.excluded.applied(rescaled(self.given, self.factors))

    def advance(self, result: Adjustment, reduced: ReducedEquations) -> str | None:
        """Choose again after an adjustment; what was done, None when the selection is final."""
        self.rounds += 1
        settings = result.settings
        if settings.is_snooping and result.redundancy > 0:
            self._choose_limit(result, reduced)
            what = self._snoop(result, reduced, settings.max_rounds)
            if what is not None or self.problems:
                return what
        if (
            settings.variance_components
            and self.component_rounds < _MAX_COMPONENT_ROUNDS
            and are_changing(result.groups, result.factors)
        ):
            self.component_rounds += 1
            self.factors = estimable_factors(result.groups)
            return "variance components"
        return None

    def _choose_limit(self, result: Adjustment, reduced: ReducedEquations) -> None:
        """The limit given, or the critical value for the tests of this adjustment."""
        settings = result.settings
        self.limit, self.tests = settings.reject_beyond, 0
        if settings.reject_beyond is None and settings.significance is not None:
            self.tests = number_of_tests(result.equations, reduced, result.redundancy_number)
            self.limit = critical_value(
                settings.test, settings.significance, max(self.tests, 1), result.redundancy
            )

    def _snoop(self, result: Adjustment, reduced: ReducedEquations, max_rounds: int) -> str | None:
        limit = self.limit or math.inf
        worst, beyond = contradicted(
            self.given,
            result.equations,
            reduced,
            result.cofactors,
            result.standardised,
            result.redundancy_number,
            result.test_sigma0,
            limit,
        )
        if beyond and self.snooping_rounds >= max_rounds:
            self.problems.append(
                f"data snooping ended after {max_rounds} rounds with {beyond} observations beyond "
                f"{limit:g} standard deviations and {self.excluded.count} left out: the result is "
                "not final; correct the observations, begin with robust weights or raise max_rounds"
            )
            return None
        if beyond:
            self.snooping_rounds += 1
            self.excluded = self.excluded.joined(worst)
            return f"{self.excluded.count} observations left out"
        again = self._fitting(result, reduced, limit)
        if not again.count:
            return None
        self.snooping_rounds += 1
        self.readmitted = self.readmitted.joined(again)
        self.excluded = self.excluded.without(again)
        return f"{again.count} observations taken in again"

    def _fitting(self, result: Adjustment, reduced: ReducedEquations, limit: float) -> Excluded:
        """What fits again and was not taken in before."""
        candidates = self.excluded.without(self.readmitted)
        if not candidates.count:
            return candidates
        return fitting_again(
            rescaled(self.given, self.factors),
            result.layout,
            result.state,
            candidates,
            reduced,
            result.cofactors,
            result.test_sigma0,
            limit,
        )

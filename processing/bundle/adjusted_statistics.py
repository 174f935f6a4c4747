"""Cofactors, residuals and redundancy of an adjusted network, in the datum that was asked for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.bundle.equation_rows import Equations
from processing.bundle.free_datum import (
    DatumFigures,
    free_motions,
    in_datum,
    scaled_directions,
    state_in_datum,
)
from processing.bundle.gauss_newton import Run
from processing.bundle.network import Network, NetworkError
from processing.bundle.normal_equations import ReducedEquations, reduced_equations
from processing.bundle.rank_diagnosis import RankDefect, rank_defects
from processing.bundle.reduced_solution import Cofactor, cofactor_matrix, null_directions
from processing.bundle.statistics import spread_of
from processing.bundle.unknowns import ParameterLayout

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class AdjustedStatistics:
    """What follows from the solution; attributes as of `Adjustment`."""

    equations: Equations
    residual: Array
    sigma0: float
    redundancy: int
    observations: int
    unknowns: int
    cofactors: Cofactor
    point_cofactor: Array
    redundancy_number: Array
    influence: Array
    rank_defects: tuple[RankDefect, ...]


def statistics_of(
    run: Run, given: Network, rows: Equations, reduced: ReducedEquations
) -> AdjustedStatistics:
    """Statistics at the solution.

    Args:
        run: the adjustment; of a free network its state is moved to the datum.
        given: the network before observations were left out.
        rows: observation equations at the solution.
        reduced: their reduced equations.

    Returns:
        The statistics.

    Raises:
        NetworkError: fewer observations than unknowns.
    """
    layout = run.layout
    if run.minimum_norm and run.free_datum != "unknowns":
        rows, reduced = _moved_to_datum(run, given, rows, reduced)
    run.report_progress("covariances", len(run.history), run.history[-1])
    found: tuple[RankDefect, ...] = ()
    directions, motions = None, None
    if run.minimum_norm:
        motions = free_motions(layout, run.state, reduced)
        expected = scaled_directions(motions, reduced)
        directions, _ = null_directions(reduced, expected)
        found = rank_defects(run.network, layout, run.state, reduced, directions=directions)
    cofactor = cofactor_matrix(reduced, directions=directions)
    own, leverage, influence = spread_of(rows, reduced, cofactor)
    free_points = layout.eliminated_points
    held = layout.locked[free_points]
    unknowns = layout.columns + int((~held).sum())
    observations = len(rows.misclosure)
    free = 0 if directions is None else directions.shape[1]
    redundancy = observations - unknowns + len(layout.constraints) + free
    if redundancy < 0:
        raise NetworkError(
            [f"{observations} observations for {unknowns} unknowns: more are needed than that"]
        )
    # The corrections at convergence are negligible: misclosures are the residuals, sign reversed.
    residual = -rows.misclosure
    sigma0 = float(np.sqrt(residual @ residual / redundancy)) if redundancy > 0 else float("nan")
    point_cofactor = np.full((len(layout.locked), 3, 3), np.nan)
    own = np.where(held[:, :, None] | held[:, None, :], 0.0, own)
    point_cofactor[free_points] = own
    for point in np.flatnonzero(
        (layout.retained_points >= 0).any(axis=1) | _fixed_distance_points(layout)
    ):
        at = layout.retained_points[point]
        there = at >= 0
        point_cofactor[point] = 0.0
        point_cofactor[point][np.ix_(there, there)] = cofactor[np.ix_(at[there], at[there])]
    figures = DatumFigures(cofactor, point_cofactor, influence)
    if run.free_datum != "unknowns" and motions is not None and len(motions.combinations):
        figures = in_datum(
            given,
            layout,
            figures,
            reduced,
            rows.point,
            motions,
            run.free_datum,
            run.datum_names,
        )
    return AdjustedStatistics(
        equations=rows,
        residual=residual,
        sigma0=sigma0,
        redundancy=redundancy,
        observations=observations,
        unknowns=unknowns,
        cofactors=figures.cofactor,
        point_cofactor=figures.point_cofactor,
        redundancy_number=1.0 - leverage,
        influence=figures.influence,
        rank_defects=found,
    )


def _moved_to_datum(
    run: Run, given: Network, rows: Equations, reduced: ReducedEquations
) -> tuple[Equations, ReducedEquations]:
    """Move the block to its datum; rows and reduced equations there, for they hold its scale."""
    motions = free_motions(run.layout, run.state, reduced)
    if not len(motions.combinations):
        return rows, reduced
    run.state = state_in_datum(
        given, run.layout, run.state, motions, run.free_datum, run.datum_names
    )
    rows = run.rows(run.state)
    return rows, reduced_equations(rows, run.layout)


def _fixed_distance_points(layout: ParameterLayout) -> Flags:
    """Fully held points that distances end at: neither eliminated nor with columns."""
    return np.asarray(layout.locked.all(axis=1) & (layout.eliminated < 0))

"""A step rotates a block as a whole: its shape, which the images fix, stays as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from processing.bundle.equations import equations
from processing.bundle.reduced_solution import GaussNewtonStep
from processing.bundle.step_control import corrected_state, rays_of
from processing.bundle.unknowns import apply_corrections, initial_values, layout_of
from tests.processing.bundle.simulated_networks import aerial


def test_a_step_that_rotates_a_block_keeps_its_image_residuals() -> None:
    """With a change of scale, as of a block between its positions."""
    simulated = aerial(sigma_mm=1e-3, seed=5)
    network = replace(
        simulated.network,
        points=replace(
            simulated.network.points, sigma_m=np.full_like(simulated.network.points.sigma_m, np.nan)
        ),
    )
    layout = layout_of(network, np.zeros(len(network.points.names), bool))
    state = replace(
        initial_values(network), points=simulated.points, station=simulated.station.copy()
    )
    rays = rays_of(network, layout)
    points = layout.eliminated_points
    centre = np.array([40.0, -30.0, 90.0])
    turn, scale = np.array([0.02, -0.03, 0.01]), 0.004

    def moved(place):
        return np.cross(turn, place - centre) + scale * (place - centre)

    dx = np.zeros(layout.columns)
    dx[layout.station] = moved(state.station)
    dx[layout.attitude] = np.einsum("nji,j->ni", state.attitude, turn)
    step = GaussNewtonStep(dx, moved(state.points[points]), 1.0)
    weak = np.zeros(len(points), bool)
    after = corrected_state(state, layout, step, rays, weak, np.ones(len(points)))
    linear = apply_corrections(state, layout, step.dx, step.dpoints)
    weight = np.ones(len(network.image_points.image))

    def residuals(values):
        rows = equations(network, layout, values, weight, derivatives=False)
        return rows.misclosure[rows.point >= 0]

    before, turned, tangent = (residuals(values) for values in (state, after, linear))
    assert np.abs(turned - before).max() < 1e-6
    assert np.abs(tangent - before).max() > 0.5
    held = corrected_state(state, layout, step, rays, weak, np.ones(len(points)), rotates=False)
    assert np.array_equal(held.points, linear.points)

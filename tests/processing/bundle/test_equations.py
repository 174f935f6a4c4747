"""Analytic derivatives of every unknown against differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.bundle.camera_model import ideal_mm
from processing.bundle.equation_rows import GROUPS
from processing.bundle.equations import equations
from processing.bundle.image_rows import BehindCameraError
from processing.bundle.network import CameraModel
from processing.bundle.unknowns import apply_corrections, initial_values, layout_of
from processing.geometry.lens import ideal_from_measured
from processing.geometry.rotation import (
    angles_by_rotation_vector,
    omega_phi_kappa,
    rotation_matrix,
    rotations_from_vectors,
    vectors_from_rotations,
)
from processing.rig import find_rig
from tests.processing.bundle.simulated_networks import aerial, rotation_of, with_everything


def test_derivatives_of_every_unknown_agree_with_differences() -> None:
    network = with_everything().network
    layout = layout_of(network, np.zeros(len(network.points.names), dtype=bool))
    state = initial_values(network)
    random = np.random.default_rng(4)
    state = replace(
        state,
        interior=random.normal(0, 1, (2, 10))
        * np.array([0.02, 0.02, 0.05, 2e-6, 1e-9, 1e-13, 1e-6, 1e-6, 1e-5, 1e-5]),
    )
    weight = np.ones(len(network.image_points.image))
    rows = equations(network, layout, state, weight)
    design = rows.reduced.toarray()
    points = len(layout.eliminated_points)
    kinds = {unknown.kind for unknown in layout.unknowns}
    assert kinds == {
        "station", "attitude", "head rotation", "head offset", "camera",
        "GNSS shift", "GNSS drift", "point",
    }  # fmt: skip
    none = np.zeros((points, 3))
    for column in range(layout.columns):
        size = float(np.abs(design[:, column]).max())
        assert size > 0.0, layout.unknowns[column].name
        dx = np.zeros(layout.columns)
        dx[column] = 1.0 / size
        up = equations(network, layout, apply_corrections(state, layout, dx, none), weight)
        down = equations(network, layout, apply_corrections(state, layout, -dx, none), weight)
        numeric = -(up.misclosure - down.misclosure) / (2.0 * dx[column])
        error = np.abs(numeric - design[:, column]).max() / size
        assert error < 1e-6, (layout.unknowns[column].name, error)
    nothing = np.zeros(layout.columns)
    for axis in range(3):
        dp = np.zeros((points, 3))
        dp[:, axis] = 1e-3
        up = equations(network, layout, apply_corrections(state, layout, nothing, dp), weight)
        down = equations(network, layout, apply_corrections(state, layout, nothing, -dp), weight)
        own = rows.point >= 0
        numeric = -(up.misclosure - down.misclosure)[own] / 2e-3
        assert (
            np.abs(numeric - rows.point_part[own, axis]).max()
            < 1e-5 * np.abs(rows.point_part).max()
        )


def test_the_truth_leaves_no_misclosure() -> None:
    simulated = with_everything()
    network = simulated.network
    state = replace(
        initial_values(network),
        station=simulated.station,
        attitude=simulated.attitude,
        points=simulated.points,
        interior=simulated.interior,
        terms=(np.array([3e-5]), np.zeros(0)),
    )
    layout = layout_of(network, np.zeros(len(network.points.names), dtype=bool))
    rows = equations(network, layout, state, np.ones(len(network.image_points.image)))
    image = rows.group < 2
    assert np.abs(rows.misclosure[image] * rows.sigma[image]).max() < 1e-9


def test_the_australis_model_is_the_lens_correction_of_the_pipeline() -> None:
    lens = replace(
        find_rig("ultracam-l").cones[0].lens,
        dx0_mm=0.01,
        dy0_mm=-0.02,
        df_mm=0.03,
        b1=1e-5,
        b2=-3e-5,
    )
    interior = np.array(
        [lens.dx0_mm, lens.dy0_mm, lens.df_mm, lens.k1, lens.k2, lens.k3, lens.p1, lens.p2,
         lens.b1, lens.b2]
    )  # fmt: skip
    xy = np.random.default_rng(1).uniform(-30, 30, (50, 2))
    ours = ideal_mm(CameraModel("c", lens.f_mm), interior, np.zeros(0), xy)
    assert np.abs(ours - ideal_from_measured(lens, xy)).max() < 1e-12


def test_angles_of_many_rotations_are_those_of_one() -> None:
    angles = np.random.default_rng(2).uniform(-1.2, 1.2, (20, 3))
    rotations = np.array([rotation_matrix(*a) for a in angles])
    assert np.abs(omega_phi_kappa(rotations) - angles).max() < 1e-12
    vectors = np.random.default_rng(3).uniform(-1.5, 1.5, (20, 3))
    assert np.abs(vectors_from_rotations(rotations_from_vectors(vectors)) - vectors).max() < 1e-12
    step = 1e-6
    for axis in range(3):
        small = rotations_from_vectors(np.tile(np.eye(3)[axis] * step, (20, 1)))
        there, back = rotations @ small, rotations @ np.swapaxes(small, 1, 2)
        numeric = (omega_phi_kappa(there) - omega_phi_kappa(back)) / (2 * step)
        assert (
            np.abs(numeric - angles_by_rotation_vector("XYZ", rotations)[:, :, axis]).max() < 1e-8
        )


def test_points_behind_a_camera_are_reported() -> None:
    network = aerial().network
    upside_down = replace(
        network.attitudes,
        rotation=network.attitudes.rotation @ rotation_of(np.pi, 0.0, 0.0),
    )
    network = replace(network, attitudes=upside_down)
    layout = layout_of(network, np.zeros(len(network.points.names), dtype=bool))
    with pytest.raises(BehindCameraError):
        equations(
            network, layout, initial_values(network), np.ones(len(network.image_points.image))
        )


def test_misclosures_of_every_kind_are_in_sigmas() -> None:
    network = with_everything().network
    layout = layout_of(network, np.zeros(len(network.points.names), dtype=bool))
    state = initial_values(network)
    state = replace(state, points=state.points + np.array([0.06, -0.04, 0.03]))
    weight = np.ones(len(network.image_points.image))
    rows = equations(network, layout, state, weight)

    def of(name: str) -> np.ndarray:
        return np.sort(np.abs(rows.misclosure[rows.group == GROUPS.index(name)]))

    def expected(off: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        return np.sort(np.abs(off / sigma).ravel())

    assert network.points.sigma_m[:8] == pytest.approx(0.02)
    np.testing.assert_allclose(of("control plan"), np.repeat([2.0, 3.0], 8))
    np.testing.assert_allclose(of("control height"), [1.5] * 8)
    gnss = network.gnss
    antenna = state.station + np.einsum("nij,nj->ni", state.attitude, gnss.lever_m)
    off = gnss.position_m - antenna
    np.testing.assert_allclose(of("GNSS plan"), expected(off[:, :2], gnss.sigma_m[:, :2]))
    np.testing.assert_allclose(of("GNSS height"), expected(off[:, 2], gnss.sigma_m[:, 2]))
    distances = network.distances
    distance = np.linalg.norm(state.points[[20, 40]] - state.points[[30, 1]], axis=1)
    np.testing.assert_allclose(
        of("distance"), expected(distance - distances.distance_m, distances.sigma_m)
    )
    rotation_vectors = vectors_from_rotations(
        np.einsum("nji,njk->nik", network.measured_attitudes.rotation, state.attitude)
    )
    np.testing.assert_allclose(
        of("attitude"), expected(rotation_vectors, network.measured_attitudes.sigma_rad), rtol=1e-3
    )
    quarter = equations(network, layout, state, weight * 0.25)
    image = rows.group < 2
    np.testing.assert_allclose(quarter.misclosure[image], rows.misclosure[image] / 2.0)
    np.testing.assert_allclose(quarter.misclosure[~image], rows.misclosure[~image])

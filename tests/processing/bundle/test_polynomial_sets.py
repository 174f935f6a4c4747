"""Ebner's and Grün's sets: orthogonality, published forms, derivatives, and a block with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from processing.bundle.adjust import adjust
from processing.bundle.camera_model import ideal_mm, term_derivatives
from processing.bundle.network import CameraModel
from processing.bundle.polynomial_sets import EBNER, GRUEN
from processing.bundle.self_calibration import with_self_calibration
from processing.bundle.terms import term_design
from tests.processing.bundle.simulated_networks import aerial

BASE_MM = 20.0


def camera_with(name: str) -> CameraModel:
    return with_self_calibration(CameraModel("c", 70.0), name, base_mm=BASE_MM)


def of_orientation(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """What shifts, tilts, rotation and flying height do to an image of flat ground, (6, 2n)."""
    one, none = np.ones_like(u), np.zeros_like(u)
    pairs = [(one, none), (none, one), (u, v), (-v, u), (u * u, u * v), (u * v, v * v)]
    return np.array([np.concatenate(pair) for pair in pairs])


@pytest.mark.parametrize(("name", "side", "count"), [("ebner", 3, 12), ("gruen", 5, 44)])
def test_parameters_are_orthogonal_to_each_other_and_to_the_orientation(name, side, count) -> None:
    axis = np.linspace(-BASE_MM, BASE_MM, side)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    terms = camera_with(name).terms
    assert len(terms) == len({t.name for t in terms}) == count
    design = np.array([term_design(term, grid).T.ravel() for term in terms])
    length = np.linalg.norm(design, axis=1)
    assert (length > 0.01).all()
    products = design @ design.T / length[:, None] / length
    assert np.abs(products - np.eye(count)).max() < 1e-12
    assert np.abs(design @ of_orientation(*(grid.T / BASE_MM)).T).max() < 1e-12
    # With the six of the orientation they are all that a grid can show.
    assert count + 6 == 2 * side**2


def test_parameters_of_ebner_have_their_published_form() -> None:
    xy = np.random.default_rng(2).uniform(-30.0, 30.0, (50, 2))
    (x, y), b2 = xy.T, BASE_MM**2
    k, l_ = x * x - 2.0 * b2 / 3.0, y * y - 2.0 * b2 / 3.0
    zero = np.zeros_like(x)
    published = [
        (x, -y), (y, x), (-(2 * x * x - 4 * b2 / 3), x * y), (x * y, -(2 * y * y - 4 * b2 / 3)),
        (l_, zero), (zero, k), (x * l_, zero), (zero, k * y), (k * y, zero), (zero, x * l_),
        (k * l_, zero), (zero, k * l_),
    ]  # fmt: skip
    degree = (1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4)
    for term, pair, power in zip(camera_with("ebner").terms, published, degree, strict=True):
        wanted = np.stack(pair, axis=1) / BASE_MM**power
        assert term_design(term, xy) == pytest.approx(wanted, abs=1e-12), term.name


def test_parameters_of_gruen_have_their_published_form() -> None:
    xy = np.random.default_rng(3).uniform(-30.0, 30.0, (50, 2))
    (x, y), b2 = xy.T, BASE_MM**2
    k, l_ = x * x - b2 / 2, y * y - b2 / 2
    p, q = x * x - 17 * b2 / 20, y * y - 17 * b2 / 20
    r = x * x * (x * x - 31 * b2 / 28) + 9 * b2**2 / 70
    s = y * y * (y * y - 31 * b2 / 28) + 9 * b2**2 / 70
    terms = {t.name: t for t in camera_with("gruen").terms}
    published = {
        "a22": (x * y, -10 * l_ / 7, 2), "b22": (-10 * k / 7, x * y, 2), "a14": (x * p, 0 * x, 3),
        "b23": (0 * x, y * k, 3), "a41": (y * q, 0 * x, 3), "b15": (0 * x, r, 4),
        "a51": (s, 0 * x, 4), "b44": (0 * x, x * y * p * q, 6), "a53": (k * s, 0 * x, 6),
        "b54": (0 * x, x * p * s, 7), "a55": (r * s, 0 * x, 8),
    }  # fmt: skip
    for name, (dx, dy, power) in published.items():
        wanted = np.stack([dx, dy], axis=1) / BASE_MM**power
        assert term_design(terms[f"gruen {name}"], xy) == pytest.approx(wanted, abs=1e-12), name
    assert set(EBNER) & set(GRUEN) == set()


@pytest.mark.parametrize("name", ["ebner", "gruen"])
def test_derivatives_agree_with_differences(name) -> None:
    camera = replace(camera_with(name), xp_mm=0.4, yp_mm=-0.3)
    interior = np.array([0.02, -0.03, 0.05, 2e-6, 1e-9, 0.0, 1e-6, -2e-6, 1e-5, -2e-5])
    random = np.random.default_rng(4)
    xy = random.uniform(-25.0, 25.0, (30, 2))
    values = random.normal(0.0, 2e-3, len(camera.terms))
    found = term_derivatives(camera, interior, values, xy)
    for k in range(len(values)):
        step = 1e-4 * np.eye(len(values))[k]
        up, down = (ideal_mm(camera, interior, values + s, xy) for s in (step, -step))
        assert (up - down) / 2e-4 == pytest.approx(found[:, :, k], rel=1e-5, abs=1e-7)


def test_a_block_estimates_what_ebner_s_set_distorted_with() -> None:
    simulated = aerial(
        seed=6, lines=4, along=4, points=220, control=20, disturb=0.3, heights=(1000.0, 1500.0),
        control_sigma_m=0.005,
    )  # fmt: skip
    camera = camera_with("ebner")
    random = np.random.default_rng(8)
    truth = random.normal(0.0, 5e-3, len(camera.terms))
    table = simulated.network.image_points
    measured = table.xy_mm.copy()
    for _ in range(30):
        moved = sum(v * term_design(t, measured) for v, t in zip(truth, camera.terms, strict=True))
        measured = table.xy_mm - moved
    noisy = measured + random.normal(0.0, 1e-3, measured.shape)
    network = replace(
        simulated.network,
        cameras=(camera,),
        image_points=replace(table, xy_mm=noisy, sigma_mm=np.full(noisy.shape, 1e-3)),
    )
    result = adjust(network)
    assert result.sigma0 == pytest.approx(1.0, abs=0.08)
    columns = result.layout.terms[0]
    error = result.state.terms[0] - truth
    covariance = result.sigma0**2 * result.cofactor[np.ix_(columns, columns)]
    low, high = chi2.ppf([0.0005, 0.9995], len(truth))
    assert low < error @ np.linalg.solve(covariance, error) < high


def test_polynomials_without_a_base_are_refused() -> None:
    with pytest.raises(ValueError, match="needs base_mm above 0"):
        with_self_calibration(CameraModel("c", 70.0), "gruen")

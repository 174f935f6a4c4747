"""Brown forward and fisheye against OpenCV, their derivatives, and a block that estimates them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

from processing.bundle.adjust import adjust
from processing.bundle.camera_conversion import converted_camera
from processing.bundle.camera_model import ideal_mm
from processing.bundle.equations import equations
from processing.bundle.forward_models import forward_derivatives, forward_ideal_mm
from processing.bundle.network import CameraModel, Network, NetworkError
from processing.bundle.unknowns import apply_corrections, initial_values, layout_of
from tests.processing.bundle.simulated_networks import aerial

BROWN = np.array([0.05, -0.08, 0.12, -0.11, 0.04, -0.01, 8e-4, -6e-4, 3e-4, -2e-4])
FISHEYE = np.array([0.05, -0.08, 0.12, -0.02, 0.006, -0.002, 3e-4, 0.0, 0.0, 0.0])
PLAIN = np.array([1, 1, 1, 1, 1, 1, 1, 1, 0, 0])
F_MM = 30.0


def opencv_mm(model: str, interior: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Measured mm, y up, of directions (x right, y up, -1) by OpenCV itself; no affinity."""
    c = F_MM - interior[2]
    points = np.column_stack([directions[:, 0], -directions[:, 1], np.ones(len(directions))])
    matrix = np.array([[c, 0.0, -interior[0]], [0.0, c, interior[1]], [0.0, 0.0, 1.0]])
    zero = np.zeros(3)
    if model == "opencv":
        k1, k2, k3, p1, p2 = interior[3:8]
        found, _ = cv2.projectPoints(points, zero, zero, matrix, np.array([k1, k2, p1, p2, k3]))
    else:
        found, _ = cv2.fisheye.projectPoints(
            points[:, None], zero, zero, matrix, np.array([*interior[3:6], interior[6]])
        )
    return found.reshape(-1, 2) * [1.0, -1.0]


def _directions(reach: float) -> np.ndarray:
    return np.random.default_rng(1).uniform(-reach, reach, (200, 2))


@pytest.mark.parametrize(
    ("model", "interior", "reach"), [("opencv", BROWN, 0.7), ("fisheye", FISHEYE, 2.5)]
)
def test_ideal_coordinates_are_those_that_opencv_distorts(model, interior, reach) -> None:
    interior = interior * PLAIN
    directions = _directions(reach)
    measured = opencv_mm(model, interior, directions)
    camera = CameraModel("c", F_MM, model=model)
    found = forward_ideal_mm(camera, interior, measured)
    assert found == pytest.approx(directions * (F_MM - interior[2]), abs=1e-8)
    shifted = replace(camera, xp_mm=0.3, yp_mm=-0.2)
    again = forward_ideal_mm(shifted, interior, measured + np.array([0.3, -0.2]))
    assert again == pytest.approx(found, abs=1e-8)


@pytest.mark.parametrize(
    ("model", "interior", "reach"), [("opencv", BROWN, 0.7), ("fisheye", FISHEYE, 2.5)]
)
def test_derivatives_agree_with_differences(model, interior, reach) -> None:
    camera = CameraModel("c", F_MM, 0.1, -0.2, model=model)
    measured = opencv_mm(model, interior * PLAIN, _directions(0.8 * reach))
    measured = np.vstack([measured, [[0.1 - interior[0], -0.2 - interior[1]]]])
    by_ten, by_place = forward_derivatives(camera, interior, measured)
    for k in range(10):
        if model == "fisheye" and k == 7:
            continue
        step = 1e-6 * np.eye(10)[k]
        up = forward_ideal_mm(camera, interior + step, measured)
        down = forward_ideal_mm(camera, interior - step, measured)
        largest = max(1.0, float(np.abs(by_ten[:, :, k]).max()))
        assert np.abs((up - down) / 2e-6 - by_ten[:, :, k]).max() < 1e-6 * largest, k
    for axis in range(2):
        off = 1e-5 * np.eye(2)[axis]
        up = forward_ideal_mm(camera, interior, measured + off)
        down = forward_ideal_mm(camera, interior, measured - off)
        assert (up - down) / 2e-5 == pytest.approx(by_place[:, :, axis], rel=1e-5, abs=1e-6)


def _block(model: str, interior: np.ndarray, sigma_mm: float) -> tuple[Network, np.ndarray]:
    """A block at two heights whose measured coordinates OpenCV distorted."""
    simulated = aerial(seed=5, lines=4, along=4, points=160, disturb=0.3, control=14,
                       heights=(1000.0, 1500.0), cameras=(CameraModel("c", F_MM),))  # fmt: skip
    network = simulated.network
    table = network.image_points
    # `aerial` noted ideal coordinates of a camera without distortion.
    measured = opencv_mm(model, interior, table.xy_mm / F_MM)
    noise = np.random.default_rng(7).normal(0.0, sigma_mm, measured.shape)
    free = {"dx0", "dy0", "df", "k1", "k2", "p1"} | ({"p2"} if model == "opencv" else set())
    camera = CameraModel("c", F_MM, model=model, free=frozenset(free | {"k3"}))
    return replace(
        network,
        cameras=(camera,),
        image_points=replace(
            table, xy_mm=measured + noise, sigma_mm=np.full(measured.shape, sigma_mm)
        ),
    ), simulated.points


@pytest.mark.parametrize(("model", "interior"), [("opencv", BROWN), ("fisheye", FISHEYE)])
def test_a_block_estimates_what_opencv_distorted_with(model, interior) -> None:
    interior = interior * PLAIN
    network, points = _block(model, interior, 1e-3)
    result = adjust(network)
    assert result.sigma0 == pytest.approx(1.0, abs=0.1)
    columns = result.layout.interior[0]
    own = columns >= 0
    error = (result.state.interior[0] - interior)[own]
    covariance = result.sigma0**2 * result.cofactor[np.ix_(columns[own], columns[own])]
    low, high = chi2.ppf([0.0005, 0.9995], int(own.sum()))
    assert low < error @ np.linalg.solve(covariance, error) < high
    seen = ~result.left_out
    assert np.abs(result.state.points - points)[seen].max() < 1.0


def test_rows_of_a_fisheye_block_have_right_derivatives() -> None:
    network, points = _block("fisheye", FISHEYE * PLAIN, 1e-6)
    layout = layout_of(network, np.zeros(len(network.points.names), dtype=bool))
    state = replace(initial_values(network), interior=(FISHEYE * PLAIN)[None], points=points.copy())
    weight = np.ones(len(network.image_points.image))
    design = equations(network, layout, state, weight).reduced.toarray()
    none = np.zeros((len(layout.eliminated_points), 3))
    for column in [*layout.station[2], *layout.attitude[3], *layout.interior[0]]:
        if column < 0:
            continue
        size = float(np.abs(design[:, column]).max())
        dx = np.zeros(layout.columns)
        dx[column] = 1.0 / size
        up = equations(network, layout, apply_corrections(state, layout, dx, none), weight)
        down = equations(network, layout, apply_corrections(state, layout, -dx, none), weight)
        numeric = -(up.misclosure - down.misclosure) / (2.0 * dx[column])
        # Starting orientations leave misclosures, which the weights of the points multiply.
        assert np.abs(numeric - design[:, column]).max() / size < 0.02


def test_conversion_states_what_the_other_model_cannot_follow() -> None:
    half = (18.0, 12.0)
    brown = CameraModel("c", F_MM, 0.1, -0.2, model="opencv", interior=BROWN)
    there = converted_camera(brown, "centred", half)
    assert 1e-5 < there.rms_mm < there.largest_mm < 0.02
    back = converted_camera(there.camera, "opencv", half)
    assert back.camera.interior[3] == pytest.approx(BROWN[3], abs=0.01)
    same = converted_camera(brown, "opencv", half)
    assert same.largest_mm < 1e-7
    assert same.camera.interior == pytest.approx(BROWN, abs=1e-6)
    # Independent of the fit: both cameras see the same directions to the residual stated.
    at = np.array([[10.0, 5.0], [-15.0, 9.0], [3.0, -11.0]])
    seen = [
        ideal_mm(c, c.interior, np.zeros(0), at) / (c.f_mm - c.interior[2])
        for c in (brown, there.camera)
    ]
    assert np.abs(seen[0] - seen[1]).max() * F_MM < 1.2 * there.largest_mm
    fisheye = converted_camera(replace(brown, model="fisheye", interior=FISHEYE), "opencv", half)
    assert fisheye.largest_mm > there.largest_mm


def test_what_a_model_cannot_have_is_refused() -> None:
    network, _ = _block("fisheye", FISHEYE * PLAIN, 1e-3)
    camera = replace(network.cameras[0], free=frozenset({"p2"}))
    with pytest.raises(NetworkError, match="fisheye has no p2"):
        adjust(replace(network, cameras=(camera,)))
    folded = np.zeros(10)
    folded[3] = -0.9
    with pytest.raises(NetworkError, match="cannot be inverted"):
        ideal_mm(CameraModel("c", F_MM, model="opencv"), folded, np.zeros(0), np.array([[25.0, 0]]))

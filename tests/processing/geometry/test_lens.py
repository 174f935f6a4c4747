"""Heier et al. (2002), eq. 5.1: every sign by a number, and the way back."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from processing.geometry import lens
from processing.geometry.lens import ideal_from_measured, lens_correction, measured_from_ideal
from processing.rig import Lens, find_rig
from tests.processing import oracle

PLAIN = Lens(
    f_mm=100.0,
    f_ppm_per_k=0.0,
    f_number=5.6,
    serial="",
    dx0_mm=0.0,
    dy0_mm=0.0,
    df_mm=0.0,
    k1=0.0,
    k2=0.0,
    k3=0.0,
    p1=0.0,
    p2=0.0,
    b1=0.0,
    b2=0.0,
)
# At x = 3, y = 4: r2 = 25, r4 = 625, r6 = 15625.
AT = np.array([[3.0, 4.0]])


@pytest.mark.parametrize(
    ("parameter", "value", "expected"),
    [
        ("dx0_mm", 0.5, (0.5, 0.0)),
        ("dy0_mm", 0.5, (0.0, 0.5)),
        ("df_mm", 0.1, (0.003, 0.004)),  # -x/z df with z = -100
        ("k1", 1e-4, (0.0075, 0.01)),
        ("k2", 1e-6, (0.001875, 0.0025)),
        ("k3", 1e-8, (0.00046875, 0.000625)),
        ("p1", 1e-4, (0.0043, 0.0024)),  # r2 + 2x2 = 43, 2xy = 24
        ("p2", 1e-4, (0.0024, 0.0057)),  # 2xy = 24, r2 + 2y2 = 57
        ("b1", 1e-3, (0.003, 0.0)),
        ("b2", 1e-3, (0.004, 0.0)),
    ],
)
def test_each_parameter_of_the_ten_moves_a_point_as_equation_5_1_states(
    parameter: str, value: float, expected: tuple[float, float]
) -> None:
    changed = dataclasses.replace(PLAIN, **{parameter: value})
    assert lens_correction(changed, AT)[0] == pytest.approx(expected, abs=1e-15)
    assert ideal_from_measured(changed, AT)[0] == pytest.approx(
        (3.0 + expected[0], 4.0 + expected[1]), abs=1e-14
    )


def test_all_ten_together_agree_with_the_oracle_and_invert_to_a_tenth_of_a_picometre() -> None:
    every = dataclasses.replace(
        find_rig("ultracam-x").cone("G").lens,
        dx0_mm=0.01,
        dy0_mm=-0.02,
        df_mm=0.03,
        k3=1e-13,
        b1=1e-5,
        b2=-2e-5,
    )
    measured = np.random.default_rng(1).uniform(-16.0, 16.0, (500, 2))
    ideal = ideal_from_measured(every, measured)
    np.testing.assert_allclose(ideal, oracle.ideal_from_measured(every, measured), atol=1e-12)
    np.testing.assert_allclose(measured_from_ideal(every, ideal), measured, atol=1e-10)


def test_a_point_beyond_the_fold_of_the_polynomial_has_no_measured_place() -> None:
    every = dataclasses.replace(PLAIN, k1=-1e-3)
    # x - x^3 / 1000 never exceeds 12.2 mm.
    found = measured_from_ideal(every, np.array([[5.0, 0.0], [40.0, 0.0]]))
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1]).all()


STRONG = dataclasses.replace(
    PLAIN,
    dx0_mm=0.02,
    dy0_mm=-0.03,
    df_mm=1.5,
    k1=2e-4,
    k2=-3e-7,
    k3=4e-9,
    p1=3e-4,
    p2=-2e-4,
    b1=2e-3,
    b2=-3e-3,
)


def test_the_derivatives_of_the_correction_agree_with_numeric_differences() -> None:
    points = np.array([[3.0, 4.0], [-6.0, 2.0], [5.0, -7.0], [-4.0, -3.0]])
    step = 1e-5
    numeric = np.empty((len(points), 4))
    for axis in range(2):
        off = np.eye(2)[axis] * step
        ahead = ideal_from_measured(STRONG, points + off)
        behind = ideal_from_measured(STRONG, points - off)
        numeric[:, axis], numeric[:, 2 + axis] = ((ahead - behind) / (2.0 * step)).T
    np.testing.assert_allclose(lens._jacobian(STRONG, points), numeric, rtol=0.0, atol=1e-8)


def test_the_inversion_converges_by_the_square_and_reaches_its_tolerance(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sheared = dataclasses.replace(STRONG, p1=0.01, p2=0.008, b1=0.1, b2=0.3)
    monkeypatch.setattr(lens, "_INVERSION_STEPS", 6)
    measured = np.random.default_rng(2).uniform(-4.0, 4.0, (200, 2))
    back = measured_from_ideal(sheared, ideal_from_measured(sheared, measured))
    assert np.abs(back - measured).max() < 2e-10


def test_only_points_that_have_no_measured_place_are_lost() -> None:
    folded = dataclasses.replace(PLAIN, k1=-1e-3)
    found = measured_from_ideal(folded, np.array([[0.0, 0.0], [0.0, 40.0], [0.0, -5.0]]))
    assert np.isnan(found).tolist() == [[False] * 2, [True] * 2, [False] * 2]
    y = float(found[2, 1])
    assert y - y**3 * 1e-3 == pytest.approx(-5.0, abs=1e-9)

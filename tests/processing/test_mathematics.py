"""The formulas of docs/explanation/mathematics, written again from the pages, against the code."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from processing.bundle.curvature_refraction import RayModel, corrected_rays, refraction_coefficient
from processing.geometry.drift import lag_step, physical_similarity
from processing.geometry.lens import ideal_from_measured
from processing.geometry.orientation import grid_from_camera
from processing.geometry.placement import (
    corrected_mm_from_raw,
    nominal_placements,
    vip_mm_from_raw,
)
from processing.geometry.projective import apply_projective
from processing.geometry.rotation import (
    level_from_body,
    omega_phi_kappa,
    rotation_matrix,
    rotations_from_vectors,
)
from processing.geometry.virtual_camera import GroundPlane, offset_mm, vip_from_layer
from processing.image.kernels import cubic_weights, phase_corrected_weights
from processing.mosaic.datum import datum_constraints
from processing.mosaic.estimated_dc import expansion_rate
from processing.mosaic.model import build_model, placement_at, small_rotation_design, vip_and_design
from processing.mosaic.validity import ValiditySettings
from processing.rig import Lens, find_rig

Array = NDArray[np.float64]
ANGLE = st.floats(-1.4, 1.4)


@given(ANGLE, ANGLE, ANGLE)
def test_the_elements_of_the_rotation_matrix(omega: float, phi: float, kappa: float) -> None:
    so, co, sp, cp = math.sin(omega), math.cos(omega), math.sin(phi), math.cos(phi)
    sk, ck = math.sin(kappa), math.cos(kappa)
    page = [
        [cp * ck, -cp * sk, sp],
        [co * sk + so * sp * ck, co * ck - so * sp * sk, -so * cp],
        [so * sk - co * sp * ck, so * ck + co * sp * sk, co * cp],
    ]
    assert rotation_matrix(omega, phi, kappa) == pytest.approx(np.array(page), abs=1e-14)
    r = np.array(page)
    angles = math.atan2(-r[1, 2], r[2, 2]), math.asin(r[0, 2]), math.atan2(-r[0, 1], r[0, 0])
    assert omega_phi_kappa(r) == pytest.approx(angles, abs=1e-12)


def test_a_small_rotation_moves_an_image_point_as_the_matrix_of_the_page() -> None:
    x, y, f = 12.0, -7.0, 100.0
    page = np.array([[x * y / f, -f - x * x / f, -y], [f + y * y / f, -x * y / f, x]])
    assert small_rotation_design(np.array([[x, y]]), f)[:, :, 0] == pytest.approx(page)
    w = np.array([2e-6, -3e-6, 1e-6])
    ray = rotations_from_vectors(w) @ np.array([x, y, -f])
    moved = -f * ray[:2] / ray[2] - np.array([x, y])
    assert moved == pytest.approx(page @ w, abs=1e-9)


def test_the_chain_from_roll_pitch_heading_to_the_grid() -> None:
    t = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    alpha = 0.03
    c, s = math.cos(alpha), math.sin(alpha)
    grid = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    level, boresight = level_from_body(0.1, -0.05, 2.0), level_from_body(0.002, 0.001, -0.003)
    cone = rotation_matrix(0.2, -0.1, 0.4)
    found = grid_from_camera(
        level_from_imu=level,
        imu_from_body=boresight,
        body_from_camera=t @ cone,
        azimuth_of_north_rad=alpha,
    )
    assert found == pytest.approx(grid @ t @ level @ boresight @ t @ cone, abs=1e-14)


def test_the_ten_parameters_term_by_term() -> None:
    lens = Lens(
        f_mm=100.0, f_ppm_per_k=0.0, f_number=5.6, serial="", dx0_mm=0.01, dy0_mm=-0.02,
        df_mm=0.05, k1=2e-7, k2=-3e-11, k3=4e-15, p1=1e-6, p2=-2e-6, b1=1e-5, b2=-2e-5,
    )  # fmt: skip
    x, y = 21.0, -13.0
    r2 = x * x + y * y
    radial = r2 * lens.k1 + r2**2 * lens.k2 + r2**3 * lens.k3
    dx = (
        lens.dx0_mm + x * lens.df_mm / lens.f_mm + x * radial + (r2 + 2 * x * x) * lens.p1
        + 2 * x * y * lens.p2 + x * lens.b1 + y * lens.b2
    )  # fmt: skip
    dy = (
        lens.dy0_mm + y * lens.df_mm / lens.f_mm + y * radial + 2 * x * y * lens.p1
        + (r2 + 2 * y * y) * lens.p2
    )  # fmt: skip
    found = ideal_from_measured(lens, np.array([[x, y]]))[0]
    assert found == pytest.approx([x + dx, y + dy], abs=1e-12)


def test_drift_and_lag() -> None:
    sensor = find_rig("ultracam-x-mini").sensor("SU00")
    drift, dc = sensor.drift, 7.0
    found = physical_similarity(sensor, dc)
    assert found.x_mm == pytest.approx(sensor.x_mm + drift.x_um_per_k * 1e-3 * dc)
    assert found.scale == pytest.approx(sensor.scale * (1 + drift.scale_ppm_per_k * 1e-6 * dc))
    x0, x1, y0, step, tau = 10.0, 13.0, 8.0, 20.0, 45.0
    b = (x1 - x0) / step * tau
    page = x1 - b + (y0 - x0 + b) * math.exp(-step / tau)
    assert lag_step(y0, x0, x1, step, tau) == pytest.approx(page)
    y, n = y0, 20000
    for k in range(n):
        y += (x0 + (x1 - x0) * (k + 0.5) / n - y) / tau * step / n
    assert page == pytest.approx(y, abs=1e-3)


def test_the_rate_of_expansion_against_the_sensors() -> None:
    sensors = find_rig("ultracam-x-mini").master_sensors
    q = np.array([(s.x_mm, s.y_mm) for s in sensors])
    q = q - q.mean(axis=0)
    lever = q / np.sum(q**2)
    a = np.array([(s.drift.x_um_per_k, s.drift.y_um_per_k) for s in sensors]) * 1e-3
    page = np.sum(lever * a) * 1e6 - np.mean([s.drift.scale_ppm_per_k for s in sensors])
    assert expansion_rate(sensors)[0] == pytest.approx(page)


def test_derivatives_of_sensor_and_layer() -> None:
    rig = find_rig("ultracam-x-mini")
    start = nominal_placements(rig, {}, {})
    name = rig.cones[1].sensors[0].name
    cone = rig.cone_of(name).name
    model = build_model(rig, start, free_sensors=[name], free_layers=[cone])
    values = np.random.default_rng(1).normal(size=len(model.names)) * model.units * 50
    raw = np.array([[10.0, 20.0], [900.0, 700.0]])
    corrected = corrected_mm_from_raw(start[name], raw)
    place, columns, design = vip_and_design(model, start[name], corrected, values)

    def at(v: Array) -> Array:
        return vip_mm_from_raw(placement_at(model, start[name], v), raw) / model.pitch_mm

    assert place == pytest.approx(at(values), abs=1e-9)
    for column, derivative in zip(columns, design, strict=True):
        step = np.zeros(len(values))
        step[column] = model.units[column]
        slope = (at(values + step) - at(values - step)) / (2 * model.units[column])
        assert derivative.T * model.units[column] == pytest.approx(
            slope * model.units[column], abs=2e-6
        ), model.names[column]


def test_inner_constraints_over_four_sensors() -> None:
    rig = find_rig("ultracam-x-mini")
    start = nominal_placements(rig, {}, {})
    names = [s.name for s in rig.master_sensors]
    q = np.array([(start[n].similarity.x_mm, start[n].similarity.y_mm) for n in names])
    q = q - q.mean(axis=0)
    page: list[dict[str, float]] = [{}, {}, {}, {}]
    for n, (x, y) in zip(names, q, strict=True):
        page[0][f"{n}.x"] = page[1][f"{n}.y"] = 1.0
        page[2] |= {f"{n}.x": x, f"{n}.y": y}
        page[3] |= {f"{n}.x": -y, f"{n}.y": x}
    for found, expected in zip(datum_constraints(start, names), page, strict=True):
        assert dict(found.coefficients) == pytest.approx(expected)


def test_one_of_four_displaced_sensors_shows_half_and_shifts_a_quarter() -> None:
    q = np.array([(-1.0, 1.0), (1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)])
    design = np.zeros((8, 4))
    design[0::2, 0], design[1::2, 1] = 1.0, 1.0
    design[0::2, 2], design[1::2, 2] = q[:, 0], q[:, 1]
    design[0::2, 3], design[1::2, 3] = -q[:, 1], q[:, 0]
    displaced = np.zeros(8)
    displaced[2] = 1.0
    fit = np.linalg.lstsq(design, displaced, rcond=None)[0]
    assert fit[0] == pytest.approx(0.25)
    assert (displaced - design @ fit)[2] == pytest.approx(0.5)


def test_a_ray_over_the_ground_plane() -> None:
    rig = find_rig("dmc-mini")
    cone, image = rig.pan_cones[0], rig.virtual_image
    assert image is not None
    roll, pitch, h = 0.03, -0.02, 800.0
    u = np.array(
        [-math.cos(pitch) * math.sin(roll), math.sin(pitch), math.cos(pitch) * math.cos(roll)]
    )
    c = offset_mm(rig, cone) * 1e-3
    xy = np.array([[5.0, -3.0], [0.0, 0.0]])
    found = apply_projective(vip_from_layer(rig, cone, GroundPlane(h, tuple(u))), xy)
    for (x, y), seen in zip(xy, found, strict=True):
        ray = rotation_matrix(*cone.rotation_rad) @ np.array([x, y, -cone.lens.f_mm])
        ground = c + ray * (-(h + u @ c) / (u @ ray))
        assert u @ ground == pytest.approx(-h)
        assert seen == pytest.approx(-image.f_mm * ground[:2] / ground[2], abs=1e-9)


def test_curvature_and_refraction() -> None:
    ray, height, radius = np.array([[300.0, -400.0, -1500.0]]), 1700.0, 6_371_000.0
    wider = 1 + (height + ray[0, 2]) / radius
    e, n, z = 300.0 * wider, -400.0 * wider, -1500.0 - (300.0**2 + 400.0**2) / (2 * radius)
    hk, gk = 1.7, 0.2
    k = 2410e-6 * (hk / (hk**2 - 6 * hk + 250) - gk / (gk**2 - 6 * gk + 250) * gk / hk)
    assert float(refraction_coefficient(np.array(height), 200.0)) == pytest.approx(k)
    out = 1 + k * (1 + (e * e + n * n) / z**2)
    found = corrected_rays(
        ray, np.array([height]), RayModel(radius, refraction=True, ground_m=200.0)
    )[0][0]
    assert found == pytest.approx([e * out, n * out, z], abs=1e-9)


@pytest.mark.parametrize("phase", [0.1, 0.37, 0.5, 0.93])
def test_the_phase_error_of_the_kernel_is_below_what_its_page_states(phase: float) -> None:
    taps, nu = np.arange(-2, 4), np.linspace(0.01, 0.352, 200)

    def error_px(weights: Array) -> float:
        h = np.exp(2j * np.pi * np.outer(nu, taps - phase)) @ weights
        return float(np.abs(np.angle(h) / (2 * np.pi * nu)).max())

    own = phase_corrected_weights(np.array([phase]))[0]
    mirrored = phase_corrected_weights(np.array([1.0 - phase]))[0]
    assert own == pytest.approx(mirrored[::-1], abs=1e-12) and own.sum() == pytest.approx(1.0)
    assert error_px(own) <= 0.0034
    if phase != 0.5:
        assert error_px(cubic_weights(np.array([phase]))[0]) > 0.01


def test_the_limits_of_the_pages_are_those_of_the_code() -> None:
    settings = ValiditySettings()
    assert settings.family_alpha == 0.001 and settings.odds_limit == 19.0
    assert (
        settings.prior_sigmas.probe_sigma_k == 0.1 and settings.prior_sigmas.unknown_sigma_k == 10.0
    )

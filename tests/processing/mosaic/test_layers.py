"""Changes of a layer planted as homographies come back in ppm and urad, with hand-made sigmas."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from processing.geometry.projective import rotation_homography
from processing.geometry.rotation import rotation_matrix
from processing.geometry.similarity import fit_similarity
from processing.mosaic.free_mosaic import Mosaic
from processing.mosaic.layers import LayerChange, LayerCheck, check_layers, layer_figures
from processing.quality.figures import QualityFigures
from processing.rig import Cone, Rig
from tests.processing.mosaic.test_precision import mosaic_of

Array = NDArray[np.float64]
PAN = ("1", "2", "3")
ALL = (*PAN, "G")


def planted(name: str, changes: dict[str, Array]) -> tuple[Rig, Mosaic]:
    """A mosaic without noise whose layers were scaled (ppm) and rotated (urad)."""
    rig, mosaic = mosaic_of(name)
    model = mosaic.model
    f, half = model.f_mm, model.half_size_mm
    values = np.zeros(len(model.names))
    for cone, (scale, *angles) in changes.items():
        homography = rotation_homography(rotation_matrix(*np.array(angles) * 1e-6), f, f)
        homography = homography @ np.diag([1.0 + scale * 1e-6, 1.0 + scale * 1e-6, 1.0])
        norm = np.diag([1.0 / half, 1.0 / half, 1.0])
        p = norm @ homography @ np.linalg.inv(norm)
        values[model.layers[cone] : model.layers[cone] + 8] = (p / p[2, 2] - np.eye(3)).ravel()[:8]
    covariance = np.zeros((len(values), len(values)))
    return rig, dataclasses.replace(mosaic, values=values, covariance=covariance, undetermined=())


def read(rig: Rig) -> dict[str, float]:
    return {s.probe: s.calibration_c for s in rig.sensors} | {
        c.probe: c.calibration_c for c in rig.cones
    }


def known(cone: Cone, *, dc: float, off_k: float) -> Array:
    """Variances (4,) of scale, two rotations of the ray, and the rotation about it."""
    sensors = cone.sensors
    sigma = np.array([np.hypot(s.position_sigma_um, s.drift.sigma_um_per_k * dc) for s in sensors])
    mean = float(np.sqrt(np.mean(sigma**2))) * 1e-3
    place = np.array([[s.x_mm, s.y_mm] for s in sensors])
    if len(sensors) == 1:
        # Half its height from its middle as well as the middle itself, relative to each other.
        half_mm = sensors[0].height_px / 2.0 * sensors[0].pitch_mm
        size, growth = mean / half_mm, sensors[0].drift.scale_ppm_per_k
    else:
        parts = []
        for i in range(len(sensors)):
            moved = place.copy()
            moved[i, 0] += mean
            fit = fit_similarity(place, moved)
            parts.append([fit.scale - 1.0, fit.rotation_rad])
        # Displacements in x and in y change scale and rotation with each other's lever arms.
        size = float(np.sqrt(np.sum(np.square(parts))))
        drift = np.array([[s.drift.x_um_per_k, s.drift.y_um_per_k] for s in sensors])
        growth = (fit_similarity(place, place + drift * 1e-6).scale - 1.0) * 1e9
    warmed = (growth - cone.lens.f_ppm_per_k) * off_k
    shift = mean / np.sqrt(len(sensors)) / cone.lens.f_mm
    scale = (size * 1e6) ** 2 + cone.lens.f_sigma_ppm**2 + warmed**2
    return np.array([scale, (shift * 1e6) ** 2, (shift * 1e6) ** 2, (size * 1e6) ** 2])


@pytest.mark.parametrize("change", [(80.0, 0.0, 0.0, 0.0), (-30.0, 70.0, -50.0, 120.0)])
def test_a_planted_change_of_a_layer_is_measured(change: tuple[float, ...]) -> None:
    rig, mosaic = planted("ultracam-x-mini", {"1": np.array(change)})
    check = check_layers(rig, mosaic, read(rig))
    assert check is not None and check.master == "0"
    assert tuple(layer.cone for layer in check.layers) == ALL
    f_px = mosaic.model.f_mm / mosaic.model.pitch_mm
    for layer in check.layers:
        expected = change if layer.cone == "1" else (0.0,) * 4
        np.testing.assert_allclose(layer.values, expected, atol=0.3)
        shift = np.hypot(layer.values[1], layer.values[2]) * 1e-6 * f_px
        assert layer.shift_px == pytest.approx(shift)


@pytest.mark.parametrize(
    ("dc", "measured", "off_k"), [(6.0, "all", 0.1), (0.0, "red", 2.0), (0.0, "none", 15.0)]
)
def test_layers_are_known_as_well_as_sensors_lenses_mountings_and_probes(
    dc: float, measured: str, off_k: float
) -> None:
    rig, mosaic = planted("ultracam-x-mini", {})
    temperatures = {
        "all": {p: c + dc for p, c in read(rig).items()},
        "red": {rig.cone("R").probe: 20.0},
        "none": {},
    }[measured]
    check = check_layers(rig, mosaic, temperatures, parallax_px=0.5)
    assert check is not None
    model = mosaic.model
    half_px, f_px = model.half_size_mm / model.pitch_mm, model.f_mm / model.pitch_mm
    relief = np.array([0.5e6 / half_px, *[0.5e6 / f_px] * 3]) ** 2
    master = known(rig.cone("0"), dc=dc, off_k=off_k)
    for layer in check.layers:
        cone = rig.cone(layer.cone)
        mounting = np.array([0.0, *[cone.rotation_sigma_urad] * 3]) ** 2
        expected = known(cone, dc=dc, off_k=off_k) + mounting + relief + master
        np.testing.assert_allclose(layer.sigmas**2, expected, rtol=1e-4)


def statistic_of(rig: Rig, mosaic: Mosaic, change: Array, cones: tuple[str, ...]) -> float:
    """Chi-square of a change shared by some cones, by inverting what it may be expected as."""
    temperatures = read(rig)
    check = check_layers(rig, mosaic, temperatures)
    assert check is not None
    master = known(rig.cone("0"), dc=0.0, off_k=0.1)
    total = 0.0
    for k in range(4):
        own = np.array([layer.sigmas[k] ** 2 for layer in check.layers]) - master[k]
        covariance = np.diag(own) + master[k]
        values = np.array([change[k] if name in cones else 0.0 for name in ALL])
        total += float(values @ np.linalg.solve(covariance, values))
    return total


@pytest.mark.parametrize(
    ("cones", "cause"), [(("2",), "2"), (("3",), "3"), (ALL, "0"), (("G",), "G")]
)
def test_the_one_cone_that_changed_is_the_cause_and_a_common_change_the_masters(
    cones: tuple[str, ...], cause: str
) -> None:
    change = np.array([400.0, 300.0, -500.0, 600.0])
    rig, mosaic = planted("ultracam-x-mini", dict.fromkeys(cones, change))
    check = check_layers(rig, mosaic, read(rig))
    assert check is not None and check.changed
    assert check.causes == (cause,)
    assert check.master_changed == (cause == "0")
    # One cause explains all of it: nothing is left.
    assert check.statistic == pytest.approx(statistic_of(rig, mosaic, change, cones), rel=0.02)
    assert check.limit == pytest.approx(chi2.isf(1e-5 / 5, 4))
    if cause == "0":
        np.testing.assert_allclose(check.common, change, atol=1.0)


@pytest.mark.parametrize(("chi_square", "alternatives"), [(5.7, ("0",)), (6.1, ())])
def test_what_is_less_than_19_times_less_likely_is_an_alternative(
    chi_square: float, alternatives: tuple[str, ...]
) -> None:
    """2 ln 19 is 5.89: by so much the master's change may explain the misfit worse."""
    rig, mosaic = planted("ultracam-l-mini", {"1": np.array([0.0, 0.0, 0.0, 9000.0])})
    loose = dataclasses.replace(rig.cone("RGB"), rotation_sigma_urad=9000.0 / chi_square**0.5)
    rig = dataclasses.replace(rig, cones=tuple(loose if c.name == "RGB" else c for c in rig.cones))
    check = check_layers(rig, mosaic, read(rig))
    assert check is not None and check.causes == ("1",)
    assert check.alternatives == alternatives
    assert check.master_changed == bool(alternatives)


def test_two_changed_cones_are_both_named() -> None:
    change = np.array([0.0, 600.0, -900.0, 300.0])
    rig, mosaic = planted("ultracam-x-mini", {"1": change, "3": -change})
    check = check_layers(rig, mosaic, read(rig))
    assert check is not None and set(check.causes) == {"1", "3"}
    assert not check.master_changed


@pytest.mark.parametrize(
    ("turned_urad", "chi_square", "likely"),
    [(2000.0, 12.9, False), (2000.0, 13.6, True), (0.0, 13.6, False)],
)
def test_what_one_changed_cone_leaves_may_show_that_several_are(
    turned_urad: float, chi_square: float, likely: bool
) -> None:
    """The 99th percentile of chi-square with four degrees of freedom is 13.28."""
    rig, healthy = planted("ultracam-l-mini", {})
    check = check_layers(rig, healthy, read(rig))
    assert check is not None and not check.several_likely
    sigma = next(layer for layer in check.layers if layer.cone == "1").sigmas[2]
    turned = np.array([0.0, 0.0, sigma * np.sqrt(chi_square), 0.0])
    changes = {"1": turned, "RGB": np.array([0.0, turned_urad, 0.0, 0.0])}
    check = check_layers(*planted("ultracam-l-mini", changes), read(rig))
    assert check is not None and check.changed == bool(turned_urad)
    assert check.several_likely == likely


def test_the_common_change_is_the_weighted_mean_of_all_layers() -> None:
    rig, mosaic = planted("ultracam-x-mini", {"1": np.array([10.0, 0.0, 0.0, 0.0])})
    check = check_layers(rig, mosaic, read(rig))
    assert check is not None and not check.changed
    assert check.causes == check.alternatives == ()
    master = known(rig.cone("0"), dc=0.0, off_k=0.1)
    for k in range(4):
        own = np.array([layer.sigmas[k] ** 2 for layer in check.layers]) - master[k]
        weight = 1.0 / own
        mean = weight @ [layer.values[k] for layer in check.layers] / weight.sum()
        assert check.common[k] == pytest.approx(mean, rel=1e-6, abs=1e-9)
        sigma = np.sqrt(1.0 / weight.sum() + master[k])
        assert check.common_sigmas[k] == pytest.approx(sigma, rel=1e-6)


def test_layers_that_tie_points_leave_open_are_not_compared() -> None:
    rig, mosaic = planted("ultracam-x-mini", {})
    some = dataclasses.replace(mosaic, undetermined=("2.p11", "G.p31", "SU00.x"))
    check = check_layers(rig, some, {})
    assert check is not None and tuple(layer.cone for layer in check.layers) == ("1", "3")
    none = dataclasses.replace(mosaic, undetermined=tuple(f"{name}.p11" for name in ALL))
    assert check_layers(rig, none, {}) is None
    assert check_layers(rig, dataclasses.replace(mosaic, redundancy=0.0), {}) is None
    assert check_layers(rig, dataclasses.replace(mosaic, redundancy=1.0), {}) is not None
    assert check_layers(*mosaic_of("dmc-mini"), {}) is None


def check_of(
    causes: tuple[str, ...], alternatives: tuple[str, ...], statistic: float
) -> LayerCheck:
    layers = (
        LayerChange("1", np.zeros(4), np.ones(4), 0.3),
        LayerChange("2", np.zeros(4), np.ones(4), 0.7),
    )
    common, sigmas = np.array([12.0, 1.0, 2.0, 3.0]), np.array([5.0, 6.0, 7.0, 8.0])
    return LayerCheck("0", layers, statistic, 8.0, common, sigmas, causes, alternatives)


def test_figures_of_the_check_are_of_the_layer_that_moved_farthest() -> None:
    assert QualityFigures(*layer_figures(check_of(("2", "1"), ("0",), 20.0))).as_json() == {
        "platform_test": 2.5,
        "platform_shift_px": 0.7,
        "platform_shift_head": "2",
        "platform_causes": "2, 1",
        "platform_alternatives": "0",
        "platform_master_changed": 1,
        "common_scale_ppm": 12.0,
        "common_scale_sigma_ppm": 5.0,
    }
    healthy = check_of((), (), 8.0)
    assert not healthy.changed and check_of((), (), 8.01).changed
    figures = QualityFigures(*layer_figures(healthy)).as_json()
    assert figures["platform_causes"] is None and figures["platform_alternatives"] is None
    assert figures["platform_master_changed"] == 0
    assert layer_figures(None) == ()

"""The stated accuracy against fits to displaced places, and against placements a kelvin warmer."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.geometry.placement import nominal_placements, vip_mm_from_raw
from processing.geometry.similarity import fit_similarity
from processing.mosaic.datum import datum_candidates
from processing.mosaic.free_mosaic import Mosaic, free_mosaic, vip_precision_px
from processing.mosaic.precision import (
    UncertaintyContribution,
    datum_covariance,
    datum_design,
    datum_per_kelvin_px,
    moved_datum_design,
    placed_covariance_px,
    placed_sigma_px,
    precision_figures,
)
from processing.rig import Cone, Rig, Sensor, find_rig
from tests.processing.synthetic import make_truth, no_tie_points, tie_points_of

Array = NDArray[np.float64]
NO_READING: dict[str, float] = {}


def uneven(rig: Rig) -> Rig:
    """The rig with sensors and lenses of which no two are alike."""

    def sensor(s: Sensor, k: int) -> Sensor:
        drift = dataclasses.replace(
            s.drift,
            x_um_per_k=0.03 + 0.011 * k,
            y_um_per_k=-0.05 + 0.017 * k * k,
            sigma_um_per_k=0.02 + 0.01 * k,
            scale_ppm_per_k=2.6 + 0.2 * k,
            rotation_urad_per_k=3.0 - k,
        )
        return dataclasses.replace(s, position_sigma_um=0.5 + 0.4 * k, drift=drift)

    def cone(c: Cone, n: int) -> Cone:
        sensors = tuple(sensor(s, k + n) for k, s in enumerate(c.sensors))
        return dataclasses.replace(
            c, sensors=sensors, lens=dataclasses.replace(c.lens, f_ppm_per_k=7.0 + n)
        )

    return dataclasses.replace(rig, cones=tuple(cone(c, n) for n, c in enumerate(rig.cones)))


@functools.cache
def mosaic_of(name: str) -> tuple[Rig, Mosaic]:
    rig = uneven(find_rig(name))
    rng = np.random.default_rng(3)
    truth = make_truth(rig, rng, sensor_px=0.2, layer_px=0.5)
    points = tie_points_of(truth, rng, per_overlap=30, per_sensor=60)
    return rig, free_mosaic(rig, truth.start, points)


def fitted_px(place_mm: Array, moved_um: Array, pitch_mm: float) -> Array:
    """Shift, scale and rotation of the similarity that fits displaced places, per um."""
    step = 1e-3
    fit = fit_similarity(place_mm, place_mm + step * 1e-3 * moved_um)
    datum = np.array([fit.x_mm, fit.y_mm, fit.scale - 1.0, fit.rotation_rad])
    return datum / step / pitch_mm


def expected_covariance(rig: Rig, mosaic: Mosaic, read: dict[str, float], off_k: float) -> Array:
    """The sum over all independent errors of what a fit to the displaced places makes of each."""
    sensors = [s for s in datum_candidates(rig) if s.name in mosaic.datum_sensors]
    pitch = mosaic.model.pitch_mm
    place = np.array([[s.x_mm, s.y_mm] for s in sensors])
    if rig.master_cone is None:
        middles = [np.array([[s.width_px - 1, s.height_px - 1]]) / 2 for s in sensors]
        place = np.concatenate(
            [
                vip_mm_from_raw(mosaic.start[s.name], at)
                for s, at in zip(sensors, middles, strict=True)
            ]
        )
    total = np.zeros((4, 4))
    for i, s in enumerate(sensors):
        dc = read[s.probe] - s.calibration_c if s.probe in read else 0.0
        sigma = np.hypot(s.position_sigma_um, s.drift.sigma_um_per_k * dc)
        for axis in range(2):
            moved = np.zeros_like(place)
            moved[i, axis] = sigma
            total += np.outer(*[fitted_px(place, moved, pitch)] * 2)
    for probe in {s.probe for s in sensors} | {rig.cone_of(s.name).probe for s in sensors}:
        moved = np.zeros_like(place)
        for i, s in enumerate(sensors):
            cone = rig.cone_of(s.name)
            moved[i] += np.array([s.drift.x_um_per_k, s.drift.y_um_per_k]) * (s.probe == probe)
            moved[i] -= cone.lens.f_ppm_per_k * 1e-3 * place[i] * (cone.probe == probe)
        off = 0.1 if probe in read else off_k
        total += np.outer(*[fitted_px(place, moved * off, pitch)] * 2)
    return total


@pytest.mark.parametrize(
    ("read_k", "others_read", "off_k"), [(12.0, True, 0.1), (None, True, 2.0), (None, False, 15.0)]
)
def test_the_datum_is_as_uncertain_as_the_places_it_is_fitted_to(
    read_k: float | None, others_read: bool, off_k: float
) -> None:
    rig, mosaic = mosaic_of("ultracam-x-mini")
    own = rig.cone(rig.master_cone or "")
    read = {p: 31.0 for p in rig.probes if p != own.probe} if others_read else {}
    if read_k is not None:
        read[own.probe] = own.calibration_c + read_k
    found = datum_covariance(rig, mosaic, read)
    np.testing.assert_allclose(
        found, expected_covariance(rig, mosaic, read, off_k), rtol=1e-4, atol=1e-9
    )


def test_the_datum_rests_on_the_sensors_that_are_left_in_it() -> None:
    rig, mosaic = mosaic_of("ultracam-x-mini")
    three = dataclasses.replace(mosaic, datum_sensors=("SU00", "SU01", "SU03"))
    found = datum_covariance(rig, three, NO_READING)
    expected = expected_covariance(rig, three, NO_READING, 15.0)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-9)


def test_the_datum_of_converging_heads_rests_on_where_their_middles_lie() -> None:
    rig, mosaic = mosaic_of("dmc-mini")
    still = tuple(dataclasses.replace(c, rotation_sigma_urad=0.0) for c in rig.cones)
    rig = dataclasses.replace(rig, cones=still)
    found = datum_covariance(rig, mosaic, NO_READING)
    expected = expected_covariance(rig, mosaic, NO_READING, 15.0)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("name", ["ultracam-x-mini", "ultracam-l-mini"])
def test_a_kelvin_moves_the_datum_as_it_moves_calibrated_placements(name: str) -> None:
    """Centres of several sensors; of one alone its centre and the middle of its upper side."""
    rig, mosaic = mosaic_of(name)
    sensors = rig.master_sensors
    places = []
    for off_k in (-5.0, 0.0, 5.0):
        read = {p: c + off_k for p, c in {s.probe: s.calibration_c for s in rig.sensors}.items()}
        placed = nominal_placements(rig, read, {})
        xy = []
        for s in sensors:
            at = [[(s.width_px - 1) / 2, (s.height_px - 1) / 2]]
            if len(sensors) == 1:
                at.append([(s.width_px - 1) / 2, -0.5])
            xy.append(vip_mm_from_raw(placed[s.name], np.array(at)))
        places.append(np.concatenate(xy))
    warm = fit_similarity(places[1], places[2])
    cold = fit_similarity(places[1], places[0])
    per_k = np.array(
        [
            warm.x_mm - cold.x_mm,
            warm.y_mm - cold.y_mm,
            warm.scale - cold.scale,
            warm.rotation_rad - cold.rotation_rad,
        ]
    )
    per_k /= 10.0 * mosaic.model.pitch_mm
    found = datum_per_kelvin_px(rig, mosaic)
    np.testing.assert_allclose(found, per_k, rtol=0.02, atol=2e-5)


def test_one_sensor_alone_knows_scale_and_rotation_by_its_half_height() -> None:
    rig, mosaic = mosaic_of("ultracam-l-mini")
    (sensor,) = rig.master_sensors
    read = dict.fromkeys(rig.probes, sensor.calibration_c)
    still = dataclasses.replace(
        sensor, drift=dataclasses.replace(sensor.drift, x_um_per_k=0.0, y_um_per_k=0.0)
    )
    master = rig.cone_of(sensor.name)
    lens = dataclasses.replace(master.lens, f_ppm_per_k=0.0)
    cones = tuple(
        dataclasses.replace(c, sensors=(still,), lens=lens) if c.name == master.name else c
        for c in rig.cones
    )
    found = datum_covariance(dataclasses.replace(rig, cones=cones), mosaic, read)
    half_mm = sensor.height_px / 2.0 * sensor.pitch_mm
    # Scale and rotation move a place half the height away by the sigma of the first.
    warm = (0.1 * sensor.drift.scale_ppm_per_k * 1e-3) ** 2
    rotated = (0.1 * sensor.drift.rotation_urad_per_k * 1e-3) ** 2
    own = (sensor.position_sigma_um / half_mm) ** 2
    assert found[2, 2] * sensor.pitch_um**2 == pytest.approx(own + warm, rel=1e-6)
    assert found[3, 3] * sensor.pitch_um**2 == pytest.approx(own + rotated, rel=1e-6)
    # Above and below the middle alike, and the middle as sure as the sensor's place.
    moved = own + (warm + rotated) / 2.0
    for up_mm in (0.0, half_mm, -half_mm):
        design = datum_design(np.array([[sensor.x_mm, sensor.y_mm + up_mm]]))
        variance_um2 = np.trace(design @ found @ design.T) / 2.0 * sensor.pitch_um**2
        expected = sensor.position_sigma_um**2 + moved * up_mm**2
        assert variance_um2 == pytest.approx(expected, rel=1e-6)


def test_of_converging_heads_the_mean_rotation_places_the_image() -> None:
    rig = find_rig("dmc-mini")
    assert rig.master_cone is None
    mosaic = free_mosaic(rig, nominal_placements(rig, {}, {}), no_tie_points(rig))

    def covariance(sigma_urad: Callable[[int], float]) -> Array:
        cones = [
            dataclasses.replace(c, rotation_sigma_urad=sigma_urad(n))
            for n, c in enumerate(rig.cones)
        ]
        return datum_covariance(dataclasses.replace(rig, cones=tuple(cones)), mosaic, NO_READING)

    own = [rig.cones.index(c) + 10.0 for c in rig.pan_cones]
    added = covariance(lambda n: n + 10.0) - covariance(lambda n: 0.0)
    variance = sum(s**2 for s in own) / len(own) ** 2 * 1e-12
    f_px = mosaic.model.f_mm / mosaic.model.pitch_mm
    expected = [f_px**2, f_px**2, 0.0, 1.0 / mosaic.model.pitch_mm**2]
    np.testing.assert_allclose(added, np.diag(expected) * variance, rtol=1e-6, atol=1e-12)


def test_the_datum_design_is_the_derivative_of_a_similarity() -> None:
    xy = np.array([[3.0, -2.0], [-7.0, 5.0]])
    shift = np.array([1e-3, -2e-3])
    scale, rotation = 3e-6, -4e-6
    rotated = xy + shift + scale * xy + rotation * np.column_stack([-xy[:, 1], xy[:, 0]])
    moved = datum_design(xy) @ np.array([*shift, scale, rotation])
    np.testing.assert_allclose(moved, (rotated - xy).ravel(), rtol=1e-9)


def test_of_converging_heads_the_datum_is_a_rotation_of_the_virtual_camera() -> None:
    rig = find_rig("dmc-mini")
    mosaic = free_mosaic(rig, nominal_placements(rig, {}, {}), no_tie_points(rig))
    f = mosaic.model.f_mm
    xy = np.array([[19.0, -10.0], [-15.0, 8.0]])
    by_x, by_y, by_z = 3e-5, -2e-5, 1e-5
    rays = np.column_stack([xy, [-f, -f]])
    rotated = rays + np.cross([by_x, by_y, by_z], rays)
    expected = rotated[:, :2] * (-f / rotated[:, 2:]) - xy
    datum = np.array([-f * by_y, f * by_x, 0.0, by_z])
    moved = moved_datum_design(rig, mosaic, xy) @ datum
    np.testing.assert_allclose(moved, expected.ravel(), rtol=1e-3)
    master, placed = mosaic_of("ultracam-x-mini")
    np.testing.assert_array_equal(moved_datum_design(master, placed, xy), datum_design(xy))


def test_findings_add_their_variance_to_the_placed_pixels() -> None:
    rig, mosaic = mosaic_of("ultracam-x-mini")
    at = np.array([[100.0, 700.0], [1200.0, 30.0]])
    x, y = vip_mm_from_raw(mosaic.placements["SU10"], at).T
    plain = placed_sigma_px(rig, mosaic, "SU10", at, datum_covariance(rig, mosaic, NO_READING)) ** 2
    datum = np.diag([0.3**2, 0.7**2, 0.02**2, 0.05**2])
    found = UncertaintyContribution(
        datum, {"SU10": np.array([4.0, 9.0]), "SU11": np.array([100.0, 100.0])}
    )
    more = (
        placed_sigma_px(rig, mosaic, "SU10", at, datum_covariance(rig, mosaic, NO_READING), found)
        ** 2
        - plain
    )
    expected_x = 0.3**2 + (0.02 * x) ** 2 + (0.05 * y) ** 2 + 4.0
    expected_y = 0.7**2 + (0.02 * y) ** 2 + (0.05 * x) ** 2 + 9.0
    np.testing.assert_allclose(more, np.column_stack([expected_x, expected_y]), rtol=1e-9)


@pytest.mark.parametrize(
    ("undetermined", "sigma0", "supported", "factor"),
    [
        (("SU10.x",), 0.25, False, 4.0),
        (("1.p31",), 0.25, False, 4.0),
        (("SU10.x",), 0.0, False, 1e6),
        (("SU10.x",), 2.0, False, 1.0),
        (("SU10.x",), 0.25, True, 1.0),
        (("SU00.x", "2.p11"), 0.25, False, 1.0),
    ],
)
def test_what_tie_points_leave_open_counts_with_its_accuracy_before_the_adjustment(
    undetermined: tuple[str, ...], sigma0: float, supported: bool, factor: float
) -> None:
    rig, mosaic = mosaic_of("ultracam-x-mini")
    at = np.array([[100.0, 700.0], [1200.0, 30.0]])
    changed = dataclasses.replace(
        mosaic, undetermined=undetermined, sigma0=sigma0, supported=supported
    )
    tied = vip_precision_px(mosaic, "SU10", at) ** 2
    known = dataclasses.replace(mosaic, undetermined=())
    datum = (
        placed_sigma_px(rig, known, "SU10", at, datum_covariance(rig, known, NO_READING)) ** 2
        - tied
    )
    found = (
        placed_sigma_px(rig, changed, "SU10", at, datum_covariance(rig, changed, NO_READING)) ** 2
    )
    np.testing.assert_allclose(found, factor**2 * tied + datum, rtol=1e-9)


def test_the_covariance_of_places_holds_their_variances_and_what_they_share() -> None:
    rig, mosaic = mosaic_of("ultracam-x-mini")
    mosaic = dataclasses.replace(mosaic, undetermined=())
    at = np.array([[100.0, 700.0], [1200.0, 30.0]])
    tied, datum = placed_covariance_px(rig, mosaic, {"SU00": at, "SU10": at[:1]}, NO_READING)
    assert tied.shape == datum.shape == (6, 6)
    for name, rows, places in (("SU00", slice(0, 4), at), ("SU10", slice(4, 6), at[:1])):
        own = vip_precision_px(mosaic, name, places) ** 2
        np.testing.assert_allclose(np.diag(tied)[rows], own.ravel(), rtol=1e-9)
        total = (
            placed_sigma_px(rig, mosaic, name, places, datum_covariance(rig, mosaic, NO_READING))
            ** 2
        )
        np.testing.assert_allclose(np.diag(tied + datum)[rows], total.ravel(), rtol=1e-9)
    # Points far apart on one sensor share its unknowns: their correlation is that of its shift.
    assert np.linalg.matrix_rank(datum, tol=1e-9 * datum.max()) <= 4
    assert np.linalg.eigvalsh(tied).min() > -1e-12


def test_figures_are_root_mean_squares_over_middle_and_corners_of_present_sensors() -> None:
    rig, mosaic = mosaic_of("ultracam-x-mini")
    found = UncertaintyContribution(
        frames={"SU10": np.array([0.09, 0.04]), "SU20": np.array([400.0, 400.0])}
    )
    present = ("SU00", "SU10", rig.cone(rig.colour_master_cone or "").sensors[0].name)
    figures = precision_figures(rig, mosaic, present, NO_READING, found)
    w, h = 1248, 832
    at = [((w - 1) / 2, (h - 1) / 2), (0, 0), (w - 1, 0), (0, h - 1), (w - 1, h - 1)]
    mean = [
        np.mean(
            placed_sigma_px(
                rig,
                mosaic,
                s,
                np.array(at, float),
                datum_covariance(rig, mosaic, NO_READING),
                found,
            )
            ** 2
        )
        for s in ("SU00", "SU10")
    ]
    assert figures.stitched_sigma_px == pytest.approx(np.sqrt(np.mean(mean)))
    assert figures.stitched_sigma_worst_px == pytest.approx(np.sqrt(mean[1]))
    assert figures.stitched_sigma_worst_sensor == "SU10"
    assert precision_figures(rig, mosaic, (), NO_READING) is None

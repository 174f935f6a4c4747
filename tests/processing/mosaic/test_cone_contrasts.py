"""What is seen of a cone's sensors through a flight, against displacements made by hand."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.mosaic.flight_series import (
    ConeContrasts,
    ContrastSeries,
    contrasts_of,
    probe_bias_series,
    series_of,
    with_probe_ignored,
)
from processing.mosaic.misfit import POSITION, POSITION_AND_SCALE
from processing.mosaic.stitch_record import StitchRecord
from processing.rig import Cone, Rig, Sensor, find_rig
from tests.processing.mosaic.test_precision import uneven

Array = NDArray[np.float64]
PITCH_UM = 7.2


def rig_of(probes: tuple[str, ...] = ("a", "b", "a", "b")) -> Rig:
    """Four unequal master sensors on two probes, two of cone 1 alike."""
    rig = uneven(find_rig("ultracam-x-mini"))
    cones = []
    for cone in rig.cones:
        sensors = tuple(
            dataclasses.replace(s, probe=probe)
            for s, probe in zip(cone.sensors, probes, strict=False)
        )
        cones.append(dataclasses.replace(cone, sensors=sensors))
    return dataclasses.replace(rig, cones=tuple(cones))


RIG = rig_of()
MASTER, PAIR = RIG.cone("0"), RIG.cone("1")
QUANTITIES = [POSITION, POSITION_AND_SCALE]


def recorded(sensors: tuple[Sensor, ...], moves: Array, quantities: tuple[str, ...]) -> Array:
    """Values of a record, um and ppm, of moves (n, 3) in um, um and ppm."""
    return moves[:, : len(quantities)].ravel()


def similarity(sensors: tuple[Sensor, ...], scale_ppm: float, rotation_urad: float) -> Array:
    """Moves (n, 3) of a shift of (3, -4) um, a scale and a rotation of the whole cone."""
    rows = [
        (
            3.0 + (scale_ppm * s.x_mm - rotation_urad * s.y_mm) * 1e-3,
            -4.0 + (scale_ppm * s.y_mm + rotation_urad * s.x_mm) * 1e-3,
            scale_ppm,
        )
        for s in sensors
    ]
    return np.array(rows)


@pytest.mark.parametrize("quantities", QUANTITIES)
def test_a_similarity_of_the_master_is_invisible_and_nothing_else_is(
    quantities: tuple[str, ...],
) -> None:
    view = contrasts_of(RIG, MASTER, quantities=quantities)
    count = 4 * len(quantities)
    assert view.contrasts.shape == (count - 4, count)
    common = recorded(view.sensors, similarity(view.sensors, 55.0, -80.0), quantities)
    np.testing.assert_allclose(view.contrasts @ common, 0.0, atol=1e-6)
    # Orthonormal in px and ppm: none weighs more than another.
    unit = np.tile([PITCH_UM, PITCH_UM, 1.0][: len(quantities)], 4)
    normal = view.contrasts * unit
    np.testing.assert_allclose(normal @ normal.T, np.eye(count - 4), atol=1e-9)


def test_two_sensors_of_another_cone_are_seen_by_their_difference() -> None:
    view = contrasts_of(RIG, PAIR)
    a, b = PAIR.sensors
    assert view.names == tuple(f"{s.name}.{q}" for s in (a, b) for q in ("x_um", "y_um"))
    np.testing.assert_allclose(view.contrasts @ [14.4, 0.0, 7.2, -3.6], [1.0, 0.5], atol=1e-12)


@pytest.mark.parametrize("quantities", QUANTITIES)
def test_names_and_moves_are_those_of_each_sensor(quantities: tuple[str, ...]) -> None:
    view = contrasts_of(RIG, MASTER, quantities=quantities)
    units = ["x_um", "y_um", "scale_ppm"][: len(quantities)]
    assert view.names == tuple(f"{s.name}.{unit}" for s in MASTER.sensors for unit in units)
    assert view.displacement.shape[1] == 8
    for i in range(4):
        for k in (0, 1):
            moves = np.zeros((4, 3))
            moves[i, k] = PITCH_UM
            np.testing.assert_allclose(
                view.displacement[:, 2 * i + k],
                view.contrasts @ recorded(view.sensors, moves, quantities),
                atol=1e-12,
            )


@pytest.mark.parametrize(
    ("cone", "quantities"), [(MASTER, POSITION), (MASTER, POSITION_AND_SCALE), (PAIR, POSITION)]
)
def test_places_and_coefficients_are_as_sure_as_the_rig_file_states(
    cone: Cone, quantities: tuple[str, ...]
) -> None:
    view = contrasts_of(RIG, cone, quantities=quantities)
    for covariance, sigma_um in (
        (view.place, lambda s: s.position_sigma_um),
        (view.drift, lambda s: s.drift.sigma_um_per_k),
    ):
        variances = []
        for s in view.sensors:
            half_mm = math.sqrt(s.width_px**2 + s.height_px**2) * s.pitch_um / 2000.0
            sigmas = [sigma_um(s), sigma_um(s), sigma_um(s) / half_mm * 1e3]
            variances += [sigma**2 for sigma in sigmas[: len(quantities)]]
        expected = view.contrasts @ np.diag(variances) @ view.contrasts.T
        np.testing.assert_allclose(covariance, expected, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("quantities", QUANTITIES)
def test_a_probe_warms_its_own_sensors_alone(quantities: tuple[str, ...]) -> None:
    view = contrasts_of(RIG, MASTER, quantities=quantities)
    assert set(view.thermal_design) == {"a", "b"}
    for probe, thermal_design in view.thermal_design.items():
        moves = np.array(
            [
                [s.drift.x_um_per_k, s.drift.y_um_per_k, s.drift.scale_ppm_per_k]
                if s.probe == probe
                else [0.0, 0.0, 0.0]
                for s in view.sensors
            ]
        )
        expected = view.contrasts @ recorded(view.sensors, moves, quantities)
        np.testing.assert_allclose(thermal_design, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("probes", [("a", "a"), ("a", "b")])
def test_a_layer_takes_up_the_mean_scale_and_rotation_of_its_warmed_sensors(
    probes: tuple[str, ...],
) -> None:
    cone = rig_of(probes).cone("1")
    view = contrasts_of(rig_of(probes), cone)
    for probe in set(probes):
        drifts = [s.drift if s.probe == probe else None for s in cone.sensors]
        scale = sum(d.scale_ppm_per_k for d in drifts if d) / 2.0
        rotation = sum(d.rotation_urad_per_k for d in drifts if d) / 2.0
        moves = np.array([[d.x_um_per_k, d.y_um_per_k] if d else [0.0, 0.0] for d in drifts])
        for row, s in zip(moves, cone.sensors, strict=True):
            row -= (
                (scale * s.x_mm - rotation * s.y_mm) * 1e-3,
                (scale * s.y_mm + rotation * s.x_mm) * 1e-3,
            )
        np.testing.assert_allclose(
            view.thermal_design[probe], (moves[0] - moves[1]) / PITCH_UM, rtol=1e-9, atol=1e-12
        )


def test_pixels_are_those_of_the_virtual_image_or_else_of_the_sensors() -> None:
    image = RIG.virtual_image
    assert image is not None
    twice = dataclasses.replace(RIG, virtual_image=dataclasses.replace(image, pitch_um=14.4))
    np.testing.assert_allclose(contrasts_of(twice, PAIR).contrasts[:, :2], np.eye(2) / 14.4)
    without = dataclasses.replace(RIG, virtual_image=None)
    np.testing.assert_allclose(contrasts_of(without, PAIR).contrasts[:, :2], np.eye(2) / 7.2)


def test_of_more_than_two_sensors_of_another_cone_the_first_two_are_compared() -> None:
    a, b = PAIR.sensors
    third = dataclasses.replace(b, name="third", pitch_um=9.0)
    more = dataclasses.replace(PAIR, sensors=(a, dataclasses.replace(b, pitch_um=8.0), third))
    view = contrasts_of(dataclasses.replace(RIG, virtual_image=None), more)
    assert [s.name for s in view.sensors] == [a.name, b.name]
    np.testing.assert_allclose(view.contrasts, np.hstack([np.eye(2), -np.eye(2)]) / a.pitch_um)


def record_of(
    view: ConeContrasts, values: Array, dc_k: dict[str, float], calibration: str
) -> StitchRecord:
    """A record in which another sensor stands before those of the view."""
    names = ("other.x_um", *reversed(view.names))
    size = len(names)
    covariance = np.diag(np.arange(1.0, size + 1.0)) + 0.1
    return StitchRecord(
        rig=RIG.name,
        calibration_id=calibration,
        dc_k=dc_k,
        measured=(),
        names=names,
        values=np.array([1e6, *values[::-1]]),
        covariance=covariance,
        sigma0=1.0,
    )


def test_a_series_holds_the_records_of_all_sensors_with_this_calibration_in_order() -> None:
    view = contrasts_of(RIG, MASTER)
    dc_k = {s.name: 2.0 * k for k, s in enumerate(MASTER.sensors)} | {"other": 1e3}
    values = np.arange(8.0) ** 2
    good = record_of(view, values, dc_k, RIG.calibration_id)
    later = record_of(view, -values, dc_k, RIG.calibration_id)
    short = dataclasses.replace(
        good, names=good.names[:-1], values=good.values[:-1], covariance=good.covariance[:-1, :-1]
    )
    foreign = record_of(view, values, dc_k, "another")
    series = series_of(RIG, view, {7: later, 5: short, 3: good, 4: foreign})
    assert series.numbers == (3, 7)
    np.testing.assert_allclose(series.y[0], view.contrasts @ values)
    np.testing.assert_allclose(series.y[1], -series.y[0])
    # The view's names stand in reverse: their variances are 9, 8, ... 2 and 0.1 is common.
    expected = view.contrasts @ (np.diag(np.arange(9.0, 1.0, -1.0)) + 0.1) @ view.contrasts.T
    np.testing.assert_allclose(series.covariance[0], expected)
    assert series.dc_k == pytest.approx([3.0, 3.0])
    none = series_of(RIG, view, {5: short})
    assert none.y.shape == (0, 4) and none.covariance.shape == (0, 4, 4)
    assert none.factor == 1.0


def planted(view: ConeContrasts, bias_k: Array, probe: str) -> ContrastSeries:
    """Exposures in which a probe reads too much: the drift it calls for did not happen."""
    size = len(view.contrasts)
    covariance = np.array([np.diag(np.arange(1.0, size + 1.0)) * (t + 1.0) for t in range(3)])
    return ContrastSeries(
        (1, 2, 3), -bias_k[:, None] * view.thermal_design[probe], covariance * 1e-4, np.ones(3)
    )


def test_what_a_probe_reads_too_much_is_found_exposure_by_exposure() -> None:
    view = contrasts_of(RIG, MASTER, quantities=POSITION_AND_SCALE)
    bias_k = np.array([3.0, -1.0, 0.5])
    series = planted(view, bias_k, "a")
    np.testing.assert_allclose(probe_bias_series(view, series, "a"), bias_k)
    # With noise: the weighted mean, by the covariance of the exposure and of the places.
    noise = np.random.default_rng(1).normal(0.0, 1.0, series.y.shape)
    found = probe_bias_series(view, dataclasses.replace(series, y=noise), "a")
    for t in range(3):
        root = np.linalg.cholesky(series.covariance[t] + view.place)
        design, y = (
            np.linalg.solve(root, -view.thermal_design["a"]),
            np.linalg.solve(root, noise[t]),
        )
        assert found[t] == pytest.approx(design @ y / (design @ design))


def test_a_probe_that_is_not_believed_counts_for_nothing() -> None:
    rig = rig_of(("a", "b", "b", "b"))
    view = contrasts_of(rig, rig.cone("0"))
    bias_k = np.array([3.0, -1.0, 0.5])
    series = planted(view, bias_k, "a")
    without = with_probe_ignored(view, series, "a", bias_k=bias_k, sigma_k=5.0)
    # One of four sensors is warmed by it.
    assert without.dc_k == pytest.approx(1.0 - bias_k / 4.0)
    added = without.covariance - series.covariance
    thermal_design = view.thermal_design["a"]
    np.testing.assert_allclose(
        added, [np.outer(thermal_design, thermal_design) * 25.0] * 3, atol=1e-12
    )
    assert without.y is series.y and without.numbers == series.numbers

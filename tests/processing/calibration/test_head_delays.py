"""Delays of nine heads from the pixels of an emulated figure of eight, against their truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks.time_from_pixels import Timed, evaluate, inertial_of, network_of
from daemon.postflight.calibration.boresight_calibration import controlled_of
from processing.bundle.adjust import Adjustment, adjust
from processing.bundle.head_times import confounded_times, head_times, jitter_sigmas
from processing.bundle.network import Network
from processing.bundle.rank_diagnosis import RankDefectError
from processing.calibration.boresight import calibrate_boresight
from processing.calibration.head_delays import head_delays, orientation_columns
from processing.calibration.motion_consistency import motion_consistency
from processing.geometry.rotation import rotations_from_vectors
from sim_hw.blocks.figure_of_eight import (
    Figure,
    FigureFlight,
    nine_heads,
    simulate_figure_flight,
)

CALM = Figure(is_line=True, swing_deg=(0.0, 0.0))
CALM_LINES = tuple(
    Figure(is_line=True, azimuth_deg=azimuth, swing_deg=(0.002, 0.004)) for azimuth in (0.0, 180.0)
)


def _flight(seed: int, figures: tuple[Figure, ...] = (Figure(),), **heads: float) -> FigureFlight:
    own = nine_heads(np.random.default_rng([seed, 9]), **heads)
    wind = (0.0, 0.0) if figures[0].is_line else (5.0, 6.0)
    return simulate_figure_flight(
        seed, figures, heads=own, wind_mps=wind, interval_s=6.0, ground_points=700
    )


@pytest.fixture(scope="module")
def figure() -> tuple[FigureFlight, Timed]:
    flight = _flight(1)
    return flight, evaluate(flight, 1)


def _sigma(timed: Timed, kind: str) -> np.ndarray:
    own = [k for k, name in enumerate(timed.names) if name.startswith(kind)]
    assert own, kind
    return np.sqrt(np.diag(timed.covariance)[own])


def test_one_figure_of_eight_gives_delays_and_lever_arms_with_true_sigmas(figure) -> None:
    _, timed = figure
    assert len(timed.error) == 35
    low, high = chi2.ppf([0.0005, 0.9995], len(timed.error))
    assert low < timed.error @ np.linalg.solve(timed.covariance, timed.error) < high
    assert _sigma(timed, "delay").max() < 1e-4
    assert _sigma(timed, "common delay").max() < 3e-4
    for arm in ("lever arm right", "lever arm forward", "antenna forward", "antenna right"):
        assert _sigma(timed, arm).max() < 0.02
    assert not confounded_times(timed.adjustment)


def test_delays_against_the_marks_hold_what_both_share(figure) -> None:
    flight, timed = figure
    every = tuple(range(len(flight.time_s)))
    total = head_delays(timed.adjustment, every, timed.found)
    truth = flight.common_delay_s + np.array([h.delay_s for h in flight.heads])
    assert (np.abs(total.delay_s - truth) < 4.0 * total.sigma_s).all()
    # Differences of totals are delays between heads: the common delay cancels.
    by = np.eye(9)[1:] - np.eye(9)[0]
    between = np.sqrt(np.diag(by @ total.covariance @ by.T))
    assert between == pytest.approx([t.delay_sigma_s for t in head_times(timed.adjustment)[1:]])


def test_sigmas_of_delays_after_the_marks_follow_from_images_and_trajectory(figure) -> None:
    flight, timed = figure
    every = tuple(range(len(flight.time_s)))
    total = head_delays(timed.adjustment, every, timed.found)
    at = orientation_columns(timed.adjustment, every)
    by_image = timed.found.by_image[6]
    block = timed.adjustment.sigma0**2 * timed.adjustment.cofactor
    of_trajectory = timed.found.covariance[6, 6] - by_image @ block[np.ix_(at, at)] @ by_image
    assert of_trajectory > 0.0
    for k in range(1, 9):
        both = np.append(at, timed.adjustment.layout.head_delay[k])
        change = np.append(by_image, 1.0)
        variance = of_trajectory + change @ block[np.ix_(both, both)] @ change
        assert total.covariance[k, k] == pytest.approx(variance, rel=1e-9)


def test_errors_that_are_common_to_all_exposures_stay_in_the_shift(figure) -> None:
    flight, timed = figure
    images = controlled_of(timed.adjustment, tuple(range(len(flight.time_s))))
    shift = {}
    for correlation_s in (None, 1e7):
        inertial = replace(inertial_of(flight), position_correlation_s=correlation_s)
        found = calibrate_boresight(images, inertial, timed.found.mounting)
        shift[correlation_s] = found.sigma[7]
    assert shift[1e7] > 0.99 * flight.spread.position_m[0] > 1.5 * shift[None]
    with pytest.raises(ValueError, match="a correlation time is positive"):
        inertial = replace(inertial_of(flight), position_correlation_s=-1.0)
        calibrate_boresight(images, inertial, timed.found.mounting)


def test_the_ten_change_with_the_images_as_stated(figure) -> None:
    flight, timed = figure
    every = tuple(range(len(flight.time_s)))
    images, inertial = controlled_of(timed.adjustment, every), inertial_of(flight)
    given = timed.found.mounting
    before = calibrate_boresight(images, inertial, given)
    off = np.random.default_rng(2).normal(0.0, 1.0, (len(every), 6)) * ([1e-3] * 3 + [1e-6] * 3)
    moved = replace(
        images,
        centre_m=images.centre_m + off[:, :3],
        rotation=images.rotation @ rotations_from_vectors(off[:, 3:]),
    )
    after = calibrate_boresight(moved, inertial, given)
    change = np.concatenate(
        [
            after.mounting.antenna_m - before.mounting.antenna_m,
            [after.mounting.time_offset_s - before.mounting.time_offset_s],
        ]
    )
    assert change == pytest.approx((before.by_image @ off.ravel())[3:7], rel=1e-3, abs=1e-6)


def test_a_calm_straight_line_is_refused_with_the_delay_and_the_lever_arm() -> None:
    flight = _flight(3, (CALM,))
    with pytest.raises(RankDefectError) as error:
        adjust(network_of(flight, seed=3))
    for k in range(1, 9):
        assert f"delay of head oblique {k}" in str(error.value)
        assert f"Y of head offset oblique {k}" in str(error.value)


def test_with_its_lever_arms_held_a_calm_line_gives_the_delays() -> None:
    flight = _flight(3, (CALM,))
    network = network_of(flight, seed=3)
    heads = tuple(
        replace(head, offset_m=truth.offset_m, offset_free=False)
        for head, truth in zip(network.heads, flight.heads, strict=True)
    )
    times = head_times(adjust(replace(network, heads=heads)))
    for head, time in zip(flight.heads[1:], times[1:], strict=True):
        assert abs(time.delay_s - head.delay_s) < 4.0 * time.delay_sigma_s < 2e-3


def test_a_line_with_little_swing_names_the_lever_arm() -> None:
    result = adjust(network_of(_flight(4, CALM_LINES), seed=4))
    sentences = confounded_times(result)
    named = [s for s in sentences if "lever arm (forward)" in s]
    assert len(named) == 8 and all("two speeds" in s for s in named)


def test_readout_time_is_found_with_affinity_held_and_named_where_it_is_free() -> None:
    flight = _flight(5, readout_s=0.03)
    timed = evaluate(flight, 5, readout=True)
    assert _sigma(timed, "readout time").max() < 1.5e-4
    low, high = chi2.ppf([0.0005, 0.9995], len(timed.error))
    assert low < timed.error @ np.linalg.solve(timed.covariance, timed.error) < high
    network = network_of(_flight(5, CALM_LINES, readout_s=0.03), seed=5, readout=True)
    cameras = tuple(replace(c, free=frozenset({"b1", "b2", "df"})) for c in network.cameras)
    heads = tuple(replace(head, offset_free=False) for head in network.heads)
    network = replace(network, heads=heads)
    assert not any("readout" in s for s in confounded_times(adjust(network)))
    named = confounded_times(adjust(replace(network, cameras=cameras)))
    assert any("readout time of head nadir and its camera nadir" in s for s in named)


def test_velocities_and_rates_are_compared_with_positions_and_attitudes(figure) -> None:
    inertial = inertial_of(figure[0])
    right = motion_consistency(inertial)
    assert not right.problems and right.intervals == len(inertial.position_m) - 1
    assert right.velocity_scale == pytest.approx(1.0, abs=0.01)
    assert right.rate_scale == pytest.approx(1.0, abs=0.1)
    half = motion_consistency(replace(inertial, rate_rad_per_s=0.5 * inertial.rate_rad_per_s))
    assert len(half.problems) == 1 and "rates" in half.problems[0]
    lines = motion_consistency(inertial_of(_flight(4, (Figure(is_line=True),))))
    assert np.isnan(lines.rate_scale) and not lines.problems, "swings show nothing of rates"
    with pytest.raises(ValueError, match="instants"):
        motion_consistency(replace(inertial, time_s=None))


def _with_jitter_sigma(network: Network, sigma_s: dict[str, float]) -> Network:
    return replace(
        network,
        heads=tuple(
            replace(h, timing=replace(h.timing, jitter_sigma_s=sigma_s[h.name]))
            for h in network.heads
        ),
    )


def test_jitter_of_each_head_is_estimated_from_the_block() -> None:
    heads = tuple(
        replace(head, jitter_s=1e-3 if k in (2, 5) else 2e-4)
        for k, head in enumerate(nine_heads(np.random.default_rng([6, 9])))
    )
    flight = simulate_figure_flight(6, heads=heads, interval_s=6.0, ground_points=700)
    sigma = dict.fromkeys((head.name for head in heads), 5e-4)
    result: Adjustment | None = None
    for _ in range(3):
        result = adjust(_with_jitter_sigma(network_of(flight, seed=6), sigma))
        sigma = jitter_sigmas(result)
    assert result is not None
    for head in heads:
        assert sigma[head.name] == pytest.approx(head.jitter_s, rel=0.6), head.name
    ratios = np.array([sigma[head.name] / head.jitter_s for head in heads])
    assert np.exp(np.log(ratios).mean()) == pytest.approx(1.0, abs=0.25)
    assert min(sigma["oblique 2"], sigma["oblique 5"]) > 2.0 * max(
        sigma[h.name] for h in heads if h.jitter_s < 5e-4
    )
    error = result.state.jitter - flight.jitter_s
    columns = result.layout.jitter
    covariance = result.sigma0**2 * result.cofactor[np.ix_(columns, columns)]
    low, high = chi2.ppf([0.0005, 0.9995], len(error))
    assert low < error @ np.linalg.solve(covariance, error) < high
    assert error.std() < 0.6 * flight.jitter_s.std()
    assert head_times(result)[2].jitter_sigma_s < 3e-4

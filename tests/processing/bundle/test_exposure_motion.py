"""Delays, jitter and readout time of heads: derivatives, truth of an emulated flight, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.time_from_pixels import inertial_of, network_of
from processing.bundle.adjust import adjust
from processing.bundle.equations import equations
from processing.bundle.network import HeadTiming, Motion, Network, NetworkError
from processing.bundle.step_control import rays_of
from processing.bundle.unknowns import (
    ParameterValues,
    apply_corrections,
    initial_values,
    layout_of,
)
from processing.calibration.boresight import mounting_of, rig_motion
from sim_hw.blocks.figure_of_eight import (
    FigureFlight,
    FlightSigmas,
    nine_heads,
    simulate_figure_flight,
)
from tests.processing.bundle.simulated_networks import with_everything

EXACT = FlightSigmas(1e-9, 1e-9, (1e-9,) * 3, 1.0, (1e-12,) * 3, 1.0)


def _timed(network: Network, *, jitter: bool = True) -> Network:
    random = np.random.default_rng(5)
    n = len(network.stations.names)
    motion = Motion(
        random.normal(0.0, 40.0, (n, 3)),
        random.normal(0.0, 3.0, (n, 3)),
        random.normal(0.0, 0.3, (n, 3)),
        random.normal(0.0, 0.3, (n, 3)),
    )
    timing = HeadTiming(0.015, True, 0.01, 0.03, True, 0.02, 40.0, 1e-3 if jitter else None)
    heads = tuple(replace(head, timing=timing) for head in network.heads)
    return replace(network, heads=heads, motion=motion)


@pytest.mark.parametrize("radius_m", [None, 6.371e6])
def test_derivatives_agree_with_differences_while_the_rig_moves(radius_m: float | None) -> None:
    network = _timed(with_everything().network)
    network = replace(network, rays=replace(network.rays, earth_radius_m=radius_m))
    layout = layout_of(network, np.zeros(len(network.points.names), dtype=bool))
    state = initial_values(network)
    state = replace(state, jitter=np.random.default_rng(6).normal(0.0, 5e-3, len(state.jitter)))
    weight = np.ones(len(network.image_points.image))
    design = equations(network, layout, state, weight).reduced.toarray()
    none = np.zeros((len(layout.eliminated_points), 3))
    names = {unknown.name for unknown in layout.unknowns}
    assert {"head nadir delay", "head oblique delay", "head oblique readout time"} <= names
    assert sum(unknown.component == "jitter" for unknown in layout.unknowns) > 10
    # Kinds that the motion acts on; some columns of each.
    taken: dict[str, int] = dict.fromkeys(
        ("head", "image", "station", "attitude", "head rotation", "head offset", "point"), 12
    )
    for column in range(layout.columns):
        unknown = layout.unknowns[column]
        if not taken.get(unknown.kind):
            continue
        taken[unknown.kind] -= 1
        size = float(np.abs(design[:, column]).max())
        assert size > 0.0, unknown.name
        dx = np.zeros(layout.columns)
        dx[column] = 1.0 / size
        up = equations(network, layout, apply_corrections(state, layout, dx, none), weight)
        down = equations(network, layout, apply_corrections(state, layout, -dx, none), weight)
        numeric = -(up.misclosure - down.misclosure) / (2.0 * dx[column])
        # The series of rotation rates ends after the second order.
        assert np.abs(numeric - design[:, column]).max() / size < 2e-6, unknown.name


def _at_truth(flight: FigureFlight, network: Network) -> ParameterValues:
    heads = flight.heads
    return replace(
        initial_values(network),
        station=flight.centre_m,
        attitude=flight.rotation,
        points=flight.points,
        head_rotation=np.array([h.rotation for h in heads]),
        head_offset=np.array([h.offset_m for h in heads]),
        head_delay=np.array([h.delay_s for h in heads]),
        readout=np.array([h.readout_s for h in heads]),
        jitter=flight.jitter_s,
    )


def _misclosure_um(network: Network, state: ParameterValues) -> np.ndarray:
    layout = layout_of(network, np.zeros(len(network.points.names), dtype=bool))
    weight = np.ones(len(network.image_points.image))
    rows = equations(network, layout, state, weight, derivatives=False)
    own = rows.group < 2
    return (rows.misclosure * rows.sigma)[own] * 1e3


@pytest.fixture(scope="module")
def exact() -> FigureFlight:
    heads = nine_heads(np.random.default_rng(3), jitter_s=1e-3, readout_s=0.02)
    return simulate_figure_flight(2, heads=heads, interval_s=20.0, spread=EXACT)


def test_true_delays_jitter_and_readout_leave_nothing_of_an_emulated_flight(exact) -> None:
    network = network_of(exact)
    mounting = mounting_of(exact.antenna_m, exact.boresight_rad, time_offset_s=exact.common_delay_s)
    motion = rig_motion(inertial_of(exact), mounting)
    network = replace(network, motion=motion)
    state = _at_truth(exact, network)
    assert np.abs(_misclosure_um(network, state)).max() < 0.1
    for wrong in (
        replace(state, head_delay=-state.head_delay),
        replace(state, readout=-state.readout),
        replace(state, jitter=-state.jitter),
        replace(state, head_delay=np.roll(state.head_delay, 1)),
    ):
        assert np.abs(_misclosure_um(network, wrong)).max() > 10.0
    halved = replace(network, motion=replace(motion, rate_rad_per_s=0.5 * motion.rate_rad_per_s))
    assert np.abs(_misclosure_um(halved, state)).max() > 5.0


def test_without_time_unknowns_the_motion_changes_nothing() -> None:
    network = with_everything().network
    moving = replace(_timed(network), heads=network.heads)
    layout = layout_of(network, np.zeros(len(network.points.names), dtype=bool))
    weight = np.ones(len(network.image_points.image))
    plain = equations(network, layout, initial_values(network), weight)
    other = equations(moving, layout, initial_values(moving), weight)
    assert (plain.misclosure == other.misclosure).all()
    assert np.allclose(plain.reduced.toarray(), other.reduced.toarray(), rtol=1e-13)


def test_what_does_not_fit_is_refused_with_the_heads_name() -> None:
    network = _timed(with_everything().network)
    with pytest.raises(NetworkError, match="no motion is given"):
        adjust(replace(network, motion=None))
    for timing, sentence in (
        (HeadTiming(jitter_sigma_s=0.0), "not positive"),
        (HeadTiming(readout_free=True), "height of its frame is not given"),
        (HeadTiming(readout_s=0.01, frame_height_mm=-1.0), "it is positive"),
    ):
        heads = tuple(replace(head, timing=timing) for head in network.heads)
        with pytest.raises(NetworkError, match=sentence):
            adjust(replace(network, heads=heads))
    assert network.motion is not None
    short = replace(network.motion, velocity_mps=network.motion.velocity_mps[1:])
    with pytest.raises(NetworkError, match="velocities are"):
        adjust(replace(network, motion=short))
    unknown = replace(
        network.motion, rate_rad_per_s=np.full_like(network.motion.rate_rad_per_s, np.nan)
    )
    with pytest.raises(NetworkError, match="rates hold a value that is not a finite number"):
        adjust(replace(network, motion=unknown))


def test_a_point_that_two_heads_of_one_exposure_see_has_a_base() -> None:
    network = with_everything().network
    table, images = network.image_points, network.images
    layout = layout_of(network, np.zeros(len(network.points.names), dtype=bool))
    point = int(layout.eliminated_points[0])
    both = np.flatnonzero(images.station == images.station[0])
    assert sorted(images.head[both]) == [0, 1]
    only = replace(
        network,
        image_points=replace(
            table,
            image=both,
            point=np.full(2, point),
            xy_mm=table.xy_mm[:2],
            sigma_mm=table.sigma_mm[:2],
        ),
    )
    _, base = rays_of(only, layout).centres(initial_values(only))
    offset_m = np.linalg.norm(network.heads[1].offset_m - network.heads[0].offset_m)
    assert base[layout.eliminated[point]] == pytest.approx(0.5 * offset_m)

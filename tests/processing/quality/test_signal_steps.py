"""Steps of signal along whole lines, planted in means of bundles and in frames."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.geometry.placement import nominal_placements, vip_mm_from_raw
from processing.image.line_means import line_means
from processing.quality.frame_blocks import _have_runs, _texture
from processing.quality.ground_steps import Axis, GroundView, LineStep
from processing.quality.signal_steps import (
    SignalStep,
    _largest,
    _medians,
    _signs,
    signal_steps,
    step_figures,
    without_edges,
)
from processing.rig import find_rig

Array = NDArray[np.float64]
MINI = find_rig("ultracam-x-mini")
SENSORS = MINI.master_sensors
BUNDLES, LINES = 20, 101


def means(changes: Array, *, bundles: int = BUNDLES, level: float = 1000.0) -> Array:
    """Means (bundles, n + 1) whose relative changes from line to line are these, (n,) or (b, n)."""
    changes = np.broadcast_to(changes, (bundles, np.shape(changes)[-1]))
    ratios = (1.0 + changes / 2.0) / (1.0 - changes / 2.0)
    return level * np.hstack([np.ones((bundles, 1)), np.cumprod(ratios, axis=1)])


def one_step(relative: float, at: int = 40, *, unstepped: int = 0) -> Array:
    changes = np.zeros((BUNDLES, LINES - 1))
    changes[unstepped:, at] = relative
    return changes


def largest(line_values: Array, *, offset: int = 0, least: float = 0.0) -> SignalStep | None:
    return _largest("SU00", "rows", line_values, offset, least)


@pytest.mark.parametrize("relative", [0.056, -0.056])
def test_a_step_of_one_line_is_found_where_it_lies(relative: float) -> None:
    step = largest(means(one_step(relative)), offset=7)
    assert step == SignalStep("SU00", "rows", 47, pytest.approx(relative), 1)
    assert largest(means(one_step(0.98 * relative))) is None


@pytest.mark.parametrize(
    ("lines", "relative", "found"),
    [(16, 0.031, 16), (15, 0.031, 0), (16, 0.029, 0), (15, 0.06, 15)],
)
def test_sixteen_lines_are_banding_at_a_smaller_step(
    lines: int, relative: float, found: int
) -> None:
    changes = np.zeros(LINES - 1)
    changes[: 2 * lines : 2] = relative * (-1.0) ** np.arange(lines)
    step = largest(means(changes))
    assert (step.lines if step else 0) == found


def test_of_several_steps_the_largest_that_all_bundles_share_counts() -> None:
    changes = one_step(0.07, 20) + one_step(-0.09, 60)
    # Half of the bundles step much farther: an edge on the ground.
    changes[::2, 80] = 0.5
    changes[:13, 10] = 0.5
    step = largest(means(changes))
    assert step == SignalStep("SU00", "rows", 60, pytest.approx(-0.09), 2)


@pytest.mark.parametrize(("unstepped", "found"), [(4, True), (5, False)])
@pytest.mark.parametrize("relative", [0.1, -0.1])
def test_a_fifth_of_the_bundles_may_stay_where_they_are(
    relative: float, unstepped: int, found: bool
) -> None:
    assert (largest(means(one_step(relative, unstepped=unstepped))) is not None) == found


@pytest.mark.parametrize(("small", "found"), [(0.052, True), (0.048, False)])
def test_what_nearly_all_share_is_more_than_half_of_the_step(small: float, found: bool) -> None:
    changes = one_step(0.1)
    changes[:5, 40] = small
    assert (largest(means(changes)) is not None) == found


@pytest.mark.parametrize(("bundles", "found"), [(14, False), (15, True)])
def test_fewer_than_fifteen_bundles_say_nothing(bundles: int, found: bool) -> None:
    made = means(one_step(0.1)[0], bundles=bundles)
    assert (largest(made) is not None) == found


@pytest.mark.parametrize(("sigmas", "found"), [(7.8, False), (8.2, True)])
@pytest.mark.parametrize("count", [1, 16])
def test_a_step_exceeds_eight_standard_deviations_of_lines(
    sigmas: float, count: int, found: bool
) -> None:
    noise = 0.01
    changes = np.where(np.arange(LINES - 1) % 2, noise, -noise)
    spread = 1.4826 * noise
    changes[5 : 5 + 4 * count : 4] = sigmas * spread
    assert (largest(means(changes)) is not None) == found


@pytest.mark.parametrize("period", [4, 6, 8, 12])
@pytest.mark.parametrize("amplitude", [0.1, 0.4])
def test_rows_of_plants_over_a_third_of_the_frame_are_no_banding(
    period: int, amplitude: float
) -> None:
    changes = np.zeros(LINES - 1)
    changes[30:63] = amplitude * np.sin(2 * np.pi * np.arange(33) / period + 0.3)
    assert largest(means(changes)) is None


@pytest.mark.parametrize("at", [0, 40, LINES - 2])
@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(("share", "found"), [(0.19, True), (0.21, False)])
def test_an_edge_that_a_lens_spreads_is_no_step(
    at: int, side: int, share: float, found: bool
) -> None:
    changes = one_step(0.1, at)
    if not 0 <= at + side < LINES - 1:
        assert largest(means(changes)) is not None
        return
    changes[:, at + side] = share * 0.1
    assert (largest(means(changes)) is not None) == found


def test_a_slope_over_the_frame_is_no_noise() -> None:
    changes = np.full(LINES - 1, 0.02)
    changes[40] = 0.07
    assert largest(means(changes)) == SignalStep("SU00", "rows", 40, pytest.approx(0.07), 1)


def test_a_step_exceeds_the_least_counts() -> None:
    line_values = means(one_step(0.1), level=400.0)
    bright = float(np.median(line_values[:, 40:42]))
    assert largest(line_values, least=0.098 * bright) is not None
    assert largest(line_values, least=0.102 * bright) is None


def test_nearly_no_signal_is_taken_as_one_count() -> None:
    dark = np.full((BUNDLES, LINES), 0.2)
    dark[:, 41:] = 0.4
    step = largest(dark, least=0.15)
    assert step is not None and step.relative == pytest.approx(0.2)
    assert largest(dark, least=0.25) is None
    assert largest(np.zeros((BUNDLES, LINES))) is None


SIDE = 640
FIRST = 32


def frames(count: int, level: int = 4000) -> dict[str, NDArray[np.uint16]]:
    """Even frames; rows that were not exposed are dark."""
    line_values = {}
    for sensor in SENSORS[:count]:
        frame = np.zeros((SIDE + 2 * FIRST, SIDE), np.uint16)
        frame[FIRST : FIRST + SIDE] = level
        line_values[sensor.name] = frame
    return line_values


def steps_of(line_values: dict[str, NDArray[np.uint16]]) -> tuple[SignalStep, ...]:
    rows = (FIRST, FIRST + SIDE - 1)
    return signal_steps(SENSORS, {n: line_means(f, rows) for n, f in line_values.items()})


def test_steps_of_frames_are_named_the_largest_first() -> None:
    line_values = frames(2)
    a, b = line_values
    assert steps_of(line_values) == ()
    line_values[a][:, 300:] = 4400
    line_values[a][:FIRST], line_values[a][FIRST + SIDE :] = 0, 0
    line_values[b][FIRST + SIDE - 1] = 2000
    found = steps_of(line_values)
    assert [(s.sensor, s.axis, s.at, s.lines) for s in found] == [
        (b, "rows", FIRST + SIDE - 2, 1),
        (a, "columns", 299, 1),
    ]
    assert [s.relative for s in found] == pytest.approx([-2000 / 3000, 400 / 4200])
    assert step_figures(found).as_json() == {
        "signal_step": pytest.approx(-2 / 3),
        "signal_step_sensor": b,
        "signal_step_axis": "rows",
        "signal_step_at": FIRST + SIDE - 2,
        "signal_step_lines": 1,
        "signal_step_frames": 2,
    }
    assert set(step_figures(()).as_json().values()) == {None}


@pytest.mark.parametrize(("count", "found"), [(2, 2), (3, 0), (4, 0)])
def test_steps_at_different_lines_of_three_frames_are_the_ground_s(count: int, found: int) -> None:
    line_values = frames(4)
    for number, frame in enumerate(list(line_values.values())[:count]):
        frame[FIRST + 100 + 7 * number : FIRST + SIDE] = 4400
    assert len(steps_of(line_values)) == found


@pytest.mark.parametrize("count", [3, 4])
def test_steps_at_the_same_line_of_three_frames_that_share_no_ground_are_read_out(
    count: int,
) -> None:
    line_values = frames(4)
    for frame in list(line_values.values())[:count]:
        frame[FIRST + 100 : FIRST + SIDE] = 4400
    assert len(steps_of(line_values)) == count


@pytest.mark.parametrize(
    ("showing", "found"), [("", ["R"]), ("B", ["R"]), ("G N", []), ("G B N", [])]
)
def test_a_step_that_most_other_heads_show_on_the_ground_is_none(
    showing: str, found: list[str]
) -> None:
    rig = find_rig("ultracam-x-mini")
    placements = nominal_placements(rig, {c.probe: c.calibration_c for c in rig.cones}, {})
    edge_mm = vip_mm_from_raw(placements["R"], np.array([[300.5, 400.0]]))[0, 0]
    line_values = {}
    for name in "RGBN":
        sensor = rig.sensor(name)
        columns = np.arange(sensor.width_px, dtype=np.float64)
        at = vip_mm_from_raw(placements[name], np.stack((columns, 0.0 * columns + 400.0), axis=1))
        bright = np.where(name in showing.split(), at[:, 0] > edge_mm, False)
        # A lens spreads the edge in the other frames.
        spread = np.convolve(
            np.pad(bright.astype(np.float64), 4, "edge"), np.ones(9) / 9.0, "valid"
        )
        line = 4000.0 + 600.0 * spread if name != "R" else 4000.0 + 600.0 * (columns > 300.0)
        line_values[name] = np.tile(line.astype(np.uint16) & 0xFFFE, (sensor.height_px, 1))
    means_of = {n: line_means(f, (0, len(f) - 1)) for n, f in line_values.items()}
    view = GroundView(rig, placements, line_values)
    steps = signal_steps(rig.sensors, means_of, view)
    assert [(step.sensor, step.at) for step in steps] == [(name, 300) for name in found]


@pytest.mark.parametrize(("step_dn", "found"), [(5.75, 0), (6.25, 1)])
def test_six_dn_of_a_sensor_are_the_least_step(step_dn: float, found: int) -> None:
    # 12 bits: eight counts of Level 1 to the DN.
    line_values = frames(1, level=400)
    frame = line_values[SENSORS[0].name]
    frame[FIRST + 100 : FIRST + SIDE] = 400 + round(8 * step_dn)
    assert len(steps_of(line_values)) == found


@pytest.mark.parametrize("bundles", [16, 21])
def test_signs_and_medians_are_those_of_numpy(bundles: int) -> None:
    made = np.random.default_rng(7).normal(1000.0, 30.0, (bundles, 300)).astype(np.float32)
    made[:, 100] = made[:, 99]
    change = np.diff(made, axis=1)
    rising, falling = _signs(made)
    assert np.array_equal(rising, np.count_nonzero(change > 0.0, axis=0))
    assert np.array_equal(falling, np.count_nonzero(change < 0.0, axis=0))
    relative = change / (0.5 * (made[:, 1:] + made[:, :-1]))
    lines = np.array([0, 5, 99, 298])
    assert _medians(made, lines) == pytest.approx(np.median(relative, axis=0)[lines], rel=1e-5)


def test_runs_of_steps_and_texture_are_those_of_numpy() -> None:
    made = np.random.default_rng(8).normal(1000.0, 30.0, (20, 200)).astype(np.float32)
    made[3:8, 51:] += 400.0
    made[10:14, 121:] += 400.0
    change = np.diff(made, axis=1)
    assert _texture(made) == pytest.approx(float(np.sqrt(np.mean(change * change))), rel=1e-5)
    for sign in (1.0, -1.0):
        rises, falls = _have_runs(sign * made, 150.0, 5)[:: int(sign)]
        assert np.flatnonzero(rises).tolist() == [50] and not falls.any()
        rises, falls = _have_runs(sign * made, 150.0, 4)[:: int(sign)]
        assert np.flatnonzero(rises).tolist() == [50, 120] and not falls.any()


@pytest.mark.parametrize(
    ("axis", "lines", "rows", "stays"),
    [
        ("rows", (0, 1), 2, False),
        ("rows", (2,), 2, True),
        ("rows", (0, 400), 2, True),
        ("rows", (829, 830), 2, False),
        ("rows", (828,), 2, True),
        ("columns", (0, 1), 2, True),
        ("rows", (0,), 0, True),
    ],
)
def test_steps_in_partly_exposed_rows_are_left_out(
    axis: Axis, lines: tuple[int, ...], rows: int, stays: bool
) -> None:
    every = tuple(LineStep("SU00", axis, at, 0.3) for at in lines)
    steps = (SignalStep("SU00", axis, lines[0], 0.3, len(lines), every),)
    assert without_edges(SENSORS, steps, rows) == (steps if stays else ())

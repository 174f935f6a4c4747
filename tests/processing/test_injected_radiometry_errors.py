"""Wrong radiometry and sharpness of one head that once went as `good`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline

from benchmarks.silent_errors.exposures import healthy
from processing.geometry.exposure_times import unknown_exposure_figures
from processing.geometry.placement import nominal_placements
from processing.quality.common_windows import measure_common_windows
from processing.quality.figures.image import BandLevelFigures, SignalStepFigures
from processing.quality.level_steps import level_steps
from processing.quality.local_sharpness import SUSPICIOUS, local_blur_figures
from processing.quality.report import Verdict
from processing.quality.word_format import wrong_format
from tests.processing.injected_errors import (
    BLACK_DN,
    InjectedExposure,
    banded,
    block,
    clipped,
    gain,
    in_part,
    rendered,
)

pytestmark = [pytest.mark.trust, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def error_free() -> InjectedExposure:
    return rendered("ultracam-x-mini")


@pytest.mark.parametrize(
    ("sensor", "axis", "line", "factor"),
    [("SU11", 0, 416, 1.08), ("SU00", 1, 600, 1.08), ("G", 0, 400, 1.2), ("SU30", 0, 300, 0.9)],
)
def test_a_gain_step_within_a_frame_is_named_with_its_line(
    error_free: InjectedExposure, sensor: str, axis: int, line: int, factor: float
) -> None:
    outcome = error_free.with_frame(sensor, gain(factor, line, axis)).outcome()
    assert outcome.verdict == "usable" and "FRAME_CORRUPT" in outcome.flags
    assert outcome.figure("signal_step_sensor") == sensor
    assert outcome.figure("signal_step_axis") == ("rows", "columns")[axis]
    assert abs(outcome.figure("signal_step_at") - (line - 1)) <= 1
    assert outcome.figure("signal_step") == pytest.approx(factor - 1.0, abs=0.03)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sensor", ["R", "N"])
def test_a_gain_step_or_banding_in_a_coarse_colour_head_is_named(sensor: str, axis: int) -> None:
    exposure = rendered("dmc-mini")

    def in_bands(frame: Any) -> Any:
        return banded(60, 12)(frame) if axis == 0 else banded(60, 12)(frame.T).T

    for change in (gain(1.2, 200, axis), in_bands):
        outcome = exposure.with_frame(sensor, change).outcome()
        assert outcome.verdict == "usable" and "FRAME_CORRUPT" in outcome.flags
        assert outcome.figure("signal_step_sensor") == sensor
        assert outcome.figure("signal_step_axis") == ("rows", "columns")[axis]


@pytest.mark.parametrize(
    ("rig", "sensor", "line", "factor"),
    [("ultracam-x-mini", "SU30", 338, 0.88), ("ultracam-l-mini", "SU10", 375, 1.27)],
)
def test_a_step_within_a_frame_accuses_no_neighbour_of_another_gain(
    rig: str, sensor: str, line: int, factor: float
) -> None:
    outcome = rendered(rig).with_frame(sensor, gain(factor, line)).outcome()
    assert outcome.figure("signal_step_sensor") == sensor
    assert outcome.figure("gain_outlier") is None, outcome.sentences


def test_banding_is_named(error_free: InjectedExposure) -> None:
    outcome = error_free.with_frame("SU10", banded(30, 20)).outcome()
    assert outcome.figure("signal_step_sensor") == "SU10" and "banding" in outcome.sentences


def heads_of(exposure: InjectedExposure, which: str) -> list[str]:
    """The sensors of PAN heads, of colour heads or of all."""
    roles = {"all": ("pan", "colour")}.get(which, (which,))
    return [s.name for cone in exposure.rig.cones if cone.role in roles for s in cone.sensors]


SHARED = {"step": gain(1.2, 250), "columns": gain(1.2, 250, axis=1), "banding": banded(80, 12)}


@pytest.mark.parametrize(
    ("rig", "which", "change"),
    [
        ("ultracam-x-mini", "pan", "step"),
        ("ultracam-x-mini", "colour", "step"),
        ("ultracam-x-mini", "all", "banding"),
        ("ultracam-l-mini", "all", "columns"),
        ("dmc-mini", "colour", "banding"),
        ("dmc-mini", "all", "step"),
    ],
)
def test_steps_that_a_supply_or_clock_makes_in_many_frames_are_named(
    rig: str, which: str, change: str
) -> None:
    exposure = rendered(rig)
    heads = heads_of(exposure, which)
    for sensor in heads:
        exposure = exposure.with_frame(sensor, SHARED[change])
    outcome = exposure.outcome()
    assert outcome.verdict != "good" and "FRAME_CORRUPT" in outcome.flags
    assert outcome.figure("signal_step_sensor") in heads, outcome.sentences
    if which != "colour":
        assert outcome.figure("signal_step_frames") > 2
    if which != "colour" and outcome.figure("mismatched_sensors") is None:
        assert "check what these heads share" in outcome.sentences


@pytest.mark.parametrize("change", SHARED)
def test_steps_in_many_frames_of_heads_that_share_no_ground_are_named(change: str) -> None:
    exposure = healthy("midas-mini", 0)
    for sensor in exposure.rig.sensors[:4]:
        exposure = exposure.with_frame(sensor.name, SHARED[change])
    report = exposure.process().report
    steps = report.figures.of(SignalStepFigures)
    assert report.verdict is Verdict.USABLE and steps.signal_step_frames == 4


def test_banding_of_one_frequency_in_heads_that_share_no_ground_is_named() -> None:
    exposure = healthy("midas-mini", 0)
    for number, sensor in enumerate(exposure.rig.sensors[:4]):
        shifted = partial(np.roll, shift=7 * number, axis=0)
        exposure = exposure.with_frame(
            sensor.name, lambda f, shifted=shifted: np.minimum(f + shifted(BANDS[: len(f)]), 4095)
        )
    steps = exposure.process().report.figures.of(SignalStepFigures)
    assert steps.signal_step_frames == 4


BANDS = (80 * ((np.arange(2000) // 15) % 2)).astype(np.uint16)[:, None]


@pytest.mark.parametrize("which", ["pan", "colour", "all"])
def test_a_block_that_many_frames_share_is_named(which: str) -> None:
    exposure = rendered("ultracam-x-mini")
    heads = heads_of(exposure, which)
    for sensor in heads:
        exposure = exposure.with_frame(sensor, block(250, slice(150, 400), slice(250, 600)))
    outcome = exposure.outcome()
    assert outcome.verdict != "good" and outcome.figure("block_sensor") in heads


@pytest.mark.parametrize(("axis", "period"), [("rows", 7), ("rows", 20), ("columns", 60)])
@pytest.mark.parametrize("rig", ["ultracam-x-mini", "dmc-mini"])
def test_stripes_on_the_ground_that_all_heads_see_are_no_steps(
    rig: str, axis: str, period: int
) -> None:
    outcome = with_stripes(rendered(rig), axis, period).outcome()
    assert outcome.figure("signal_step_sensor") is None, outcome.sentences
    assert outcome.figure("block_sensor") is None, outcome.sentences


def with_stripes(exposure: InjectedExposure, axis: str, period: int) -> InjectedExposure:
    """Stripes of 20 % more light on the ground, along rows or columns of the virtual image."""
    truth = exposure.truth.truth
    for sensor in exposure.rig.sensors:
        name = sensor.name
        key = "vip_row" if axis == "rows" else "vip_column"
        at = RectBivariateSpline(
            truth[f"{name}.rows"], truth[f"{name}.columns"], truth[f"{name}.{key}"], kx=1, ky=1
        )(np.arange(sensor.height_px), np.arange(sensor.width_px))
        factor = 1.0 + 0.2 * (np.floor(at / period).astype(int) % 2)

        def brightened(frame: Any, factor: Any = factor) -> Any:
            signal = (frame.astype(np.float64) - BLACK_DN) * factor + BLACK_DN
            return np.clip(np.rint(signal), 0, 4095).astype(np.uint16)

        exposure = exposure.with_frame(name, brightened)
    return exposure


@pytest.mark.parametrize("factor", [0.5, 0.85, 1.3])
def test_a_pan_head_with_another_exposure_is_named_and_draws_no_other(
    error_free: InjectedExposure, factor: float
) -> None:
    clean = error_free.outcome()
    outcome = error_free.with_frame("SU11", gain(factor)).outcome()
    assert outcome.verdict == "usable" and outcome.figure("gain_outlier") == "SU11"
    assert outcome.figure("gain_outlier_signal") == pytest.approx(factor, rel=0.02)
    assert not outcome.figure("gain_outlier_alternatives")
    both = (outcome.product.pan > 0) & (clean.product.pan > 0)
    ratio = np.median(outcome.product.pan[both] / clean.product.pan[both])
    assert ratio == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize("sensor", ["SU00", "SU10"])
def test_of_two_pan_heads_both_are_named_where_one_has_another_exposure(sensor: str) -> None:
    outcome = rendered("ultracam-l-mini").with_frame(sensor, gain(0.5)).outcome()
    assert outcome.verdict == "usable"
    alternatives = outcome.figure("gain_outlier_alternatives")
    assert {outcome.figure("gain_outlier"), alternatives} == {"SU00", "SU10"}
    assert f"times the signal of {alternatives} in the overlaps, which" in outcome.sentences


@pytest.mark.parametrize("sensor", ["R", "SU11", "SU30"])
def test_a_head_exposed_half_as_long_as_its_record_states_keeps_its_level(
    error_free: InjectedExposure, sensor: str
) -> None:
    clean = error_free.outcome()
    pan, red = clean.product.pan.copy(), clean.product.colour["red"].copy()
    times_s = {**error_free.conditions.exposure_time_s}
    times_s[sensor] *= 0.5
    planted = error_free.with_frame(sensor, gain(0.5))
    planted = replace(planted, conditions=replace(planted.conditions, exposure_time_s=times_s))
    outcome = planted.outcome()
    assert outcome.verdict == "good" and "UNDEREXPOSED" in outcome.flags
    assert outcome.figure("exposure_scaled_sensor") == sensor
    assert outcome.figure("gain_outlier") is None and "as its record states" in outcome.sentences
    for before, after in ((pan, outcome.product.pan), (red, outcome.product.colour["red"])):
        both = (before > 0) & (after > 0)
        assert np.median(after[both] / before[both]) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("unknown", [("R",), ("G", "N")])
def test_a_colour_head_without_a_stated_exposure_time_is_not_good(
    error_free: InjectedExposure, unknown: tuple[str, ...]
) -> None:
    times_s = {n: t for n, t in error_free.conditions.exposure_time_s.items() if n not in unknown}
    conditions = replace(error_free.conditions, exposure_time_s=times_s)
    outcome = replace(error_free, conditions=conditions).outcome()
    assert outcome.verdict == "usable" and outcome.flags == {"UNDEREXPOSED"}
    assert outcome.figure("exposure_unknown_sensors") == ", ".join(unknown)
    assert f"no exposure time of {', '.join(unknown)}:" in outcome.sentences


def test_unknown_exposure_times_of_pan_lost_or_of_all_heads_are_not_named(
    error_free: InjectedExposure,
) -> None:
    times_s = dict(error_free.conditions.exposure_time_s)
    present = set(error_free.frames)

    def unknown(*without: str, lost: str = "") -> Any:
        stated = {n: t for n, t in times_s.items() if n not in without}
        figures = unknown_exposure_figures(error_free.rig, present - {lost}, stated)
        return figures.exposure_unknown_sensors

    assert unknown() == () and unknown("SU00", "SU30") == ()
    assert unknown("B", lost="B") == () and unknown("B") == ("B",)
    assert unknown(*times_s) == ()


def test_red_exposed_half_as_long_without_saying_so_is_seen_over_a_flight(
    error_free: InjectedExposure,
) -> None:
    usual = error_free.outcome().product.report.figures.of(BandLevelFigures).level_by_band
    changed = error_free.with_frame("R", gain(0.5)).outcome()
    assert changed.verdict == "good"  # one exposure cannot show it
    halved = changed.product.report.figures.of(BandLevelFigures).level_by_band
    flight = {3: usual, 4: halved, 6: {}, 7: usual}
    down, up = level_steps(flight)
    assert (down.band, down.before, down.exposure) == ("red", 3, 4)
    assert (up.band, up.before, up.exposure) == ("red", 4, 7)
    assert down.factor == pytest.approx(0.5, rel=0.02) and "level of red" in down.sentence


def test_common_ground_of_few_frames_finds_no_blur_and_raises_nothing(
    error_free: InjectedExposure,
) -> None:
    places = nominal_placements(error_free.rig, {}, error_free.conditions.tdi_shifts)
    for names in ((), ("SU30",), ("G",), ("SU30", "G"), ("R", "G", "B", "N")):
        frames = {name: error_free.frames[name] * np.uint16(8) for name in names}
        ground = measure_common_windows(error_free.rig, places, frames)
        assert ground is not None and ground.names == tuple(
            s.name for s in error_free.rig.sensors if s.name in names
        )
        blur = local_blur_figures(error_free.rig, ground)
        for deficit, limit in zip(
            (blur.colour_blur_deficit, blur.pan_blur_deficit), SUSPICIOUS, strict=True
        ):
            assert deficit is None or deficit < limit


def test_ground_that_changes_several_bands_is_no_step_of_one() -> None:
    fields = {"red": 0.77, "green": 0.90, "blue": 0.55, "nir": 2.3}
    water = {"red": 0.80, "green": 1.20, "blue": 1.46, "nir": 0.32}
    soil = {"red": 1.12, "green": 0.96, "blue": 0.71, "nir": 1.2}
    assert level_steps({1: fields, 2: fields, 3: water, 4: soil, 5: fields}) == ()
    red = {**fields, "red": 0.77 * 1.6}
    assert level_steps({1: fields, 2: red}) == ()
    assert level_steps({1: fields, 2: {**fields, "red": 0.77 * 1.7}})[0].band == "red"


@pytest.mark.parametrize(("sensor", "size"), [("SU11", (0, 0)), ("SU30", (0, 0)), ("SU02", (1, 5))])
def test_a_blurred_or_smeared_head_is_named(
    error_free: InjectedExposure, sensor: str, size: tuple[int, int]
) -> None:
    def blurred(frame: Any) -> Any:
        if size == (0, 0):
            return cv2.GaussianBlur(frame, size, 1.5)
        return cv2.blur(frame, size)

    outcome = error_free.with_frame(sensor, blurred).outcome()
    assert outcome.verdict == "usable" and "BLUR" in outcome.flags
    assert outcome.figure("blurred_sensor") == sensor and outcome.figure("blurred_ratio") < 0.6


@pytest.mark.parametrize(
    ("named", "change"),
    [("left-justified", lambda f: f << 4), ("byte-swapped", lambda f: f.byteswap())],
)
def test_values_of_another_format_are_named(
    error_free: InjectedExposure, named: str, change: Callable[[Any], Any]
) -> None:
    outcome = error_free.with_frame("SU20", change).outcome()
    assert outcome.verdict == "refly" and outcome.figure("word_format") == named
    assert outcome.figure("word_format_sensors") == "SU20" and "pixel format" in outcome.sentences


def test_formats_of_pixel_values_by_the_rig_file(error_free: InjectedExposure) -> None:
    frame = error_free.frames["SU00"]
    right = error_free.rig.sensor("SU00")
    left = replace(right, justified="left")
    assert wrong_format(right, frame) is None and wrong_format(left, frame << 4) is None
    assert wrong_format(left, frame) == "right-justified"
    assert wrong_format(right, frame + np.uint16(4096)) == "beyond 12 bits"


@pytest.mark.parametrize(
    ("sensor", "dn", "rows", "columns"),
    [
        ("SU11", 40, slice(300, 500), slice(400, 700)),
        ("SU00", 40, slice(0, 300), slice(0, 400)),
        ("G", 40, slice(300, 500), slice(400, 700)),
    ],
)
def test_a_block_with_another_offset_is_named_with_an_edge(
    error_free: InjectedExposure, sensor: str, dn: int, rows: slice, columns: slice
) -> None:
    outcome = error_free.with_frame(sensor, block(dn, rows, columns)).outcome()
    assert outcome.verdict == "usable" and "FRAME_CORRUPT" in outcome.flags
    assert outcome.figure("block_sensor") == sensor and "no other head shows" in outcome.sentences
    assert abs(outcome.figure("block_step_dn")) == pytest.approx(abs(dn), rel=0.3)
    edges = (rows if outcome.figure("block_axis") == "rows" else columns).indices(1248)[:2]
    assert outcome.figure("block_at") + 1 in edges


def test_a_block_over_ground_of_other_brightness_on_each_side_is_named() -> None:
    planted = block(600, slice(72, 200), slice(209, 401))
    outcome = rendered("dmc-mini").with_frame("G", planted).outcome()
    assert outcome.verdict == "usable" and outcome.figure("block_sensor") == "G"


@pytest.mark.parametrize("rig", ["ultracam-x-mini", "ultracam-l-mini", "dmc-mini"])
def test_a_block_is_named_or_smaller_than_what_the_report_states(rig: str) -> None:
    exposure = rendered(rig)
    sensors = [cone.sensors[0] for cone in exposure.rig.cones]
    for sensor in sensors[:: max(1, len(sensors) // 3)]:
        part = slice(sensor.height_px // 3, 2 * sensor.height_px // 3)
        across = slice(sensor.width_px // 4, sensor.width_px // 2)
        outcome = exposure.with_frame(sensor.name, block(40, part, across)).outcome()
        found = outcome.figure("block_sensor") == sensor.name
        assert found or outcome.figure("block_limit_dn") > 40.0
        assert 40.0 < outcome.figure("block_limit_dn") < 250.0
        assert outcome.figure("block_limit_sensor") in exposure.frames


@pytest.mark.parametrize(("sensor", "level_dn"), [("SU21", 1500), ("G", 1200), ("N", 1500)])
def test_a_head_that_clips_below_full_scale_is_named_with_its_level(
    error_free: InjectedExposure, sensor: str, level_dn: int
) -> None:
    outcome = error_free.with_frame(sensor, clipped(level_dn)).outcome()
    assert outcome.verdict == "usable" and "OVEREXPOSED" in outcome.flags
    assert outcome.figure("clipped_sensor") == sensor
    assert outcome.figure("clipped_dn") == level_dn
    share = float(np.mean(error_free.frames[sensor] >= level_dn))
    assert outcome.figure("clipped_fraction") == pytest.approx(share, rel=0.2)


def test_noise_in_rows_of_a_frame_is_named_and_no_neighbour_is_blurred(
    error_free: InjectedExposure,
) -> None:
    random = np.random.default_rng(5)

    def noisy(frame: Any) -> Any:
        rows = frame.astype(np.float64)
        rows[400:420] += random.normal(0.0, 300.0, rows[400:420].shape)
        return np.clip(np.rint(rows), 0, 4095).astype(np.uint16)

    outcome = error_free.with_frame("SU01", noisy).outcome()
    assert outcome.verdict == "usable" and "FRAME_CORRUPT" in outcome.flags
    assert outcome.figure("noisy_sensor") == "SU01" and outcome.figure("noisy_share") > 0.55
    assert outcome.figure("blurred_sensor") is None, outcome.sentences


EVERYTHING = slice(None)


@pytest.mark.parametrize(
    ("sensor", "kind", "sigma_px", "smear_px", "rows", "columns"),
    [
        ("G", "colour", 3.0, 0, EVERYTHING, EVERYTHING),
        ("R", "colour", 2.0, 0, slice(416, 832), slice(0, 624)),
        ("SU30", "pan", 0.0, 5, slice(0, 416), slice(0, 624)),
        ("SU11", "pan", 1.5, 0, slice(416, 832), slice(624, 1248)),
    ],
)
def test_a_colour_head_or_a_region_without_fine_detail_is_named(
    error_free: InjectedExposure,
    sensor: str,
    kind: str,
    sigma_px: float,
    smear_px: int,
    rows: slice,
    columns: slice,
) -> None:
    def blurred(frame: Any) -> Any:
        if smear_px:
            return cv2.blur(frame, (1, smear_px))
        return cv2.GaussianBlur(frame, (0, 0), sigma_px)

    outcome = error_free.with_frame(sensor, in_part(blurred, rows, columns)).outcome()
    assert outcome.verdict == "usable" and "BLUR" in outcome.flags
    assert outcome.figure(f"{kind}_blur_sensor") == sensor
    region = outcome.figure(f"{kind}_blur_region")
    assert f"{sensor} shows less fine detail" in outcome.sentences and region in outcome.sentences
    if rows != EVERYTHING:
        assert region == (
            f"columns {columns.start} to {columns.stop - 1}, rows {rows.start} to {rows.stop - 1}"
        )


@pytest.mark.parametrize(
    ("rig", "sensor", "axis"),
    [("ultracam-x-mini", "SU21", 1), ("ultracam-x-mini", "B", 0), ("ultracam-l-mini", "RGB", 1)],
)
def test_a_line_stuck_at_a_value_is_named(rig: str, sensor: str, axis: int) -> None:
    exposure = rendered(rig)

    def stuck(frame: Any) -> Any:
        lines = frame if axis == 0 else frame.T
        lines[201] = int(np.median(frame))
        return frame

    outcome = exposure.with_frame(sensor, stuck).outcome()
    assert outcome.verdict == "usable" and "FRAME_CORRUPT" in outcome.flags
    assert outcome.figure("defect_line_sensor") == sensor
    assert outcome.figure("defect_line_axis") == ("rows", "columns")[axis]
    assert outcome.figure("defect_line_at") == 201


@pytest.mark.parametrize(("sensor", "line"), [("SU01", 678), ("N", 613)])
def test_repeated_lines_are_named(error_free: InjectedExposure, sensor: str, line: int) -> None:
    def stuck(frame: Any) -> Any:
        frame[line : line + 20] = frame[line - 1]
        return frame

    outcome = error_free.with_frame(sensor, stuck).outcome()
    assert outcome.verdict == "usable" and "FRAME_CORRUPT" in outcome.flags
    assert outcome.figure("repeated_lines_sensor") == sensor
    assert (outcome.figure("repeated_lines_first"), outcome.figure("repeated_lines")) == (line, 20)

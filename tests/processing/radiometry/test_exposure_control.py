"""Light that changes is followed, within what motion and noise allow; the loop is closed over the
emulated sensor's electronics, which know nothing of the law."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from processing.radiometry.exposure_control import (
    BINS,
    ExposureLimits,
    ExposureSettings,
    light_factor,
    next_settings,
    sampled_histogram,
    settings_for,
    smear_px,
)
from processing.rig import find_rig
from sim_hw.world.electronics import Electronics, true_sensor

ROWS_PER_S = 55.0 / 0.215
LIMITS = ExposureLimits(
    exposure_time_min_us=200.0,
    exposure_time_max_us=20_000.0,
    gain_max_db=12.0,
    tdi_shifts_max=4,
    rows_per_s=ROWS_PER_S,
)


def counts_at(level: float) -> tuple[int, ...]:
    """All pixels at one share of the full scale."""
    counts = [0] * BINS
    counts[int(level * BINS)] = 1000
    return tuple(counts)


def test_what_is_well_exposed_is_left_alone() -> None:
    now = ExposureSettings(4000.0, 0.0, 1)
    assert next_settings(counts_at(0.6), now, LIMITS) is now
    assert next_settings((0,) * BINS, now, LIMITS) is now


def test_saturation_halves_the_light_and_darkness_doubles_it_at_most() -> None:
    assert light_factor(counts_at(0.999), LIMITS) == 0.5
    assert light_factor(counts_at(0.01), LIMITS) == 2.0
    assert light_factor(counts_at(0.4), LIMITS) == pytest.approx(1.5, rel=0.05)


def test_time_comes_first_then_tdi_and_gain_only_when_motion_forbids_more() -> None:
    row_us = 1e6 / ROWS_PER_S
    now = ExposureSettings(1000.0)
    little = settings_for(0.4 * row_us, now, LIMITS)
    assert (little.tdi_shifts, little.gain_db) == (0, 0.0)
    assert little.exposure_time_us == pytest.approx(0.4 * row_us, rel=1e-3)
    more = settings_for(3.2 * row_us, now, LIMITS)
    assert (more.tdi_shifts, more.gain_db) == (3, 0.0)
    much = settings_for(9.0 * row_us, now, LIMITS)
    assert much.tdi_shifts == 4
    assert much.exposure_time_us == pytest.approx(4.5 * row_us, rel=1e-3)
    assert much.gain_db == pytest.approx(6.02, abs=0.02)
    most = settings_for(900.0 * row_us, now, LIMITS)
    assert most.gain_db == LIMITS.gain_max_db


def test_a_head_without_tdi_is_limited_to_short_exposures() -> None:
    limits = ExposureLimits(50.0, 20_000.0, 12.0, 0, ROWS_PER_S, smear_px=0.3)
    found = settings_for(4000.0, ExposureSettings(500.0), limits)
    assert found.tdi_shifts == 0
    assert found.exposure_time_us == pytest.approx(0.3e6 / ROWS_PER_S, abs=0.1)
    assert found.gain_db == pytest.approx(
        20 * math.log10(4000.0 / found.exposure_time_us), abs=0.01
    )


def test_without_height_or_speed_the_time_never_grows() -> None:
    limits = ExposureLimits(50.0, 20_000.0, 12.0, 4, None)
    now = ExposureSettings(2000.0, 0.0, 2)
    brighter = next_settings(counts_at(0.2), now, limits)
    assert (brighter.exposure_time_us, brighter.tdi_shifts) == (2000.0, 2)
    assert brighter.gain_db == pytest.approx(6.02, abs=0.01)
    assert next_settings(counts_at(0.99), now, limits).exposure_time_us == 1000.0


@given(
    light=st.floats(1.0, 1e7),
    rows_per_s=st.floats(10.0, 20_000.0),
    allowed_px=st.floats(0.1, 1.0),
    crab=st.floats(-0.3, 0.3),
    tdi_shifts_max=st.integers(0, 64),
)
def test_no_settings_break_a_limit(
    light: float, rows_per_s: float, allowed_px: float, crab: float, tdi_shifts_max: int
) -> None:
    limits = ExposureLimits(
        *(1.0, 30_000.0, 12.0, tdi_shifts_max, rows_per_s), smear_px=allowed_px, crab_rad=crab
    )
    found = settings_for(light, ExposureSettings(1000.0), limits)
    assert 0.0 <= found.gain_db <= 12.0
    assert 0 <= found.tdi_shifts <= tdi_shifts_max
    assert 1.0 <= found.exposure_time_us <= 30_000.1
    assert smear_px(found, limits) <= allowed_px + rows_per_s * 1e-7 + 1e-6


def test_a_flight_through_changing_light_stays_well_exposed() -> None:
    """Clouds and sun: the light falls to a sixth and comes back, 8 % an exposure."""
    rig = find_rig("ultracam-x-mini")
    sensor = rig.sensor("SU00")
    truth = true_sensor(rig.cone_of("SU00"), sensor, 1, field_radius_mm=40.0)
    random = np.random.default_rng(5)
    ground = random.lognormal(math.log(0.25), 0.5, (sensor.height_px, sensor.width_px))
    ground = np.minimum(ground, 1.5).astype(np.float32)
    electrons = 0.8 * sensor.full_scale_dn * sensor.electrons_per_dn / 4000e-6
    head = Electronics(sensor, truth, electrons)
    black = sensor.black_dn / sensor.full_scale_dn
    limits = ExposureLimits(200.0, 20_000.0, 12.0, 4, ROWS_PER_S, black=black)
    fall = 0.92 ** np.arange(22)
    now = ExposureSettings(16_000.0, 0.0, 4)
    saturated, bright, used = [], [], []
    for number, sun in enumerate([*fall, *fall[::-1]]):
        frame = head.frame(
            ground * np.float32(sun),
            exposure_time_us=now.exposure_time_us,
            tdi_shifts=now.tdi_shifts,
            gain_db=now.gain_db,
            temperature_c=20.0,
            random=np.random.default_rng(number),
        )
        counts = sampled_histogram(frame, sensor.bits)
        saturated.append(float((frame >= sensor.full_scale_dn).mean()))
        bright.append(float(np.percentile(frame, 99)) / sensor.full_scale_dn)
        used.append(now)
        now = next_settings(counts, now, limits)
    assert saturated[0] > 0.01
    assert max(saturated[6:]) < 0.01
    assert min(bright[6:]) > 0.4
    assert max(bright[6:]) < 0.8
    assert all(smear_px(one, limits) <= 0.5 + 1e-6 for one in used[1:])
    assert {one.tdi_shifts for one in used} >= {1, 2, 3}

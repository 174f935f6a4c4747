"""Formats of words, planted in frames of which every 16th row and 4th column is looked at."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.quality.figures.image import WordFormatFigures
from processing.quality.word_format import constant_bits, word_format_figures, wrong_format
from processing.rig import find_rig

MINI = find_rig("ultracam-x-mini")
RIGHT = dataclasses.replace(MINI.sensor("SU00"), bits=12, justified="right")
LEFT = dataclasses.replace(RIGHT, justified="left")
FULL = 4095


def frame(rows: int = 160) -> NDArray[np.uint16]:
    """Any words of 12 bits, right-justified; of 160 rows 1000 are looked at."""
    return np.random.default_rng(1).integers(300, FULL + 1, (rows, 400)).astype(np.uint16)


def test_values_as_the_rig_file_states_them_are_in_order() -> None:
    raw = frame()
    raw[::16] = FULL
    assert wrong_format(RIGHT, raw) is None
    assert wrong_format(LEFT, raw << 4) is None


def test_values_of_another_format_are_named() -> None:
    raw = frame()
    assert wrong_format(RIGHT, raw.byteswap()) == "byte-swapped"
    assert wrong_format(LEFT, (raw << 4).byteswap()) == "byte-swapped"
    assert wrong_format(RIGHT, raw << 4) == "left-justified"
    assert wrong_format(LEFT, raw) == "right-justified"
    assert wrong_format(RIGHT, raw | 0x1000) == "beyond 12 bits"
    assert wrong_format(LEFT, raw | 0x1000) == "beyond 12 bits"
    # Shifted by fewer bits than a justification.
    assert wrong_format(RIGHT, raw << 3) == "beyond 12 bits"
    assert wrong_format(dataclasses.replace(RIGHT, bits=14), raw << 2) is None
    assert wrong_format(dataclasses.replace(RIGHT, bits=14), (raw << 4) | 4) == "left-justified"


@pytest.mark.parametrize(("rows", "wrong"), [(160, True), (176, False)])
def test_one_value_of_a_thousand_is_too_many(rows: int, wrong: bool) -> None:
    """Fewer are bits flipped on the way; so they are where another format is tried."""
    for sensor, plain, flip, formats in (
        (RIGHT, frame(rows), 0x8000, ("byte-swapped", "left-justified")),
        (LEFT, frame(rows) << 4, 0x0001, ("byte-swapped", "right-justified")),
    ):
        flipped = plain.copy()
        flipped[16, 4] = plain[16, 4] ^ flip
        found = wrong_format(sensor, flipped)
        assert found == ("beyond 12 bits" if wrong else None)
        other = plain << 4 if sensor is RIGHT else plain >> 4
        for raw, format_, bad in (
            (plain.byteswap(), formats[0], np.uint16(flip).byteswap()),
            (other, formats[1], 0x0001 if sensor is RIGHT else 0x8000),
        ):
            raw[16, 4] ^= bad
            assert wrong_format(sensor, raw) == ("beyond 12 bits" if wrong else format_)


def test_only_every_sixteenth_row_and_fourth_column_is_looked_at() -> None:
    raw = frame()
    sampled = np.zeros(raw.shape, bool)
    sampled[::16, ::4] = True
    raw[~sampled] = 0xFFFF
    assert wrong_format(RIGHT, raw) is None


def test_values_of_sixteen_bits_may_be_any() -> None:
    for bits, found in ((16, None), (15, "beyond 15 bits")):
        sensor = dataclasses.replace(RIGHT, bits=bits)
        assert wrong_format(sensor, np.full((160, 400), 0xFFFF, np.uint16)) == found


def test_figures_name_formats_and_sensors() -> None:
    good, wrong = frame(), frame().byteswap()
    assert word_format_figures(MINI, {"SU00": good, "SU01": good}) is None
    raw = {"SU00": wrong, "SU01": good, "SU02": wrong, "SU03": good << 4}
    assert word_format_figures(MINI, raw) == WordFormatFigures(
        ("byte-swapped", "left-justified"), ("SU00", "SU02", "SU03")
    )


def noise(mean: float, sigma: float) -> NDArray[np.uint16]:
    values = np.random.default_rng(3).normal(mean, sigma, (832, 1248))
    return np.asarray(np.clip(np.rint(values), 1, FULL - 1), np.uint16)


@pytest.mark.trust
@pytest.mark.parametrize(
    ("mask_or", "mask_and", "bits"),
    [(0, 0xFFFF, ()), (0x80, 0xFFFF, (7,)), (0, 0xFFF0, (0, 1, 2, 3)), (1, 0xFFFF, (0,))],
)
def test_bits_that_never_change_are_named(
    mask_or: int, mask_and: int, bits: tuple[int, ...]
) -> None:
    raw = (noise(1200.0, 250.0) | np.uint16(mask_or)) & np.uint16(mask_and)
    assert constant_bits(RIGHT, raw) == bits
    assert constant_bits(LEFT, raw << 4) == bits
    # Lines that were not read out or are saturated have all bits alike.
    raw[:100], raw[100:200] = 0, FULL
    assert constant_bits(RIGHT, raw) == bits


def test_values_that_hardly_differ_show_no_constant_bit() -> None:
    assert constant_bits(RIGHT, noise(64.0, 1.0)) == ()
    # Calm water and sand: bits between both levels are the same in all values.
    two = np.where(np.arange(1248) < 600, noise(484.0, 1.0), noise(1004.0, 1.0))
    assert constant_bits(RIGHT, two) == ()
    assert constant_bits(RIGHT, np.zeros((832, 1248), np.uint16)) == ()


def test_a_frame_of_one_value_has_no_bit_that_changes() -> None:
    frames = {"SU00": np.full((832, 1248), 1200, np.uint16), "SU10": noise(1200.0, 250.0)}
    found = word_format_figures(MINI, frames)
    assert found is not None and found.constant_bits_sensors == ("SU00",)
    assert found.constant_bits == tuple(str(bit) for bit in range(12))
    assert not found.word_format and not found.word_format_sensors

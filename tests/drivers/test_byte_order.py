"""Byte order of pixels by their values: photographs, ramps, noise, dark and even images."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.cameras.aravis.byte_order import bits_of, is_swapped

Image = NDArray[np.uint16]
ROWS, COLUMNS = 120, 160


def scene(highest: int, noise: float = 0.004, seed: int = 7) -> Image:
    """Smooth ground with edges and noise of the sensor, over the whole range."""
    random = np.random.default_rng(seed)
    rows, columns = np.mgrid[:ROWS, :COLUMNS]
    ground = 0.45 + 0.3 * np.sin(rows / 17) * np.cos(columns / 23) + 0.15 * ((columns // 40) % 2)
    return np.clip((ground + random.normal(0, noise, ground.shape)) * highest, 0, highest).astype(
        np.uint16
    )


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_a_scene_shows_its_byte_order(bits: int) -> None:
    image = scene((1 << bits) - 1)
    assert not is_swapped(image, bits)
    assert is_swapped(image.byteswap(), bits)


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_fewer_bits_at_the_upper_end_of_a_16_bit_format(bits: int) -> None:
    image = scene((1 << bits) - 1) << np.uint16(16 - bits)
    assert not is_swapped(image, 16)
    assert is_swapped(image.byteswap(), 16)


def test_strong_noise_in_a_dark_scene() -> None:
    image = scene(900, noise=0.1)
    assert not is_swapped(image, 16)
    assert is_swapped(image.byteswap(), 16)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((ROWS, COLUMNS), np.uint16),
        np.full((ROWS, COLUMNS), 0x1234, np.uint16),
        scene(200),
        scene(255) << np.uint16(8),
        np.random.default_rng(3).integers(0, 65_536, (ROWS, COLUMNS)).astype(np.uint16),
        scene(65_535)[:1, :32],
        scene(65_535).byteswap()[:1, :63],
    ],
    ids=["dark", "even", "lower-byte", "upper-byte", "noise", "small", "small-swapped"],
)
def test_what_decides_nothing_is_not_reported(image: Image) -> None:
    assert not is_swapped(image, 16)
    assert not is_swapped(image.byteswap(), 16)


def test_a_few_hot_or_wrong_pixels_are_no_wrong_order() -> None:
    image = scene(4095)
    image[::3] = 0xFFFF
    assert not is_swapped(image, 12)
    saturated = np.full((ROWS, COLUMNS), 0xFFFF, np.uint16)
    assert not is_swapped(saturated, 12), "the other order is no better"


def test_the_sample_is_of_the_whole_height() -> None:
    image = np.zeros((3200, 300), np.uint16)
    image[50:] = scene(4095).repeat(30, axis=0)[:3150, :1].repeat(300, axis=1) + 5
    assert is_swapped(image.byteswap(), 12)


@pytest.mark.parametrize(
    ("name", "bits"), [("Mono12", 12), ("BayerRG10", 10), ("Mono16", 16), ("0x0110", 16)]
)
def test_the_name_of_a_format_states_its_bits(name: str, bits: int) -> None:
    assert bits_of(name) == bits

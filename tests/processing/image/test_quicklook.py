"""The quick look shows detail, hue and holes."""

from __future__ import annotations

import numpy as np

from processing.image.quicklook import quicklook


def test_it_is_about_1200_pixels_wide_and_holes_are_dark_red() -> None:
    pan = np.full((2226, 3480), 8000, np.uint16)
    pan[:, 1740:] = 16000
    pan[600:900, 300:600] = 0
    picture = quicklook(pan, {})
    assert picture.shape == (742, 1160, 3) and picture.dtype == np.uint8
    assert np.all(picture[205:295, 105:195] == (70, 20, 20))
    assert picture[10, 1000].min() > picture[10, 100].max() + 50
    assert np.all(np.ptp(picture[10].astype(int), axis=1) == 0)


def test_colour_gives_the_hue_and_pan_the_brightness() -> None:
    rng = np.random.default_rng(1)
    pan = rng.integers(5000, 15000, (600, 1200)).astype(np.uint16)
    bands = {band: np.full((200, 400), 6000, np.uint16) for band in ("red", "green", "blue")}
    bands["red"][:, 300:] = 5000
    bands["green"][:, 300:] = 3000
    bands["blue"][:, 300:] = 1500
    picture = quicklook(pan, bands).astype(int)
    grey, red = picture[:, :850], picture[:, 950:]
    assert np.all(np.ptp(grey, axis=2) <= 2)
    assert np.mean(red[..., 0]) > np.mean(red[..., 1]) > np.mean(red[..., 2])
    means = picture.mean(axis=2)
    assert np.corrcoef(means[:, :850].ravel(), pan[:, :850].ravel())[0, 1] > 0.95


def test_an_image_without_any_data_is_one_hole() -> None:
    assert np.all(quicklook(np.zeros((300, 400), np.uint16), {}) == (70, 20, 20))

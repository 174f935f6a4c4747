"""Pansharpening keeps the colour's radiometry and the PAN's geometry, in numbers."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from processing.image import pansharpening
from processing.image.pansharpening import pansharpened
from tests.processing.textures import Texture, box_means

WEIGHTS = {"red": 0.35, "green": 0.4, "blue": 0.25}


def scene(ratio, size=360, seed=3):
    """Bands of one scene at PAN resolution, the PAN image over them, and colour in blocks."""
    rng = np.random.default_rng(seed)
    common = Texture(size, rng, cutoff=0.3).moved(0.0, 0.0) - 2000.0
    bands = {}
    for k, name in enumerate([*WEIGHTS, "nir"]):
        hue = Texture(size, rng, cutoff=0.04).moved(0.0, 0.0) - 2000.0
        bands[name] = 6000.0 + 1500.0 * k + 6.0 * common + 8.0 * hue
        # Edges of one colour only: roofs and cars.
        bands[name][100:140, 50 + 60 * k : 90 + 60 * k] *= 1.8
    bands = {name: np.clip(band, 300.0, 32000.0) for name, band in bands.items()}
    pan = sum(weight * bands[name] for name, weight in WEIGHTS.items())
    colour = {
        name: np.rint(box_means(band, ratio)).astype(np.uint16) for name, band in bands.items()
    }
    return bands, np.rint(pan).astype(np.uint16), colour


@pytest.mark.parametrize("ratio", [2, 3, 4])
def test_the_mean_over_each_colour_pixel_is_that_colour_pixel(ratio):
    _, pan, colour = scene(ratio)
    for name, sharp in pansharpened(pan, colour, ratio).items():
        error = box_means(sharp.astype(np.float64), ratio) / colour[name] - 1.0
        assert np.abs(error).max() < 0.005, name
        assert np.sqrt(np.mean(error**2)) < 0.0005, name


def test_the_detail_lies_where_pan_has_it():
    """The shift of the sharpened detail against PAN's, by least squares over its gradients."""
    _, pan, colour = scene(3)

    def detail(image):
        fine = image.astype(np.float64)
        return fine - cv2.GaussianBlur(fine, (0, 0), 2.0)

    given = detail(pan)
    down, right = np.gradient(given)
    design = np.stack([given.ravel(), right.ravel(), down.ravel()], axis=1)
    for name, sharp in pansharpened(pan, colour, 3).items():
        found = detail(sharp).ravel()
        contrast, *moved = np.linalg.lstsq(design, found, rcond=None)[0]
        assert np.hypot(*moved) / contrast < 0.005, name
        assert np.corrcoef(design[:, 0], found)[0, 1] > 0.9, name


def test_the_truth_is_nearer_than_colour_that_is_only_enlarged():
    bands, pan, colour = scene(3)
    for name, sharp in pansharpened(pan, colour, 3).items():
        enlarged = cv2.resize(colour[name].astype(np.float32), (360, 360))
        ours = np.sqrt(np.mean((sharp - bands[name]) ** 2))
        theirs = np.sqrt(np.mean((enlarged - bands[name]) ** 2))
        # Near infrared is no part of PAN here: it gains less.
        assert ours < (0.7 if name == "nir" else 0.5) * theirs, name


def test_uniform_colour_over_uniform_pan_stays_as_it_is():
    pan = np.full((30, 36), 5000, np.uint16)
    sharp = pansharpened(pan, {"red": np.full((10, 12), 1234, np.uint16)}, 3)["red"]
    assert np.all(sharp == 1234)


def test_holes_in_pan_and_in_colour_are_no_data_and_darken_no_neighbour():
    pan = np.full((60, 60), 4000, np.uint16)
    pan[10:20, 31:40] = 0
    colour = np.full((20, 20), 900, np.uint16)
    colour[8:12, 2:6] = 0
    sharp = pansharpened(pan, {"red": colour}, 3)["red"]
    expected = np.full((60, 60), 900)
    expected[10:20, 31:40] = 0
    expected[24:36, 6:18] = 0
    assert np.array_equal(sharp, expected)


def test_data_never_become_no_data_and_never_wrap():
    pan = np.full((30, 30), 2, np.uint16)
    pan[::3, ::3] = 65535
    sharp = pansharpened(pan, {"red": np.full((10, 10), 9000, np.uint16)}, 3)["red"]
    assert sharp.min() >= 1
    assert sharp[0, 0] == 65535


def test_strips_make_no_difference(monkeypatch):
    _, pan, colour = scene(3)
    full_image = pansharpened(pan, colour, 3)
    monkeypatch.setattr(pansharpening, "STRIP_ROWS", 17)
    for name, sharp in pansharpened(pan, colour, 3).items():
        assert np.abs(sharp.astype(int) - full_image[name]).max() <= 1


def test_rows_and_columns_beyond_the_last_complete_colour_pixel_are_filled():
    _, pan, colour = scene(3)
    pan = np.pad(pan, ((0, 2), (0, 1)), mode="edge")
    sharp = pansharpened(pan, colour, 3)["green"]
    assert sharp.shape == (362, 361)
    assert np.abs(sharp[360:].astype(int) - sharp[359]).max() <= 1
    assert np.abs(sharp[:, 360].astype(int) - sharp[:, 359]).max() <= 1


def test_colour_that_does_not_belong_to_the_pan_image_is_refused():
    pan = np.ones((30, 30), np.uint16)
    with pytest.raises(ValueError, match=r"red is uint16 of shape \(9, 10\)"):
        pansharpened(pan, {"red": np.ones((9, 10), np.uint16)}, 3)
    with pytest.raises(ValueError, match="PAN is float64"):
        pansharpened(np.ones((30, 30)), {}, 3)

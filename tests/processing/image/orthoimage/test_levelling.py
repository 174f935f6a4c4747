"""Levelling of a block: light that was planted is taken out, ground that differs stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.image.orthoimage.levelling import ImageLevels, level_block, levelled

SIZE = 24
STEP = 9


def _block(random: np.random.Generator, planted) -> tuple[list[ImageLevels], np.ndarray]:
    """Twelve images in three lines over rough ground, and the block each is nearest to."""
    ground = random.normal(0.0, 0.6, (2, 60, 60))
    images, centres = [], []
    for k in range(12):
        row, column = (k // 4) * 15, (k % 4) * STEP
        own = ground[:, row : row + SIZE, column : column + SIZE].copy()
        v, u = np.mgrid[0:SIZE, 0:SIZE] / (SIZE - 1) - 0.5
        own += planted(k, v, u)
        images.append(ImageLevels(row, column, own.astype(np.float32)))
        centres.append((row + SIZE / 2, column + SIZE / 2))
    r, c = np.mgrid[0:60, 0:60]
    distance = np.array([np.maximum(abs(r - y), abs(c - x)) for y, x in centres])
    owner = np.where(distance.min(axis=0) <= SIZE / 2 - 1, distance.argmin(axis=0), -1)
    return images, owner


def _seams(images: list[ImageLevels], signals: list[np.ndarray], owner: np.ndarray) -> float:
    """RMS difference of all images to the one a block is taken from."""
    taken = np.full((2, 60, 60), np.nan)
    for k, (image, signal) in enumerate(zip(images, signals, strict=True)):
        part = owner[image.row : image.row + SIZE, image.column : image.column + SIZE] == k
        taken[:, image.row : image.row + SIZE, image.column : image.column + SIZE][:, part] = (
            signal[:, part]
        )
    found = [
        signal - taken[:, image.row : image.row + SIZE, image.column : image.column + SIZE]
        for image, signal in zip(images, signals, strict=True)
    ]
    return float(np.sqrt(np.nanmean(np.square(found))))


def _light(k: int, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Exposure, a gradient of haze, and a hot spot that lies elsewhere in every line."""
    spot = 0.15 * np.exp(-((v - 0.2) ** 2 + (u - 0.1 * (k // 4)) ** 2) / 0.08)
    return np.array(
        [0.2 * np.sin(3 * k) + 0.1 * u * (-1) ** k + spot, 0.1 * np.cos(k) + 0.5 * spot]
    )


def test_exposure_haze_and_hot_spot_are_taken_out() -> None:
    images, owner = _block(np.random.default_rng(1), _light)
    fields = level_block(images, owner)
    before = _seams(images, [image.log_signal for image in images], owner)
    after = _seams(images, [levelled(i, f) for i, f in zip(images, fields, strict=True)], owner)
    assert before > 0.1
    assert after < 0.005


def test_light_that_haze_adds_is_taken_out_of_dark_ground_too() -> None:
    """A gradient of a tenth of the mean signal, which turns with the line; ground of contrast."""
    random = np.random.default_rng(4)
    images, owner = _block(random, lambda k, v, u: 0.05 * np.sin(3 * k))
    u = np.arange(SIZE) / (SIZE - 1)
    added = []
    for k, image in enumerate(images):
        haze = 0.1 * (u if k // 4 % 2 else u[::-1])
        added.append(haze)
        image.log_signal[:] = np.log(np.exp(image.log_signal) + haze)
    fields = level_block(images, owner)
    before = _seams(images, [image.log_signal for image in images], owner)
    after = _seams(images, [levelled(i, f) for i, f in zip(images, fields, strict=True)], owner)
    flat = [replace(field, haze=np.zeros_like(field.haze)) for field in fields]
    gain_only = _seams(images, [levelled(i, f) for i, f in zip(images, flat, strict=True)], owner)
    assert before > 0.05 and gain_only > 0.02
    assert after < 0.006
    for field, haze in zip(fields, added, strict=True):
        slope = field.haze[..., -1].mean() - field.haze[..., 0].mean()
        # Images of one line share their gradient: overlaps show a part of it only.
        assert 0.2 < slope / (haze[-1] - haze[0]) < 1.1


def test_a_block_without_differences_stays_as_it_is() -> None:
    images, owner = _block(np.random.default_rng(2), lambda k, v, u: 0.0)
    for field in level_block(images, owner):
        assert np.abs(field.log_gain).max() < 1e-6


def test_a_thing_that_moved_levels_nothing() -> None:
    images, owner = _block(np.random.default_rng(3), lambda k, v, u: 0.0)
    images[5].log_signal[:, 3:6, 3:6] += 2.0
    for field in level_block(images, owner):
        assert np.abs(field.log_gain).max() < 0.02


def test_images_without_overlap_keep_their_signal() -> None:
    levels = [ImageLevels(0, 0, np.ones((1, 4, 4), np.float32))]
    field = level_block(levels, np.zeros((4, 4), int))[0]
    assert levelled(levels[0], field) == pytest.approx(levels[0].log_signal)

"""Band-limited textures that can be moved by any fraction of a pixel without interpolation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEVEL = 2000.0
CONTRAST = 200.0


class Texture:
    """A periodic texture of n x n pixels: amplitude falls with frequency, none above `cutoff`."""

    def __init__(self, size: int, rng: np.random.Generator, *, cutoff: float = 0.3) -> None:
        self.fx = np.fft.fftfreq(size)[None, :]
        self.fy = np.fft.fftfreq(size)[:, None]
        frequency = np.hypot(self.fx, self.fy)
        amplitude = np.exp(-((frequency / cutoff) ** 4)) / np.maximum(frequency, 2.0 / size)
        amplitude[0, 0] = 0.0
        amplitude[(np.abs(self.fx) == 0.5) | (np.abs(self.fy) == 0.5)] = 0.0
        spectrum = np.fft.fft2(rng.normal(size=(size, size))) * amplitude
        self.spectrum = spectrum * (CONTRAST / np.fft.ifft2(spectrum).real.std())

    def moved(self, dx: float, dy: float) -> Array:
        """The texture with its content moved by (dx, dy) px to the right and down."""
        phase_factor = np.exp(-2j * np.pi * (self.fx * dx + self.fy * dy))
        return np.asarray(np.fft.ifft2(self.spectrum * phase_factor).real + LEVEL)


def box_means(image: Array, ratio: int) -> Array:
    """Means of ratio x ratio pixels, the first box in the corner."""
    rows, columns = image.shape[0] // ratio, image.shape[1] // ratio
    boxes = image[: rows * ratio, : columns * ratio].reshape(rows, ratio, columns, ratio)
    return np.asarray(boxes.mean(axis=(1, 3)))

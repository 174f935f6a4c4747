"""Resampling of an image to ground pixels: image, pose and surface in, ground tile out.

Every ground pixel is projected into the image by the collinearity equations and interpolated once,
with a kernel of six by six pixels. Ground that another part of the surface hides from the camera is
not detected: height models of bare ground at nadir rarely hide any.

Source: docs/explanation/mathematics/orthomosaic.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel
from processing.image.kernels import KERNELS, Interpolation
from processing.image.orthoimage.ground_grid import GroundSurface
from processing.image.taps import weights_at

Array = NDArray[Any]

GROUND_INTERPOLATION: Final[Interpolation] = "lanczos"
"""Up to 0.15 cycles per pixel contrast changes with the sub-pixel phase by 1 %, place by 0.02 px.
The phase-corrected kernel, made for measuring, keeps the place and amplifies by up to 8 %."""
_TAPS: Final = 6


@dataclass(frozen=True)
class ImagePose:
    """Geometry of an image without distortion, and where it was taken.

    Attributes:
        f_mm, pixel_mm: principal distance and size of a pixel.
        width_px, height_px: of the image.
        centre_m: projection centre in the Cartesian system of the surface, (3,).
        rotation: object from camera, (3, 3); camera x right, y up in the image, z backwards.
        principal_px: column and row of the principal point; by default the middle of the image.
    """

    f_mm: float
    pixel_mm: float
    width_px: int
    height_px: int
    centre_m: Array
    rotation: Array
    principal_px: tuple[float, float] | None = None

    @property
    def principal(self) -> tuple[float, float]:
        """Column and row of the principal point, px."""
        return self.principal_px or ((self.width_px - 1) / 2.0, (self.height_px - 1) / 2.0)

    def window(self, column: int, row: int, width_px: int, height_px: int) -> ImagePose:
        """Pose of a part of the image.

        Args:
            column: first column, px.
            row: first row, px.
            width_px: columns of the part.
            height_px: rows of the part.

        Returns:
            The pose with the principal point in the pixels of the part.
        """
        x, y = self.principal
        return replace(
            self, width_px=width_px, height_px=height_px, principal_px=(x - column, y - row)
        )

    def reduced(self, factor: int) -> ImagePose:
        """Pose of the image that `reduced_image` makes.

        Args:
            factor: pixels to a block along each axis.

        Returns:
            The pose with larger pixels.

        Example:
            >>> pose = ImagePose(100.0, 0.01, 9, 8, np.zeros(3), np.eye(3)).reduced(4)
            >>> pose.width_px, pose.height_px, pose.principal
            (2, 2, (0.625, 0.5))
        """
        x, y = self.principal
        return replace(
            self,
            pixel_mm=self.pixel_mm * factor,
            width_px=self.width_px // factor,
            height_px=self.height_px // factor,
            principal_px=((x + 0.5) / factor - 0.5, (y + 0.5) / factor - 0.5),
        )


def reduced_image(pixels: Array, factor: int) -> Array:
    """Means of blocks of pixels: an image for a coarser ground sampling distance, without aliases.

    Args:
        pixels: (bands, h, w) uint16, 0 is no data.
        factor: pixels to a block along each axis; columns and rows beyond the last whole block are
            left out.

    Returns:
        (bands, h // factor, w // factor) float32; 0 where a pixel of the block has no data.

    Example:
        >>> reduced_image(np.array([[[2, 4, 0, 4], [2, 4, 4, 4]]], np.uint16), 2)
        array([[[3., 0.]]], dtype=float32)
    """
    height, width = (n // factor for n in pixels.shape[1:])
    result = np.zeros((len(pixels), height, width), np.float32)
    for band, out in zip(pixels, result, strict=True):
        cut = np.ascontiguousarray(band[: height * factor, : width * factor])
        cv2.resize(cut.astype(np.float32), (width, height), out, interpolation=cv2.INTER_AREA)
        whole = cv2.erode((cut > 0).astype(np.uint8), np.ones((factor, factor), np.uint8))
        # With an even kernel the anchor is pixel factor // 2 of the block.
        out[whole[factor // 2 :: factor, factor // 2 :: factor][:height, :width] == 0] = 0.0
    return result


def project(surface: GroundSurface, pose: ImagePose) -> Array:
    """Columns and rows in the image of the pixels of a surface.

    Args:
        surface: ground pixels, shape (h, w).
        pose: of the image.

    Returns:
        (2, h, w) float64, px; NaN where the height is not known or the camera looks away.

    Source: docs/explanation/mathematics/coordinates.md, collinearity equations.

    Example:
        From 1000 m with f = 100 mm and 10 um, pixels are 0.1 m; 3 m east are 30 columns.

        >>> from processing.image.orthoimage.ground_grid import GroundGrid, ground_surface
        >>> surface = ground_surface(GroundGrid(3.0, 0.0, 0.1, 1, 1), 0.0)
        >>> pose = ImagePose(100.0, 0.01, 101, 101, np.array([0.0, 0.0, 1000.0]), np.eye(3))
        >>> project(surface, pose).ravel().round(6)
        array([80., 50.])
    """
    nodes = _camera_nodes(surface, pose)
    out = np.empty((2, *surface.above_m.shape))
    x, y = pose.principal
    _project(nodes, surface.above_m, surface.step_px, pose.f_mm / pose.pixel_mm, x, y, out)
    return out


def window_seen(surface: GroundSurface, pose: ImagePose) -> tuple[int, int, int, int] | None:
    """Part of the image that a surface takes its pixels from, with the reach of the kernel.

    Args:
        surface: ground pixels.
        pose: of the image.

    Returns:
        First column, first row, columns and rows, px; None if no pixel lies in the image.
    """
    known = np.isfinite(surface.above_m)
    if not known.any():
        return None
    heights = np.array([surface.above_m[known].min(), surface.above_m[known].max()])
    nodes = _camera_nodes(surface, pose)
    at = nodes[None, :, :, :3] + nodes[None, :, :, 3:] * heights[:, None, None, None]
    ahead = at[..., 2] < 0.0
    if not ahead.any():
        return None
    x, y = pose.principal
    scale = pose.f_mm / pose.pixel_mm
    column = (x - scale * at[..., 0] / at[..., 2])[ahead]
    row = (y + scale * at[..., 1] / at[..., 2])[ahead]
    # Between nodes the projection bends by less than the margin.
    first_c, first_r = (max(int(np.floor(v.min())) - _TAPS, 0) for v in (column, row))
    last_c = min(int(np.ceil(column.max())) + _TAPS, pose.width_px - 1)
    last_r = min(int(np.ceil(row.max())) + _TAPS, pose.height_px - 1)
    if last_c < first_c or last_r < first_r:
        return None
    return first_c, first_r, last_c - first_c + 1, last_r - first_r + 1


def resample_to_ground(
    pixels: Array,
    pose: ImagePose,
    surface: GroundSurface,
    *,
    wanted: Array | None = None,
    interpolation: Interpolation = GROUND_INTERPOLATION,
) -> Array:
    """Resample an image to ground pixels.

    Args:
        pixels: (bands, h, w) uint16 or float32, linear signal, 0 is no data.
        pose: of the image; for a part or a reduction of it, `ImagePose.window` or `reduced`.
        surface: ground pixels.
        wanted: (rows, columns) bool, ground pixels to compute; None: all.
        interpolation: kernel.

    Returns:
        (bands, rows, columns) float32; 0 where the image has no data or the height is not known.
        Next to missing pixels interpolation is bilinear.

    Raises:
        ValueError: the pixels are not those of the pose.
    """
    if pixels.ndim != 3 or pixels.shape[1:] != (pose.height_px, pose.width_px):
        raise ValueError(
            f"pixels have shape {pixels.shape}; the pose is of (bands, {pose.height_px}, "
            f"{pose.width_px})"
        )
    out = np.zeros((len(pixels), *surface.above_m.shape), np.float32)
    if min(pixels.shape[1:]) < _TAPS:
        return out
    mask = np.ones(surface.above_m.shape, np.bool_) if wanted is None else wanted
    x, y = pose.principal
    _resample_to_ground(
        np.ascontiguousarray(pixels),
        _camera_nodes(surface, pose),
        surface.above_m,
        mask,
        surface.step_px,
        pose.f_mm / pose.pixel_mm,
        x,
        y,
        KERNELS[interpolation].table,
        out,
    )
    return out


def _camera_nodes(surface: GroundSurface, pose: ImagePose) -> Array:
    """Nodes in camera axes, (r, c, 6): position at the reference height, what a metre adds."""
    base = (surface.base_m - pose.centre_m) @ pose.rotation
    return np.ascontiguousarray(np.concatenate([base, surface.up_m @ pose.rotation], axis=-1))


@compiled_kernel(inline="always")
def _place(nodes, i, j, step, above, scale, x0, y0):
    """Column and row of ground pixel (i, j); NaN where it is not seen."""
    r, c = i // step, j // step
    v, u = (i - r * step) / step, (j - c * step) / step
    w00, w01, w10, w11 = (1.0 - v) * (1.0 - u), (1.0 - v) * u, v * (1.0 - u), v * u
    x = y = z = 0.0
    a, b = nodes[r, c], nodes[r, c + 1]
    d, e = nodes[r + 1, c], nodes[r + 1, c + 1]
    x = w00 * (a[0] + above * a[3]) + w01 * (b[0] + above * b[3])
    x += w10 * (d[0] + above * d[3]) + w11 * (e[0] + above * e[3])
    y = w00 * (a[1] + above * a[4]) + w01 * (b[1] + above * b[4])
    y += w10 * (d[1] + above * d[4]) + w11 * (e[1] + above * e[4])
    z = w00 * (a[2] + above * a[5]) + w01 * (b[2] + above * b[5])
    z += w10 * (d[2] + above * d[5]) + w11 * (e[2] + above * e[5])
    if not z < 0.0:
        return np.nan, np.nan
    return x0 - scale * x / z, y0 + scale * y / z


@compiled_kernel()
def _project(nodes, above, step, scale, x0, y0, out):
    for i in range(above.shape[0]):
        for j in range(above.shape[1]):
            column, row = _place(nodes, i, j, step, above[i, j], scale, x0, y0)
            out[0, i, j] = column
            out[1, i, j] = row


@compiled_kernel()
def _resample_to_ground(pixels, nodes, above, wanted, step, scale, x0, y0, table, out):
    bands, height, width = pixels.shape
    wx = np.empty(6, np.float32)
    wy = np.empty(6, np.float32)
    for i in range(above.shape[0]):
        for j in range(above.shape[1]):
            if not wanted[i, j]:
                continue
            column, row = _place(nodes, i, j, step, above[i, j], scale, x0, y0)
            # Also false for NaN. Half a pixel beyond the last centre still belongs to the image.
            if not (-0.5 <= column <= width - 0.5 and -0.5 <= row <= height - 0.5):
                continue
            c = min(max(int(np.floor(column)), 0), width - 2)
            r = min(max(int(np.floor(row)), 0), height - 2)
            fx = np.float32(min(max(column - c, 0.0), 1.0))
            fy = np.float32(min(max(row - r, 0.0), 1.0))
            inner = 2 <= c < width - 3 and 2 <= r < height - 3
            if inner:
                for at, x in ((wx, fx), (wy, fy)):
                    k, beyond = weights_at(table, x)
                    for m in range(6):
                        at[m] = table[k, m] + beyond * table[k, m + 6]
            for band in range(bands):
                image = pixels[band]
                whole = inner
                total = np.float32(0.0)
                if inner:
                    for m in range(6):
                        line = np.float32(0.0)
                        for n in range(6):
                            value = np.float32(image[r - 2 + m, c - 2 + n])
                            whole &= value > 0.0
                            line += wx[n] * value
                        total += wy[m] * line
                if not whole:
                    p, q = np.float32(image[r, c]), np.float32(image[r, c + 1])
                    s, t = np.float32(image[r + 1, c]), np.float32(image[r + 1, c + 1])
                    if not (p > 0.0 and q > 0.0 and s > 0.0 and t > 0.0):
                        continue
                    upper = p + (q - p) * fx
                    total = upper + (s + (t - s) * fx - upper) * fy
                out[band, i, j] = max(total, np.float32(0.001))

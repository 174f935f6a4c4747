"""Registering the bands of a rig without a virtual image to one of them, the reference band.

Heads looking side by side at different light: a coarse search on reduced gradient images finds
shifts of many pixels, then patches are matched in raw geometry and a projective transformation is
fitted. The plane of the result is the ideal image of the reference band.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import (
    SensorPlacement,
    nominal_placements,
    raw_from_vip_mm,
    vip_mm_from_px,
    vip_mm_from_raw,
)
from processing.geometry.projective import apply_projective
from processing.image.colour import fit_projective
from processing.matching.patches import INTERPOLATION, MARGIN_PX, match_patches, select_features
from processing.rig import Rig, VirtualImage

Array = NDArray[Any]

_LATTICE_PX: Final = 8
"""Distortion bends by 2e-4 px per px2 at most: a bilinear lattice of this spacing errs by 0.002."""


@dataclass(frozen=True)
class BandSettings:
    """How bands are matched. The coarse stage works on frames reduced `reduction` times."""

    points: int = 3000
    window_px: int = 25
    search_px: int = 6
    last_search_px: int = 3
    min_correlation: float = 0.5
    min_peak_margin: float = 0.05
    max_sigma_px: float = 0.25
    min_points: int = 60
    reduction: int = 4
    coarse_points: int = 200
    coarse_window_px: int = 41
    coarse_search_px: int = 24
    coarse_min_points: int = 12


@dataclass(frozen=True)
class RegisteredBand:
    """One band against the reference.

    `band_from_reference` (3, 3) carries a point of the reference band's ideal image in mm to where
    the band's own calibration has it. `shift_px` (columns right, rows down) is the raw displacement
    of the points, mean; `largest_shift_px` its largest length. `rms_px` is the root mean square
    length of the residuals of the `points` kept, and `rms_x_px`, `rms_y_px` its parts.
    `registered` False: too few points, the band keeps its calibrated position.
    """

    band: str
    sensor: str
    band_from_reference: Array
    points: int
    attempted: int
    rms_px: float | None
    rms_x_px: float | None
    rms_y_px: float | None
    shift_px: tuple[float, float]
    largest_shift_px: float
    registered: bool


def reference_image(rig: Rig) -> VirtualImage:
    """The ideal image of the reference band: its own pixels, principal point in the middle.

    Args:
        rig: a rig whose colour master cone is the reference band.

    Returns:
        Size, pitch and principal distance of the reference band, without drift.

    Raises:
        ValueError: the rig names no colour master cone.
    """
    if rig.colour_master_cone is None:
        raise ValueError(f"rig {rig.name} has no colour_master_cone; it is the reference band")
    cone = rig.cone(rig.colour_master_cone)
    sensor = cone.sensors[0]
    return VirtualImage(sensor.width_px, sensor.height_px, sensor.pitch_um, cone.lens.f_mm, 1)


def band_placements(rig: Rig, temperatures_c: Mapping[str, float]) -> dict[str, SensorPlacement]:
    """Where calibration puts each band in the reference image.

    Args:
        rig: as of `reference_image`.
        temperatures_c: temperature by probe name, degC.

    Returns:
        Placements by sensor name.
    """
    return nominal_placements(replace(rig, virtual_image=reference_image(rig)), temperatures_c, {})


def register_to_reference(
    band: str,
    reference: SensorPlacement,
    other: SensorPlacement,
    reference_frame: Array,
    band_frame: Array,
    *,
    settings: BandSettings | None = None,
) -> RegisteredBand:
    """Estimate the transformation of a band against the reference band.

    Args:
        band: name of the band.
        reference: placement of the reference band by calibration.
        other: placement of the band by calibration.
        reference_frame: (h, w) float32 in raw geometry, NaN where a pixel is not to be used.
        band_frame: the same of the band.
        settings: windows, searches and limits; None takes the defaults.

    Returns:
        The registration; the identity with `registered` False where too few points agree.
    """
    settings = settings or BandSettings()
    nominal = RegisteredBand(
        band, other.sensor.name, np.eye(3), 0, 0, None, None, None, (0.0, 0.0), 0.0, False
    )
    homography = _coarse(reference, other, reference_frame, band_frame, settings)
    if homography is None:
        return nominal
    found = nominal
    for search in (settings.search_px, settings.last_search_px):
        found = _refine(found, reference, other, (reference_frame, band_frame), homography,
                        search, settings)  # fmt: skip
        if not found.registered:
            return replace(found, band_from_reference=np.eye(3))
        homography = found.band_from_reference
    return found


def raw_of_reference_pixels(
    image: VirtualImage, placement: SensorPlacement, band_from_reference: Array
) -> Array:
    """Raw (column, row) of a band behind every pixel of the reference image.

    Args:
        image: from `reference_image`.
        placement: of the band, by calibration.
        band_from_reference: (3, 3), mm in the ideal image, of a `RegisteredBand`.

    Returns:
        (H, W, 2) float32; pixels the lens polynomial cannot reach are far outside.
    """
    columns = np.arange(0, image.width_px + _LATTICE_PX, _LATTICE_PX)
    rows = np.arange(0, image.height_px + _LATTICE_PX, _LATTICE_PX)
    nodes = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(np.float64)
    there = apply_projective(band_from_reference, vip_mm_from_px(image, nodes))
    raw = raw_from_vip_mm(placement, there).reshape(len(rows), len(columns), 2)
    raw = np.nan_to_num(raw, nan=-1e4)
    at_c, at_r = np.arange(image.width_px), np.arange(image.height_px)
    c, r = at_c // _LATTICE_PX, at_r // _LATTICE_PX
    fc = ((at_c % _LATTICE_PX) / _LATTICE_PX)[None, :, None]
    fr = ((at_r % _LATTICE_PX) / _LATTICE_PX)[:, None, None]
    along = raw[:, c] * (1.0 - fc) + raw[:, c + 1] * fc
    dense: Array = (along[r] * (1.0 - fr) + along[r + 1] * fr).astype(np.float32)
    return dense


def _coarse(
    reference: SensorPlacement,
    other: SensorPlacement,
    reference_frame: Array,
    band_frame: Array,
    settings: BandSettings,
) -> Array | None:
    """A first transformation from reduced gradient images, whose sign no band inverts."""
    k = settings.reduction
    small_reference = _gradient(_reduced(reference_frame, k))
    small_band = _gradient(_reduced(band_frame, k))
    at = _positions(small_reference, settings.coarse_window_px, settings.coarse_points)
    middle = (k - 1) / 2.0
    raw = at * k + middle
    predicted = raw_from_vip_mm(other, vip_mm_from_raw(reference, raw))
    at_band = (predicted - middle) / k
    found = _match(
        small_reference, small_band, at, at_band,
        (settings.coarse_window_px, settings.coarse_search_px), settings,
    )  # fmt: skip
    if len(found) < settings.coarse_min_points:
        return None
    source = vip_mm_from_raw(reference, found[:, 0:2] * k + middle)
    target = vip_mm_from_raw(other, found[:, 2:4] * k + middle)
    # The densest shift: false matches of another band scatter, true ones agree within a few pixels.
    shift = target - source
    unit_mm = other.sensor.pitch_mm * k
    near = np.hypot(*(shift[:, None, :] - shift[None, :, :]).transpose(2, 0, 1)) < 2.0 * unit_mm
    best = near[int(near.sum(axis=1).argmax())]
    if int(best.sum()) < settings.coarse_min_points:
        return None
    homography = np.eye(3)
    homography[:2, 2] = shift[best].mean(axis=0)
    return homography


def _refine(
    found: RegisteredBand,
    reference: SensorPlacement,
    other: SensorPlacement,
    frames: tuple[Array, Array],
    homography: Array,
    search_px: int,
    settings: BandSettings,
) -> RegisteredBand:
    at = _positions(frames[0], settings.window_px, settings.points)
    predicted = raw_from_vip_mm(
        other, apply_projective(homography, vip_mm_from_raw(reference, at.astype(np.float64)))
    )
    matches = _match(frames[0], frames[1], at, predicted, (settings.window_px, search_px), settings)
    if len(matches) < settings.min_points:
        return replace(found, points=len(matches), attempted=len(at), registered=False)
    source = vip_mm_from_raw(reference, matches[:, 0:2])
    target = vip_mm_from_raw(other, matches[:, 2:4])
    sigma_mm = np.maximum(matches[:, 4], 0.02) * other.sensor.pitch_mm
    fitted, rms_mm, used = fit_projective(source, target, sigma_mm)
    residual_px = (target - apply_projective(fitted, source)) / other.sensor.pitch_mm
    length = np.hypot(residual_px[:, 0], residual_px[:, 1])
    retained = np.argsort(length)[:used]
    rms_x, rms_y = np.sqrt(np.mean(residual_px[retained] ** 2, axis=0))
    shift = matches[retained, 2:4] - matches[retained, 0:2]
    return replace(
        found,
        band_from_reference=fitted,
        points=used,
        attempted=len(at),
        rms_px=rms_mm / other.sensor.pitch_mm,
        rms_x_px=float(rms_x),
        rms_y_px=float(rms_y),
        shift_px=(float(shift[:, 0].mean()), float(shift[:, 1].mean())),
        largest_shift_px=float(np.hypot(shift[:, 0], shift[:, 1]).max()),
        registered=used >= settings.min_points,
    )


def _match(
    frame_a: Array,
    frame_b: Array,
    at_a: Array,
    predicted: Array,
    window_and_search_px: tuple[int, int],
    settings: BandSettings,
) -> Array:
    """Accepted rows of `match_patches`, (n, 8)."""
    window_px, search_px = window_and_search_px
    margin_px = window_px // 2 + MARGIN_PX + 2
    height, width = frame_b.shape
    with np.errstate(invalid="ignore"):
        inside = (
            (predicted[:, 0] >= margin_px)
            & (predicted[:, 0] <= width - 1 - margin_px)
            & (predicted[:, 1] >= margin_px)
            & (predicted[:, 1] <= height - 1 - margin_px)
        )
    found = match_patches(
        frame_a,
        frame_b,
        at_a[inside],
        np.rint(predicted[inside]).astype(np.int64),
        np.array([0, width - 1, 0, height - 1], dtype=np.int64),
        1,
        window_px // 2,
        search_px,
        False,
        INTERPOLATION,
    )
    accepted: Array = found[
        (found[:, 7] > 0.0)
        & (found[:, 4] <= settings.max_sigma_px)
        & (found[:, 5] >= settings.min_correlation)
        & (found[:, 6] >= settings.min_peak_margin)
    ]
    return accepted


def _positions(frame: Array, window_px: int, points: int) -> Array:
    """Feature-rich pixels on an even grid, (n, 2) int64 (column, row)."""
    margin_px = window_px // 2 + MARGIN_PX + 2
    height, width = frame.shape
    right, bottom = width - 1 - margin_px, height - 1 - margin_px
    if right <= margin_px or bottom <= margin_px:
        return np.empty((0, 2), dtype=np.int64)
    spacing = max(np.sqrt((right - margin_px) * (bottom - margin_px) / points), 3.0)
    columns = np.linspace(margin_px, right, max(2, round((right - margin_px) / spacing) + 1))
    rows = np.linspace(margin_px, bottom, max(2, round((bottom - margin_px) / spacing) + 1))
    c, r = (grid.ravel() for grid in np.meshgrid(range(len(columns) - 1), range(len(rows) - 1)))
    cells = np.stack(
        [np.ceil(columns[c]), np.floor(columns[c + 1]) - 1, np.ceil(rows[r]),
         np.floor(rows[r + 1]) - 1], axis=1,
    ).astype(np.int64)  # fmt: skip
    best = select_features(frame, cells, window_px // 2, 1, False)
    positions: Array = best[best[:, 2] > 0.0, :2].astype(np.int64)
    return positions


def _reduced(frame: Array, factor: int) -> Array:
    height, width = frame.shape[0] // factor, frame.shape[1] // factor
    blocks = frame[: height * factor, : width * factor].reshape(height, factor, width, factor)
    means: Array = blocks.mean(axis=(1, 3), dtype=np.float32)
    return means


def _gradient(frame: Array) -> Array:
    """Length of the gradient of a lightly smoothed frame; NaN spreads."""
    smooth = cv2.GaussianBlur(frame, (0, 0), 1.0)
    dx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0)
    dy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    length: Array = cv2.magnitude(dx, dy)
    return length

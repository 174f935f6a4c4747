"""Which head sees which colours, and registering them to green.

Heads are registered by projective transformations; green itself is placed by the adjustment of the
mosaic, and the pixels are fetched in `processing.image.resampling`.

Source: Heier et al. (2002), 6.1; Ladstädter et al. (2010), steps 5 and 6 of the previous versions.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement, raw_from_vip_mm, vip_mm_from_raw
from processing.geometry.projective import apply_projective
from processing.matching.patches import INTERPOLATION, MARGIN_PX, match_patches, select_features
from processing.matching.texture import has_texture
from processing.radiometry.demosaic import BAYER_BANDS, is_bayer
from processing.radiometry.level1 import exposed_rows
from processing.rig import Rig, Sensor

Array = NDArray[Any]

_ROUNDS: Final = 8
_TUKEY: Final = 4.685


@dataclass(frozen=True)
class ColourSettings:
    """How colour is matched to green; lengths in colour pixels.

    Bands see different light, so less correlation is asked than between PAN heads.
    """

    points: int = 600
    window_px: int = 17
    search_px: int = 5
    min_correlation: float = 0.45
    min_peak_margin: float = 0.05
    max_sigma_px: float = 0.3
    min_points: int = 40


@dataclass(frozen=True)
class ColourHead:
    """One colour sensor and the bands it gives; all of them share its geometry.

    `leading` is the band the head is matched by: green of a Bayer head, else its only one.
    """

    sensor: Sensor
    bands: tuple[str, ...]
    leading: str


def colour_heads(rig: Rig) -> tuple[ColourHead, ...]:
    """The colour heads of a rig, the colour master's first.

    A cone of one band has it on its only sensor; a cone of several has them behind the colour
    filter array of its only sensor. Of two heads that see the same band the first gives it.

    Args:
        rig: the camera.

    Returns:
        Heads that give a band; cones of several sensors are left out.
    """
    heads: list[ColourHead] = []
    given: set[str] = set()
    cones = sorted(rig.colour_cones, key=lambda cone: cone.name != rig.colour_master_cone)
    for cone in cones:
        sensor = cone.sensors[0]
        if len(cone.sensors) > 1:
            continue
        if is_bayer(sensor):
            seen = [band for band in cone.bands if band in BAYER_BANDS]
            leading = "green"
        elif len(cone.bands) == 1:
            seen, leading = list(cone.bands), cone.bands[0]
        else:
            continue
        bands = tuple(band for band in seen if band not in given)
        given.update(bands)
        if bands:
            heads.append(ColourHead(sensor, bands, leading))
    return tuple(heads)


@dataclass(frozen=True)
class BandRegistration:
    """One head, by its leading band, against green.

    `band_from_green` (3, 3) carries a VIP point in mm to where the band's own placement has it.
    Where too few points were found it is the identity: the band stays as calibrated, and
    `registered` is False; `textured` counts the positions that were tried there and where the band
    has texture well above noise, `matched` those that matched all the same. `rms_px` is the
    residual length per point, colour pixels. `matched_at` (n, 2) are the places of all matches in
    the band's frame, `green_at` (n, 2) those in green, `sigma_px` (n,) the standard deviation of a
    coordinate of each, colour pixels; `unmatched_at` (m, 2) the positions in green that did not
    match.
    """

    band: str
    sensor: str
    band_from_green: Array
    points: int
    rms_px: float | None
    registered: bool
    textured: int = 0
    matched: int = 0
    matched_at: Array = field(default_factory=lambda: np.zeros((0, 2)), compare=False, repr=False)
    unmatched_at: Array = field(
        default_factory=lambda: np.zeros((0, 2), np.int64), compare=False, repr=False
    )
    green_at: Array = field(default_factory=lambda: np.zeros((0, 2)), compare=False, repr=False)
    sigma_px: Array = field(default_factory=lambda: np.zeros(0), compare=False, repr=False)


def nominal_registration(
    band: str, sensor: str, *, textured: int = 0, matched: int = 0
) -> BandRegistration:
    """A band at its calibrated position.

    Args:
        band: name of the band.
        sensor: name of its sensor.
        textured: positions tried where the band has texture.
        matched: positions that matched, too few for a transformation.

    Returns:
        The identity, `registered` False.
    """
    return BandRegistration(
        band, sensor, np.eye(3), 0, None, registered=False, textured=textured, matched=matched
    )


def register_band(
    band: str,
    green: SensorPlacement,
    other: SensorPlacement,
    green_frame: Array,
    band_frame: Array,
    *,
    positions: Array,
    settings: ColourSettings,
) -> BandRegistration:
    """Estimate the transformation of a band against green.

    Args:
        band: name of the band.
        green: adjusted placement of the green sensor.
        other: placement of the band's sensor by calibration and TDM.
        green_frame: Level-1 frame of green, (h, w) uint16.
        band_frame: Level-1 frame of the band, (h, w) uint16.
        positions: where to match, from `green_positions`; the same for all bands.
        settings: windows, searches and limits.

    Returns:
        The registration; `nominal_registration` where too few points match.
    """
    raw_green, raw_band, sigma, unmatched = _match(
        green, other, green_frame, band_frame, positions, settings
    )
    if len(sigma) < settings.min_points:
        expected = raw_from_vip_mm(other, vip_mm_from_raw(green, positions.astype(np.float64)))
        at = np.rint(expected[np.isfinite(expected).all(axis=1)]).astype(np.int64)
        rough = has_texture(band_frame, other.sensor, at, settings.window_px)
        return nominal_registration(
            band,
            other.sensor.name,
            textured=int(np.count_nonzero(rough)),
            matched=len(sigma),
        )
    matched = BandRegistration(
        band,
        other.sensor.name,
        np.eye(3),
        0,
        None,
        registered=False,
        matched_at=raw_band,
        unmatched_at=unmatched,
        green_at=raw_green,
        sigma_px=sigma,
    )
    return fitted_registration(matched, green, other, np.ones(len(sigma), np.bool_), settings)


def fitted_registration(
    matched: BandRegistration,
    green: SensorPlacement,
    other: SensorPlacement,
    keep: Array,
    settings: ColourSettings,
) -> BandRegistration:
    """Estimate the transformation of a band against green from some of its matches.

    Args:
        matched: the band with its n matches.
        green: adjusted placement of the green sensor.
        other: placement of the band's sensor by calibration and TDM.
        keep: matches to use, (n,).
        settings: limits.

    Returns:
        The registration; as calibrated, `registered` False, where fewer matches are used than a
        transformation needs.
    """
    if np.count_nonzero(keep) < settings.min_points:
        return replace(matched, band_from_green=np.eye(3), points=0, rms_px=None, registered=False)
    source = vip_mm_from_raw(green, matched.green_at[keep])
    target = vip_mm_from_raw(other, matched.matched_at[keep])
    unit_mm = vip_mm_per_pixel(other, matched.matched_at)
    homography, rms, used = fit_projective(source, target, matched.sigma_px[keep] * unit_mm)
    return replace(
        matched,
        band_from_green=homography,
        points=used,
        rms_px=rms / unit_mm,
        registered=used >= settings.min_points,
    )


def green_positions(green: SensorPlacement, green_frame: Array, settings: ColourSettings) -> Array:
    """Feature-rich pixels of the green frame on an even grid.

    Args:
        green: placement of the green sensor.
        green_frame: Level-1 frame, (h, w) uint16.
        settings: number of points and window.

    Returns:
        (n, 2) int64, column and row.
    """
    cells = _grid(green, _window_margin_px(settings), settings)
    best = select_features(green_frame, cells, settings.window_px // 2, 2, True)
    positions: Array = best[best[:, 2] > 0.0, :2].astype(np.int64)
    return positions


def fit_projective(source: Array, target: Array, sigma: Array) -> tuple[Array, float, int]:
    """The projective transformation near the identity that carries source to target.

    Iteratively re-weighted least squares (Tukey's biweight): neither a moving car nor a false match
    can pull it.

    Args:
        source: (n, 2), any unit.
        target: (n, 2), the same unit.
        sigma: standard deviation of each point, (n,), the same unit.

    Returns:
        target_from_source (3, 3) with element [2, 2] one; root mean square length of the residuals
        of the points kept; how many were kept.
    """
    scale = float(np.abs(source).max()) or 1.0
    p, q = source / scale, target / scale
    h = np.eye(3)
    keep = np.ones(len(p), dtype=np.bool_)
    residuals = np.zeros_like(p)
    for _ in range(_ROUNDS):
        residuals = q - apply_projective(h, p)
        length = np.hypot(residuals[:, 0], residuals[:, 1]) / (sigma / scale)
        spread = max(1.4826 * float(np.median(length)) / 1.1774, 1e-9)
        outlying = length / (_TUKEY * spread)
        weight = (
            np.where(outlying < 1.0, (1.0 - outlying**2) ** 2, 0.0) / (sigma / sigma.mean()) ** 2
        )
        keep = outlying < 1.0
        design = _design(h, p) * np.sqrt(np.repeat(weight, 2))[:, None]
        step, *_ = np.linalg.lstsq(
            design, residuals.ravel() * np.sqrt(np.repeat(weight, 2)), rcond=None
        )
        h = h + np.append(step, 0.0).reshape(3, 3)
        if float(np.abs(step).max()) < 1e-12:
            break
    residuals = q - apply_projective(h, p)
    rms = float(np.sqrt(np.mean(np.sum(residuals[keep] ** 2, axis=1)))) * scale
    # Undo the scaling of both sides: H_mm = S H S^-1 with S = diag(scale, scale, 1).
    unscaled = np.diag([scale, scale, 1.0]) @ h @ np.diag([1.0 / scale, 1.0 / scale, 1.0])
    return unscaled / unscaled[2, 2], rms, int(np.count_nonzero(keep))


def _design(h: Array, p: Array) -> Array:
    """d(target) / d(h11 .. h32), rows x, y per point: (2 n, 8)."""
    w = h[2, 0] * p[:, 0] + h[2, 1] * p[:, 1] + h[2, 2]
    at = apply_projective(h, p)
    design = np.zeros((len(p), 2, 8))
    homogeneous = np.column_stack([p, np.ones(len(p))]) / w[:, None]
    design[:, 0, 0:3] = homogeneous
    design[:, 1, 3:6] = homogeneous
    design[:, :, 6:8] = -at[:, :, None] * homogeneous[:, None, :2]
    return design.reshape(-1, 8)


def vip_mm_per_pixel(placement: SensorPlacement, raw: Array) -> float:
    """Size of a frame's pixel in the virtual image plane.

    Args:
        placement: of the frame.
        raw: places (n, 2), px, at whose centre it is wanted.

    Returns:
        mm.
    """
    middle = raw.mean(axis=0)
    corners = middle + np.array([[0.0, 0.0], [100.0, 0.0]])
    xy = vip_mm_from_raw(placement, corners)
    return float(np.hypot(*(xy[1] - xy[0]))) / 100.0


def _match(
    green: SensorPlacement,
    other: SensorPlacement,
    green_frame: Array,
    band_frame: Array,
    at_green: Array,
    settings: ColourSettings,
) -> tuple[Array, Array, Array, Array]:
    margin_px = _window_margin_px(settings)
    predicted = raw_from_vip_mm(other, vip_mm_from_raw(green, at_green.astype(np.float64)))
    first, last = exposed_rows(other.sensor, other.tdi_shifts)
    limits = np.array([0, other.sensor.width_px - 1, first, last], dtype=np.int64)
    with np.errstate(invalid="ignore"):
        inside = (
            (predicted[:, 0] >= limits[0] + margin_px)
            & (predicted[:, 0] <= limits[1] - margin_px)
            & (predicted[:, 1] >= limits[2] + margin_px)
            & (predicted[:, 1] <= limits[3] - margin_px)
        )
    found = match_patches(
        green_frame,
        band_frame,
        at_green[inside],
        np.rint(predicted[inside]).astype(np.int64),
        limits,
        1,
        settings.window_px // 2,
        settings.search_px,
        True,
        INTERPOLATION,
    )
    matched = (
        (found[:, 7] > 0.0)
        & (found[:, 4] <= settings.max_sigma_px)
        & (found[:, 5] >= settings.min_correlation)
        & (found[:, 6] >= settings.min_peak_margin)
    )
    unmatched = at_green[inside][~matched]
    found = found[matched]
    return found[:, 0:2], found[:, 2:4], np.maximum(found[:, 4], 0.005), unmatched


def _window_margin_px(settings: ColourSettings) -> int:
    """Pixels a window needs between its centre and the frame's border."""
    return settings.window_px // 2 + MARGIN_PX + 2


def _grid(green: SensorPlacement, margin_px: int, settings: ColourSettings) -> Array:
    first, last = exposed_rows(green.sensor, green.tdi_shifts)
    left, right = margin_px, green.sensor.width_px - 1 - margin_px
    top, bottom = first + margin_px, last - margin_px
    if right <= left or bottom <= top:
        return np.empty((0, 4), dtype=np.int64)
    spacing = max(np.sqrt((right - left) * (bottom - top) / settings.points), 4.0)
    columns = np.linspace(left, right, max(2, round((right - left) / spacing) + 1))
    rows = np.linspace(top, bottom, max(2, round((bottom - top) / spacing) + 1))
    grid = np.meshgrid(np.arange(len(columns) - 1), np.arange(len(rows) - 1))
    c, r = grid[0].ravel(), grid[1].ravel()
    # One pixel short, so that neighbouring cells share no position.
    return np.stack(
        [
            np.ceil(columns[c]),
            np.floor(columns[c + 1]) - 1,
            np.ceil(rows[r]),
            np.floor(rows[r + 1]) - 1,
        ],
        axis=1,
    ).astype(np.int64)

"""What an image is really off by, in place and in radiance, against what its report states.

Truth is the emulator's: its exact mapping of every raw pixel, and the radiance that fell on it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.stats import chi2

from benchmarks.silent_errors.exposures import EmulatedExposure
from benchmarks.uncertainty_consistency import NormalizedErrors, normalized_errors
from processing.geometry.exposure_times import reference_exposure_times
from processing.geometry.placement import vip_mm_from_raw, vip_px_from_mm
from processing.geometry.projective import apply_projective
from processing.mosaic.precision import disturbance_covariance_px, placed_covariance_px
from processing.pipelines.perspective import HeadsProduct
from processing.pipelines.stitched import Product
from processing.quality.figures.stitching import PrecisionFigures
from processing.radiometry.demosaic import BAYER_BANDS, is_bayer
from processing.rig import Sensor
from sim_hw.truth_comparison import on_sensor, true_positions

Array = NDArray[Any]

BLOCKS: Final = 8
"""Regions of a frame along each side whose radiance is compared."""
MIN_PIXELS: Final = 12
CHECK: Final = (5, 5)
WITHOUT_DATA: Final = 1e-6
"""Weight of pixels without data up to which an interpolated value counts as measured."""
BY_CHANCE: Final = 1e-3
"""Probability with which the errors of any head exceed their limit where the covariance holds."""
DARK: Final = 0.02
"""Radiance below which a relative error is meaningless."""


@dataclass(frozen=True)
class Found:
    """Errors of one image, and what is stated of it.

    `error_px` is the RMS of a coordinate over the image, `stated_px` the report's sigma, `worst`
    the RMS error of the worst PAN sensor `worst_of` over its own stated sigma, `worst_limit` what
    that ratio reaches in one of 1,000 images where the stated covariance holds. `normalised` are
    the errors of check points against the stated covariance, `freedom` the degrees of freedom of
    their mean square. `band_px` is the largest RMS error of a colour band, colour pixels.
    `radiance` is the largest relative error of a region, `radiance_of` its sensor. Against the
    image of the same exposure without a fault, `detail` is the least share of the fine detail of a
    sensor, `blank` the largest share of its part of the image that has no data, `blank_of` the
    sensor.
    """

    error_px: float | None
    stated_px: float | None
    worst: float | None
    worst_of: str
    worst_limit: float | None
    normalised: NormalizedErrors | None
    freedom: float | None
    band_px: float
    radiance: float
    radiance_of: str
    detail: float
    blank: float
    blank_of: str


@dataclass(frozen=True)
class CleanImage:
    """By sensor, what the image of an exposure without a fault shows.

    `detail` is its fine detail, (2, 2, 2), `blank` the share of pixels without data.
    """

    detail: Mapping[str, Array] = field(default_factory=dict)
    blank: Mapping[str, float] = field(default_factory=dict)


def compare(
    emulated: EmulatedExposure, product: Product | HeadsProduct, clean: CleanImage
) -> Found:
    """Compare an image with the truth.

    Args:
        emulated: the exposure it was made of.
        product: the image and its report.
        clean: the image of the exposure without a fault (`image_of`).
    """
    regions = _radiance(emulated, product)
    worst = max(regions, key=lambda name: regions[name], default="")
    shown = image_of(emulated, product)
    blank = {n: share - clean.blank.get(n, share) for n, share in shown.blank.items()}
    blank_of = max(blank, key=lambda name: blank[name], default="")
    found = Found(
        error_px=None,
        stated_px=None,
        worst=None,
        worst_of="",
        worst_limit=None,
        normalised=None,
        freedom=None,
        band_px=0.0,
        radiance=regions.get(worst, 0.0),
        radiance_of=worst,
        detail=_least_share(shown.detail, clean.detail),
        blank=blank.get(blank_of, 0.0),
        blank_of=blank_of,
    )
    if isinstance(product, HeadsProduct):
        return found
    errors = _errors(emulated, product)
    every = np.concatenate(list(errors.values()))
    stated = product.report.figures.of(PrecisionFigures).stitched_sigma_px
    points = _check_points(emulated, product)
    ratio, name, limit = _worst_head(emulated, product, errors, points)
    normalised, freedom = _normalised(emulated, product, points)
    return replace(
        found,
        error_px=float(np.sqrt(np.mean(every**2))),
        stated_px=None if stated is None else float(stated),
        worst=ratio,
        worst_of=name,
        worst_limit=limit,
        normalised=normalised,
        freedom=freedom,
        band_px=max(_bands(emulated, product).values(), default=0.0),
    )


def _errors(emulated: EmulatedExposure, product: Product) -> dict[str, Array]:
    """Truth minus place of the pixels behind the image, (n, 2) px, by PAN sensor."""
    truth, geometry = emulated.snapshot.truth, product.geometry[product.mosaic.method]
    found = {}
    for name in truth["pan_sensors"].tolist():
        if f"{name}.vip" not in geometry or name in emulated.elsewhere:
            continue
        used = geometry[f"{name}.weight"] > 0
        vip, raw = (
            np.asarray(geometry[f"{name}.{what}"][used], np.float64) for what in ("vip", "raw")
        )
        inside = on_sensor(truth, name, raw)
        raw, vip = raw[inside], vip[inside]
        found[name] = _true(emulated, name, raw) - vip
    return found or {"": np.zeros((1, 2))}


def _true(emulated: EmulatedExposure, name: str, raw: Array) -> Array:
    """Where the content of raw pixels belongs in the virtual image."""
    content = emulated.content.get(name)
    return true_positions(emulated.snapshot.truth, name, raw if content is None else content(raw))


def _worst_head(
    emulated: EmulatedExposure,
    product: Product,
    errors: Mapping[str, Array],
    points: Mapping[str, Array],
) -> tuple[float | None, str, float | None]:
    """RMS error over stated sigma, name and limit of the head that exceeds its limit the most."""
    found: list[tuple[float, str, float]] = []
    if product.mosaic.redundancy > 0:
        heads = [name for name in errors if name in points]
        for name in heads:
            covariance = _of_head(emulated, product, name, points[name])
            variance = float(np.trace(covariance)) / len(covariance)
            ratio = float(np.sqrt(np.mean(errors[name] ** 2) / variance))
            found.append((ratio, name, head_limit(covariance, len(heads))))
    return max(found, key=lambda head: head[0] / head[2], default=(None, "", None))


def _of_head(emulated: EmulatedExposure, product: Product, name: str, points: Array) -> Array:
    """Stated covariance of points of one head; what is added for a frame moves it as a whole."""
    mosaic, added = product.mosaic, product.uncertainty_contribution
    tie, datum = placed_covariance_px(
        emulated.rig, mosaic, {name: points}, product.temperatures.usable_c
    )
    image_wide = replace(added, frames={})
    shared = disturbance_covariance_px(emulated.rig, mosaic, {name: points}, image_wide)
    frame = np.diag(added.frames.get(name, np.zeros(2)))
    return np.asarray(tie + datum + shared + np.tile(frame, (len(points), len(points))))


def head_limit(covariance: Array, heads: int) -> float:
    """RMS error over stated sigma that one of `heads` heads reaches in one of 1,000 images.

    Args:
        covariance: of the errors of one head, (n, n).
        heads: that are compared.
    """
    freedom = freedom_of(covariance)
    return float(np.sqrt(chi2.ppf(1.0 - BY_CHANCE / heads, freedom) / freedom))


def freedom_of(covariance: Array) -> float:
    """Degrees of freedom of the chi-square that has the variance of the errors' mean square.

    Source: Satterthwaite, F. E. (1946). Biometrics Bulletin 2(6), 110-114.

    Args:
        covariance: of correlated errors, (n, n).
    """
    return float(np.trace(covariance)) ** 2 / float(np.sum(covariance**2))


def _check_points(emulated: EmulatedExposure, product: Product) -> dict[str, Array]:
    points = {}
    for cone in emulated.rig.pan_cones:
        for s in cone.sensors:
            if s.name in product.mosaic.placements and s.name not in emulated.elsewhere:
                columns = np.linspace(0.03, 0.97, CHECK[0]) * (s.width_px - 1)
                rows = np.linspace(0.03, 0.97, CHECK[1]) * (s.height_px - 1)
                points[s.name] = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    return points


def _normalised(
    emulated: EmulatedExposure, product: Product, points: Mapping[str, Array]
) -> tuple[NormalizedErrors | None, float | None]:
    """Errors of check points against the covariance stated for them, findings included."""
    if not points or product.mosaic.redundancy <= 0:
        return None, None
    image, mosaic = emulated.world.image, product.mosaic
    error = []
    for name, raw in points.items():
        mm = vip_mm_from_raw(mosaic.placements[name], raw)
        off = vip_px_from_mm(image, mm) - _true(emulated, name, raw)
        error.append((off * (1.0, -1.0)).reshape(-1))
    tie, datum = placed_covariance_px(emulated.rig, mosaic, points, product.temperatures.usable_c)
    added = disturbance_covariance_px(
        emulated.rig, mosaic, points, product.uncertainty_contribution
    )
    covariance = tie + datum + added
    return normalized_errors(np.concatenate(error), covariance), freedom_of(covariance)


def _bands(emulated: EmulatedExposure, product: Product) -> dict[str, float]:
    """RMS error of a coordinate of every colour head, colour pixels."""
    image, truth = emulated.world.image, emulated.snapshot.truth
    found = {}
    homographies = {
        r.sensor: np.linalg.inv(r.band_from_green) for r in product.bands if r.registered
    }
    for cone in emulated.rig.cones:
        name = cone.sensors[0].name
        if cone.role != "colour" or name not in emulated.frames or name in emulated.elsewhere:
            continue
        raw = _grid(cone.sensors[0], 32)
        mm = vip_mm_from_raw(product.mosaic.placements[name], raw)
        vip = vip_px_from_mm(image, apply_projective(homographies.get(name, np.eye(3)), mm))
        inside = ((vip >= 0.0) & (vip <= (image.width_px - 1, image.height_px - 1))).all(axis=1)
        inside &= on_sensor(truth, name, raw)
        off = _true(emulated, name, raw[inside]) - vip[inside]
        found[name] = float(np.sqrt(np.mean(off**2))) / image.colour_ratio
    return found


def _grid(sensor: Sensor, step: int) -> Array:
    columns, rows = (
        np.arange(step // 2, size, step, dtype=np.float64)
        for size in (sensor.width_px, sensor.height_px)
    )
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


def _radiance(emulated: EmulatedExposure, product: Product | HeadsProduct) -> dict[str, float]:
    """The largest relative error of the radiance of a region of a frame, by sensor.

    The image's own level (one factor for all PAN, one for each rig of heads' band) is free.
    """
    samples = (
        _of_heads(emulated, product)
        if isinstance(product, HeadsProduct)
        else {**_of_pan(emulated, product), **_of_colour(emulated, product)}
    )
    found = {}
    for name, (raw, shown, true) in samples.items():
        sensor = emulated.rig.sensor(name)
        block = (raw[:, 1] * BLOCKS // sensor.height_px).astype(int) * BLOCKS
        block += (raw[:, 0] * BLOCKS // sensor.width_px).astype(int)
        pixels = np.bincount(block, minlength=BLOCKS**2)
        of_true = np.bincount(block, true, BLOCKS**2)
        of_shown = np.bincount(block, shown, BLOCKS**2)
        enough = (pixels >= MIN_PIXELS) & (of_true > DARK * pixels * np.median(true) * 10)
        if enough.any():
            ratio = of_shown[enough] / of_true[enough]
            found[name] = float(np.max(np.abs(ratio - 1.0)))
    return found


Samples = dict[str, tuple[Array, Array, Array]]


def _of_pan(emulated: EmulatedExposure, product: Product) -> Samples:
    geometry = product.geometry[product.mosaic.method]
    found: Samples = {}
    for name in emulated.snapshot.truth["pan_sensors"].tolist():
        if f"{name}.vip" not in geometry:
            continue
        used = geometry[f"{name}.weight"] > 0.5
        vip = geometry[f"{name}.vip"][used].astype(int)
        raw = geometry[f"{name}.raw"][used]
        shown = product.pan[vip[:, 1], vip[:, 0]] / product.counts_per_dn
        found[name] = _compared(emulated, name, raw, shown)
    return found


def _of_colour(emulated: EmulatedExposure, product: Product) -> Samples:
    image, truth = emulated.world.image, emulated.snapshot.truth
    found: Samples = {}
    for cone in emulated.rig.cones:
        sensor = cone.sensors[0]
        if cone.role != "colour" or sensor.name not in emulated.frames:
            continue
        raw = _grid(sensor, 5)
        band = cone.bands[0]
        if is_bayer(sensor):
            raw, band = raw[_green_sites(sensor, raw)], BAYER_BANDS[1]
        raw = raw[on_sensor(truth, sensor.name, raw)]
        vip = true_positions(truth, sensor.name, raw)
        at = (vip + 0.5) / image.colour_ratio - 0.5
        height, width = product.colour[band].shape
        inside = ((at >= 0.0) & (at <= (width - 1, height - 1))).all(axis=1)
        at, raw = at[inside], raw[inside]
        picture = product.colour[band].astype(np.float32)
        shown = map_coordinates(picture, at.T[::-1], order=1) / product.counts_per_dn
        # Next to pixels without data the interpolated value is too low: not the image's error.
        data = map_coordinates((picture > 0).astype(np.float32), at.T[::-1], order=1)
        at_data = data > 1.0 - WITHOUT_DATA
        raw, shown = raw[at_data], shown[at_data]
        found[sensor.name] = _compared(emulated, sensor.name, raw, shown)
    return found


def _of_heads(emulated: EmulatedExposure, product: HeadsProduct) -> Samples:
    """Green of every head at the raw pixels nearby: its perspective moves pixels but little."""
    found: Samples = {}
    for name, head in product.heads.items():
        sensor = emulated.rig.cone(name).sensors[0]
        raw = _grid(sensor, 7)
        raw = raw[_green_sites(sensor, raw)]
        at = raw.astype(int)
        shown = head.bands[BAYER_BANDS[1]][at[:, 1], at[:, 0]] / 8.0
        found[sensor.name] = _compared(emulated, sensor.name, raw, shown)
    return found


def _green_sites(sensor: Sensor, raw: Array) -> Array:
    letters = sensor.colour_filter_array
    at = raw.astype(int)
    green = np.array([letter == "G" for letter in letters])
    return np.asarray(green[(at[:, 1] % 2) * 2 + at[:, 0] % 2])


def _compared(
    emulated: EmulatedExposure, name: str, raw: Array, shown: Array
) -> tuple[Array, Array, Array]:
    """Raw pixels with data, what the image shows there (DN) and what it should show."""
    cone, sensor = emulated.world.rig.cone_of(name), emulated.rig.sensor(name)
    looks = emulated.snapshot.parameters_by_sensor
    times_us = {sensor_name: look.exposure_time_us for sensor_name, look in looks.items()}
    # The image brings a head that was exposed otherwise to the level of the others of its kind.
    references_us = reference_exposure_times(emulated.world.rig, times_us)
    seconds = references_us.get(name, times_us[name]) * 1e-6
    factor = emulated.world.electrons_per_radiance_s(cone) * seconds / sensor.electrons_per_dn
    at = np.clip(np.rint(raw).astype(int), 0, (sensor.width_px - 1, sensor.height_px - 1))
    true = emulated.snapshot.light[name][at[:, 1], at[:, 0]] * factor
    good = (shown > 0) & (true < 0.9 * (sensor.full_scale_dn - sensor.black_dn))
    return raw[good], shown[good].astype(np.float64), true[good].astype(np.float64)


def image_of(emulated: EmulatedExposure, product: Product | HeadsProduct) -> CleanImage:
    """Fine detail and pixels without data of an image, by sensor."""
    pictures = dict(_pictures(emulated, product))
    return CleanImage(
        {name: _differences(picture) for name, picture in pictures.items()},
        {name: float(np.mean(picture == 0)) for name, picture in pictures.items()},
    )


def _pictures(
    emulated: EmulatedExposure, product: Product | HeadsProduct
) -> Iterator[tuple[str, Array]]:
    """The part of the image that each PAN sensor, colour cone or head makes, by its name."""
    if isinstance(product, HeadsProduct):
        for name, head in product.heads.items():
            yield name, head.bands[BAYER_BANDS[1]]
        return
    truth = emulated.snapshot.truth
    for name in truth["pan_sensors"].tolist():
        columns, rows = (truth[f"{name}.vip_{what}"] for what in ("column", "row"))
        top, low = (int(rows[1:-1, 1:-1].min()), int(rows[1:-1, 1:-1].max()))
        left, right = (int(columns[1:-1, 1:-1].min()), int(columns[1:-1, 1:-1].max()))
        yield name, product.pan[max(top, 0) : low, max(left, 0) : right]
    for cone in emulated.rig.cones:
        if cone.role == "colour":
            yield cone.name, product.colour[cone.bands[0]]


def _differences(picture: Array) -> Array:
    """Mean absolute second difference over a frame's quarters, (2, 2, 2): by axis and place."""
    values = picture.astype(np.float32)
    half = (values.shape[0] // 2, values.shape[1] // 2)
    found = np.zeros((2, 2, 2))
    for i in (0, 1):
        for j in (0, 1):
            part = values[i * half[0] : (i + 1) * half[0], j * half[1] : (j + 1) * half[1]]
            for axis in (0, 1):
                found[axis, i, j] = np.mean(np.abs(np.diff(part, 2, axis=axis)))
    return found


def _least_share(of: Mapping[str, Array], clean: Mapping[str, Array]) -> float:
    """The least share of detail in any part of any picture; a blank one has none."""
    return min(
        (
            float(np.min(detail / np.maximum(clean[name], 1e-6)))
            for name, detail in of.items()
            if name in clean
        ),
        default=1.0,
    )

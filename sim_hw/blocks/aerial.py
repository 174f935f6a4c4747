"""A block of aerial images for aerial triangulation: measurements, navigation, control, truth.

Nothing is rendered: image coordinates are where the true camera sees ground points, by projection
code of the emulator's own, plus noise and a systematic pattern that no calibration knows.

Conventions as in `sim_hw.world.true_camera`; object coordinates are local Cartesian metres, x east,
y north.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from processing.rig import Rig
from sim_hw.world.seeding import random_stream
from sim_hw.world.true_camera import rotation_opk

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_PATTERN_GRID = 25


@dataclass(frozen=True)
class ImageStrip:
    """One flight line: start, heading (degrees, clockwise from north), frames, height."""

    name: str
    start_m: tuple[float, float]
    heading_deg: float
    frames: int
    base_m: float
    height_m: float


@dataclass(frozen=True)
class ImageFormat:
    """The stitched image: half sides mm, principal distance mm, pixel mm."""

    half_width_mm: float
    half_height_mm: float
    f_mm: float
    pixel_mm: float


@dataclass(frozen=True)
class MeasurementErrors:
    """Standard deviations of the measurements, and the size of the unknown systematic errors.

    Attributes:
        image_mm: image coordinates.
        pattern_mm: longest vector of the systematic pattern, once every image's orientation has
            taken what it can; zero plants none.
        survey_m: control and check points, each coordinate.
        gnss_m: antenna positions, plan and height.
        gnss_shift_m, gnss_drift_m_per_s: of every strip.
        attitude_rad: what the inertial unit is off, used for starting values only.
    """

    image_mm: float = 0.7e-3
    pattern_mm: float = 2e-3
    survey_m: float = 0.02
    gnss_m: tuple[float, float] = (0.05, 0.08)
    gnss_shift_m: float = 0.15
    gnss_drift_m_per_s: float = 3e-4
    attitude_rad: float = 2e-4


@dataclass(frozen=True)
class AerialBlockPlan:
    """Strips, ground, and how densely tie points are matched."""

    strips: tuple[ImageStrip, ...]
    frame: ImageFormat
    spacing_m: float
    relief_m: float
    control: int
    checks: int
    rig: str = "ultracam-l"
    speed_mps: float = 65.0
    lever_m: tuple[float, float, float] = (0.2, -0.3, 1.6)
    errors: MeasurementErrors = field(default_factory=MeasurementErrors)


@dataclass(frozen=True)
class DistortionPattern:
    """What the right half of the image (x > 0) suffers: a projective distortion; and radial.

    The right half's layer was joined to the left one by fewer parameters than its distortion has,
    as in the experiment of Ladstädter et al. (2010). `projective` are its eight small coefficients
    about the half's centre (shift x, y, four of the affine part, two of perspective), `radial` K1.
    """

    centre_mm: tuple[float, float]
    projective: tuple[float, ...]
    radial: float

    def at(self, xy_mm: Array) -> Array:
        """Displacement (n, 2) mm of measured against ideal coordinates."""
        u, v = xy_mm[:, 0] - self.centre_mm[0], xy_mm[:, 1] - self.centre_mm[1]
        a, b, c, d, e, f, g, h = self.projective
        w = 1.0 + g * u + h * v
        moved = np.stack([(u + a + c * u + d * v) / w - u, (v + b + e * u + f * v) / w - v], axis=1)
        moved[xy_mm[:, 0] <= 0.0] = 0.0
        r2 = np.sum(xy_mm**2, axis=1, keepdims=True)
        return np.asarray(moved + self.radial * r2 * xy_mm)


@dataclass(frozen=True)
class CcdDistortionPattern:
    """Every CCD of a rig off on its own: shifts, and a small affine and perspective distortion.

    `parts_mm` (n, 4) are x_min, y_min, x_max, y_max in the stitched image, nominally; `projective`
    (n, 8) as in `Pattern`, about each part's centre.
    """

    parts_mm: Array
    projective: Array

    def at(self, xy_mm: Array) -> Array:
        """Displacement (n, 2) mm of measured against ideal coordinates."""
        low, high = self.parts_mm[:, :2], self.parts_mm[:, 2:]
        inside = np.minimum(xy_mm[:, None] - low, high - xy_mm[:, None]).min(axis=2)
        own = inside.argmax(axis=1)
        u, v = (xy_mm - ((low + high) / 2.0)[own]).T
        a, b, c, d, e, f, g, h = self.projective[own].T
        w = 1.0 + g * u + h * v
        return np.asarray(
            np.stack([(u + a + c * u + d * v) / w - u, (v + b + e * u + f * v) / w - v], axis=1)
        )


@dataclass(frozen=True)
class AerialBlock:
    """The measurements, and the truth for comparison.

    Attributes:
        plan: what was flown.
        names: of images.
        strip: (n,) which strip; time_s (n,).
        true_station, true_rotation: (n, 3), (n, 3, 3), object from camera.
        antenna_m: (n, 3) measured antenna positions, shift and drift of the receiver in them.
        start_rotation: (n, 3, 3) as the inertial unit has it.
        true_points: (m, 3). The first `plan.control` are control, the next `plan.checks` checks.
        survey_m: (control + checks, 3) surveyed coordinates.
        image, point, xy_mm: measured image coordinates.
        pattern: what was planted.
    """

    plan: AerialBlockPlan
    names: tuple[str, ...]
    strip: Indices
    time_s: Array
    true_station: Array
    true_rotation: Array
    antenna_m: Array
    start_rotation: Array
    true_points: Array
    survey_m: Array
    image: Indices
    point: Indices
    xy_mm: Array
    pattern: DistortionPattern | CcdDistortionPattern


ULTRACAM_L = ImageFormat(9735 * 3.6e-3, 6588 * 3.6e-3, 70.0, 7.2e-3)
"""9735 x 6588 pixels of 7.2 um."""


def ultracam_l_plan() -> AerialBlockPlan:
    """The UltraCam L flight: 296 frames, six lines and three cross strips, GSD 10 cm.

    Ladstädter et al. (2010) give counts and GSD; overlaps of 80 and 40 % are ours.
    """
    height, base, line_spacing = 972.2, 131.8, 584.0
    strips = []
    for k in range(6):
        frames = 37 if k in (2, 3) else 36
        north = k % 2 == 0
        y = -(frames - 1) / 2 * base * (1 if north else -1)
        strips.append(
            ImageStrip(
                f"line {k + 1}",
                ((k - 2.5) * line_spacing, y),
                0.0 if north else 180.0,
                frames,
                base,
                height,
            )
        )
    for k in range(3):
        east = k % 2 == 0
        x = -12.5 * base * (1 if east else -1)
        strips.append(
            ImageStrip(
                f"cross {k + 1}", (x, (k - 1) * 1900.0), 90.0 if east else 270.0, 26, base, height
            )
        )
    return AerialBlockPlan(
        tuple(strips), ULTRACAM_L, spacing_m=41.5, relief_m=40.0, control=24, checks=40
    )


def small_plan(frame: ImageFormat = ULTRACAM_L, rig: str = "ultracam-l") -> AerialBlockPlan:
    """Three lines of eight frames and a cross strip of six, GSD 10 cm: for tests."""
    height = 0.1 * frame.f_mm / frame.pixel_mm
    scale = height / frame.f_mm
    base, line_spacing = 0.4 * frame.half_height_mm * scale, 1.2 * frame.half_width_mm * scale
    strips = [
        ImageStrip(
            f"line {k + 1}",
            ((k - 1) * line_spacing, -3.5 * base * (1 if k % 2 == 0 else -1)),
            0.0 if k % 2 == 0 else 180.0,
            8,
            base,
            height,
        )
        for k in range(3)
    ]
    strips.append(ImageStrip("cross 1", (-2.5 * base, 0.0), 90.0, 6, base, height))
    spacing = 0.077 * frame.half_width_mm * scale * 2.0
    return AerialBlockPlan(
        tuple(strips), frame, spacing, relief_m=40.0, control=12, checks=20, rig=rig
    )


def ccd_pattern(rig: Rig, seed: int, size_mm: float) -> CcdDistortionPattern:
    """Every PAN CCD but the master cone's first off by `size_mm` or so at its edges."""
    random = random_stream(seed, "ccd pattern")
    parts, projective = [], []
    for cone in rig.pan_cones:
        perspective = random.normal(0.0, 1.0, 2) if cone.name != rig.master_cone else np.zeros(2)
        for sensor in cone.sensors:
            half = np.array([sensor.width_px, sensor.height_px]) * sensor.pitch_um * 0.5e-3
            centre = np.array([sensor.x_mm, sensor.y_mm])
            parts.append([*(centre - half), *(centre + half)])
            own = random.normal(0.0, 1.0, 6) * [1.0, 1.0, *(4 * [1.0 / half[0]])]
            projective.append(size_mm * 0.5 * np.array([*own, *(perspective / half[0] ** 2)]))
    table = np.array(projective)
    masters = [k for k, c in enumerate(_cones(rig)) if c == rig.master_cone]
    # The orientation absorbs what the master cone's CCDs have in common: remove it.
    table[:, :6] -= table[masters, :6].mean(axis=0)
    return CcdDistortionPattern(np.array(parts), table)


def _cones(rig: Rig) -> list[str]:
    return [cone.name for cone in rig.pan_cones for _ in cone.sensors]


def simulate_block(
    plan: AerialBlockPlan, seed: int, pattern: CcdDistortionPattern | None = None
) -> AerialBlock:
    """Fly a plan: one seed, one block; a pattern of one's own in place of the paper's."""
    station, rotation, strip, time, names = _exposures(plan, seed)
    points = _ground(plan, station, seed)
    planted = pattern or _pattern(plan, seed)
    image, point, ideal = [], [], []
    for k in range(len(station)):
        seen = (points - station[k]) @ rotation[k]
        with np.errstate(all="ignore"):
            xy = -plan.frame.f_mm * seen[:, :2] / seen[:, 2:]
        inside = (
            (seen[:, 2] < 0.0)
            & (np.abs(xy[:, 0]) < plan.frame.half_width_mm)
            & (np.abs(xy[:, 1]) < plan.frame.half_height_mm)
        )
        found = np.flatnonzero(inside)
        image.append(np.full(len(found), k))
        point.append(found)
        ideal.append(xy[found])
    xy = np.concatenate(ideal)
    noise = random_stream(seed, "image").normal(0.0, plan.errors.image_mm, xy.shape)
    surveyed = points[: plan.control + plan.checks]
    survey = random_stream(seed, "survey").normal(0.0, plan.errors.survey_m, surveyed.shape)
    antenna = _antenna(plan, seed, station, rotation, strip, time)
    off = random_stream(seed, "inertial").normal(0.0, plan.errors.attitude_rad, (len(station), 3))
    start = np.array(
        [r @ rotation_opk((a[0], a[1], a[2])) for r, a in zip(rotation, off, strict=True)]
    )
    return AerialBlock(
        plan=plan,
        names=names,
        strip=strip,
        time_s=time,
        true_station=station,
        true_rotation=rotation,
        antenna_m=antenna,
        start_rotation=start,
        true_points=points,
        survey_m=surveyed + survey,
        image=np.concatenate(image),
        point=np.concatenate(point),
        xy_mm=xy + planted.at(xy) + noise,
        pattern=planted,
    )


def orientation_design(frame: ImageFormat, xy_mm: Array) -> Array:
    """What the six of an image's orientation do to coordinates over flat ground, (6, n, 2)."""
    x, y, f = xy_mm[:, 0], xy_mm[:, 1], frame.f_mm
    one, none = np.ones_like(x), np.zeros_like(x)
    columns = (
        (one, none), (none, one), (x, y), (-y, x),
        (f + x * x / f, x * y / f), (x * y / f, f + y * y / f),
    )  # fmt: skip
    return np.array([np.stack(c, axis=1) for c in columns])


def image_grid(frame: ImageFormat, columns: int, rows: int) -> Array:
    """Places spread over the image, (columns * rows, 2) mm, none on its middle column line."""
    x = ((np.arange(columns) + 0.5) / columns * 2.0 - 1.0) * frame.half_width_mm
    y = ((np.arange(rows) + 0.5) / rows * 2.0 - 1.0) * frame.half_height_mm
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def residuals_after_orientation(frame: ImageFormat, xy_mm: Array, vectors_mm: Array) -> Array:
    """Vectors (n, 2) less what the six of an image's orientation would take of them."""
    design = orientation_design(frame, xy_mm).reshape(6, -1).T
    step, *_ = np.linalg.lstsq(design, vectors_mm.ravel(), rcond=None)
    return np.asarray((vectors_mm.ravel() - design @ step).reshape(-1, 2))


def _exposures(
    plan: AerialBlockPlan, seed: int
) -> tuple[Array, Array, Indices, Array, tuple[str, ...]]:
    random = random_stream(seed, "exposures")
    station, rotation, strip, time, names = [], [], [], [], []
    clock = 0.0
    for index, s in enumerate(plan.strips):
        heading = math.radians(s.heading_deg)
        ahead = np.array([math.sin(heading), math.cos(heading), 0.0])
        for k in range(s.frames):
            place = np.array([*s.start_m, s.height_m]) + k * s.base_m * ahead
            station.append(place + random.normal(0.0, [8.0, 8.0, 6.0]))
            tilt = random.normal(0.0, math.radians(1.0), 3)
            rotation.append(rotation_opk((tilt[0], tilt[1], tilt[2] - heading)))
            strip.append(index)
            time.append(clock + k * s.base_m / plan.speed_mps)
            names.append(f"{s.name.replace(' ', '')}-{k + 1:02d}")
        clock = time[-1] + 240.0
    return np.array(station), np.array(rotation), np.array(strip), np.array(time), tuple(names)


def _ground(plan: AerialBlockPlan, station: Array, seed: int) -> Array:
    """Control and check points first, then tie points on a jittered lattice."""
    random = random_stream(seed, "ground")
    scale = station[:, 2].max() / plan.frame.f_mm
    reach = scale * math.hypot(plan.frame.half_width_mm, plan.frame.half_height_mm)
    low, high = station[:, :2].min(axis=0) - reach, station[:, :2].max(axis=0) + reach
    axes = [np.arange(a, b, plan.spacing_m) for a, b in zip(low, high, strict=True)]
    tie = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    tie = tie + random.uniform(-0.4, 0.4, tie.shape) * plan.spacing_m
    inner_low, inner_high = station[:, :2].min(axis=0), station[:, :2].max(axis=0)
    span = inner_high - inner_low
    control = inner_low + span * _spread(plan.control, random)
    checks = inner_low + span * random.uniform(0.03, 0.97, (plan.checks, 2))
    plan_xy = np.concatenate([control, checks, tie])
    return np.column_stack([plan_xy, _height(plan, plan_xy, seed)])


def _spread(count: int, random: np.random.Generator) -> Array:
    """Places in the unit square, the corners and edges among them, as surveyors choose them."""
    side = math.ceil(math.sqrt(count))
    lattice = np.stack(np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side)), axis=-1)
    places = lattice.reshape(-1, 2)
    border = np.abs(places - 0.5).max(axis=1)
    order = np.argsort(-border + random.uniform(0.0, 0.2, len(places)), kind="stable")
    chosen = np.sort(order[:count])
    return np.asarray(0.02 + 0.96 * places[chosen])


def _height(plan: AerialBlockPlan, xy: Array, seed: int) -> Array:
    random = random_stream(seed, "relief")
    height = np.zeros(len(xy))
    for wave in range(6):
        length = 2500.0 / 1.7**wave
        azimuth, phase = random.uniform(0.0, 2.0 * math.pi, 2)
        along = xy @ np.array([math.cos(azimuth), math.sin(azimuth)])
        height += np.sin(2.0 * math.pi * along / length + phase) / 1.5**wave
    return np.asarray(plan.relief_m * height / 2.0)


def _antenna(
    plan: AerialBlockPlan, seed: int, station: Array, rotation: Array, strip: Indices, time: Array
) -> Array:
    random = random_stream(seed, "gnss")
    e = plan.errors
    antenna = station + rotation @ np.array(plan.lever_m)
    for index in range(len(plan.strips)):
        rows = strip == index
        shift = random.normal(0.0, e.gnss_shift_m, 3)
        drift = random.normal(0.0, e.gnss_drift_m_per_s, 3)
        antenna[rows] += shift + drift * (time[rows] - time[rows].mean())[:, None]
    return np.asarray(
        antenna + random.normal(0.0, [e.gnss_m[0]] * 2 + [e.gnss_m[1]], antenna.shape)
    )


def _pattern(plan: AerialBlockPlan, seed: int) -> DistortionPattern:
    """A projective distortion of the right half and some radial one, of the size asked for."""
    frame = plan.frame
    centre = (frame.half_width_mm / 2.0, 0.0)
    if plan.errors.pattern_mm == 0.0:
        return DistortionPattern(centre, (0.0,) * 8, 0.0)
    random = random_stream(seed, "pattern")
    size = np.array([1.0, 1.0, *(4 * [1.0 / frame.half_height_mm]), *(2 * [1.0 / 400.0])])
    drawn = random.uniform(0.5, 1.0, 8) * random.choice([-1.0, 1.0], 8) * size
    places = image_grid(frame, _PATTERN_GRID - 1, _PATTERN_GRID)
    radial = 0.5 / frame.half_width_mm**3
    scale = 1e-3
    for _ in range(20):
        pattern = DistortionPattern(centre, tuple(float(v) for v in drawn * scale), radial * scale)
        left = residuals_after_orientation(frame, places, pattern.at(places))
        scale *= plan.errors.pattern_mm / float(np.hypot(*left.T).max())
    return pattern

"""How the heads are mounted, as one exposure's stitching finds it, and whether that is calibrated.

Turns are small rotation vectors (rad) about the axes of the virtual image (x right, y forward, z
up), found against the platform calibration; the adjustment that finds them is in
`processing.mosaic.free_mosaic`.

Source: docs/explanation/mathematics/virtual-camera.md#mounting-angles; Heier et al. (2002), 6.1.
Eq. 6 is that of Ladstädter et al. (2010).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import chdtri

from processing.geometry.drift import sensor_dc
from processing.geometry.placement import (
    corrected_mm_from_raw,
    vip_mm_from_corrected,
    vip_mm_from_raw,
)
from processing.geometry.projective import apply_projective
from processing.geometry.rotation import (
    angles_by_rotation_vector,
    omega_phi_kappa,
    rotation_matrix,
    rotations_from_vectors,
)
from processing.image.colour import BandRegistration
from processing.matching.tie_points import PAN_TO_PAN, TiePoints
from processing.mosaic.free_mosaic import Mosaic
from processing.mosaic.model import (
    placement_at,
    residuals_px,
    small_rotation_design,
    vip_and_design,
)
from processing.quality.figures import FigureGroup
from processing.quality.figures.stitching import (
    HeadFitFigures,
    HeadScaleFigures,
    PlatformFigures,
)
from processing.rig import Cone, Rig, Sensor

Array = NDArray[np.float64]

FAMILY_ALPHA: Final = 1e-5
"""Probability of calling a healthy platform expired: it changes the verdict."""
MIN_SHIFT_PX: Final = 0.01
SHIFT_SIGMAS: Final = 6.0
"""Of a shift that the adjustment left. The sigma of it is that of independent points, those of
correlated neighbours are up to 1.8 times as large, and every exposure has two for each head."""
MIN_POINTS: Final = 24
SCALED_PPM: Final = 100.0
ALTERNATIVE_SHARE: Final = 0.5
"""Of the largest turn, above which another head may be the one that moved: of one head that turned
alone, the others seem to have turned a third of it."""
_ROUNDS: Final = 12


@dataclass(frozen=True)
class EstimatedMounting:
    """One head: the angles of the platform calibration, turned as the tie points say.

    `angles_rad` are omega, phi, kappa of virtual_from_head with their `covariance` (3, 3), by tie
    points and by how well the sensors' places are known; `correction_rad`, `correction_sigma_rad`
    the same against calibration, about the axes of the virtual image; the mean of all heads is
    zero. `usual_rad` is the standard deviation of an angle by calibration; `turn` the
    length of the correction in standard deviations of calibration and stitching. `shift_px` is how
    far the head's middle went by it, (x right, y up), `reach_px` how far the point of the frame
    that went farthest. `residual_px` is the
    shift that an affine transformation still finds between this head's tie points and its
    neighbours', `affine` (2, 2) the rest of it, px per px, `points` their number.
    """

    cone: str
    angles_rad: tuple[float, float, float]
    covariance: Array
    correction_rad: tuple[float, float, float]
    correction_sigma_rad: tuple[float, float, float]
    shift_px: tuple[float, float]
    residual_px: tuple[float, float]
    residual_sigma_px: tuple[float, float]
    affine: Array
    points: int
    usual_rad: float = 0.0
    turn: float = 0.0
    reach_px: float = 0.0

    @property
    def scale_ppm(self) -> float:
        """By how much the head's scale differs from its neighbours'."""
        return float(np.trace(self.affine)) * 0.5e6


@dataclass(frozen=True)
class PlatformCheck:
    """Whether the platform calibration still holds.

    `covariance` (3 n, 3 n) is that of the turns of all heads, by tie points and by the sensors'
    places; their mean, which is the datum, has none.
    `statistic` is chi-square with `degrees_of_freedom` on a platform as calibrated; a common
    rotation of all heads cannot be observed and does not count.
    """

    heads: tuple[EstimatedMounting, ...]
    covariance: Array
    statistic: float
    degrees_of_freedom: int
    limit: float

    @property
    def is_expired(self) -> bool:
        """True where the test is failed."""
        return self.degrees_of_freedom > 0 and self.statistic > self.limit

    @property
    def scaled(self) -> EstimatedMounting:
        """The head whose scale differs most from its neighbours'."""
        return max(self.heads, key=lambda head: abs(head.scale_ppm))

    @property
    def alternatives(self) -> tuple[str, ...]:
        """Other heads that turned nearly as far as the farthest, where the test is failed."""
        far = ALTERNATIVE_SHARE * self.farthest.turn
        return tuple(
            head.cone
            for head in self.heads
            if self.is_expired and head is not self.farthest and head.turn > far
        )

    @property
    def farthest(self) -> EstimatedMounting:
        """The head that turned most, measured by how well its angles are known.

        By the shift of its middle, a head that turned about its own axis would be overlooked.
        """
        return max(self.heads, key=lambda head: head.turn)


def verified_mosaic(rig: Rig, mosaic: Mosaic, tie_points: TiePoints) -> Mosaic:
    """The mosaic with residual shifts of its heads turned into small angle increments.

    Each head's tie points are compared with its neighbours' by an affine transformation; as a rule
    the adjustment has left no shift. Where one is left (over `SHIFT_SIGMAS` standard deviations
    and `MIN_SHIFT_PX`), the head goes half of the way: its neighbour is found as far off.

    Args:
        rig: the camera.
        mosaic: of converging heads; others are returned as they are.
        tie_points: those the mosaic is of.

    Returns:
        The mosaic, the same where no shift is left.

    Source: docs/explanation/mathematics/virtual-camera.md#verification-by-affine-transformation.
    """
    if not mosaic.model.mountings:
        return mosaic
    for _ in range(_ROUNDS):
        values = mosaic.values.copy()
        moved = False
        for name, first in mosaic.model.mountings.items():
            shift, sigma, _, points = _affine_shift(rig, mosaic, tie_points, name)
            significant = np.abs(shift) > np.maximum(SHIFT_SIGMAS * sigma, MIN_SHIFT_PX)
            if points >= MIN_POINTS and significant.any():
                middle = _middle_mm(rig, mosaic, name)
                jacobian = small_rotation_design(middle, mosaic.model.f_mm)[:, :2, 0]
                step = np.linalg.solve(jacobian, shift * mosaic.model.pitch_mm)
                values[first : first + 2] += 0.5 * step
                moved = True
        if not moved:
            break
        for axis in range(3):
            at = [first + axis for first in mosaic.model.mountings.values()]
            values[at] -= values[at].mean() - mosaic.values[at].mean()
        mosaic = _at_values(mosaic, tie_points, values)
    return mosaic


def most_scaled_head(rig: Rig, mosaic: Mosaic, tie_points: TiePoints) -> tuple[str, float] | None:
    """The converging head that differs most from its neighbours in scale, equally along both axes.

    That is a principal distance; lines lost in read-out change one axis.

    Args:
        rig: the camera.
        mosaic: of converging heads.
        tie_points: those the mosaic is of.

    Returns:
        Name of its cone, and by how much of itself it has to grow; None where no head differs by
        `SCALED_PPM`, and for rigs with a master cone.
    """
    scales = {}
    for name in mosaic.model.mountings:
        _, _, affine, points = _affine_shift(rig, mosaic, tie_points, name)
        along, across = float(affine[0, 0]), float(affine[1, 1])
        least = min(abs(along), abs(across))
        if points >= MIN_POINTS and along * across > 0.0 and least > SCALED_PPM * 1e-6:
            scales[name] = 0.5 * (along + across)
    if not scales:
        return None
    most = max(scales, key=lambda name: abs(scales[name]))
    return most, scales[most]


def check_platform(
    rig: Rig, mosaic: Mosaic, tie_points: TiePoints, temperatures_c: Mapping[str, float]
) -> PlatformCheck | None:
    """Compare the mountings an exposure found with the platform calibration.

    Args:
        rig: the camera.
        mosaic: by tie points alone.
        tie_points: those it was made of.
        temperatures_c: temperatures that were read, by probe name.

    Returns:
        None where no mountings were adjusted, or of one head only.
    """
    held = {name.split(".")[0] for name in mosaic.undetermined}
    mountings = {c: first for c, first in mosaic.model.mountings.items() if c not in held}
    if len(mountings) < 2 or mosaic.redundancy <= 0:
        return None
    count = len(mountings)
    at = np.concatenate([np.arange(first, first + 3) for first in mountings.values()])
    cones = [rig.cone(name) for name in mountings]
    stitched = mosaic.covariance[np.ix_(at, at)]
    dc_k = {s.name: sensor_dc(s, temperatures_c) for cone in cones for s in cone.sensors}
    places = block_diag(*(place_covariance(cone, dc_k) for cone in cones))
    # What all heads turn together is the datum's.
    without_mean = np.kron(np.eye(count) - 1.0 / count, np.eye(3))
    known = stitched + without_mean @ places @ without_mean
    heads = tuple(
        _mounting(rig, mosaic, tie_points, name, known[3 * i : 3 * i + 3, 3 * i : 3 * i + 3])
        for i, name in enumerate(mountings)
    )
    own = np.repeat([(cone.rotation_sigma_urad * 1e-6) ** 2 for cone in cones], 3)
    contrasts = np.kron(np.linalg.svd(np.ones((1, count)))[2][1:], np.eye(3))
    y = contrasts @ mosaic.values[at]
    covariance = contrasts @ (stitched + places + np.diag(own)) @ contrasts.T
    return PlatformCheck(
        heads=heads,
        covariance=known,
        statistic=float(y @ np.linalg.solve(covariance, y)),
        degrees_of_freedom=len(y),
        limit=float(chdtri(len(y), FAMILY_ALPHA)),
    )


def platform_figures(check: PlatformCheck | None) -> tuple[FigureGroup, ...]:
    """The check in figures of the quality report.

    Args:
        check: None where the mountings were not tested.

    Returns:
        Groups of figures; empty without a check.
    """
    if check is None:
        return ()
    farthest, scaled = check.farthest, check.scaled
    return (
        PlatformFigures(
            platform_test=check.statistic / check.limit,
            platform_shift_px=farthest.reach_px,
            platform_shift_head=farthest.cone,
            platform_alternatives=tuple(check.alternatives),
        ),
        HeadFitFigures(max(math.hypot(*head.residual_px) for head in check.heads)),
        HeadScaleFigures(scaled.scale_ppm, scaled.cone),
    )


def rotation_of_layer(rig: Rig, mosaic: Mosaic, cone: Cone) -> Array | None:
    """How the unknowns make the turn of a cone.

    Of a mounting it is the unknowns themselves; of a projective layer the rotation nearest to it
    over the cone's sensors.

    Args:
        rig: the camera.
        mosaic: the adjustment.
        cone: one of the rig's cones.

    Returns:
        (3, u), rad per unknown's own unit; None where the cone has neither.
    """
    model = mosaic.model
    rows = np.zeros((3, len(model.names)))
    if cone.name in model.mountings:
        first = model.mountings[cone.name]
        rows[:, first : first + 3] = np.eye(3)
        return rows
    if cone.name not in model.layers:
        return None
    first = model.layers[cone.name]
    rotation_columns, moves = [], []
    for sensor in cone.sensors:
        start = mosaic.start[sensor.name]
        corrected = corrected_mm_from_raw(start, _grid(sensor))
        _, columns, design = vip_and_design(model, start, corrected, np.zeros(len(model.names)))
        layer = design[(columns >= first) & (columns < first + 8)] * model.pitch_mm
        moves.append(layer.transpose(2, 1, 0).reshape(-1, 8))
        place = vip_mm_from_corrected(start, corrected)
        rotation_columns.append(
            small_rotation_design(place, model.f_mm).transpose(2, 0, 1).reshape(-1, 3)
        )
    by_rotation = np.concatenate(rotation_columns)
    rows[:, first : first + 8] = np.linalg.solve(
        by_rotation.T @ by_rotation, by_rotation.T @ np.concatenate(moves)
    )
    return rows


def rotation_of_band(rig: Rig, mosaic: Mosaic, band: BandRegistration) -> tuple[Array, Array]:
    """The rotation of a colour head by its registration to green, and its sigma.

    The rotation nearest to the projective transformation over the head's sensor; green itself has
    its place by the adjustment.

    Args:
        rig: the camera.
        mosaic: the adjustment.
        band: a registered band of the head.

    Returns:
        Rotation vector and standard deviations, about the axes of the virtual image, (3,) rad each.
    """
    model, sensor = mosaic.model, rig.sensor(band.sensor)
    seen = vip_mm_from_raw(mosaic.start[band.sensor], _grid(sensor))
    belongs = apply_projective(np.asarray(np.linalg.inv(band.band_from_green), np.float64), seen)
    design = small_rotation_design(seen, model.f_mm).transpose(2, 0, 1).reshape(-1, 3)
    rotation_vector, *_ = np.linalg.lstsq(design, (belongs - seen).reshape(-1), rcond=None)
    unit_mm = sensor.pitch_mm * model.f_mm / rig.cone_of(band.sensor).lens.f_mm
    per_point = (band.rms_px or 0.0) / math.sqrt(2.0) * unit_mm
    cofactor = np.linalg.inv(design.T @ design) * len(seen) / max(band.points, 1)
    return np.asarray(rotation_vector), np.asarray(
        per_point * np.sqrt(np.diag(cofactor)), np.float64
    )


def _mounting(
    rig: Rig, mosaic: Mosaic, tie_points: TiePoints, name: str, covariance: Array
) -> EstimatedMounting:
    cone, first = rig.cone(name), mosaic.model.mountings[name]
    rotation_vector = mosaic.values[first : first + 3]
    rotation = rotated_mounting(cone, rotation_vector)
    # A turn w before the rotation is one of R'w behind it.
    jacobian = angles_by_rotation_vector("XYZ", rotation) @ rotation.T
    moved = (
        small_rotation_design(_middle_mm(rig, mosaic, name), mosaic.model.f_mm)[:, :, 0]
        @ rotation_vector
    )
    edge_mm = vip_mm_from_raw(mosaic.placements[cone.sensors[0].name], _grid(cone.sensors[0]))
    reach_mm = np.einsum(
        "ijn,j->in", small_rotation_design(edge_mm, mosaic.model.f_mm), rotation_vector
    )
    calibrated = np.eye(3) * (cone.rotation_sigma_urad * 1e-6) ** 2
    shift, sigma, affine, points = _affine_shift(rig, mosaic, tie_points, name)
    return EstimatedMounting(
        cone=name,
        angles_rad=_triple(omega_phi_kappa(rotation)),
        covariance=jacobian @ covariance @ jacobian.T,
        correction_rad=_triple(rotation_vector),
        correction_sigma_rad=_triple(np.sqrt(np.maximum(np.diag(covariance), 0.0))),
        shift_px=_pair(moved / mosaic.model.pitch_mm),
        residual_px=_pair(shift),
        residual_sigma_px=_pair(sigma),
        affine=affine,
        points=points,
        usual_rad=cone.rotation_sigma_urad * 1e-6,
        turn=math.sqrt(rotation_vector @ np.linalg.solve(covariance + calibrated, rotation_vector)),
        reach_px=float(np.hypot(*reach_mm).max()) / mosaic.model.pitch_mm,
    )


def rotated_mounting(cone: Cone, correction_rad: Array) -> Array:
    """Mounting of a cone turned further about the axes of the virtual image.

    Args:
        cone: with its calibrated mounting.
        correction_rad: rotation vector, (3,).

    Returns:
        virtual_from_head, (3, 3).
    """
    return np.asarray(rotations_from_vectors(correction_rad) @ rotation_matrix(*cone.rotation_rad))


def place_covariance(cone: Cone, dc_k: Mapping[str, float], *, is_datum: bool = False) -> Array:
    """Turns that the sensors' places in the head pass for.

    A shift in the layer, by calibration and drift, looks like a turn about its x and y axes; of a
    cone with several sensors the mean shift does. Where the places of three or more are the datum
    (eq. 6), their rotation about each other looks like a turn about z.

    Args:
        cone: one of the rig's cones.
        dc_k: dC by sensor name, K; a sensor without one has none.
        is_datum: the places of the cone's sensors are the datum.

    Returns:
        Covariance about the axes of the virtual image, (3, 3), rad squared.
    """
    sensors = cone.sensors
    tdm_um = [s.drift.sigma_um_per_k * dc_k.get(s.name, 0.0) for s in sensors]
    variance = np.array(
        [s.position_sigma_um**2 + t**2 for s, t in zip(sensors, tdm_um, strict=True)]
    )
    across = float(variance.sum()) / len(sensors) ** 2 * (1e-3 / cone.lens.f_mm) ** 2
    about_z = 0.0
    if is_datum and len(sensors) > 2:
        arm = np.array([[s.x_mm, s.y_mm] for s in sensors])
        square = np.sum((arm - arm.mean(axis=0)) ** 2, axis=1)
        about_z = float(np.sum(square * variance)) * 1e-6 / float(square.sum()) ** 2
    rotation = rotation_matrix(*cone.rotation_rad)
    return np.asarray(rotation @ np.diag([across, across, about_z]) @ rotation.T)


def _affine_shift(
    rig: Rig, mosaic: Mosaic, tie_points: TiePoints, name: str
) -> tuple[Array, Array, Array, int]:
    """Shift at the head's middle (px right, up), its sigma, the linear part (2, 2), points used.

    Fitted to where neighbours see the head's P/P points less where it sees them itself.
    """
    sensors = [s.name for s in rig.cone(name).sensors]
    numbers = [i for i, n in enumerate(tie_points.names) if n in sensors]
    good = ~mosaic.outliers & (tie_points.kind == PAN_TO_PAN)
    places, separation, sigmas = [], [], []
    for side, sign in ((tie_points.sensor_a, -1.0), (tie_points.sensor_b, 1.0)):
        raw = tie_points.raw_a if sign < 0 else tie_points.raw_b
        for number in numbers:
            rows = good & (side == number)
            if rows.any():
                placement = mosaic.placements[tie_points.names[number]]
                places.append(vip_mm_from_raw(placement, raw[rows]) / mosaic.model.pitch_mm)
                separation.append(sign * mosaic.residuals_px[rows])
                sigmas.append(tie_points.sigma_px[rows])
    points = sum(map(len, places))
    nothing = np.zeros(2), np.full(2, math.inf), np.zeros((2, 2)), points
    if points < MIN_POINTS:
        return nothing
    at, d = np.concatenate(places), np.concatenate(separation)
    arm = at - _middle_mm(rig, mosaic, name)[0] / mosaic.model.pitch_mm
    design = np.column_stack([np.ones(points), arm])
    weight = 1.0 / np.concatenate(sigmas)
    scaled = design * weight[:, None]
    fit, *_ = np.linalg.lstsq(scaled, d * weight[:, None], rcond=None)
    misfit = (d - design @ fit) * weight[:, None]
    cofactor = np.linalg.pinv(scaled.T @ scaled)
    unit = np.sqrt(np.sum(misfit**2, axis=0) / max(points - 3, 1))
    sigma = np.asarray(unit * math.sqrt(max(float(cofactor[0, 0]), 0.0)), np.float64)
    return np.asarray(fit[0]), sigma, np.asarray(fit[1:].T), points


def _at_values(mosaic: Mosaic, tie_points: TiePoints, values: Array) -> Mosaic:
    placements = {n: placement_at(mosaic.model, p, values) for n, p in mosaic.start.items()}
    residuals = residuals_px(mosaic.model, placements, tie_points)
    return dataclasses.replace(mosaic, values=values, placements=placements, residuals_px=residuals)


def _middle_mm(rig: Rig, mosaic: Mosaic, name: str) -> Array:
    """The middle of a head's sensor in the VIP, (1, 2) mm."""
    sensor = rig.cone(name).sensors[0]
    middle = np.array([[(sensor.width_px - 1) / 2.0, (sensor.height_px - 1) / 2.0]])
    return vip_mm_from_raw(mosaic.placements[sensor.name], middle)


def _grid(sensor: Sensor) -> Array:
    columns = np.linspace(0.0, sensor.width_px - 1.0, 5)
    rows = np.linspace(0.0, sensor.height_px - 1.0, 5)
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


def _pair(values: Array) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _triple(values: Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])

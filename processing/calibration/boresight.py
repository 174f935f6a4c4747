"""Boresight, lever arm and time offset: inertial attitude and position against controlled images.

Least squares of all exposures at once, with the whole covariance of the adjusted orientations.
Parameters that the flight cannot separate keep their given values and are named, with a remedy.

Source: docs/explanation/mathematics/boresight.md#model; Jacobsen (2008), boresite calibration.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.exposure_motion import advanced, moved
from processing.bundle.network import Motion
from processing.geometry.orientation import BODY_FROM_CAMERA
from processing.geometry.rotation import (
    angles_by_rotation_vector,
    level_from_body,
    rotations_from_vectors,
    skew,
    vectors_from_rotations,
)

Array = NDArray[np.float64]

PARAMETERS: Final = (
    *("boresight about forward", "boresight about right", "boresight about down"),
    *("lever arm forward", "lever arm right", "lever arm down"),
    "time offset",
    *("position shift east", "position shift north", "position shift up"),
)
GROUPS: Final = {"boresight": (0, 1, 2), "lever": (3, 4, 5), "time": (6,), "shift": (7, 8, 9)}
PARAMETER_SCALES: Final = np.array([1e-3, 1e-3, 1e-3, 0.5, 0.5, 0.5, 5e-3, 0.5, 0.5, 0.5])
"""rad, m, s, m: a direction with a larger sigma counts as unknown."""

_MIN_PARTICIPATION: Final = 0.05
_ITERATIONS: Final = 8
_MIN_SPEED_SPREAD_MPS: Final = 2.0


@dataclass(frozen=True)
class ImageOrientations:
    """Orientations of n exposures from an adjustment without the trajectory.

    `centre_m` (n, 3) projection centres in object axes (east, north, up); `rotation` (n, 3, 3)
    object from rig, in camera axes; `covariance` (6n, 6n) of centres (m) and of rotation vectors
    about the rig's camera axes (rad), exposure by exposure: three and three.
    """

    centre_m: Array
    rotation: Array
    covariance: Array


@dataclass(frozen=True)
class InertialOrientations:
    """Measurements of receiver and inertial unit at the same n mid-exposures, in the same object
    axes.

    `position_m` (n, 3) of the antenna; `velocity_mps` (n, 3); `rotation` (n, 3, 3) object from
    inertial unit (forward, right, down); `rate_rad_per_s` (n, 3) about the unit's axes; sigmas (3,)
    of position in object axes and of attitude about the unit's axes.

    `acceleration_mps2` of the antenna, object axes, and `rate_change_rad_per_s2` about the unit's
    axes, (n, 3), carry the trajectory over a time offset to the second order; None: zero. `time_s`
    (n,) and the times over which errors are correlated (Gauss-Markov, first order) make exposures
    depend on each other; None: they are independent.
    """

    position_m: Array
    velocity_mps: Array
    rotation: Array
    rate_rad_per_s: Array
    position_sigma_m: Array
    attitude_sigma_rad: Array
    acceleration_mps2: Array | None = None
    rate_change_rad_per_s2: Array | None = None
    time_s: Array | None = None
    position_correlation_s: float | None = None
    attitude_correlation_s: float | None = None

    @property
    def motion(self) -> Motion:
        """Motion of the antenna, rates about the axes of the inertial unit."""
        none = np.zeros_like(self.velocity_mps)
        return Motion(
            self.velocity_mps,
            none if self.acceleration_mps2 is None else self.acceleration_mps2,
            self.rate_rad_per_s,
            none if self.rate_change_rad_per_s2 is None else self.rate_change_rad_per_s2,
        )


@dataclass(frozen=True)
class ImuMounting:
    """Mounting of the rig against the inertial unit and antenna.

    `imu_from_body` (3, 3); `antenna_m` (3,) from the rig's origin, forward, right, down;
    `time_offset_s`: a mid-exposure's instant on the trajectory's time scale less its own;
    `shift_m` (3,) positions of the trajectory less those of the control, east, north, up.
    """

    imu_from_body: Array
    antenna_m: Array
    time_offset_s: float
    shift_m: Array


@dataclass(frozen=True)
class InseparableParameters:
    """Parameters that this flight does not separate: a sentence with the remedy, and their
    names."""

    sentence: str
    parameters: tuple[str, ...]


@dataclass(frozen=True)
class BoresightCalibration:
    """Result of a calibration flight.

    `covariance` (10, 10) in the order of `PARAMETERS` (rad, m, s), within what is determined: held
    parameters and unseparated directions have none. `determined` (10,) marks the parameters that
    are completely determined. `basis` (10, r) are the determined directions, scaled by
    `PARAMETER_SCALES`. Residuals are (n, 3): positions in m (object axes), attitudes in rad (rig's
    body axes). `sigma0` has expected value one.
    """

    mounting: ImuMounting
    covariance: Array
    determined: NDArray[np.bool_]
    basis: Array
    held: tuple[str, ...]
    inseparable: tuple[InseparableParameters, ...]
    position_residual_m: Array
    attitude_residual_rad: Array
    sigma0: float
    redundancy: int
    by_image: Array
    """(10, 6n) change of the ten by the orientations from images, as `ImageOrientations` has
    them."""

    @property
    def sigma(self) -> Array:
        """(10,) standard deviations; NaN where a parameter is not determined."""
        found = np.sqrt(np.clip(np.diag(self.covariance), 0.0, None))
        return np.where(self.determined, found, np.nan)

    @property
    def correlation(self) -> Array:
        """(10, 10); zero for what is not determined."""
        spread = np.sqrt(np.clip(np.diag(self.covariance), 1e-300, None))
        return np.asarray(self.covariance / spread / spread[:, None])


def calibrate_boresight(
    image_orientations: ImageOrientations,
    inertial: InertialOrientations,
    given: ImuMounting,
    *,
    held: Collection[str] = (),
    lever_sigma_m: float | None = None,
) -> BoresightCalibration:
    """Compare inertial with controlled orientation.

    Args:
        image_orientations: adjusted without the trajectory.
        inertial: the same exposures in the same order.
        given: the values so far; what is held or cannot be separated stays as it is there.
        held: of "boresight", "lever", "time", "shift".
        lever_sigma_m: the given lever arm was surveyed to this and counts as an observation.

    Returns:
        The mounting with its covariance, residuals, and what the flight does not separate.

    Raises:
        ValueError: fewer than three exposures, tables that do not fit, or an unknown group.

    Source: docs/explanation/mathematics/boresight.md#model.
    """
    n = len(image_orientations.centre_m)
    _check(image_orientations, inertial, held)
    free = np.ones(10, dtype=bool)
    for group in held:
        free[list(GROUPS[group])] = False
    at = given
    if free[0]:
        at = replace(given, imu_from_body=_mean_boresight(image_orientations, inertial))
    for _ in range(_ITERATIONS):
        misclosure, design, by_image = _equations(image_orientations, inertial, at)
        weight = np.linalg.inv(_observation_covariance(image_orientations, inertial, at, by_image))
        scaled = design[:, free] * PARAMETER_SCALES[free]
        normal = scaled.T @ weight @ scaled
        right = scaled.T @ weight @ misclosure
        prior = np.zeros(10)
        if lever_sigma_m is not None:
            prior[3:6] = (PARAMETER_SCALES[3:6] / lever_sigma_m) ** 2
            away = (at.antenna_m - given.antenna_m) / PARAMETER_SCALES[3:6]
            free_columns = np.flatnonzero(free)
            right[np.isin(free_columns, (3, 4, 5))] -= (prior[3:6] * away)[free[3:6]]
        normal = normal + np.diag(prior[free])
        values, vectors = np.linalg.eigh(normal)
        known = values > 1.0
        basis = vectors[:, known]
        step = np.zeros(10)
        step[free] = PARAMETER_SCALES[free] * (basis @ ((basis.T @ right) / values[known]))
        step[free] += PARAMETER_SCALES[free] * _back(at, step, given, vectors[:, ~known], free)
        at = _with_step(at, step)
        if np.abs(step / PARAMETER_SCALES).max(initial=0.0) < 1e-9:
            break
    misclosure, _, by_image = _equations(image_orientations, inertial, at)
    full_basis = np.zeros((10, int(known.sum())))
    full_basis[free] = basis
    covariance = (
        (full_basis * PARAMETER_SCALES[:, None])
        / values[known]
        @ (full_basis * PARAMETER_SCALES[:, None]).T
    )
    gain = covariance @ (design.T @ weight)
    lost = np.zeros((10, int((~known).sum())))
    lost[free] = vectors[:, ~known]
    squares = float(misclosure @ weight @ misclosure)
    observations = 6 * n
    if lever_sigma_m is not None:
        squares += float(np.sum(((at.antenna_m - given.antenna_m) / lever_sigma_m) ** 2))
        observations += 3
    redundancy = observations - int(known.sum())
    residual = misclosure.reshape(n, 6)
    return BoresightCalibration(
        mounting=at,
        covariance=np.asarray(covariance),
        determined=free & ((lost**2).sum(axis=1) < _MIN_PARTICIPATION),
        basis=full_basis,
        held=tuple(held),
        inseparable=_named(lost, inertial),
        position_residual_m=residual[:, :3],
        attitude_residual_rad=residual[:, 3:],
        sigma0=math.sqrt(squares / redundancy) if redundancy > 0 else math.nan,
        redundancy=redundancy,
        by_image=np.einsum("pna,nab->pnb", gain.reshape(10, n, 6), by_image).reshape(10, 6 * n),
    )


def angle_covariance(found: BoresightCalibration) -> Array:
    """Covariance of roll, pitch and heading of the boresight.

    Args:
        found: from `calibrate_boresight`.

    Returns:
        Shape (3, 3), rad squared, in the order roll, pitch, heading.
    """
    by = angles_by_rotation_vector("ZYX", found.mounting.imu_from_body)[::-1]
    return np.asarray(by @ found.covariance[:3, :3] @ by.T)


def rig_motion(inertial: InertialOrientations, mounting: ImuMounting) -> Motion:
    """Motion of the rig at the exposures' own instants, from the trajectory and a mounting.

    Args:
        inertial: at the marks.
        mounting: boresight, lever arm and time offset so far. An error of 0.1 m and 1 degree makes
            0.2 mm and 20 urad in 20 ms at 0.1 rad/s.

    Returns:
        Motion of the rig's origin in object axes, rates about its camera axes, the time offset
        after the marks.

    Source: docs/explanation/mathematics/boresight.md#delays-of-heads.

    Example:
        The antenna 2 m ahead of a rig that turns about its down axis moves to the right.

        >>> one = np.array([[0.0, 0.0, 0.1]])
        >>> inertial = InertialOrientations(
        ...     0 * one, 0 * one, np.eye(3)[None], one, np.ones(3), np.ones(3)
        ... )
        >>> mounting = mounting_of(np.array([2.0, 0.0, 0.0]), np.zeros(3))
        >>> rig_motion(inertial, mounting).velocity_mps + 0.0
        array([[ 0. , -0.2,  0. ]])
    """
    given = inertial.motion
    arm = mounting.imu_from_body @ mounting.antenna_m
    rate, change = given.rate_rad_per_s, given.rate_change_rad_per_s2
    circling = np.cross(rate, arm)
    pull = np.cross(change, arm) + np.cross(rate, circling)
    camera_from_imu = BODY_FROM_CAMERA.T @ mounting.imu_from_body.T
    motion = Motion(
        given.velocity_mps - np.einsum("nij,nj->ni", inertial.rotation, circling),
        given.acceleration_mps2 - np.einsum("nij,nj->ni", inertial.rotation, pull),
        rate @ camera_from_imu.T,
        change @ camera_from_imu.T,
    )
    return advanced(motion, mounting.time_offset_s)


def mounting_of(
    antenna_m: Array,
    boresight_rad: Array,
    *,
    time_offset_s: float = 0.0,
    shift_m: Array | None = None,
) -> ImuMounting:
    """A mounting from a lever arm and the angles of the boresight.

    Args:
        antenna_m: from the rig's origin, forward, right, down, shape (3,), m.
        boresight_rad: roll, pitch, heading of the body against the inertial unit, shape (3,), rad.
        time_offset_s: as of `ImuMounting`.
        shift_m: as of `ImuMounting`, shape (3,), m; None: zero.

    Returns:
        The mounting.

    Example:
        A rig turned by 90 degrees: its forward axis is the unit's right axis.

        >>> mounting = mounting_of(np.zeros(3), np.array([0.0, 0.0, np.pi / 2]))
        >>> mounting.imu_from_body.round(6) @ [1.0, 0.0, 0.0]
        array([0., 1., 0.])
    """
    return ImuMounting(
        level_from_body(*(float(v) for v in boresight_rad)),
        np.asarray(antenna_m, dtype=np.float64),
        time_offset_s,
        np.zeros(3) if shift_m is None else np.asarray(shift_m, dtype=np.float64),
    )


def _check(
    image_orientations: ImageOrientations, inertial: InertialOrientations, held: Collection[str]
) -> None:
    n = len(image_orientations.centre_m)
    unknown = sorted(set(held) - set(GROUPS))
    if unknown:
        raise ValueError(f"{unknown} cannot be held; one of {', '.join(GROUPS)} can")
    if n < 3:
        raise ValueError(f"{n} exposures with both orientations; a comparison takes three or more")
    correlated = (inertial.position_correlation_s, inertial.attitude_correlation_s)
    if any(own is not None for own in correlated) and inertial.time_s is None:
        raise ValueError("a correlation time needs the instants of the exposures")
    if any(own is not None and not own > 0.0 for own in correlated):
        raise ValueError("a correlation time is positive")
    if len(inertial.position_m) != n or image_orientations.covariance.shape != (6 * n, 6 * n):
        raise ValueError(
            f"{n} controlled exposures, {len(inertial.position_m)} inertial ones, covariance "
            f"{image_orientations.covariance.shape}; the same exposures and (6n, 6n) are needed"
        )


def _mean_boresight(image_orientations: ImageOrientations, inertial: InertialOrientations) -> Array:
    body = image_orientations.rotation @ BODY_FROM_CAMERA.T
    relative = np.einsum("nji,njk->nik", inertial.rotation, body)
    mean = relative[0]
    for _ in range(5):
        off = vectors_from_rotations(np.einsum("ji,njk->nik", mean, relative))
        mean = mean @ rotations_from_vectors(off.mean(axis=0))
    return np.asarray(mean)


def _with_step(at: ImuMounting, step: Array) -> ImuMounting:
    return ImuMounting(
        at.imu_from_body @ rotations_from_vectors(step[:3]),
        at.antenna_m + step[3:6],
        at.time_offset_s + float(step[6]),
        at.shift_m + step[7:],
    )


def _back(at: ImuMounting, step: Array, given: ImuMounting, lost: Array, free: Array) -> Array:
    """A way along unseparated directions (scaled) that leaves lever arm and time as given, so that
    the shift of positions absorbs the unseparated part."""
    moved = np.zeros(10)
    moved[3:6] = at.antenna_m - given.antenna_m
    moved[6] = at.time_offset_s - given.time_offset_s
    away = ((moved + step) / PARAMETER_SCALES)[free]
    mounted = np.isin(np.flatnonzero(free), (3, 4, 5, 6))
    way, *_ = np.linalg.lstsq(lost[mounted], -away[mounted], rcond=1e-3)
    return np.asarray(lost @ way)


def _equations(
    image_orientations: ImageOrientations, inertial: InertialOrientations, at: ImuMounting
) -> tuple[Array, Array, Array]:
    """Misclosures (6n,), their sensitivity to the ten with reversed sign (6n, 10), and to the
    controlled orientations (n, 6, 6)."""
    n = len(image_orientations.centre_m)
    body = image_orientations.rotation @ BODY_FROM_CAMERA.T
    shift_m, rotation_in_offset, velocity_mps, rate = moved(
        inertial.motion, np.arange(n), np.full(n, at.time_offset_s)
    )
    misclosure = np.zeros((n, 6))
    misclosure[:, :3] = (
        inertial.position_m
        + shift_m
        - image_orientations.centre_m
        - body @ at.antenna_m
        - at.shift_m
    )
    seen = np.einsum(
        "nji,njk->nik", body, inertial.rotation @ rotation_in_offset @ at.imu_from_body
    )
    misclosure[:, 3:] = vectors_from_rotations(seen)
    design = np.zeros((n, 6, 10))
    design[:, 3:, :3] = -np.eye(3)
    design[:, :3, 3:6] = body
    design[:, :3, 6] = -velocity_mps
    design[:, 3:, 6] = -rate @ at.imu_from_body
    design[:, :3, 7:] = np.eye(3)
    by_image = np.zeros((n, 6, 6))
    by_image[:, :3, :3] = -np.eye(3)
    arm = BODY_FROM_CAMERA.T @ at.antenna_m
    by_image[:, :3, 3:] = image_orientations.rotation @ skew(arm[None])[0]
    by_image[:, 3:, 3:] = -BODY_FROM_CAMERA
    return misclosure.ravel(), design.reshape(6 * n, 10), by_image


def _observation_covariance(
    image_orientations: ImageOrientations,
    inertial: InertialOrientations,
    at: ImuMounting,
    by_image: Array,
) -> Array:
    n = len(by_image)
    blocks = image_orientations.covariance.reshape(n, 6, n, 6)
    covariance = np.einsum("iab,ibjc,jdc->iajd", by_image, blocks, by_image, optimize=True)
    own = at.imu_from_body.T @ np.diag(inertial.attitude_sigma_rad**2) @ at.imu_from_body
    position = _alike(n, inertial.time_s, inertial.position_correlation_s)
    attitude = _alike(n, inertial.time_s, inertial.attitude_correlation_s)
    covariance[:, :3, :, :3] += np.einsum(
        "ij,ab->iajb", position, np.diag(inertial.position_sigma_m**2)
    )
    covariance[:, 3:, :, 3:] += np.einsum("ij,ab->iajb", attitude, own)
    return np.asarray(covariance.reshape(6 * n, 6 * n))


def _alike(n: int, time_s: Array | None, correlation_s: float | None) -> Array:
    """Correlations of errors of the same quantity at n instants, (n, n)."""
    if time_s is None or correlation_s is None:
        return np.eye(n)
    return np.asarray(np.exp(-np.abs(time_s[:, None] - time_s) / correlation_s))


def _named(lost: Array, inertial: InertialOrientations) -> tuple[InseparableParameters, ...]:
    """Sentences for undetermined directions (10, k), scaled by `PARAMETER_SCALES`."""
    if not lost.shape[1]:
        return ()
    together = (lost @ lost.T > _MIN_PARTICIPATION) | (lost @ lost.T < -_MIN_PARTICIPATION)
    left = [int(k) for k in np.flatnonzero((lost**2).sum(axis=1) >= _MIN_PARTICIPATION)]
    found = []
    while left:
        group, queue = {left[0]}, [left[0]]
        while queue:
            now = queue.pop()
            for other in left:
                if other not in group and together[now, other]:
                    group.add(other)
                    queue.append(other)
        left = [k for k in left if k not in group]
        found.append(_sentence(sorted(group), inertial))
    return tuple(found)


def _sentence(group: list[int], inertial: InertialOrientations) -> InseparableParameters:
    names = tuple(PARAMETERS[k] for k in group)
    listed = " and ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else names[0]
    has = set(group)
    speed = np.linalg.norm(inertial.velocity_mps, axis=1)
    hints = []
    if 6 in has and 3 in has and float(np.ptp(speed)) < _MIN_SPEED_SPREAD_MPS:
        hints.append(f"all lines were flown at {speed.mean():.0f} m/s: fly two speeds")
    if has & {3, 4, 6} and has & {7, 8}:
        hints.append("fly lines in opposite and in crossing directions")
    if {5, 9} <= has:
        hints.append(
            "level flight never separates them: survey the lever arm and give --lever-sigma"
        )
    if not hints:
        hints.append("fly two heights, opposite and crossing lines and two speeds, or hold one")
    verb = "cannot be separated" if len(names) > 1 else "cannot be determined"
    return InseparableParameters(f"{listed} {verb}: {'; '.join(hints)}", names)

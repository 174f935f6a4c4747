"""Platform calibration from many exposures: mounting angles of every cone and their sigmas.

Each exposure's stitching estimates rotations against the calibration in use
(`processing.mosaic.stitch_record`); this module averages them. Rotations are rotation vectors (rad)
about the axes of the virtual image.

A cone off the flight axis has another perspective centre than the master cone. The apparent
rotation this causes is removed with the height above ground.

Source: docs/explanation/mathematics/virtual-camera.md#platform-calibration-from-a-flight; Heier et
al. (2002), 6.1; Ladstädter et al. (2010), "platform calibration".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from processing.geometry.rotation import angles_by_rotation_vector, omega_phi_kappa
from processing.mosaic.mounting import place_covariance, rotated_mounting
from processing.mosaic.stitch_record import ROTATIONS, StitchRecord
from processing.rig import Cone, Rig

Array = NDArray[np.float64]

MIN_EXPOSURES: Final = 3
MIN_EXPOSURES_SYNTOPIC: Final = 12
"""The aircraft rotates between cones that expose one after the other: more are needed."""
MIN_SIGMA_URAD: Final = 2.0
"""Smallest sigma stated for the angles of a mount from flight to flight."""
COLOUR_SHIFT_PX: Final = 0.002
COLOUR_ROTATION_PX: Final = 0.001
"""Systematic error of matching PAN to the colour master, colour pixels: of shift, and of rotation
at the corners. Measured on rendered flights
(docs/how-to/processing/calibration.md)."""
REGISTERED_PX: Final = 0.02
"""The same of a band registered to the colour master, shift and turn
(docs/explanation/cameras/dmc.md)."""
HEIGHT_SIGMA: Final = 0.02
"""Sigma of the mean height above ground: relief, and the error of the plan."""
_OUTLIER_LIMIT: Final = 5.0
_MAD_TO_SIGMA: Final = 1.4826
_SCATTER_ALPHA: Final = 0.01


@dataclass(frozen=True)
class CalibratedConeMounting:
    """Estimated rotation of one cone.

    `correction_rad` against the calibration flown with, `correction_sigma_rad` of the mean, the
    sensor's place in its head taken as calibrated; `scatter_rad` is that of a single exposure.
    `angles_rad` are omega, phi, kappa with `angles_sigma_rad`, which holds the place's share too;
    so does the turn's `covariance` (3, 3). `corrections` (n, 3) are those of the exposures used,
    numbers `used` among the records.
    """

    cone: str
    correction_rad: Array
    correction_sigma_rad: Array
    scatter_rad: Array
    angles_rad: Array
    angles_sigma_rad: Array
    covariance: Array
    corrections: Array
    used: tuple[int, ...]
    left_out: int
    unexplained_rad: Array
    """Scatter beyond the exposures' sigmas: rotation between syntopic instants, a loose mount."""

    @property
    def sigma_urad(self) -> float:
        """Sigma of the mounting in a single exposure, for the rig file."""
        own = float(np.sqrt(np.max(self.correction_sigma_rad**2 + self.unexplained_rad**2))) * 1e6
        return max(own, MIN_SIGMA_URAD)


@dataclass(frozen=True)
class PlatformCalibration:
    """`cones` that could be calibrated; `missing` those with no or too few exposures."""

    cones: tuple[CalibratedConeMounting, ...]
    missing: tuple[str, ...]


def calibrate_platform(rig: Rig, records: Sequence[StitchRecord]) -> PlatformCalibration:
    """Average the rotations of every cone except the master over exposures.

    An exposure in which a cone's rotation is an outlier (a blurred head, a cloud) is left out for
    it. Of converging heads only exposures with all of them count: their datum is their mean.

    Args:
        rig: the camera, with the calibration that was flown.
        records: of its exposures, in the order of time.

    Returns:
        Mean rotations of the cones with enough exposures, and names of the others.

    Raises:
        ValueError: a record of another rig or calibration.

    Source: docs/explanation/mathematics/virtual-camera.md#platform-calibration-from-a-flight.
    """
    for record in records:
        if (record.rig, record.calibration_id) != (rig.name, rig.calibration_id):
            raise ValueError(
                f"a record of {record.rig} {record.calibration_id!r} does not belong to "
                f"{rig.name} {rig.calibration_id!r}"
            )
    heads = [cone.name for cone in rig.pan_cones] if rig.has_virtual_camera else []
    complete = [
        k
        for k, r in enumerate(records)
        if all(_is_usable_record(rig, rig.cone(name), r) for name in heads)
    ]
    cones, missing = [], []
    for cone in rig.cones:
        if cone.name == rig.master_cone:
            continue
        candidates = complete if cone.name in heads else range(len(records))
        usable = [k for k in candidates if _is_usable_record(rig, cone, records[k])]
        found = _calibrated(rig, cone, records, usable)
        if found is None:
            missing.append(cone.name)
        else:
            cones.append(found)
    return PlatformCalibration(tuple(cones), tuple(missing))


def calibrated_rig(
    rig: Rig, calibration: PlatformCalibration, *, calibration_id: str, date: str
) -> Rig:
    """The rig with the new angles and their sigmas.

    Args:
        rig: the camera that was calibrated.
        calibration: of its cones; others keep their angles.
        calibration_id: of the new calibration.
        date: of the new calibration, YYYY-MM-DD.

    Returns:
        A new rig; an uncalibrated one stays uncalibrated, because its lenses are nominal.
    """
    found = {c.cone: c for c in calibration.cones}
    cones = []
    for cone in rig.cones:
        if cone.name in found:
            omega, phi, kappa = (float(angle) for angle in found[cone.name].angles_rad)
            cone = replace(
                cone,
                rotation_rad=(omega, phi, kappa),
                rotation_sigma_urad=round(found[cone.name].sigma_urad, 2),
            )
        cones.append(cone)
    dated = date if rig.is_calibrated else ""
    return replace(rig, cones=tuple(cones), calibration_id=calibration_id, calibration_date=dated)


@dataclass(frozen=True)
class ConfoundingEffect:
    """Effects that cannot be separated from a rotation of a cone, rad (about x, y, z).

    `places` of the sensors, the datum's too (one standard deviation, held in the angles' sigma);
    `speed` a speed or delay off by 1 %, always the same; `crab` of one degree, always the same;
    `height` above ground off by 1 %.
    """

    places: Array
    speed: Array
    crab: Array
    height: Array


def confounding_effect(rig: Rig, cone: Cone, records: Sequence[StitchRecord]) -> ConfoundingEffect:
    """Rotation of a cone's image by each of these, at the heights that were flown.

    Args:
        rig: the camera.
        cone: one of its cones.
        records: of the exposures; without a height the effects of the base are zero.

    Returns:
        Rotations about x, y, z, shape (3,) each, rad.
    """
    heights = [r.height_m for r in records if r.height_m]
    per_m = 1.0 / float(np.mean(heights)) if heights else 0.0
    base_along_m = 0.0
    if rig.timing == "syntopic":
        base_along_m = abs(cone.position_mm[0] - rig.image_position_mm[0]) * 1e-3
    right, forward = (abs(b) * 1e-3 for b in base_mm(rig, cone))
    return ConfoundingEffect(
        places=np.sqrt(np.diag(_position_covariance(rig, cone, records))),
        speed=np.array([0.01 * base_along_m * per_m, 0.0, 0.0]),
        crab=np.array([0.0, math.sin(math.radians(1.0)) * base_along_m * per_m, 0.0]),
        height=np.array([forward, right, 0.0]) * 0.01 * per_m,
    )


def shift_px(rig: Rig, correction_rad: Array) -> float:
    """Displacement by a rotation of the middle of a cone's field, about x and y alone.

    Args:
        rig: the camera.
        correction_rad: rotation vector, shape (3,), rad.

    Returns:
        PAN pixels of the virtual image; zero where the rig has none.

    Example:
        100 urad of 100.5 mm are 10 um, 1.4 pixels of 7.2 um.

        >>> from processing.rig import find_rig
        >>> round(shift_px(find_rig("ultracam-x"), np.array([100e-6, 0.0, 0.0])), 3)
        1.396
    """
    if rig.virtual_image is None:
        return 0.0
    return (
        float(np.hypot(*correction_rad[:2])) * rig.virtual_image.f_mm / rig.virtual_image.pitch_mm
    )


def _calibrated(
    rig: Rig, cone: Cone, records: Sequence[StitchRecord], used: Sequence[int]
) -> CalibratedConeMounting | None:
    observed = [_mounting_correction(rig, cone, records[k]) for k in used]
    least = min_exposures(rig)
    if len(observed) < least:
        return None
    corrections, stated = np.array([t for t, _ in observed]), np.array([c for _, c in observed])
    middle = np.median(corrections, axis=0)
    deviations = np.abs(corrections - middle)
    spread = np.maximum(
        _MAD_TO_SIGMA * np.median(deviations, axis=0),
        np.sqrt(np.median(np.diagonal(stated, axis1=1, axis2=2), axis=0)),
    )
    good = (deviations <= _OUTLIER_LIMIT * np.maximum(spread, 1e-12)).all(axis=1)
    if int(good.sum()) < least:
        return None
    corrections, stated = corrections[good], stated[good]
    n = len(corrections)
    mean, own = corrections.mean(axis=0), stated.mean(axis=0)
    seen = np.atleast_2d(np.cov(corrections.T, ddof=1))
    # Scatter counts where the exposures' own statement does not explain it.
    ratio = np.diag(seen) / np.maximum(np.diag(own), 1e-30)
    beyond = ratio > chdtri(n - 1, _SCATTER_ALPHA / 3.0) / (n - 1)
    # An aircraft rotates slowly: errors of neighbouring exposures are correlated and count for
    # less.
    variance = np.where(beyond, np.diag(seen) * _autocorrelation_factor(corrections), np.diag(own))
    scale = np.sqrt(variance / np.maximum(np.diag(own), 1e-30))
    of_mean = own * np.outer(scale, scale) / n
    rotation = rotated_mounting(cone, mean)
    # A turn w before the rotation is one of R'w behind it.
    jacobian = angles_by_rotation_vector("XYZ", rotation) @ rotation.T
    total = of_mean + _common_covariance(rig, cone, [records[k] for k in used])
    return CalibratedConeMounting(
        cone=cone.name,
        correction_rad=mean,
        correction_sigma_rad=np.sqrt(np.diag(of_mean)),
        scatter_rad=np.sqrt(np.diag(seen)),
        angles_rad=omega_phi_kappa(rotation),
        angles_sigma_rad=np.sqrt(np.diag(jacobian @ total @ jacobian.T)),
        covariance=total,
        corrections=corrections,
        used=tuple(int(k) for k, is_used in zip(used, good, strict=True) if is_used),
        left_out=int(np.count_nonzero(~good)),
        unexplained_rad=np.sqrt(np.where(beyond, np.maximum(np.diag(seen - own), 0.0), 0.0)),
    )


def min_exposures(rig: Rig) -> int:
    """Exposures a cone needs; with fewer its mean is not reported.

    Args:
        rig: its timing is used.

    Returns:
        `MIN_EXPOSURES_SYNTOPIC` or `MIN_EXPOSURES`.
    """
    return MIN_EXPOSURES_SYNTOPIC if rig.timing == "syntopic" else MIN_EXPOSURES


def _autocorrelation_factor(corrections: Array) -> Array:
    """(1 + r) / (1 - r) of neighbouring exposures' correlation r, (3,): at least one."""
    off = corrections - corrections.mean(axis=0)
    r = np.sum(off[1:] * off[:-1], axis=0) / np.maximum(np.sum(off**2, axis=0), 1e-30)
    r = np.clip(r, 0.0, 0.9)
    return np.asarray((1.0 + r) / (1.0 - r))


def base_mm(rig: Rig, cone: Cone) -> tuple[float, float]:
    """From where the virtual image is seen to where the cone sees from.

    Args:
        rig: the camera.
        cone: one of its cones.

    Returns:
        (right, forward), mm. Forward is zero for cones that fire one after the other over one
        place; both are zero for converging heads, whose placement takes the height into account.
    """
    forward, right, _ = np.subtract(cone.position_mm, rig.image_position_mm)
    if rig.has_virtual_camera:
        return 0.0, 0.0  # its placement takes the ground's height into account
    return float(right), 0.0 if rig.timing == "syntopic" else float(forward)


def _common_covariance(rig: Rig, cone: Cone, records: Sequence[StitchRecord]) -> Array:
    """Covariance common to all exposures, (3, 3): places, matching of colour, height."""
    share = _position_covariance(rig, cone, records)
    if cone.role == "colour":
        sensor = cone.sensors[0]
        is_master = cone.name == rig.colour_master_cone
        shift_px = COLOUR_SHIFT_PX if is_master else REGISTERED_PX
        rotation_px = COLOUR_ROTATION_PX if is_master else REGISTERED_PX
        half_px = math.hypot(sensor.width_px, sensor.height_px) / 2.0
        across = shift_px * sensor.pitch_mm / cone.lens.f_mm
        share = share + np.diag(np.square([across, across, rotation_px / half_px]))
    base = np.mean([_base_rotation(rig, cone, r) for r in records], axis=0)
    return np.asarray(share + np.diag(np.square(HEIGHT_SIGMA * base)))


def _position_covariance(rig: Rig, cone: Cone, records: Sequence[StitchRecord]) -> Array:
    """What places of sensors add to a turn, (3, 3): the cone's own, and that of the datum."""
    dc_k = {
        s.name: float(np.mean([abs(r.dc_k.get(s.name, 0.0)) for r in records])) for s in rig.sensors
    }
    own = place_covariance(cone, dc_k)
    if not rig.has_virtual_camera:
        return own + place_covariance(rig.cone(rig.master_cone), dc_k, is_datum=True)
    heads = rig.pan_cones
    of_mean = sum((place_covariance(c, dc_k) for c in heads), np.zeros((3, 3))) / len(heads) ** 2
    if cone not in heads:
        return own + of_mean
    return own * (1.0 - 2.0 / len(heads)) + of_mean


def _is_usable_record(rig: Rig, cone: Cone, record: StitchRecord) -> bool:
    known = record.height_m is not None and record.height_m > 0.0
    return f"{cone.name}.{ROTATIONS[0]}" in record.names and (known or not any(base_mm(rig, cone)))


def _mounting_correction(rig: Rig, cone: Cone, record: StitchRecord) -> tuple[Array, Array]:
    at = [record.names.index(f"{cone.name}.{what}") for what in ROTATIONS]
    correction = record.values[at] * 1e-6 - _base_rotation(rig, cone, record)
    return correction, record.covariance[np.ix_(at, at)] * 1e-12


def _base_rotation(rig: Rig, cone: Cone, record: StitchRecord) -> Array:
    """Apparent rotation by a base over even ground: seen from the right, all appears farther
    left."""
    right, forward = base_mm(rig, cone)
    if record.height_m is None:
        return np.zeros(3)
    return np.array([forward, -right, 0.0]) * 1e-3 / record.height_m

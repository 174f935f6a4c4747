"""A network: observations between images and ground, and prior knowledge.

Frozen arrays; the only behaviour is validation. A projection centre (station) and a rotation
(attitude) are separate, so that images may share either; a head is the place of a camera
against the rotation and the projection centre it shares with others.

Conventions: image coordinates mm, x right, y up; camera axes x right, y forward, z up, an image
point is the vector (x, y, -f); rotations carry camera to object; object coordinates are Cartesian,
metres.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from processing import ProcessingError
from processing.bundle.curvature_refraction import RayModel
from processing.bundle.frame_patterns import FramePatterns
from processing.bundle.terms import Term

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

INTERIOR: Final = ("dx0", "dy0", "df", "k1", "k2", "k3", "p1", "p2", "b1", "b2")
"""The Australis ten, in the order of every array that holds them."""

Model = Literal["australis", "centred", "opencv", "fisheye"]


class NetworkError(ProcessingError, ValueError):
    """A network that cannot be adjusted as given; `problems` has a sentence for each error."""

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(problems))


@dataclass(frozen=True)
class CameraModel:
    """The interior orientation of one camera.

    `model` selects how the ten act on measured coordinates (`camera_model`): `australis` is eq. 5.1
    of Heier et al. (2002) about the given principal point; `centred` applies affinity and shear
    first and the polynomials about the estimated principal point, as most close-range programs do.
    `opencv` and `fisheye` distort ideal coordinates (`forward_models`); of `fisheye` p1 is the
    fourth coefficient, and p2 is not used.

    `interior` holds starting values of the ten, (10,); `free` names those to be estimated, `sigma`
    gives a priori standard deviations of any of them or of terms (pseudo-observations of the
    starting values). `terms` are additional parameters, all estimated; each of `gauges` names
    terms whose sum is zero.
    """

    name: str
    f_mm: float
    xp_mm: float = 0.0
    yp_mm: float = 0.0
    model: Model = "australis"
    interior: Array = field(default_factory=lambda: np.zeros(10))
    free: frozenset[str] = frozenset()
    sigma: Mapping[str, float] = field(default_factory=dict)
    terms: tuple[Term, ...] = ()
    gauges: tuple[tuple[str, ...], ...] = ()
    pixel_mm: float | None = None


@dataclass(frozen=True)
class HeadTiming:
    """When a head exposes, against the instant of the exposure's station.

    `delay_s`: the middle row's mid-exposure is later by this. `readout_s`: the row of the smallest
    y is exposed later than that of the largest, `frame_height_mm` away, by this (rolling shutter).
    Each is held, estimated, or (sigma given) estimated with its value as an observation. With
    `jitter_sigma_s` every image has a further delay of its own, zero with this standard deviation.
    """

    delay_s: float = 0.0
    delay_free: bool = False
    delay_sigma_s: float | None = None
    readout_s: float = 0.0
    readout_free: bool = False
    readout_sigma_s: float | None = None
    frame_height_mm: float = math.inf
    jitter_sigma_s: float | None = None

    @property
    def uses_motion(self) -> bool:
        """Whether an image of this head depends on the motion of the rig."""
        free = self.delay_free or self.readout_free or self.jitter_sigma_s is not None
        return free or self.delay_s != 0.0 or self.readout_s != 0.0


@dataclass(frozen=True)
class HeadMounting:
    """Mounting of a camera in a rig: rotation rig_from_camera (3, 3), offset in rig axes, m (3,).

    A quantity is held at its value, estimated, or (`sigma` given, positive) estimated with its
    value as an observation.
    """

    name: str
    rotation: Array
    offset_m: Array
    rotation_free: bool = False
    offset_free: bool = False
    rotation_sigma_rad: float | None = None
    offset_sigma_m: float | None = None
    timing: HeadTiming = field(default_factory=HeadTiming)


@dataclass(frozen=True)
class Motion:
    """Motion of the rig at the instants of the n stations, from a trajectory.

    `velocity_mps` and `acceleration_mps2` (n, 3) of the rig's origin in object axes;
    `rate_rad_per_s` and `rate_change_rad_per_s2` (n, 3) about the axes of the rig (camera axes: x
    right, y forward, z up).
    """

    velocity_mps: Array
    acceleration_mps2: Array
    rate_rad_per_s: Array
    rate_change_rad_per_s2: Array


@dataclass(frozen=True)
class Stations:
    """Projection centres: (n, 3) m, object system. `fixed` (n,): held."""

    names: tuple[str, ...]
    position_m: Array
    fixed: NDArray[np.bool_]


@dataclass(frozen=True)
class Attitudes:
    """Rotations, object from camera (or rig): (n, 3, 3). `fixed` (n,): held."""

    names: tuple[str, ...]
    rotation: Array
    fixed: NDArray[np.bool_]


@dataclass(frozen=True)
class Images:
    """Which station, attitude, camera and head (-1: none) an image has; indices (n,)."""

    names: tuple[str, ...]
    station: Indices
    attitude: Indices
    camera: Indices
    head: Indices


@dataclass(frozen=True)
class Points:
    """Object points, (n, 3) m.

    `sigma_m` (n, 3), coordinate by coordinate: NaN unknown, zero held, positive observed with that
    standard deviation. `at_infinity` (n,): the coordinates are a direction (collimator).
    """

    names: tuple[str, ...]
    xyz_m: Array
    sigma_m: Array
    at_infinity: NDArray[np.bool_]


@dataclass(frozen=True)
class ImagePoints:
    """Measured image coordinates (n, 2) mm with standard deviations (n, 2) mm."""

    image: Indices
    point: Indices
    xy_mm: Array
    sigma_mm: Array


@dataclass(frozen=True)
class Distances:
    """Measured distances between object points, (n,) m."""

    point_a: Indices
    point_b: Indices
    distance_m: Array
    sigma_m: Array


@dataclass(frozen=True)
class Gnss:
    """Antenna positions, (n, 3) m, of images' exposures.

    The antenna is at station + attitude * lever_m, plus the line's shift and drift.
    `line` (n,) indexes `lines`, -1 is none; drift is linear in `time_s` (n,). `drift` selects what
    is estimated for every line: nothing, a shift, or a shift and a drift.
    """

    station: Indices
    attitude: Indices
    position_m: Array
    sigma_m: Array
    lever_m: Array
    line: Indices
    time_s: Array
    lines: tuple[str, ...] = ()
    drift: Literal["none", "shift", "linear"] = "none"


@dataclass(frozen=True)
class MeasuredAttitudes:
    """Measured attitudes (n, 3, 3), sigma (n, 3) rad about the axes of the camera or rig."""

    attitude: Indices
    rotation: Array
    sigma_rad: Array


@dataclass(frozen=True)
class LinearConstraint:
    """sum of coefficient * (unknown's correction against its starting value) = 0, by name."""

    coefficients: Mapping[str, float]


def no_distances() -> Distances:
    """An empty table of distances.

    Returns:
        No rows.
    """
    return Distances(_index(()), _index(()), np.zeros(0), np.zeros(0))


def no_gnss() -> Gnss:
    """An empty table of antenna positions.

    Returns:
        No rows and no lines.
    """
    empty = np.zeros((0, 3))
    return Gnss(_index(()), _index(()), empty, empty, empty, _index(()), np.zeros(0))


def no_measured_attitudes() -> MeasuredAttitudes:
    """An empty table of measured attitudes.

    Returns:
        No rows.
    """
    return MeasuredAttitudes(_index(()), np.zeros((0, 3, 3)), np.zeros((0, 3)))


@dataclass(frozen=True)
class Network:
    """All tables. `problems` names inconsistencies.

    `patterns` are those of stitching, one entry for each image or none at all.
    """

    cameras: tuple[CameraModel, ...]
    stations: Stations
    attitudes: Attitudes
    images: Images
    points: Points
    image_points: ImagePoints
    heads: tuple[HeadMounting, ...] = ()
    distances: Distances = field(default_factory=no_distances)
    gnss: Gnss = field(default_factory=no_gnss)
    measured_attitudes: MeasuredAttitudes = field(default_factory=no_measured_attitudes)
    constraints: tuple[LinearConstraint, ...] = ()
    rays: RayModel = field(default_factory=RayModel)
    motion: Motion | None = None
    patterns: tuple[FramePatterns | None, ...] = ()

    def problems(self) -> tuple[str, ...]:
        """Check shapes, indices and numbers.

        Returns:
            One sentence for each error; empty when the tables fit.
        """
        return tuple(_problems(self))


def validate(network: Network) -> Network:
    """Refuse a network whose tables do not fit.

    Args:
        network: to be checked.

    Returns:
        The network itself.

    Raises:
        NetworkError: with everything that is wrong with it.
    """
    problems = network.problems()
    if problems:
        raise NetworkError(problems)
    return network


def _index(values: Sequence[int]) -> Indices:
    return np.asarray(values, dtype=np.int64)


def _problems(n: Network) -> list[str]:
    found: list[str] = []
    found += _indices("image point", "image", n.image_points.image, len(n.images.names))
    found += _indices("image point", "object point", n.image_points.point, len(n.points.names))
    found += _indices("image", "station", n.images.station, len(n.stations.names))
    found += _indices("image", "attitude", n.images.attitude, len(n.attitudes.names))
    found += _indices("image", "camera", n.images.camera, len(n.cameras))
    found += _indices("image", "head", n.images.head, len(n.heads), least=-1)
    found += _indices("distance", "point", n.distances.point_a, len(n.points.names))
    found += _indices("distance", "point", n.distances.point_b, len(n.points.names))
    found += _indices("GNSS position", "station", n.gnss.station, len(n.stations.names))
    found += _indices("GNSS position", "line", n.gnss.line, len(n.gnss.lines), least=-1)
    found += _indices("bearing", "attitude", n.measured_attitudes.attitude, len(n.attitudes.names))
    for what, array, shape in (
        ("stations", n.stations.position_m, (len(n.stations.names), 3)),
        ("attitudes", n.attitudes.rotation, (len(n.attitudes.names), 3, 3)),
        ("object points", n.points.xyz_m, (len(n.points.names), 3)),
        ("sigmas of object points", n.points.sigma_m, (len(n.points.names), 3)),
        ("image coordinates", n.image_points.xy_mm, (len(n.image_points.image), 2)),
        ("GNSS positions", n.gnss.position_m, (len(n.gnss.station), 3)),
    ):
        if array.shape != shape:
            found.append(f"{what} are {array.shape}; {shape} fits the other tables")
        elif what != "sigmas of object points" and not np.isfinite(array).all():
            found.append(f"{what} hold a value that is not a finite number")
    for what, sigma in (
        ("image coordinate", n.image_points.sigma_mm),
        ("distance", n.distances.sigma_m),
        ("GNSS position", n.gnss.sigma_m),
        ("bearing", n.measured_attitudes.sigma_rad),
    ):
        if sigma.size and not (sigma > 0.0).all():
            found.append(f"a {what} has a sigma that is not positive; held values need no sigma")
    for camera in n.cameras:
        if not camera.f_mm > 0.0:
            found.append(f"camera {camera.name}: f {camera.f_mm} mm; it is positive")
        if camera.model == "fisheye" and ("p2" in camera.free or camera.interior[7] != 0.0):
            found.append(f"camera {camera.name}: fisheye has no p2; its four are k1, k2, k3 and p1")
        if camera.terms and camera.model in ("opencv", "fisheye"):
            found.append(
                f"camera {camera.name}: additional parameters need the model australis or centred"
            )
        unknown = camera.free - set(INTERIOR)
        if unknown:
            found.append(f"camera {camera.name}: {sorted(unknown)} are none of {INTERIOR}")
    for what, names in (
        ("camera", [c.name for c in n.cameras]),
        ("head", [h.name for h in n.heads]),
        ("station", n.stations.names),
        ("attitude", n.attitudes.names),
        ("image", n.images.names),
        ("object point", n.points.names),
    ):
        if len(set(names)) < len(names):
            twice = next(name for name in names if list(names).count(name) > 1)
            found.append(f"{what} {twice} is given twice")
    found += _motion_problems(n)
    if n.patterns and len(n.patterns) != len(n.images.names):
        found.append(
            f"{len(n.patterns)} patterns of stitching; one for each of {len(n.images.names)} "
            "images, or none, is right"
        )
    if not n.rays.is_straight and n.points.at_infinity.any():
        found.append("directions of a collimator have neither earth curvature nor refraction")
    return found


def _motion_problems(n: Network) -> list[str]:
    found: list[str] = []
    for head in n.heads:
        timing, own = head.timing, f"head {head.name}"
        if timing.uses_motion and n.motion is None:
            found.append(f"{own} has a delay, jitter or readout time, and no motion is given")
        sigmas = (timing.delay_sigma_s, timing.readout_sigma_s, timing.jitter_sigma_s)
        if any(sigma is not None and not sigma > 0.0 for sigma in sigmas):
            found.append(f"{own}: a sigma of delay, readout time or jitter is not positive")
        if not timing.frame_height_mm > 0.0:
            found.append(f"{own}: frame height {timing.frame_height_mm} mm; it is positive")
        reads = timing.readout_free or timing.readout_s != 0.0
        if reads and not math.isfinite(timing.frame_height_mm):
            found.append(f"{own} has a readout time, and the height of its frame is not given")
    if n.motion is None:
        return found
    shape = (len(n.stations.names), 3)
    for what, array in (
        ("velocities", n.motion.velocity_mps),
        ("accelerations", n.motion.acceleration_mps2),
        ("rates", n.motion.rate_rad_per_s),
        ("changes of rates", n.motion.rate_change_rad_per_s2),
    ):
        if array.shape != shape:
            found.append(f"{what} are {array.shape}; {shape} fits the other tables")
        elif not np.isfinite(array).all():
            found.append(f"{what} hold a value that is not a finite number")
    return found


def _indices(what: str, of: str, index: Indices, count: int, *, least: int = 0) -> list[str]:
    if index.size and (index.min() < least or index.max() >= count):
        return [f"a {what} refers to a {of} that is not there ({count} given)"]
    return []

"""The block of Jacobsen (2008): one nadir and four oblique heads, three lines of four stations.

Image coordinates only, by the emulator's own projection: lenses that distort by up to 100 um, heads
mounted as the paper's table 2 has them, control read from an orthoimage and a height model.

Source: Jacobsen (2008), table 2. It lists phi, omega, kappa with phi primary, in
grads; three values lost their leading sign and zero and are read as -.0261, -.3585, -.5065.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sim_hw.world.seeding import random_stream
from sim_hw.world.true_camera import rotation_opk

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

GRAD = math.pi / 200.0
PIXEL_MM = 7.2e-3
HALF_WIDTH_MM = 4992 * PIXEL_MM / 2.0
HALF_HEIGHT_MM = 3328 * PIXEL_MM / 2.0
NADIR = "nadir"
TABLE_2_GRAD = {
    # phi, omega, kappa of nadir from oblique, R = Ry(phi) Rx(omega) Rz(kappa)
    "5": (-0.0261, 49.9609, -0.3585),
    "7": (-49.1002, -0.5065, -99.8977),
    "8": (1.7375, -51.1537, 199.2017),
    "19": (51.3505, 0.4023, 99.6800),
}
HEADS = (NADIR, *TABLE_2_GRAD)
F_MM = {NADIR: 23.8, **dict.fromkeys(TABLE_2_GRAD, 51.0)}


@dataclass(frozen=True)
class MeasurementNoise:
    """Standard deviations of what is measured.

    `image_mm` of nadir and oblique coordinates (1.4 px is what the paper's nadir images show),
    `control_m` in plan and height (an orthoimage of 1 m pixels and a height model), `gnss_m`,
    `inertial_rad` about the rig's x, y and z, and what f and the principal point are off.
    """

    image_mm: tuple[float, float] = (0.011, 0.020)
    control_m: tuple[float, float] = (0.35, 1.5)
    gnss_m: float = 0.10
    inertial_rad: tuple[float, float, float] = (8e-5, 8e-5, 2e-4)
    principal_mm: float = 0.05


@dataclass(frozen=True)
class ObliqueBlock:
    """The measurements, and the truth for comparison.

    Image coordinates are of image `image` = exposure * 5 + head. The first `control` points are
    known to the adjustment, the next `checks` are not.
    """

    station: Array
    rotation: Array
    gnss_m: Array
    inertial: Array
    boresight: Array
    line: Indices
    time_s: Array
    head_rotation: Array
    f_mm: Array
    principal_mm: Array
    radial: Array
    points: Array
    surveyed_m: Array
    control: int
    checks: int
    image: Indices
    point: Indices
    xy_mm: Array
    noise: MeasurementNoise = field(default_factory=MeasurementNoise)


def table_2_rotation(name: str) -> Array:
    """Nadir from oblique, (3, 3), of table 2; the nadir head is one."""
    if name == NADIR:
        return np.eye(3)
    return np.asarray(Rotation.from_euler("YXZ", np.multiply(TABLE_2_GRAD[name], GRAD)).as_matrix())


def simulate_oblique_block(
    seed: int, *, noise: MeasurementNoise | None = None, checks: int = 40
) -> ObliqueBlock:
    """Three lines of four stations, the middle one flown the other way, 32 control points."""
    noise = noise or MeasurementNoise()
    control = 32
    random = random_stream(seed, "oblique")
    height, base, line_spacing = 562.0, 226.0, 500.0
    station, rotation, line, time = [], [], [], []
    for k in range(3):
        north = k == 1
        for j in range(4):
            y = (j - 1.5) * base * (1.0 if north else -1.0)
            station.append(np.array([(k - 1) * line_spacing, y, height]) + random.normal(0, 4.0, 3))
            tilt = random.normal(0.0, math.radians(1.5), 3)
            rotation.append(rotation_opk((tilt[0], tilt[1], tilt[2] + (0.0 if north else math.pi))))
            line.append(k)
            time.append(300.0 * k + j * base / 60.0)
    centres, rotations = np.array(station), np.array(rotation)
    # Mounted about as in table 2, to a few milligrads of the calibration before.
    mounted = np.array([table_2_rotation(name) for name in HEADS])
    f = np.array([F_MM[n] + random.normal(0.0, noise.principal_mm) for n in HEADS])
    principal = random.normal(0.0, noise.principal_mm, (5, 2))
    edge = math.hypot(HALF_WIDTH_MM, HALF_HEIGHT_MM)
    # 100 um at the image corner with a zero crossing, as the paper's figure 8; like lenses alike.
    radial = np.array(
        [_radial(edge, 0.10 if n == NADIR else 0.08 + 0.005 * k) for k, n in enumerate(HEADS)]
    )
    places = random.uniform([-950.0, -850.0], [950.0, 850.0], (control + checks + 500, 2))
    places[: control + checks] *= 0.72
    waves = random.uniform(0.0, 2.0 * math.pi, 4)
    relief = 12.0 * np.sin(places[:, 0] / 160.0 + waves[0]) + 9.0 * np.sin(
        places[:, 1] / 110.0 + waves[1]
    )
    points = np.column_stack([places, relief])
    image, point, xy = [], [], []
    for e in range(len(centres)):
        for h in range(5):
            seen = (points - centres[e]) @ rotations[e] @ mounted[h]
            with np.errstate(all="ignore"):
                ideal = -f[h] * seen[:, :2] / seen[:, 2:]
            front = seen[:, 2] < 0.0
            front &= (np.abs(ideal) < [HALF_WIDTH_MM * 0.98, HALF_HEIGHT_MM * 0.98]).all(axis=1)
            rows = np.flatnonzero(front)
            measured = _distorted(ideal[rows], radial[h]) + principal[h]
            sigma = noise.image_mm[0 if h == 0 else 1]
            image.append(np.full(len(rows), e * 5 + h))
            point.append(rows)
            xy.append(measured + random.normal(0.0, sigma, measured.shape))
    spread = [noise.control_m[0], noise.control_m[0], noise.control_m[1]]
    surveyed = points[: control + checks]
    boresight = rotation_opk((0.012, -0.008, 0.02))
    disturbed_rotation = np.array([rotation_opk((a, b, c)) for a, b, c in random.normal(
        0.0, noise.inertial_rad, (len(centres), 3))])  # fmt: skip
    return ObliqueBlock(
        station=centres,
        rotation=rotations,
        gnss_m=centres + random.normal(0.0, noise.gnss_m, centres.shape),
        inertial=rotations @ disturbed_rotation @ boresight.T,
        boresight=boresight,
        line=np.array(line),
        time_s=np.array(time),
        head_rotation=mounted,
        f_mm=f,
        principal_mm=principal,
        radial=radial,
        points=points,
        surveyed_m=surveyed + random.normal(0.0, spread, surveyed.shape),
        control=control,
        checks=checks,
        image=np.concatenate(image),
        point=np.concatenate(point),
        xy_mm=np.concatenate(xy),
        noise=noise,
    )


def _radial(edge_mm: float, size_mm: float) -> Array:
    """K1 and K2 of a correction that is `size_mm` at the edge and changes sign inside."""
    k1 = -size_mm / edge_mm**3
    return np.array([k1, -2.0 * k1 / edge_mm**2])


def _distorted(ideal: Array, radial: Array) -> Array:
    """Measured coordinates whose correction by K1 and K2 gives the ideal ones."""
    measured = ideal.copy()
    for _ in range(30):
        r2 = np.sum(measured**2, axis=1, keepdims=True)
        measured = ideal - measured * r2 * (radial[0] + r2 * radial[1])
    return measured

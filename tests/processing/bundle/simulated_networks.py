"""Small networks with known truth, projected point by point with code of their own."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from processing.bundle.network import (
    Attitudes,
    CameraModel,
    Distances,
    Gnss,
    HeadMounting,
    ImagePoints,
    Images,
    MeasuredAttitudes,
    Network,
    Points,
    Stations,
)
from processing.bundle.terms import Part, Term

Array = NDArray[np.float64]

PARTS = (
    Part("A", "0", -30.0, -20.0, 1.0, 20.0),
    Part("B", "1", -1.0, -20.0, 30.0, 20.0),
)


@dataclass(frozen=True)
class SimulatedNetwork:
    """A network with disturbed starting values, and its truth."""

    network: Network
    station: Array
    attitude: Array
    points: Array
    interior: Array


def rotation_of(omega: float, phi: float, kappa: float) -> Array:
    cx, sx, cy, sy = math.cos(omega), math.sin(omega), math.cos(phi), math.sin(phi)
    cz, sz = math.cos(kappa), math.sin(kappa)
    rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return np.asarray(rx @ ry @ rz, dtype=np.float64)


def measured_from_ideal(camera: CameraModel, ideal: Array) -> Array:
    """Heier et al. (2002), eq. 5.1, inverted by fixed-point iteration, one image point (2,)."""
    dx0, dy0, df, k1, k2, k3, p1, p2, b1, b2 = camera.interior
    measured = ideal.copy()
    for _ in range(60):
        # A CCD's own displacement comes before the lens.
        placed = measured
        for term in camera.terms:
            assert term.kind == "rotation", "what these networks are made with"
            u, v = measured - (camera.xp_mm, camera.yp_mm)
            if term.sensors == ("B",) and u > 0.0:
                cu, cv = term.parts[1].centre_mm
                placed = placed + term.value * np.array([-(v - cv), u - cu])
        if camera.model == "australis":
            x, y = placed - (camera.xp_mm, camera.yp_mm)
            r2 = x * x + y * y
            radial = k1 * r2 + k2 * r2**2 + k3 * r2**3 + df / camera.f_mm
            dx = dx0 + x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y + b1 * x + b2 * y
            dy = dy0 + y * radial + 2 * p1 * x * y + p2 * (r2 + 2 * y * y)
            now = np.array([x + dx, y + dy])
        else:
            a, y = placed - (camera.xp_mm, camera.yp_mm) + np.array([dx0, dy0])
            x = a * (1 + b1) + y * b2
            r2 = x * x + y * y
            radial = k1 * r2 + k2 * r2**2 + k3 * r2**3
            now = np.array(
                [
                    x + x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y,
                    y + y * radial + 2 * p1 * x * y + p2 * (r2 + 2 * y * y),
                ]
            )
        measured = measured + (ideal - now)
    return measured


def aerial(
    *,
    seed: int = 1,
    cameras: tuple[CameraModel, ...] | None = None,
    heads: tuple[HeadMounting, ...] = (),
    lines: int = 2,
    along: int = 4,
    points: int = 60,
    sigma_mm: float = 0.0,
    control: int = 8,
    control_sigma_m: float = 0.02,
    gnss_sigma_m: float | None = None,
    relief_m: float = 60.0,
    heights: tuple[float, ...] = (1000.0,),
    disturb: float = 1.0,
    tilt_rad: float = 0.02,
) -> SimulatedNetwork:
    """Strips of images over hilly ground; every head of an exposure is an image of its own."""
    random = np.random.default_rng(seed)
    cameras = cameras or (CameraModel("c", 70.0),)
    station, attitude, line_of, time = [], [], [], []
    for line in range(lines):
        for k in range(along):
            height = heights[line % len(heights)]
            station.append(np.array([150.0 * k, 350.0 * line, height]) + random.normal(0, 5, 3))
            kappa = math.pi * (line % 2) + random.normal(0, 0.02)
            attitude.append(rotation_of(*random.normal(0, 1, 2) * tilt_rad, kappa))
            line_of.append(line)
            time.append(100.0 * line + 2.0 * k)
    stations, attitudes = np.array(station), np.array(attitude)
    ground = np.column_stack(
        [
            random.uniform(-250, 150 * along + 100, points),
            random.uniform(-250, 350 * lines - 100, points),
            random.uniform(0, relief_m, points),
        ]
    )
    mounted = heads or (None,)
    names, of_station, of_camera, of_head = [], [], [], []
    image, point, xy = [], [], []
    for e in range(len(stations)):
        for h, head in enumerate(mounted):
            camera = cameras[min(h, len(cameras) - 1)]
            names.append(f"{e}-{h}")
            of_station.append(e)
            of_camera.append(min(h, len(cameras) - 1))
            of_head.append(h if head is not None else -1)
            for p in range(points):
                seen = attitudes[e].T @ (ground[p] - stations[e])
                if head is not None:
                    seen = head.rotation.T @ (seen - head.offset_m)
                if seen[2] > -100.0:
                    continue
                f = camera.f_mm if camera.model == "australis" else camera.f_mm - camera.interior[2]
                ideal = -f * seen[:2] / seen[2]
                if abs(ideal[0]) < 29.0 and abs(ideal[1]) < 19.0:
                    image.append(len(names) - 1)
                    point.append(p)
                    xy.append(
                        measured_from_ideal(camera, ideal) + random.normal(0, 1, 2) * sigma_mm
                    )
    sigma = np.full((points, 3), np.nan)
    sigma[:control] = control_sigma_m
    given = ground + random.normal(0, 1, ground.shape) * disturb
    given[:control] = ground[:control] + random.normal(0, 1, (control, 3)) * control_sigma_m
    starts = np.array([rotation_of(*random.normal(0, 1e-3 * disturb, 3)) for _ in stations])
    n = len(stations)
    exposures = tuple(f"e{k}" for k in range(n))
    index = np.arange(n)
    network = Network(
        cameras=tuple(replace(c, interior=np.zeros(10), terms=_blank(c.terms)) for c in cameras),
        heads=heads,
        stations=Stations(
            exposures, stations + random.normal(0, 1, (n, 3)) * disturb, np.zeros(n, dtype=bool)
        ),
        attitudes=Attitudes(
            exposures, np.einsum("nij,njk->nik", attitudes, starts), np.zeros(n, dtype=bool)
        ),
        images=Images(
            tuple(names),
            np.array(of_station),
            np.array(of_station),
            np.array(of_camera),
            np.array(of_head),
        ),
        points=Points(tuple(f"p{k}" for k in range(points)), given, sigma, np.zeros(points, bool)),
        image_points=ImagePoints(
            np.array(image),
            np.array(point),
            np.array(xy),
            np.full((len(xy), 2), sigma_mm if sigma_mm > 0 else 1e-3),
        ),
    )
    if gnss_sigma_m is not None:
        network = replace(
            network,
            gnss=Gnss(
                station=index,
                attitude=index,
                position_m=stations + random.normal(0, 1, (n, 3)) * gnss_sigma_m,
                sigma_m=np.full((n, 3), gnss_sigma_m),
                lever_m=np.zeros((n, 3)),
                line=np.array(line_of),
                time_s=np.array(time),
                lines=tuple(f"line {k}" for k in range(lines)),
            ),
        )
    interior = np.array([c.interior for c in cameras])
    return SimulatedNetwork(network, stations, attitudes, ground, interior)


def _blank(terms: tuple[Term, ...]) -> tuple[Term, ...]:
    return tuple(replace(term, value=0.0) for term in terms)


def with_everything(seed: int = 3) -> SimulatedNetwork:
    """Two heads of two camera models, terms, GNSS with lever arm and drift, distances, bearings.

    Nothing is noisy; the GNSS positions of line 1 are 0.1 m off in every coordinate.
    """
    ten = frozenset({"dx0", "dy0", "df", "k1", "k2", "k3", "p1", "p2", "b1", "b2"})
    interior = np.array([0.02, -0.03, 0.05, 2e-6, 1e-9, 1e-13, 1e-6, -2e-6, 1e-5, -2e-5])
    rotation = Term("rotation B", "rotation", ("B",), PARTS, value=3e-5)
    known = interior.copy()
    known[5] = 0.0
    cameras = (
        CameraModel(
            "nadir", 70.0, interior=known, free=ten, terms=(rotation,), sigma={"k3": 1e-12}
        ),
        CameraModel("oblique", 70.0, 0.1, -0.2, model="centred", interior=interior, free=ten),
    )
    heads = (
        HeadMounting("nadir", np.eye(3), np.zeros(3)),
        HeadMounting(
            "oblique",
            rotation_of(0.5, 0.01, 0.02),
            np.array([0.3, -0.2, 0.1]),
            rotation_free=True,
            offset_free=True,
            offset_sigma_m=0.01,
        ),
    )
    simulated = aerial(
        seed=seed, cameras=cameras, heads=heads, lines=3, along=3, points=130, gnss_sigma_m=0.05,
        heights=(1000.0, 1400.0, 1000.0),
    )  # fmt: skip
    network = simulated.network
    n = len(network.stations.names)
    lever = np.tile([0.5, -0.4, 1.2], (n, 1))
    antenna = simulated.station + np.einsum("nij,nj->ni", simulated.attitude, lever)
    drift = np.where(network.gnss.line == 1, 0.1, 0.0)[:, None] * np.ones(3)
    xyz = network.points.xyz_m.copy()
    xyz[:8] = simulated.points[:8]
    pairs = np.array([[20, 30], [40, 1]])
    distance = np.linalg.norm(simulated.points[pairs[:, 0]] - simulated.points[pairs[:, 1]], axis=1)
    return replace(
        simulated,
        network=replace(
            network,
            gnss=replace(network.gnss, position_m=antenna + drift, lever_m=lever, drift="linear"),
            points=replace(network.points, xyz_m=xyz),
            distances=Distances(pairs[:, 0], pairs[:, 1], distance, np.full(2, 0.01)),
            measured_attitudes=MeasuredAttitudes(
                np.arange(n), simulated.attitude.copy(), np.full((n, 3), 1e-3)
            ),
        ),
    )

"""Figures of eight with nine heads that expose late, each by its own delay, with their truth.

Nothing is rendered: image coordinates are where a head sees ground points at the instant at which
it exposes their row. The path, the poses and their derivatives are the emulator's own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from sim_hw.world.seeding import random_stream
from sim_hw.world.true_camera import BODY_FROM_CAMERA

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

PIXEL_MM = 3.76e-3
SIZE_PX = (14192, 10640)
HALF_MM = (SIZE_PX[0] * PIXEL_MM / 2.0, SIZE_PX[1] * PIXEL_MM / 2.0)
NADIR_F_MM = 50.0
OBLIQUE_F_MM = 80.0
GRAVITY_MPS2 = 9.80665
EAST_NORTH_UP_FROM_LEVEL = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_STEP_S = 2e-3
_PATH_STEP_S = 0.01
_READ_TIMES = 4
POINT_COUNT = 3000


@dataclass(frozen=True)
class Figure:
    """One figure of eight.

    `radius_m` is the smallest radius of its turns over ground; `azimuth_deg` the direction of its
    longer axis; `airspeed_mps` is held, so that speed over ground changes with the wind. A figure
    with `is_line` is one straight line of the same length as the longer axis. Roll, pitch and
    heading swing by angles within `swing_deg`.
    """

    height_m: float = 600.0
    airspeed_mps: float = 55.0
    radius_m: float = 700.0
    azimuth_deg: float = 0.0
    is_line: bool = False
    swing_deg: tuple[float, float] = (0.1, 0.4)


@dataclass(frozen=True)
class FlightSigmas:
    """Standard deviations: image mm, control m, antenna m (east, north, up) and attitude rad (about
    forward, right, down), with the times over which errors of the last two are correlated, s.
    """

    image_mm: float = 1.5e-3
    control_m: float = 0.015
    position_m: tuple[float, float, float] = (0.02, 0.02, 0.03)
    position_correlation_s: float = 30.0
    attitude_rad: tuple[float, float, float] = (5e-5, 5e-5, 1e-4)
    attitude_correlation_s: float = 20.0


@dataclass(frozen=True)
class TimedHead:
    """A head: rig from camera (3, 3), offset m in rig axes (x right, y forward, z up), principal
    distance mm, delay, standard deviation of its jitter and readout time, s."""

    name: str
    rotation: Array
    offset_m: Array
    f_mm: float
    delay_s: float
    jitter_s: float
    readout_s: float


@dataclass(frozen=True)
class FigureFlight:
    """The measurements, and the truth for comparison.

    n exposures of the heads `heads`; image k is of exposure `exposure[k]` and head `head[k]`. The
    first `control` points are surveyed. `velocity_mps`, `acceleration_mps2` (of the antenna),
    `angles_rad` and rates are what the receiver and the inertial unit state at the marks `time_s`;
    `centre_m` and `rotation` (object from rig) are true at the marks plus `common_delay_s`.
    """

    heads: tuple[TimedHead, ...]
    time_s: Array
    figure: Indices
    centre_m: Array
    rotation: Array
    exposure: Indices
    head: Indices
    jitter_s: Array
    points: Array
    surveyed_m: Array
    control: int
    image: Indices
    point: Indices
    xy_mm: Array
    position_m: Array
    velocity_mps: Array
    acceleration_mps2: Array
    angles_rad: Array
    rate_rad_per_s: Array
    rate_change_rad_per_s2: Array
    boresight_rad: Array
    antenna_m: Array
    common_delay_s: float
    shift_m: Array
    spread: FlightSigmas = field(default_factory=FlightSigmas)


class _Path:
    """Pose of the rig's origin over time on one figure."""

    def __init__(self, figure: Figure, wind_mps: Array, random: np.random.Generator) -> None:
        self._figure, self._wind = figure, wind_mps
        # The turns of x = a sin u, y = b sin 2u are tightest at its ends: radius 4 b^2 / a.
        self._a, self._b = 2.4 * figure.radius_m, math.sqrt(2.4) / 2.0 * figure.radius_m
        self._swing = np.radians(random.uniform(*figure.swing_deg, 3))
        self._pace = random.uniform(0.15, 0.5, 3)
        self._phase = random.uniform(0.0, 2.0 * math.pi, 3)
        end = 2.0 * self._a if figure.is_line else 2.0 * math.pi
        u, knots, slopes = 0.0, [0.0], []
        while u < end:
            slopes.append(self._pace_of(u))
            k1 = slopes[-1]
            k2 = self._pace_of(u + 0.5 * _PATH_STEP_S * k1)
            k3 = self._pace_of(u + 0.5 * _PATH_STEP_S * k2)
            k4 = self._pace_of(u + _PATH_STEP_S * k3)
            u += _PATH_STEP_S / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            knots.append(u)
        slopes.append(self._pace_of(u))
        time = np.arange(len(knots)) * _PATH_STEP_S
        self.duration_s = float(time[-1])
        self._u = CubicHermiteSpline(time, np.array(knots), np.array(slopes))
        self._turn = _about_up(math.radians(figure.azimuth_deg))

    def _track(self, u: Array | float) -> tuple[Array, Array]:
        """Place (..., 2) east, north and its derivative by u, before the figure is turned."""
        u = np.asarray(u, dtype=np.float64)
        if self._figure.is_line:
            nothing = np.zeros_like(u)
            return (
                np.stack([nothing, u - self._a], axis=-1),
                np.stack([nothing, nothing + 1.0], axis=-1),
            )
        place = np.stack([self._b * np.sin(2.0 * u), self._a * np.sin(u)], axis=-1)
        along = np.stack([2.0 * self._b * np.cos(2.0 * u), self._a * np.cos(u)], axis=-1)
        return place, along

    def _pace_of(self, u: float) -> float:
        """du/dt at the airspeed in this wind, along the track over ground."""
        _, along = self._track(u)
        length = float(np.hypot(*along))
        turn = _about_up(math.radians(self._figure.azimuth_deg))[:2, :2]
        direction = turn @ along / length
        wind = self._wind[:2]
        tail = float(wind @ direction)
        across = math.hypot(*(wind - tail * direction))
        return (tail + math.sqrt(self._figure.airspeed_mps**2 - across**2)) / length

    def velocity(self, t: Array) -> Array:
        """Over ground, (n, 3), east, north, up."""
        _, along = self._track(self._u(t))
        flat = along * self._u(t, 1)[..., None]
        return np.concatenate([flat, np.zeros((*flat.shape[:-1], 1))], axis=-1) @ self._turn.T

    def place(self, t: Array) -> Array:
        """(n, 3), east, north, up."""
        flat, _ = self._track(self._u(t))
        level = np.concatenate([flat, np.zeros((*flat.shape[:-1], 1))], axis=-1) @ self._turn.T
        return np.asarray(level + np.array([0.0, 0.0, self._figure.height_m]))

    def level_from_body(self, t: Array) -> Array:
        """Coordinated turns that head into the wind, and swings about three axes, (n, 3, 3)."""
        air = self.velocity(t) - self._wind
        pull = (self.velocity(t + _STEP_S) - self.velocity(t - _STEP_S)) / (2.0 * _STEP_S)
        heading = np.arctan2(air[:, 0], air[:, 1])
        right = np.stack([np.cos(heading), -np.sin(heading)], axis=1)
        bank = np.arctan(np.sum(pull[:, :2] * right, axis=1) / GRAVITY_MPS2)
        swing = self._swing * np.sin(2.0 * math.pi * self._pace * t[:, None] + self._phase)
        angles = np.stack(
            [heading + swing[:, 2], math.radians(2.0) + swing[:, 1], bank + swing[:, 0]]
        )
        return np.asarray(Rotation.from_euler("ZYX", angles.T).as_matrix())


def nine_heads(
    random: np.random.Generator,
    *,
    delay_s: float = 0.02,
    jitter_s: float = 0.0,
    readout_s: float = 0.0,
) -> tuple[TimedHead, ...]:
    """A nadir head and eight oblique ones around it, with random errors of their mounting.

    Delays lie between zero and `delay_s`; the first head has none: the common delay is its own.
    """
    heads = []
    for k in range(9):
        azimuth = math.radians(45.0 * (k - 1))
        tilt = 0.0 if k == 0 else math.radians(35.0 if k % 2 else 28.0)
        level = Rotation.from_euler("Z", -azimuth) * Rotation.from_euler("X", tilt)
        mounted = level * Rotation.from_rotvec(random.normal(0.0, 2e-3, 3))
        ring = 0.0 if k == 0 else 0.16
        offset = ring * np.array([math.sin(azimuth), math.cos(azimuth), 0.0])
        offset = offset + random.normal(0.0, 0.03, 3)
        heads.append(
            TimedHead(
                "nadir" if k == 0 else f"oblique {k}",
                np.eye(3) if k == 0 else mounted.as_matrix(),
                np.zeros(3) if k == 0 else offset,
                NADIR_F_MM if k == 0 else OBLIQUE_F_MM,
                0.0 if k == 0 else float(random.uniform(0.0, delay_s)),
                jitter_s,
                readout_s,
            )
        )
    return tuple(heads)


def simulate_figure_flight(
    seed: int,
    figures: tuple[Figure, ...] = (Figure(),),
    *,
    heads: tuple[TimedHead, ...] | None = None,
    wind_mps: tuple[float, float] = (5.0, 6.0),
    interval_s: float = 4.0,
    points_per_image: int = 60,
    control: int = 30,
    ground_points: int = POINT_COUNT,
    spread: FlightSigmas | None = None,
) -> FigureFlight:
    """Fly `figures` one after the other over a field with surveyed points.

    Args:
        seed: for all random generators.
        figures: what is flown.
        heads: None: `nine_heads` without jitter or readout time.
        wind_mps: to the east and to the north.
        interval_s: between marks.
        points_per_image: largest number of image points of an image, control points in addition.
        control: surveyed points.
        ground_points: of them and all others.
        spread: None: its defaults.
    """
    spread = spread or FlightSigmas()
    random = random_stream(seed, "figure of eight")
    heads = heads or nine_heads(random)
    unit_from_body = Rotation.from_euler("ZYX", random.normal(0.0, 5e-3, 3)).as_matrix()
    antenna = np.array([0.35, -0.20, -1.25]) + random.normal(0.0, 0.05, 3)
    common = float(random.uniform(0.0, 0.02))
    shift = random.normal(0.0, 0.1, 3)
    reach = max(2.4 * f.radius_m for f in figures) + 300.0
    across = reach if len({f.azimuth_deg for f in figures}) > 1 else 0.5 * reach + 300.0
    ground = random.uniform(-1.0, 1.0, (ground_points, 2)) * [across, reach]
    side = math.ceil(math.sqrt(control))
    grid = np.stack(np.meshgrid(*[np.linspace(-0.75, 0.75, side)] * 2), axis=-1).reshape(-1, 2)
    ground[:control] = grid[np.linspace(0, len(grid) - 1, control).astype(int)] * [across, reach]
    relief = 30.0 * np.sin(ground[:, 0] / 190.0) * np.cos(ground[:, 1] / 230.0)
    points = np.column_stack([ground, relief])

    rows: dict[str, list[Array]] = {}
    exposure: list[int] = []
    of_head: list[int] = []
    jitter: list[float] = []
    image, point, xy = [], [], []
    count, begin_s = 0, 0.0
    for number, figure in enumerate(figures):
        path = _Path(figure, np.array([*wind_mps, 0.0]), random)
        marks = np.arange(0.5, path.duration_s - 0.5, interval_s)
        _append_marks(rows, path, marks, unit_from_body, antenna, common)
        rows.setdefault("figure", []).append(np.full(len(marks), float(number)))
        rows.setdefault("time", []).append(begin_s + marks)
        begin_s += path.duration_s + 60.0
        for at, mark in enumerate(marks):
            for k, head in enumerate(heads):
                own_jitter = float(random.normal(0.0, head.jitter_s)) if head.jitter_s else 0.0
                seen, where = _image_of(path, mark + common + head.delay_s + own_jitter, head,
                                        points)  # fmt: skip
                known = seen[seen < control]
                others = seen[seen >= control]
                if len(others) > points_per_image:
                    others = np.sort(random.choice(others, points_per_image, replace=False))
                chosen = np.concatenate([known, others])
                if len(chosen) < 6:
                    continue
                place = where[np.searchsorted(seen, chosen)]
                image.append(np.full(len(chosen), len(exposure)))
                point.append(chosen)
                xy.append(place + random.normal(0.0, spread.image_mm, place.shape))
                exposure.append(count + at)
                of_head.append(k)
                jitter.append(own_jitter)
        count += len(marks)
    table = {name: np.concatenate(parts) for name, parts in rows.items()}
    time = table["time"]
    position_noise = _correlated(random, time, spread.position_m, spread.position_correlation_s)
    attitude_noise = _correlated(random, time, spread.attitude_rad, spread.attitude_correlation_s)
    unit = table["unit"] @ Rotation.from_rotvec(attitude_noise).as_matrix()
    return FigureFlight(
        heads=heads,
        time_s=time,
        figure=table["figure"].astype(np.int64),
        centre_m=table["centre"],
        rotation=table["rotation"],
        exposure=np.array(exposure),
        head=np.array(of_head),
        jitter_s=np.array(jitter),
        points=points,
        surveyed_m=points[:control] + random.normal(0.0, spread.control_m, (control, 3)),
        control=control,
        image=np.concatenate(image),
        point=np.concatenate(point),
        xy_mm=np.concatenate(xy),
        position_m=table["antenna"] + shift + position_noise,
        velocity_mps=table["velocity"],
        acceleration_mps2=table["acceleration"],
        angles_rad=np.asarray(Rotation.from_matrix(unit).as_euler("ZYX")[:, ::-1]),
        rate_rad_per_s=table["rate"],
        rate_change_rad_per_s2=table["rate_change"],
        boresight_rad=np.asarray(Rotation.from_matrix(unit_from_body).as_euler("ZYX")[::-1]),
        antenna_m=antenna,
        common_delay_s=common,
        shift_m=shift,
        spread=spread,
    )


def _append_marks(
    rows: dict[str, list[Array]], path: _Path, marks: Array, unit_from_body: Array, antenna: Array,
    common: float,
) -> None:  # fmt: skip
    """What receiver and inertial unit would state at the marks without noise, and true poses."""

    def at(t: Array) -> tuple[Array, Array]:
        body = path.level_from_body(t)
        arm = np.einsum("nij,j->ni", EAST_NORTH_UP_FROM_LEVEL @ body, antenna)
        return path.place(t) + arm, body @ unit_from_body.T

    def rate(t: Array) -> Array:
        here, ahead, back = (at(t + s)[1] for s in (0.0, _STEP_S, -_STEP_S))
        turned = np.swapaxes(here, 1, 2) @ (ahead - back) / (2.0 * _STEP_S)
        return np.stack([turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]], axis=1)

    here, ahead, back = (at(marks + s)[0] for s in (0.0, _STEP_S, -_STEP_S))
    true_body = EAST_NORTH_UP_FROM_LEVEL @ path.level_from_body(marks + common)
    for name, values in (
        ("antenna", here),
        ("velocity", (ahead - back) / (2.0 * _STEP_S)),
        ("acceleration", (ahead - 2.0 * here + back) / _STEP_S**2),
        ("unit", at(marks)[1]),
        ("rate", rate(marks)),
        ("rate_change", (rate(marks + _STEP_S) - rate(marks - _STEP_S)) / (2.0 * _STEP_S)),
        ("centre", path.place(marks + common)),
        ("rotation", true_body @ BODY_FROM_CAMERA),
    ):
        rows.setdefault(name, []).append(values)


def _image_of(path: _Path, t: float, head: TimedHead, points: Array) -> tuple[Indices, Array]:
    """Points inside the frame of a head whose middle row is exposed at `t`, and where they are."""

    def projected(instant: Array, own: Array) -> tuple[Array, Array]:
        rig = EAST_NORTH_UP_FROM_LEVEL @ path.level_from_body(instant) @ BODY_FROM_CAMERA
        ray = np.einsum("nji,nj->ni", rig, own - path.place(instant)) - head.offset_m
        seen = ray @ head.rotation
        with np.errstate(all="ignore"):
            return -head.f_mm * seen[:, :2] / seen[:, 2:], seen[:, 2]

    where, depth = projected(np.full(1, t), points)
    near = np.abs(where) < np.array(HALF_MM) * 1.05
    index = np.flatnonzero((depth < -100.0) & near.all(axis=1))
    place = where[index]
    for _ in range(_READ_TIMES if head.readout_s and len(index) else 0):
        row = t - head.readout_s * place[:, 1] / (2.0 * HALF_MM[1])
        place, _ = projected(row, points[index])
    inside = (np.abs(place) < HALF_MM).all(axis=1)
    return index[inside], place[inside]


def _correlated(
    random: np.random.Generator, time_s: Array, sigma: tuple[float, ...], correlation_s: float
) -> Array:
    """Gauss-Markov errors of the first order at increasing instants, (n, 3)."""
    noise = random.normal(0.0, 1.0, (len(time_s), 3))
    for k in range(1, len(time_s)):
        alike = math.exp(-(time_s[k] - time_s[k - 1]) / correlation_s) if correlation_s else 0.0
        noise[k] = alike * noise[k - 1] + math.sqrt(1.0 - alike**2) * noise[k]
    return np.asarray(noise * np.array(sigma))


def _about_up(azimuth_rad: float) -> Array:
    c, s = math.cos(azimuth_rad), math.sin(azimuth_rad)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

"""Tracks of a simulated flight of a rig whose lenses and mountings are known.

Projection written from the definitions of the rig file; it shares no code with what it tests.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from processing.calibration.flight.images import FlightImages
from processing.matching.photograph_tracks import Tracks
from processing.rig import Cone, Lens, Rig, Sensor

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

F_MM, PITCH_UM, WIDTH_PX, HEIGHT_PX = 12.0, 10.0, 900, 600
VIEW_SIMILAR_COSINE = math.cos(math.radians(35.0))


def nominal_rig(mountings: Sequence[tuple[str, tuple[float, float, float]]]) -> Rig:
    """Heads as `syntopic init` writes them: no distortion, angles as stated, degrees."""
    cones = tuple(
        Cone(
            name=name,
            role="pan",
            bands=("pan",),
            position_mm=(0.0, 120.0 * k, 0.0),
            rotation_rad=(
                math.radians(angles[0]),
                math.radians(angles[1]),
                math.radians(angles[2]),
            ),
            probe="",
            calibration_c=20.0,
            lens=Lens(f_mm=F_MM),
            sensors=(
                Sensor(
                    name=name, width_px=WIDTH_PX, height_px=HEIGHT_PX, pitch_um=PITCH_UM,
                    x_mm=0.0, y_mm=0.0, calibration_c=20.0, probe="",
                ),
            ),
        )
        for k, (name, angles) in enumerate(mountings)
    )  # fmt: skip
    first = cones[0].name
    return Rig(
        name="new-rig", title="", timing="synchronous", frame_interval_s=1.0, cones=cones,
        master_cone=first, reference_cone=first, colour_master_cone=None,
        calibration_id="uncalibrated-0", calibration_date="", virtual_image=None,
    )  # fmt: skip


def true_rig(rig: Rig, seed: int) -> Rig:
    """A rig of real lenses near the nominal one: within what the priors state."""
    random = np.random.default_rng(seed)
    cones = []
    for k, cone in enumerate(rig.cones):
        f_mm = F_MM * (1.0 + 0.01 * random.standard_normal())
        lens = replace(
            cone.lens,
            f_mm=f_mm,
            k1=4e-4 * random.standard_normal(),
            k2=2e-6 * random.standard_normal(),
            p1=2e-5 * random.standard_normal(),
            p2=2e-5 * random.standard_normal(),
        )
        x_mm, y_mm = 0.05 * random.standard_normal(2)
        sensor = replace(cone.sensors[0], x_mm=float(x_mm), y_mm=float(y_mm))
        turned = Rotation.from_euler("XYZ", cone.rotation_rad)
        if k:
            turned = turned * Rotation.from_rotvec(0.01 * random.standard_normal(3))
        omega, phi, kappa = turned.as_euler("XYZ").tolist()
        cones.append(replace(cone, lens=lens, sensors=(sensor,), rotation_rad=(omega, phi, kappa)))
    return replace(rig, cones=tuple(cones))


@dataclass(frozen=True)
class FlightPlan:
    """Lines of a flight: heading in degrees and height above ground in m, of each."""

    lines: Sequence[tuple[float, float]]
    exposures: int = 6
    gnss_sigma_m: float = 0.03
    noise_px: float = 0.3
    tilt_deg: float = 2.0
    wander_m: float = 1.0


def flown(rig: Rig, plan: FlightPlan, seed: int, *, relief_m: float = 3.0) -> FlightImages:
    """Images, tracks and positions of a flight of this rig."""
    random = np.random.default_rng(seed)
    poses = [pose for k, line in enumerate(plan.lines) for pose in _line(*line, k, plan, random)]
    ground = random.uniform(-260.0, 260.0, (9000, 3))
    ground[:, 2] = relief_m * np.sin(ground[:, 0] / 30.0) * np.cos(ground[:, 1] / 45.0)
    rows: list[tuple[Indices, Indices, Array]] = []
    heads: list[int] = []
    exposures: list[int] = []
    for e, (station, rotation) in enumerate(poses):
        for h, cone in enumerate(rig.cones):
            px, seen = project(cone, rig.cones[0], station, rotation, ground)
            index = np.full(len(seen), len(heads))
            noisy = px + plan.noise_px * random.standard_normal(px.shape)
            rows.append((index, seen, noisy))
            heads.append(h)
            exposures.append(e)
    image = np.concatenate([row[0] for row in rows])
    point = np.concatenate([row[1] for row in rows])
    px = np.concatenate([row[2] for row in rows])
    tracks = _joined_by_view(image, point, px, rig, heads, len(ground), random)
    position = np.array([station for station, _ in poses])
    sigma = np.full(position.shape, plan.gnss_sigma_m)
    return FlightImages(
        np.array(heads),
        np.array(exposures),
        np.repeat(np.arange(len(plan.lines)), plan.exposures),
        tracks,
        position + sigma * random.standard_normal(position.shape),
        sigma,
        np.zeros(3),
    )


def _line(
    heading_deg: float, height_m: float, number: int, plan: FlightPlan, random: np.random.Generator
) -> list[tuple[Array, Array]]:
    base_m = 0.35 * height_m * HEIGHT_PX * PITCH_UM * 1e-3 / F_MM
    forward = np.array([math.sin(math.radians(heading_deg)), math.cos(math.radians(heading_deg))])
    right = np.array([forward[1], -forward[0]])
    poses = []
    for k in range(plan.exposures):
        along = (k - (plan.exposures - 1) / 2.0) * base_m
        across = 20.0 * (number - (len(plan.lines) - 1) / 2.0)
        # A line flown the other way lies next to the others, not upon them.
        side = across if heading_deg in (0.0, 90.0) else -across
        place = np.append(along * forward + side * right, height_m)
        place += random.normal(0.0, 1.0, 3) * plan.wander_m
        small = np.radians(random.normal(0.0, 1.0, 3) * plan.tilt_deg)
        turn = Rotation.from_euler("Z", -heading_deg, degrees=True) * Rotation.from_rotvec(small)
        poses.append((place, turn.as_matrix()))
    return poses


def project(
    cone: Cone, base: Cone, station: Array, rotation: Array, ground: Array
) -> tuple[Array, NDArray[np.int64]]:
    """Raw pixels of ground points that a head sees, and which points these are."""
    base_rotation = Rotation.from_euler("XYZ", base.rotation_rad).as_matrix()
    own = Rotation.from_euler("XYZ", cone.rotation_rad).as_matrix()
    forward, right, down = np.subtract(cone.position_mm, base.position_mm) * 1e-3
    centre = station + rotation @ base_rotation.T @ np.array([right, forward, -down])
    seen = (ground - centre) @ (rotation @ base_rotation.T @ own)
    ideal = -cone.lens.f_mm * seen[:, :2] / seen[:, 2:]
    sensor = cone.sensors[0]
    near = (seen[:, 2] < 0.0) & (np.abs(ideal) < 0.8 * WIDTH_PX * sensor.pitch_mm).all(axis=1)
    index = np.flatnonzero(near)
    measured = ideal[index]
    for _ in range(30):
        measured = ideal[index] - distortion(cone.lens, measured)
    column = (measured[:, 0] - sensor.x_mm) / sensor.pitch_mm + (WIDTH_PX - 1) / 2.0
    row = (HEIGHT_PX - 1) / 2.0 - (measured[:, 1] - sensor.y_mm) / sensor.pitch_mm
    inside = (column > 0) & (column < WIDTH_PX - 1) & (row > 0) & (row < HEIGHT_PX - 1)
    return np.stack([column, row], axis=1)[inside], index[inside]


def distortion(lens: Lens, xy: Array) -> Array:
    """Heier et al. (2002), eq. 5.1: what is added to measured coordinates, mm."""
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    radial = r2 * lens.k1 + r2 * r2 * lens.k2
    dx = x * radial + lens.p1 * (r2 + 2 * x * x) + 2 * lens.p2 * x * y
    dy = y * radial + 2 * lens.p1 * x * y + lens.p2 * (r2 + 2 * y * y)
    return np.stack([dx, dy], axis=1)


def _joined_by_view(
    image: NDArray[np.int64],
    point: NDArray[np.int64],
    px: Array,
    rig: Rig,
    heads: list[int],
    points: int,
    random: np.random.Generator,
) -> Tracks:
    """Tracks: heads that look apart by more than 35 degrees find no common features."""
    axes = [Rotation.from_euler("XYZ", c.rotation_rad).as_matrix()[:, 2] for c in rig.cones]
    group = [
        next(g for g in range(k + 1) if axes[g] @ axes[k] > VIEW_SIMILAR_COSINE)
        for k in range(len(axes))
    ]
    found = random.random(len(image)) < 0.8
    key = point * len(axes) + np.array([group[heads[i]] for i in image])
    count = np.bincount(key[found], minlength=points * len(axes))
    keep = found & (count[key] >= 2)
    _, number = np.unique(key[keep], return_inverse=True)
    order = np.lexsort((image[keep], number))
    return Tracks(image[keep][order], number[order], px[keep][order], int(number.max()) + 1)

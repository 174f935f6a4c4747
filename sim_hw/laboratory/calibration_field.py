"""A rig in front of an emulated field of targets: `python -m sim_hw.laboratory.calibration_field`.

Some hundred bright targets, surveyed with errors; the rig images them from many positions,
turned and tilted. Frames hold discs with photon and read noise. The truth: every sensor displaced,
turned, scaled and skewed, every cone turned and shifted against the rig file. Projection code of
its own.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import tifffile
from numpy.typing import NDArray

from processing.rig import Cone, Rig, Sensor
from sim_hw.laboratory.instrument_series import command, new_series, run, write_list
from sim_hw.world.seeding import random_stream
from sim_hw.world.true_camera import rotation_opk, undistorted

Array = NDArray[np.float64]

SHIFT_MM: Final = 0.010
ROTATION_RAD: Final = 60e-6
SCALE: Final = 60e-6
SKEW_PER_MM: Final = 3e-6
CONE_RAD: Final = 150e-6
OFFSET_MM: Final = 0.1
LENS: Final = {"k1": 4e-7, "k2": 4e-9, "p1": 2e-6, "p2": 2e-6}
SURVEY_SIGMA_M: Final = 20e-6
HOLDER_SIGMA: Final = (0.003, 2e-3)
"""Standard deviations of the holder's settings: position (m) and attitude (rad)."""
PROBE_NOISE_K: Final = 0.05
TARGET_RADIUS_PX: Final = 6.0
LIGHT_SHARE: Final = 0.7
DARK_SHARE: Final = 0.04


@dataclass(frozen=True)
class TrueSensor:
    """Errors of a sensor against the rig file: shift mm, rotation rad, scale, skew 1/mm (x, y)."""

    shift: tuple[float, float]
    rotation: float
    scale: float
    skew: tuple[float, float]


@dataclass(frozen=True)
class TrueRig:
    """The rig as it is. The first sensor of a cone is not turned: it defines the cone's layer, and
    the master cone defines the rig. `turn` by cone: master_from_cone = R(file) R(turn)."""

    rig: Rig
    sensors: Mapping[str, TrueSensor]
    rotation_rad: Mapping[str, tuple[float, float, float]]
    offset_mm: Mapping[str, tuple[float, float, float]]

    def master_from_cone(self, cone: Cone) -> Array:
        rotation_rad = rotation_opk(self.rotation_rad[cone.name])
        return np.asarray(rotation_opk(cone.rotation_rad) @ rotation_rad)

    def centre_m(self, cone: Cone) -> Array:
        """Projection centre in the axes of the master camera, from the master's."""
        master = self.rig.cone(self.rig.master_cone or self.rig.cones[0].name)
        forward, right, down = np.subtract(cone.position_mm, master.position_mm)
        return np.asarray((np.array([right, forward, -down]) + self.offset_mm[cone.name]) * 1e-3)

    def layer(self, sensor: Sensor, px: Array) -> Array:
        """True layer coordinates, mm, of pixel positions (n, 2)."""
        t = self.sensors[sensor.name]
        pitch = sensor.pitch_um * 1e-3
        u = (px[:, 0] - (sensor.width_px - 1) / 2) * pitch
        v = ((sensor.height_px - 1) / 2 - px[:, 1]) * pitch
        angle, s = sensor.rotation_rad + t.rotation, sensor.scale * (1 + t.scale)
        a, b = s * math.cos(angle), s * math.sin(angle)
        x, y = a * u - b * v, b * u + a * v
        drawn = (sensor.skew_x_ppm_per_mm * 1e-6, sensor.skew_y_ppm_per_mm * 1e-6)
        skew = (drawn[0] + t.skew[0]) * x + (drawn[1] + t.skew[1]) * y
        return np.stack(
            [sensor.x_mm + t.shift[0] + x * (1 + skew), sensor.y_mm + t.shift[1] + y * (1 + skew)],
            axis=1,
        )

    def pixels(self, cone: Cone, sensor: Sensor, ideal: Array) -> Array:
        """Pixel positions (n, 2) that show ideal image points (n, 2), mm."""
        pitch = sensor.pitch_um * 1e-3
        px = np.stack(
            [
                (ideal[:, 0] - sensor.x_mm) / pitch + (sensor.width_px - 1) / 2,
                (sensor.height_px - 1) / 2 - (ideal[:, 1] - sensor.y_mm) / pitch,
            ],
            axis=1,
        )
        for _ in range(25):
            off = ideal - undistorted(cone.lens, self.layer(sensor, px))
            px = px + off * np.array([1.0, -1.0]) / pitch
            if not len(off) or float(np.abs(off).max()) < 1e-10:
                break
        return px


def true_rig(rig: Rig, seed: int) -> TrueRig:
    """Draw the errors of a rig; `rig` of the result has the true lenses."""
    random = random_stream(seed, "test field rig")
    master = rig.master_cone or rig.cones[0].name
    sensors, rotation_rad, offset, cones = {}, {}, {}, []
    for cone in rig.cones:
        for k, sensor in enumerate(cone.sensors):
            dx, dy = random.normal(0, SHIFT_MM, 2)
            kx, ky = random.normal(0, SKEW_PER_MM, 2)
            rotation = float(random.normal(0, ROTATION_RAD)) * (k > 0)
            scale = float(random.normal(0, SCALE))
            sensors[sensor.name] = TrueSensor(
                (float(dx), float(dy)), rotation, scale, (float(kx), float(ky))
            )
        r, o = random.normal(0, CONE_RAD, 3), random.normal(0, OFFSET_MM, 3)
        if cone.name == master:
            r, o = np.zeros(3), np.zeros(3)
        rotation_rad[cone.name] = (float(r[0]), float(r[1]), float(r[2]))
        offset[cone.name] = (float(o[0]), float(o[1]), float(o[2]))
        drawn: dict[str, Any] = {
            key: getattr(cone.lens, key) + float(random.normal(0, sigma))
            for key, sigma in LENS.items()
        }
        cones.append(replace(cone, lens=replace(cone.lens, **drawn)))
    return TrueRig(replace(rig, cones=tuple(cones)), sensors, rotation_rad, offset)


def targets(
    seed: int, count: tuple[int, int], size_m: tuple[float, float], depth_m: float
) -> Array:
    """Targets on a jittered raster in x and y, at random depths, (n, 3) m; z is up to the rig."""
    random = random_stream(seed, "test field targets")
    x, y = np.meshgrid(
        np.linspace(-size_m[0] / 2, size_m[0] / 2, count[0]),
        np.linspace(-size_m[1] / 2, size_m[1] / 2, count[1]),
    )
    jitter = random.uniform(-0.2, 0.2, (2, *x.shape))
    step = (size_m[0] / (count[0] - 1), size_m[1] / (count[1] - 1))
    z = random.uniform(-depth_m / 2, depth_m / 2, x.shape)
    xyz = np.stack([x + jitter[0] * step[0], y + jitter[1] * step[1], z], axis=-1)
    return np.asarray(xyz.reshape(-1, 3))


def poses(seed: int, count: int, distance_m: float) -> Iterator[tuple[Array, Array]]:
    """Place and rotation (object from rig) of each exposure: around the field, turned, tilted."""
    random = random_stream(seed, "test field poses")
    for k in range(count):
        away = distance_m * (0.8, 1.0, 1.25)[k % 3]
        about = 2 * math.pi * k / count
        lean = 0.35 if k % 4 else 0.0
        side = np.array([math.cos(about), math.sin(about)]) * math.sin(lean)
        place = away * np.array([side[0], side[1], math.cos(lean)])
        place[:2] += random.normal(0, 0.03, 2)
        upright = rotation_opk((0.0, 0.0, (k % 4) * math.pi / 2 + float(random.normal(0, 0.03))))
        aim = place - np.append(random.normal(0, 0.04, 2), 0.0)
        z = aim / np.linalg.norm(aim)
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        yield place, np.asarray(np.stack([x, np.cross(z, x), z], axis=1) @ upright)


def seen(
    truth: TrueRig, cone: Cone, sensor: Sensor, place: Array, rotation: Array, xyz: Array
) -> tuple[NDArray[np.int64], Array]:
    """Which targets a sensor sees whole, and where (n, 2) px."""
    own = truth.rig.cone(cone.name)
    centre = place + rotation @ truth.centre_m(cone)
    ray = (xyz - centre) @ (rotation @ truth.master_from_cone(cone))
    ideal = -own.lens.f_mm * ray[:, :2] / ray[:, 2:]
    pitch = sensor.pitch_um * 1e-3
    size = np.array([sensor.width_px, sensor.height_px])
    near = np.abs(ideal - np.array([sensor.x_mm, sensor.y_mm])) < (size / 2 + 20) * pitch
    index = np.flatnonzero(near.all(axis=1))
    px = truth.pixels(own, sensor, ideal[index])
    rim = 2.5 * TARGET_RADIUS_PX
    inside = ((px > rim) & (px < size - 1 - rim)).all(axis=1)
    return index[inside], px[inside]


def frame(sensor: Sensor, px: Array, random: np.random.Generator) -> NDArray[np.uint16]:
    """Raw values of a frame with a bright disc at each position."""
    full = (sensor.full_scale_dn - sensor.black_dn) * sensor.electrons_per_dn
    light = np.full((sensor.height_px, sensor.width_px), DARK_SHARE)
    reach = math.ceil(TARGET_RADIUS_PX + 4)
    for column, row in px:
        c, r = round(float(column)), round(float(row))
        part = (slice(r - reach, r + reach + 1), slice(c - reach, c + reach + 1))
        y, x = np.mgrid[part[0], part[1]]
        d = np.hypot(x - column, y - row)
        # An edge as wide as optics and pixel make it.
        light[part] += LIGHT_SHARE / (1 + np.exp((d - TARGET_RADIUS_PX) / 0.45))
    mean = light * full
    deviate = random.standard_normal(light.shape, dtype=np.float32)
    dn = sensor.black_dn + (mean + np.sqrt(mean + sensor.read_noise_e**2) * deviate) / (
        sensor.electrons_per_dn
    )
    return np.asarray(np.clip(np.floor(dn + 0.5), 0, sensor.full_scale_dn), dtype=np.uint16)


@dataclass(frozen=True)
class FieldPlan:
    """How large the field is and how often it is looked at."""

    count: tuple[int, int] = (30, 26)
    size_m: tuple[float, float] = (1.7, 1.5)
    depth_m: float = 2.0
    distance_m: float = 5.0
    exposures: int = 18


def plan_for(rig: Rig, exposures: int) -> FieldPlan:
    """A field as wide as the rig sees at 5 m, its targets some 60 px apart or more."""
    image = rig.virtual_image
    if image is None:
        raise ValueError(f"rig {rig.name} has no virtual image to size a test field by")
    width, height = (
        5.0 * n * image.pitch_um * 1e-3 / image.f_mm for n in (image.width_px, image.height_px)
    )
    # Turned and seen from the side, the field must still fill every sensor.
    side = 1.35 * max(width, height)
    return FieldPlan(count=(29, 29), size_m=(side, side), exposures=exposures)


def write_series(
    rig: Rig, rig_file: Path, out: Path, *, seed: int, take: int = 1, plan: FieldPlan
) -> Path:
    """Take the frames; returns the folder with `series.json`."""
    series = new_series(out, rig_file)
    truth = true_rig(rig, seed)
    xyz = targets(seed, plan.count, plan.size_m, plan.depth_m)
    random = random_stream(seed, "test field frames", take)
    surveyed = xyz + random.normal(0, SURVEY_SIGMA_M, xyz.shape)
    exposures = []
    places: dict[str, Any] = {}
    for k, (place, rotation) in enumerate(
        poses(seed + 1000 * take, plan.exposures, plan.distance_m)
    ):
        name = f"E{k:03d}"
        (series / name).mkdir()
        files = {}
        for cone in rig.cones:
            for sensor in cone.sensors:
                index, px = seen(truth, cone, sensor, place, rotation, xyz)
                tifffile.imwrite(series / name / f"{sensor.name}.tif", frame(sensor, px, random))
                files[sensor.name] = f"{name}/{sensor.name}.tif"
                places[f"{name}/{sensor.name}"] = np.column_stack([index, px])
        rotation_deg = random.normal(0, HOLDER_SIGMA[1], 3).tolist()
        record = np.asarray(rotation) @ rotation_opk(
            (rotation_deg[0], rotation_deg[1], rotation_deg[2])
        )
        exposures.append(
            {
                "name": name,
                "files": files,
                "position_m": [float(v) for v in place + random.normal(0, HOLDER_SIGMA[0], 3)],
                "object_from_rig": [[float(v) for v in row] for row in record],
                "temperatures": {
                    probe: rig_c + 2.0 + float(random.normal(0, PROBE_NOISE_K))
                    for probe, rig_c in {c.probe: c.calibration_c for c in rig.cones}.items()
                },
            }
        )
        print(f"exposure {k + 1} of {plan.exposures}", file=sys.stderr)
    np.savez(out / "truth" / "places.npz", **places)
    write_list(
        series,
        "lab",
        source="emulated 3D test field",
        serials={"test field": "SIM-FIELD-1"},
        offset_sigma_mm=OFFSET_MM,
        skew_sigma_per_mm=SKEW_PER_MM,
        targets=[
            {"name": f"T{k}", "xyz_m": [float(v) for v in p], "sigma_m": SURVEY_SIGMA_M}
            for k, p in enumerate(surveyed)
        ],
        images=exposures,
    )
    return series


def main(arguments: Sequence[str] | None = None) -> int:
    line = command("test_field", __doc__)
    line.add_argument("--exposures", type=int, default=18, help="how often the field is looked at")

    def take(rig: Rig, file: Path, given: argparse.Namespace) -> Path:
        plan = plan_for(rig, given.exposures)
        return write_series(rig, file, given.out, seed=given.seed, take=given.take, plan=plan)

    return run(line, arguments, take)


if __name__ == "__main__":
    sys.exit(main())

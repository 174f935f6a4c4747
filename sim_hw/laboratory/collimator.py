"""`python -m sim_hw.laboratory.collimator RIG`: a head in front of an emulated collimator.

A collimator on an arm shows one target at infinity under known angles; the head stands in a holder
that is turned between series. Each image is a cut-out around the target, drawn through the true
lens, whose distortion exceeds the ten-parameter model. Projection code of its own.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from processing.rig import Cone, Lens, Rig, Sensor
from sim_hw.laboratory.instrument_series import command, new_series, run, write_list
from sim_hw.world.seeding import random_stream
from sim_hw.world.true_camera import rotation_opk, skewed_by, undistorted

Array = NDArray[np.float64]

CUT_PX: Final = 64
SUBPIXELS: Final = 5
BLUR_PX: Final = 0.55
TARGET_RADIUS_PX: Final = 20.0
LIGHT_SHARE: Final = 0.7
ANGLE_SIGMA_RAD: Final = 0.3e-6
HOLDER_SIGMA_RAD: Final = 2e-3
PROBE_NOISE_K: Final = 0.05
EXTRA_UM: Final = 0.25
"""Amplitude of what the true lens does beyond Heier et al. (2002), eq. 5.1."""
LENS_SPREAD: Final = {
    "dx0_mm": 0.02,
    "dy0_mm": 0.02,
    "df_mm": 0.03,
    "k1": 4e-7,
    "k2": 4e-11,
    "p1": 4e-7,
    "p2": 4e-7,
    "b1": 3e-6,
    "b2": 3e-6,
}
"""How far a true lens lies from the one in the rig file."""


@dataclass(frozen=True)
class TrueHead:
    """The true head. `place` is the true position of the sensor in its layer."""

    cone: Cone
    sensor: Sensor
    lens: Lens
    extra_mm: float
    period_mm: float

    def ideal(self, column: Array, row: Array) -> Array:
        """Ideal image coordinates, mm, of pixel positions; shape (..., 2)."""
        s = self.sensor
        u = (column - (s.width_px - 1) / 2) * s.pitch_um * 1e-3
        v = ((s.height_px - 1) / 2 - row) * s.pitch_um * 1e-3
        c, t = s.scale * math.cos(s.rotation_rad), s.scale * math.sin(s.rotation_rad)
        layer = np.stack([s.x_mm + c * u - t * v, s.y_mm + t * u + c * v], axis=-1)
        layer = layer + skewed_by(s, layer - np.array([s.x_mm, s.y_mm]))
        x, y = layer[..., 0], layer[..., 1]
        w = 2 * math.pi / self.period_mm
        extra = np.stack([np.sin(w * x) * np.cos(w * y), np.cos(w * x + 1) * np.sin(w * y)], -1)
        return np.asarray(undistorted(self.lens, layer) + self.extra_mm * extra)

    def pixel(self, ideal: Array) -> Array:
        """The pixel position (column, row) that shows an ideal point (2,), by search."""
        s = self.sensor
        pitch = s.pitch_um * 1e-3
        at = np.array([(s.width_px - 1) / 2, (s.height_px - 1) / 2])
        for _ in range(30):
            off = ideal - self.ideal(at[0], at[1])
            if float(np.abs(off).max()) < 1e-10:
                break
            at = at + np.array([off[0], -off[1]]) / pitch
        return np.asarray(at)


def true_head(rig: Rig, sensor_name: str, seed: int, *, extra_um: float = EXTRA_UM) -> TrueHead:
    """Draw a lens about the one in the rig file."""
    cone, sensor = rig.cone_of(sensor_name), rig.sensor(sensor_name)
    random = random_stream(seed, "collimator lens", sensor_name)
    drawn = {
        name: getattr(cone.lens, name) + float(random.normal(0, sigma))
        for name, sigma in LENS_SPREAD.items()
    }
    width = sensor.width_px * sensor.pitch_um * 1e-3
    return TrueHead(cone, sensor, replace(cone.lens, **drawn), extra_um * 1e-3, width / 1.5)


def target(u: Array, v: Array, edge: float) -> Array:
    """Reflectance of the target at places in units of its radius: disc, rings, cross, one mark.

    Edges are `edge` wide, the spacing of the places: hard ones would fall on the raster by chance.
    """

    def within(distance: Array, width: float) -> Array:
        return np.asarray(np.clip(0.5 + (width - distance) / edge, 0.0, 1.0))

    r = np.hypot(u, v)
    is_inside = within(r, 0.95)
    rings = within(r, 0.2) + within(np.abs(r - 0.52), 0.1) + within(np.abs(r - 0.875), 0.075)
    cross = np.maximum(within(np.abs(u), 0.06), within(np.abs(v), 0.06)) * is_inside
    mark = within(np.hypot(u - 0.5, v - 0.5), 0.09)
    light = rings + cross - 2 * rings * cross
    light = light + mark - 2 * light * mark
    return np.asarray(0.12 + 0.88 * light)


def direction(alpha: float, beta: float) -> tuple[Array, Array, Array]:
    """To the target in the laboratory, and the axes of its plane: three unit vectors."""
    right, up, backwards = Rotation.from_euler("YX", [-alpha, beta]).as_matrix().T
    return -backwards, right, up


def seen_at(head: TrueHead, rotation: Array, alpha: float, beta: float) -> Array | None:
    """Pixel position of the target's middle, None where the head does not see it whole."""
    ray = direction(alpha, beta)[0] @ rotation
    if ray[2] >= 0:
        return None
    at = head.pixel(-head.lens.f_mm * ray[:2] / ray[2])
    size = np.array([head.sensor.width_px, head.sensor.height_px])
    half = CUT_PX / 2 + 2
    return at if bool(((at > half) & (at < size - 1 - half)).all()) else None


def image(
    head: TrueHead, rotation: Array, angles: tuple[float, float], origin: NDArray[np.int64]
) -> Array:
    """Light on the pixels of a cut-out at `origin` (column, row), zero to one, without noise."""
    fine = (np.arange(-4 * SUBPIXELS, (CUT_PX + 4) * SUBPIXELS) + 0.5) / SUBPIXELS - 0.5
    column, row = np.meshgrid(origin[0] + fine, origin[1] + fine)
    ideal = head.ideal(column, row)
    ray = np.concatenate([ideal, np.full((*ideal.shape[:-1], 1), -head.lens.f_mm)], axis=-1)
    seen = ray @ rotation.T
    to, right, up = direction(*angles)
    depth = seen @ to
    radius = TARGET_RADIUS_PX * head.sensor.pitch_um * 1e-3 / head.lens.f_mm
    edge = 1.0 / (TARGET_RADIUS_PX * SUBPIXELS)
    light = target((seen @ right) / depth / radius, (seen @ up) / depth / radius, edge)
    light = gaussian_filter(light, BLUR_PX * SUBPIXELS)
    inner = light[4 * SUBPIXELS : -4 * SUBPIXELS, 4 * SUBPIXELS : -4 * SUBPIXELS]
    return np.asarray(inner.reshape(CUT_PX, SUBPIXELS, CUT_PX, SUBPIXELS).mean(axis=(1, 3)))


def frame(sensor: Sensor, light: Array, random: np.random.Generator) -> NDArray[np.uint16]:
    """Raw values of a cut-out."""
    full = (sensor.full_scale_dn - sensor.black_dn) * sensor.electrons_per_dn
    mean = light * LIGHT_SHARE * full
    noise = np.sqrt(mean + sensor.read_noise_e**2) * random.standard_normal(light.shape)
    dn = sensor.black_dn + (mean + noise) / sensor.electrons_per_dn
    return np.asarray(np.clip(np.floor(dn + 0.5), 0, sensor.full_scale_dn), dtype=np.uint16)


def holder_rotations(seed: int, name: str, count: int) -> list[Array]:
    """How the head stands in each series: turned by quarters, and not quite upright."""
    random = random_stream(seed, "collimator holder", name)
    tilts = random.normal(0, HOLDER_SIGMA_RAD, (count, 3))
    return [
        rotation_opk((float(t[0]), float(t[1]), k * math.pi / 2 + float(t[2])))
        for k, t in enumerate(tilts)
    ]


def angles_of(
    head: TrueHead, columns: int, rows: int, quarter_rotations: int
) -> list[tuple[float, float]]:
    """A grid of collimator angles that fills the field in a series turned by so many quarters."""
    f = head.cone.lens.f_mm
    pitch = head.sensor.pitch_um * 1e-3
    half = [
        math.atan((n * pitch / 2 - 0.6 * CUT_PX * pitch) / f)
        for n in (head.sensor.width_px, head.sensor.height_px)
    ]
    if quarter_rotations % 2:
        half.reverse()
        columns, rows = rows, columns
    return [
        (float(a), float(b))
        for b in np.linspace(-half[1], half[1], rows)
        for a in np.linspace(-half[0], half[0], columns)
    ]


def write_series(
    rig: Rig,
    rig_file: Path,
    out: Path,
    *,
    sensors: Sequence[str],
    seed: int,
    take: int = 1,
    grid: tuple[int, int] = (11, 7),
    orientations: int = 4,
    extra_um: float = EXTRA_UM,
) -> Path:
    """Take the series of the named sensors; returns the folder with `series.json`.

    `seed` draws the lenses, `take` what happens while the series is taken.
    """
    series = new_series(out, rig_file)
    images = []
    for name in sensors:
        head = true_head(rig, name, seed, extra_um=extra_um)
        random = random_stream(seed, "collimator", take, name)
        (series / name).mkdir()
        rotations = holder_rotations(seed + take, name, orientations)
        centres: list[Array] = []
        for orientation, rotation in enumerate(rotations):
            for angles in angles_of(head, *grid, orientation):
                set_to = tuple(a + float(random.normal(0, ANGLE_SIGMA_RAD)) for a in angles)
                at = seen_at(head, rotation, set_to[0], set_to[1])
                if at is None:
                    continue
                shift = random.integers(-2, 3, 2)
                origin = np.round(at).astype(np.int64) - CUT_PX // 2 + shift
                light = image(head, rotation, (set_to[0], set_to[1]), origin)
                file = f"{name}/{len(centres):04d}.tif"
                tifffile.imwrite(series / file, frame(head.sensor, light, random))
                temperature = head.cone.calibration_c + 1.5 + float(random.normal(0, PROBE_NOISE_K))
                images.append(
                    {
                        "file": file,
                        "sensor": name,
                        "series": f"{name} turned {90 * orientation}",
                        "rotation_deg": 90 * orientation,
                        "origin_px": [int(origin[0]), int(origin[1])],
                        "alpha_rad": angles[0],
                        "beta_rad": angles[1],
                        "temperature_c": temperature,
                    }
                )
                centres.append(at)
        np.savez(
            out / "truth" / f"{name}.npz",
            centre_px=np.array(centres),
            rotation=np.array(rotations),
            lens=np.array([getattr(head.lens, key) for key in LENS_SPREAD]),
        )
        print(f"{name}: {len(centres)} targets", file=sys.stderr)
    first = rig.sensor(sensors[0])
    radius_mm = TARGET_RADIUS_PX * first.pitch_um * 1e-3
    write_list(
        series,
        "head",
        source="emulated collimator",
        serials={"collimator": "SIM-COLLIMATOR-1", "probe": "SIM-PT100-1"},
        angle_sigma_rad=ANGLE_SIGMA_RAD,
        target_radius_rad=radius_mm / rig.cone_of(first.name).lens.f_mm,
        images=images,
    )
    return series


def main(arguments: Sequence[str] | None = None) -> int:
    line = command("collimator", __doc__)
    line.add_argument("--sensor", action="append", required=True, help="may be repeated")
    line.add_argument("--grid", type=int, nargs=2, default=(11, 7), help="targets across and down")
    line.add_argument("--extra", type=float, default=EXTRA_UM, help="um beyond ten parameters")

    def take(rig: Rig, file: Path, given: argparse.Namespace) -> Path:
        return write_series(
            rig,
            file,
            given.out,
            sensors=given.sensor,
            seed=given.seed,
            take=given.take,
            grid=(given.grid[0], given.grid[1]),
            extra_um=given.extra,
        )

    return run(line, arguments, take)


if __name__ == "__main__":
    sys.exit(main())

"""`python -m benchmarks.orthomosaic`: an orthomosaic held against the emulator's ideal orthoimage.

Lines flown there and back are rendered as the ideal camera sees them, with shot noise, hot spot, a
gradient of haze and another exposure time in every image. They are triangulated, and the
orthomosaic is computed over the true height model and over a plane. Displacements are those of
windows against the ideal orthoimage; at a seam, the difference of its two sides.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typer.testing import CliRunner

from daemon.cli import app
from daemon.cli.benchmark.measurement import machine
from daemon.mission.store.level0 import tiff_parts
from daemon.orientation.georeference import Georeference
from daemon.orientation.local_frame import LocalFrame
from processing.rig import shipped_rigs
from sim_hw.processes.exposures import EPOCH_GPS_NS, FIRST_AFTER_S
from sim_hw.world.flight import SimulatedFlight
from sim_hw.world.post_processed_trajectory import marks_of_lines, write_trajectory
from sim_hw.world.rendering import GRID_PX, render_ideal, sample_scene, scene_positions
from sim_hw.world.scene import Scene, open_scene
from sim_hw.world.world import World, WorldSettings

Array = NDArray[Any]

LEVEL = 8000.0
NOISE = 40.0
WINDOW_PX = 64
HOT_SPOT = 0.15
"""Brightening toward the point opposite the sun, and its width in image widths."""
HOT_SPOT_WIDTH = 0.3
HAZE = 0.10
"""Haze at one edge of the image, in units of the mean signal; none at the other."""
EXPOSURE = 0.12
"""Standard deviation of the logarithm of the exposure."""
COLOUR = {"red": 0.9, "green": 1.0, "blue": 0.7, "nir": 1.3}


@dataclass(frozen=True)
class OrthoFlight:
    """A mission of ideal images with planted light, and the world it was flown in."""

    folder: Path
    mission: Path
    world: World
    scene: Scene
    flight: SimulatedFlight


def fly(
    folder: Path,
    *,
    rig: str = "ultracam-l-mini",
    exposures: int = 4,
    lines: int = 2,
    seed: int = 5,
    width_px: int | None = None,
    light: bool = True,
    colour: bool = True,
) -> OrthoFlight:
    """Render the images of a block and write them as a mission with Level-2.

    Args:
        width_px: sensors as wide, to make the image smaller; None: as the rig has them.
        light: whether hot spot, haze and exposure change.
        colour: whether there is colour, made of PAN with a light of its own.
    """
    folder.mkdir(parents=True, exist_ok=True)
    text = shipped_rigs()[rig].read_text()
    if width_px is not None:
        text = text.replace("width_px = 2364", f"width_px = {width_px}")
    file = folder / "rig.toml"
    file.write_text(text)
    world = World(
        WorldSettings(
            rig_file=str(file), seed=seed, epoch_gps_ns=EPOCH_GPS_NS, exposures=exposures,
            height_m=1500.0, ground="land",
        )
    )  # fmt: skip
    first = EPOCH_GPS_NS + FIRST_AFTER_S * 1_000_000_000
    flight = world.flight.beginning_first_line_at(world.flight.distance_flown_m(first))
    marks = marks_of_lines(world, flight, first, exposures, lines)
    write_trajectory(folder / "trajectory.csv", flight, marks, seed=seed)
    scene = open_scene(world.scene_settings, folder / "scenes")
    mission, random = folder / "mission", np.random.default_rng(seed)
    sensors = [s.name for cone in world.rig.pan_cones for s in cone.sensors]
    scale = 0.0
    for number, mark in enumerate(marks, 1):
        radiance = render_ideal(world, scene, flight, mark)
        scale = scale or LEVEL / float(radiance.mean())
        level2, level0 = (mission / f"{level}/{number:06d}" for level in ("L2", "L0"))
        level2.mkdir(parents=True)
        level0.mkdir(parents=True)
        heading = 0.0 if (number - 1) // exposures % 2 == 0 else np.pi
        signal = radiance * scale
        if light:
            signal = lit(signal, heading, float(np.exp(random.normal(0.0, EXPOSURE))))
        pan = _words(signal + random.normal(0.0, NOISE, signal.shape))
        _write(level2 / "pan.tif", [pan], ["pan"])
        if colour:
            _write(level2 / "rgbn.tif", _colour(signal, world, random), list(COLOUR))
        record = {
            "number": number,
            "simulated": True,
            "mark_gps_ns": str(mark),
            "mark_source": "event-mark",
            "line_id": f"line {(number - 1) // exposures + 1}",
            "frames": [{"sensor": name, "mid_exposure_gps_ns": str(mark)} for name in sensors],
        }
        (level0 / "exposure.json").write_text(json.dumps(record))
    (mission / "rig.toml").write_text(text)
    (mission / "service.toml").write_text(
        f"[plan]\nground_height_m = {world.plan.ground_height_m}\n"
    )
    return OrthoFlight(folder, mission, world, scene, flight)


def lit(signal: Array, heading_rad: float, exposure: float) -> Array:
    """A picture under a sun in the south, through haze that thickens to the east."""
    height, width = signal.shape
    x = np.linspace(-0.5, 0.5, width, dtype=np.float32)[None, :]
    y = np.linspace(-0.5, 0.5, height, dtype=np.float32)[:, None] * (height / width)
    turn = np.cos(heading_rad)
    spot = np.exp(-((x**2 + (y - 0.15 * turn) ** 2) / (2.0 * (HOT_SPOT_WIDTH / 2.0) ** 2)))
    haze = HAZE * float(signal.mean()) * (0.5 + turn * x)
    return np.asarray(exposure * (signal * (1.0 + HOT_SPOT * spot) + haze))


def _words(signal: Array) -> NDArray[np.uint16]:
    return np.ascontiguousarray(np.clip(signal, 2, 65534).astype(np.uint16) & 0xFFFE)


def _colour(signal: Array, world: World, random: np.random.Generator) -> list[Array]:
    ratio = int(world.image.colour_ratio)
    height, width = (n // ratio for n in signal.shape)
    cut = signal[: height * ratio, : width * ratio]
    means = cut.reshape(height, ratio, width, ratio).mean(axis=(1, 3))
    gains = [g * float(np.exp(random.normal(0.0, 0.03))) for g in COLOUR.values()]
    return [_words(means * gain) for gain in gains]


def _write(path: Path, planes: list[Array], bands: list[str]) -> None:
    parts = tiff_parts(planes, {"bands": bands, "simulated": True})
    path.write_bytes(b"".join(bytes(p) for p in parts))


class GroundTruth:
    """The emulated ground in the coordinate system of an orthomosaic."""

    def __init__(self, flown: OrthoFlight, crs: str) -> None:
        plan = flown.flight.plan
        self._flown, self._georeference = flown, Georeference(crs)
        self._frame = LocalFrame(plan.latitude_deg, plan.longitude_deg)
        self._origin_m = plan.ground_height_m

    def enu(self, east_m: Array, north_m: Array) -> tuple[Array, Array]:
        """Points on the terrain at places of the grid, in the emulator's axes, and their heights.

        Returns:
            (n, 3) east, north, up and (n,) heights in the system of the grid.
        """
        height = np.full(east_m.shape, float(self._origin_m))
        for _ in range(4):
            geodetic = self._georeference.geodetic(np.stack([east_m, north_m, height], axis=-1))
            local = self._frame.from_geodetic(*geodetic.T)
            local[:, 2] -= self._origin_m
            height += self._flown.world.terrain.height_m(local[:, 0], local[:, 1]) - local[:, 2]
        return local, height

    def orthoimage(self, report: Mapping[str, Any], window: tuple[int, int, int, int]) -> Array:
        """The ideal orthoimage of a part (column, row, width, height) of a grid, radiances."""
        column, row, width, height = window
        gsd = report["gsd_m"]
        c = column + np.arange(-(-width // GRID_PX) + 1) * GRID_PX
        r = row + np.arange(-(-height // GRID_PX) + 1) * GRID_PX
        east = report["first_pixel_m"][0] + c * gsd
        north = report["first_pixel_m"][1] - r * gsd
        e, n = np.meshgrid(east, north)
        local, _ = self.enu(e.ravel(), n.ravel())
        at = scene_positions(
            self._flown.world, self._flown.scene, self._flown.flight,
            local.reshape(*e.shape, 3),
        )  # fmt: skip
        return sample_scene(self._flown.scene, "pan", at, (height, width))

    def write_height_model(self, path: Path, step_m: float = 10.0) -> None:
        """The true heights over the whole scene, as an ESRI ASCII grid."""
        world = self._flown.world
        reach = 0.75 * max(world.scene_settings.height_px, world.scene_settings.width_px)
        reach = reach * world.plan.gsd_m + world.flight.plan.line_spacing_m * 3.0
        at = self._georeference.place(
            self._flown.flight.plan.latitude_deg, self._flown.flight.plan.longitude_deg, 0.0
        )
        first = self._flown.flight.first_line_at_m
        centre = np.array([at.east_m, at.north_m + first + reach / 2.0])
        low = np.floor((centre - 1.5 * reach) / step_m) * step_m
        n = int(3.0 * reach / step_m)
        e, north = np.meshgrid(low[0] + np.arange(n) * step_m, low[1] + np.arange(n) * step_m)
        _, height = self.enu(e.ravel(), north.ravel())
        rows = height.reshape(n, n)[::-1]
        head = (
            f"ncols {n}\nnrows {n}\nxllcenter {low[0]}\nyllcenter {low[1]}\ncellsize {step_m}\n"
            "NODATA_value -9999\n"
        )
        path.write_text(head + "\n".join(" ".join(f"{v:.4f}" for v in r) for r in rows) + "\n")


def shift_between(a: Array, b: Array, mask: Array) -> Array | None:
    """Shift (columns, rows) px that brings b onto a by least squares, with gain and offset.

    None where the window holds too little to say.
    """
    y, x = (np.gradient(b, axis=k) for k in (0, 1))
    inner = mask.copy()
    inner[[0, -1]] = False
    inner[:, [0, -1]] = False
    if inner.sum() < 200:
        return None
    design = np.stack([x[inner], y[inner], b[inner], np.ones(inner.sum())], axis=1)
    normal = design.T @ design
    if np.linalg.cond(normal) > 1e16:
        return None
    found = np.linalg.solve(normal, design.T @ a[inner])
    residual = a[inner] - design @ found
    shift = found[:2] / found[2]
    sigma = np.sqrt(np.mean(residual**2) * np.diag(np.linalg.inv(normal))[:2]) / abs(found[2])
    return shift if sigma.max() < 0.05 and abs(found[2]) > 0 else None


def displacements(
    pixels: Array, owner: Array, truth: GroundTruth, report: Mapping[str, Any]
) -> dict[str, Any]:
    """Displacement of windows against the ideal orthoimage, and across seams, px.

    Args:
        pixels: the orthomosaic, PAN.
        owner: image of each pixel, -1: none.
    """
    whole, across = [], []
    size = WINDOW_PX
    for row in range(0, pixels.shape[0] - size, size):
        for column in range(0, pixels.shape[1] - size, size):
            part = np.s_[row : row + size, column : column + size]
            a, who = pixels[part].astype(np.float64), owner[part]
            if (a == 0).any():
                continue
            names = np.unique(who)
            b = truth.orthoimage(report, (column, row, size, size)).astype(np.float64)
            shifts = [shift_between(a, b * LEVEL, who == k) for k in names]
            if len(names) == 1 and shifts[0] is not None:
                whole.append(shifts[0])
            elif len(names) == 2 and shifts[0] is not None and shifts[1] is not None:
                across.append(shifts[0] - shifts[1])
    return {
        "windows": len(whole),
        "rms_px": _rms(whole),
        "common_shift_px": [float(v) for v in np.mean(whole, axis=0)] if whole else None,
        "rms_px_without_common_shift": _rms(list(np.array(whole) - np.mean(whole, axis=0))),
        "worst_px": float(np.hypot(*np.array(whole).T).max()) if whole else None,
        "seam_windows": len(across),
        "seam_rms_px": _rms(across),
    }


def _rms(vectors: list[Array]) -> float | None:
    return float(np.sqrt(np.mean(np.sum(np.square(vectors), axis=1)))) if vectors else None


def owners(folder: Path, report: Mapping[str, Any]) -> Array:
    """Image of each pixel, from the areas of `seams.gpkg`, read without the program's code."""
    import sqlite3
    import struct

    from rasterio.features import rasterize
    from rasterio.transform import Affine

    gsd, (east, north) = report["gsd_m"], report["first_pixel_m"]
    place = Affine(gsd, 0.0, east - gsd / 2, 0.0, -gsd, north + gsd / 2)
    shapes = []
    with sqlite3.connect(folder / "seams.gpkg") as connection:
        rows = connection.execute("SELECT geom, exposure FROM seam_areas").fetchall()
    for blob, exposure in rows:
        at = 8 + 5
        (count,) = struct.unpack_from("<I", blob, at)
        at += 4
        polygons = []
        for _ in range(count):
            (rings,) = struct.unpack_from("<I", blob, at + 5)
            at += 9
            polygon = []
            for _ in range(rings):
                (points,) = struct.unpack_from("<I", blob, at)
                ring = np.frombuffer(blob, "<f8", 2 * points, at + 4).reshape(-1, 2)
                polygon.append(ring.tolist())
                at += 4 + 16 * points
            polygons.append(polygon)
        shapes.append(({"type": "MultiPolygon", "coordinates": polygons}, exposure))
    size = (report["height_px"], report["width_px"])
    return np.asarray(rasterize(shapes, size, fill=-1, transform=place, dtype="int32"))


def command(*arguments: str) -> dict[str, Any]:
    """Run a command of ours and return what it prints with --json."""
    done = CliRunner().invoke(app, [*arguments, "--json"])
    if done.exit_code != 0:
        raise RuntimeError(f"{arguments[0]}: {done.output} {done.exception}")
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def evaluate(flown: OrthoFlight) -> dict[str, Any]:
    """Triangulate, compute both orthomosaics, and hold them against the truth."""
    import rasterio

    folder, mission = flown.folder, str(flown.mission)
    trajectory = ["--trajectory", str(flown.folder / "trajectory.csv")]
    block = command("triangulate", mission, *trajectory)
    crs = block["triangulation"]["crs"]
    truth = GroundTruth(flown, crs)
    model = folder / "dtm.asc"
    truth.write_height_model(model)
    cases = {
        "height model": ["--elevation", str(model)],
        "plane": [],
        "height model, not levelled": ["--elevation", str(model), "--no-level"],
    }
    figures: dict[str, Any] = {}
    for name, options in cases.items():
        out = folder / name.replace(" ", "-").replace(",", "")
        begun = time.perf_counter()
        report = command("orthomosaic", mission, *options, "--out", str(out))
        seconds = time.perf_counter() - begun
        with rasterio.open(out / "pan-16.tif") as raster:
            pixels = raster.read(1)
        figures[name] = displacements(pixels, owners(out, report), truth, report) | {
            "seam_step_before": report["seams"]["step_rms_before"],
            "seam_step_after": report["seams"]["step_rms_after"],
            "relief": report.get("relief"),
            "pixels": report["pixels_with_data"],
            "gsd_m": report["gsd_m"],
            "images": report["images"],
            "seconds": seconds,
        }
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.orthomosaic", description=__doc__)
    parser.add_argument("--rig", default="ultracam-l-mini")
    parser.add_argument("--exposures", type=int, default=6, help="of each line")
    parser.add_argument("--lines", type=int, default=3)
    parser.add_argument("--width-px", type=int, default=None, help="of a sensor, for less work")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--folder", type=Path, default=None, help="where results are kept")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="syntopic-bench-") as temporary:
        flown = fly(
            options.folder or Path(temporary), rig=options.rig, exposures=options.exposures,
            lines=options.lines, seed=options.seed, width_px=options.width_px,
        )  # fmt: skip
        figures = evaluate(flown)
    if options.json:
        print(json.dumps({"machine": machine(), "rig": options.rig, "cases": figures}))
        return
    for name, f in figures.items():
        print(
            f"{name}: {f['rms_px']:.3f} px RMS in {f['windows']} windows, "
            f"{f['rms_px_without_common_shift']:.3f} without the shift of the whole block, worst "
            f"{f['worst_px']:.3f}; across seams {f['seam_rms_px']:.3f} px in {f['seam_windows']}; "
            f"steps of PAN at seams {f['seam_step_before']['pan']:.2%} before, "
            f"{f['seam_step_after']['pan']:.2%} after levelling; {f['pixels'] / 1e6:.1f} million "
            f"pixels of {f['gsd_m']:.3f} m from {f['images']} images in {f['seconds']:.1f} s"
        )


if __name__ == "__main__":
    main()

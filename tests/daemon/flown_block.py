"""A mission of rendered images with the navigation of each exposure in its record, and the truth.

Images are those of the ideal camera with shot noise, over true terrain; navigation errs by drawn
errors of the stated size, the mounting by one drawn error of its calibration.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.mission.store.level0 import tiff_parts
from processing.rig import shipped_rigs
from sim_hw.processes.exposures import EPOCH_GPS_NS, FIRST_AFTER_S
from sim_hw.world import true_camera
from sim_hw.world.flight import SimulatedFlight
from sim_hw.world.post_processed_trajectory import COLUMNS, marks_of_lines
from sim_hw.world.rendering import render_ideal
from sim_hw.world.scene import open_scene
from sim_hw.world.world import World, WorldSettings

Array = NDArray[np.float64]

POSITION_M = np.array([0.05, 0.05, 0.08])
ATTITUDE_DEG = np.array([0.005, 0.005, 0.008])
BORESIGHT_DEG = 0.0057
AROUND, STEP_NS = 20, 10_000_000
MARGIN_PX = 20
"""Points nearer to the edge of an image are not measured in it."""


@dataclass(frozen=True)
class FlownBlock:
    """The mission's folder; geodetic places (n, 3) and ENU rotations (n, 3, 3) of the camera."""

    mission: Path
    world: World
    flight: SimulatedFlight
    marks: list[int]
    place: Array
    enu_from_camera: Array


def flown_block(
    folder: Path, each: int, lines: int, *, seed: int = 5, rig: str = "ultracam-l-mini"
) -> FlownBlock:
    """Render lines flown there and back; half the width of `ultracam-l-mini`, other rigs whole."""
    text = shipped_rigs()[rig].read_text()
    file = folder / "rig.toml"
    file.write_text(text.replace("width_px = 2364", "width_px = 1182"))
    world = World(
        WorldSettings(
            rig_file=str(file), seed=seed, epoch_gps_ns=EPOCH_GPS_NS, exposures=each,
            height_m=1500.0,
        )
    )  # fmt: skip
    first = EPOCH_GPS_NS + FIRST_AFTER_S * 1_000_000_000
    flight = world.flight.beginning_first_line_at(world.flight.distance_flown_m(first))
    marks = marks_of_lines(world, flight, first, each, lines)
    names = [f"line {k // each + 1}" for k in range(each * lines)]
    return write_flown(folder, world, flight, marks, names)


def write_flown(
    folder: Path, world: World, flight: SimulatedFlight, marks: list[int], lines: list[str]
) -> FlownBlock:
    """Render an exposure at each mark, and write the mission below the folder.

    Args:
        lines: name of the line of each exposure.
    """
    seed = world.settings.seed
    scene = open_scene(world.scene_settings, folder / "scenes")
    mission, noise = folder / "mission", np.random.default_rng(seed)
    boresight_deg = noise.normal(0.0, BORESIGHT_DEG, 3)
    place, rotation = [], []
    for number, (mark, line) in enumerate(zip(marks, lines, strict=True), 1):
        light = render_ideal(world, scene, flight, mark)
        pixels = np.clip(light / light.mean() * 8000.0, 2, 60000)
        pixels = (pixels + noise.normal(0.0, 40.0, pixels.shape)).clip(2, 65534).astype(np.uint16)
        write_image(mission, number, pixels & 0xFFFE)
        pose = flight.pose(mark)
        place.append(flight.geodetic(true_camera.image_centre_m(world.rig, pose)))
        rotation.append(pose.enu_from_body @ true_camera.BODY_FROM_CAMERA)
        record = _record(world, flight, number, mark, line)
        _add_errors(record["navigation"], noise, boresight_deg)
        write_record(mission, record)
    (mission / "rig.toml").write_text(Path(world.settings.rig_file).read_text())
    plan = f"[plan]\nground_height_m = {world.plan.ground_height_m}\n"
    (mission / "service.toml").write_text(plan)
    return FlownBlock(mission, world, flight, marks, np.array(place), np.array(rotation))


def write_navigation(flown: FlownBlock) -> Path:
    """The navigation of the records as a trajectory, with the same errors; its file."""
    path = flown.mission.parent / "trajectory.csv"
    keys = ("latitude_deg", "longitude_deg", "height_m", "roll_rad", "pitch_rad", "heading_rad")
    rows = []
    for number, mark in enumerate(flown.marks, 1):
        navigation = read_record(flown.mission, number)["navigation"]
        recorded = np.array([navigation[key] for key in keys])
        error = recorded - _navigation(flown, mark)
        for step in range(-AROUND, AROUND + 1):
            instant = mark + step * STEP_NS
            values = _navigation(flown, instant) + error
            values[3:] = np.degrees(values[3:])
            rows.append(",".join([str(instant), *(repr(float(v)) for v in values)]))
    path.write_text("\n".join([",".join(COLUMNS), *rows]) + "\n")
    return path


def _navigation(flown: FlownBlock, gps_ns: int) -> Array:
    """True latitude, longitude, height, roll, pitch and heading (deg, m, rad), (6,)."""
    pose = flown.flight.pose(gps_ns)
    return np.array([*flown.flight.geodetic(pose.position_enu_m), *flown.flight.attitude_rad(pose)])


@dataclass(frozen=True)
class GroundPoints:
    """Points on the true terrain (p, 3) in the emulator's axes; where exposures (m,) show points
    (m,), px (m, 2), with noise."""

    enu_m: Array
    exposure: NDArray[np.int64]
    point: NDArray[np.int64]
    px: Array


def ground_points(
    flown: FlownBlock, count: int, seed: int, *, sigma_px: float = 0.1, rays: int = 3
) -> GroundPoints:
    """Draw points that at least `rays` images show, and measure them."""
    random = np.random.default_rng(seed)
    world, image = flown.world, flown.world.image
    poses = [flown.flight.pose(mark) for mark in flown.marks]
    middle = np.array([pose.position_enu_m[:2] for pose in poses])
    size = np.array([image.width_px, image.height_px])
    half = 0.4 * size * world.plan.gsd_m
    low, high = middle.min(axis=0) - half, middle.max(axis=0) + half
    enu: list[Array] = []
    seen: list[tuple[int, int, Array]] = []
    while len(enu) < count:
        xy = random.uniform(low, high)
        ground = np.array([*xy, float(world.terrain.height_m(xy[0], xy[1]))])
        own = []
        for k, pose in enumerate(poses, 1):
            at = np.array(true_camera.ideal_pixels(ground, world.rig, pose), dtype=float)
            if ((at > MARGIN_PX) & (at < size - 1 - MARGIN_PX)).all():
                own.append((k, len(enu), at + random.normal(0.0, sigma_px, 2)))
        if len(own) >= rays:
            seen += own
            enu.append(ground)
    return GroundPoints(
        np.array(enu),
        np.array([k for k, _, _ in seen]),
        np.array([p for _, p, _ in seen]),
        np.array([at for _, _, at in seen]),
    )


def write_points(folder: Path, flown: FlownBlock, points: GroundPoints) -> tuple[Path, Path]:
    """Write the tables of points and of their image coordinates."""
    surveyed, measured = folder / "points.csv", folder / "measured.csv"
    places = [flown.flight.geodetic(one) for one in points.enu_m]
    rows = [
        f"P{k:03d},{'control' if k % 2 else 'check'},{a:.10f},{b:.10f},{c:.4f}"
        for k, (a, b, c) in enumerate(places)
    ]
    surveyed.write_text("\n".join(["point,role,latitude_deg,longitude_deg,height_m", *rows]))
    rows = [
        f"{k:06d},P{p:03d},{at[0]:.3f},{at[1]:.3f},0.1"
        for k, p, at in zip(points.exposure, points.point, points.px, strict=True)
    ]
    measured.write_text("\n".join(["image,point,column_px,row_px,sigma_px", *rows]))
    return surveyed, measured


def write_image(mission: Path, number: int, pixels: NDArray[np.uint16]) -> None:
    """Write a stitched image."""
    (mission / f"L2/{number:06d}").mkdir(parents=True, exist_ok=True)
    parts = tiff_parts([np.ascontiguousarray(pixels)], {"bands": ["pan"]})
    (mission / f"L2/{number:06d}/pan.tif").write_bytes(b"".join(bytes(p) for p in parts))


def read_record(mission: Path, number: int) -> dict[str, Any]:
    """The record of an exposure."""
    record: dict[str, Any] = json.loads((mission / f"L0/{number:06d}/exposure.json").read_text())
    return record


def write_record(mission: Path, record: dict[str, Any]) -> None:
    """Write the record of an exposure."""
    folder = mission / f"L0/{record['number']:06d}"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "exposure.json").write_text(json.dumps(record))


def _record(
    world: World, flight: SimulatedFlight, number: int, mark: int, line: str
) -> dict[str, Any]:
    pose, later = flight.pose(mark), flight.pose(mark + 10_000_000)
    latitude, longitude, height = (float(v) for v in flight.geodetic(pose.position_enu_m))
    roll, pitch, heading = (float(v) for v in flight.attitude_rad(pose))
    east, north, up = (np.array(later.position_enu_m) - np.array(pose.position_enu_m)) / 0.01
    sensors = [s for cone in world.rig.pan_cones for s in cone.sensors]
    return {
        "number": number,
        "simulated": True,
        "mark_gps_ns": str(mark),
        "mark_source": "event-mark",
        "line_id": line,
        "frames": [{"sensor": s.name, "mid_exposure_gps_ns": str(mark)} for s in sensors],
        "navigation": {
            "gps_ns": str(mark),
            "latitude_deg": latitude,
            "longitude_deg": longitude,
            "height_m": height,
            "velocity_ned_mps": [float(north), float(east), float(-up)],
            "roll_rad": roll,
            "pitch_rad": pitch,
            "heading_rad": heading,
            "horizontal_sigma_m": float(POSITION_M[0]),
            "vertical_sigma_m": float(POSITION_M[2]),
        },
    }


def _add_errors(
    navigation: dict[str, Any], noise: np.random.Generator, boresight_deg: Array
) -> None:
    east, north, up = noise.normal(0.0, POSITION_M)
    metres = 6_371_000.0 * math.radians(1.0)
    navigation["latitude_deg"] += north / metres
    navigation["longitude_deg"] += (
        east / metres / math.cos(math.radians(navigation["latitude_deg"]))
    )
    navigation["height_m"] += up
    errors = np.radians(noise.normal(0.0, ATTITUDE_DEG) + boresight_deg)
    for key, error in zip(("roll_rad", "pitch_rad", "heading_rad"), errors, strict=True):
        navigation[key] += float(error)

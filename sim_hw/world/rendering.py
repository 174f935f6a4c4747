"""Irradiance of a sensor: rays through the true camera onto the ground, and its radiance.

The mapping is computed exactly on a coarse grid and interpolated; the scene is a spline, read
with six by six taps at unrounded positions. The conversion to counts is in `electronics`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from processing.rig import Cone, Sensor
from sim_hw.world import spline, traffic, true_camera
from sim_hw.world.cloud import Cloud
from sim_hw.world.flight import Pose, SimulatedFlight
from sim_hw.world.scene import COLOURS, Scene
from sim_hw.world.world import END_MARGIN, World

Array = NDArray[np.float64]
Map = NDArray[np.float32]

GRID_PX = 8
"""Spacing of the exact mapping; between its points it is interpolated, to below 1e-3 px."""
PHASES = spline.PHASES
UNIT = np.float32(spline.STORED_UNIT)
ZERO = np.float32(spline.STORED_ZERO)
SMEAR_STEPS = 33


@dataclass(frozen=True)
class ExposureParameters:
    """One exposure of one sensor: its mid-exposure in GPS time and how long it looks."""

    mid_gps_ns: int
    exposure_time_us: float
    tdi_shifts: int


def sensor_directions(
    world: World, cone: Cone, sensor: Sensor, columns: Array, rows: Array, gps_ns: int
) -> Array:
    """Directions in master camera axes at the temperatures of an instant, shape (..., 3)."""
    return world.camera.directions(
        cone,
        sensor,
        columns,
        rows,
        sensor_c=world.temperature_c(sensor.probe, gps_ns),
        cone_c=world.temperature_c(cone.probe, gps_ns),
    )


def content_rows(sensor: Sensor, rows: Array, tdi_shifts: int) -> Array:
    """Where on the array the image content of raw rows is at mid-exposure."""
    return rows - sensor.tdi_row_sign * tdi_shifts / 2


def ground_points(
    world: World,
    cone: Cone,
    sensor: Sensor,
    columns: Array,
    rows: Array,
    parameters: ExposureParameters,
    pose: Pose,
) -> Array:
    """Ground points that raw pixels see at mid-exposure, east, north, up, shape (..., 3)."""
    at = content_rows(sensor, rows, parameters.tdi_shifts)
    directions = sensor_directions(world, cone, sensor, columns, at, parameters.mid_gps_ns)
    rays = true_camera.world_directions(directions, pose)
    return world.terrain.intersect(true_camera.projection_centre_m(cone, pose), rays)


def scene_positions(world: World, scene: Scene, flight: SimulatedFlight, ground_m: Array) -> Array:
    """Columns and rows in the scene of ground points, shape (..., 2).

    The scene lies where the first line begins: its first image is centred END_MARGIN, half an
    image and the margin of the world above the lower edge.
    """
    line = math.radians(flight.plan.heading_deg)
    east, north = ground_m[..., 0], ground_m[..., 1]
    right = east * math.cos(line) - north * math.sin(line)
    along = east * math.sin(line) + north * math.cos(line) - flight.first_line_at_m
    height, width = scene.bands["pan"].shape
    sample = scene.settings.sample_m
    first = height - world.image.height_px * (0.5 + END_MARGIN) - world.scene_margin_px
    return np.stack([(width - 1) / 2 + right / sample, first - along / sample], axis=-1)


def grid_axis(length_px: int, spacing_px: int) -> Array:
    """Pixel positions from the first to the last in steps; the last step may be shorter."""
    axis = np.arange(0, length_px - 1, spacing_px, dtype=np.float64)
    return np.append(axis, float(length_px - 1))


def light_on_sensor(
    world: World,
    scene: Scene,
    flight: SimulatedFlight,
    cone: Cone,
    sensor: Sensor,
    parameters: ExposureParameters,
) -> Map:
    """Radiance on the pixels of a raw frame, shape (height, width), forward motion included.

    Behind a colour filter array each pixel has the light of its own filter's band.
    """
    # The grid reaches past the last pixel, so that every cell of it is a full one.
    columns = np.arange(-(-sensor.width_px // GRID_PX) + 1, dtype=np.float64) * GRID_PX
    rows = np.arange(-(-sensor.height_px // GRID_PX) + 1, dtype=np.float64) * GRID_PX
    c, r = np.meshgrid(columns, rows)
    pose = flight.pose(parameters.mid_gps_ns)
    ground = ground_points(world, cone, sensor, c, r, parameters, pose)
    positions = scene_positions(world, scene, flight, ground)
    size = (sensor.height_px, sensor.width_px)
    smear = residual_smear_px(world, flight, cone, sensor, parameters)
    if world.cars:
        t_s = (parameters.mid_gps_ns - world.settings.epoch_gps_ns) * 1e-9
        t_s -= flight.first_line_at_m / flight.plan.ground_speed_mps
        bands = [band for band, _ in _mix_of(cone, scene)]
        scene = traffic.scene_with(world.cars, scene, t_s, bands)
    if sensor.colour_filter_array != "none":
        total = _through_filters(scene, sensor, positions, smear)
    else:
        total = smeared(_mixed(cone, scene, positions, size), smear)
    if world.cloud is not None:
        _overlay_cloud(total, world, world.cloud, flight, cone, sensor, (c, r), parameters)
    return np.asarray(total * np.float32(world.ground.light), dtype=np.float32)


def _mixed(cone: Cone, scene: Scene, positions: Array, size: tuple[int, int]) -> Map:
    total: Map | None = None
    for band, share in _mix_of(cone, scene):
        light = sample_scene(scene, band, positions, size)
        total = light * np.float32(share) if total is None else total + light * np.float32(share)
    if total is None:
        raise ValueError(f"cone {cone.name} has no band that the scene knows")
    return total


def _overlay_cloud(
    light: Map,
    world: World,
    cloud: Cloud,
    flight: SimulatedFlight,
    cone: Cone,
    sensor: Sensor,
    grid: tuple[Array, Array],
    parameters: ExposureParameters,
) -> None:
    """Put a cloud before the ground, seen from where the cone is at mid-exposure."""
    columns, rows = grid
    pose = flight.pose(parameters.mid_gps_ns)
    at = content_rows(sensor, rows, parameters.tdi_shifts)
    directions = sensor_directions(world, cone, sensor, columns, at, parameters.mid_gps_ns)
    places = cloud.positions(
        true_camera.projection_centre_m(cone, pose),
        true_camera.world_directions(directions, pose),
        heading=math.radians(flight.plan.heading_deg),
        along_m=flight.first_line_at_m,
    )
    x, y = (np.ascontiguousarray(places[..., i]) for i in (0, 1))
    opacity, white = np.empty_like(light), np.empty_like(light)
    rows, columns = (2 * n - 2 for n in cloud.opacity.shape)
    _sample(cloud.opacity, x, y, (rows, columns), _TABLE, opacity)
    _sample(cloud.radiance, x, y, (rows, columns), _TABLE, white)
    np.clip(opacity, 0.0, 1.0, out=opacity)
    light += opacity * (white - light)


FILTERS = {"R": "red", "G": "green", "B": "blue"}


def filter_of(colour_filter_array: str, *, column: int, row: int) -> str:
    """The band that a pixel sees; the array's four letters are (0, 0), (1, 0), (0, 1), (1, 1)."""
    return FILTERS[colour_filter_array[2 * (row % 2) + column % 2]]


def _through_filters(
    scene: Scene, sensor: Sensor, positions: Array, smear_px: tuple[float, float]
) -> Map:
    mosaic = np.empty((sensor.height_px, sensor.width_px), dtype=np.float32)
    for band in FILTERS.values():
        light = smeared(sample_scene(scene, band, positions, mosaic.shape), smear_px)
        for row in (0, 1):
            for column in (0, 1):
                if filter_of(sensor.colour_filter_array, column=column, row=row) == band:
                    mosaic[row::2, column::2] = light[row::2, column::2]
    return mosaic


def _mix_of(cone: Cone, scene: Scene) -> Sequence[tuple[str, float]]:
    if cone.bands == ("pan",):
        return [("pan", 1.0)]
    known = [b for b in cone.bands if b in COLOURS and b in scene.bands]
    return [(band, 1 / len(known)) for band in known]


def residual_smear_px(
    world: World,
    flight: SimulatedFlight,
    cone: Cone,
    sensor: Sensor,
    parameters: ExposureParameters,
) -> tuple[float, float]:
    """How far the image moves over the pixels during an exposure, less what TDI follows.

    From the mapping at the beginning and the end: forward motion, crab and angular rates alike.

    Returns:
        (columns, rows) in pixels.
    """
    centre = (np.array([(sensor.width_px - 1) / 2]), np.array([(sensor.height_px - 1) / 2]))
    half_ns = round(parameters.exposure_time_us * 500)
    ground = []
    for offset_ns in (-half_ns, half_ns):
        gps_ns = parameters.mid_gps_ns + offset_ns
        pose = flight.pose(gps_ns)
        directions = sensor_directions(world, cone, sensor, *centre, parameters.mid_gps_ns)
        rays = true_camera.world_directions(directions, pose)
        ground.append(world.terrain.intersect(true_camera.projection_centre_m(cone, pose), rays)[0])
    pose = flight.pose(parameters.mid_gps_ns)
    moved = (ground[1] - ground[0]) @ (pose.enu_from_body @ true_camera.BODY_FROM_CAMERA)
    gsd = pose.position_enu_m[2] * sensor.pitch_um * 1e-3 / cone.lens.f_mm
    # The footprint moves forward by `moved`, so a ground point moves back over the pixels: down,
    # to higher rows, and the charge with it where the sign of TDI is that of the flight.
    follows = sensor.tdi_row_sign * parameters.tdi_shifts
    return float(-moved[0] / gsd), float(moved[1] / gsd - follows)


def smeared(light: Map, smear_px: tuple[float, float]) -> Map:
    """Average over a straight motion, (columns, rows) in pixels, centred."""
    columns, rows = smear_px
    if math.hypot(columns, rows) < 0.02:
        return light
    t = (np.arange(SMEAR_STEPS) + 0.5) / SMEAR_STEPS - 0.5
    reach_c, reach_r = (math.ceil(abs(v) / 2) + 2 for v in (columns, rows))
    x = np.arange(-reach_c, reach_c + 1)
    y = np.arange(-reach_r, reach_r + 1)
    wx = _keys(x[None, :] - (columns * t)[:, None])
    wy = _keys(y[None, :] - (rows * t)[:, None])
    kernel = np.einsum("ki,kj->ij", wy, wx) / SMEAR_STEPS
    return np.asarray(
        cv2.filter2D(light, cv2.CV_32F, kernel[::-1, ::-1], borderType=cv2.BORDER_REFLECT)
    )


def _keys(x: Array) -> Array:
    """Cubic convolution; reproduces parabolas, so a smear gets its true second moment."""
    a = np.abs(x)
    near = (1.5 * a - 2.5) * a * a + 1
    far = ((-0.5 * a + 2.5) * a - 4) * a + 2
    return np.asarray(np.where(a <= 1, near, np.where(a < 2, far, 0.0)))


def sample_scene(scene: Scene, band: str, grid: Array, size: tuple[int, int]) -> Map:
    """Radiances of one band on a grid of scene positions.

    Args:
        grid: scene columns and rows at every `GRID_PX`-th pixel, shape (rows, columns, 2).
        size: (height, width) of the picture.
    """
    out = np.empty(size, dtype=np.float32)
    step = scene.step(band)
    # All bands are mirrored where PAN ends; that may lie between two samples of a colour.
    rows, columns = (2 * (n - 1) // step for n in scene.bands["pan"].shape)
    _sample(
        scene.bands[band],
        np.ascontiguousarray(grid[..., 0] / step),
        np.ascontiguousarray(grid[..., 1] / step),
        (rows, columns),
        _TABLE,
        out,
    )
    return out


_TABLE = spline.weight_table()


@numba.njit(inline="always", fastmath=True)
def _mirrored(index: int, period: int) -> int:
    """Mirrored at 0 and at half the period."""
    index = index % period
    return period - index if 2 * index > period else index


@numba.njit(cache=True, nogil=True, fastmath=True)
def _sample(
    band: NDArray[np.uint16],
    grid_x: Array,
    grid_y: Array,
    periods: tuple[int, int],
    table: Map,
    out: Map,
) -> None:
    height, width = out.shape
    rows, columns = band.shape
    wx = np.empty(6, dtype=np.float32)
    wy = np.empty(6, dtype=np.float32)
    for i in range(height):
        gi = i // GRID_PX
        fi = (i - gi * GRID_PX) / GRID_PX
        for gj in range((width + GRID_PX - 1) // GRID_PX):
            x0 = grid_x[gi, gj] * (1 - fi) + grid_x[gi + 1, gj] * fi
            x1 = grid_x[gi, gj + 1] * (1 - fi) + grid_x[gi + 1, gj + 1] * fi
            y0 = grid_y[gi, gj] * (1 - fi) + grid_y[gi + 1, gj] * fi
            y1 = grid_y[gi, gj + 1] * (1 - fi) + grid_y[gi + 1, gj + 1] * fi
            first = gj * GRID_PX
            for j in range(first, min(first + GRID_PX, width)):
                fj = (j - first) / GRID_PX
                x = x0 + (x1 - x0) * fj
                y = y0 + (y1 - y0) * fj
                cx = math.floor(x)
                cy = math.floor(y)
                px = (x - cx) * PHASES
                py = (y - cy) * PHASES
                ix = min(int(px), PHASES - 1)
                iy = min(int(py), PHASES - 1)
                ax = np.float32(px - ix)
                ay = np.float32(py - iy)
                for k in range(6):
                    wx[k] = table[ix, k] + (table[ix + 1, k] - table[ix, k]) * ax
                    wy[k] = table[iy, k] + (table[iy + 1, k] - table[iy, k]) * ay
                total = np.float32(0.0)
                if 2 <= cx < columns - 3 and 2 <= cy < rows - 3:
                    for m in range(6):
                        line = np.float32(0.0)
                        for n in range(6):
                            line += wx[n] * np.float32(band[cy - 2 + m, cx - 2 + n])
                        total += wy[m] * line
                else:
                    for m in range(6):
                        line = np.float32(0.0)
                        row = _mirrored(cy - 2 + m, periods[0])
                        for n in range(6):
                            line += wx[n] * np.float32(band[row, _mirrored(cx - 2 + n, periods[1])])
                        total += wy[m] * line
                out[i, j] = max((total - ZERO) / UNIT, np.float32(0.0))


def render_ideal(
    world: World,
    scene: Scene,
    flight: SimulatedFlight,
    mid_gps_ns: int,
    *,
    columns: tuple[int, int] | None = None,
    rows: tuple[int, int] | None = None,
) -> Map:
    """The virtual image as the ideal master camera sees it: no noise, no distortion, no smear.

    Args:
        mid_gps_ns: mid-exposure of the master cone.
        columns, rows: the part wanted, first and one past the last; all of it by default.

    Returns:
        Radiances of the PAN band over the true terrain, shape (rows, columns).
    """
    image = world.image
    c0, c1 = columns or (0, image.width_px)
    r0, r1 = rows or (0, image.height_px)
    c = c0 + np.arange(-(-(c1 - c0) // GRID_PX) + 1, dtype=np.float64) * GRID_PX
    r = r0 + np.arange(-(-(r1 - r0) // GRID_PX) + 1, dtype=np.float64) * GRID_PX
    cc, rr = np.meshgrid(c, r)
    pitch = image.pitch_um * 1e-3
    seen = np.stack(
        [
            (cc - (image.width_px - 1) / 2) * pitch,
            ((image.height_px - 1) / 2 - rr) * pitch,
            np.full(cc.shape, -image.f_mm),
        ],
        axis=-1,
    )
    pose = flight.pose(mid_gps_ns)
    centre = true_camera.image_centre_m(world.rig, pose)
    ground = world.terrain.intersect(centre, true_camera.world_directions(seen, pose))
    positions = scene_positions(world, scene, flight, ground)
    return sample_scene(scene, "pan", positions, (r1 - r0, c1 - c0))

"""`python -m benchmarks.ultracam_l`: two PAN cones stitched with and without the colour master.

Repeats the experiment of Ladstädter et al. (2010) over an emulated line at full size and draws the
systematic residuals as its fig. 10 does. Nothing is rendered: tie points are where the emulator's
camera sees the same ground, plus noise of the size measured on rendered exposures.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from daemon.cli.benchmark.measurement import machine
from daemon.postflight.plots import field_of_vectors, svg_of
from processing.geometry.conditions import Conditions, for_sensors, parallax_px
from processing.geometry.placement import (
    SensorPlacement,
    nominal_placements,
    raw_from_vip_mm,
    vip_mm_from_raw,
    vip_px_from_mm,
)
from processing.geometry.topology import Rectangle, colour_coverage, overlaps
from processing.matching.tie_points import PAN_TO_COLOUR, PAN_TO_PAN, TiePoints
from processing.mosaic.fixed_mosaic import fixed_mosaic
from processing.mosaic.free_mosaic import Mosaic, MosaicSettings, free_mosaic
from processing.mosaic.pan_only import pan_only_mosaic
from processing.rig import Rig, VirtualImage, shipped_rigs
from sim_hw.world.flight import SimulatedFlight
from sim_hw.world.rendering import ExposureParameters, ground_points
from sim_hw.world.truth import true_vip
from sim_hw.world.world import World, WorldSettings

Array = NDArray[np.float64]
Placements = Mapping[str, SensorPlacement]

EPOCH_GPS_NS = 1_447_000_000_000_000_000
SIGMA_PP_PX = 0.018
SIGMA_PC_PX = 0.10
"""Of one coordinate of a difference: what the adjustment finds on rendered ultracam-l-mini."""
POINTS_PER_OVERLAP = 850
POINTS_PER_SENSOR = 1900
PROBE_SIGMA_C = 0.1
GRID = (11, 15)
"""Columns and rows of residuals on each half of the image."""
METHODS = {
    "experiment": "P/P only, 4 parameters, not pre-corrected",
    "pre-corrected": "P/P only, 4 parameters, pre-corrected",
    "fixed": "P/P only, 8 parameters, pre-corrected",
    "regular": "P/P and P/C, 8 parameters, pre-corrected",
}


@dataclass(frozen=True)
class Residuals:
    """One method over a line: errors (exposures, points, 2) px at `places` (points, 2) VIP px."""

    places: Array
    errors: Array


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ultracam_l", description=__doc__)
    parser.add_argument("--rig", default="ultracam-l")
    parser.add_argument("--exposures", type=int, default=40)
    parser.add_argument("--dc", type=float, default=12.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--rotation", type=float, default=None, help="turn cone 1 by this omega and phi, mrad"
    )
    parser.add_argument("--drawing", type=Path, default=None, help="where to draw fig. 10 (SVG)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="syntopic-bench-") as folder:
        rig_file = shipped_rigs()[options.rig]
        if options.rotation is not None:
            rig_file = _rotated(rig_file, options.rotation * 1e-3, Path(folder))
        world = World(
            WorldSettings(
                rig_file=str(rig_file),
                seed=options.seed,
                epoch_gps_ns=EPOCH_GPS_NS,
                dc_k=options.dc,
                exposures=options.exposures,
            )
        )
    found = fly(world, options.exposures, options.seed)
    pitch_um = world.image.pitch_um
    figures = {name: figures_of(world.image, r) for name, r in found.items()}
    if options.drawing is not None:
        panels = [
            (METHODS[n], systematic(world.image, found[n])) for n in ("experiment", "regular")
        ]
        options.drawing.write_text(
            drawn(world.image, panels, f"{world.rig.name}, {options.exposures} exposures") + "\n"
        )
    rotation = world.rig.pan_cones[1].rotation_rad
    result: dict[str, Any] = {
        "machine": machine(),
        "rig": world.rig.name,
        "exposures": options.exposures,
        "cone_1_rotation_mrad": [round(v * 1e3, 3) for v in rotation],
        "methods": figures,
    }
    if options.json:
        print(json.dumps(result))
        return
    rotated = " ".join(f"{v * 1e3:+.3f}" for v in rotation)
    print(f"{world.rig.name}, {options.exposures} exposures, cone 1 turned by {rotated} mrad")
    print(f"{'':46}inner RMS  worst px   systematic RMS  worst um")
    for name, f in figures.items():
        print(
            f"{METHODS[name]:46}{f['inner_rms_px']:9.4f}{f['inner_max_px']:10.3f}"
            f"{f['systematic_rms_px'] * pitch_um:17.3f}{f['systematic_max_px'] * pitch_um:10.3f}"
        )


def _rotated(rig_file: Path, angle_rad: float, folder: Path) -> Path:
    """The rig with the second PAN cone turned by omega = phi = angle, calibrated and true."""
    text = rig_file.read_text()
    head, found, tail = text.partition('name = "1"')
    tail = re.sub(
        r"rotation_rad = \[.*?\]", f"rotation_rad = [{angle_rad}, {angle_rad}, 0.0]", tail, count=1
    )
    path = folder / rig_file.name
    path.write_text(head + found + tail)
    return path


def fly(world: World, exposures: int, seed: int) -> dict[str, Residuals]:
    """All methods over one line, from the same tie points."""
    rig, plan = world.rig, world.plan
    flight = world.flight.beginning_first_line_at(0.0)
    period_ns = round(plan.distance_m / plan.ground_speed_mps * 1e9)
    settings = MosaicSettings(parallax_px=parallax_px(rig, _conditions(world, {}), 0.01))
    rng = np.random.default_rng(seed)
    errors: dict[str, list[Array]] = {name: [] for name in METHODS}
    raw = {name: _grid(world, rig, name) for name in _pan(rig)}
    places = np.empty((0, 2))
    for k in range(exposures):
        looks = _looks(world, EPOCH_GPS_NS + 20_000_000_000 + k * period_ns)
        probes = {
            p: world.temperature_c(p, looks[rig.cone(rig.master_cone).name].mid_gps_ns)
            + rng.normal(0, PROBE_SIGMA_C)
            for p in rig.probes
        }
        start = nominal_placements(rig, probes, for_sensors(rig, plan.tdi_shifts))
        points = tie_points(world, flight, looks, start, rng)
        mosaics = {
            "experiment": pan_only_mosaic(rig, start, points, settings=settings),
            "pre-corrected": pan_only_mosaic(
                rig, start, points, precorrected=True, settings=settings
            ),
            "fixed": fixed_mosaic(rig, start, points, settings=settings),
            "regular": free_mosaic(rig, start, points, settings=settings),
        }
        for name, mosaic in mosaics.items():
            put, errors_here = _errors(world, flight, looks, mosaic, raw)
            errors[name].append(errors_here)
            if name == "regular" and not len(places):
                places = put
    return {name: Residuals(places, np.array(each)) for name, each in errors.items()}


def _pan(rig: Rig) -> list[str]:
    return [sensor.name for cone in rig.pan_cones for sensor in cone.sensors]


def _conditions(world: World, probes: Mapping[str, float]) -> Conditions:
    plan = world.plan
    return Conditions(
        temperatures_c=dict(probes),
        exposure_time_s=for_sensors(
            world.rig, {name: t * 1e-6 for name, t in plan.exposure_time_us.items()}
        ),
        tdi_shifts=for_sensors(world.rig, plan.tdi_shifts),
        ground_speed_mps=plan.ground_speed_mps,
        height_above_ground_m=plan.height_above_ground_m,
    )


def _looks(world: World, reference_ns: int) -> dict[str, ExposureParameters]:
    """The exposure of every cone, each over the place of the reference cone."""
    rig, plan = world.rig, world.plan
    reference_mm = rig.cone(rig.reference_cone).position_mm[0]
    return {
        cone.name: ExposureParameters(
            reference_ns
            - round((cone.position_mm[0] - reference_mm) * 1e-3 / plan.ground_speed_mps * 1e9),
            plan.exposure_time_us[cone.name],
            plan.tdi_shifts[cone.name],
        )
        for cone in rig.cones
    }


def _grid(world: World, rig: Rig, name: str) -> Array:
    """Raw pixels of a sensor spread over its half of the virtual image."""
    image = world.image
    half = image.width_px * image.pitch_mm / 2.0
    tall = image.height_px * image.pitch_mm / 2.0
    left = rig.sensor(name).x_mm < 0.0
    x = np.linspace(-half if left else 0.0, 0.0 if left else half, GRID[0] + 1)
    y = np.linspace(-tall, tall, GRID[1] + 1)
    xy = np.stack(np.meshgrid((x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2), axis=-1).reshape(-1, 2)
    return raw_from_vip_mm(nominal_placements(rig, {}, {})[name], xy)


def tie_points(
    world: World,
    flight: SimulatedFlight,
    looks: Mapping[str, ExposureParameters],
    start: Placements,
    rng: np.random.Generator,
    *,
    per_overlap: int = POINTS_PER_OVERLAP,
    per_sensor: int = POINTS_PER_SENSOR,
) -> TiePoints:
    """Where two sensors truly see the same ground, relief and all, with the noise of matching.

    `per_overlap` P/P points in every overlap, `per_sensor` P/C points on every PAN sensor.
    """
    rig = world.rig
    names = tuple(sensor.name for sensor in rig.sensors)
    areas: list[tuple[str, str, Rectangle, int]] = [
        (o.sensor_a, o.sensor_b, o.rectangle, PAN_TO_PAN) for o in overlaps(rig)
    ]
    assert rig.colour_master_cone is not None and rig.virtual_image is not None
    green = rig.cone(rig.colour_master_cone).sensors[0].name
    areas += [(n, green, r, PAN_TO_COLOUR) for n, r in colour_coverage(rig).items()]
    rows = []
    for number, (a, b, area, kind) in enumerate(areas):
        count = per_overlap if kind == PAN_TO_PAN else per_sensor
        sigma = SIGMA_PP_PX if kind == PAN_TO_PAN else SIGMA_PC_PX
        xy = np.stack(
            [
                rng.uniform(area.x_min_mm, area.x_max_mm, count),
                rng.uniform(area.y_min_mm, area.y_max_mm, count),
            ],
            axis=1,
        )
        raw_a = raw_from_vip_mm(start[a], xy)
        raw_b = _same_ground(world, flight, looks, (a, raw_a), (b, raw_from_vip_mm(start[b], xy)))
        raw_a = raw_a + rng.normal(0.0, sigma, raw_a.shape)
        rows.append(
            np.column_stack(
                [
                    np.full(count, names.index(a)),
                    np.full(count, names.index(b)),
                    raw_a,
                    raw_b,
                    np.full(count, sigma),
                    np.full(count, kind),
                    np.full(count, number),
                ]
            )
        )
    table = np.concatenate(rows)
    return TiePoints(
        names=names,
        pairs=tuple((a, b) for a, b, _, _ in areas),
        attempted=tuple(len(block) for block in rows),
        sensor_a=table[:, 0].astype(np.int64),
        sensor_b=table[:, 1].astype(np.int64),
        raw_a=table[:, 2:4],
        raw_b=table[:, 4:6],
        sigma_px=table[:, 6],
        correlation=np.ones(len(table)),
        kind=table[:, 7].astype(np.int64),
        overlap=table[:, 8].astype(np.int64),
    )


def _same_ground(
    world: World,
    flight: SimulatedFlight,
    looks: Mapping[str, ExposureParameters],
    seen: tuple[str, Array],
    attempted: tuple[str, Array],
) -> Array:
    """Raw pixels of the sought sensor that see the ground of the first's; Newton's method."""
    target = _ground(world, flight, looks, *seen)
    name, raw = attempted[0], attempted[1].copy()
    for _ in range(4):
        here = _ground(world, flight, looks, name, raw)
        by_column = _ground(world, flight, looks, name, raw + np.array([1.0, 0.0])) - here
        by_row = _ground(world, flight, looks, name, raw + np.array([0.0, 1.0])) - here
        jacobian = np.stack([by_column, by_row], axis=2)
        raw += np.linalg.solve(jacobian, (target - here)[:, :, None])[:, :, 0]
    return raw


def _ground(
    world: World,
    flight: SimulatedFlight,
    looks: Mapping[str, ExposureParameters],
    name: str,
    raw: Array,
) -> Array:
    """East and north, m, of what raw pixels see."""
    cone = world.rig.cone_of(name)
    look = looks[cone.name]
    pose = flight.pose(look.mid_gps_ns)
    ground = ground_points(world, cone, world.rig.sensor(name), raw[:, 0], raw[:, 1], look, pose)
    return np.asarray(ground[:, :2])


def _errors(
    world: World,
    flight: SimulatedFlight,
    looks: Mapping[str, ExposureParameters],
    mosaic: Mosaic,
    raw: Mapping[str, Array],
) -> tuple[Array, Array]:
    """Places in VIP px and truth less place, (n, 2) each, of the grids of all PAN sensors."""
    rig = world.rig
    put, errors = [], []
    for name, at in raw.items():
        column, row = true_vip(
            world,
            flight,
            name,
            looks[rig.cone_of(name).name],
            columns=at[:, 0],
            rows=at[:, 1],
            master_mid_gps_ns=looks[rig.cone(rig.master_cone).name].mid_gps_ns,
        )
        px = vip_px_from_mm(world.image, vip_mm_from_raw(mosaic.placements[name], at))
        put.append(px)
        errors.append(np.stack([column, row], axis=1) - px)
    return np.concatenate(put), np.concatenate(errors)


def figures_of(image: VirtualImage, found: Residuals) -> dict[str, float]:
    """Inner errors of single exposures, and what bundle adjustment leaves of their mean."""
    inner = np.array([_after(_similarity(image, found.places), e) for e in found.errors])
    length = np.hypot(inner[..., 0], inner[..., 1])
    mean = np.hypot(*systematic(image, found)[1].T)
    return {
        "inner_rms_px": float(np.sqrt(np.mean(length**2))),
        "inner_max_px": float(length.max()),
        "systematic_rms_px": float(np.sqrt(np.mean(mean**2))),
        "systematic_max_px": float(mean.max()),
    }


def systematic(image: VirtualImage, found: Residuals) -> tuple[Array, Array]:
    """Mean residuals of a line as a bundle adjustment would leave them.

    Each image's orientation takes six parameters (shift, scale, rotation, two tilts), the block two
    of radial distortion; the mean over the exposures is taken in between.
    """
    each = [_after(_orientation(image, found.places), e) for e in found.errors]
    mean = np.mean(each, axis=0)
    both = np.concatenate([_orientation(image, found.places), _radial(image, found.places)], axis=0)
    return found.places, _after(both, mean)


def _after(design: Array, errors: Array) -> Array:
    """Errors (n, 2) less their best fit by a design (k, n, 2)."""
    flat = design.reshape(len(design), -1).T
    step, *_ = np.linalg.lstsq(flat, errors.ravel(), rcond=None)
    return np.asarray((errors.ravel() - flat @ step).reshape(-1, 2))


def _unit(image: VirtualImage, places: Array) -> tuple[Array, Array, float]:
    """Image coordinates over the half diagonal, row down, and f likewise."""
    half = np.hypot(image.width_px, image.height_px) / 2.0
    x = (places[:, 0] - (image.width_px - 1) / 2.0) / half
    y = (places[:, 1] - (image.height_px - 1) / 2.0) / half
    return x, y, image.f_mm / image.pitch_mm / float(half)


def _similarity(image: VirtualImage, places: Array) -> Array:
    x, y, _ = _unit(image, places)
    one, none = np.ones_like(x), np.zeros_like(x)
    return np.array(
        [np.stack(v, axis=1) for v in ((one, none), (none, one), (x, y), (-y, x))], np.float64
    )


def _orientation(image: VirtualImage, places: Array) -> Array:
    x, y, f = _unit(image, places)
    tilts = [np.stack([f + x * x / f, x * y / f], 1), np.stack([x * y / f, f + y * y / f], 1)]
    return np.concatenate([_similarity(image, places), np.array(tilts)])


def _radial(image: VirtualImage, places: Array) -> Array:
    x, y, _ = _unit(image, places)
    r2 = x * x + y * y
    return np.array([np.stack([x * r2**k, y * r2**k], axis=1) for k in (1, 2)])


def drawn(
    image: VirtualImage, panels: Sequence[tuple[str, tuple[Array, Array]]], title: str
) -> str:
    """Residual vectors side by side in one scale, as an SVG."""
    longest = max(float(np.hypot(*errors.T).max()) for _, (_, errors) in panels)
    half = (image.width_px / 2.0, image.height_px / 2.0)

    def draw(figure: Figure) -> None:
        whole = f"Remaining systematic image residuals: {title}"
        figure.suptitle(whole, weight="bold", x=0.01, ha="left")
        plots = figure.subplots(1, len(panels), squeeze=False)[0]
        for plot, (name, (places, errors)) in zip(plots, panels, strict=True):
            rms_um = float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))) * image.pitch_um
            # Rows count down, the plot's y up.
            up = (places + 0.5 - half) * [1.0, -1.0]
            unit = ("um", image.pitch_um)
            field_of_vectors(plot, up, errors * [1.0, -1.0], half, longest, unit)
            plot.set_title(f"{name}: RMS {rms_um:.3f} um", weight="normal")

    return svg_of(draw, (0.4 + 5.2 * len(panels), 1.4 + 5.0 * half[1] / half[0]))


if __name__ == "__main__":
    main()

"""Stitched exposures with their truth, rendered or drawn: samples to test statistics on.

A rendered trial goes from light to image through electronics and pipeline. A drawn one takes the
tie points from where the emulator's true camera sees the same ground and gives them the errors that
were measured on rendered trials, overlap by overlap: with their neighbours' and with their
blunders. The truth is the emulator's and shares no code with the pipeline; what calibration, drift
coefficients and probes are off by is drawn from the sigmas the rig file states.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks import rendered
from processing.geometry.conditions import Conditions, for_sensors, parallax_px
from processing.geometry.placement import (
    nominal_placements,
    raw_from_vip_mm,
    vip_mm_from_raw,
    vip_px_from_mm,
)
from processing.geometry.topology import colour_ratio
from processing.matching.tie_points import PAN_TO_COLOUR, PAN_TO_PAN, TiePoints
from processing.mosaic.free_mosaic import Mosaic, MosaicSettings, free_mosaic
from processing.mosaic.validity import Validity, evaluate_master, robust_datum
from processing.pipelines.stitched import Pipeline, PipelineSettings
from processing.rig import Rig
from sim_hw.world.flight import SimulatedFlight
from sim_hw.world.rendering import ExposureParameters, ground_points
from sim_hw.world.scene import Scene
from sim_hw.world.snapshots import RigElectronics, exposure_parameters_of, probe_readings
from sim_hw.world.true_camera import true_camera
from sim_hw.world.truth import true_vip
from sim_hw.world.world import World

Array = NDArray[np.float64]

RELIEF_FRACTION = PipelineSettings().relief_fraction
CHECK_GRID = (3, 3)
"""Columns and rows of check points on each sensor, from edge to edge."""


@dataclass(frozen=True)
class StitchedSample:
    """One stitched exposure and the flight it was taken on; `looks` by sensor.

    `rig` is the camera as calibrated, `world.rig` as it really is.
    """

    rig: Rig
    world: World
    flight: SimulatedFlight
    parameters_by_sensor: Mapping[str, ExposureParameters]
    probes_c: Mapping[str, float]
    tie_points: TiePoints
    equal: Mosaic
    mosaic: Mosaic
    validity: Validity


@dataclass(frozen=True)
class MatchingErrors:
    """What matching did on rendered trials, as columns of n points.

    `trial` numbers the exposures, `pair` indexes `pairs`; `raw_a` (n, 2) is where the point was,
    `sigma_px` predicted, `error_px` (n, 2) found minus true, both in PAN px.
    """

    pairs: tuple[tuple[str, str], ...]
    sample: NDArray[np.int64]
    pair: NDArray[np.int64]
    raw_a: Array
    sigma_px: Array
    error_px: Array

    def save(self, path: Path) -> None:
        np.savez_compressed(
            path,
            pairs=np.array(self.pairs),
            trial=self.sample.astype(np.uint8),
            pair=self.pair.astype(np.uint8),
            raw_a=np.rint(self.raw_a * 4.0).astype(np.uint16),
            sigma_px=self.sigma_px.astype(np.float16),
            error_px=self.error_px.astype(np.float16),
        )

    @staticmethod
    def load(path: Path) -> MatchingErrors:
        with np.load(path) as content:
            return MatchingErrors(
                pairs=tuple((str(a), str(b)) for a, b in content["pairs"]),
                sample=content["trial"].astype(np.int64),
                pair=content["pair"].astype(np.int64),
                raw_a=content["raw_a"] / 4.0,
                sigma_px=content["sigma_px"].astype(np.float64),
                error_px=content["error_px"].astype(np.float64),
            )


def world_and_rig(
    rig: str,
    seed: int,
    *,
    dc_k: float,
    displaced_px: Mapping[str, tuple[float, float]] | None = None,
    exposures: int = 8,
) -> tuple[World, Rig]:
    """A world whose camera is off its calibration by what the rig file promises, and that rig.

    Places and mounting are drawn by the emulator; here every drift coefficient is drawn too.
    """
    settings = rendered.world_settings(
        rig, seed, dc_k=dc_k, exposures=exposures, displaced_px=displaced_px or {}
    )
    world = World(settings)
    calibrated = world.rig
    random = np.random.default_rng([seed, 3])
    cones = []
    for cone in calibrated.cones:
        sensors = []
        for sensor in cone.sensors:
            x, y = random.normal(0.0, sensor.drift.sigma_um_per_k, 2)
            drift = replace(
                sensor.drift,
                x_um_per_k=sensor.drift.x_um_per_k + float(x),
                y_um_per_k=sensor.drift.y_um_per_k + float(y),
            )
            sensors.append(replace(sensor, drift=drift))
        cones.append(replace(cone, sensors=tuple(sensors)))
    world.rig = replace(calibrated, cones=tuple(cones))
    world.camera = true_camera(world.rig, seed, displaced_px=settings.displaced_px)
    return world, calibrated


def rendered_sample(
    world: World, pipeline: Pipeline, heads: RigElectronics, scene: Scene, *, seed: int, place: int
) -> StitchedSample:
    """Render one exposure and stitch it with the whole pipeline."""
    exposure = rendered.take(world, Path(), place=place, scene=scene)
    conditions = rendered.conditions_of(exposure, seed=seed)
    product = rendered.process(pipeline, heads, exposure, seed=seed, conditions=conditions)
    assert product.validity is not None
    return StitchedSample(
        rig=pipeline.rig,
        world=world,
        flight=exposure.flight,
        parameters_by_sensor=exposure.snapshot.parameters_by_sensor,
        probes_c={p: c for p, c in conditions.temperatures_c.items() if c is not None},
        tie_points=product.tie_points,
        equal=product.equal_datum,
        mosaic=product.mosaic,
        validity=product.validity,
    )


def drawn_sample(
    world: World, rig: Rig, errors: MatchingErrors, *, seed: int, share: float = 1.0
) -> StitchedSample:
    """Stitch drawn tie points.

    Args:
        world: the camera as it is, on its flight.
        rig: the camera as calibrated.
        errors: of matching; every overlap takes those of one of the trials, by chance.
        seed: of that choice and of the probes' errors.
        share: of the errors that is taken; positions stay the same.
    """
    first_ns = rendered.EPOCH_GPS_NS + round(rendered.FIRST_AFTER_S * 1e9)
    flight = world.flight.beginning_first_line_at(world.flight.distance_flown_m(first_ns))
    parameters_by_sensor = {
        s.name: exposure_parameters_of(world, cone, first_ns)
        for cone in rig.cones
        for s in cone.sensors
    }
    probes = probe_readings(world, first_ns, seed=seed)
    start = nominal_placements(rig, probes, for_sensors(rig, world.plan.tdi_shifts))
    random = np.random.default_rng([seed, 5])
    names = tuple(sensor.name for sensor in rig.sensors)
    samples = int(errors.sample.max()) + 1
    rows = []
    for number, (a, b) in enumerate(errors.pairs):
        own_rows = (errors.pair == number) & (errors.sample == random.integers(0, samples))
        is_colour = rig.cone_of(b).role == "colour"
        raw_a = errors.raw_a[own_rows]
        near_b = raw_from_vip_mm(start[b], vip_mm_from_raw(start[a], raw_a))
        raw_b = same_ground(world, flight, parameters_by_sensor, (a, raw_a), (b, near_b))
        step = (colour_ratio(rig) or 1) if is_colour else 1
        raw_b = raw_b + share / step * errors.error_px[own_rows]
        block = np.zeros((len(raw_a), 8))
        block[:, 0], block[:, 1] = names.index(a), names.index(b)
        block[:, 2:4], block[:, 4:6] = raw_a, raw_b
        block[:, 6] = errors.sigma_px[own_rows]
        block[:, 7] = number
        rows.append(block)
    table = np.concatenate(rows)
    overlap = table[:, 7].astype(np.int64)
    kinds = [
        PAN_TO_COLOUR if rig.cone_of(b).role == "colour" else PAN_TO_PAN for _, b in errors.pairs
    ]
    points = TiePoints(
        names=names,
        pairs=errors.pairs,
        attempted=tuple(len(block) for block in rows),
        sensor_a=table[:, 0].astype(np.int64),
        sensor_b=table[:, 1].astype(np.int64),
        raw_a=table[:, 2:4].copy(),
        raw_b=table[:, 4:6].copy(),
        sigma_px=table[:, 6].copy(),
        correlation=np.ones(len(table)),
        kind=np.array(kinds)[overlap],
        overlap=overlap,
    )
    settings = mosaic_settings(world)
    equal = free_mosaic(rig, start, points, settings=settings)
    validity = evaluate_master(rig, equal, probes)
    mosaic = robust_datum(rig, start, points, equal, validity, settings=settings)
    return StitchedSample(
        rig, world, flight, parameters_by_sensor, probes, points, equal, mosaic, validity
    )


def mosaic_settings(world: World) -> MosaicSettings:
    """As the pipeline sets them for a plan."""
    plan = Conditions(
        temperatures_c={},
        exposure_time_s={},
        tdi_shifts=for_sensors(world.rig, world.plan.tdi_shifts),
        ground_speed_mps=world.plan.ground_speed_mps,
        height_above_ground_m=world.plan.height_above_ground_m,
    )
    return MosaicSettings(parallax_px=parallax_px(world.rig, plan, RELIEF_FRACTION))


def matching_errors(samples: Sequence[StitchedSample]) -> MatchingErrors:
    """Errors of all tie points of some rendered trials against the truth."""
    pairs = samples[0].tie_points.pairs
    return MatchingErrors(
        pairs=pairs,
        sample=np.concatenate([np.full(len(t.tie_points), k) for k, t in enumerate(samples)]),
        pair=np.concatenate([t.tie_points.overlap for t in samples]),
        raw_a=np.concatenate([t.tie_points.raw_a for t in samples]),
        sigma_px=np.concatenate([t.tie_points.sigma_px for t in samples]),
        error_px=np.concatenate([tie_point_errors(t) for t in samples]),
    )


def tie_point_errors(sample: StitchedSample) -> Array:
    """Found minus true of every tie point, (n, 2), PAN px, column and row."""
    points = sample.tie_points
    ratio = colour_ratio(sample.world.rig) or 1
    errors = np.zeros((len(points), 2))
    for number, (a, b) in enumerate(points.pairs):
        rows = np.flatnonzero(points.overlap == number)
        if len(rows):
            seen, near = points.raw_a[rows], points.raw_b[rows]
            true = same_ground(
                sample.world, sample.flight, sample.parameters_by_sensor, (a, seen), (b, near)
            )
            errors[rows] = near - true
            if points.kind[rows[0]] == PAN_TO_COLOUR:
                errors[rows] *= ratio
    return errors


def same_ground(
    world: World,
    flight: SimulatedFlight,
    parameters_by_sensor: Mapping[str, ExposureParameters],
    seen: tuple[str, Array],
    near: tuple[str, Array],
) -> Array:
    """Raw pixels (n, 2) of one sensor that see the ground of another's, by a chord method."""
    target = _ground_m(world, flight, parameters_by_sensor, *seen)
    name, raw = near[0], near[1].copy()
    here = _ground_m(world, flight, parameters_by_sensor, name, raw)
    by_column = (
        _ground_m(world, flight, parameters_by_sensor, name, raw + np.array([1.0, 0.0])) - here
    )
    by_row = _ground_m(world, flight, parameters_by_sensor, name, raw + np.array([0.0, 1.0])) - here
    inverse = np.linalg.inv(np.stack([by_column, by_row], axis=2))
    for _ in range(2):
        raw += np.einsum("nij,nj->ni", inverse, target - here)
        here = _ground_m(world, flight, parameters_by_sensor, name, raw)
    return raw


def check_points(rig: Rig) -> dict[str, Array]:
    """Raw pixels (n, 2) spread over every PAN sensor."""
    points = {}
    for cone in rig.pan_cones:
        for sensor in cone.sensors:
            columns = np.linspace(0.02, 0.98, CHECK_GRID[0]) * (sensor.width_px - 1)
            rows = np.linspace(0.04, 0.98, CHECK_GRID[1]) * (sensor.height_px - 1)
            points[sensor.name] = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    return points


def true_px(sample: StitchedSample, points: Mapping[str, Array]) -> Array:
    """Where the ideal master camera sees raw pixels: VIP column and row (n, 2), all sensors."""
    master = sample.world.rig.cone(sample.world.rig.master_cone).sensors[0].name
    seen = [
        true_vip(
            sample.world,
            sample.flight,
            name,
            sample.parameters_by_sensor[name],
            columns=raw[:, 0],
            rows=raw[:, 1],
            master_mid_gps_ns=sample.parameters_by_sensor[master].mid_gps_ns,
        )
        for name, raw in points.items()
    ]
    return np.concatenate([np.stack(pair, axis=1) for pair in seen])


def put_px(sample: StitchedSample, mosaic: Mosaic, points: Mapping[str, Array]) -> Array:
    """Where a mosaic puts raw pixels: VIP column and row (n, 2), all sensors."""
    return np.concatenate(
        [
            vip_px_from_mm(sample.world.image, vip_mm_from_raw(mosaic.placements[name], raw))
            for name, raw in points.items()
        ]
    )


def _ground_m(
    world: World,
    flight: SimulatedFlight,
    parameters_by_sensor: Mapping[str, ExposureParameters],
    name: str,
    raw: Array,
) -> Array:
    """East and north, m, of what raw pixels see."""
    look = parameters_by_sensor[name]
    pose = flight.pose(look.mid_gps_ns)
    cone, sensor = world.rig.cone_of(name), world.rig.sensor(name)
    ground = ground_points(world, cone, sensor, raw[:, 0], raw[:, 1], look, pose)
    return np.asarray(ground[..., :2], np.float64)

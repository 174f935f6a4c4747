"""`python -m benchmarks.dc_over_flight OUT.svg`: measured and estimated dC over a flight, fig. 1.

Renders emulated mini exposures over real imagery while the camera cools, rests and warms again, and
one probe sticks; plots dC by the probes and dC by stitching.

Source: Ladstädter et al. (2010), fig. 1.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from daemon.cli.benchmark.measurement import machine
from processing.geometry.conditions import for_sensors
from processing.pipelines.stitched import Conditions, Pipeline, PipelineSettings, Product
from processing.quality.report import Flag
from processing.radiometry.calibration import load_radiometry
from processing.rig import shipped_rigs
from sim_hw.world import sensor_calibration, true_camera
from sim_hw.world.electronics import Electronics, true_sensor
from sim_hw.world.rendering import ExposureParameters, light_on_sensor
from sim_hw.world.scene import open_scene
from sim_hw.world.seeding import random_stream
from sim_hw.world.world import World, WorldSettings

EPOCH_NS = 1_400_000_000_000_000_000
MINUTES = 40.0
STUCK_PROBE, STUCK_AT_MIN = "1", 26.0
LINE_EXPOSURES = 10


@dataclass(frozen=True)
class Point:
    """One exposure: its minute and true dC, and per cone what probes and stitching say, K."""

    minute: float
    true_k: float
    measured_k: Mapping[str, float]
    estimated_k: Mapping[str, float]
    sigma_k: Mapping[str, float]
    disagrees: tuple[str, ...]
    flagged: bool


class Profile:
    """dC of the camera over a flight: it cools on the climb, rests, and warms on the descent."""

    def __init__(self, reference_c: Mapping[str, float], own_k: Mapping[str, float]) -> None:
        self.reference_c = reference_c
        self.own_k = own_k
        self.minute = 0.0

    def dc_k(self, minute: float) -> float:
        cooled = -10.0 + 24.0 * math.exp(-minute / 8.0)
        return cooled + (0.0 if minute < 28.0 else 9.0 * (1.0 - math.exp(-(minute - 28.0) / 5.0)))

    def at(self, probe: str, t_s: float) -> float:
        """The temperature of a probe; `t_s` within an exposure does not count."""
        return self.reference_c[probe] + self.own_k[probe] + self.dc_k(self.minute)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.dc_over_flight")
    parser.add_argument("svg", type=Path, help="where the drawing goes")
    parser.add_argument("--exposures", type=int, default=20)
    options = parser.parse_args()
    points = fly(options.exposures)
    options.svg.write_text(drawing(points), encoding="utf-8")
    print(json.dumps({"machine": machine(), **summary(points)}, indent=2))


def fly(exposures: int) -> list[Point]:
    """Render and stitch exposures spread over the profile.

    They are taken along one short line, over and over, as if the minutes lay between them.
    """
    world = World(
        WorldSettings(
            rig_file=str(shipped_rigs()["ultracam-x-mini"]),
            seed=4,
            epoch_gps_ns=EPOCH_NS,
            exposures=LINE_EXPOSURES,
        )
    )
    rig, plan, random = world.rig, world.plan, np.random.default_rng(4)
    profile = Profile(
        {cone.probe: cone.calibration_c for cone in rig.cones},
        {probe: float(random.uniform(-0.3, 0.3)) for probe in rig.probes},
    )
    world.temperatures = cast(true_camera.ProbeTemperatures, profile)
    needed = [c for c in rig.cones if c.role == "pan" or c.name == rig.colour_master_cone]
    points: list[Point] = []
    stuck_c: float | None = None
    with tempfile.TemporaryDirectory(prefix="syntopic-dc-") as folder:
        scene = open_scene(replace(world.scene_settings, height_px=9000), Path(folder) / "scene")
        flight = world.flight.beginning_first_line_at(1100.0)
        heads, radiometry = {}, {}
        for cone in needed:
            for sensor in cone.sensors:
                true = true_sensor(cone, sensor, 4, field_radius_mm=world.field_radius_mm(cone))
                heads[sensor.name] = Electronics(sensor, true, world.electrons_per_radiance_s(cone))
                measured = sensor_calibration.measure(sensor, true, 4)
                sensor_calibration.write_radiometry(Path(folder), sensor, measured)
                path = Path(folder) / "radiometry" / f"{sensor.name}.npz"
                radiometry[sensor.name] = load_radiometry(path)
        pipeline = Pipeline(rig, radiometry, PipelineSettings(geometry=False))
        for k in range(exposures):
            profile.minute = MINUTES * k / max(exposures - 1, 1)
            step_s = plan.distance_m / plan.ground_speed_mps * (k % LINE_EXPOSURES)
            reference_ns = EPOCH_NS + round((20.0 + step_s) * 1e9)
            reference_mm = rig.cone(rig.reference_cone).position_mm[0]
            frames = {}
            for cone in needed:
                ahead_m = (cone.position_mm[0] - reference_mm) * 1e-3
                look = ExposureParameters(
                    mid_gps_ns=reference_ns - round(ahead_m / plan.ground_speed_mps * 1e9),
                    exposure_time_us=plan.exposure_time_us[cone.name],
                    tdi_shifts=plan.tdi_shifts[cone.name],
                )
                for sensor in cone.sensors:
                    frames[sensor.name] = heads[sensor.name].frame(
                        light_on_sensor(world, scene, flight, cone, sensor, look),
                        exposure_time_us=look.exposure_time_us,
                        tdi_shifts=look.tdi_shifts,
                        gain_db=0.0,
                        temperature_c=profile.at(sensor.probe, 0.0),
                        random=random_stream(4, "noise", sensor.name, k),
                    )
            read = {p: profile.at(p, 0.0) + float(random.normal(0, 0.1)) for p in rig.probes}
            if profile.minute >= STUCK_AT_MIN:
                stuck_c = read[STUCK_PROBE] if stuck_c is None else stuck_c
                read[STUCK_PROBE] = stuck_c
            conditions = Conditions(
                temperatures_c=read,
                exposure_time_s=for_sensors(
                    rig, {name: t * 1e-6 for name, t in plan.exposure_time_us.items()}
                ),
                tdi_shifts=for_sensors(rig, plan.tdi_shifts),
                ground_speed_mps=plan.ground_speed_mps,
                height_above_ground_m=plan.height_above_ground_m,
            )
            product = pipeline.process(frames, conditions)
            own = [profile.own_k[cone.probe] for cone in rig.pan_cones]
            points.append(
                _point(profile.minute, profile.dc_k(profile.minute) + float(np.mean(own)), product)
            )
    return points


def summary(points: Sequence[Point]) -> dict[str, Any]:
    """Difference estimated less measured, and the cones and minutes that were flagged."""
    off = [
        (p.estimated_k[c] - p.measured_k[c], math.hypot(p.sigma_k[c], 0.1))
        for p in points
        for c in p.estimated_k
        if c != STUCK_PROBE or p.minute < STUCK_AT_MIN
    ]
    return {
        "exposures": len(points),
        "healthy_rms_k": round(float(np.sqrt(np.mean([d**2 for d, _ in off]))), 3),
        "healthy_rms_in_sigmas": round(float(np.sqrt(np.mean([(d / s) ** 2 for d, s in off]))), 2),
        "sigma_k": {
            c: round(float(np.median([p.sigma_k[c] for p in points if c in p.sigma_k])), 3)
            for c in ("0", "1", "2")
        },
        "flagged_minutes": [round(p.minute, 1) for p in points if p.flagged],
        "disagreeing": sorted({c for p in points for c in p.disagrees}),
    }


def drawing(points: Sequence[Point]) -> str:
    """Fig. 1: measured blue, estimated red with three sigmas; below, the difference by cone."""
    wide, high = 760.0, 560.0
    left, right = 60.0, 740.0

    def x_of(minute: float) -> float:
        return left + (right - left) * minute / MINUTES

    def top(k: float) -> float:
        return 170.0 - k * 8.0

    def low(k: float) -> float:
        return 430.0 - k * 14.0

    body: list[str] = []
    for k in range(-10, 16, 5):
        body += [
            _line(left, top(k), right, top(k), "#dddddd"),
            _text(52, top(k) + 4, f"{k}", "end"),
        ]
    for k in range(-6, 9, 2):
        body += [
            _line(left, low(k), right, low(k), "#dddddd"),
            _text(52, low(k) + 4, f"{k}", "end"),
        ]
    for minute in range(0, 41, 5):
        body.append(_text(x_of(minute), 545.0, f"{minute}", "middle"))
    body.append(_text(right, 528.0, "minutes of flight", "end"))
    body.append(_text(left, 24.0, "dC, K: measured by probes (blue), estimated by stitching (red)"))
    body.append(
        _text(left, 308.0, "Estimated less measured, K, by cone, with 3 sigma; filled: flagged")
    )
    others = [[c for c in p.measured_k if c != STUCK_PROBE] for p in points]
    blue = [
        float(np.mean([p.measured_k[c] for c in o])) for p, o in zip(points, others, strict=True)
    ]
    body.append(_path((x_of(p.minute), top(k)) for p, k in zip(points, blue, strict=True)))
    for p in points:
        weights = {c: 1.0 / p.sigma_k[c] ** 2 for c in p.estimated_k}
        total = sum(weights.values())
        mean_k = sum(p.estimated_k[c] * w for c, w in weights.items()) / total
        reach = 3.0 / math.sqrt(total)
        x = x_of(p.minute)
        body.append(_line(x, top(mean_k - reach), x, top(mean_k + reach), "#c0392b"))
        body.append(_dot(x, top(mean_k), "#c0392b"))
    colours = {"0": "#7f8c8d", "1": "#c0392b", "2": "#27ae60"}
    for shift, (cone, colour) in enumerate(colours.items()):
        body.append(_text(right - 180.0 + 60.0 * shift, 308.0, f"cone {cone}", fill=colour))
        for p in points:
            if cone in p.estimated_k:
                x = x_of(p.minute) + 4.0 * (shift - 1)
                off, reach = p.estimated_k[cone] - p.measured_k[cone], 3.0 * p.sigma_k[cone]
                body.append(_line(x, low(off - reach), x, low(off + reach), colour))
                body.append(_dot(x, low(off), colour, filled=cone in p.disagrees))
    stuck = x_of(STUCK_AT_MIN)
    body += [_line(stuck, 40.0, stuck, 530.0, "#888888"), _text(stuck + 4, 52.0, "probe 1 sticks")]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide:.0f} {high:.0f}" '
        f'width="{wide:.0f}" height="{high:.0f}" font-family="system-ui, DejaVu Sans, sans-serif">'
        '<rect width="100%" height="100%" fill="#ffffff"/>' + "".join(body) + "</svg>\n"
    )


def _point(minute: float, true_k: float, product: Product) -> Point:
    known = [
        e for e in product.estimated_dc if e.estimated_k is not None and e.measured_k is not None
    ]
    return Point(
        minute=minute,
        true_k=true_k,
        measured_k={e.cone: e.measured_k for e in known if e.measured_k is not None},
        estimated_k={e.cone: e.estimated_k for e in known if e.estimated_k is not None},
        sigma_k={e.cone: e.sigma_k for e in known if e.sigma_k is not None},
        disagrees=tuple(e.cone for e in known if e.disagrees),
        flagged=bool(product.report.flags & Flag.DC_DISAGREEMENT),
    )


def _line(x1: float, y1: float, x2: float, y2: float, stroke: str) -> str:
    return f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{stroke}"/>'


def _dot(x: float, y: float, colour: str, *, filled: bool = True) -> str:
    fill = colour if filled else "#ffffff"
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" stroke="{colour}" fill="{fill}"/>'


def _text(x: float, y: float, content: str, anchor: str = "start", fill: str = "#333333") -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="12" fill="{fill}" '
        f'text-anchor="{anchor}">{content}</text>'
    )


def _path(points: Iterable[tuple[float, float]]) -> str:
    path_data = " L ".join(f"{x:.1f} {y:.1f}" for x, y in points)
    return f'<path d="M {path_data}" fill="none" stroke="#2980b9" stroke-width="2"/>'


if __name__ == "__main__":
    main()

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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.figure import Figure

from daemon.cli.benchmark.measurement import machine
from daemon.postflight.plots import FAINT, svg_of, titles
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
    """Fig. 1: measured and estimated with three sigmas; below, the difference by cone."""

    def draw(figure: Figure) -> None:
        above, below = figure.subplots(2, 1, sharex=True)
        minutes = [p.minute for p in points]
        others = [[k for c, k in p.measured_k.items() if c != STUCK_PROBE] for p in points]
        above.plot(minutes, [np.mean(k) for k in others], label="measured by probes")
        weights = [{c: p.sigma_k[c] ** -2 for c in p.estimated_k} for p in points]
        totals = [sum(w.values()) for w in weights]
        means = [
            sum(p.estimated_k[c] * w[c] for c in w) / total
            for p, w, total in zip(points, weights, totals, strict=True)
        ]
        reach = [3.0 / math.sqrt(total) for total in totals]
        above.errorbar(minutes, means, reach, fmt="o", markersize=3, label="estimated by stitching")
        titles(above, "dC, with 3 sigma", "", "K")
        for shift, cone in enumerate(("0", "1", "2")):
            own = [p for p in points if cone in p.estimated_k]
            x = np.array([p.minute for p in own]) + 0.2 * (shift - 1)
            off = np.array([p.estimated_k[cone] - p.measured_k[cone] for p in own])
            bars = below.errorbar(
                x, off, [3.0 * p.sigma_k[cone] for p in own], fmt="o", markersize=4,
                markerfacecolor="w", label=f"cone {cone}",
            )  # fmt: skip
            flagged = np.array([cone in p.disagrees for p in own], dtype=bool)
            below.plot(
                x[flagged], off[flagged], "o", markersize=4, color=bars[0].get_color(), zorder=3
            )
        titles(below, "Estimated less measured, 3 sigma; filled: flagged",
               "minutes of flight", "K")  # fmt: skip
        for plot in (above, below):
            plot.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.0)
            plot.axvline(STUCK_AT_MIN, color=FAINT, linestyle="--", linewidth=1.0)
        above.annotate("probe 1 sticks", (STUCK_AT_MIN, 0.02), xycoords=("data", "axes fraction"),
                       xytext=(4, 2), textcoords="offset points", color=FAINT)  # fmt: skip

    return svg_of(draw, (7.6, 5.6))


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


if __name__ == "__main__":
    main()

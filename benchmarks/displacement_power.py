"""`python -m benchmarks.displacement_power`: how small a moved master sensor is found and named.

Thousands of outcomes of stitching with one master sensor moved a known way, and of healthy ones for
false alarms, go through the pipeline's own judgement. What calibration, drift, probes and stitching
are off by is drawn, the last from the covariance that `benchmarks.uncertainty_consistency` holds;
some are stitched in full as a control. Next to each figure is the bound of the best test.
Then complete flights are evaluated together, warm ones among them, and at last the probe is wrong
instead.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks import uncertainty_consistency
from benchmarks.stitching_samples import (
    MatchingErrors,
    drawn_sample,
    matching_errors,
    world_and_rig,
)
from daemon.cli.benchmark.measurement import machine
from daemon.postflight.plots import FAINT, legend, level_line, svg_of, titles
from processing.mosaic.flight_validity import evaluate_flight
from processing.mosaic.free_mosaic import Mosaic
from processing.mosaic.stitch_record import stitch_record
from processing.mosaic.validity import Validity, evaluate_master
from processing.rig import Rig, find_rig

Array = NDArray[np.float64]

LENGTHS_PX = (0.05, 0.10, 0.15, 0.20, 0.25, 0.30, 0.40, 0.50)
DC_K = (0.0, 5.0, 10.0, 20.0)
COLOURS = ("#2980b9", "#8e44ad", "#27ae60", "#c0392b")
FLIGHT_EXPOSURES = 24
FLIGHTS = {
    "20 K throughout, moved half way": (20.0, 20.0, FLIGHT_EXPOSURES // 2 + 1),
    "from 20 K to 0 K, moved before it": (20.0, 0.0, 1),
    "20 K throughout, moved before it": (20.0, 20.0, 1),
}
"""dC at the first and the last exposure of a flight, and the first that is displaced."""
FLIGHT_LENGTHS_PX = (0.10, 0.15, 0.30)
MISREAD_K = (1.0, 2.0, 4.0, 8.0, 16.0)
MISREAD_DC_K = (0.0, 20.0)
FAMILY_ALPHA = 0.001
PROBE_SIGMA_K = 0.1
IDEAL_DRAWS = 40_000
TEMPLATES = 8
CONTROL = (0.15, 0.30)
FIRST_SEED = 50_000


@dataclass(frozen=True)
class Power:
    """Shares of `exposures` with one sensor moved by `length_px` at a dC.

    `found`: some sensor was called displaced; `named`: the right one; `alone`: the right one, and
    no other that fits nearly as well. `ideal_found` and `ideal_named` are those of the best test.
    """

    dc_k: float
    length_px: float
    exposures: int
    found: float
    named: float
    named_uniquely: float
    ideal_found: float
    ideal_named: float


@dataclass(frozen=True)
class FlightPower:
    """Shares of `flights` with a reported step, and with the right sensor (or as alternative)."""

    flight: str
    length_px: float
    flights: int
    found: float
    named: float
    named_uniquely: float


@dataclass(frozen=True)
class ProbeMisreading:
    """The verdict where the master cone's probe reads `off_k` too much and no sensor has moved.

    Shares of `exposures`, or of `flights` from whose middle on it does: a sensor accused alone,
    sensor or probe, the probe named.
    """

    dc_k: float
    off_k: float
    exposures: int
    misattributed: float
    either: float
    named: float
    flights: int
    flights_misattributed: float
    flights_named: float


@dataclass(frozen=True)
class Camera:
    """Displacements of master sensors: `off_um`, and `um_per_k` in addition to TDM."""

    off_um: dict[str, Array]
    um_per_k: dict[str, Array]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.displacement_power")
    parser.add_argument("--errors", type=Path, help="errors of matching; rendered where not given")
    parser.add_argument("--rendered", type=int, default=8, help="exposures to render for them")
    parser.add_argument("--exposures", type=int, default=1000, help="for each length and dC")
    parser.add_argument("--healthy", type=int, default=10_000)
    parser.add_argument("--stitched", type=int, default=60, help="for each length of the control")
    parser.add_argument("--flights", type=int, default=40, help="for each kind and length")
    parser.add_argument("--drawing", type=Path, help="where to draw the curves (SVG)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    if options.errors is None:
        with tempfile.TemporaryDirectory(prefix="syntopic-power-") as folder:
            errors = matching_errors(uncertainty_consistency.render(options.rendered, Path(folder)))
    else:
        errors = MatchingErrors.load(options.errors)
    outcomes = Outcomes(errors)
    alarms = outcomes.false_alarms(options.healthy)
    powers = [
        outcomes.power(dc_k=dc_k, length_px=length, exposures=options.exposures)
        for dc_k in DC_K
        for length in LENGTHS_PX
    ]
    control = [stitched(errors, length_px=length, exposures=options.stitched) for length in CONTROL]
    flights = [
        outcomes.flights(kind, length_px=length, flights=options.flights)
        for kind in (FLIGHTS if options.flights else ())
        for length in (0.0, *FLIGHT_LENGTHS_PX)
    ]
    misreadings = [
        outcomes.probe_bias(dc_k, off_k, exposures=options.exposures, flights=options.flights)
        for dc_k in MISREAD_DC_K
        for off_k in MISREAD_K
    ]
    if options.drawing is not None:
        options.drawing.write_text(drawing(powers), encoding="utf-8")
    if options.json:
        output = {"healthy": options.healthy, "alarms": alarms}
        output |= {"power": [vars(p) for p in powers], "control": [vars(p) for p in control]}
        output |= {"flights": [vars(f) for f in flights]}
        output |= {"misread": [vars(m) for m in misreadings]}
        print(json.dumps({"machine": machine(), **output}))
        return
    print(f"{uncertainty_consistency.RIG}: {alarms} false alarms of {options.healthy} healthy\n")
    print(
        "| dC K | moved px | exposures | found | rightly named | named alone | best test: found "
        "| named |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for p in [*powers, *control]:
        print(
            f"| {p.dc_k:g} | {p.length_px:.2f} | {p.exposures} | {p.found:.1%} | {p.named:.1%} "
            f"| {p.named_uniquely:.1%} | {p.ideal_found:.1%} | {p.ideal_named:.1%} |"
        )
    print("\n| flight | moved px | flights | reported | the right sensor | named alone |")
    print("|---|---|---|---|---|---|")
    for f in flights:
        print(
            f"| {f.flight} | {f.length_px:.2f} | {f.flights} | {f.found:.1%} | {f.named:.1%} "
            f"| {f.named_uniquely:.1%} |"
        )
    print(
        "\n| dC K | probe off K | exposures | sensor accused | sensor or probe | probe named "
        "| flights | sensor accused | probe named |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for m in misreadings:
        print(
            f"| {m.dc_k:g} | {m.off_k:g} | {m.exposures} | {m.misattributed:.1%} | {m.either:.1%} "
            f"| {m.named:.1%} | {m.flights} | {m.flights_misattributed:.1%} | "
            f"{m.flights_named:.1%} |"
        )


class Outcomes:
    """What stitching may find of the master sensors, drawn; and its evaluation."""

    def __init__(self, errors: MatchingErrors) -> None:
        self.rig = find_rig(uncertainty_consistency.RIG)
        self._templates = []
        for k in range(TEMPLATES):
            world, rig = world_and_rig(uncertainty_consistency.RIG, FIRST_SEED + k, dc_k=0.0)
            mosaic = drawn_sample(world, rig, errors, seed=FIRST_SEED + k).equal
            units = mosaic.model.units
            values, directions = np.linalg.eigh(mosaic.covariance / np.outer(units, units))
            root = directions * np.sqrt(np.maximum(values, 0.0))
            self._templates.append((mosaic, units[:, None] * root))
        self._random = np.random.default_rng(7)

    def camera(self) -> Camera:
        """A camera's calibration and drift coefficients, off by the sigmas of the rig file."""
        draw = self._random.normal
        sensors = self.rig.master_sensors
        return Camera(
            {s.name: draw(0.0, s.position_sigma_um, 2) for s in sensors},
            {s.name: draw(0.0, s.drift.sigma_um_per_k, 2) for s in sensors},
        )

    def stitched(
        self,
        camera: Camera,
        dc_k: float,
        moved: str | None,
        shift_px: tuple[float, float],
        misread_k: float = 0.0,
    ) -> tuple[Mosaic, dict[str, float]]:
        """One exposure's stitching with one sensor moved, and what the probes say.

        That of the master cone reads `misread_k` too much.
        """
        random = self._random
        mosaic, root = self._templates[int(random.integers(0, TEMPLATES))]
        values = root @ random.standard_normal(root.shape[1])
        probe_k = float(random.normal(0.0, PROBE_SIGMA_K))
        temperatures = {
            cone.probe: cone.calibration_c + dc_k + probe_k for cone in self.rig.pan_cones
        }
        for sensor in self.rig.master_sensors:
            drift = sensor.drift
            off_um = camera.off_um[sensor.name] + camera.um_per_k[sensor.name] * dc_k
            off_um -= np.array([drift.x_um_per_k, drift.y_um_per_k]) * (probe_k + misread_k)
            if sensor.name == moved:
                off_um += np.array(shift_px) * mosaic.model.pitch_mm * 1e3
            first = mosaic.model.sensors[sensor.name]
            values[first : first + 2] += off_um * 1e-3
            values[first + 3] -= drift.scale_ppm_per_k * 1e-6 * misread_k
            temperatures[sensor.probe] = sensor.calibration_c + dc_k + probe_k + misread_k
        return replace(mosaic, values=values), temperatures

    def evaluate(self, dc_k: float, moved: str | None, shift_px: tuple[float, float]) -> Validity:
        """One exposure of a newly drawn camera."""
        mosaic, temperatures = self.stitched(self.camera(), dc_k, moved, shift_px)
        return evaluate_master(self.rig, mosaic, temperatures)

    def flights(self, kind: str, *, length_px: float, flights: int) -> FlightPower:
        """Flights evaluated together, each with its own camera; one master sensor moves."""
        first_k, last_k, since = FLIGHTS[kind]
        found = named = named_uniquely = 0
        for k in range(flights):
            camera = self.camera()
            moved = self.rig.master_sensors[k % len(self.rig.master_sensors)].name
            angle = float(self._random.uniform(0.0, 2.0 * math.pi))
            shift = (length_px * math.cos(angle), length_px * math.sin(angle))
            records = {}
            for number, dc_k in enumerate(np.linspace(first_k, last_k, FLIGHT_EXPOSURES), start=1):
                far = shift if number >= since else (0.0, 0.0)
                mosaic, read = self.stitched(camera, float(dc_k), moved, far)
                records[number] = stitch_record(self.rig, mosaic, read, read)
            steps = [
                s
                for s in evaluate_flight(self.rig, records).steps
                if s.cone == self.rig.master_cone and s.kind != "misread"
            ]
            found += bool(steps)
            named += any(moved in (s.sensor, *s.alternatives) for s in steps)
            named_uniquely += len(steps) == 1 and (steps[0].sensor, steps[0].alternatives) == (
                moved,
                (),
            )
        return FlightPower(
            kind, length_px, flights, found / flights, named / flights, named_uniquely / flights
        )

    def probe_bias(
        self, dc_k: float, off_k: float, *, exposures: int, flights: int
    ) -> ProbeMisreading:
        """The master cone's probe is wrong: in single exposures, and from half a flight on."""
        misattributed = either = named = flights_misattributed = flights_named = 0
        for _ in range(exposures):
            found = evaluate_master(
                self.rig, *self.stitched(self.camera(), dc_k, None, (0.0, 0.0), off_k)
            )
            misattributed += found.displaced is not None and found.probe_bias is None
            either += found.displaced is not None and found.probe_bias is not None
            named += found.displaced is None and found.probe_bias is not None
        for _ in range(flights):
            camera, records = self.camera(), {}
            for number in range(1, FLIGHT_EXPOSURES + 1):
                wrong_k = off_k if number > FLIGHT_EXPOSURES // 2 else 0.0
                mosaic, read = self.stitched(camera, dc_k, None, (0.0, 0.0), wrong_k)
                records[number] = stitch_record(self.rig, mosaic, read, read)
            steps = evaluate_flight(self.rig, records).steps
            kinds = [s.kind for s in steps if s.cone == self.rig.master_cone]
            flights_misattributed += any(kind != "misread" for kind in kinds)
            flights_named += "misread" in kinds
        return ProbeMisreading(
            dc_k,
            off_k,
            exposures,
            misattributed / max(exposures, 1),
            either / max(exposures, 1),
            named / max(exposures, 1),
            flights,
            flights_misattributed / max(flights, 1),
            flights_named / max(flights, 1),
        )

    def false_alarms(self, count: int) -> int:
        """How many of `count` healthy exposures, dC within +-20 K, name a sensor."""
        alarms = 0
        for _ in range(count):
            dc_k = float(self._random.uniform(-20.0, 20.0))
            alarms += self.evaluate(dc_k, None, (0.0, 0.0)).displaced is not None
        return alarms

    def power(self, *, dc_k: float, length_px: float, exposures: int) -> Power:
        """Move one of the master sensors, in turn, in a direction drawn each time."""
        tally = _Tally()
        masters = [s.name for s in self.rig.cone(self.rig.master_cone).sensors]
        for k in range(exposures):
            moved = masters[k % len(masters)]
            angle = float(self._random.uniform(0.0, 2.0 * math.pi))
            shift = (length_px * math.cos(angle), length_px * math.sin(angle))
            tally.add(self.evaluate(dc_k, moved, shift), moved)
        return tally.power(self.rig, dc_k, length_px)


def stitched(errors: MatchingErrors, *, length_px: float, exposures: int) -> Power:
    """The same at dC = 0 with tie points, adjustment and all, the emulator's camera being moved."""
    rig = find_rig(uncertainty_consistency.RIG)
    masters = [s.name for s in rig.cone(rig.master_cone).sensors]
    tally = _Tally()
    for k in range(exposures):
        seed = 2 * FIRST_SEED + k
        angle = float(np.random.default_rng([seed, 2]).uniform(0.0, 2.0 * math.pi))
        moved = masters[k % len(masters)]
        shift = (length_px * math.cos(angle), length_px * math.sin(angle))
        world, calibrated = world_and_rig(
            uncertainty_consistency.RIG, seed, dc_k=0.0, displaced_px={moved: shift}
        )
        tally.add(drawn_sample(world, calibrated, errors, seed=seed).validity, moved)
    return tally.power(rig, 0.0, length_px)


@dataclass
class _Tally:
    count: int = 0
    found: int = 0
    named: int = 0
    named_uniquely: int = 0

    def add(self, validity: Validity, moved: str) -> None:
        self.count += 1
        if validity.displaced is not None:
            right = validity.displaced.sensor == moved
            self.found += 1
            self.named += right
            self.named_uniquely += right and not validity.alternatives

    def power(self, rig: Rig, dc_k: float, length_px: float) -> Power:
        ideal_found, ideal_named = ideal(rig, dc_k=dc_k, length_px=length_px)
        return Power(
            dc_k,
            length_px,
            self.count,
            self.found / self.count,
            self.named / self.count,
            self.named_uniquely / self.count,
            ideal_found,
            ideal_named,
        )


def ideal(rig: Rig, *, dc_k: float, length_px: float) -> tuple[float, float]:
    """What the likelihood ratio over all master sensors reaches where stitching has no error.

    Only the positions of the master sensors carry the displacement; shift, rotation and scale they
    have in common are the datum's. What remains is off by calibration, drift coefficients and
    probe, drawn here by their sigmas.
    """
    sensors = rig.cone(rig.master_cone).sensors
    pitch_um = sensors[0].pitch_um
    covariance = np.diag(
        np.repeat(
            [s.position_sigma_um**2 + (s.drift.sigma_um_per_k * dc_k) ** 2 for s in sensors], 2
        )
    )
    per_kelvin = np.array([[s.drift.x_um_per_k, s.drift.y_um_per_k] for s in sensors]).reshape(-1)
    covariance = (covariance + np.outer(per_kelvin, per_kelvin) * PROBE_SIGMA_K**2) / pitch_um**2
    common = np.zeros((2 * len(sensors), 4))
    for i, s in enumerate(sensors):
        common[2 * i] = (1.0, 0.0, s.x_mm, -s.y_mm)
        common[2 * i + 1] = (0.0, 1.0, s.y_mm, s.x_mm)
    full, _, _ = np.linalg.svd(common)
    contrasts = full[:, 4:].T
    of_contrasts = contrasts @ covariance @ contrasts.T
    weight = np.linalg.inv(of_contrasts)
    random = np.random.default_rng(1)
    moved = random.integers(0, len(sensors), IDEAL_DRAWS)
    angle = random.uniform(0.0, 2.0 * math.pi, IDEAL_DRAWS)
    y = random.standard_normal((IDEAL_DRAWS, len(weight))) @ np.linalg.cholesky(of_contrasts).T
    shift = length_px * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    statistics = np.empty((len(sensors), IDEAL_DRAWS))
    for i in range(len(sensors)):
        own_columns = moved == i
        y[own_columns] += shift[own_columns] @ contrasts[:, 2 * i : 2 * i + 2].T
    for i in range(len(sensors)):
        design = contrasts[:, 2 * i : 2 * i + 2]
        pull = y @ weight @ design
        statistics[i] = np.sum((pull @ np.linalg.inv(design.T @ weight @ design)) * pull, axis=1)
    over = statistics.max(axis=0) > chi2.ppf(1.0 - FAMILY_ALPHA / len(sensors), 2)
    right = statistics.argmax(axis=0) == moved
    return float(over.mean()), float((over & right).mean())


def drawing(powers: Sequence[Power]) -> str:
    """Found (full) and rightly named (hollow) over the displacement, a colour for each dC."""

    def draw(figure: Figure) -> None:
        plot = figure.subplots()
        for dc_k, colour in zip(DC_K, COLOURS, strict=True):
            some = [p for p in powers if p.dc_k == dc_k]
            x = [p.length_px for p in some]
            plot.plot(x, [p.ideal_found for p in some], "--", color=colour, linewidth=1.0)
            label = f"found, dC {dc_k:g} K"
            plot.plot(x, [p.found for p in some], "o-", color=colour, markersize=4, label=label)
            named = [p.named for p in some]
            plot.plot(
                x, named, "o-", color=colour, markersize=4, markerfacecolor="w", linewidth=0.7
            )
        level_line(plot, 0.8, "80 %")
        plot.axvline(0.15, color=FAINT, linestyle="--", linewidth=1.0)
        plot.text(0.153, 0.03, "0.15 px", color=FAINT)
        plot.set(xlim=(0.0, 0.5), ylim=(0.0, 1.02))
        title = (
            f"{uncertainty_consistency.RIG}: one master sensor moved, {powers[0].exposures} a point"
        )
        note = "filled: found; hollow: rightly named; dashed: found by the best test there is"
        titles(plot, title, f"displacement, px\n{note}", "share of exposures")
        legend(figure, plot)

    return svg_of(draw)


if __name__ == "__main__":
    main()

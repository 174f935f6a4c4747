"""`python -m benchmarks.blunder_search`: blunders that data snooping finds, and false alarms.

Three blocks: aerial lines with control, images around a building, and the network of the published
camera calibration in tests/processing/bundle/data. Observations are computed from the adjusted
values and disturbed with normal errors; 2 % of the image points are displaced by 50 px. `--large`
takes a building of 256,000 image coordinates alone. `--others` adds GNSS positions, attitudes and
distances, and a blunder of 20 standard deviations to one of 12 control points, GNSS positions,
attitudes and distances.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from daemon.cli.benchmark.measurement import machine
from daemon.postflight.importers.dbat import import_dbat
from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.data_snooping import Excluded, nothing_excluded
from processing.bundle.equations import equations
from processing.bundle.initial_values import completed
from processing.bundle.network import (
    Attitudes,
    CameraModel,
    Distances,
    Gnss,
    ImagePoints,
    Images,
    MeasuredAttitudes,
    Network,
    Points,
    Stations,
)
from processing.bundle.reliability import reliability_of
from processing.bundle.robust_weights import WeightFunction
from processing.geometry.rotation import rotation_matrix, rotations_from_vectors

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

CAMCAL: Final = (
    Path(__file__).parents[1] / "tests/processing/bundle/data/dbat-camcal/camcaldemo.xml"
)
BLUNDER_PX: Final = 50.0
SHARE: Final = 0.02
ABOVE_DETECTABLE: Final = 1.5
MIN_RAYS: Final = 3
OTHER_SIGMAS: Final = 20.0
ONE_OF: Final = 12
KINDS: Final = (("control", (2, 3)), ("gnss", (4, 5)), ("attitude", (6,)), ("distance", (7,)))
LARGE: Final = 26_000


@dataclass(frozen=True)
class Block:
    """A network without errors in its observations."""

    name: str
    network: Network
    pixel_mm: float


def _network(
    name: str, f_mm: float, half_mm: tuple[float, float], pixel_mm: float, station: Array,
    rotation: Array, ground: Array, control: Array, taken: Callable[[int, Array], Flags],
) -> Block:  # fmt: skip
    """All images of all points that `taken` accepts, without errors."""
    image, point, xy = [], [], []
    for k, (place, own) in enumerate(zip(station, rotation, strict=True)):
        ray = (ground - place) @ own
        with np.errstate(all="ignore"):
            seen = -f_mm * ray[:, :2] / ray[:, 2:]
            inside = (ray[:, 2] < 0.0) & (np.abs(seen) < half_mm).all(axis=1)
        rows = np.flatnonzero(inside & taken(k, ray))
        image.append(np.full(len(rows), k))
        point.append(rows)
        xy.append(seen[rows])
    images, points, places = (np.concatenate(part) for part in (image, point, xy))
    often = np.bincount(points, minlength=len(ground)) >= 2
    own = often[points]
    sigma = np.full(ground.shape, np.nan)
    sigma[control] = 0.02
    names = tuple(f"i{k}" for k in range(len(station)))
    none = np.zeros(len(station), dtype=bool)
    every = np.arange(len(station))
    return Block(
        name,
        Network(
            cameras=(CameraModel("c", f_mm, pixel_mm=pixel_mm),),
            stations=Stations(names, station, none),
            attitudes=Attitudes(names, rotation, none),
            images=Images(names, every, every, np.zeros_like(every), np.full_like(every, -1)),
            points=Points(
                tuple(f"p{k}" for k in range(len(ground))),
                ground,
                sigma,
                np.zeros(len(ground), dtype=bool),
            ),
            image_points=ImagePoints(
                images[own], points[own], places[own], np.full((int(own.sum()), 2), pixel_mm * 0.3)
            ),
        ),
        pixel_mm,
    )


def aerial_lines(lines: int = 4, along: int = 6, points: int = 600, seed: int = 1) -> Block:
    """Crosswise overlapping lines at 60 % and 30 %, twelve control points."""
    random = np.random.default_rng(seed)
    base, distance, height = 400.0, 900.0, 1000.0
    place = [(base * k, distance * line, height) for line in range(lines) for k in range(along)]
    station = np.array(place) + random.normal(0.0, 5.0, (lines * along, 3))
    rotation = np.array(
        [
            rotation_matrix(omega, phi, np.pi * (k // along % 2))
            for k, (omega, phi) in enumerate(random.normal(0.0, 0.02, (lines * along, 2)))
        ]
    )
    low = (-base, -0.6 * distance, 0.0)
    high = (base * along, distance * (lines - 0.4), 80.0)
    ground = random.uniform(low, high, (points, 3))
    control = np.arange(points) % (points // 12) == 0
    return _network(
        "aerial", 100.0, (52.0, 67.0), 6e-3, station, rotation, ground, control,
        lambda _, ray: np.ones(len(ray), dtype=bool),
    )  # fmt: skip


def around_building(images: int = 60, points: int = 2600, seed: int = 2) -> Block:
    """Converging images around four walls; of the images that see a point few measure it."""
    random = np.random.default_rng(seed)
    half = np.array([12.5, 3.5])
    wall = random.integers(0, 4, points)
    along, up = random.uniform(-1.0, 1.0, points), random.uniform(0.0, 20.0, points)
    axis = wall // 2
    sign = np.where(wall % 2 == 0, 1.0, -1.0)
    ground = np.zeros((points, 3))
    ground[np.arange(points), axis] = sign * half[axis] + random.normal(0.0, 0.2, points)
    ground[np.arange(points), 1 - axis] = along * half[1 - axis]
    ground[:, 2] = up
    normal = np.zeros((points, 3))
    normal[np.arange(points), axis] = sign
    angle = 2.0 * np.pi * np.arange(images) / images
    station = np.column_stack([34.0 * np.cos(angle), 24.0 * np.sin(angle), np.full(images, 4.0)])
    station += random.normal(0.0, 1.5, station.shape)
    target = np.column_stack([np.zeros((images, 2)), np.full(images, 9.0)])
    rotation = np.array([_looking(t - s) for s, t in zip(station, target, strict=True)])

    def taken(k: int, _: Array) -> Flags:
        towards = np.einsum("ni,ni->n", station[k] - ground, normal) > 2.0
        return np.asarray(towards & (random.random(points) < 0.22))

    return _network(
        "building", 24.0, (18.0, 14.0), 5e-3, station, rotation, ground,
        np.arange(points) % 200 == 0, taken,
    )  # fmt: skip


def _looking(direction: Array) -> Array:
    """Rotation of a camera with upright images that looks along a direction."""
    z = -direction / np.linalg.norm(direction)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def calibration() -> Block:
    """The network of a published camera calibration at its adjusted values."""
    result = adjust(completed(import_dbat(CAMCAL).network))
    return Block("calibration", at_adjusted_values(result), 3.3e-3)


def at_adjusted_values(result: Adjustment) -> Network:
    """The network with image coordinates that its adjusted values explain exactly."""
    network, state = result.network, result.state
    cameras = tuple(
        replace(camera, interior=state.interior[k]) for k, camera in enumerate(network.cameras)
    )
    network = replace(
        network,
        cameras=cameras,
        stations=replace(network.stations, position_m=state.station),
        attitudes=replace(network.attitudes, rotation=state.attitude),
        points=replace(network.points, xyz_m=state.points),
    )
    table = network.image_points
    weight = np.ones(len(table.image))
    for _ in range(20):
        rows = equations(network, result.layout, state, weight, derivatives=False)
        xy = table.xy_mm.copy()
        for axis in range(2):
            own = rows.group == axis
            xy[rows.source[own], axis] -= rows.misclosure[own] * rows.sigma[own]
        table = replace(table, xy_mm=xy)
        network = replace(network, image_points=table)
    return network


def with_others(block: Block, seed: int = 5) -> Block:
    """The block with GNSS positions, attitudes and distances, without errors."""
    random = np.random.default_rng(seed)
    network = block.network
    n, own = len(network.stations.names), np.arange(len(network.stations.names))
    rays = np.bincount(network.image_points.point, minlength=len(network.points.names))
    ends = random.choice(np.flatnonzero(rays >= MIN_RAYS), (24, 2), replace=False)
    xyz, zero = network.points.xyz_m, np.zeros((n, 3))
    length = np.linalg.norm(xyz[ends[:, 0]] - xyz[ends[:, 1]], axis=1)
    scale = float(np.median(np.linalg.norm(network.stations.position_m - xyz.mean(axis=0), axis=1)))
    gnss = Gnss(
        own, own, network.stations.position_m, np.full((n, 3), 5e-5 * scale), zero,
        np.full(n, -1), np.zeros(n),
    )  # fmt: skip
    return replace(
        block,
        network=replace(
            network,
            gnss=gnss,
            measured_attitudes=MeasuredAttitudes(
                own, network.attitudes.rotation, np.full((n, 3), 5e-5)
            ),
            distances=Distances(ends[:, 0], ends[:, 1], length, np.full(24, 5e-5 * scale)),
        ),
    )


def others_disturbed(network: Network, seed: int, share: float) -> tuple[Network, Excluded]:
    """Normal errors in GNSS positions, attitudes and distances; blunders where `share` is not 0."""
    random = np.random.default_rng(seed + 50_000)
    wrong = nothing_excluded(network)
    gnss, attitudes, distances = network.gnss, network.measured_attitudes, network.distances
    known = np.flatnonzero((np.nan_to_num(network.points.sigma_m) > 0.0).any(axis=1))
    if share:
        for flags, rows in (
            (wrong.control, known),
            (wrong.gnss, np.arange(len(gnss.station))),
            (wrong.attitude, np.arange(len(attitudes.attitude))),
            (wrong.distance, np.arange(len(distances.point_a))),
        ):
            chosen = random.choice(rows, len(rows) // ONE_OF, replace=False)
            flags[chosen, random.integers(0, flags.shape[1], len(chosen))] = True

    def error(sigma: Array, flags: Flags) -> Array:
        sign = random.choice((-1.0, 1.0), flags.shape)
        return sigma * (random.normal(0.0, 1.0, flags.shape) + OTHER_SIGMAS * sign * flags)

    turned = rotations_from_vectors(error(attitudes.sigma_rad, wrong.attitude))
    shifted = np.nan_to_num(network.points.sigma_m) * OTHER_SIGMAS * wrong.control
    return replace(
        network,
        points=replace(network.points, xyz_m=network.points.xyz_m + shifted),
        gnss=replace(gnss, position_m=gnss.position_m + error(gnss.sigma_m, wrong.gnss)),
        measured_attitudes=replace(attitudes, rotation=attitudes.rotation @ turned),
        distances=replace(
            distances,
            distance_m=distances.distance_m
            + error(distances.sigma_m[:, None], wrong.distance)[:, 0],
        ),
    ), wrong


def of_kinds(clean: Adjustment, wrong: Excluded, found: Excluded) -> dict[str, dict[str, int]]:
    """Blunders in other observations: planted, controllable, found, and innocent ones left out."""
    rows, detectable, report = clean.equations, reliability_of(clean).detectable, {}
    for name, groups in KINDS:
        planted, out = getattr(wrong, name), getattr(found, name)
        size = np.zeros(planted.shape)
        own = np.isin(rows.group, groups)
        with np.errstate(invalid="ignore"):
            over = OTHER_SIGMAS * rows.sigma[own] / (ABOVE_DETECTABLE * detectable[own])
        size[rows.source[own], rows.axis[own]] = over
        wanted = planted & (size > 1.0)
        report[name] = {
            "planted": int(planted.sum()),
            "controllable": int(wanted.sum()),
            "found": int((out & wanted).sum()),
            "uncontrollable_found": int((out & planted & ~wanted).sum()),
            "innocent_left_out": int((out & ~planted).sum()),
        }
    return report


def disturbed(block: Block, seed: int, share: float) -> tuple[Network, Array]:
    """Normal errors in all observations, and displacements of a share of the image points."""
    random = np.random.default_rng(seed)
    network = block.network
    table, points = network.image_points, network.points
    count = len(table.image)
    error = np.zeros((count, 2))
    wrong = random.choice(count, round(share * count), replace=False)
    angle = random.uniform(0.0, 2.0 * np.pi, len(wrong))
    size = BLUNDER_PX * block.pixel_mm
    error[wrong] = size * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    noise = random.normal(0.0, 1.0, (count, 2)) * table.sigma_mm
    ground = np.nan_to_num(points.sigma_m) * random.normal(0.0, 1.0, points.xyz_m.shape)
    return replace(
        network,
        image_points=replace(table, xy_mm=table.xy_mm + noise + error),
        points=replace(points, xyz_m=points.xyz_m + ground),
    ), error


def controllable(clean: Adjustment, error: Array) -> Flags:
    """Blunders above 1.5 times their own detectable bias in points of three rays or more.

    Rays that are blunders themselves do not count: two of three outvote the third.
    """
    rows, table = clean.equations, clean.network.image_points
    bias = np.full(error.shape, np.inf)
    found = reliability_of(clean).detectable
    for axis in range(2):
        own = rows.group == axis
        bias[rows.source[own], axis] = found[own]
    count = len(clean.network.points.names)
    good = np.bincount(table.point[(error == 0.0).all(axis=1)], minlength=count)
    rays = good + 1
    large = (np.abs(error) > ABOVE_DETECTABLE * bias).any(axis=1)
    return np.asarray(large & (rays[table.point] >= MIN_RAYS))


def search(block: Block, settings: AdjustmentSettings, seeds: int) -> dict[str, Any]:
    """Blunders of several runs: planted, above the limit, found; innocent points left out."""
    counts = dict.fromkeys(("planted", "controllable", "found", "uncontrollable_found"), 0)
    innocent, rounds, seconds, problems = 0, 0, 0.0, 0
    kinds: dict[str, Counter[str]] = {name: Counter() for name, _ in KINDS}
    for seed in range(seeds):
        undisturbed, _ = disturbed(block, seed, 0.0)
        network, error = disturbed(block, seed, SHARE)
        wrong_others = nothing_excluded(network)
        if len(network.distances.point_a):
            undisturbed, _ = others_disturbed(undisturbed, seed, 0.0)
            network, wrong_others = others_disturbed(network, seed, SHARE)
        clean = adjust(undisturbed, replace(settings, robust=False))
        wrong = (error != 0.0).any(axis=1)
        wanted = controllable(clean, error)
        begun = time.process_time()
        result = adjust(network, settings)
        seconds += time.process_time() - begun
        counts["planted"] += int(wrong.sum())
        counts["controllable"] += int(wanted.sum())
        # What was left alone in its object point does not take part either.
        out = result.rejected | result.left_out[network.image_points.point]
        counts["found"] += int((out & wanted).sum())
        counts["uncontrollable_found"] += int((out & wrong & ~wanted).sum())
        innocent += int((result.rejected & ~wrong).sum())
        for name, own in of_kinds(clean, wrong_others, result.excluded).items():
            kinds[name].update(own)
        rounds = max(rounds, result.rounds)
        problems += len(result.problems)
    return counts | {
        "share_found": counts["found"] / counts["controllable"],
        "innocent_left_out": innocent,
        "rounds_max": rounds,
        "cpu_s_per_run": round(seconds / seeds, 2),
        "problems": problems,
        "others": {name: dict(own) for name, own in kinds.items()},
    }


def false_alarms(block: Block, settings: AdjustmentSettings, runs: int) -> dict[str, Any]:
    """Blocks without blunders of which data snooping leaves anything out."""
    assert settings.significance is not None
    alarms = 0
    for seed in range(runs):
        network, _ = disturbed(block, 10_000 + seed, 0.0)
        alarms += adjust(network, settings).excluded.count > 0
    low, high = stats.binom.interval(0.999, runs, settings.significance)
    return {
        "runs": runs,
        "alarms": alarms,
        "expected": runs * settings.significance,
        "interval": [int(low), int(high)],
        "inside": bool(low <= alarms <= high),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.blunder_search", description=__doc__
    )
    parser.add_argument("--seeds", type=int, default=3, help="Runs with blunders (default: 3).")
    parser.add_argument("--runs", type=int, default=60, help="Runs without (default: 60).")
    parser.add_argument("--significance", type=float, default=0.05)
    parser.add_argument("--test", choices=("pope", "baarda"), default="pope")
    parser.add_argument(
        "--weight-function", choices=("none", "huber", "cauchy", "tukey", "danish"), default="none"
    )
    parser.add_argument("--large", action="store_true", help="The block of 256,000 coordinates.")
    parser.add_argument("--others", action="store_true", help="Blunders in other observations.")
    options = parser.parse_args()
    robust: WeightFunction = (
        "huber" if options.weight_function == "none" else options.weight_function
    )
    settings = AdjustmentSettings(
        significance=options.significance,
        test=options.test,
        robust=options.weight_function != "none",
        weight_function=robust,
    )
    report: dict[str, Any] = {"machine": machine(), "options": vars(options)}
    blocks = (
        [around_building(points=LARGE)]
        if options.large
        else [aerial_lines(), around_building(), calibration()]
    )
    for plain_block in blocks:
        # Object coordinates of the calibration's network are in no unit of length.
        is_other = options.others and plain_block.name != "calibration"
        block = with_others(plain_block) if is_other else plain_block
        table = block.network.image_points
        report[block.name] = {
            "image_points": len(table.image),
            "blunders": search(block, settings, options.seeds),
        }
        if options.runs:
            plain = replace(settings, robust=False)
            report[block.name]["false_alarms"] = false_alarms(block, plain, options.runs)
        print(json.dumps({block.name: report[block.name]}), flush=True)
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()

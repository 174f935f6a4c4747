"""`python -m benchmarks.uncertainty_consistency`: compare stated accuracy with true errors.

Stitches exposures rendered by the emulator and exposures whose tie points are drawn with the errors
measured on the rendered ones, and holds every error against the covariance stated for it. Truth,
relief and errors of calibration, drift, mounting and probes are the emulator's.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks import rendered
from benchmarks.stitching_samples import (
    MatchingErrors,
    StitchedSample,
    check_points,
    drawn_sample,
    matching_errors,
    put_px,
    rendered_sample,
    true_px,
    world_and_rig,
)
from daemon.cli.benchmark.measurement import machine
from processing.mosaic.precision import datum_covariance, placed_covariance_px
from processing.pipelines.stitched import Pipeline, PipelineSettings
from sim_hw.world.scene import open_scene
from sim_hw.world.snapshots import RigElectronics
from sim_hw.world.world import World

Array = NDArray[np.float64]

RIG = "ultracam-x-mini"
LARGEST_DC_K = 20.0
PLACES = 8
SCENES = 2
FIRST_SEED = 1000
SEEDS_OF_SCENE = 4000
REFERENCE_SHARE = 0.03
"""Of the errors of matching, where they should be out of the way."""
_RANK_TOLERANCE = 1e-7


@dataclass(frozen=True)
class NormalizedErrors:
    """Errors of one exposure against their covariance.

    `whitened` (rank,) is standard normal where the covariance is right; `normalised` (n,) are
    single errors over their own sigma; `error_px`, `sigma_px` their root mean squares.
    """

    whitened: Array
    normalised: Array
    error_px: float
    sigma_px: float


@dataclass(frozen=True)
class Pooled:
    """What many exposures say together; the interval holds 99.9 % of chi-square."""

    exposures: int
    rank: int
    mean_square: float
    low: float
    high: float
    inside_2: float
    inside_3: float
    largest: float
    error_px: float
    sigma_px: float

    @property
    def is_consistent(self) -> bool:
        return self.low <= self.mean_square <= self.high and self.inside_3 >= 0.99


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.uncertainty_consistency")
    parser.add_argument("--rendered", type=int, default=48, help="exposures to render")
    parser.add_argument("--drawn", type=int, default=200, help="exposures with drawn tie points")
    parser.add_argument("--save-errors", type=Path, help="where to keep the errors of matching")
    parser.add_argument(
        "--save-exposures", type=int, default=40, help="how many exposures' errors to keep"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="syntopic-honest-") as folder:
        samples = render(options.rendered, Path(folder))
    errors = matching_errors(samples)
    if options.save_errors is not None:
        matching_errors(samples[: options.save_exposures]).save(options.save_errors)
    pools = {
        f"rendered, {name}": pooled(normalized_errors)
        for name, normalized_errors in normalize_samples(samples).items()
    }
    drawn_pairs = [draw(errors, k) for k in range(options.drawn)]
    found = normalize_samples([noisy for noisy, _ in drawn_pairs])
    found["parameters, in the datum of the exposure"] = [parameters(*pair) for pair in drawn_pairs]
    pools |= {
        f"drawn, {name}": pooled(normalized_errors) for name, normalized_errors in found.items()
    }
    if options.json:
        print(json.dumps({"machine": machine(), **{n: vars(p) for n, p in pools.items()}}))
        return
    print(
        f"| {RIG} | exposures | rank | mean e'S⁻¹e / rank | 99.9 % interval | in 2 sigma "
        "| in 3 sigma | largest | error px | stated px |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name, p in pools.items():
        print(
            f"| {name} | {p.exposures} | {p.rank} | {p.mean_square:.3f} | {p.low:.3f} .. "
            f"{p.high:.3f} | {p.inside_2:.2%} | {p.inside_3:.2%} | {p.largest:.2f} | "
            f"{p.error_px:.4f} | {p.sigma_px:.4f} |"
        )


def render(count: int, scenes: Path) -> list[StitchedSample]:
    """Exposures along a line over each scene, each by a camera of its own, dC from +-20 K."""
    return [
        sample
        for number in range(SCENES)
        for sample in _over_scene(number, (count + SCENES - 1 - number) // SCENES, scenes)
    ]


def _over_scene(number: int, count: int, scenes: Path) -> list[StitchedSample]:
    first = World(rendered.world_settings(RIG, 1 + number, exposures=PLACES))
    scene = open_scene(first.scene_settings, scenes)
    heads = RigElectronics(first, seed=1)
    settings = PipelineSettings(geometry=False, threads=len(os.sched_getaffinity(0)))
    pipeline = Pipeline(first.rig, rendered.radiometry_of(heads), settings)
    samples = []
    for k in range(count):
        seed = SEEDS_OF_SCENE * number + k
        world, _ = world_and_rig(RIG, FIRST_SEED + seed, dc_k=_dc_k(seed), exposures=PLACES)
        samples.append(
            rendered_sample(world, pipeline, heads, scene, seed=FIRST_SEED + seed, place=k % PLACES)
        )
    return samples


def draw(errors: MatchingErrors, number: int) -> tuple[StitchedSample, StitchedSample]:
    """One exposure with the errors of matching, and the same all but without."""
    seed = 2 * FIRST_SEED + number
    world, rig = world_and_rig(RIG, seed, dc_k=_dc_k(seed))
    noisy = drawn_sample(world, rig, errors, seed=seed)
    return noisy, drawn_sample(world, rig, errors, seed=seed, share=REFERENCE_SHARE)


def normalize_samples(samples: Sequence[StitchedSample]) -> dict[str, list[NormalizedErrors]]:
    """Check points after a best-fit similarity, as they are, and the datum: shift, scale, turn."""
    found: dict[str, list[NormalizedErrors]] = {
        "check points, inner": [],
        "datum": [],
        "check points, absolute": [],
    }
    for sample in samples:
        points = check_points(sample.rig)
        placed = put_px(sample, sample.mosaic, points)
        up = np.array([1.0, -1.0])
        error = ((placed - true_px(sample, points)) * up).reshape(-1)
        tie, datum = placed_covariance_px(sample.rig, sample.mosaic, points, sample.probes_c)
        image = sample.world.image
        middle = np.array([image.width_px - 1, image.height_px - 1]) / 2.0
        similarity = _similarity((placed - middle) * up * image.pitch_mm)
        fit = np.linalg.pinv(similarity)
        inner = np.eye(len(error)) - similarity @ fit
        found["check points, inner"].append(normalized_errors(inner @ error, inner @ tie @ inner.T))
        of_datum = datum_covariance(sample.rig, sample.mosaic, sample.probes_c)
        found["datum"].append(normalized_errors(fit @ error, fit @ tie @ fit.T + of_datum))
        found["check points, absolute"].append(normalized_errors(error, tie + datum))
    return found


def parameters(noisy: StitchedSample, exact: StitchedSample) -> NormalizedErrors:
    """All unknowns against those that all but error-free points give in the same datum.

    Where a sensor was found displaced the datum may differ; the adjustments over all master sensors
    are compared.
    """
    units = noisy.equal.model.units
    covariance = noisy.equal.covariance / np.outer(units, units)
    return normalized_errors((noisy.equal.values - exact.equal.values) / units, covariance)


def normalized_errors(error: Array, covariance: Array) -> NormalizedErrors:
    """Errors (n,) against their covariance (n, n), which may be singular."""
    sigma = np.sqrt(np.diag(covariance))
    # Shift, scale and rotation have units of their own.
    balanced = covariance / np.outer(sigma, sigma)
    values, directions = np.linalg.eigh(balanced)
    good = values > _RANK_TOLERANCE * values[-1]
    whitened = (directions[:, good].T @ (error / sigma)) / np.sqrt(values[good])
    return NormalizedErrors(
        whitened=whitened,
        normalised=error / sigma,
        error_px=float(np.sqrt(np.mean(error**2))),
        sigma_px=float(np.sqrt(np.mean(sigma**2))),
    )


def pooled(some: Sequence[NormalizedErrors]) -> Pooled:
    """All exposures together."""
    whitened = np.concatenate([h.whitened for h in some])
    normalised = np.abs(np.concatenate([h.normalised for h in some]))
    low, high = (float(chi2.ppf(p, len(whitened))) / len(whitened) for p in (0.0005, 0.9995))
    return Pooled(
        exposures=len(some),
        rank=round(len(whitened) / len(some)),
        mean_square=float(np.mean(whitened**2)),
        low=low,
        high=high,
        inside_2=float(np.mean(normalised < 2.0)),
        inside_3=float(np.mean(normalised < 3.0)),
        largest=float(normalised.max()),
        error_px=float(np.sqrt(np.mean([h.error_px**2 for h in some]))),
        sigma_px=float(np.sqrt(np.mean([h.sigma_px**2 for h in some]))),
    )


def _dc_k(seed: int) -> float:
    return float(np.random.default_rng([seed, 1]).uniform(-LARGEST_DC_K, LARGEST_DC_K))


def _similarity(xy_mm: Array) -> Array:
    """How shift, scale and rotation move points: (2 n, 4)."""
    design = np.zeros((2 * len(xy_mm), 4))
    design[0::2, 0], design[1::2, 1] = 1.0, 1.0
    design[0::2, 2], design[1::2, 2] = xy_mm[:, 0], xy_mm[:, 1]
    design[0::2, 3], design[1::2, 3] = -xy_mm[:, 1], xy_mm[:, 0]
    return design


if __name__ == "__main__":
    main()

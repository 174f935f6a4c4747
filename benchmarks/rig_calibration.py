"""`python -m benchmarks.rig_calibration`: relative orientations against truth, over many blocks.

The block of Jacobsen (2008), every image oriented for itself, averaged as `syntopic calibrate rig`
does; errors are compared with their covariance. `--project` writes block 1 for the command.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks.midas_block import network_of
from daemon.cli.benchmark.measurement import machine
from daemon.postflight.adjustment.project import CheckPoints
from daemon.postflight.adjustment.project_file import ProjectFile
from daemon.postflight.adjustment.project_writer import write_project
from processing.bundle.adjust import adjust
from processing.bundle.network import Network
from processing.calibration.relative_orientation import RelativeOrientations, relative_orientations
from processing.geometry.rotation import vectors_from_rotations
from sim_hw.blocks.oblique import (
    HEADS,
    NADIR,
    PIXEL_MM,
    TABLE_2_GRAD,
    ObliqueBlock,
    simulate_oblique_block,
)

Array = NDArray[np.float64]

EVERY = tuple(range(len(HEADS)))
MGRAD = 200e3 / np.pi


def evaluate(seed: int, *, own: bool = True) -> tuple[RelativeOrientations, Array, float]:
    """One block: what was found, errors (h, 3) about the heads' axes, squares in the covariance."""
    block = simulate_oblique_block(seed)
    found = relative_orientations(adjust(network_of(block, EVERY, own=own)), NADIR)
    error = error_of(found, block)
    return found, error, float(error.ravel() @ np.linalg.solve(found.covariance, error.ravel()))


def error_of(found: RelativeOrientations, block: ObliqueBlock) -> Array:
    truth = [block.head_rotation[HEADS.index(head.head)] for head in found.heads]
    return vectors_from_rotations(
        np.array([t.T @ head.rotation for t, head in zip(truth, found.heads, strict=True)])
    )


def write_block(folder: Path, *, seed: int = 1) -> None:
    """The block as an adjustment project, as somebody would hand it over."""
    network = network_of(simulate_oblique_block(seed), EVERY, own=True)
    network = _named_as_projects_are(network)
    file = ProjectFile.model_validate(
        {
            "format": 1,
            "name": f"block of Jacobsen (2008), seed {seed}",
            "camera": [
                {"name": c.name, "f_mm": c.f_mm, "pixel_um": PIXEL_MM * 1e3, "free": sorted(c.free)}
                for c in network.cameras
            ],
        }
    )
    nothing = np.zeros((0, 3))
    write_project(folder, file, network, CheckPoints((), nothing, nothing))


def _named_as_projects_are(network: Network) -> Network:
    """Attitudes of single images carry the name by which the writer recognizes them."""
    names = tuple(f"image {name}" for name in network.attitudes.names)
    return replace(network, attitudes=replace(network.attitudes, names=names))


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.rig_calibration", description=__doc__
    )
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--project", type=Path, help="write block 1 as a project and stop")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    if options.project is not None:
        write_block(options.project)
        return
    runs = [evaluate(seed) for seed in range(1, options.seeds + 1)]
    rank = sum(3 * len(r[0].heads) for r in runs)
    low, high = (float(chi2.ppf(q, rank)) / rank for q in (0.0005, 0.9995))
    ratio = np.concatenate(
        [(np.abs(e) / np.sqrt(np.diag(f.covariance)).reshape(-1, 3)).ravel() for f, e, _ in runs]
    )
    output: dict[str, Any] = {
        "machine": machine(),
        "seeds": options.seeds,
        "squares_per_rank": sum(r[2] for r in runs) / rank,
        "bounds": [low, high],
        "within_3_sigma": float(np.mean(ratio < 3.0)),
        "largest": float(ratio.max()),
        "single_exposures": float(np.mean([r[0].squares for r in runs])),
    }
    if options.json:
        print(json.dumps(output))
        return
    print(
        f"{options.seeds} blocks: squares per rank {output['squares_per_rank']:.3f} ({low:.3f} to "
        f"{high:.3f} holds 99.9 %), {100 * output['within_3_sigma']:.1f} % within 3 sigma, largest "
        f"{output['largest']:.1f}; single exposures about the averages "
        f"{output['single_exposures']:.2f} of their variance"
    )
    found = runs[0][0]
    for k, head in enumerate(found.heads):
        angles, sigma = found.angles(k)
        listed = " ".join(f"{v * MGRAD / 1e3:9.4f}" for v in angles)
        own = " ".join(f"{v * MGRAD:.1f}" for v in sigma)
        paper = " ".join(f"{v:9.4f}" for v in TABLE_2_GRAD[head.head])
        print(f"  head {head.head:3} {listed} grad, sigma {own} mgrad, mounted {paper}")


if __name__ == "__main__":
    main()

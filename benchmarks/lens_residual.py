"""How much truer a stitched image is with the residual grid of its lenses than without.

Every PAN lens of a rig gets a ripple that the ten parameters do not describe. An exposure is
rendered through it; it is stitched with a grid as a collimator would find it, and with none.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.calibration.rig_writer import rig_toml
from processing.geometry.residual_grid import ResidualGrid, fit_residual_grid
from processing.rig import Cone, LensGrid, Rig, find_rig

TARGETS, NODES = 400, (17, 13)
TARGET_SIGMA_UM = 0.1
RENDER_TIMEOUT_S = 1800


def ripple_um(xy_mm: NDArray[np.float64], half_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """One micrometre at most, five waves over the image."""
    x, y = np.moveaxis(2.5 * np.pi * xy_mm / half_mm, -1, 0)
    return np.stack([np.sin(x + 0.4) * np.cos(0.8 * y), np.cos(0.7 * x) * np.sin(y - 0.7)], axis=-1)


def lens_grids(cone: Cone, seed: int) -> tuple[LensGrid, LensGrid]:
    """What is planted in a lens, dense, and what is found of it at some targets."""
    sensor = cone.sensors[0]
    half = np.array([sensor.width_px, sensor.height_px]) * sensor.pitch_mm / 2.0
    x, y = (np.linspace(-1.02 * h, 1.02 * h, 61) for h in half)
    dense = ripple_um(np.stack(np.meshgrid(x, y), axis=-1), half) * 1e-3
    random = np.random.default_rng(seed)
    at = random.uniform(-1.0, 1.0, (TARGETS, 2)) * half
    seen = ripple_um(at, half) + random.normal(0.0, TARGET_SIGMA_UM, (TARGETS, 2))
    found = fit_residual_grid(at, seen * 1e-3, half_mm=(half[0], half[1]), nodes=NODES)
    return ResidualGrid(x, y, dense).as_lens_grid(), found.as_lens_grid()


def rigs(name: str) -> dict[str, Rig]:
    """The rig that flies, and what is known of it: with the grid found, and with none."""
    rig = find_rig(name)
    cones_by_kind = {"true": [], "with": [], "without": []}  # type: dict[str, list[Cone]]
    for k, cone in enumerate(rig.cones):
        dense, found = lens_grids(cone, k) if cone.role == "pan" else (None, None)
        for kind, grid in (("true", dense), ("with", found), ("without", None)):
            cones_by_kind[kind].append(replace(cone, lens=replace(cone.lens, residual_grid=grid)))
    return {kind: replace(rig, cones=tuple(cones)) for kind, cones in cones_by_kind.items()}


def measure(name: str, out: Path) -> dict[str, Any]:
    """Render one exposure, stitch it both ways, hold both against the truth."""
    known = rigs(name)
    out.mkdir(parents=True, exist_ok=True)
    (out / "true.toml").write_bytes(rig_toml(known["true"]))
    _run("sim_hw.processes.exposures", str(out / "true.toml"), "--out", str(out), "--dc", "12")
    found: dict[str, Any] = {"rig": name}
    for kind in ("with", "without"):
        (out / "mission/rig.toml").write_bytes(rig_toml(known[kind]))
        output = _run("daemon", "process", str(out / "mission"), "--json")
        evaluation = _run(
            "sim_hw.truth_comparison",
            "--mission",
            str(out / "mission"),
            "--truth",
            str(out / "truth"),
        )
        figures = json.loads(output)["exposures"][0]["figures"]
        found[kind] = json.loads(evaluation)["methods"]["free"] | {
            "sigma0_px": figures["sigma0_px"]
        }
    return found


def _run(module: str, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments],
        capture_output=True, text=True, timeout=RENDER_TIMEOUT_S, check=False,
    )  # fmt: skip
    if done.returncode != 0:
        raise SystemExit(f"{module} failed: {done.stderr[-1000:]}")
    return done.stdout


def main() -> None:
    """The command line."""
    line = argparse.ArgumentParser(prog="python -m benchmarks.lens_residual", description=__doc__)
    line.add_argument("rig", nargs="?", default="dmc-mini", help="a rig of single-CCD PAN heads")
    line.add_argument("--out", type=Path, required=True, help="an empty folder to work in")
    arguments = line.parse_args()
    os.nice(10)
    print(json.dumps(measure(arguments.rig, arguments.out), indent=1))


if __name__ == "__main__":
    main()

"""`python -m benchmarks.midas_block`: the block of Jacobsen (2008), repeated with its tables.

Bundle adjustment of all images with the heads' relative orientation, relative orientations averaged
over the block (table 2), boresight, and combined intersection from direct orientation, held against
points the adjustment did not know.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.cli.benchmark.measurement import machine
from processing.bundle.adjust import Adjustment, adjust
from processing.bundle.adjustment_results import control_residuals, heads_of
from processing.bundle.initial_values import completed
from processing.bundle.network import (
    Attitudes,
    CameraModel,
    Gnss,
    HeadMounting,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)
from processing.bundle.point_intersection import (
    intersect_points,
    orientation_layout,
    propagated_covariance,
)
from processing.calibration.relative_orientation import relative_orientations
from processing.geometry.rotation import (
    phi_omega_kappa,
    rotations_from_vectors,
    vectors_from_rotations,
)
from sim_hw.blocks.oblique import (
    F_MM,
    HALF_HEIGHT_MM,
    HALF_WIDTH_MM,
    HEADS,
    NADIR,
    PIXEL_MM,
    ObliqueBlock,
    simulate_oblique_block,
    table_2_rotation,
)

Array = NDArray[np.float64]

FREE = frozenset({"dx0", "dy0", "df", "k1", "k2"})
PAPER = {"table 1": "sigma0 11 um, RMS 0.15 m, 1.60 m", "intersection": (0.62, 0.60, 1.63)}
MIN_POINTS = 10
START_ROTATION_RAD = 0.01
"""How far the mounting is thought to be from where it is, and the inertial unit from the camera."""


@dataclass(frozen=True)
class BlockResult:
    """What came out of one block."""

    figures: dict[str, Any]
    oblique: Adjustment
    differences_m: Array
    sigma_m: Array
    true_error_m: Array
    true_sigma_m: Array


def network_of(block: ObliqueBlock, heads: tuple[int, ...], *, own: bool) -> Network:
    """The block for an adjustment.

    Args:
        block: flown.
        heads: which of the five.
        own: whether each image has an attitude of its own and only the projection centre in common,
            as the paper's program has it, or the exposure's attitude turned by its head.
    """
    n, k = len(block.station), len(heads)
    # Images at the border that hardly see the block are not used, as in the paper.
    places = np.unique(np.stack([block.point, block.image // 5]), axis=1)[0]
    tied = np.bincount(places, minlength=len(block.points))[block.point] >= 2
    seen = np.bincount(block.image[tied], minlength=5 * n)
    table = np.isin(block.image % 5, heads) & (seen[block.image] >= MIN_POINTS)
    of_head = {h: i for i, h in enumerate(heads)}
    image_of = np.array(
        [(i // 5) * k + of_head[i % 5] if i % 5 in of_head else -1 for i in range(5 * n)]
    )
    exposure = np.repeat(np.arange(n), k)
    head = np.tile(np.arange(k), n)
    start = (
        block.inertial
        @ block.boresight
        @ rotations_from_vectors(np.full((n, 3), START_ROTATION_RAD / 2))
    )
    mounted = [table_2_rotation(HEADS[h]) for h in heads]
    names = tuple(f"{e}-{HEADS[h]}" for e in range(n) for h in heads)
    attitudes = np.array([start[e] @ mounted[h] for e, h in zip(exposure, head, strict=True)])
    exposures = tuple(f"e{e}" for e in range(n))
    points = len(block.points)
    sigma, xyz = np.full((points, 3), np.nan), np.full((points, 3), np.nan)
    spread = block.noise.control_m
    sigma[: block.control] = [spread[0], spread[0], spread[1]]
    xyz[: block.control] = block.surveyed_m[: block.control]
    noise = np.where(block.image[table] % 5 == 0, *block.noise.image_mm)
    gnss = block.noise.gnss_m
    return completed(
        Network(
            cameras=tuple(
                CameraModel(HEADS[h], F_MM[HEADS[h]], free=FREE, pixel_mm=PIXEL_MM) for h in heads
            ),
            heads=()
            if own
            else tuple(
                HeadMounting(
                    HEADS[h], table_2_rotation(HEADS[h]), np.zeros(3), rotation_free=h != 0
                )
                for h in heads
            ),
            stations=Stations(exposures, block.gnss_m, np.zeros(n, bool)),
            attitudes=Attitudes(names, attitudes, np.zeros(n * k, bool))
            if own
            else Attitudes(exposures, start, np.zeros(n, bool)),
            images=Images(
                names,
                exposure,
                np.arange(n * k) if own else exposure,
                head,
                np.full(n * k, -1) if own else head,
            ),
            points=Points(
                tuple(f"p{p}" for p in range(points)), xyz, sigma, np.zeros(points, bool)
            ),
            image_points=ImagePoints(
                image_of[block.image[table]],
                block.point[table],
                block.xy_mm[table],
                np.stack([noise, noise], axis=1),
            ),
            gnss=Gnss(
                station=np.arange(n),
                attitude=np.arange(n),
                position_m=block.gnss_m,
                sigma_m=np.full((n, 3), gnss),
                lever_m=np.zeros((n, 3)),
                line=block.line,
                time_s=block.time_s,
                lines=("line 1", "line 2", "line 3"),
            ),
        )
    )


def run_block(seed: int) -> BlockResult:
    """Fly, adjust, calibrate and intersect once."""
    block = simulate_oblique_block(seed)
    nadir = adjust(network_of(block, (0,), own=False))
    separate = adjust(network_of(block, (0, 1, 2, 3, 4), own=True))
    oblique = adjust(network_of(block, (0, 1, 2, 3, 4), own=False))
    averaged = {h.head: h for h in relative_orientations(separate, NADIR).heads}
    boresight = _boresight(block, oblique)
    direct = block.inertial @ boresight
    network = oblique.network
    network = replace(
        network,
        stations=replace(network.stations, position_m=block.gnss_m),
        attitudes=replace(network.attitudes, rotation=direct),
        cameras=tuple(
            replace(c, interior=v)
            for c, v in zip(network.cameras, oblique.state.interior, strict=True)
        ),
        heads=tuple(
            replace(h, rotation=r)
            for h, r in zip(network.heads, oblique.state.head_rotation, strict=True)
        ),
        points=replace(network.points, xyz_m=oblique.state.points),
    )
    layout = orientation_layout(network)
    covariance = propagated_covariance(
        layout,
        oblique,
        position_m=np.full(3, block.noise.gnss_m),
        attitude_rad=np.array(block.noise.inertial_rad),
    )
    found = intersect_points(network, layout, covariance)
    rows = slice(block.control, block.control + block.checks)
    good = np.isfinite(found.xyz_m[rows]).all(axis=1)
    own = found.covariance_m2[rows][good]
    true_error = (found.xyz_m[rows] - block.points[rows])[good]
    differences = (found.xyz_m[rows] - block.surveyed_m[rows])[good]
    spread = block.noise.control_m
    survey = np.diag(np.array([spread[0], spread[0], spread[1]]) ** 2)
    sigma = np.sqrt(np.einsum("nii->ni", own + survey))
    normalised = true_error / np.sqrt(np.einsum("nii->ni", own))
    figures: dict[str, Any] = {
        "nadir": _block_figures(nadir),
        "all": _block_figures(oblique),
        "separate": _block_figures(separate),
        "heads": {
            h.name: {
                "phi_omega_kappa_grad": _phi_omega_kappa_grad(oblique.state.head_rotation[k]),
                "sigma_mgrad": [float(v) * 200e3 / np.pi for v in _head_sigma(oblique, k)],
                "averaged_spread_mgrad": [
                    float(v) * 200e3 / np.pi for v in averaged[h.name].spread_rad
                ],
                "averaged_less_adjusted_mgrad": [
                    float(v) * 200e3 / np.pi
                    for v in vectors_from_rotations(
                        (oblique.state.head_rotation[k].T @ averaged[h.name].rotation)[None]
                    )[0]
                ],
                "error_mgrad": [
                    float(v) * 200e3 / np.pi
                    for v in vectors_from_rotations(
                        (block.head_rotation[k].T @ oblique.state.head_rotation[k])[None]
                    )[0]
                ],
            }
            for k, h in enumerate(heads_of(oblique))
            if h.name != NADIR
        },
        "checks": int(good.sum()),
        "rms_m": [float(v) for v in np.sqrt(np.mean(differences**2, axis=0))],
        "predicted_m": [float(v) for v in np.sqrt(np.mean(sigma**2, axis=0))],
        "true_rms_m": [float(v) for v in np.sqrt(np.mean(true_error**2, axis=0))],
        "true_predicted_m": [float(v) for v in np.sqrt(np.mean(np.einsum("nii->ni", own), axis=0))],
        "largest_normalised": float(np.abs(normalised).max()),
        "rays_per_check": float(
            np.bincount(block.point, minlength=len(block.points))[rows][good].mean()
        ),
    }
    return BlockResult(
        figures, oblique, differences, sigma, true_error, np.sqrt(np.einsum("nii->ni", own))
    )


def _boresight(block: ObliqueBlock, result: Adjustment) -> Array:
    """Inertial unit from rig, averaged over the exposures."""
    relative = np.einsum("nji,njk->nik", block.inertial, result.state.attitude)
    mean = relative[0]
    for _ in range(5):
        off = vectors_from_rotations(np.einsum("ji,njk->nik", mean, relative))
        mean = mean @ rotations_from_vectors(off.mean(axis=0))
    return np.asarray(mean)


def _head_sigma(result: Adjustment, head: int) -> Array:
    columns = result.layout.head_rotation[head]
    return np.asarray(result.sigma0 * np.sqrt(np.diag(result.cofactor)[columns]))


def _phi_omega_kappa_grad(r: Array) -> list[float]:
    """Angles of R = Ry(phi) Rx(omega) Rz(kappa), grads, as the paper lists them."""
    return [float(a) * 200.0 / np.pi for a in phi_omega_kappa(r)]


def _block_figures(result: Adjustment) -> dict[str, Any]:
    residual = {g.name: g for g in result.groups}
    control = control_residuals(result)
    return {
        "sigma0": result.sigma0,
        "image_rms_um": float(
            np.sqrt((residual["image x"].rms ** 2 + residual["image y"].rms ** 2) / 2.0)
        )
        * 1e3,
        "redundancy": result.redundancy,
        "control_rms_m": [float(v) for v in control.rms_m],
        "unknowns": result.unknowns,
    }


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.midas_block", description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    found = [run_block(seed) for seed in range(1, options.seeds + 1)]
    pooled = np.concatenate([(r.true_error_m / r.true_sigma_m).ravel() for r in found])
    rms = np.sqrt(np.mean(np.concatenate([r.differences_m for r in found]) ** 2, axis=0))
    predicted = np.sqrt(np.mean(np.concatenate([r.sigma_m for r in found]) ** 2, axis=0))
    if options.json:
        print(json.dumps({"machine": machine(), "seeds": [r.figures for r in found]}))
        return
    f = found[0].figures
    print(f"frame {2 * HALF_WIDTH_MM:.2f} x {2 * HALF_HEIGHT_MM:.2f} mm, seed 1:")
    for key in ("nadir", "all", "separate"):
        b = f[key]
        control = " ".join(f"{v:.2f}" for v in b["control_rms_m"])
        print(
            f"  {key:9} image RMS {b['image_rms_um']:.1f} um, sigma0 {b['sigma0']:.3f}, control "
            f"RMS {control} m, redundancy {b['redundancy']}, unknowns {b['unknowns']}"
        )
    for name, h in f["heads"].items():
        angles = " ".join(f"{v:9.4f}" for v in h["phi_omega_kappa_grad"])
        sigma = " ".join(f"{v:.1f}" for v in h["sigma_mgrad"])
        spread = " ".join(f"{v:.1f}" for v in h["averaged_spread_mgrad"])
        print(
            f"  head {name:3} {angles} grad, sigma {sigma} mgrad, single exposures {spread} mgrad"
        )
    checks = sum(r.figures["checks"] for r in found)
    print(
        f"intersection, {options.seeds} seeds, {checks} check points: RMS {rms[0]:.2f} "
        f"{rms[1]:.2f} {rms[2]:.2f} m, predicted {predicted[0]:.2f} {predicted[1]:.2f} "
        f"{predicted[2]:.2f} m (paper 0.62 0.60 1.63 m); against truth "
        f"{np.mean(pooled**2):.2f} of the predicted variance, "
        f"{100 * np.mean(np.abs(pooled) < 3.0):.1f} % within 3 sigma, largest "
        f"{np.abs(pooled).max():.1f}"
    )


if __name__ == "__main__":
    main()

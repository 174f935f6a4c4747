"""Healthy exposures drawn without rendering, and how many of them change a verdict.

Adjusted unknowns are drawn from the stated covariance of rendered exposures, with calibration,
mountings and probes off by their sigmas; residual fields are drawn class by class, neighbours
erring alike. All go through the judgement of the pipeline.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.silent_errors.exposures import remeasured
from benchmarks.silent_errors.limits import DMC, L, X
from processing.mosaic.estimated_dc import estimate_dc
from processing.mosaic.free_mosaic import Mosaic
from processing.mosaic.layers import check_layers
from processing.mosaic.mounting import check_platform, place_covariance, rotation_of_layer
from processing.mosaic.readout_slips import find_slips
from processing.mosaic.stitch_record import layer_scale_design
from processing.mosaic.validity import evaluate_master
from processing.pipelines.stitched import Product
from processing.quality.report import Thresholds
from processing.rig import Cone, Rig

Array = NDArray[np.float64]
Random = np.random.Generator

RIG_SEQUENCE: Final = (X, X, X, X, X, L, DMC)
"""The rig of each drawn exposure in turn."""
PROGRESS: Final = 100
"""Drawn exposures from one line of progress to the next."""
PROBE_SIGMA_K: Final = 0.1
LARGEST_DC_K: Final = 15.0
CORRELATED_PX: Final = 60.0
"""Tie points of a cell of this side in the first frame share a part of their error."""
CORRELATED_SHARE: Final = 0.3
"""Of the variance of a residual."""


@dataclass(frozen=True)
class Template:
    """A rendered exposure that others are drawn after; `root` is that of its covariance."""

    rig: Rig
    product: Product
    root: Array


def template(rig: str) -> Template:
    """An exposure of a rig, rendered and processed."""
    emulated = remeasured(rig, 0, 7)
    product = emulated.process()
    assert isinstance(product, Product)
    mosaic = product.free
    units = mosaic.model.units
    values, directions = np.linalg.eigh(mosaic.covariance / np.outer(units, units))
    root = units[:, None] * (directions * np.sqrt(np.maximum(values, 0.0)))
    return Template(emulated.rig, product, root)


def false_alarms(count: int, seed: int, file: Path | None = None) -> Counter[str]:
    """How many of `count` drawn exposures change a verdict, by finding; `any` counts exposures.

    Args:
        count: exposures.
        seed: for all random generators.
        file: of outcomes, one JSON object a line; exposures that are in it are not drawn again.

    Returns:
        Exposures by finding.
    """
    known = set()
    found: Counter[str] = Counter({"any": 0})
    if file is not None and file.exists():
        for row in map(json.loads, file.read_text().splitlines()):
            if row["seed"] == seed and row["number"] < count:
                known.add(row["number"])
                found.update(row["alarms"])
                found["any"] += bool(row["alarms"])
    templates = {rig: template(rig) for rig in dict.fromkeys(RIG_SEQUENCE)}
    for number in range(count):
        if number in known:
            continue
        of = templates[RIG_SEQUENCE[number % len(RIG_SEQUENCE)]]
        alarms = raised_findings(of, np.random.default_rng([seed, 37, number]))
        found.update(alarms)
        found["any"] += bool(alarms)
        if file is not None:
            with file.open("a") as out:
                out.write(json.dumps({"seed": seed, "number": number, "alarms": alarms}) + "\n")
        if (number + 1) % PROGRESS == 0:
            print(f"{number + 1} of {count} drawn: {dict(found)}", file=sys.stderr, flush=True)
    return found


def raised_findings(of: Template, random: Random) -> list[str]:
    """Draw one exposure; the findings that change its verdict."""
    mosaic, temperatures = _drawn(of, random)
    rig, tie_points = of.rig, of.product.tie_points
    alarms = []
    validity = evaluate_master(rig, mosaic, temperatures)
    if validity.displaced is not None:
        test = validity.displaced.statistic / validity.limit
        alarms += ["displaced"] if test > Thresholds().displacement_verdict else []
    alarms += ["misread"] if validity.probe_bias is not None else []
    if any(e.disagrees for e in estimate_dc(rig, mosaic, temperatures)):
        alarms.append("temperature")
    layers = check_layers(rig, mosaic, temperatures)
    alarms += ["layers"] if layers is not None and layers.changed else []
    platform = check_platform(rig, mosaic, tie_points, temperatures)
    alarms += ["platform"] if platform is not None and platform.is_expired else []
    alarms += ["slip"] if find_slips(rig, tie_points, mosaic.residuals_px) else []
    return alarms


def _drawn(of: Template, random: Random) -> tuple[Mosaic, dict[str, float]]:
    """What stitching finds of a healthy camera, and what its probes read."""
    rig, mosaic = of.rig, of.product.free
    values = of.root @ random.standard_normal(of.root.shape[1])
    dc_k = float(random.uniform(-LARGEST_DC_K, LARGEST_DC_K))
    read = {probe: float(random.normal(0.0, PROBE_SIGMA_K)) for probe in rig.probes}
    temperatures = {
        probe: cone.calibration_c + dc_k + read[probe]
        for cone in rig.cones
        for probe in {cone.probe, *(s.probe for s in cone.sensors)}
        if probe in read
    }
    for cone in rig.cones:
        for sensor in cone.sensors:
            first = mosaic.model.sensors.get(sensor.name)
            if first is None:
                continue
            drift, off_k = sensor.drift, read.get(sensor.probe, 0.0)
            sigma = np.hypot(sensor.position_sigma_um, drift.sigma_um_per_k * dc_k)
            off_um = random.normal(0.0, sigma, 2)
            off_um -= np.array([drift.x_um_per_k, drift.y_um_per_k]) * off_k
            values[first : first + 2] += off_um * 1e-3
            values[first + 3] -= drift.scale_ppm_per_k * 1e-6 * off_k
    _perturb_layers(rig, mosaic, values, read, random)
    _perturb_mountings(rig, mosaic, values, random)
    return replace(mosaic, values=values, residuals_px=_residuals(of, random)), temperatures


def _perturb_layers(
    rig: Rig, mosaic: Mosaic, values: Array, read: Mapping[str, float], random: Random
) -> None:
    """Principal distances and mountings off by their sigmas."""
    if rig.master_cone is None:
        return

    def scale_ppm(cone: Cone) -> float:
        own = float(random.normal(0.0, cone.lens.f_sigma_ppm))
        return own - cone.lens.f_ppm_per_k * read.get(cone.probe, 0.0)

    master_ppm = scale_ppm(rig.cone(rig.master_cone))
    for cone in rig.cones:
        rotation = rotation_of_layer(rig, mosaic, cone)
        if cone.name not in mosaic.model.layers or rotation is None:
            continue
        first = mosaic.model.layers[cone.name]
        own = slice(first, first + 8)
        design = np.concatenate([layer_scale_design(mosaic, cone, first)[None], rotation * 1e6])
        wanted = np.array(
            [scale_ppm(cone) - master_ppm, *random.normal(0.0, cone.rotation_sigma_urad, 3)]
        )
        values[own] += np.linalg.pinv(design[:, own]) @ wanted


def _perturb_mountings(rig: Rig, mosaic: Mosaic, values: Array, random: Random) -> None:
    """Converging heads turned by their sigmas; the mean is the datum's."""
    rotations = {}
    for name in mosaic.model.mountings:
        cone = rig.cone(name)
        places = place_covariance(cone, {})
        rotations[name] = random.normal(0.0, cone.rotation_sigma_urad * 1e-6, 3)
        rotations[name] += random.multivariate_normal(np.zeros(3), places)
    mean = np.mean(list(rotations.values()), axis=0) if rotations else np.zeros(3)
    for name, first in mosaic.model.mountings.items():
        values[first : first + 3] += rotations[name] - mean


def _residuals(of: Template, random: Random) -> Array:
    """A residual field (n, 2), px: by class and sigma of its points, neighbours erring alike."""
    points, mosaic = of.product.tie_points, of.product.free
    kinds: Any = points.kind
    sigma = np.zeros(len(points))
    for kind in np.unique(kinds):
        rows = kinds == kind
        used = rows & ~mosaic.outliers
        relative = points.sigma_px / np.median(points.sigma_px[used])
        spread = np.sqrt(np.nanmean((mosaic.residuals_px[used] / relative[used, None]) ** 2))
        sigma[rows] = (relative * spread)[rows]
    cells = np.floor(points.raw_a / CORRELATED_PX).astype(np.int64)
    number = (points.overlap * 1000 + cells[:, 0]) * 1000 + cells[:, 1]
    _, cell = np.unique(number, return_inverse=True)
    shared = random.standard_normal((int(cell.max()) + 1, 2))[cell]
    own = random.standard_normal((len(points), 2))
    field = np.sqrt(CORRELATED_SHARE) * shared + np.sqrt(1.0 - CORRELATED_SHARE) * own
    # Points that the adjustment had no use for stay as they were, blunders among them.
    drawn = field * sigma[:, None]
    retained = mosaic.outliers | ~np.isfinite(mosaic.residuals_px).all(axis=1)
    drawn[retained] = mosaic.residuals_px[retained]
    return np.asarray(drawn, np.float64)

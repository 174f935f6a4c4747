"""Compares the geometry of stitched images with the emulator's truth.

A pure function with a thin command line. It reads what the mission states and what the
emulator knows. It uses no code of the pipeline.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from sim_hw import SimulatorError

Array = NDArray[np.float64]

METHODS = {
    "free": "geometry.npz",
    "fixed": "geometry-fixed.npz",
    "fixed-no-tdm": "geometry-fixed-no-tdm.npz",
}
MATCH_WITHIN_NS = 500_000_000
"""A mark further from every true one belongs to no exposure of the emulator."""


class ComparisonError(SimulatorError):
    """A mission or a truth that cannot be judged."""


@dataclass(frozen=True)
class GeometryErrors:
    """Error vectors of one method: truth minus where the pixel was put, PAN pixels, (n, 2)."""

    absolute: Array
    inner: Array

    @property
    def figures(self) -> dict[str, float | int]:
        return {
            "points": len(self.absolute),
            "absolute_rms_px": _rms(self.absolute),
            "absolute_max_px": _longest(self.absolute),
            "inner_rms_px": _rms(self.inner),
            "inner_max_px": _longest(self.inner),
        }


@dataclass
class _Pool:
    """Sums over exposures."""

    points: int = 0
    squares: dict[str, float] = field(default_factory=lambda: {"absolute": 0.0, "inner": 0.0})
    worst: dict[str, float] = field(default_factory=lambda: {"absolute": 0.0, "inner": 0.0})

    def add(self, errors: GeometryErrors) -> None:
        self.points += len(errors.absolute)
        for kind, vectors in (("absolute", errors.absolute), ("inner", errors.inner)):
            self.squares[kind] += float(np.sum(vectors**2))
            self.worst[kind] = max(self.worst[kind], _longest(vectors))

    @property
    def figures(self) -> dict[str, float | int]:
        found: dict[str, float | int] = {"points": self.points}
        for kind in ("absolute", "inner"):
            found[f"{kind}_rms_px"] = float(np.sqrt(self.squares[kind] / self.points))
            found[f"{kind}_max_px"] = self.worst[kind]
        return found


def compare_mission(mission: Path, truth: Path) -> dict[str, Any]:
    """Compare every exposure of a mission with the truth.

    Returns:
        `methods`: per method, over all exposures, `points` and RMS and largest length of the error
        vectors in PAN pixels, absolute and inner (after a best-fit similarity per exposure).
        `colour`: the same of the colour sensors. `exposures`: the same one by one, with
        `time_error_ns`, the mission's event mark minus the true one. `time_error_ns`: the largest
        of them in size. `unmatched`: exposures that fit no true one.

    Raises:
        ComparisonError: the folder holds no truth.
    """
    marks = read_marks(truth)
    exposures, unmatched = [], []
    pools: dict[str, dict[str, _Pool]] = {"methods": {}, "colour": {}}
    for record in sorted((mission / "L0").glob("*/exposure.json")):
        name = record.parent.name
        stamp = json.loads(record.read_text()).get("mark_gps_ns")
        nearest = _nearest(marks, None if stamp is None else int(stamp))
        if stamp is None or nearest is None:
            unmatched.append(name)
            continue
        with np.load(marks[nearest]) as content:
            known = {key: content[key] for key in content.files}
        product_entry: dict[str, Any] = {
            "id": name,
            "pulse_count": int(marks[nearest].stem),
            "time_error_ns": int(stamp) - nearest,
            "methods": {},
            "colour": {},
        }
        for method, file in METHODS.items():
            path = mission / "L2" / name / file
            if not path.exists():
                continue
            with np.load(path) as content:
                geometry = {key: content[key] for key in content.files}
            for kind, errors in compare(geometry, known).items():
                product_entry[kind][method] = errors.figures
                pools[kind].setdefault(method, _Pool()).add(errors)
        exposures.append(product_entry)
    return {
        "methods": {name: pool.figures for name, pool in pools["methods"].items()},
        "colour": {name: pool.figures for name, pool in pools["colour"].items()},
        "time_error_ns": max((e["time_error_ns"] for e in exposures), key=abs, default=None),
        "exposures": exposures,
        "unmatched": unmatched,
    }


def compare(
    geometry: Mapping[str, NDArray[Any]], truth: Mapping[str, NDArray[Any]]
) -> dict[str, GeometryErrors]:
    """Errors of one exposure: "methods" of the PAN sensors together, "colour" of the others.

    Args:
        geometry: `<sensor>.vip`, `<sensor>.raw` (n, 2) columns and rows, `<sensor>.weight` (n,).
        truth: the arrays of one file of the emulator.
    """
    pan_sensors = set(truth["pan_sensors"].tolist())
    found = {}
    for kind, is_pan in (("methods", True), ("colour", False)):
        places, errors = [], []
        for name in truth["sensors"].tolist():
            if (name in pan_sensors) != is_pan or f"{name}.vip" not in geometry:
                continue
            used = geometry[f"{name}.weight"] > 0
            vip = geometry[f"{name}.vip"][used].astype(np.float64)
            raw = geometry[f"{name}.raw"][used].astype(np.float64)
            inside = on_sensor(truth, name, raw)
            places.append(vip[inside])
            errors.append(true_positions(truth, name, raw[inside]) - vip[inside])
        if places and sum(map(len, places)) > 2:
            at, absolute = np.concatenate(places), np.concatenate(errors)
            found[kind] = GeometryErrors(absolute=absolute, inner=_inner(truth, at, absolute))
    return found


def on_sensor(truth: Mapping[str, NDArray[Any]], sensor: str, raw: Array) -> NDArray[np.bool_]:
    """Whether raw positions lie on the sensor's pixel centres or between them, shape (n,)."""
    last_column, last_row = truth[f"{sensor}.columns"][-1], truth[f"{sensor}.rows"][-1]
    inside = (raw >= 0).all(axis=1) & (raw[:, 0] <= last_column) & (raw[:, 1] <= last_row)
    return np.asarray(inside)


def true_positions(truth: Mapping[str, NDArray[Any]], sensor: str, raw: Array) -> Array:
    """Where raw pixels belong in the virtual image, (n, 2), by splines through the truth's grid."""
    rows, columns = truth[f"{sensor}.rows"], truth[f"{sensor}.columns"]
    belongs = []
    for key in ("vip_column", "vip_row"):
        spline = RectBivariateSpline(rows, columns, truth[f"{sensor}.{key}"])
        belongs.append(spline.ev(raw[:, 1], raw[:, 0]))
    return np.stack(belongs, axis=1)


def _inner(truth: Mapping[str, NDArray[Any]], places: Array, errors: Array) -> Array:
    """What is left after the datum is taken out: three rotations of a virtual camera between
    converging heads, four parameters of a similarity else."""
    if "inner" in truth and str(truth["inner"]) == "rotations":
        width, height, f_px = truth["image"]
        return after_rotations(places - [(width - 1) / 2, (height - 1) / 2], errors, float(f_px))
    return after_similarity(places, errors)


def after_rotations(places: Array, errors: Array, f_px: float) -> Array:
    """Errors left after the best-fit small rotation of a camera, points alike, (n, 2).

    Args:
        places: (column, row) from the principal point.
        f_px: principal distance.
    """
    x, y = places.T
    # What turns about the axes across, along and of sight do to (column, row).
    design = np.empty((len(places), 2, 3))
    design[:, 0] = np.stack([x * y / f_px, f_px + x * x / f_px, -y], axis=1)
    design[:, 1] = np.stack([f_px + y * y / f_px, x * y / f_px, x], axis=1)
    rotations, *_ = np.linalg.lstsq(design.reshape(-1, 3), errors.reshape(-1), rcond=None)
    return np.asarray(errors - design @ rotations)


def after_similarity(places: Array, errors: Array) -> Array:
    """Errors left after the best-fit similarity (shift, rotation, scale), points alike, (n, 2)."""
    x, y = (places - places.mean(axis=0)).T
    ex, ey = (errors - errors.mean(axis=0)).T
    spread = float(np.sum(x * x + y * y))
    if spread == 0:
        return np.asarray(errors - errors.mean(axis=0))
    scale = float(np.sum(x * ex + y * ey)) / spread
    rotation = float(np.sum(x * ey - y * ex)) / spread
    return np.stack([ex - scale * x + rotation * y, ey - rotation * x - scale * y], axis=1)


def read_marks(truth: Path) -> dict[int, Path]:
    """Files of truth by their true mark, GPS ns."""
    marks = {}
    for path in sorted(truth.glob("[0-9]*.npz")):
        with np.load(path) as content:
            marks[int(content["mark_gps_ns"])] = path
    if not marks:
        raise ComparisonError(f"{truth}: holds no exposures; give the truth folder of the emulator")
    return marks


def _nearest(marks: Mapping[int, Path], stamp: int | None) -> int | None:
    if stamp is None:
        return None
    nearest = min(marks, key=lambda mark: abs(mark - stamp))
    return nearest if abs(nearest - stamp) <= MATCH_WITHIN_NS else None


def _rms(vectors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def _longest(vectors: Array) -> float:
    return float(np.sqrt(np.max(np.sum(vectors**2, axis=1))))


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the judgement as one JSON object."""
    parser = argparse.ArgumentParser(prog="python -m sim_hw.truth_comparison", description=__doc__)
    parser.add_argument("--mission", type=Path, required=True, help="folder of the mission")
    parser.add_argument("--truth", type=Path, required=True, help="truth folder of the emulator")
    given = parser.parse_args(arguments)
    try:
        print(json.dumps(compare_mission(given.mission, given.truth)))
    except ComparisonError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

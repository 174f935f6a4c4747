"""What a calibration from a board shows about the rig file, the board and the pictures.

Each finding is a sentence with its cure; `blocking` ones keep a rig uncalibrated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.calibration.board.adjustment import BoardCalibration
from processing.calibration.board.near_focus import NearFocus, near_focus
from processing.calibration.board.network import mounting_of
from processing.calibration.board.views import ViewCoverage, coverage_of
from processing.geometry.rotation import vectors_from_rotations

Array = NDArray[np.float64]

F_CHANGE: Final = 0.1
BASE_CHANGE: Final = 0.15
BASE_MIN_MM: Final = 20.0
SIGMA_MAX_PX: Final = 0.25
MOVED_FACTOR: Final = 1.6
BENT_SIGMAS: Final = 6.0
BENT_SHARE: Final = 2e-4
"""Flatness of a board that is reported, over its size."""
_SWAPPED_RAD: Final = math.radians(3.0)


@dataclass(frozen=True)
class BoardFindings:
    """Coverage and near focus by head, sentences, and what keeps the rig uncalibrated."""

    coverage: Mapping[str, ViewCoverage]
    focus: Mapping[str, NearFocus]
    warnings: tuple[str, ...]
    blocking: tuple[str, ...]


def findings_of(found: BoardCalibration, *, focused_m: float | None) -> BoardFindings:
    """Everything a reader of the calibration has to know.

    Args:
        found: the calibration.
        focused_m: distance at which the lenses were focused; None: infinity, as in flight.
    """
    coverage, focus = {}, {}
    warnings: list[str] = []
    for name in found.heads:
        cone = found.rig.cone(name)
        own = [(v, p) for v, p in zip(found.views, found.poses, strict=True) if v.head == name]
        coverage[name] = coverage_of(cone, [v for v, _ in own], [p for _, p in own])
        warnings += [f"{name}: missing {text}" for text in coverage[name].missing]
        sensor = cone.sensors[0]
        c = cone.lens.f_mm
        f = c if focused_m is None else c * focused_m * 1e3 / (c + focused_m * 1e3)
        focus[name] = near_focus(
            f,
            found.distance_m(name) if focused_m is None else focused_m,
            f_number=cone.lens.f_number,
            pitch_mm=sensor.pitch_mm,
            corner_mm=math.hypot(sensor.width_px, sensor.height_px) / 2.0 * sensor.pitch_mm,
        )
    warnings += [*found.left_out, *_optics(found), *_heads(found), *_board(found), *_noise(found)]
    return BoardFindings(coverage, focus, tuple(warnings), tuple(_blocking(found, focused_m)))


def _blocking(found: BoardCalibration, focused_m: float | None) -> list[str]:
    missing = [c.name for c in found.rig.cones if c.name not in found.heads]
    sentences = []
    if missing:
        sentences.append(
            f"no pictures of {', '.join(missing)}: their lenses are as they were; take pictures "
            "with every head"
        )
    sentences += [
        f"{head} never shows the board together with {found.reference} or a head that does: "
        f"the relative orientation of {head} is as it was. Hold the board where both see part "
        "of it"
        for head in found.relative.unconnected
    ]
    if focused_m is not None:
        sentences.append(
            f"the lenses were focused at {focused_m:g} m and fly focused at infinity: the "
            "principal "
            "distance is carried over by the lens equation, distortion is not"
        )
    return sentences


def _optics(found: BoardCalibration) -> list[str]:
    sentences = []
    for name in found.heads:
        new, old = found.rig.cone(name).lens.f_mm, found.before.cone(name).lens.f_mm
        if abs(new / old - 1.0) > F_CHANGE:
            sentences.append(
                f"{name}: the principal distance is {new:.3f} mm, the rig file states {old:.3f} "
                "mm: "
                "check focal length and pixel size"
            )
    return sentences


def _heads(found: BoardCalibration) -> list[str]:
    """Heads that are swapped, and bases that show a board of another size."""
    sentences = []
    reference = found.before.cone(found.reference)
    for name in found.relative.mountings:
        drawn_rotation, drawn = mounting_of(found.before.cone(name), reference)
        rotation, base = mounting_of(found.rig.cone(name), found.rig.cone(found.reference))
        direct = _angle(drawn_rotation.T @ rotation)
        inverse = _angle(drawn_rotation @ rotation)
        drawn_mm, base_mm = (float(np.linalg.norm(v)) * 1e3 for v in (drawn, base))
        has_base = min(drawn_mm, base_mm) > BASE_MIN_MM
        opposite = has_base and float(drawn @ base) < -0.5 * drawn_mm * base_mm * 1e-6
        if inverse + _SWAPPED_RAD < direct or (opposite and inverse < direct + _SWAPPED_RAD):
            sentences.append(
                f"{name} is where the rig file has {found.reference}: the pictures of the two "
                "heads "
                "are swapped, or their names in the rig file"
            )
        elif has_base and abs(base_mm / drawn_mm - 1.0) > BASE_CHANGE:
            sentences.append(
                f"{name}: {base_mm:.1f} mm from {found.reference}, the rig file states "
                f"{drawn_mm:.1f} mm: the board is {drawn_mm / base_mm:.2f} times as large as "
                "--board "
                "states, or the rig file is wrong; measure a square with a caliper"
            )
        common = [n for pair, n in found.relative.common.items() if name in pair]
        if sum(common) < 3:
            sentences.append(
                f"{name}: {sum(common)} exposure{'s' * (sum(common) != 1)} in common with other "
                "heads: relative orientation is not checked; take five or more"
            )
    return sentences


def _angle(rotation: Array) -> float:
    return float(np.linalg.norm(vectors_from_rotations(rotation)))


def bend_mm(found: BoardCalibration) -> tuple[float, float]:
    """Largest height of the board over its mean plane and its standard deviation, mm."""
    shape, sigma = found.shape_m
    place = found.adjustment.network.points.xyz_m[:, :2]
    plane = np.column_stack([place, np.ones(len(place))])
    height = shape[:, 2] - plane @ np.linalg.lstsq(plane, shape[:, 2], rcond=None)[0]
    worst = int(np.argmax(np.abs(height)))
    return float(height[worst]) * 1e3, float(sigma[worst, 2]) * 1e3


def _board(found: BoardCalibration) -> list[str]:
    height, sigma = bend_mm(found)
    tolerance = found.settings.board_sigma_mm
    size = max(found.board.size_mm)
    if abs(height) > max(BENT_SIGMAS * sigma, BENT_SHARE * size):
        tolerance = found.settings.board_sigma_mm
        sentence = f"the board is bent: a corner is {height:.2f} mm off its plane"
        if abs(height) > 3.0 * tolerance:
            return [
                f"{sentence}. Use a flat board, or state how far it may be off: --board-tolerance "
                f"{abs(height):.1f}mm adjusts its shape"
            ]
        return [f"{sentence}; its shape is adjusted. A flat board gives a better result"]
    return []


def _noise(found: BoardCalibration) -> list[str]:
    sentences = []
    if found.sigma_px > SIGMA_MAX_PX:
        sentences.append(
            f"corners fit to {found.sigma_px:.2f} px only; 0.1 px and less are usual: board not "
            "flat, drawn with other sizes, or pictures compressed or moved"
        )
    alone = max(found.single_sigma_px.values())
    if found.relative.mountings and found.sigma_px > MOVED_FACTOR * alone:
        sentences.append(
            f"together the heads fit to {found.sigma_px:.3f} px, each alone to {alone:.3f} px: "
            "heads "
            "or board moved between pictures that count as one instant; trigger the heads together"
        )
    return sentences

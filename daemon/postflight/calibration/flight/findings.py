"""What a calibration from a flight leaves open, and what keeps the rig uncalibrated.

Each finding is a sentence with its cure; `blocking` ones keep a rig without `[calibration]`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from daemon.postflight.calibration.flight.frames import FlightFrames
from processing.calibration.board.adjustment import F_SIGMA_MAX
from processing.calibration.flight.adjustment import FlightCalibration
from processing.calibration.flight.images import FOCAL_SIGMA

DISTORTION_SIGMA_MAX_PX: Final = 1.0
SEPARATED_SHARE: Final = 0.5
"""Standard deviation over that beforehand above which a parameter counts as not separated."""
SIGMA_MAX_PX: Final = 1.5
POSITION_FACTOR: Final = 1.5
APART_MAX_M: Final = 0.1
F_CHANGE: Final = 2.0 * FOCAL_SIGMA


@dataclass(frozen=True)
class FlightFindings:
    """Sentences, and those that keep the rig uncalibrated."""

    blocking: tuple[str, ...]
    warnings: tuple[str, ...]


def findings_of(found: FlightCalibration, frames: FlightFrames) -> FlightFindings:
    """Everything a reader of the calibration has to know."""
    blocking = list(found.left_out)
    warnings: list[str] = []
    for head in found.heads:
        blocking += _open_lens(found, head)
        warnings += _open_point(found, head)
        new, old = found.rig.cone(head).lens.f_mm, found.before.cone(head).lens.f_mm
        if abs(new / old - 1.0) > F_CHANGE:
            warnings.append(
                f"{head}: the principal distance is {new:.3f} mm, the rig file states {old:.3f} "
                "mm: check focal length and pixel size"
            )
    warnings += [
        f"no common points of {a} and {b}: their relative orientation rests on the positions of "
        "the exposures"
        for (a, b), count in found.common.items()
        if not count and found.reference in (a, b)
    ]
    if found.sigma_px > SIGMA_MAX_PX:
        warnings.append(
            f"image points fit to {found.sigma_px:.2f} px; 0.3 to 1 px are usual: heads that fire "
            "at different instants, motion blur, or a rolling shutter"
        )
    if frames.apart_m > APART_MAX_M:
        warnings.append(
            f"frames of one exposure are up to {frames.apart_m:.2f} m of flight apart and are "
            "taken as of one place; trigger the heads together"
        )
    if frames.contradicting:
        warnings.append(
            f"{frames.contradicting} of {frames.matched} pairs of images were left out: by the "
            "positions they do not lie where their matches put them, as over ground that repeats "
            "itself"
        )
    warnings += _positions(found, frames)
    warnings += found.adjustment.problems
    warnings += frames.unreadable
    return FlightFindings(tuple(blocking), tuple(warnings))


def _open_lens(found: FlightCalibration, head: str) -> list[str]:
    sentences = []
    f_mm = found.rig.cone(head).lens.f_mm
    share = found.sigmas(head)["df"] / f_mm
    if share > F_SIGMA_MAX:
        sentences.append(
            f"{head}: the principal distance is known to {share:.1%} only: images of one height "
            "over flat ground do not separate it from the height above ground. Fly some lines 30 % "
            "higher and give both flights, or use `syntopic calibrate board`"
        )
    distortion = found.distortion_sigma_px(head)
    if distortion > DISTORTION_SIGMA_MAX_PX:
        sentences.append(
            f"{head}: distortion at the corners is known to {distortion:.1f} px only; give more "
            "exposures, over texture in all parts of the image"
        )
    return sentences


def _open_point(found: FlightCalibration, head: str) -> list[str]:
    shares = found.shares_of_prior(head)
    open_axes = [name for name in ("dx0", "dy0") if shares[name] > SEPARATED_SHARE]
    if not open_axes:
        return []
    axes = " and ".join({"dx0": "x", "dy0": "y"}[name] for name in open_axes)
    return [
        f"{head}: the principal point in {axes} is not separated from the angles of the head; "
        "both are known together only. Fly lines both ways and crosswise"
    ]


def _positions(found: FlightCalibration, frames: FlightFrames) -> list[str]:
    sentences = []
    if frames.without_sigma:
        sentences.append(
            f"{frames.without_sigma} positions have no standard deviation; "
            f"{frames.default_sigma_m[0]:g} m, and {frames.default_sigma_m[1]:g} m in height, are "
            "taken"
        )
    used = found.adjustment.network.gnss.sigma_m
    factor = float(np.median(used) / np.median(frames.images.position_sigma_m))
    if factor > POSITION_FACTOR:
        sentences.append(
            f"positions fit the images {factor:.1f} times worse than their standard deviations "
            "state, and are weighted so: check the antenna in [mount] and the receiver"
        )
    return sentences

"""What navigation gives a block: its observations, and the unknowns that go with them.

The one description that the block in flight and the triangulation after landing share. Measured
orientations are those of the camera by its calibrated mounting; corrections of the mounting
(boresight and lever arm) are unknowns, with the calibration as observations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from processing.bundle.network import (
    Attitudes,
    Gnss,
    HeadMounting,
    MeasuredAttitudes,
    Stations,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
GnssDrift = Literal["none", "shift", "linear"]

MOUNTING: Final = "mounting"
"""Name of the mounting of a block with one camera."""


@dataclass(frozen=True)
class MeasuredOrientations:
    """Orientations of n exposures as measured.

    Attributes:
        position_m: (n, 3) projection centres, object system.
        rotation: (n, 3, 3) object from camera.
        position_sigma_m: (n, 3); infinite where nothing was measured.
        attitude_sigma_rad: (n, 3) about the camera's axes; infinite likewise.
    """

    position_m: Array
    rotation: Array
    position_sigma_m: Array
    attitude_sigma_rad: Array


@dataclass(frozen=True)
class MountingPrior:
    """Standard deviations of the calibrated boresight (rad) and lever arm (m), by coordinate."""

    boresight_sigma_rad: float = math.radians(6e-3)
    lever_arm_sigma_m: float = 0.02


@dataclass(frozen=True)
class GnssLines:
    """Line (n,) and time (n,) s of each exposure, and what is unknown of positions of a line."""

    names: tuple[str, ...]
    line: Indices
    time_s: Array
    drift: GnssDrift = "none"


@dataclass(frozen=True)
class HeadPlace:
    """Calibrated place of a head in its exposure: rotation (3, 3) and offset (3,) m, in the axes of
    the head that represents the exposure."""

    name: str
    rotation: Array
    offset_m: Array


@dataclass(frozen=True)
class FlownExposures:
    """Tables of a network: everything of it that comes from navigation and calibration."""

    stations: Stations
    attitudes: Attitudes
    heads: tuple[HeadMounting, ...]
    gnss: Gnss
    measured_attitudes: MeasuredAttitudes


def flown_exposures(
    names: Sequence[str],
    measured: MeasuredOrientations,
    prior: MountingPrior | None,
    *,
    start: tuple[Array, Array] | None = None,
    lines: GnssLines | None = None,
    heads: Sequence[HeadPlace] = (),
) -> FlownExposures:
    """Tables of exposures with measured orientations.

    Args:
        names: of the exposures.
        measured: their orientations.
        prior: of the mounting; None holds it.
        start: stations (n, 3) and rotations (n, 3, 3) to begin with; None: as measured.
        lines: None: positions have no shift or drift by line.
        heads: of each exposure; none: one camera. Every mounting is an unknown of its own.

    Returns:
        Stations and attitudes by exposure, mountings by head; no mountings with one camera whose
        mounting is held.
    """
    n = len(names)
    every = np.arange(n)
    station, rotation = start or (measured.position_m, measured.rotation)
    free = np.zeros(n, dtype=bool)
    places = heads or (() if prior is None else (HeadPlace(MOUNTING, np.eye(3), np.zeros(3)),))
    lines = lines or GnssLines((), np.full(n, -1), np.zeros(n))
    return FlownExposures(
        Stations(tuple(names), station, free),
        Attitudes(tuple(names), rotation, free),
        tuple(_mounting(place, prior) for place in places),
        Gnss(
            every, every, measured.position_m, measured.position_sigma_m, np.zeros((n, 3)),
            lines.line, lines.time_s, lines.names, lines.drift,
        ),
        MeasuredAttitudes(every, measured.rotation, measured.attitude_sigma_rad),
    )  # fmt: skip


def _mounting(place: HeadPlace, prior: MountingPrior | None) -> HeadMounting:
    if prior is None:
        return HeadMounting(place.name, place.rotation, place.offset_m)
    return HeadMounting(
        place.name,
        place.rotation,
        place.offset_m,
        rotation_free=True,
        offset_free=True,
        rotation_sigma_rad=prior.boresight_sigma_rad,
        offset_sigma_m=prior.lever_arm_sigma_m,
    )

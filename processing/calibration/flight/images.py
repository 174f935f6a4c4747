"""Images of a flight as the calibration takes them, and what is known of lenses beforehand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing import ProcessingError
from processing.bundle.network import INTERIOR, CameraModel
from processing.calibration.board.network import LENS_KEYS
from processing.matching.photograph_tracks import Tracks
from processing.rig import Cone

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

FREE: Final = ("dx0", "dy0", "df", "k1", "k2", "p1", "p2")
FOCAL_SIGMA: Final = 0.02
"""Standard deviation of a focal length as printed on a lens, relative."""
POINT_SIGMA: Final = 0.02
"""That of a principal point, over the distance of a corner."""
_CORNER_SIGMA: Final = 0.05
_DECENTRING_SIGMA: Final = 0.005


class FlightCalibrationError(ProcessingError, ValueError):
    """A flight that does not determine the calibration; the message states what is missing."""


@dataclass(frozen=True)
class FlightImages:
    """Images of heads, and tracks of features through them.

    Attributes:
        head: (n,) index of each image's cone in the rig.
        exposure: (n,) index of its exposure.
        line: (exposures,) index of the line of each exposure.
        tracks: image points of all images, by image index.
        position_m: (exposures, 3) of the antenna at the exposure of the reference head, NaN where
            there is none.
        position_sigma_m: (exposures, 3).
        antenna_m: (3,) body axes: forward, right, down.
    """

    head: Indices
    exposure: Indices
    line: Indices
    tracks: Tracks
    position_m: Array
    position_sigma_m: Array
    antenna_m: Array


def corner_mm(cone: Cone) -> float:
    """Distance of a corner from the middle of the sensor.

    Args:
        cone: with one sensor.

    Returns:
        Millimetres.
    """
    sensor = cone.sensors[0]
    return 0.5 * float(np.hypot(sensor.width_px, sensor.height_px)) * sensor.pitch_mm


def prior_sigmas(cone: Cone) -> dict[str, float]:
    """Standard deviations of a lens that nobody calibrated, in the unit of each parameter.

    Args:
        cone: with one sensor.

    Returns:
        By parameter: the focal length to 2 %, distortion to 5 % of the distance of a corner, the
        principal point to 2 % of it.
    """
    corner = corner_mm(cone)
    return {
        "dx0": POINT_SIGMA * corner,
        "dy0": POINT_SIGMA * corner,
        "df": FOCAL_SIGMA * cone.lens.f_mm,
        **{f"k{n}": _CORNER_SIGMA / corner ** (2 * n) for n in (1, 2)},
        "p1": _DECENTRING_SIGMA / corner,
        "p2": _DECENTRING_SIGMA / corner,
    }


def camera_of(cone: Cone, *, is_centred: bool = True) -> CameraModel:
    """The camera model of a head, with what is estimated and how well it is known beforehand.

    Args:
        cone: with one sensor, dx0 = dy0 = df = 0 (`processing.calibration.board.network.started`).
        is_centred: the model of the adjustment; False: the Australis model without the principal
            point, for starting values.

    Returns:
        Values of the rig file as starting values.
    """
    interior = np.array([float(getattr(cone.lens, LENS_KEYS[name])) for name in INTERIOR])
    sigma = prior_sigmas(cone)
    free = FREE if is_centred else tuple(name for name in FREE if name not in ("dx0", "dy0"))
    return CameraModel(
        cone.name,
        cone.lens.f_mm,
        model="centred" if is_centred else "australis",
        interior=interior,
        free=frozenset(free),
        sigma={name: sigma[name] for name in free},
        pixel_mm=cone.sensors[0].pitch_mm,
    )

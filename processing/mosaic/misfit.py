"""How far the stitching puts sensors of a cone from where calibration + TDM expect them.

The part of it that no shift, rotation and scale of the whole cone can make, with its covariance,
and how well one cause or another fits it. What is concluded from that is in
`processing.mosaic.validity`.

Source: docs/explanation/mathematics/validity.md#contrasts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from processing.geometry.drift import sensor_dc
from processing.mosaic.free_mosaic import Mosaic
from processing.rig import Rig, Sensor

Array = NDArray[np.float64]

POSITION = ("x", "y")
POSITION_AND_SCALE = ("x", "y", "scale")
"""Quantities of a sensor: px, px, ppm. A displaced sensor keeps its scale, a warm one does not."""
_UNKNOWN = {"x": 0, "y": 1, "scale": 3}


@dataclass(frozen=True)
class PriorSigmas:
    """Standard deviations of what is known besides the rig file's.

    `probe_sigma_k` is common to all sensors of a probe; a probe without a temperature has
    `unknown_sigma_k`.
    """

    probe_sigma_k: float = 0.1
    unknown_sigma_k: float = 10.0


@dataclass(frozen=True)
class ProbeBias:
    """A probe that reads `bias_k` too much, if that alone were wrong.

    `statistic` is chi-square with one degree of freedom where it reads right.
    """

    probe: str
    bias_k: float
    sigma_k: float
    statistic: float


@dataclass(frozen=True)
class CauseFit:
    """A cause's best size (k,), its cofactor (k, k), and the chi-square with k it explains."""

    size: Array
    cofactor: Array
    statistic: float


@dataclass(frozen=True)
class Misfit:
    """Found minus expected of some sensors, as `contrasts` (c, n) of their quantities.

    `y` (c,) are the contrasts, `weight` (c, c) the inverse of their covariance.
    """

    sensors: tuple[Sensor, ...]
    quantities: tuple[str, ...]
    pitch_um: float
    contrasts: Array
    y: Array
    weight: Array

    @property
    def statistic(self) -> float:
        """Chi-square of nothing being wrong."""
        return float(self.y @ self.weight @ self.y)

    def displacement(self, index: int) -> Array:
        """Design of a displacement of one sensor.

        Args:
            index: of the sensor in `sensors`.

        Returns:
            What a px of x and of y makes of the contrasts, (c, 2).
        """
        first = index * len(self.quantities)
        return self.contrasts[:, first : first + 2]

    def probe_bias(self, probe: str) -> Array:
        """Design of a probe that reads one kelvin too much.

        Args:
            probe: name of the probe.

        Returns:
            What it makes of the contrasts, (c, 1).
        """
        warmed = [
            per_kelvin(s, self.quantities, self.pitch_um) * (s.probe == probe) for s in self.sensors
        ]
        return -self.contrasts @ np.concatenate(warmed)[:, None]

    def fit(self, design: Array) -> CauseFit:
        """The best size of a cause.

        Args:
            design: of the cause, (c, k).

        Returns:
            Size, cofactor and the chi-square it explains.

        Source: docs/explanation/mathematics/validity.md#one-displaced-sensor.
        """
        cofactor = np.asarray(np.linalg.inv(design.T @ self.weight @ design), np.float64)
        normal_vector = design.T @ self.weight @ self.y
        size = cofactor @ normal_vector
        return CauseFit(size, cofactor, float(size @ normal_vector))

    def with_free_cause(self, design: Array) -> Misfit:
        """The same where a cause may have any size.

        Args:
            design: of the cause, (c, k).

        Returns:
            A copy whose weight leaves the cause out.
        """
        weighted = self.weight @ design
        taken = weighted @ np.linalg.inv(design.T @ weighted) @ weighted.T
        return replace(self, weight=self.weight - taken)


def misfit(
    rig: Rig,
    mosaic: Mosaic,
    sensors: Sequence[str],
    temperatures_c: Mapping[str, float],
    *,
    quantities: tuple[str, ...] = POSITION,
    prior_sigmas: PriorSigmas | None = None,
) -> Misfit:
    """The misfit of sensors of one cone, three at least.

    Args:
        rig: the camera.
        mosaic: a free mosaic, in any datum.
        sensors: by name; the stitching has found them.
        temperatures_c: temperature by probe name, as the mosaic's start was made with.
        quantities: `POSITION` or `POSITION_AND_SCALE`.
        prior_sigmas: None takes the defaults.

    Returns:
        Contrasts and their weight.

    Source: docs/explanation/mathematics/validity.md#contrasts.
    """
    found, stitching = found_quantities(mosaic, sensors, quantities)
    expected = expected_covariance(
        rig, mosaic, sensors, temperatures_c, quantities=quantities, prior_sigmas=prior_sigmas
    )
    covariance = stitching + expected
    places = [mosaic.start[name].similarity for name in sensors]
    pitch_mm = mosaic.model.pitch_mm
    directions = similarity_directions([(p.x_mm, p.y_mm) for p in places], pitch_mm, quantities)
    contrasts = orthogonal_complement(directions)
    return Misfit(
        sensors=tuple(rig.sensor(name) for name in sensors),
        quantities=quantities,
        pitch_um=mosaic.model.pitch_mm * 1e3,
        contrasts=contrasts,
        y=contrasts @ found,
        weight=np.asarray(np.linalg.inv(contrasts @ covariance @ contrasts.T), np.float64),
    )


def found_quantities(
    mosaic: Mosaic, sensors: Sequence[str], quantities: Sequence[str] = POSITION
) -> tuple[Array, Array]:
    """Corrections of sensors by stitching, one sensor after the other.

    Args:
        mosaic: a free mosaic, in any datum.
        sensors: names of adjusted sensors.
        quantities: `POSITION` or `POSITION_AND_SCALE`.

    Returns:
        Corrections (n,), px and for scales ppm, and their covariance (n, n).
    """
    rows = [mosaic.model.sensors[name] + _UNKNOWN[q] for name in sensors for q in quantities]
    unit = np.tile([_per_unknown(q, mosaic) for q in quantities], len(sensors))
    return mosaic.values[rows] * unit, mosaic.covariance[np.ix_(rows, rows)] * np.outer(unit, unit)


def expected_covariance(
    rig: Rig,
    mosaic: Mosaic,
    sensors: Sequence[str],
    temperatures_c: Mapping[str, float],
    *,
    quantities: Sequence[str] = POSITION,
    prior_sigmas: PriorSigmas | None = None,
) -> Array:
    """Covariance of where calibration + TDM expect the sensors.

    A calibrated scale is as good as places of the same sigma half a diagonal from the centre.

    Args:
        rig: the camera.
        mosaic: gives the pixel pitch.
        sensors: by name, of one cone.
        temperatures_c: temperature by probe name.
        quantities: `POSITION` or `POSITION_AND_SCALE`.
        prior_sigmas: None takes the defaults.

    Returns:
        (n, n), quantities of one sensor after the other, px and for scales ppm, squared.

    Source: docs/explanation/mathematics/validity.md#contrasts.
    """
    prior_sigmas = prior_sigmas or PriorSigmas()
    pitch_um = mosaic.model.pitch_mm * 1e3
    expected = [rig.sensor(name) for name in sensors]
    variances = []
    for sensor in expected:
        dc = sensor_dc(sensor, temperatures_c)
        unknown = 0.0 if sensor.probe in temperatures_c else prior_sigmas.unknown_sigma_k
        tdm_um = sensor.drift.sigma_um_per_k * math.hypot(dc, unknown)
        place_px = math.hypot(sensor.position_sigma_um, tdm_um) / pitch_um
        half_mm = math.hypot(sensor.width_px, sensor.height_px) / 2.0 * sensor.pitch_mm
        scale_ppm = sensor.position_sigma_um / half_mm * 1e3
        variances += [(scale_ppm if q == "scale" else place_px) ** 2 for q in quantities]
    covariance = np.diag(variances)
    for probe in dict.fromkeys(sensor.probe for sensor in expected):
        known = probe in temperatures_c
        sigma_k = prior_sigmas.probe_sigma_k if known else prior_sigmas.unknown_sigma_k
        displacement = np.concatenate(
            [per_kelvin(s, quantities, pitch_um) * (s.probe == probe) for s in expected]
        )
        covariance += np.outer(displacement, displacement) * sigma_k**2
    return covariance


def per_kelvin(sensor: Sensor, quantities: Sequence[str], pitch_um: float) -> Array:
    """What a kelvin does to a sensor.

    Args:
        sensor: its drift coefficients count.
        quantities: `POSITION` or `POSITION_AND_SCALE`.
        pitch_um: pixel pitch of the virtual image, um.

    Returns:
        One value for each quantity, px/K, of the scale ppm/K.
    """
    drift = sensor.drift
    known = {
        "x": drift.x_um_per_k / pitch_um,
        "y": drift.y_um_per_k / pitch_um,
        "scale": drift.scale_ppm_per_k,
    }
    return np.array([known[q] for q in quantities])


def similarity_directions(
    places_mm: Sequence[tuple[float, float]], pitch_mm: float, quantities: Sequence[str] = POSITION
) -> Array:
    """How a common shift, scale and rotation moves sensors.

    Args:
        places_mm: x, y of each sensor in its layer, mm.
        pitch_mm: pixel pitch of the virtual image, mm.
        quantities: `POSITION` or `POSITION_AND_SCALE`.

    Returns:
        Columns of shift x, shift y, scale and rotation, (n, 4), px and for scales ppm, by px and by
        px per mm.

    Example:
        A sensor 10 mm to the right: shift x, shift y, scale moves it right, rotation moves it up.

        >>> similarity_directions([(10.0, 0.0)], 0.0072) + 0.0
        array([[ 1.,  0., 10.,  0.],
               [ 0.,  1.,  0., 10.]])
    """
    rows = []
    for x_mm, y_mm in places_mm:
        moves = {
            "x": (1.0, 0.0, x_mm, -y_mm),
            "y": (0.0, 1.0, y_mm, x_mm),
            # Places are in px, per mm of lever arm.
            "scale": (0.0, 0.0, pitch_mm * 1e6, 0.0),
        }
        rows += [moves[q] for q in quantities]
    return np.array(rows)


def orthogonal_complement(directions: Array) -> Array:
    """An orthonormal basis of what directions cannot produce.

    Args:
        directions: independent columns, (n, d).

    Returns:
        Basis as rows, (n - d, n).

    Example:
        What a common shift of two sensors cannot produce is their difference.

        >>> np.abs(orthogonal_complement(np.array([[1.0], [1.0]]))).round(4)
        array([[0.7071, 0.7071]])
    """
    full, _, _ = np.linalg.svd(directions, full_matrices=True)
    return np.asarray(full[:, directions.shape[1] :].T)


def _per_unknown(quantity: str, mosaic: Mosaic) -> float:
    return 1e6 if quantity == "scale" else 1.0 / mosaic.model.pitch_mm

"""What an adjustment of converging heads holds, and what an error of it does to the image.

A head turns; its sensor's place in the head and its scale stay as calibrated. An error of these
bends the whole image: part of it the turns take up, the rest stays as one pattern over all heads,
the same for neighbouring pixels. Rigs with a master cone have free layers, which take it up whole.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.drift import sensor_dc
from processing.geometry.placement import SensorPlacement, corrected_mm_from_raw
from processing.geometry.projective import projective_jacobian
from processing.geometry.similarity import apply_similarity
from processing.matching.tie_points import PAN_TO_COLOUR, TiePoints
from processing.mosaic.datum import mounting_constraints
from processing.mosaic.free_mosaic import Mosaic
from processing.mosaic.model import vip_and_design
from processing.quality.figures.stitching import HeadScaleFigures
from processing.rig import Cone, Rig

Array = NDArray[np.float64]

QUANTITIES: Final = np.eye(3)
"""Shift x, y (mm) and scale of a head's layer."""
SCALE_SIGMA: Final = 0.01
"""A scale is not farther off; it keeps heads without points where they are."""
SIGNIFICANT: Final = 6.0
"""Standard deviations; those of correlated neighbours are up to 1.8 times as large."""
_NO_INFORMATION: Final = 1e-10
"""Share of the largest eigenvalue below which tie points say nothing."""


@dataclass(frozen=True)
class HeldPart:
    """One pattern of errors over the image, one standard deviation of it.

    `unknowns` (u,) are errors of the adjusted unknowns; `layers` (3,) those of the layers of cones,
    by name, which the adjustment holds: shift x, y in mm, and scale.
    """

    unknowns: Array
    layers: Mapping[str, Array] = field(default_factory=dict)

    def times(self, factor: float) -> HeldPart:
        """The pattern, so many times as large.

        Args:
            factor: without unit, any sign.

        Returns:
            A copy, scaled.
        """
        layers = {cone: layer * factor for cone, layer in self.layers.items()}
        return HeldPart(self.unknowns * factor, layers)

    def at(self, mosaic: Mosaic, sensor: str, colrow: Array) -> Array:
        """Errors of where raw pixels of a sensor lie.

        Args:
            mosaic: the adjustment the pattern is of.
            sensor: name of the sensor.
            colrow: raw column and row, (n, 2).

        Returns:
            x right and y up in the virtual image, (n, 2), px.
        """
        start = mosaic.start[sensor]
        corrected = corrected_mm_from_raw(start, colrow)
        _, columns, design = vip_and_design(mosaic.model, start, corrected, mosaic.values)
        moved = np.einsum("kan,k->na", design, self.unknowns[columns])
        if start.cone.name in self.layers:
            direct = _direct(mosaic, mosaic.placements[sensor], corrected)
            moved = moved + direct @ self.layers[start.cone.name]
        return np.asarray(moved, np.float64)


@dataclass(frozen=True)
class HeldQuantities:
    """Patterns of a unit of every held quantity, and what the residuals say of the scales.

    `parts` are three of each head: shift x, y (mm) and scale. `scales` (m,) are the errors of the
    heads' scales that explain the residuals best, less their median, since what all have in common
    leaves hardly a trace; `scale_sigmas` (m,) are theirs. `away` (u,) is how far the unknowns lie
    from where least squares puts them: heads are turned further where a shift was left.
    """

    cones: tuple[str, ...]
    parts: Mapping[str, tuple[HeldPart, ...]]
    scales: Array
    scale_sigmas: Array
    away: Array


def held_quantities(mosaic: Mosaic, tie_points: TiePoints) -> HeldQuantities | None:
    """Carry errors of what is held through the adjustment.

    Args:
        mosaic: by these tie points.
        tie_points: those it was made of.

    Returns:
        None where no heads converge, or nothing ties them.
    """
    cones = tuple(mosaic.model.mountings)
    if not cones or mosaic.redundancy <= 0:
        return None
    design, errors, residuals, weight = _observations(mosaic, tie_points, cones)
    scaled = design * mosaic.model.units
    normal = scaled.T @ (weight[:, None] * scaled)
    for constraint in mounting_constraints(cones):
        row = np.zeros(len(mosaic.model.names))
        for name, coefficient in constraint.coefficients.items():
            i = mosaic.model.names.index(name)
            row[i] = coefficient * mosaic.model.units[i]
        row *= np.sqrt(np.abs(normal).max()) / np.linalg.norm(row)
        normal += np.outer(row, row)
    right = -scaled.T @ (weight[:, None] * errors)
    inverse = np.linalg.pinv(normal, rcond=_NO_INFORMATION, hermitian=True)
    unknowns = (inverse @ right) * mosaic.model.units[:, None]
    left = errors + design @ unknowns
    of_scale = left[:, 2::3]
    information = of_scale.T @ (weight[:, None] * of_scale)
    information += np.eye(len(cones)) / SCALE_SIGMA**2
    cofactor = np.linalg.inv(information)
    scales = cofactor @ (of_scale.T @ (weight * residuals))
    against = np.eye(len(cones)) - 1.0 / len(cones)
    sigmas = np.sqrt(np.diag(against @ cofactor @ against))
    away = inverse @ (scaled.T @ (weight * residuals)) * mosaic.model.units
    parts = {
        cone: tuple(
            HeldPart(unknowns[:, 3 * i + j], {cone: QUANTITIES[j]}) for j in range(len(QUANTITIES))
        )
        for i, cone in enumerate(cones)
    }
    return HeldQuantities(cones, parts, scales - np.median(scales), sigmas, away)


def calibrated_parts(
    rig: Rig,
    held: HeldQuantities,
    temperatures_c: Mapping[str, float],
    sigma_k: Mapping[str, float],
) -> tuple[HeldPart, ...]:
    """What sensor places, drift coefficients and probes of a healthy rig do, a pattern of each.

    Args:
        rig: the camera.
        held: its patterns.
        temperatures_c: temperatures that were read, by probe name.
        sigma_k: how well the temperature of every probe is known, by its name, K.

    Returns:
        Patterns of one standard deviation, independent of each other.
    """
    found = []
    for name in held.cones:
        cone = rig.cone(name)
        by_x, by_y, by_scale = held.parts[name]
        sigma_mm = _place_sigma_mm(cone, temperatures_c)
        found += [by_x.times(sigma_mm), by_y.times(sigma_mm)]
        sensors = cone.sensors
        for probe in dict.fromkeys([*(s.probe for s in sensors), cone.probe]):
            own = [s.drift for s in sensors if s.probe == probe]
            x, y, scale = (
                np.sum([d.x_um_per_k for d in own]) * 1e-3 / len(sensors),
                np.sum([d.y_um_per_k for d in own]) * 1e-3 / len(sensors),
                np.sum([d.scale_ppm_per_k for d in own]) * 1e-6 / len(sensors),
            )
            scale -= cone.lens.f_ppm_per_k * 1e-6 * float(cone.probe == probe)
            factors = (x, y, scale)
            found.append(_sum((by_x, by_y, by_scale), factors).times(sigma_k[probe]))
    return tuple(found)


def scaled_part(held: HeldQuantities, *, least: float) -> HeldPart | None:
    """What heads with another scale do to the image, as the residuals find them.

    Args:
        held: patterns and scales.
        least: scales below are no finding.

    Returns:
        None where no head has another scale.
    """
    large = _significant(held) & (np.abs(held.scales) > least)
    if not large.any():
        return None
    some = [held.parts[cone][2] for cone in held.cones]
    found = _sum(some, [float(s) for s in held.scales * large])
    return HeldPart(found.unknowns + held.away, found.layers)


def scale_figures(held: HeldQuantities | None) -> HeadScaleFigures | None:
    """The head whose scale differs most, in figures of the quality report.

    Against `processing.mosaic.mounting.platform_figures`, which compare each head with its
    neighbours alone, all heads are weighed together: the one that bends the others is named.

    Args:
        held: from `held_quantities`; None where it had nothing to go by.

    Returns:
        Scale, ppm, and name of the head; None where no scale differs significantly.
    """
    if held is None or not _significant(held).any():
        return None
    sizes = np.abs(held.scales) * _significant(held)
    i = int(np.argmax(sizes))
    # A head that is placed too large has to shrink.
    return HeadScaleFigures(-float(held.scales[i]) * 1e6, held.cones[i])


def _significant(held: HeldQuantities) -> NDArray[np.bool_]:
    return np.asarray(np.abs(held.scales) > SIGNIFICANT * held.scale_sigmas)


def _sum(parts: Sequence[HeldPart], factors: Sequence[float]) -> HeldPart:
    scaled = [part.times(float(factor)) for part, factor in zip(parts, factors, strict=True)]
    layers: dict[str, Array] = {}
    for part in scaled:
        for cone, layer in part.layers.items():
            layers[cone] = layers.get(cone, np.zeros(3)) + layer
    return HeldPart(np.sum([part.unknowns for part in scaled], axis=0), layers)


def _place_sigma_mm(cone: Cone, temperatures_c: Mapping[str, float]) -> float:
    """How well the middle of a head's sensors is known."""
    squares = [
        s.position_sigma_um**2 + (s.drift.sigma_um_per_k * sensor_dc(s, temperatures_c)) ** 2
        for s in cone.sensors
    ]
    return float(np.sqrt(np.sum(squares)) / len(squares)) * 1e-3


def _observations(
    mosaic: Mosaic, tie_points: TiePoints, cones: Sequence[str]
) -> tuple[Array, Array, Array, Array]:
    """Design (m, u), errors by held quantities (m, 3 h), residuals (m,) and weights (m,)."""
    designs, errors, residuals, weights = [], [], [], []
    good = ~mosaic.outliers & np.isfinite(mosaic.residuals_px).all(axis=1)
    for number, (a, b) in enumerate(tie_points.pairs):
        rows = np.flatnonzero(good & (tie_points.overlap == number))
        if not len(rows):
            continue
        design = np.zeros((len(rows), 2, len(mosaic.model.names)))
        error = np.zeros((len(rows), 2, 3 * len(cones)))
        for sign, name, raw in ((1.0, a, tie_points.raw_a), (-1.0, b, tie_points.raw_b)):
            start = mosaic.start[name]
            corrected = corrected_mm_from_raw(start, raw[rows])
            _, columns, by = vip_and_design(mosaic.model, start, corrected, mosaic.values)
            design[:, :, columns] += sign * by.transpose(2, 1, 0)
            if start.cone.name in cones:
                i = 3 * cones.index(start.cone.name)
                direct = _direct(mosaic, mosaic.placements[name], corrected)
                error[:, :, i : i + 3] += sign * direct
        of_kind = good & (tie_points.kind == tie_points.kind[rows[0]])
        typical = float(np.median(tie_points.sigma_px[of_kind]))
        colour = tie_points.kind[rows[0]] == PAN_TO_COLOUR
        unit = mosaic.sigma_pc_px if colour else mosaic.sigma_pp_px
        sigma = np.maximum(tie_points.sigma_px[rows] / typical * unit, 1e-6)
        designs.append(design.reshape(2 * len(rows), -1))
        errors.append(error.reshape(2 * len(rows), -1))
        residuals.append(mosaic.residuals_px[rows].reshape(-1))
        weights.append(np.repeat(1.0 / sigma**2, 2))
    return (
        np.concatenate(designs),
        np.concatenate(errors),
        np.concatenate(residuals),
        np.concatenate(weights),
    )


def _direct(mosaic: Mosaic, placement: SensorPlacement, corrected_mm: Array) -> Array:
    """How points move by shift x, y (mm) and scale of their layer, (n, 2, 3), px."""
    layer_mm = apply_similarity(placement.similarity, corrected_mm)
    jacobian = projective_jacobian(placement.layer, layer_mm)
    quantities = np.zeros((len(layer_mm), 2, 3))
    quantities[:, 0, 0] = quantities[:, 1, 1] = 1.0
    quantities[:, :, 2] = layer_mm
    return np.asarray(jacobian @ quantities / mosaic.model.pitch_mm)

"""Test of the layers of the other cones against the platform calibration, in scale and rotation.

Stitching transforms every layer onto the master's, independent of the calibration. The change is
compared here with how well principal distances, mountings and sensor places are known.
A change that all other cones share is the master's own; it moves the whole image and is not
corrected. A change common to all cones cannot be observed by stitching: that takes a bundle
adjustment with ground control or GNSS.

Source: docs/explanation/mathematics/validity.md#layers-against-the-platform-calibration; Ladstädter
et al. (2010), "platform calibration".
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import chdtri

from processing.geometry.drift import sensor_dc
from processing.geometry.topology import mosaic_cones
from processing.mosaic.estimated_dc import expansion_rate
from processing.mosaic.free_mosaic import Mosaic
from processing.mosaic.mounting import rotation_of_layer
from processing.mosaic.precision import BLIND_SIGMA_K, PROBE_SIGMA_K, UNKNOWN_SIGMA_K
from processing.mosaic.stitch_record import layer_scale_design
from processing.quality.figures import FigureGroup
from processing.quality.figures.stitching import LayerFigures, PlatformFigures
from processing.rig import Cone, Rig

Array = NDArray[np.float64]

ALPHA: Final = 1e-5
"""Probability of a finding in a healthy exposure: it changes the verdict."""
REST_ALPHA: Final = 0.01
"""The same of what one changed cone leaves: it widens the stated accuracy only."""
ODDS_LIMIT: Final = 19.0
QUANTITIES: Final = ("scale_ppm", "rotation_x_urad", "rotation_y_urad", "rotation_z_urad")


@dataclass(frozen=True)
class LayerChange:
    """What the stitching changed of one layer against calibration and drift.

    `values` (4,) are ln(scale) in ppm and the rotation about the axes of the virtual image in
    urad, `sigmas` (4,) how well calibration, drift and tie points let them be expected.
    `shift_px` is how far the middle of the cone's sensors went, PAN pixels.
    """

    cone: str
    values: Array
    sigmas: Array
    shift_px: float


@dataclass(frozen=True)
class LayerCheck:
    """Whether the layers are as calibrated.

    `statistic` is what one changed cone explains at most, chi-square with four degrees of freedom
    on a healthy rig. `common` (4,) is the change that all layers share, which is the master's with
    the opposite sign. `several_likely` is true where one cone is changed and leaves what only one
    healthy exposure in a hundred does. `causes` are the cones whose change explains the misfit, the
    master's name for the common one; `alternatives` explain the first as well. Both are empty where
    the test is passed.
    """

    master: str
    layers: tuple[LayerChange, ...]
    statistic: float
    limit: float
    common: Array
    common_sigmas: Array
    causes: tuple[str, ...]
    alternatives: tuple[str, ...]
    several_likely: bool = False

    @property
    def changed(self) -> bool:
        """Whether the layers differ significantly from the platform calibration."""
        return self.statistic > self.limit

    @property
    def master_changed(self) -> bool:
        """Whether the master cone is among the causes, or may be."""
        return self.master in (*self.causes, *self.alternatives)


def check_layers(
    rig: Rig, mosaic: Mosaic, temperatures_c: Mapping[str, float], *, parallax_px: float = 0.0
) -> LayerCheck | None:
    """Compare scale and rotation of the free layers with the platform calibration.

    Args:
        rig: the camera.
        mosaic: by tie points alone.
        temperatures_c: temperatures that were read, by probe name.
        parallax_px: what relief may leave between cones that stand apart, PAN pixels.

    Returns:
        None where no layer is free or found.
    """
    held = {name.split(".")[0] for name in mosaic.undetermined}
    cones = [c for c in mosaic_cones(rig) if c.name in mosaic.model.layers and c.name not in held]
    if rig.master_cone is None or not cones or mosaic.redundancy <= 0:
        return None
    design = np.concatenate([_design(rig, mosaic, cone) for cone in cones])
    values = design @ mosaic.values
    own = [_known(cone, temperatures_c) for cone in cones]
    master = _known(rig.cone(rig.master_cone), temperatures_c)
    half_px = mosaic.model.half_size_mm / mosaic.model.pitch_mm
    f_px = mosaic.model.f_mm / mosaic.model.pitch_mm
    relief = np.square([parallax_px / half_px * 1e6, *[parallax_px / f_px * 1e6] * 3])
    mountings = [np.square([0.0, *[cone.rotation_sigma_urad] * 3]) for cone in cones]
    count = len(cones)
    covariance = design @ mosaic.covariance @ design.T
    covariance += block_diag(
        *(np.diag(o + m + relief) for o, m in zip(own, mountings, strict=True))
    )
    covariance += np.kron(np.ones((count, count)), np.diag(master))
    weight = np.asarray(np.linalg.inv(covariance), np.float64)
    designs: dict[str, Array] = {rig.master_cone: _repeated(np.ones((count, 1)))}
    for i, cone in enumerate(cones):
        designs[cone.name] = _repeated(np.eye(count)[:, i : i + 1])
    left = [_remaining(values, weight, design) for design in designs.values()]
    statistic = float(values @ weight @ values) - min(left)
    limit = float(chdtri(4, ALPHA / len(designs)))
    shared = designs[rig.master_cone]
    cofactor = np.linalg.inv(shared.T @ weight @ shared)
    causes: tuple[str, ...] = ()
    alternatives: tuple[str, ...] = ()
    if statistic > limit:
        causes, alternatives = _causes(designs, values, weight)
    sigmas = np.sqrt(np.diag(covariance)).reshape(count, 4)
    return LayerCheck(
        master=rig.master_cone,
        layers=tuple(
            LayerChange(
                cone=cone.name,
                values=values[4 * i : 4 * i + 4],
                sigmas=sigmas[i],
                shift_px=math.hypot(values[4 * i + 1], values[4 * i + 2]) * 1e-6 * f_px,
            )
            for i, cone in enumerate(cones)
        ),
        statistic=statistic,
        limit=limit,
        common=np.asarray(cofactor @ (shared.T @ weight @ values)),
        common_sigmas=np.asarray(np.sqrt(np.diag(cofactor))),
        causes=causes,
        alternatives=alternatives,
        several_likely=bool(causes) and bool(min(left) > chdtri(max(4 * count - 4, 1), REST_ALPHA)),
    )


def layer_figures(check: LayerCheck | None) -> tuple[FigureGroup, ...]:
    """The check in figures of the quality report.

    Args:
        check: None where the layers were not tested.

    Returns:
        Groups of figures; empty without a check.
    """
    if check is None:
        return ()
    farthest = max(check.layers, key=lambda layer: layer.shift_px)
    return (
        PlatformFigures(
            platform_test=check.statistic / check.limit,
            platform_shift_px=farthest.shift_px,
            platform_shift_head=farthest.cone,
            platform_alternatives=tuple(check.alternatives),
        ),
        LayerFigures(
            platform_causes=tuple(check.causes),
            platform_master_changed=int(check.master_changed),
            common_scale_ppm=float(check.common[0]),
            common_scale_sigma_ppm=float(check.common_sigmas[0]),
        ),
    )


def _design(rig: Rig, mosaic: Mosaic, cone: Cone) -> Array:
    """Scale (ppm) and rotation (urad) of a layer by the unknowns, (4, u)."""
    rotation = rotation_of_layer(rig, mosaic, cone)
    assert rotation is not None
    first = mosaic.model.layers[cone.name]
    return np.concatenate([layer_scale_design(mosaic, cone, first)[None], rotation * 1e6])


def _known(cone: Cone, temperatures_c: Mapping[str, float]) -> Array:
    """Variances (4,), ppm and urad squared, of what sensors and lens make of a layer."""
    sensors = cone.sensors
    variance_um2 = float(
        np.mean(
            [
                s.position_sigma_um**2
                + (s.drift.sigma_um_per_k * sensor_dc(s, temperatures_c)) ** 2
                for s in sensors
            ]
        )
    )
    if len(sensors) > 1:
        places = np.array([[s.x_mm, s.y_mm] for s in sensors])
        spread_mm2 = float(np.sum((places - places.mean(axis=0)) ** 2))
        rate = expansion_rate(sensors)[0] + float(
            np.mean([s.drift.scale_ppm_per_k for s in sensors])
        )
    else:
        spread_mm2 = (sensors[0].height_px / 2.0 * sensors[0].pitch_mm) ** 2
        rate = sensors[0].drift.scale_ppm_per_k
    rotation_variance = variance_um2 / spread_mm2 * 1e6
    shifted = variance_um2 / len(sensors) / cone.lens.f_mm**2 * 1e6
    unknown_k = UNKNOWN_SIGMA_K if temperatures_c else BLIND_SIGMA_K
    sigma_k = PROBE_SIGMA_K if cone.probe in temperatures_c else unknown_k
    warmed = ((rate - cone.lens.f_ppm_per_k) * sigma_k) ** 2
    scale = rotation_variance + cone.lens.f_sigma_ppm**2 + warmed
    return np.array([scale, shifted, shifted, rotation_variance])


def _repeated(which: Array) -> Array:
    """The design (4 m, 4) of a change of the layers marked in `which` (m, 1)."""
    return np.asarray(np.kron(which, np.eye(4)), np.float64)


def _causes(
    designs: Mapping[str, Array], values: Array, weight: Array
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The fewest cones whose change explains the misfit, and what explains the first as well."""
    causes: list[str] = []
    alternatives: tuple[str, ...] = ()
    taken = np.zeros((len(values), 0))
    while len(causes) < len(designs) - 1:
        left = {
            name: _remaining(values, weight, np.hstack([taken, design]))
            for name, design in designs.items()
            if name not in causes
        }
        best = min(left, key=lambda name: left[name])
        if not causes:
            near = left[best] + 2.0 * math.log(ODDS_LIMIT)
            alternatives = tuple(n for n, rest in left.items() if n != best and rest < near)
        causes.append(best)
        taken = np.hstack([taken, designs[best]])
        freedom = len(values) - taken.shape[1]
        if freedom <= 0 or left[best] <= chdtri(freedom, ALPHA):
            break
    return tuple(causes), alternatives


def _remaining(values: Array, weight: Array, design: Array) -> float:
    """Chi-square that a cause of any size with this design leaves."""
    normal = design.T @ weight @ design
    normal_vector = design.T @ weight @ values
    return float(
        values @ weight @ values
        - normal_vector @ np.linalg.lstsq(normal, normal_vector, rcond=None)[0]
    )

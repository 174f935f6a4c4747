"""What the findings of an exposure add to its stated accuracy.

The covariance of `processing.mosaic.precision` holds for a camera that is as calibrated. Where the
report itself finds a displaced sensor, a wrong temperature, a changed master cone or a read-out
slip, the stated accuracy of the image includes that finding.

Source: docs/explanation/mathematics/validity.md#what-findings-add. Eq. 6 is that of Ladstädter et
al. (2010).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.mosaic.datum import datum_candidates
from processing.mosaic.estimated_dc import EstimatedDc, combined_dc
from processing.mosaic.free_mosaic import Mosaic
from processing.mosaic.held import HeldPart, HeldQuantities, calibrated_parts, scaled_part
from processing.mosaic.layers import LayerCheck
from processing.mosaic.mounting import EstimatedMounting, PlatformCheck
from processing.mosaic.precision import (
    BLIND_SIGMA_K,
    PROBE_SIGMA_K,
    UNKNOWN_SIGMA_K,
    UncertaintyContribution,
    datum_by_places,
    datum_design,
    datum_per_kelvin_px,
)
from processing.mosaic.readout_slips import Slip
from processing.mosaic.validity import Validity
from processing.rig import Rig, Sensor

Array = NDArray[np.float64]

SCALE_SIGMAS: Final = 2.0
"""A common change of scale within so many standard deviations of the calibration is no error."""
SINGLE_SENSOR_SIGMAS: Final = 1.0
"""The same where the master cone has one sensor: nothing else shows a wrong scale of it."""
OTHER_LENS_SIGMAS: Final = 4.0
"""Of scale and of direction, beyond which a changed cone is that of another unit."""
TURN_SIGMAS: Final = 2.0
"""A rotation of a converging head within so many standard deviations of calibration is no error."""
STALE_K_PER_S: Final = 0.02
"""How fast temperatures change that were read too long ago."""
HEAD_SCALE_PPM: Final = 50.0
"""Of a converging head; healthy ones reach half of it."""
RELATIVE_SHIFT: Final = 3.0
"""The largest of a few shifts between frames, over the sigma of a coordinate of one."""
MIN_SLIP_PX: Final = 0.1
"""Component of a slip; a smaller one is the error of its measurement: lines shift by whole pixels,
of which a quarter is left."""
MIN_DISPLACEMENT_PX: Final = 0.02
"""Displacements with a smaller difference count as equal."""


@dataclass(frozen=True)
class CalibrationChecks:
    """What one exposure shows of its calibration.

    Args:
        estimated_dc: temperatures by stitching against those of the probes.
        layers: the other cones against the platform calibration.
        platform: the mountings of converging heads against it.
    """

    estimated_dc: Sequence[EstimatedDc] = ()
    layers: LayerCheck | None = None
    platform: PlatformCheck | None = None


def uncertainty_contribution_of(
    rig: Rig,
    mosaic: Mosaic,
    *,
    validity: Validity | None,
    checks: CalibrationChecks,
    slips: Sequence[Slip],
    held: HeldQuantities | None,
    temperatures_c: Mapping[str, float],
    stale_s: float = 0.0,
    shifted_px: float = 0.0,
    weak: Collection[str] = (),
    smear_px: Mapping[str, float] | None = None,
) -> UncertaintyContribution:
    """Add up what the findings of one exposure may have done to the image.

    Args:
        rig: the camera.
        mosaic: what the image was made with.
        validity: of the master cone's sensors.
        checks: of the calibration.
        slips: shifted bands of frames.
        held: what the adjustment of converging heads holds.
        temperatures_c: temperatures that were read, by probe name.
        stale_s: age of the temperatures where they are too old, else zero.
        shifted_px: how far frames lay apart beyond the search for tie points, else zero.
        weak: sensors that rest on calibration.
        smear_px: by cone, what its stated TDI count leaves of the motion, where that is too much.

    Returns:
        Covariances of datum and frames, and patterns; all zero without findings.

    Source: docs/explanation/mathematics/validity.md#what-findings-add.
    """
    platform = checks.platform
    warmed = tuple(_wrong_temperature(rig, mosaic, checks.estimated_dc))
    # A wrong temperature changes the common scale of all layers, too.
    changed = () if warmed else tuple(_changed_master(rig, mosaic, checks.layers))
    datum = np.zeros((4, 4))
    contributions = [*_rotated_heads(mosaic, platform, held), *_stale(rig, mosaic, stale_s)]
    contributions += _miscounted(rig, smear_px or {})
    places_off_px = _places_off_px(rig, mosaic, validity, checks.layers)
    if places_off_px and _is_other_unit(validity, checks.layers):
        datum += datum_by_places(rig, mosaic) @ datum_by_places(rig, mosaic).T * places_off_px**2
    else:
        contributions += _other_datums(rig, mosaic, validity)
    for part in (*warmed, *changed, *contributions):
        datum += np.outer(part, part)
    frames: dict[str, Array] = {}
    for slip in slips:
        shift = np.array([slip.dx_px, slip.dy_px])
        shift[np.abs(shift) < MIN_SLIP_PX] = 0.0
        for name in (slip.sensor, *slip.alternatives):
            frames[name] = frames.get(name, np.zeros(2)) + slip.share * shift**2
    unplaced, apart = _unplaced(rig, mosaic, shifted_px, places_off_px, weak)
    parts = (*_held(rig, mosaic, platform, held, temperatures_c, stale_s), *apart)
    return UncertaintyContribution(
        datum + unplaced + _common_scale(mosaic, platform, held), frames, parts
    )


def _held(
    rig: Rig,
    mosaic: Mosaic,
    platform: PlatformCheck | None,
    held: HeldQuantities | None,
    temperatures_c: Mapping[str, float],
    stale_s: float,
) -> Iterator[HeldPart]:
    """What the calibration of converging heads does, and heads that are not as calibrated."""
    if held is None:
        return
    unknown_k = UNKNOWN_SIGMA_K if temperatures_c else BLIND_SIGMA_K
    sigma_k = {
        probe: math.hypot(
            PROBE_SIGMA_K if probe in temperatures_c else unknown_k, STALE_K_PER_S * stale_s
        )
        for probe in rig.probes
    }
    # What has no probe drifts by a dC that nothing reads.
    sigma_k[""] = BLIND_SIGMA_K
    yield from calibrated_parts(rig, held, temperatures_c, sigma_k)
    scaled = scaled_part(held, least=HEAD_SCALE_PPM * 1e-6)
    if scaled is not None:
        yield scaled
    if platform is None or not platform.is_expired:
        return
    f_mm = mosaic.model.f_mm
    for head in platform.heads:
        # A displaced sensor is confounded with a rotated head, whose image bends otherwise.
        by_x, by_y, _ = _true_rotation(mosaic, head, held)
        for part, shift_mm in zip(held.parts[head.cone], (-f_mm * by_y, f_mm * by_x), strict=False):
            yield part.times(shift_mm)


def _true_rotation(mosaic: Mosaic, head: EstimatedMounting, held: HeldQuantities | None) -> Array:
    """The rotation of a head (3,), rad, less what heads with another scale make of it."""
    rotation = np.array(head.correction_rad)
    scaled = None if held is None else scaled_part(held, least=HEAD_SCALE_PPM * 1e-6)
    if scaled is None:
        return rotation
    first = mosaic.model.mountings[head.cone]
    return np.asarray(rotation - scaled.unknowns[first : first + 3])


def _common_scale(
    mosaic: Mosaic, platform: PlatformCheck | None, held: HeldQuantities | None
) -> Array:
    """Where several heads have other scales, what all have in common is known no better."""
    datum = np.zeros((4, 4))
    if held is None or platform is None or not platform.is_expired:
        return datum
    changed = np.abs(held.scales) > HEAD_SCALE_PPM * 1e-6
    if changed.sum() > 1:
        datum[2, 2] = float(np.mean(held.scales**2)) / mosaic.model.pitch_mm**2
    return datum


def _is_other_unit(validity: Validity | None, layers: LayerCheck | None) -> bool:
    """Whether both places of master sensors and several layers are not as calibrated."""
    if validity is None or layers is None:
        return False
    return not validity.consistent and len(layers.causes) > 1


def _places_off_px(
    rig: Rig, mosaic: Mosaic, validity: Validity | None, layers: LayerCheck | None
) -> float:
    """How far places of the calibration are off where several sensors show it.

    Squares of a coordinate of the master sensors after a best-fit similarity, which leaves 2 m - 4
    of 2 m, and of the sensors of other cones about their mean, 2 (m - 1) of 2 m; from so few the
    variance of the next place is f / (f - 2) times their mean (Student's t). Zero where at most one
    sensor was displaced.
    """
    if validity is None or not (validity.several_displaced or _is_other_unit(validity, layers)):
        return 0.0
    held = {name.split(".")[0] for name in mosaic.undetermined}
    found = [s for s in datum_candidates(rig) if s.name in mosaic.model.sensors.keys() - held]
    freedom, squares = max(2 * len(found) - 4, 0), 0.0
    if freedom:
        design, moved = _places(found), _moved_px(mosaic, found)
        left = moved - design @ np.linalg.lstsq(design, moved, rcond=None)[0]
        squares = float(left @ left)
    for cone in rig.pan_cones:
        pairs = [pair for pair in validity.relative if pair.cone == cone.name]
        if pairs:
            sensors = len({name for pair in pairs for name in (pair.sensor_a, pair.sensor_b)})
            squares += sum(pair.dx_px**2 + pair.dy_px**2 for pair in pairs) / sensors
            freedom += 2 * (sensors - 1)
    return math.sqrt(squares / (freedom - 2)) if freedom > 2 else math.sqrt(squares)


def _unplaced(
    rig: Rig, mosaic: Mosaic, shifted_px: float, places_off_px: float, weak: Collection[str]
) -> tuple[Array, tuple[HeldPart, ...]]:
    """Frames that tie points do not place, where the calibration that holds them does not hold.

    Where frames lay elsewhere than calibrated, the datum's calibration is off by as much. Where
    places of other sensors are off, those of these frames are; the datum has that already.
    """
    datum = np.zeros((4, 4))
    owners = {name.split(".")[0] for name in mosaic.undetermined}
    owners |= {*weak, *(rig.cone_of(name).name for name in weak)}
    sigma_px = max(shifted_px / RELATIVE_SHIFT, places_off_px)
    if not sigma_px or not owners:
        return datum, ()
    # A cone's place in the image is that of its mounting as well, which the master has none of.
    of_datum = (shifted_px / RELATIVE_SHIFT / 2.0) ** 2
    half_mm = mosaic.model.half_size_mm
    datum = np.diag([1.0, 1.0, half_mm**-2, half_mm**-2]) * of_datum
    parts = []
    for i, name in enumerate(mosaic.model.names):
        if name.split(".")[0] not in owners:
            continue
        unknowns = np.zeros(len(mosaic.model.names))
        unknowns[i] = mosaic.model.units[i] * sigma_px
        parts.append(HeldPart(unknowns))
    return datum, tuple(parts)


def _rotated_heads(
    mosaic: Mosaic, platform: PlatformCheck | None, held: HeldQuantities | None
) -> Iterator[Array]:
    """What heads that turned do to the mean of all, which is the datum; each on its own.

    Of heads whose rotation is no significant one, what is beyond the usual size counts.
    """
    if platform is None:
        return
    pitch_mm = mosaic.model.pitch_mm
    f_px = mosaic.model.f_mm / pitch_mm
    for head in platform.heads:
        rotation = _true_rotation(mosaic, head, held)
        if not platform.is_expired:
            usual = TURN_SIGMAS * head.usual_rad
            rotation = np.sign(rotation) * np.sqrt(np.maximum(rotation**2 - usual**2, 0.0))
        by_x, by_y, by_z = rotation / (len(platform.heads) - 1)
        yield np.array([-f_px * by_y, f_px * by_x, 0.0, by_z / pitch_mm])


def _miscounted(rig: Rig, smear_px: Mapping[str, float]) -> Iterator[Array]:
    """Where a TDI count does not fit the motion it may be the count: frames lie half of it off.

    Layers that are stitched go along; the cones of the datum take it with them, each its share.
    """
    cones = {rig.cone_of(s.name).name for s in datum_candidates(rig)}
    for name in sorted(cones & smear_px.keys()):
        yield np.array([0.0, smear_px[name] / 2.0 / len(cones), 0.0, 0.0])


def _stale(rig: Rig, mosaic: Mosaic, stale_s: float) -> Iterator[Array]:
    """What temperatures that were read long ago may do to the master cone."""
    if stale_s > 0.0:
        yield datum_per_kelvin_px(rig, mosaic) * STALE_K_PER_S * stale_s


def _other_datums(rig: Rig, mosaic: Mosaic, validity: Validity | None) -> Iterator[Array]:
    """How far the datum would lie elsewhere on the master sensors that may be in place (eq. 6)."""
    displaced = (
        None if validity is None else validity.displaced or validity.insignificant_displacement
    )
    if validity is None or displaced is None:
        return
    found = [s for s in datum_candidates(rig) if s.name in mosaic.model.sensors]
    trusted: list[tuple[Sensor, ...]] = []
    if validity.several_displaced:
        trusted += itertools.combinations(found, 2)
    else:
        candidates = {displaced.sensor, *validity.alternatives}
        trusted += [
            tuple(s for s in found if s.name != candidate) for candidate in sorted(candidates)
        ]
    parts, weights = [], []
    for sensors in trusted:
        if len(sensors) < 2:
            continue
        others = [s for s in found if s not in sensors]
        part, *_ = np.linalg.lstsq(_places(sensors), _moved_px(mosaic, sensors), rcond=None)
        left = (_moved_px(mosaic, others) - _places(others) @ part).reshape(-1, 2)
        parts.append(part)
        # Of several explanations the smaller displacements are the likelier ones.
        weights.append(float(np.prod(1.0 / (np.sum(left**2, axis=1) + MIN_DISPLACEMENT_PX**2))))
    for part, weight in zip(parts, weights, strict=True):
        yield part * np.sqrt(weight / sum(weights))


def _places(sensors: Sequence[Sensor]) -> Array:
    return datum_design(np.array([[s.x_mm, s.y_mm] for s in sensors]))


def _moved_px(mosaic: Mosaic, sensors: Sequence[Sensor]) -> Array:
    """Corrections of x and y against calibration and drift, (2 m,) px."""
    first = [mosaic.model.sensors[s.name] for s in sensors]
    return np.concatenate([mosaic.values[i : i + 2] / mosaic.model.pitch_mm for i in first])


def _wrong_temperature(
    rig: Rig, mosaic: Mosaic, estimated_dc: Sequence[EstimatedDc]
) -> Iterator[Array]:
    """What the difference between probes and stitching does to the master cone."""
    off = [e for e in estimated_dc if e.disagrees]
    if not off:
        return
    own = [e for e in off if e.cone == rig.master_cone]
    # Probes of other cones move layers that are stitched anyway; all of them alike, all cones.
    if not own and len(off) < sum(e.estimated_k is not None for e in estimated_dc):
        return
    combined = combined_dc(own or off)
    measured = [e.measured_k for e in own or off if e.measured_k is not None]
    if combined is not None and measured:
        yield datum_per_kelvin_px(rig, mosaic) * (combined[0] - float(np.mean(measured)))


def _is_other_unit_of_one(layers: LayerCheck) -> bool:
    """Whether one changed layer is not all: what it leaves, or both its scale and direction."""
    changed = [layer for layer in layers.layers if layer.cone in layers.causes]
    return layers.several_likely or any(
        (np.abs(layer.values[:3]) > OTHER_LENS_SIGMAS * layer.sigmas[:3])[[0, i]].all()
        for layer in changed
        for i in (1, 2)
    )


def _changed_master(rig: Rig, mosaic: Mosaic, layers: LayerCheck | None) -> Iterator[Array]:
    """The change all other layers share is the master's own.

    Where several cones are not as calibrated, the master's scale is known no better than theirs;
    so is the place of a single master sensor. That of several is tested separately.
    """
    if layers is None:
        return
    is_single = len(rig.master_sensors) == 1
    per_mm = 1e-6 / mosaic.model.pitch_mm
    f_px = mosaic.model.f_mm * per_mm

    def moved(scale_ppm: float, by_x: float, by_y: float, by_z: float) -> Array:
        return np.array([-f_px * by_y, f_px * by_x, scale_ppm * per_mm, by_z * per_mm])

    if layers.master_changed and not (is_single and len(layers.causes) > 1):
        # Each by itself: together they would state one direction only, and that of their noise.
        beyond = np.abs(layers.common) > SCALE_SIGMAS * layers.common_sigmas
        for quantity in np.diag(layers.common)[beyond]:
            yield moved(*quantity)
    elif len(layers.causes) > 1 or (is_single and _is_other_unit_of_one(layers)):
        changes = np.sqrt(np.mean([layer.values**2 for layer in layers.layers], axis=0))
        # Pixels of colour are larger, and so is what a unit differs by in them.
        pan = [v.values for v in layers.layers if rig.cone(v.cone).role == "pan"]
        turns = np.array(pan or [v.values for v in layers.layers])[:, 1:3]
        # The master may have tilted about the axis about which the others did not.
        changes[1:3] = np.sqrt(np.mean(turns**2))
        if is_single:
            # A lens that stands elsewhere across its axis does so along it: the scales of all
            # cones may be off by as much and agree by chance.
            changes[0] = max(changes[0], changes[1])
        for quantity in np.diag(changes)[: 3 if is_single else 1]:
            yield moved(*quantity)
    elif not layers.changed:
        within = (SINGLE_SENSOR_SIGMAS if is_single else SCALE_SIGMAS) * layers.common_sigmas[0]
        beyond = np.sqrt(max(layers.common[0] ** 2 - within**2, 0.0)) * per_mm
        part = np.array([0.0, 0.0, beyond, 0.0])
        per_kelvin = datum_per_kelvin_px(rig, mosaic)
        if is_single and per_kelvin[2] != 0.0:
            # The principal distance or the temperature, which moves a single sensor as well: one
            # is as likely as the other.
            part = part * math.sqrt(0.5)
            yield per_kelvin * part[2] / per_kelvin[2]
        yield part

"""Read-out slips of the colour heads that are registered to green, by their tie points with it.

The transformation of a band bends to meet a shifted band of rows halfway, as the adjustment does in
PAN (`processing.mosaic.readout_slips`): residuals are searched against a similarity, and the head
is registered again without the points of the slip.

Source: docs/explanation/mathematics/validity.md#read-out-slips.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement, vip_mm_from_raw
from processing.image.colour import (
    BandRegistration,
    ColourSettings,
    fitted_registration,
    vip_mm_per_pixel,
)
from processing.matching.tie_points import PAN_TO_PAN, TiePoints
from processing.mosaic.readout_slips import Slip, find_slips, inside_slips, slip_of
from processing.mosaic.slip_settings import SlipSettings
from processing.rig import Rig

Array = NDArray[Any]

_ROUNDS: Final = 8
_TUKEY: Final = 4.685


def without_band_slips(
    rig: Rig,
    green: SensorPlacement,
    placements: Mapping[str, SensorPlacement],
    registrations: Sequence[BandRegistration],
    *,
    settings: ColourSettings,
) -> tuple[tuple[BandRegistration, ...], tuple[Slip, ...]]:
    """Search heads for shifted rows or columns, and register them without these.

    Of two heads or more, what all see at the same place is a slip of green. Of a single one it is
    its own: green is in order where its tie points with PAN are.

    Args:
        rig: the camera.
        green: adjusted placement of the green sensor, of which no slip is known.
        placements: of the heads by calibration and TDM, by sensor name.
        registrations: of the heads.
        settings: of the registration.

    Returns:
        The registrations, and the shifted bands of rows or columns, the worst first.
    """
    heads = [r for r in registrations if len(r.matched_at)]
    if not heads or rig.virtual_image is None:
        return tuple(registrations), ()
    points = _tie_points(green.sensor.name, heads)
    pitch_mm = rig.virtual_image.pitch_mm
    seen = [
        (vip_mm_from_raw(green, r.green_at), vip_mm_from_raw(placements[r.sensor], r.matched_at))
        for r in heads
    ]
    fitted = np.concatenate(
        [_similar(a, b, r.sigma_px) for (a, b), r in zip(seen, heads, strict=True)]
    )
    fitted = fitted / pitch_mm
    calibrated = np.concatenate([a - b for a, b in seen]) / pitch_mm
    own_px = vip_mm_per_pixel(green, heads[0].green_at) / pitch_mm
    limits = SlipSettings(unit_px=own_px)
    sought = points.names if len(heads) > 1 else points.names[1:]
    slips: tuple[Slip, ...] = ()
    for slip in find_slips(rig, points, fitted, sensors=sought, settings=limits):
        measured = slip_of(rig, points, calibrated, slip.sensor, settings=limits) or slip
        slips += (replace(measured, alternatives=slip.alternatives),)
    outside = ~inside_slips(points, slips)
    return tuple(
        _without(r, points, outside, green, placements, settings) for r in registrations
    ), slips


def _without(
    registration: BandRegistration,
    points: TiePoints,
    outside: Array,
    green: SensorPlacement,
    placements: Mapping[str, SensorPlacement],
    settings: ColourSettings,
) -> BandRegistration:
    """A head, registered again where some of its points lie in a slip."""
    if registration.sensor not in points.names:
        return registration
    keep = outside[points.sensor_b == points.names.index(registration.sensor)]
    if keep.all():
        return registration
    other = placements[registration.sensor]
    return fitted_registration(registration, green, other, keep, settings)


def _tie_points(green: str, heads: Sequence[BandRegistration]) -> TiePoints:
    """Matches of heads with green, which is the first frame of all.

    Their kind is not that of points whose second frame is green.
    """
    counts = [len(r.sigma_px) for r in heads]
    of_head = np.repeat(np.arange(len(heads)), counts)
    sigma_px = np.concatenate([r.sigma_px for r in heads])
    return TiePoints(
        names=(green, *(r.sensor for r in heads)),
        pairs=tuple((green, r.sensor) for r in heads),
        attempted=tuple(counts),
        sensor_a=np.zeros(len(of_head), np.int64),
        sensor_b=of_head + 1,
        raw_a=np.concatenate([r.green_at for r in heads]),
        raw_b=np.concatenate([r.matched_at for r in heads]),
        sigma_px=sigma_px,
        correlation=np.ones(len(of_head)),
        kind=np.full(len(of_head), PAN_TO_PAN),
        overlap=of_head,
    )


def _similar(a: Array, b: Array, sigma: Array) -> Array:
    """Residuals (n, 2) of the similarity that carries a to b: a, carried there, less b.

    Iteratively re-weighted least squares (Tukey's biweight); `sigma` in any unit.
    """
    design = np.column_stack([a[:, 0] + 1j * a[:, 1], np.ones(len(a))])
    wanted = b[:, 0] + 1j * b[:, 1]
    weight = 1.0 / sigma
    left = design[:, 0] - wanted
    for _ in range(_ROUNDS):
        length = np.abs(left) / sigma
        outlying = length / (_TUKEY * max(1.4826 * float(np.median(length)) / 1.1774, 1e-9))
        weight = np.where(outlying < 1.0, 1.0 - outlying**2, 0.0) / sigma
        fit, *_ = np.linalg.lstsq(design * weight[:, None], wanted * weight, rcond=None)
        left = design @ fit - wanted
    return np.column_stack([left.real, left.imag])

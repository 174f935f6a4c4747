"""Made-up exposures with a known truth: perturbed placements and the tie points they imply."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import (
    SensorPlacement,
    nominal_placements,
    raw_from_vip_mm,
)
from processing.geometry.topology import (
    Rectangle,
    colour_coverage,
    colour_ratio,
    exact_colour_ratio,
    overlaps,
)
from processing.matching.tie_points import PAN_TO_COLOUR, PAN_TO_PAN, TiePoints
from processing.mosaic.free_mosaic import free_mosaic
from processing.mosaic.model import MosaicModel, placement_at
from processing.rig import Rig

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Truth:
    """The start the pipeline knows, the placements that hold, and the unknowns between them."""

    rig: Rig
    start: dict[str, SensorPlacement]
    placements: dict[str, SensorPlacement]
    model: MosaicModel
    values: Array


def mosaic_model_of(rig: Rig) -> MosaicModel:
    return free_mosaic(rig, nominal_placements(rig, {}, {}), no_tie_points(rig)).model


def make_truth(
    rig: Rig,
    rng: np.random.Generator,
    *,
    temperature_c: float = 30.0,
    sensor_px: float = 1.0,
    layer_px: float = 3.0,
    displaced: Mapping[str, tuple[float, float]] | None = None,
) -> Truth:
    """Truth at some temperature: sensors off by `sensor_px`, layers by `layer_px` (standard
    deviations), and sensors `displaced` by (x, y) px on top."""
    start = nominal_placements(rig, dict.fromkeys(rig.probes, temperature_c), {})
    model = mosaic_model_of(rig)
    spread = np.zeros(len(model.names))
    for first in model.sensors.values():
        spread[first : first + 4] = sensor_px
    for first in model.mountings.values():
        spread[first : first + 3] = layer_px
    for first in model.layers.values():
        spread[first : first + 8] = layer_px / 3.0
        spread[first + np.array([2, 5])] = layer_px
    values = rng.normal(0.0, 1.0, len(spread)) * spread * model.units
    for axis in range(3):
        rotation_rows = [first + axis for first in model.mountings.values()]
        values[rotation_rows] -= values[rotation_rows].mean() if rotation_rows else 0.0
    for name, (x, y) in (displaced or {}).items():
        values[model.sensors[name]] += x * model.pitch_mm
        values[model.sensors[name] + 1] += y * model.pitch_mm
    placements = {name: placement_at(model, p, values) for name, p in start.items()}
    return Truth(rig, start, placements, model, values)


def no_tie_points(rig: Rig) -> TiePoints:
    none = np.empty(0)
    index = np.empty(0, dtype=np.int64)
    pair = np.empty((0, 2))
    return TiePoints(
        names=tuple(s.name for s in rig.sensors),
        pairs=_pairs(rig),
        attempted=(0,) * len(_pairs(rig)),
        sensor_a=index,
        sensor_b=index,
        raw_a=pair,
        raw_b=pair,
        sigma_px=none,
        correlation=none,
        kind=index,
        overlap=index,
    )


def tie_points_of(
    truth: Truth,
    rng: np.random.Generator,
    *,
    per_overlap: int = 120,
    per_sensor: int = 400,
    sigma_pp_px: float = 0.1,
    sigma_pc_px: float = 0.3,
    without: tuple[str, ...] = (),
    without_kind: int | None = None,
) -> TiePoints:
    """Exact tie points of the truth plus Gaussian noise of the given sigma of the difference."""
    rig = truth.rig
    names = tuple(s.name for s in rig.sensors)
    ratio = colour_ratio(rig) or exact_colour_ratio(rig) or 1
    areas: list[tuple[str, str, Rectangle, int]] = [
        (o.sensor_a, o.sensor_b, o.rectangle, PAN_TO_PAN) for o in overlaps(rig)
    ]
    if rig.colour_master_cone is not None:
        green = rig.cone(rig.colour_master_cone).sensors[0].name
        areas += [(n, green, r, PAN_TO_COLOUR) for n, r in colour_coverage(rig).items()]
    rows = []
    for number, (a, b, area, kind) in enumerate(areas):
        if a in without or b in without or kind == without_kind:
            continue
        count, sigma = (
            (per_overlap, sigma_pp_px) if kind == PAN_TO_PAN else (per_sensor, sigma_pc_px)
        )
        xy = np.stack(
            [
                rng.uniform(area.x_min_mm, area.x_max_mm, count),
                rng.uniform(area.y_min_mm, area.y_max_mm, count),
            ],
            axis=1,
        )
        raw_a = raw_from_vip_mm(truth.placements[a], xy)
        raw_b = raw_from_vip_mm(truth.placements[b], xy)
        # Noise of the difference, in PAN px, shared between both sides.
        step = 1.0 if kind == PAN_TO_PAN else float(ratio)
        raw_a = raw_a + rng.normal(0.0, sigma / np.sqrt(2.0), raw_a.shape)
        raw_b = raw_b + rng.normal(0.0, sigma / np.sqrt(2.0) / step, raw_b.shape)
        block = np.zeros((count, 8))
        block[:, 0], block[:, 1] = names.index(a), names.index(b)
        block[:, 2:4], block[:, 4:6] = raw_a, raw_b
        block[:, 6], block[:, 7] = kind, number
        rows.append(block)
    table = np.concatenate(rows) if rows else np.empty((0, 8))
    kinds = table[:, 6].astype(np.int64)
    return TiePoints(
        names=names,
        pairs=tuple((a, b) for a, b, _, _ in areas),
        attempted=tuple(per_overlap if k == PAN_TO_PAN else per_sensor for _, _, _, k in areas),
        sensor_a=table[:, 0].astype(np.int64),
        sensor_b=table[:, 1].astype(np.int64),
        raw_a=table[:, 2:4].copy(),
        raw_b=table[:, 4:6].copy(),
        sigma_px=np.where(kinds == PAN_TO_PAN, sigma_pp_px, sigma_pc_px),
        correlation=np.ones(len(table)),
        kind=kinds,
        overlap=table[:, 7].astype(np.int64),
    )


def _pairs(rig: Rig) -> tuple[tuple[str, str], ...]:
    pairs = [(o.sensor_a, o.sensor_b) for o in overlaps(rig)]
    if rig.colour_master_cone is not None:
        green = rig.cone(rig.colour_master_cone).sensors[0].name
        pairs += [(name, green) for name in colour_coverage(rig)]
    return tuple(pairs)

"""Record of one exposure's stitching: corrections of sensor positions, in a compact form.

Corrections of the adjustment against calibration + TDM with their covariance; what is learned from
many of them is in `processing.calibration.thermal_learning`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from processing import ProcessingError
from processing.geometry.drift import sensor_dc
from processing.geometry.topology import mosaic_cones
from processing.image.colour import BandRegistration
from processing.mosaic.estimated_dc import EstimatedDc
from processing.mosaic.free_mosaic import Mosaic
from processing.mosaic.mounting import rotation_of_band, rotation_of_layer
from processing.rig import Cone, Rig

Array = NDArray[np.float64]

STITCH_FORMAT = 1
SENSOR_UNITS = {"x_um": 1e3, "y_um": 1e3, "rotation_urad": 1e6, "scale_ppm": 1e6}
"""Quantities of a sensor, and what turns the adjustment's own units (mm, rad, 1) into theirs."""
LAYER_SCALE = "layer_scale_ppm"
ROTATIONS = ("rotation_x_urad", "rotation_y_urad", "rotation_z_urad")
"""Rotation of a cone against its calibration, about the axes of the virtual image."""


class StitchRecordError(ProcessingError, ValueError):
    """A record that cannot be read; the sentence names the key."""


@dataclass(frozen=True)
class StitchRecord:
    """Corrections against the calibrated place at dC plus drift.

    `names` are `<sensor>.x_um`, `.y_um`, `.rotation_urad`, `.scale_ppm` for sensors of cones with
    two or more, in their layer, `<cone>.layer_scale_ppm` for every layer but the master's, and
    `<cone>.rotation_x_urad`, `_y_`, `_z_` for every cone that is not the master, colour included;
    `values` (n,) and `covariance` (n, n) go with them. What tie points did not determine is left
    out. `dc_k` is the dC by sensor the start was made with; `measured` are the sensors whose own
    probe was read. Values are in the gauge of the adjustment: a similarity common to the sensors of
    a cone means nothing. `height_m` above ground is None where it was not known.
    """

    rig: str
    calibration_id: str
    dc_k: Mapping[str, float]
    measured: tuple[str, ...]
    names: tuple[str, ...]
    values: Array
    covariance: Array
    sigma0: float
    estimated_dc: tuple[EstimatedDc, ...] = ()
    height_m: float | None = None


def stitch_record(
    rig: Rig,
    mosaic: Mosaic,
    placing_c: Mapping[str, float],
    measured_c: Mapping[str, float],
    estimated_dc: Sequence[EstimatedDc] = (),
    *,
    bands: Sequence[BandRegistration] = (),
    height_m: float | None = None,
) -> StitchRecord:
    """The record of a free mosaic.

    Args:
        rig: the camera.
        mosaic: the adjustment.
        placing_c: temperatures its start was made with, by probe name.
        measured_c: those of them that were read.
        estimated_dc: what `processing.mosaic.estimated_dc` made of it.
        bands: how the other colours were registered to green.
        height_m: of the exposure above ground; None where it is not known.

    Returns:
        Determined quantities with their covariance.
    """
    held = set(mosaic.undetermined)
    rows: list[Array] = []
    names: list[str] = []
    sensors = [s for cone in mosaic_cones(rig) for s in cone.sensors]
    for sensor in sensors:
        first = mosaic.model.sensors.get(sensor.name)
        if first is None or any(name.startswith(f"{sensor.name}.") for name in held):
            continue
        for k, (what, unit) in enumerate(SENSOR_UNITS.items()):
            row = np.zeros(len(mosaic.model.names))
            row[first + k] = unit
            rows.append(row)
            names.append(f"{sensor.name}.{what}")
    for cone in mosaic_cones(rig):
        first = mosaic.model.layers.get(cone.name)
        if first is None or any(name.startswith(f"{cone.name}.") for name in held):
            continue
        rows.append(layer_scale_design(mosaic, cone, first))
        names.append(f"{cone.name}.{LAYER_SCALE}")
    for cone in mosaic_cones(rig):
        rotation_vector = rotation_of_layer(rig, mosaic, cone)
        if rotation_vector is not None and not any(
            name.startswith(f"{cone.name}.") for name in held
        ):
            rows += list(rotation_vector * 1e6)
            names += [f"{cone.name}.{what}" for what in ROTATIONS]
    design = np.array(rows).reshape(len(rows), len(mosaic.model.names))
    values = [design @ mosaic.values]
    covariances = [design @ mosaic.covariance @ design.T]
    for band in bands:
        if band.registered:
            rotation_vector, sigma = rotation_of_band(rig, mosaic, band)
            values.append(rotation_vector * 1e6)
            covariances.append(np.diag((sigma * 1e6) ** 2))
            names += [f"{rig.cone_of(band.sensor).name}.{what}" for what in ROTATIONS]
    return StitchRecord(
        rig=rig.name,
        calibration_id=rig.calibration_id,
        dc_k={s.name: sensor_dc(s, placing_c) for s in sensors},
        measured=tuple(s.name for s in sensors if s.probe in measured_c),
        names=tuple(names),
        values=np.concatenate(values),
        covariance=block_diag(*covariances),
        sigma0=mosaic.sigma0,
        estimated_dc=tuple(estimated_dc),
        height_m=height_m,
    )


def stitch_record_json(record: StitchRecord) -> dict[str, Any]:
    """The record as JSON-ready data.

    Args:
        record: of one exposure.

    Returns:
        Content of `mosaic.json`; the covariance as its lower triangle, row by row.
    """
    lower = record.covariance[np.tril_indices(len(record.names))]
    return {
        "format": STITCH_FORMAT,
        "rig": record.rig,
        "calibration_id": record.calibration_id,
        "dc_k": {name: _short(k) for name, k in record.dc_k.items()},
        "measured": list(record.measured),
        "names": list(record.names),
        "values": [_short(v) for v in record.values],
        "covariance": [_short(v) for v in lower],
        "sigma0": _short(record.sigma0),
        "height_m": record.height_m,
        "estimated_dc": [
            {
                "cone": e.cone,
                "estimated_k": e.estimated_k,
                "sigma_k": e.sigma_k,
                "measured_k": e.measured_k,
                "expansion_ppm": e.expansion_ppm,
                "rate_ppm_per_k": e.rate_ppm_per_k,
                "disagrees": e.disagrees,
            }
            for e in record.estimated_dc
        ],
    }


def stitch_record_from_json(content: Mapping[str, Any]) -> StitchRecord:
    """Read what `stitch_record_json` wrote.

    Args:
        content: parsed JSON.

    Returns:
        The record.

    Raises:
        StitchRecordError: a key is missing, or sizes do not fit.
    """
    try:
        if content["format"] != STITCH_FORMAT:
            raise StitchRecordError(f"format is {content['format']!r}; this reads {STITCH_FORMAT}")
        names = tuple(str(name) for name in content["names"])
        n = len(names)
        values = np.array(content["values"], np.float64)
        lower = np.array(content["covariance"], np.float64)
        if values.shape != (n,) or lower.shape != (n * (n + 1) // 2,):
            raise StitchRecordError(
                f"{n} names, {values.size} values and {lower.size} covariances; "
                f"{n} and {n * (n + 1) // 2} are right"
            )
        covariance = np.zeros((n, n))
        covariance[np.tril_indices(n)] = lower
        covariance += np.tril(covariance, -1).T
        return StitchRecord(
            rig=str(content["rig"]),
            calibration_id=str(content["calibration_id"]),
            dc_k={str(name): float(k) for name, k in content["dc_k"].items()},
            measured=tuple(str(name) for name in content["measured"]),
            names=names,
            values=values,
            covariance=covariance,
            sigma0=float(content["sigma0"]),
            estimated_dc=tuple(EstimatedDc(**e) for e in content["estimated_dc"]),
            height_m=None if content.get("height_m") is None else float(content["height_m"]),
        )
    except (KeyError, TypeError, AttributeError, OverflowError) as error:
        raise StitchRecordError(f"mosaic.json cannot be used: {error!r}") from error
    except ValueError as error:
        raise StitchRecordError(f"mosaic.json cannot be used: {error}") from error


def layer_scale_design(mosaic: Mosaic, cone: Cone, first: int) -> Array:
    """ln(local scale) of the correction of P at the middle of the cone's sensors.

    Half the divergence of P = I + p: (p11 + p22) / 2 - 3/2 (p31 x + p32 y), lengths in half sizes.

    Args:
        mosaic: the adjustment.
        cone: a cone with a free layer.
        first: index of the layer's first unknown, p11.

    Returns:
        ppm per unknown, (u,).
    """
    x, y = np.mean([[s.x_mm, s.y_mm] for s in cone.sensors], axis=0) / mosaic.model.half_size_mm
    row = np.zeros(len(mosaic.model.names))
    row[first] = row[first + 4] = 0.5e6
    row[first + 6], row[first + 7] = -1.5e6 * x, -1.5e6 * y
    return row


def _short(value: float) -> float:
    """Nine digits: below a thousandth of any standard deviation here."""
    return float(f"{value:.9g}")

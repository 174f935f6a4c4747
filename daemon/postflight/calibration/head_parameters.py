"""Parameters of heads that one adjustment found: values, covariance, and their table.

Common to calibrations from a board and from a flight.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.calibration.calibration_report import Quantity, ReportTable
from processing.bundle.adjust import Adjustment
from processing.bundle.network import INTERIOR
from processing.calibration.board.network import LENS_KEYS
from processing.geometry.rotation import angles_by_rotation_vector, rotation_matrix
from processing.rig import Cone, Rig

Array = NDArray[np.float64]

_UNITS: Final = {
    "k1": "mm^-2",
    "k2": "mm^-4",
    "k3": "mm^-6",
    "p1": "mm^-1",
    "p2": "mm^-1",
    "b1": "1",
    "b2": "1",
}


class AdjustedHeads(Protocol):
    """Heads with a lens each and, all but one, a mounting, by one adjustment.

    `heads` are in the order of its cameras, `oriented_heads` those with a new mounting; cofactors
    times `variance_factor` are covariances.
    """

    @property
    def rig(self) -> Rig: ...

    @property
    def before(self) -> Rig: ...

    @property
    def heads(self) -> tuple[str, ...]: ...

    @property
    def oriented_heads(self) -> tuple[str, ...]: ...

    @property
    def adjustment(self) -> Adjustment: ...

    @property
    def variance_factor(self) -> float: ...


@dataclass(frozen=True)
class HeadParameter:
    """One number with its column: its derivative by the column's unknown is `sign`.

    Values are in mm, rad and ones.
    """

    where: str
    what: str
    unit: str
    value: float
    before: float
    column: int
    sign: float = 1.0


def estimated_parameters(found: AdjustedHeads) -> list[HeadParameter]:
    """Lenses, sensor places, and small rotations and offsets of heads, as the rig file has them."""
    result, rows = found.adjustment, []
    for k, name in enumerate(found.heads):
        new, old = found.rig.cone(name), found.before.cone(name)
        columns = result.layout.interior[k]
        named = {
            "dx0": ("x", new.sensors[0].x_mm, old.sensors[0].x_mm + old.lens.dx0_mm, 1.0),
            "dy0": ("y", new.sensors[0].y_mm, old.sensors[0].y_mm + old.lens.dy0_mm, 1.0),
            # A larger df is a shorter principal distance.
            "df": ("f", new.lens.f_mm, _distance(old), -1.0),
        }
        for j, parameter in enumerate(INTERIOR):
            if columns[j] < 0:
                continue
            what, value, before, sign = named.get(
                parameter,
                (
                    parameter,
                    float(getattr(new.lens, LENS_KEYS[parameter])),
                    float(getattr(old.lens, LENS_KEYS[parameter])),
                    1.0,
                ),
            )
            unit = _UNITS.get(parameter, "mm")
            rows.append(HeadParameter(name, what, unit, value, before, int(columns[j]), sign))
    for k, head in enumerate(result.network.heads):
        if head.name not in found.oriented_heads:
            continue
        new, old = found.rig.cone(head.name), found.before.cone(head.name)
        for axis, what in enumerate(("omega", "phi", "kappa")):
            rows.append(
                HeadParameter(
                    head.name,
                    what,
                    "rad",
                    new.rotation_rad[axis],
                    old.rotation_rad[axis],
                    int(result.layout.head_rotation[k, axis]),
                )
            )
        # Offsets are in the axes of the reference camera: right, forward, up.
        for axis, (what, place, sign) in enumerate(
            (("right", 1, 1e3), ("forward", 0, 1e3), ("down", 2, -1e3))
        ):
            rows.append(
                HeadParameter(
                    head.name,
                    what,
                    "mm",
                    new.position_mm[place],
                    old.position_mm[place],
                    int(result.layout.head_offset[k, axis]),
                    sign,
                )
            )
    return rows


def _distance(cone: Cone) -> float:
    return cone.lens.f_mm / (1.0 + cone.lens.df_mm / cone.lens.f_mm)


def covariance_of(found: AdjustedHeads, rows: Sequence[HeadParameter]) -> Array:
    """Covariance (n, n), in mm, rad and ones; rotations are small ones about the head's axes.

    Offsets are along the axes of the reference camera.
    """
    columns = np.array([r.column for r in rows])
    sign = np.array([r.sign for r in rows])
    cofactor = found.variance_factor * found.adjustment.cofactor[np.ix_(columns, columns)]
    return np.asarray(cofactor * sign[:, None] * sign)


def covariance_bytes(found: AdjustedHeads) -> bytes:
    """`covariance.npz`: names, values and covariance in mm, rad and ones."""
    rows = estimated_parameters(found)
    stream = io.BytesIO()
    np.savez(
        stream,
        names=np.array([f"{r.where} {r.what}" for r in rows]),
        values=np.array([r.value for r in rows]),
        covariance=covariance_of(found, rows),
    )
    return stream.getvalue()


def quantities_of(found: AdjustedHeads) -> list[Quantity]:
    """Everything estimated, angles in degrees of omega, phi, kappa."""
    rows = estimated_parameters(found)
    covariance = covariance_of(found, rows)
    sigma = np.sqrt(np.diag(covariance))
    angles: dict[str, Array] = {}
    for k, row in enumerate(rows):
        if row.what == "omega":
            cone = found.rig.cone(row.where)
            by = angles_by_rotation_vector("XYZ", rotation_matrix(*cone.rotation_rad))
            own = by @ covariance[k : k + 3, k : k + 3] @ by.T
            angles[row.where] = np.sqrt(np.diag(own))
    quantities = []
    for row, s in zip(rows, sigma.tolist(), strict=True):
        if row.unit == "rad":
            axis = ("omega", "phi", "kappa").index(row.what)
            degrees = math.degrees(float(angles[row.where][axis]))
            quantities.append(
                Quantity(row.where, row.what, "deg", math.degrees(row.value), degrees)
            )
        else:
            quantities.append(Quantity(row.where, row.what, row.unit, row.value, s))
    return quantities


def parameter_table(rows: Sequence[HeadParameter], quantities: Sequence[Quantity]) -> ReportTable:
    """Values, standard deviations, and what the rig file had before."""

    def in_unit(row: HeadParameter, value: float) -> float:
        return math.degrees(value) if row.unit == "rad" else value

    return ReportTable(
        "Parameters",
        ("head", "what", "value", "sigma", "unit", "in the rig file"),
        [
            (
                q.where,
                q.what,
                float(f"{q.value:.9g}"),
                float(f"{q.sigma or 0.0:.3g}"),
                q.unit,
                float(f"{in_unit(r, r.before):.9g}"),
            )
            for r, q in zip(rows, quantities, strict=True)
        ],
        "x, y: centre of the sensor about the principal point; f: principal distance; the others "
        "after Heier et al. (2002), eq. 5.1, ideal from measured.",
    )

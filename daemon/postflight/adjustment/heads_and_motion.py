"""Heads of an adjustment project with their timing, and the motion of the rig at its exposures.

`motion.csv` states for each exposure what delays and readout times are multiplied by.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.adjustment.csv_tables import CsvTable, write_table
from daemon.postflight.adjustment.project_file import AdjustmentHeadSection
from processing.bundle.network import HeadMounting, HeadTiming, Motion, Network
from processing.bundle.unknowns import ParameterValues
from processing.geometry.rotation import rotation_matrix

Array = NDArray[np.float64]

VELOCITY: Final = ("vx_mps", "vy_mps", "vz_mps")
ACCELERATION: Final = ("ax_mps2", "ay_mps2", "az_mps2")
RATE: Final = ("rate_x_deg_s", "rate_y_deg_s", "rate_z_deg_s")
RATE_CHANGE: Final = ("rate_change_x_deg_s2", "rate_change_y_deg_s2", "rate_change_z_deg_s2")
NEEDED: Final = ("exposure", *VELOCITY, *RATE)
KNOWN: Final = (*ACCELERATION, *RATE_CHANGE)


def head_of(section: AdjustmentHeadSection) -> HeadMounting:
    """A head of a project file."""
    angles = np.radians([section.omega_deg, section.phi_deg, section.kappa_deg])
    sigma = section.rotation_sigma_deg
    return HeadMounting(
        section.name,
        rotation_matrix(*angles),
        np.array([section.x_m, section.y_m, section.z_m]),
        rotation_free=section.rotation == "free",
        offset_free=section.offset == "free",
        rotation_sigma_rad=None if sigma is None else math.radians(sigma),
        offset_sigma_m=section.offset_sigma_m,
        timing=HeadTiming(
            delay_s=section.delay_ms * 1e-3,
            delay_free=section.delay == "free",
            delay_sigma_s=_seconds(section.delay_sigma_ms),
            readout_s=section.readout_ms * 1e-3,
            readout_free=section.readout == "free",
            readout_sigma_s=_seconds(section.readout_sigma_ms),
            frame_height_mm=section.frame_height_mm or math.inf,
            jitter_sigma_s=_seconds(section.jitter_sigma_ms),
        ),
    )


def timing_values(state: ParameterValues, head: int) -> dict[str, Any]:
    """Current delay and readout time of a head as keys of a project file, where not zero."""
    values = {"delay_ms": state.head_delay[head] * 1e3, "readout_ms": state.readout[head] * 1e3}
    return {name: float(value) for name, value in values.items() if value != 0.0}


def motion_of(table: CsvTable, exposures: Sequence[str]) -> Motion:
    """The motion at the exposures; mistakes are added to the table's problems."""
    at = {name: k for k, name in enumerate(exposures)}
    index = []
    for name, line in zip(table.names("exposure"), table.lines, strict=True):
        if name not in at:
            table.add_problem(line, f"exposure {name!r} is not there")
        index.append(at.get(name, 0))
    missing = sorted(set(exposures) - set(table.text("exposure")))
    if missing:
        table.add_problem(
            table.header,
            f"{len(missing)} exposures have no motion, first {missing[0]}; every exposure needs "
            "its velocity and rates",
        )

    def rows(columns: Sequence[str], default: float) -> Array:
        values = np.array([table.numbers(c, default) for c in columns]).T.reshape(-1, 3)
        for row in np.flatnonzero(~np.isfinite(values).all(axis=1)):
            table.add_problem(table.lines[row], f"{', '.join(columns)} need a number each")
        result = np.zeros((len(exposures), 3))
        result[index] = np.nan_to_num(values)
        return result

    return Motion(
        rows(VELOCITY, math.nan),
        rows(ACCELERATION, 0.0),
        np.radians(rows(RATE, math.nan)),
        np.radians(rows(RATE_CHANGE, 0.0)),
    )


def write_motion(path: Path, network: Network) -> None:
    """The motion of a network as `motion.csv`."""
    motion = network.motion
    if motion is None:
        return
    values = np.hstack(
        [
            motion.velocity_mps,
            np.degrees(motion.rate_rad_per_s),
            motion.acceleration_mps2,
            np.degrees(motion.rate_change_rad_per_s2),
        ]
    )
    write_table(
        path,
        "Motion of the rig's origin at the exposures; rates about the rig's axes (x right, y "
        "forward, z up).",
        (*NEEDED, *KNOWN),
        (
            (name, *(float(v) for v in row))
            for name, row in zip(network.stations.names, values, strict=True)
        ),
    )


def _seconds(ms: float | None) -> float | None:
    return None if ms is None else ms * 1e-3

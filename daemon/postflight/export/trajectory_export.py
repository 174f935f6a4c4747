"""A trajectory in the files of other programs: SBET with its accuracies, CSV, RTKLIB's `.pos`.

Coordinates are those of the trajectory: WGS 84 (EPSG:4979) at the epoch of the observations, of the
point whose position the receiver reports. What a format requires and a sample does not have leaves
the sample out, and is counted.

Source: Applanix, "SBET and SMRMSG file formats"; RTKLIB 2.4.2 manual, appendix B.1.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Literal

import numpy as np

from daemon import DaemonError
from daemon.mission.layout import Mission
from daemon.mission.store.level2 import write_folder
from daemon.orientation.exterior_orientation import sealed_exposures
from daemon.orientation.orientation_inputs import trajectory_of
from daemon.orientation.trajectory import CSV_COLUMNS, WEEK_NS, Trajectory
from drivers.contract import NavSample

Format = Literal["sbet", "csv", "pos"]
FORMATS: tuple[Format, ...] = ("sbet", "csv", "pos")
ARCMIN_PER_RAD = 60.0 * 180.0 / math.pi
RTKLIB_SINGLE = 5
"""RTKLIB's quality of a position whose ambiguities are not known to be fixed."""
_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)


class TrajectoryExportError(DaemonError):
    """A trajectory that a format cannot hold; the message states what is missing."""


@dataclass(frozen=True)
class TrajectoryExport:
    """The folder, its files, and the numbers of samples written and left out."""

    folder: Path
    files: tuple[str, ...]
    samples: int
    left_out: int
    trajectory: str


def export_trajectory(
    mission: Mission,
    kind: Format,
    *,
    trajectory_file: Path | None = None,
    receiver: str | None = None,
    attitude_sigma_rad: tuple[float, float, float] | None = None,
) -> TrajectoryExport:
    """Write `export/trajectory/<trajectory>/`.

    Args:
        kind: the format.
        trajectory_file: post-processed; None is the navigation of the flight.
        receiver: whose navigation, where the flight had several.
        attitude_sigma_rad: of roll, pitch and heading: SMRMSG is written with them only.

    Raises:
        TrajectoryExportError: no sample has what the format requires.
        TrajectoryError, OrientationError: as their modules say.
        OSError: the disk refused.
    """
    exposures = list(sealed_exposures(mission).results.values())
    trajectory = trajectory_of(mission, exposures, trajectory_file, receiver)
    every = list(_samples(trajectory))
    usable = [sample for sample in every if _is_usable(sample, kind)]
    if len(usable) < 2:
        needed = "standard deviations" if kind == "pos" else "attitude"
        raise TrajectoryExportError(
            f"{trajectory.name}: {len(usable)} of {len(every)} samples have a height and {needed}, "
            f"which {kind} requires; choose another format or trajectory"
        )
    name = trajectory.name
    files: dict[str, bytes] = {}
    if kind == "sbet":
        files[f"{name}.sbet"] = _sbet(usable)
        if attitude_sigma_rad is not None and all(_has_all_sigmas(one) for one in usable):
            files[f"{name}.smrmsg"] = _smrmsg(usable, attitude_sigma_rad)
    elif kind == "csv":
        files[f"{name}.csv"] = _csv(usable)
    else:
        files[f"{name}.pos"] = _pos(usable)
    about = {
        "format": 1,
        "trajectory": name,
        "crs": "EPSG:4979 (WGS 84), at the epoch of the observations",
        "time": "GPS time",
        "point": "the point whose position the receiver reports ([mount] antenna_m)",
        "first_gps_ns": str(usable[0].gps_ns),
        "last_gps_ns": str(usable[-1].gps_ns),
        "gps_week": usable[0].gps_ns // WEEK_NS,
        "simulated": any(exposure.simulated for exposure in exposures),
    }
    files["about.json"] = (json.dumps(about, indent=1) + "\n").encode()
    folder = mission.export_dir / "trajectory" / f"{name}-{kind}"
    write_folder(folder, {file: [data] for file, data in files.items()})
    left_out = len(every) - len(usable)
    return TrajectoryExport(folder, tuple(files), len(usable), left_out, name)


def _samples(trajectory: Trajectory) -> Iterator[NavSample]:
    return (trajectory.sample(i) for i in range(len(trajectory.instants_ns)))


def _is_usable(sample: NavSample, kind: Format) -> bool:
    if sample.position is None or sample.height_m is None:
        return False
    if kind == "pos":
        return _has_sigma(sample)
    if kind == "sbet" and (sample.velocity_ned_mps is None or None in sample.velocity_ned_mps):
        return False
    return None not in (sample.roll_rad, sample.pitch_rad, sample.heading_rad)


def _has_sigma(sample: NavSample) -> bool:
    return sample.horizontal_sigma_m is not None and sample.vertical_sigma_m is not None


def _has_all_sigmas(sample: NavSample) -> bool:
    return _has_sigma(sample) and sample.speed_sigma_mps is not None


def _sbet(samples: Sequence[NavSample]) -> bytes:
    """Seconds of the first sample's week, which run past its end; wander angle zero."""
    week_ns = samples[0].gps_ns // WEEK_NS * WEEK_NS
    rows = np.zeros((len(samples), 17), "<f8")
    for row, one in zip(rows, samples, strict=True):
        latitude, longitude, height = _place(one)
        row[0] = (one.gps_ns - week_ns) * 1e-9
        row[1:4] = math.radians(latitude), math.radians(longitude), height
        row[4:7] = one.velocity_ned_mps or math.nan
        row[7:10] = _attitude(one)
    return rows.tobytes()


def _smrmsg(samples: Sequence[NavSample], sigma_rad: tuple[float, float, float]) -> bytes:
    """Time, standard deviations of place (m), velocity (m/s) and attitude (arc minutes)."""
    week_ns = samples[0].gps_ns // WEEK_NS * WEEK_NS
    rows = np.zeros((len(samples), 10), "<f8")
    for row, one in zip(rows, samples, strict=True):
        horizontal, vertical = one.horizontal_sigma_m, one.vertical_sigma_m
        row[0] = (one.gps_ns - week_ns) * 1e-9
        row[1:4] = horizontal, horizontal, vertical
        row[4:7] = one.speed_sigma_mps
        row[7:10] = [sigma * ARCMIN_PER_RAD for sigma in sigma_rad]
    return rows.tobytes()


def _csv(samples: Sequence[NavSample]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("gps_ns", *CSV_COLUMNS))
    for one in samples:
        latitude, longitude, height = _place(one)
        angles = (f"{math.degrees(angle):.9f}" for angle in _attitude(one))
        writer.writerow(
            (one.gps_ns, f"{latitude:.11f}", f"{longitude:.11f}", f"{height:.5f}", *angles)
        )
    return text.getvalue().encode()


def _pos(samples: Sequence[NavSample]) -> bytes:
    lines = [
        "% program   : Syntopic",
        "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,"
        "ns=# of satellites)",
        "%  GPST                        latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   "
        "sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio",
    ]
    for one in samples:
        seconds, rest = divmod(one.gps_ns, 1_000_000_000)
        at = _GPS_EPOCH + timedelta(seconds=seconds)
        latitude, longitude, height = _place(one)
        horizontal, vertical = one.horizontal_sigma_m or 0.0, one.vertical_sigma_m or 0.0
        lines.append(
            f"{at:%Y/%m/%d %H:%M:%S}.{rest:09d} {latitude:15.10f} {longitude:15.10f} "
            f"{height:11.4f} "
            f"{RTKLIB_SINGLE:3d} {one.satellites or 0:3d} {horizontal:8.4f} {horizontal:8.4f} "
            f"{vertical:8.4f} {0.0:8.4f} {0.0:8.4f} {0.0:8.4f} {0.0:6.2f} {0.0:6.1f}"
        )
    return ("\n".join(lines) + "\n").encode()


def _place(sample: NavSample) -> tuple[float, float, float]:
    if sample.position is None or sample.height_m is None:
        raise TrajectoryExportError(f"no place at {sample.gps_ns}")
    return (*sample.position, sample.height_m)


def _attitude(sample: NavSample) -> tuple[float, float, float]:
    if sample.roll_rad is None or sample.pitch_rad is None or sample.heading_rad is None:
        raise TrajectoryExportError(f"no attitude at {sample.gps_ns}")
    return sample.roll_rad, sample.pitch_rad, sample.heading_rad

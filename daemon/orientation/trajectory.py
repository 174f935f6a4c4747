"""The way the camera flew: the flight's own navigation, or a post-processed trajectory from a file.

A trajectory answers where the camera was at an instant. Where it comes from differs, how it is
interpolated does not (`daemon.orientation.navigation`).
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.canonical_json import sha256_hex
from daemon.mission.exposure import NavigationRecord
from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import logs_of, read
from daemon.mission.log.log_records import record_of
from daemon.orientation.geodesy import metres_per_degree
from daemon.orientation.navigation import EXTRAPOLATION_LIMIT_NS, navigation_at
from drivers.contract import NavSample

WEEK_NS = 604_800_000_000_000
TRAJECTORY_MAX_BYTES = 4_000_000_000
SBET_TIME_MAX_S = 1e8
"""Seconds of the week, and weeks after its end."""
SBET_FIELDS = (
    *("time_s", "latitude_rad", "longitude_rad", "height_m", "x_velocity", "y_velocity"),
    *("z_velocity", "roll_rad", "pitch_rad", "platform_heading_rad", "wander_rad"),
    *("x_acceleration", "y_acceleration", "z_acceleration", "x_rate", "y_rate", "z_rate"),
)
SBET_RECORD_BYTES = 8 * len(SBET_FIELDS)
CSV_COLUMNS = ("latitude_deg", "longitude_deg", "height_m", "roll_deg", "pitch_deg", "heading_deg")


class TrajectoryError(DaemonError):
    """A trajectory that cannot be used; the message names file, place and what would be right."""


@dataclass(frozen=True)
class Trajectory:
    """Samples in the order of time, created on demand: an SBET holds a million.

    `name` distinguishes versions: "in-flight", or the file's name and the beginning of its hash.
    `instants_ns` is strictly increasing, GPS time, (n,) int64; `sample` gives the i-th.
    """

    name: str
    instants_ns: NDArray[np.int64]
    sample: Callable[[int], NavSample]

    def at(self, gps_ns: int) -> NavigationRecord | None:
        """Navigation at an instant; None where no sample is within two seconds."""
        index = int(np.searchsorted(self.instants_ns, gps_ns, side="right"))
        earlier = range(index - 1, -1, -1)
        later = range(index, len(self.instants_ns))
        near = [*self._near(earlier, gps_ns), *self._near(later, gps_ns)]
        return navigation_at(near, gps_ns)

    def _near(self, indices: range, gps_ns: int) -> Iterator[NavSample]:
        """The samples within reach in one direction, as far as one with a height."""
        for i in indices:
            if abs(int(self.instants_ns[i]) - gps_ns) > EXTRAPOLATION_LIMIT_NS:
                return
            sample = self.sample(i)
            yield sample
            if sample.height_m is not None:
                return


def flown_trajectory(mission: Mission, receiver: str | None = None) -> Trajectory:
    """The navigation that was recorded in flight.

    Args:
        receiver: which one; by default the one with the most samples that know the attitude, or
            the most samples.

    Raises:
        TrajectoryError: the log holds no navigation of such a receiver.
    """
    found: dict[str, list[NavSample]] = {}
    for path in logs_of(mission.log_dir):
        for message in read(path):
            if message.topic.startswith("navigation/"):
                sample = record_of(message)
                if isinstance(sample, NavSample) and sample.time_valid and sample.position:
                    found.setdefault(sample.receiver, []).append(sample)
    if receiver is None and found:
        receiver = max(found, key=lambda name: (_with_attitude(found[name]), len(found[name])))
    if receiver is None or receiver not in found:
        recorded = ", ".join(found) or "none at all"
        raise TrajectoryError(
            f"{mission.log_dir}: no navigation of {receiver or 'any receiver'}; received: "
            f"{recorded}"
        )
    return trajectory_of_samples("in-flight", found[receiver])


def read_trajectory(path: Path, *, around_gps_ns: int) -> Trajectory:
    """A post-processed trajectory: SBET, or CSV with a line of headings.

    Both are in docs/reference/formats.md.

    Args:
        around_gps_ns: any instant of the flight; it gives the week, which an SBET leaves out.

    Raises:
        TrajectoryError: what is not understood, with the place in the file.
    """
    try:
        data = read_regular_file(path, TRAJECTORY_MAX_BYTES)
    except ForeignFileError as error:
        raise TrajectoryError(f"trajectory {error}") from error
    name = f"{path.stem}-{sha256_hex(data)[:8]}"
    if path.suffix.lower() == ".csv":
        return trajectory_of_samples(name, list(_csv(path, data)))
    return _sbet(path, data, around_gps_ns, name)


def _sbet(path: Path, data: bytes, around_gps_ns: int, name: str) -> Trajectory:
    """Seventeen little-endian doubles a record (Applanix, smoothed best estimate of trajectory).

    Velocities stand in a wander frame; they are taken from the positions instead. Time is in GPS
    seconds of the week and may run past its end.
    """
    if not data or len(data) % SBET_RECORD_BYTES:
        raise TrajectoryError(
            f"{path}: {len(data)} bytes are no whole number of SBET records of "
            f"{SBET_RECORD_BYTES}; give an SBET, or a .csv with a line of headings"
        )
    table = np.frombuffer(data, dtype="<f8").reshape(-1, len(SBET_FIELDS))
    column = {name: table[:, i] for i, name in enumerate(SBET_FIELDS)}
    steps_s = np.diff(column["time_s"])
    plausible = (
        float(np.abs(column["time_s"]).max()) <= SBET_TIME_MAX_S
        and np.isfinite(table[:, :11]).all()
        and float(np.abs(column["latitude_rad"]).max()) <= math.pi / 2
        and bool((steps_s > 0).all())
        and len(table) >= 2
    )
    if not plausible:
        raise TrajectoryError(
            f"{path}: latitudes beyond the poles, times that run back, or numbers that are none; "
            "this is no SBET in GPS seconds of the week"
        )
    week_ns = round((around_gps_ns - float(np.median(column["time_s"])) * 1e9) / WEEK_NS) * WEEK_NS
    gps_ns = week_ns + np.round(column["time_s"] * 1e9).astype(np.int64)
    heading = (column["platform_heading_rad"] - column["wander_rad"]) % (2 * math.pi)

    def row(i: int) -> tuple[int, list[float]]:
        place = (math.degrees(table[i, 1]), math.degrees(table[i, 2]), float(table[i, 3]))
        return int(gps_ns[i]), list(place)

    def sample(i: int) -> NavSample:
        instant, place = row(i)
        velocity = _mean_velocity(row(max(i - 1, 0)), row(min(i + 1, len(table) - 1)))
        attitude = (float(table[i, 7]), float(table[i, 8]), float(heading[i]))
        return _sample(instant, (place[0], place[1], place[2]), velocity, attitude)

    return Trajectory(name, gps_ns, sample)


def _csv(path: Path, data: bytes) -> Iterator[NavSample]:
    try:
        lines = csv.DictReader(data.decode("utf-8-sig").splitlines())
        headings = set(lines.fieldnames or ())
    except UnicodeDecodeError as error:
        raise TrajectoryError(f"{path}: not UTF-8 text ({error.reason})") from error
    except csv.Error as error:
        raise TrajectoryError(f"{path}: no table ({error})") from error
    has_instant = "gps_ns" in headings or {"gps_week", "seconds_of_week"} <= headings
    missing = [name for name in CSV_COLUMNS if name not in headings]
    if missing or not has_instant:
        wanted = missing + ([] if has_instant else ["gps_ns (or gps_week, seconds_of_week)"])
        raise TrajectoryError(f"{path}: the line of headings has no {', '.join(wanted)}")
    rows = []
    for row in _rows_of(path, lines):
        try:
            values = [float(row[name]) for name in CSV_COLUMNS]
            instant = _instant(row)
        except (TypeError, ValueError, KeyError) as error:
            raise TrajectoryError(f"{path}, line {lines.line_num}: {error}") from error
        is_possible = 0 <= instant < 2**63 and all(abs(value) <= 1e6 for value in values)
        if not is_possible or abs(values[0]) > 90:
            raise TrajectoryError(f"{path}, line {lines.line_num}: {values} is no place")
        rows.append((instant, values))
    rows.sort(key=lambda row: row[0])
    for i, (instant, values) in enumerate(rows):
        velocity = _mean_velocity(rows[max(i - 1, 0)], rows[min(i + 1, len(rows) - 1)])
        roll, pitch, heading = (math.radians(angle) for angle in values[3:])
        yield _sample(instant, (values[0], values[1], values[2]), velocity, (roll, pitch, heading))


def _rows_of(path: Path, lines: csv.DictReader[str]) -> Iterator[dict[str, str]]:
    try:
        yield from lines
    except csv.Error as error:
        raise TrajectoryError(f"{path}, line {lines.line_num}: no table ({error})") from error


def _instant(row: dict[str, str]) -> int:
    if row.get("gps_ns"):
        return int(row["gps_ns"])
    seconds, _, decimals = row["seconds_of_week"].strip().partition(".")
    nanoseconds = int((decimals + "000000000")[:9]) if decimals else 0
    return int(row["gps_week"]) * WEEK_NS + int(seconds) * 1_000_000_000 + nanoseconds


def _mean_velocity(
    first: tuple[int, list[float]], last: tuple[int, list[float]]
) -> tuple[float, float, float]:
    span_s = (last[0] - first[0]) * 1e-9
    if span_s <= 0:
        return (0.0, 0.0, 0.0)
    (a, b) = (first[1], last[1])
    north_m, east_m = metres_per_degree(a[0], a[2])
    return (
        (b[0] - a[0]) * north_m / span_s,
        (b[1] - a[1]) * east_m / span_s,
        -(b[2] - a[2]) / span_s,
    )


def _sample(
    gps_ns: int,
    place: tuple[float, float, float],
    velocity: tuple[float, float, float],
    attitude: tuple[float, float, float],
) -> NavSample:
    return NavSample(
        receiver="post-processed",
        gps_ns=gps_ns,
        mono_ns=0,
        fix="3d",
        satellites=None,
        latitude_deg=place[0],
        longitude_deg=place[1],
        height_m=place[2],
        horizontal_sigma_m=None,
        vertical_sigma_m=None,
        velocity_ned_mps=velocity,
        speed_sigma_mps=None,
        roll_rad=attitude[0],
        pitch_rad=attitude[1],
        heading_rad=attitude[2],
        leap_seconds=None,
        time_valid=True,
        sigma_source="none",
    )


def _with_attitude(samples: Sequence[NavSample]) -> int:
    return sum(sample.heading_rad is not None for sample in samples)


def trajectory_of_samples(name: str, samples: Sequence[NavSample]) -> Trajectory:
    """A trajectory of samples, by time; of two at one instant the first.

    Raises:
        TrajectoryError: fewer than two.
    """
    ordered: list[NavSample] = []
    for sample in sorted(samples, key=lambda sample: sample.gps_ns):
        if not ordered or sample.gps_ns > ordered[-1].gps_ns:
            ordered.append(sample)
    if len(ordered) < 2:
        raise TrajectoryError(f"{name}: {len(ordered)} samples; a trajectory has two at least")
    instants = np.array([sample.gps_ns for sample in ordered], dtype=np.int64)
    return Trajectory(name, instants, ordered.__getitem__)

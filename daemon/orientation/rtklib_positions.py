"""Positions that RTKLIB computed after landing (`.pos`), with the attitude of the flight.

RTKLIB computes no attitude. Its positions are joined with roll, pitch and heading that were
recorded in flight; those of event marks in `<name>_events.pos` next to the file are in
`daemon.orientation.rtklib_events`.

Source: RTKLIB 2.4.2 manual, appendix B.1 "Positioning Solution File".
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.orientation.rtklib_events import EVENTS, north_east_up_m, positions_of_marks
from daemon.orientation.trajectory import (
    TRAJECTORY_MAX_BYTES,
    WEEK_NS,
    Trajectory,
    TrajectoryError,
    trajectory_of_samples,
)
from drivers.contract import NavSample

SUFFIX = ".pos"
VELOCITY_SPAN_NS = 5_000_000_000
"""Positions farther apart give no velocity."""
TIME_RESOLUTION_S = 1e-7
"""Rounding of times that is not stated: 10 um at 100 m/s."""
_Slope = tuple[float, tuple[float, float, float]] | None
"""Span in seconds; velocity north, east, down."""
_INVALID_MARK = "Q=0"
"""RTKLIB EX: "Q=0, Time mark is not valid"."""
_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
_CALENDAR = re.compile(r"(\d{4})/(\d{2})/(\d{2})")
_LEAST_COLUMNS = 10
"""Two of time, place, quality, satellites, and three standard deviations."""


def read_positions(path: Path) -> list[NavSample]:
    """Samples of a solution file, in the order of time, without attitude.

    Raises:
        TrajectoryError: a file in another time system, other coordinates or with a line that is
            not understood; the message names the option of RTKLIB that writes what is read.
    """
    solution, resolution_s = _read(path)
    epochs = [
        _with_rounded_time(sample, resolution_s) for sample in _with_velocities(_in_order(solution))
    ]
    if len(epochs) < 2:
        raise TrajectoryError(f"{path}: {len(epochs)} positions; a trajectory has two at least")
    events_path = path.with_name(path.stem + EVENTS)
    if not events_path.exists():
        return epochs
    marks, marks_resolution_s = _read(events_path)
    events = positions_of_marks(
        events_path, trajectory_of_samples(path.stem, epochs), _in_order(marks),
        resolution_s=max(resolution_s, marks_resolution_s),
    )  # fmt: skip
    return _in_order([*epochs, *events])


def _in_order(samples: Sequence[NavSample]) -> list[NavSample]:
    """By time; of two at one instant the first."""
    by_instant = {sample.gps_ns: sample for sample in reversed(samples)}
    return [by_instant[instant] for instant in sorted(by_instant)]


def with_flown_attitude(name: str, positions: list[NavSample], flown: Trajectory) -> Trajectory:
    """Positions of a file with the attitude of the flight, at the instants of both.

    Args:
        name: of the trajectory.
        positions: of `read_positions`.
        flown: trajectory of the flight.

    Raises:
        TrajectoryError: the flight's navigation has no attitude in the time of the file.
    """
    placed = trajectory_of_samples(name, positions)
    first, last = positions[0].gps_ns, positions[-1].gps_ns
    instants = {int(i) for i in flown.instants_ns if first <= i <= last}
    instants |= {sample.gps_ns for sample in positions}
    own = {sample.gps_ns: sample for sample in positions}
    joined = []
    for instant in sorted(instants):
        attitude = flown.at(instant)
        sample = own.get(instant) or _sample_at(placed, instant)
        if sample is None or attitude is None or attitude.heading_rad is None:
            continue
        joined.append(
            replace(
                sample,
                roll_rad=attitude.roll_rad,
                pitch_rad=attitude.pitch_rad,
                heading_rad=attitude.heading_rad,
            )
        )
    if not joined:
        raise TrajectoryError(
            f"{name}: RTKLIB's positions have no attitude, and the flight recorded none in their "
            "time; give a trajectory with attitude (SBET or CSV)"
        )
    return trajectory_of_samples(name, joined)


def _read(path: Path) -> tuple[list[NavSample], float]:
    """Samples of a file, and the resolution of its times in seconds."""
    try:
        text = read_regular_file(path, TRAJECTORY_MAX_BYTES).decode("ascii", "replace")
    except ForeignFileError as error:
        raise TrajectoryError(f"trajectory {error}") from error
    heading = ""
    samples = []
    decimals = 9
    for number, line in enumerate(text.splitlines(), 1):
        if line.startswith("%"):
            heading = line if "Q" in line and "ns" in line.split() else heading
            _refuse(path, line)
            continue
        if not line.strip():
            continue
        if not heading:
            raise TrajectoryError(
                f"{path}: no heading that names the time system; write it with out-outhead=on"
            )
        words = line.replace(",", " ").split()
        if _INVALID_MARK in words:
            continue
        try:
            samples.append(_sample(words))
        except (ValueError, IndexError) as error:
            raise TrajectoryError(f"{path}, line {number}: {error}") from error
        decimals = len(words[1].partition(".")[2])
    return samples, 10.0**-decimals


def _refuse(path: Path, line: str) -> None:
    for word, cure in (
        ("UTC", "out-timesys=gpst"),
        ("JST", "out-timesys=gpst"),
        ("x-ecef(m)", "out-solformat=llh"),
        ("e-baseline(m)", "out-solformat=llh"),
        ("/geodetic", "out-height=ellipsoidal"),
        ("latitude(d'\")", "out-degform=deg"),
    ):
        is_heading = word in ("UTC", "JST")
        if word in (line.split() if is_heading else line) and not line.startswith("% program"):
            raise TrajectoryError(
                f"{path}: {word} in its heading; GPS time, degrees and ellipsoidal heights are "
                f"read. Compute it with {cure}"
            )


def _sample(words: list[str]) -> NavSample:
    if len(words) < _LEAST_COLUMNS:
        raise ValueError(f"{len(words)} columns; {_LEAST_COLUMNS} are needed")
    gps_ns = _instant(words[0], words[1])
    latitude, longitude, height = (float(word) for word in words[2:5])
    quality, satellites = int(words[5]), int(words[6])
    north, east, up = (float(word) for word in words[7:10])
    values = (latitude, longitude, height, north, east, up)
    if not all(map(math.isfinite, values)) or abs(latitude) > 90.0 or min(north, east, up) < 0.0:
        raise ValueError(f"{words[2:10]} is no position")
    return NavSample(
        receiver="post-processed",
        gps_ns=gps_ns,
        mono_ns=0,
        fix="3d" if quality else "none",
        satellites=satellites,
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        horizontal_sigma_m=max(north, east),
        vertical_sigma_m=up,
        velocity_ned_mps=None,
        speed_sigma_mps=None,
        roll_rad=None,
        pitch_rad=None,
        heading_rad=None,
        leap_seconds=None,
        time_valid=True,
    )


def _instant(day: str, clock: str) -> int:
    """From a date and time of day, or from week and seconds of the week; whole nanoseconds."""
    if found := _CALENDAR.fullmatch(day):
        hour, minute, second = clock.split(":")
        date = datetime(int(found[1]), int(found[2]), int(found[3]), tzinfo=UTC)
        seconds = round((date - _GPS_EPOCH).total_seconds()) + int(hour) * 3600 + int(minute) * 60
        return seconds * 1_000_000_000 + _nanoseconds(second)
    return int(day) * WEEK_NS + _nanoseconds(clock)


def _nanoseconds(text: str) -> int:
    whole, _, decimals = text.partition(".")
    return int(whole) * 1_000_000_000 + int((decimals + "0" * 9)[:9])


def _with_velocities(samples: Sequence[NavSample]) -> list[NavSample]:
    """With the velocity along the parabola through each sample and its neighbours."""
    slopes = [_slope(a, b) for a, b in pairwise(samples)]
    return [
        replace(sample, velocity_ned_mps=_parabola(before, after))
        for sample, before, after in zip(samples, [None, *slopes], [*slopes, None], strict=True)
    ]


def _with_rounded_time(sample: NavSample, resolution_s: float) -> NavSample:
    """With the way flown in the rounding of its time, evenly distributed, in the sigma."""
    velocity, sigma_m = sample.velocity_ned_mps, sample.horizontal_sigma_m
    if velocity is None or sigma_m is None or resolution_s <= TIME_RESOLUTION_S:
        return sample
    rounding_m = math.hypot(*velocity[:2]) * resolution_s / math.sqrt(12.0)
    return replace(sample, horizontal_sigma_m=math.hypot(sigma_m, rounding_m))


def _slope(a: NavSample, b: NavSample) -> _Slope:
    span_ns = b.gps_ns - a.gps_ns
    if span_ns > VELOCITY_SPAN_NS:
        return None
    north_m, east_m, up_m = north_east_up_m(a, b)
    span_s = span_ns * 1e-9
    return span_s, (north_m / span_s, east_m / span_s, -up_m / span_s)


def _parabola(before: _Slope, after: _Slope) -> tuple[float, float, float] | None:
    if before is None or after is None:
        only = before or after
        return None if only is None else only[1]
    (span_a, va), (span_b, vb) = before, after
    north, east, down = (
        (span_b * a + span_a * b) / (span_a + span_b) for a, b in zip(va, vb, strict=True)
    )
    return north, east, down


def _sample_at(trajectory: Trajectory, gps_ns: int) -> NavSample | None:
    there = trajectory.at(gps_ns)
    if there is None or there.method != "interpolated":
        return None
    return replace(
        trajectory.sample(0),
        gps_ns=gps_ns,
        fix=there.fix,
        satellites=there.satellites,
        latitude_deg=there.latitude_deg,
        longitude_deg=there.longitude_deg,
        height_m=there.height_m,
        horizontal_sigma_m=there.horizontal_sigma_m,
        vertical_sigma_m=there.vertical_sigma_m,
        velocity_ned_mps=there.velocity_ned_mps,
    )

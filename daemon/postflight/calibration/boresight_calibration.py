"""`syntopic calibrate boresight`: from a project or mission with its trajectory to a dated mount.

The project is adjusted with its control alone: antenna positions and attitudes in it are left out,
because they are what is evaluated. The mathematics is in `processing.calibration.boresight`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from daemon import DaemonError
from daemon.configuration.model import MountSection
from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.orientation.exterior_orientation import sealed_exposures
from daemon.orientation.geodesy import metres_per_degree
from daemon.orientation.georeference import Georeference
from daemon.orientation.local_frame import FRAME_FILE, LocalFrame
from daemon.orientation.orientation_inputs import trajectory_of
from daemon.orientation.trajectory import Trajectory
from daemon.postflight.adjustment.csv_tables import read_table
from daemon.postflight.adjustment.project import Project
from daemon.postflight.calibration.calibration_report import (
    CalibrationReport,
    Plot,
    Previous,
    Quantity,
    ReportTable,
    changes_between,
)
from daemon.postflight.plots import Curve, chart_svg
from processing.bundle.adjust import Adjustment
from processing.bundle.flown_network import MOUNTING
from processing.bundle.network import Network, no_gnss, no_measured_attitudes
from processing.calibration.boresight import (
    PARAMETERS,
    BoresightCalibration,
    ImageOrientations,
    ImuMounting,
    InertialOrientations,
    angle_covariance,
    calibrate_boresight,
    mounting_of,
)
from processing.calibration.head_delays import attitudes_of_stations, orientation_columns
from processing.geometry.orientation import ENU_FROM_NED, grid_from_enu
from processing.geometry.rotation import level_from_body, roll_pitch_heading, vectors_from_rotations

Array = NDArray[np.float64]

_GLOBAL_TEST = 0.9995
STEP_NS = 20_000_000
"""Rates and velocities of a trajectory are differences over twice this."""

ANGLES = ("roll_deg", "pitch_deg", "heading_deg")
RATES = ("rate_forward_deg_s", "rate_right_deg_s", "rate_down_deg_s")
RATE_CHANGES = (
    *("rate_change_forward_deg_s2", "rate_change_right_deg_s2", "rate_change_down_deg_s2"),
)
ACCELERATION = ("ax_mps2", "ay_mps2", "az_mps2")
OPTIONAL = (*RATES, *ACCELERATION, *RATE_CHANGES, "time_s")
VELOCITY = ("vx_mps", "vy_mps", "vz_mps")


class BoresightError(DaemonError, ValueError):
    """Nothing can be compared; the message states what is missing."""


@dataclass(frozen=True)
class BoresightComparison:
    """A comparison: exposures by name and by index, both orientations, and the result."""

    names: tuple[str, ...]
    exposures: tuple[int, ...]
    inertial: InertialOrientations
    given: ImuMounting
    found: BoresightCalibration
    adjustment: Adjustment


def control_only(network: Network) -> Network:
    """The network without antenna positions and attitudes, and without corrections of the mounting
    against them: exposures are then those of the camera."""
    bare = replace(network, gnss=no_gnss(), measured_attitudes=no_measured_attitudes())
    images = network.images
    if [head.name for head in network.heads] != [MOUNTING] or (images.head < 0).any():
        return bare
    return replace(bare, heads=(), images=replace(images, head=np.full_like(images.head, -1)))


def controlled_of(result: Adjustment, exposures: Sequence[int]) -> ImageOrientations:
    """Adjusted orientations of stations (by index) with their whole covariance.

    Raises:
        BoresightError: a station's orientation is held, so that nothing was determined.
    """
    attitudes = attitudes_of_stations(result.network, exposures)
    at = orientation_columns(result, exposures)
    held = np.flatnonzero(at < 0)
    if held.size:
        name = result.network.stations.names[exposures[int(held[0]) // 6]]
        raise BoresightError(
            f"exposure {name} is held or not seen in the project; leave its position and attitude "
            "free"
        )
    return ImageOrientations(
        result.state.station[list(exposures)],
        result.state.attitude[attitudes],
        result.sigma0**2 * result.cofactor[np.ix_(at, at)],
    )


def inertial_table(
    path: Path, stations: Sequence[str], position_sigma_m: Array, attitude_sigma_rad: Array
) -> tuple[tuple[int, ...], InertialOrientations]:
    """Read `inertial.csv`: the stations (by index) in it, and their values.

    Raises:
        daemon.postflight.adjustment.csv_tables.ProjectError: columns or cells that are not right.
        BoresightError: no exposure of the project is in it.
    """
    places = ("x_m", "y_m", "z_m")
    table = read_table(path, ("exposure", *places, *ANGLES, *VELOCITY), OPTIONAL)
    at = {name: k for k, name in enumerate(stations)}
    names = table.names("exposure")
    rows = [k for k, name in enumerate(names) if name in at]
    if not rows:
        raise BoresightError(
            f"{path}: none of its exposures ({', '.join(names[:3])} ...) is in the project "
            f"({', '.join(list(stations)[:3])} ...); both must use the same names"
        )
    columns = (*places, *VELOCITY, *ANGLES, *OPTIONAL)
    values = np.array([table.numbers(c, 0.0 if c in OPTIONAL else math.nan) for c in columns]).T[
        rows
    ]
    if table.problems or not np.isfinite(values).all():
        quantities = "; ".join(table.problems) or "an empty cell where a number is needed"
        raise BoresightError(f"{path}: {quantities}")
    angles = np.radians(values[:, 6:9])
    return tuple(at[names[k]] for k in rows), InertialOrientations(
        values[:, :3],
        values[:, 3:6],
        np.array([ENU_FROM_NED @ level_from_body(*a) for a in angles]),
        np.radians(values[:, 9:12]),
        position_sigma_m,
        attitude_sigma_rad,
        values[:, 12:15],
        np.radians(values[:, 15:18]),
        values[:, 18] if table.has("time_s") else None,
    )


def system_of(project: Path, crs: str | None) -> str | LocalFrame:
    """Coordinate system of a project: `crs`, or the frame file next to it.

    Raises:
        BoresightError: neither is there.
    """
    if crs is not None:
        return crs
    frame = project.parent / FRAME_FILE
    try:
        quantities = json.loads(frame.read_text(encoding="utf-8"))
        return LocalFrame(float(quantities["latitude_deg"]), float(quantities["longitude_deg"]))
    except FileNotFoundError as error:
        raise BoresightError(
            "--mission needs --crs, the coordinate system of the project, such as EPSG:25833; only "
            "projects that `syntopic triangulate` wrote contain their own"
        ) from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BoresightError(f"{frame}: {error}; give --crs") from error


def inertial_of_mission(
    mission: Mission,
    stations: Sequence[str],
    system: str | LocalFrame,
    trajectory_file: Path | None,
    position_sigma_m: Array,
    attitude_sigma_rad: Array,
) -> tuple[tuple[int, ...], InertialOrientations]:
    """The trajectory at the marks of a mission's exposures, in the project's coordinate system.

    Exposures are named as `syntopic export orientation` names them. Positions are those of the
    antenna, from the trajectory. `system` is a coordinate system that PROJ knows, or the
    local frame of a project that `syntopic triangulate` wrote.

    Raises:
        BoresightError: no exposure of the project has an instant and an attitude, or the record of
            one cannot be read.
    """
    read = sealed_exposures(mission)
    for failure in read.failures:
        if f"{failure.exposure:06d}" in stations:
            raise BoresightError(f"exposure {failure.exposure}: {failure.cause}")
    exposures = {f"{number:06d}": exposure for number, exposure in read.results.items()}
    trajectory = trajectory_of(mission, exposures.values(), trajectory_file)
    place = system if isinstance(system, LocalFrame) else Georeference(system)
    used_stations, rows = [], []
    for k, name in enumerate(stations):
        exposure = exposures.get(name)
        row = None if exposure is None else _at_mark(exposure, trajectory, place)
        if row is not None:
            used_stations.append(k)
            rows.append(row)
    if not rows:
        raise BoresightError(
            f"{mission.path}: no exposure of the project has a GPS time and an attitude in "
            f"{trajectory.name}; stations are named like the exposures' folders (000001), and a "
            "receiver without attitude needs --trajectory"
        )
    position, velocity, rotation, rate, acceleration, rate_change, time_s = (
        np.array(part) for part in zip(*rows, strict=True)
    )
    return tuple(used_stations), InertialOrientations(
        position,
        velocity,
        rotation,
        rate,
        position_sigma_m,
        attitude_sigma_rad,
        acceleration,
        rate_change,
        time_s - time_s.min(),
    )


def given_mounting(mount: MountSection) -> ImuMounting:
    """The mounting of a configuration."""
    return mounting_of(
        np.array(mount.antenna_m),
        np.radians(mount.boresight_deg),
        time_offset_s=mount.time_offset_ms * 1e-3,
    )


def compare_boresight(
    adjustment: Adjustment,
    exposures: Sequence[int],
    inertial: InertialOrientations,
    mount: MountSection,
    *,
    held: Sequence[str] = (),
    lever_sigma_m: float | None = None,
) -> BoresightComparison:
    """Compare, beginning with the mount that is in use."""
    given = given_mounting(mount)
    try:
        found = calibrate_boresight(
            controlled_of(adjustment, exposures),
            inertial,
            given,
            held=held,
            lever_sigma_m=lever_sigma_m,
        )
    except ValueError as error:
        raise BoresightError(str(error)) from error
    names = tuple(adjustment.network.stations.names[k] for k in exposures)
    return BoresightComparison(names, tuple(exposures), inertial, given, found, adjustment)


def quantities_of(done: BoresightComparison) -> tuple[Quantity, ...]:
    """Roll, pitch and heading of the boresight in deg, lever arm in m, time offset in ms, shift in
    m; a sigma of None: not determined by this flight."""
    found = done.found
    angles = np.degrees(roll_pitch_heading(found.mounting.imu_from_body))
    spread = np.degrees(np.sqrt(np.clip(np.diag(angle_covariance(found)), 0.0, None)))
    all_determined = bool(found.determined[:3].all())
    quantities = [
        Quantity("boresight", name, "deg", float(angle), float(s) if all_determined else None)
        for name, angle, s in zip(("roll", "pitch", "heading"), angles, spread, strict=True)
    ]
    values = (
        *found.mounting.antenna_m,
        found.mounting.time_offset_s * 1e3,
        *found.mounting.shift_m,
    )
    sigma = found.sigma[3:] * np.array([1.0, 1.0, 1.0, 1e3, 1.0, 1.0, 1.0])
    for name, value, s in zip(PARAMETERS[3:], values, sigma, strict=True):
        where, _, what = name.rpartition(" ")
        unit = "ms" if name == "time offset" else "m"
        own = float(s) if math.isfinite(s) else None
        quantities.append(Quantity(where, what, unit, float(value), own))
    return tuple(quantities)


def report_of(
    done: BoresightComparison,
    project: Project,
    *,
    delays: Sequence[Quantity] = (),
    calibration_id: str,
    date: str,
    serials: Mapping[str, str],
    previous: Previous | None,
    warnings: Sequence[str] = (),
) -> CalibrationReport:
    """The calibration report, as printed and written."""
    found, n = done.found, len(done.names)
    quantities = (*quantities_of(done), *delays)
    speed = np.linalg.norm(done.inertial.velocity_mps, axis=1)
    sentences = [u.sentence for u in found.inseparable]
    held = [f"{group} held at what was given" for group in found.held]
    correlated = _correlated(found)
    rms_m = np.sqrt(np.mean(found.position_residual_m**2, axis=0))
    rms_deg = np.degrees(np.sqrt(np.mean(found.attitude_residual_rad**2, axis=0)))
    numbers = [float(k) for k in range(1, n + 1)]
    plots = (
        Plot(
            "Attitudes, inertial less controlled",
            chart_svg(
                "Residuals of attitude", ("exposure", "mdeg"),
                [
                    Curve(name, numbers, np.degrees(found.attitude_residual_rad[:, k]) * 1e3,
                          joined=False)
                    for k, name in enumerate(("about forward", "about right", "about down"))
                ],
            ),
        ),
        Plot(
            "Positions, trajectory less controlled",
            chart_svg(
                "Residuals of position", ("exposure", "cm"),
                [
                    Curve(name, numbers, found.position_residual_m[:, k] * 100.0, joined=False)
                    for k, name in enumerate(("east", "north", "up"))
                ],
            ),
        ),
    )  # fmt: skip
    return CalibrationReport(
        kind="boresight",
        title=f"Boresight of {project.name}",
        calibration_id=calibration_id,
        date=date,
        facts=(
            ("project", project.name),
            ("exposures compared", str(n)),
            ("ground speeds", f"{speed.min():.1f} to {speed.max():.1f} m/s"),
            ("sigma0 of the images", f"{done.adjustment.sigma0:.3f}"),
            ("sigma0 of the comparison", f"{found.sigma0:.3f}"),
            ("redundancy of the comparison", str(found.redundancy)),
        ),
        serials=serials,
        quantities=quantities,
        figures={
            "exposures": n,
            "sigma0": found.sigma0,
            "redundancy": found.redundancy,
            "position_rms_m": [float(v) for v in rms_m],
            "attitude_rms_deg": [float(v) for v in rms_deg],
            "not_separated": [list(u.parameters) for u in found.inseparable],
            "correlation": found.correlation.tolist(),
        },
        verdicts=[*held, *correlated],
        warnings=[*warnings, *done.adjustment.problems, *_misfits(done), *sentences],
        tables=(
            ReportTable(
                "Result",
                ("", "", "value", "sigma", "unit"),
                [(q.where, q.what, q.value, q.sigma, q.unit) for q in quantities],
                "Without a sigma: held, or not separated by this flight; lever arm and time are "
                "then as they were given.",
            ),
            ReportTable(
                "Residuals, root mean square",
                ("", "1", "2", "3", "unit"),
                [
                    ("position east, north, up", *(float(v) for v in rms_m), "m"),
                    ("attitude about forward, right, down", *(float(v) for v in rms_deg), "deg"),
                ],
            ),
        ),
        plots=plots,
        previous=None if previous is None else previous.calibration_id,
        changes=() if previous is None else changes_between(previous.quantities, quantities),
    )


def mount_toml(
    done: BoresightComparison, *, date: str, project: str, delays: Sequence[Quantity] = ()
) -> bytes:
    """The `[mount]` section as the configuration holds it, delays of heads as remarks."""
    at = done.found.mounting
    angles = ", ".join(f"{v:.6f}" for v in np.degrees(roll_pitch_heading(at.imu_from_body)))
    arm = ", ".join(f"{v:.4f}" for v in at.antenna_m)
    lines = [
        f"# Mount, by `syntopic calibrate boresight` on {date} from {project}, "
        f"{len(done.names)} exposures.",
        "# It counts where it is configured: put it in place of [mount] in the configuration, or",
        "# `syntopic orient MISSION --mount FILE`.",
        *(f"# Not from this flight: {u.sentence}" for u in done.found.inseparable),
        *(f"# {q.where}: {q.what} {q.value:.4f} {q.unit}" for q in delays),
        "[mount]",
        f"antenna_m = [{arm}]",
        f"boresight_deg = [{angles}]",
        f"time_offset_ms = {at.time_offset_s * 1e3:.4f}",
    ]
    return ("\n".join(lines) + "\n").encode("utf-8")


def _misfits(done: BoresightComparison) -> list[str]:
    """Residuals of images or comparison that their standard deviations do not explain."""
    sentences = []
    for what, sigma0, redundancy, remedy in (
        ("the images", done.adjustment.sigma0, done.adjustment.redundancy,
         "blunders, a wrong interior orientation, or wrong velocities and rates"),
        ("the comparison", done.found.sigma0, done.found.redundancy,
         "check order, units, signs and standard deviations of the inertial values"),
    ):  # fmt: skip
        if redundancy <= 0:
            continue
        limit = math.sqrt(chdtri(redundancy, 1.0 - _GLOBAL_TEST) / redundancy)
        if sigma0 > limit:
            sentences.append(
                f"residuals of {what} are larger than stated: sigma0 {sigma0:.2f}, at most "
                f"{limit:.2f} with a probability of 99.95 %: {remedy}"
            )
    return sentences


def _correlated(found: BoresightCalibration) -> list[str]:
    names = PARAMETERS
    return [
        f"{names[i]} and {names[j]} correlate by {found.correlation[i, j]:.2f}"
        for i in range(10)
        for j in range(i)
        if found.determined[i] and found.determined[j] and abs(found.correlation[i, j]) > 0.9
    ]


def _at_mark(
    exposure: Exposure, trajectory: Trajectory, system: Georeference | LocalFrame
) -> tuple[Array, Array, Array, Array, Array, Array, float] | None:
    """Position, velocity, rotation, rates, acceleration, change of rates and instant (s) at the
    mark, in grid axes; None: not known."""
    if exposure.mark_gps_ns is None:
        return None
    there = [trajectory.at(exposure.mark_gps_ns + k * STEP_NS) for k in (-1, 0, 1)]
    level, heights_m = [], []
    for one in there:
        if one is None or one.roll_rad is None or one.pitch_rad is None or one.heading_rad is None:
            return None
        if one.height_m is None:
            return None
        heights_m.append(one.height_m)
        level.append(level_from_body(one.roll_rad, one.pitch_rad, one.heading_rad))
    before, here, after = there
    if before is None or here is None or after is None:
        return None
    if isinstance(system, LocalFrame):
        at = (here.latitude_deg, here.longitude_deg, heights_m[1])
        position = system.from_geodetic(*(np.array(v) for v in at))
        grid = system.local_from_enu(here.latitude_deg, here.longitude_deg)
    else:
        place = system.place(here.latitude_deg, here.longitude_deg, heights_m[1])
        position = np.array([place.east_m, place.north_m, place.height_m])
        grid = grid_from_enu(place.azimuth_of_north_rad)
    per_latitude, per_longitude = metres_per_degree(here.latitude_deg, heights_m[1])
    span_s = 2 * STEP_NS * 1e-9
    scale = np.array([per_longitude, per_latitude, 1.0])
    path = np.array(
        [
            (one.longitude_deg - here.longitude_deg, one.latitude_deg - here.latitude_deg, h - mid)
            for one, h, mid in zip(
                (before, here, after), heights_m, (heights_m[1],) * 3, strict=True
            )
        ]
    ) * scale  # fmt: skip
    half_s = STEP_NS * 1e-9
    velocity = (path[2] - path[0]) / span_s
    acceleration = (path[2] - 2.0 * path[1] + path[0]) / half_s**2
    rate = vectors_from_rotations(level[0].T @ level[2]) / span_s
    ahead = vectors_from_rotations(level[1].T @ level[2])
    back = vectors_from_rotations(level[0].T @ level[1])
    return (
        position,
        grid @ velocity,
        grid @ ENU_FROM_NED @ level[1],
        rate,
        grid @ acceleration,
        (ahead - back) / half_s**2,
        exposure.mark_gps_ns * 1e-9,
    )

"""Writing an adjustment project, and what came out of it, as text."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.mission.store.durable import new_files
from daemon.mission.store.output_places import refuse_occupied
from daemon.postflight.adjustment.adjusted_project import (
    initial_state,
    used_network,
    with_settings,
)
from daemon.postflight.adjustment.csv_tables import ProjectError, write_table
from daemon.postflight.adjustment.heads_and_motion import timing_values, write_motion
from daemon.postflight.adjustment.html_report import report_page
from daemon.postflight.adjustment.patterns_file import PATTERNS_FILE, write_patterns
from daemon.postflight.adjustment.project import (
    ANGLES,
    AXIS_SIGMAS,
    SIGMAS,
    XYZ,
    CheckPoints,
    Project,
)
from daemon.postflight.adjustment.project_file import ProjectFile
from daemon.postflight.adjustment.reliability_report import (
    OBSERVATION_COLUMNS,
    image_reliability,
    other_observations,
)
from processing.bundle.adjust import Adjustment
from processing.bundle.adjustment_results import exposures_of, image_residuals_mm
from processing.bundle.network import INTERIOR, Network
from processing.bundle.unknowns import ParameterValues, initial_values
from processing.geometry.rotation import omega_phi_kappa

Array = NDArray[np.float64]


PROJECT_FILE = "project.toml"

RESIDUAL_COLUMNS = (
    "image", "point", "vx_um", "vy_um", "rx", "ry", "wx", "wy", "rejected",
    "detectable_x_um", "detectable_y_um", "point_shift_m",
)  # fmt: skip


def write_project(
    folder: Path,
    file: ProjectFile,
    network: Network,
    checks: CheckPoints,
    state: ParameterValues | None = None,
) -> None:
    """Write a project that `read_project` reads back as it was.

    Args:
        folder: made, if need be; it must be empty.
        file: its settings, cameras and heads.
        network: observations and starting values.
        checks: independent coordinates.
        state: values to begin with in place of the network's; control coordinates stay as given.

    Raises:
        ProjectError: the folder holds a project.
    """
    with new_project(folder) as part:
        _write_project(part, file, network, checks, state)


def refuse_existing_project(folder: Path) -> None:
    """Refuse a folder for a new project that is not empty, before anything is computed.

    Raises:
        ProjectError: it holds a project.
        OutputPlaceError: it holds something else, such as tables of the same names.
    """
    if (folder / PROJECT_FILE).exists():
        raise ProjectError([f"{folder} holds a project already; give another folder with --out"])
    refuse_occupied(folder, cure="give another folder with --out")


@contextmanager
def new_project(folder: Path) -> Iterator[Path]:
    """A folder to write a project's files into; they appear in `folder` when the block ends.

    `project.toml` comes last: where it is, the project is complete.

    Raises:
        ProjectError: the folder holds a project.
        OutputPlaceError: it holds something else.
    """
    refuse_existing_project(folder)
    with new_files(folder, last=PROJECT_FILE) as part:
        yield part


def _write_project(
    folder: Path,
    file: ProjectFile,
    network: Network,
    checks: CheckPoints,
    state: ParameterValues | None,
) -> None:
    state = state or initial_values(network)
    tables = {"images": "images.csv", "image_points": "image_points.csv"}
    tables |= {"exposures": "exposures.csv", "points": "points.csv"}
    _images(folder, network, state)
    _exposures(folder, network, state)
    _points(folder, network, checks, state)
    table = network.image_points
    write_table(
        folder / "image_points.csv",
        "Measured image coordinates, x right, y up.",
        ("image", "point", "x_mm", "y_mm", "sx_um", "sy_um"),
        (
            (network.images.names[i], network.points.names[p], *xy, *sigma)
            for i, p, xy, sigma in zip(
                table.image, table.point, table.xy_mm, table.sigma_mm * 1e3, strict=True
            )
        ),
    )
    if len(network.distances.point_a):
        tables["distances"] = "distances.csv"
        d, names = network.distances, network.points.names
        write_table(
            folder / "distances.csv",
            "Measured distances between object points.",
            ("point_a", "point_b", "distance_m", "sigma_m"),
            (
                (names[a], names[b], float(length), float(sigma))
                for a, b, length, sigma in zip(
                    d.point_a, d.point_b, d.distance_m, d.sigma_m, strict=True
                )
            ),
        )
    if len(network.gnss.station):
        tables["gnss"] = "gnss.csv"
        _gnss(folder, network)
    if network.motion is not None:
        tables["motion"] = "motion.csv"
        write_motion(folder / "motion.csv", network)
    if network.patterns:
        tables["patterns"] = PATTERNS_FILE
        write_patterns(folder / PATTERNS_FILE, network)
    if len(network.measured_attitudes.attitude):
        tables["attitudes"] = "attitudes.csv"
        b = network.measured_attitudes
        angles = np.degrees(omega_phi_kappa(b.rotation))
        alike = bool((b.sigma_rad == b.sigma_rad[:, :1]).all())
        write_table(
            folder / "attitudes.csv",
            "Measured attitudes, R = Rx(omega) Ry(phi) Rz(kappa), object from camera; sigmas about "
            "the axes of the camera or rig.",
            ("exposure", *ANGLES, *(("sigma_deg",) if alike else AXIS_SIGMAS)),
            (
                (network.attitudes.names[a], *own, *np.degrees(sigma[: 1 if alike else 3]))
                for a, own, sigma in zip(b.attitude, angles, b.sigma_rad, strict=True)
            ),
        )
    (folder / PROJECT_FILE).write_text(_toml(file, network, state, tables), encoding="utf-8")


def write_results(
    folder: Path, project: Project, result: Adjustment, report: Mapping[str, Any]
) -> None:
    """Write the adjusted project, adjusted points and orientations with sigmas, residuals, report.

    Raises:
        ProjectError: the folder holds a project.
    """
    with new_project(folder) as part:
        fill_results(part, project, result, report)


def fill_results(
    folder: Path, project: Project, result: Adjustment, report: Mapping[str, Any]
) -> None:
    """Like `write_results`, into the folder of `new_project`."""
    network = result.network
    adjusted = with_settings(project.file, result.settings)
    _write_project(folder, adjusted, used_network(result), project.checks, initial_state(result))
    sigma = result.sigma0 * np.sqrt(np.clip(np.einsum("nii->ni", result.point_cofactor), 0.0, None))
    rays = np.bincount(
        network.image_points.point[result.weight > 0.0], minlength=len(network.points.names)
    )
    write_table(
        folder / "adjusted_points.csv",
        "Adjusted object points; no sigma: took no part.",
        ("point", *XYZ, *SIGMAS, "rays"),
        (
            (name, *result.state.points[k], *sigma[k], str(int(rays[k])))
            for k, name in enumerate(network.points.names)
        ),
    )
    write_table(
        folder / "adjusted_images.csv",
        "Projection centres and angles of the exposures the images belong to; no sigma: held.",
        ("image", *XYZ, *ANGLES, *SIGMAS, "so_deg", "sp_deg", "sk_deg"),
        (
            (
                o.name,
                *o.position_m,
                *np.degrees(o.angles_rad),
                *o.position_sigma_m,
                *np.degrees(o.angles_sigma_rad),
            )
            for o in exposures_of(result)
        ),
    )
    write_table(
        folder / "residuals.csv",
        "Computed less measured image coordinates; redundancy numbers; standardised residuals; "
        "minimal detectable bias and how far it moves the object point, empty without control.",
        RESIDUAL_COLUMNS,
        _residuals(result),
    )
    write_table(
        folder / "observations.csv",
        "Observations other than image points: residuals, redundancy numbers, reliability.",
        OBSERVATION_COLUMNS,
        other_observations(result),
    )
    (folder / "report.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    page = report_page(result, project.checks, report)
    (folder / "report.html").write_text(page, encoding="utf-8")


def _residuals(result: Adjustment) -> Iterator[tuple[str | float, ...]]:
    network, rows = result.network, result.equations
    count = len(network.image_points.image)
    redundancy, standardised = np.full((count, 2), np.nan), np.full((count, 2), np.nan)
    for axis in range(2):
        own = rows.group == axis
        redundancy[rows.source[own], axis] = result.redundancy_number[own]
        standardised[rows.source[own], axis] = result.standardised[own]
    residual = image_residuals_mm(result) * 1e3
    detectable, shift = image_reliability(result)
    for k, (image, point) in enumerate(
        zip(network.image_points.image, network.image_points.point, strict=True)
    ):
        yield (
            network.images.names[image],
            network.points.names[point],
            *(round(float(v), 4) for v in residual[k]),
            *(round(float(v), 4) for v in redundancy[k]),
            *(round(float(v), 3) for v in standardised[k]),
            "yes" if result.rejected[k] else "no",
            *(round(float(v), 3) for v in np.where(np.isinf(detectable[k]), np.nan, detectable[k])),
            math.nan if math.isinf(shift[k]) else float(f"{shift[k]:.4g}"),
        )


def _images(folder: Path, network: Network, state: ParameterValues) -> None:
    images, angles = network.images, np.degrees(omega_phi_kappa(state.attitude))
    rows: list[tuple[str | float, ...]] = []
    for k, name in enumerate(images.names):
        attitude = network.attitudes.names[images.attitude[k]]
        own = angles[images.attitude[k]] if attitude.startswith("image ") else np.full(3, np.nan)
        head = "" if images.head[k] < 0 else network.heads[images.head[k]].name
        rows.append(
            (
                name,
                network.cameras[images.camera[k]].name,
                network.stations.names[images.station[k]],
                head,
                *own,
            )
        )
    write_table(
        folder / "images.csv",
        "Images; one with angles has an attitude of its own and shares the exposure's centre.",
        ("image", "camera", "exposure", "head", *ANGLES),
        rows,
    )


def _exposures(folder: Path, network: Network, state: ParameterValues) -> None:
    angles = np.degrees(omega_phi_kappa(state.attitude))
    at = {name: k for k, name in enumerate(network.attitudes.names)}
    rows: list[tuple[str | float, ...]] = []
    for k, name in enumerate(network.stations.names):
        own = at.get(name)
        rows.append(
            (
                name,
                *state.station[k],
                *(np.full(3, np.nan) if own is None else angles[own]),
                "held" if network.stations.fixed[k] else "free",
                "held" if own is not None and network.attitudes.fixed[own] else "free",
            )
        )
    write_table(
        folder / "exposures.csv",
        "Projection centres and angles, R = Rx(omega) Ry(phi) Rz(kappa), object from camera.",
        ("exposure", *XYZ, *ANGLES, "position", "attitude"),
        rows,
    )


def _points(folder: Path, network: Network, checks: CheckPoints, state: ParameterValues) -> None:
    points = network.points
    check_points = {name: k for k, name in enumerate(checks.names)}
    rows: list[tuple[str | float, ...]] = []
    for k, name in enumerate(points.names):
        if name in check_points:
            c = check_points[name]
            rows.append((name, "check", *checks.xyz_m[c], *checks.sigma_m[c]))
        elif points.at_infinity[k]:
            rows.append((name, "direction", *points.xyz_m[k], *points.sigma_m[k]))
        elif np.isfinite(points.sigma_m[k]).any():
            rows.append((name, "control", *points.xyz_m[k], *points.sigma_m[k]))
        else:
            rows.append((name, "tie", *state.points[k], *np.full(3, np.nan)))
    write_table(
        folder / "points.csv",
        "Object points. Control: an empty sigma leaves a coordinate free, 0 holds it.",
        ("point", "role", *XYZ, *SIGMAS),
        rows,
    )


def _gnss(folder: Path, network: Network) -> None:
    gnss = network.gnss
    write_table(
        folder / "gnss.csv",
        "Antenna positions; lever arm in camera (rig) axes.",
        ("exposure", *XYZ, *SIGMAS, "line", "time_s", "lever_x_m", "lever_y_m", "lever_z_m"),
        (
            (
                network.stations.names[s],
                *gnss.position_m[k],
                *gnss.sigma_m[k],
                "" if gnss.line[k] < 0 else gnss.lines[gnss.line[k]],
                float(gnss.time_s[k]),
                *gnss.lever_m[k],
            )
            for k, s in enumerate(gnss.station)
        ),
    )


def _toml(
    file: ProjectFile, network: Network, state: ParameterValues, tables: Mapping[str, str]
) -> str:
    """project.toml with current values of interior orientation and heads."""
    lines = ["format = 1", f"name = {_value(file.name)}", "", "[adjust]"]
    lines += _keys(file.adjust.model_dump(exclude_none=True, exclude_defaults=True))
    lines += ["", "[files]", *_keys(dict(tables))]
    for k, section in enumerate(file.camera):
        content = section.model_dump(exclude_none=True, exclude_defaults=True)
        content |= {
            name: float(value)
            for name, value in zip(INTERIOR, state.interior[k], strict=True)
            if value != 0.0
        }
        terms = {
            t.name: float(v) for t, v in zip(network.cameras[k].terms, state.terms[k], strict=True)
        }
        content["terms"] = {name: value for name, value in terms.items() if value != 0.0}
        lines += ["", "[[camera]]", *_keys(content)]
    angles = np.degrees(omega_phi_kappa(state.head_rotation))
    for k, head in enumerate(file.head):
        content = head.model_dump(exclude_none=True, exclude_defaults=True)
        content |= dict(zip(ANGLES, (float(v) for v in angles[k]), strict=True))
        content |= dict(zip(XYZ, (float(v) for v in state.head_offset[k]), strict=True))
        content |= timing_values(state, k)
        lines += ["", "[[head]]", *_keys(content)]
    for constraint in file.constraint:
        lines += ["", "[[constraint]]", *_keys(constraint.model_dump())]
    return "\n".join(lines) + "\n"


def _keys(content: Mapping[str, Any]) -> list[str]:
    return [f"{key} = {_value(value)}" for key, value in content.items() if value not in ({}, ())]


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{json.dumps(k)} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(v) for v in value) + "]"
    return json.dumps(value, ensure_ascii=False)

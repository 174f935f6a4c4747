"""Report of an aerial triangulation, in addition to that of any adjustment.

Image measurements in um and px, control and check residuals in px and m, orientations in the
requested coordinate system.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.orientation.georeference import Georeference
from daemon.orientation.local_frame import FRAME_FILE
from daemon.postflight.adjustment.csv_tables import write_table
from daemon.postflight.adjustment.project import Project
from daemon.postflight.adjustment.project_writer import fill_results, new_project
from daemon.postflight.triangulation.triangulation import ImageBlock
from daemon.terminal.console import Console, light_table
from processing.bundle.adjust import Adjustment
from processing.bundle.adjustment_results import (
    check_point_differences,
    control_residuals,
    image_residuals_mm,
    systematic_residuals,
)
from processing.bundle.camera_orientations import (
    adjusted_cameras,
    camera_orientations,
    variance_factor,
)
from processing.bundle.flown_network import MOUNTING
from processing.bundle.unknowns import initial_values
from processing.geometry.orientation import grid_from_enu
from processing.geometry.rotation import omega_phi_kappa, vectors_from_rotations
from processing.matching.block_matching import BlockTiePoints, match_counts_by_line

Array = NDArray[np.float64]

CELLS = (16, 11)
_MIN_IN_CELL = 10


def triangulation_of(
    block: ImageBlock, tied: BlockTiePoints, project: Project, result: Adjustment
) -> dict[str, Any]:
    """The section `triangulation` of the report; lengths in m, px and um as named."""
    network = result.network
    residual = image_residuals_mm(result)
    used = np.isfinite(residual).all(axis=1) & (result.weight > 0.0)
    tie = used & (network.image_points.point < tied.points)
    rms_um = np.sqrt(np.mean(residual[tie] ** 2, axis=0)) * 1e3
    sigma_um = [float(v) * 1e3 for v in network.image_points.sigma_mm[tie].mean(axis=0)]
    used_cameras = np.unique(network.images.camera[network.image_points.image[used]])
    patterns = [systematic_residuals(result, int(k), CELLS) for k in used_cameras]
    means = np.concatenate([one.mean_mm[one.count >= _MIN_IN_CELL] for one in patterns])
    worst = np.hypot(*means.T).max() * 1e3 if len(means) else math.nan
    rays = np.bincount(network.image_points.point[tie], minlength=tied.points)[: tied.points]
    along, across = match_counts_by_line(tied, block.lines)
    checks = project.checks
    control = control_residuals(result)
    against = check_point_differences(result, checks.names, checks.xyz_m, checks.sigma_m)
    of_camera = np.array([camera.pixel_mm or block.image.pitch_mm for camera in network.cameras])
    pixel_mm = of_camera[network.images.camera[network.image_points.image[tie]]][:, None]
    rms_px = np.sqrt(np.mean((residual[tie] / pixel_mm) ** 2, axis=0))
    sigma_px = (network.image_points.sigma_mm[tie] / pixel_mm).mean(axis=0)
    return {
        "exposures": len(network.stations.names),
        "images": len(block.names),
        "lines": len(set(block.lines)),
        "gsd_m": block.gsd_m,
        "crs": block.crs,
        "frame": block.frame.name,
        "trials": sum(tied.tried.values()),
        "matches_along": along,
        "matches_across": across,
        "rays": {str(n): int((rays == n).sum()) for n in range(2, int(rays.max(initial=1)) + 1)},
        "image_rms_um": [float(v) for v in rms_um],
        "image_rms_px": [float(v) for v in rms_px],
        "image_sigma_um": sigma_um,
        "image_sigma_px": [float(v) for v in sigma_px],
        "systematic_most_um": float(worst) if math.isfinite(worst) else None,
        "mounting": mountings_of(result),
        "patterns": _patterns(result),
        "control": _agreement(control.names, control.difference_m, block.gsd_m),
        "checks": _agreement(against.names, against.difference_m, block.gsd_m)
        | {
            "predicted_m": [float(v) for v in against.predicted_m] if against.names else [],
            "squares": against.squares if against.names else None,
        },
    }


def _patterns(result: Adjustment) -> dict[str, Any]:
    """How many images have patterns of stitching, the most of one, and the least share of the
    variance that they hold."""
    own = [one for one in result.network.patterns if one is not None]
    return {
        "images": len(own),
        "most": max((one.count for one in own), default=0),
        "share": min((one.share for one in own), default=None),
    }


def mountings_of(result: Adjustment) -> list[dict[str, Any]]:
    """Corrections of boresights (mdeg, about the camera's axes) and lever arms (m, along them)
    against the calibration, with standard deviations."""
    found: list[dict[str, Any]] = []
    given = initial_values(result.network)
    for k, head in enumerate(result.network.heads):
        turn = given.head_rotation[k].T @ result.state.head_rotation[k]
        quantities = (
            ("boresight", "mdeg", math.degrees(1e3) * vectors_from_rotations(turn[None])[0],
             math.degrees(1e3), result.layout.head_rotation[k]),
            ("lever arm", "m", result.state.head_offset[k] - given.head_offset[k], 1.0,
             result.layout.head_offset[k]),
        )  # fmt: skip
        for what, unit, value, factor, columns in quantities:
            if (columns < 0).any():
                continue
            cofactor = result.cofactors[np.ix_(columns, columns)]
            variance = variance_factor(result.sigma0) * np.diag(cofactor)
            found += [
                {"head": head.name, "what": what, "axis": axis, "unit": unit, "value": float(v),
                 "sigma": factor * math.sqrt(max(float(s), 0.0))}
                for axis, v, s in zip("xyz", value, variance, strict=True)
            ]  # fmt: skip
    return found


def _agreement(names: tuple[str, ...], difference_m: Array, gsd_m: float) -> dict[str, Any]:
    if not names:
        return {"count": 0, "rms_m": [], "rms_px": [], "worst_m": []}
    rms = np.sqrt(np.nanmean(difference_m**2, axis=0))
    worst = np.nanmax(np.abs(difference_m), axis=0)
    return {
        "count": len(names),
        "rms_m": [float(v) for v in rms],
        "rms_px": [float(v) / gsd_m for v in rms],
        "worst_m": [float(v) for v in worst],
    }


def write_triangulation(
    folder: Path, block: ImageBlock, project: Project, result: Adjustment, report: Mapping[str, Any]
) -> None:
    """Write the adjusted project with its report, and orientations in the coordinate system.

    Raises:
        ProjectError: the folder holds a project.
        OutputPlaceError: it holds something else.
    """
    report = {"mission": block.mission.about().get("id"), **report}
    with new_project(folder) as part:
        _fill(part, block, project, result, report)


def _fill(
    folder: Path, block: ImageBlock, project: Project, result: Adjustment, report: Mapping[str, Any]
) -> None:
    (folder / "rig.toml").write_bytes(block.mission.rig_path.read_bytes())
    fill_results(folder, _named(project), result, report)
    frame = {"latitude_deg": block.frame.latitude_deg, "longitude_deg": block.frame.longitude_deg}
    (folder / FRAME_FILE).write_text(json.dumps(frame) + "\n", encoding="utf-8")
    georeference = Georeference(block.crs)
    adjusted = camera_orientations(result)
    place = block.frame.to_geodetic(adjusted.station_m)
    sigma = {o.name: o for o in adjusted_cameras(result)}
    rows: list[tuple[str | float, ...]] = []
    for k, name in enumerate(block.names):
        latitude, longitude, height = (float(v) for v in place[k])
        at = georeference.place(latitude, longitude, height)
        enu = block.frame.local_from_enu(latitude, longitude).T @ adjusted.rotation[k]
        angles = np.degrees(omega_phi_kappa(grid_from_enu(at.azimuth_of_north_rad) @ enu))
        own = sigma[name]
        rows.append(
            (
                name,
                at.east_m,
                at.north_m,
                at.height_m,
                *angles,
                latitude,
                longitude,
                *own.position_sigma_m,
                *np.degrees(own.angles_sigma_rad),
            )
        )
    write_table(
        folder / "exterior.csv",
        f"Adjusted exterior orientation in {block.crs}, heights: {georeference.height_system}.\n"
        "R = Rx(omega) Ry(phi) Rz(kappa), camera to grid; sigmas are of the local frame.",
        (
            *("image", "east_m", "north_m", "height_m", "omega_deg", "phi_deg", "kappa_deg"),
            *("latitude_deg", "longitude_deg", "sx_m", "sy_m", "sz_m"),
            *("so_deg", "sp_deg", "sk_deg"),
        ),
        rows,
    )


def _named(project: Project) -> Project:
    return replace(project, name=project.file.name)


def print_triangulation(console: Console, found: Mapping[str, Any]) -> None:
    """The section as sentences and a table."""
    rays = ", ".join(f"{n} of {k} rays" for k, n in found["rays"].items() if n)
    console.print(
        f"{found['exposures']} exposures of {found['lines']} lines, GSD {found['gsd_m']:.3f} m; "
        f"{found['matches_along']} matches along, {found['matches_across']} across lines; object "
        f"points: {rays}",
        highlight=False,
    )
    rms, px = found["image_rms_um"], found["image_rms_px"]
    console.print(
        f"RMSE of image measurements {rms[0]:.3f} {rms[1]:.3f} um = {px[0]:.4f} {px[1]:.4f} px",
        highlight=False,
    )
    if found["systematic_most_um"] is not None:
        console.print(
            f"Systematic image residuals: at most {found['systematic_most_um']:.3f} um "
            f"(means of {CELLS[0]} x {CELLS[1]} cells)",
            highlight=False,
        )
    if found["patterns"]["images"]:
        console.print(
            f"{found['patterns']['images']} images with patterns of stitching, at most "
            f"{found['patterns']['most']} each, which hold at least "
            f"{100.0 * found['patterns']['share']:.1f} % of its variance",
            highlight=False,
        )
    if found["mounting"]:
        mounting = light_table("Against the calibration", ("quantity",), ("value", "sigma", "unit"))
        for one in found["mounting"]:
            name = f"{one['what']}, camera's {one['axis']}"
            head = "" if one["head"] == MOUNTING else f"{one['head']} "
            mounting.add_row(head + name, f"{one['value']:.4g}", f"{one['sigma']:.3g}", one["unit"])
        console.print(mounting)
    table = light_table("Residuals", ("",), ("points", "x", "y", "z", "unit"))
    for key in ("control", "checks"):
        part = found[key]
        if part["count"]:
            for unit, digits in (("m", 4), ("px", 3)):
                cells = [f"{v:.{digits}f}" for v in part[f"rms_{unit}"]]
                table.add_row(key if unit == "m" else "", str(part["count"]), *cells, unit)
    if found["checks"]["count"]:
        cells = [f"{v:.4f}" for v in found["checks"]["predicted_m"]]
        table.add_row("checks, predicted", "", *cells, "m")
    if found["control"]["count"] or found["checks"]["count"]:
        console.print(table)
    else:
        console.print("No control and no check points: --points and --measured give them")
    for one in found.get("findings", ()):
        console.print(f"{one['name']}: {one['sentence']}", markup=False, highlight=False)

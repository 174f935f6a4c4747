"""The files of a live triangulation: `live.json`, `orientations.csv` and `report.html`.

`live.json` is described in docs/reference/formats.md. Every file is written whole, under its final
name only when it is complete.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from daemon.mission.canonical_json import canonical_bytes
from daemon.mission.store.level2 import write_folder
from daemon.onboard.triangulation.control_points import control_json
from daemon.onboard.triangulation.findings import live_ties
from daemon.onboard.triangulation.mission_triangulation import MissionTriangulation
from daemon.onboard.triangulation.quality_page import quality_page
from daemon.orientation.in_flight_orientation import ANGLES, PLACES
from daemon.orientation.local_frame import LocalFrame
from processing.geometry.rotation import omega_phi_kappa
from processing.pipelines.live_triangulation import LiveOrientation

FORMAT: Final = 1
COVARIANCE: Final = (
    "6 x 6, row by row: projection centre east, north, up (m^2) in the local frame, rotation "
    "vector about the camera's x, y, z (rad^2)"
)


def exposure_json(one: LiveOrientation, frame: LocalFrame) -> dict[str, Any]:
    """An orientation with its covariance."""
    latitude, longitude, height = (float(v) for v in frame.to_geodetic(one.position_m))
    enu = frame.local_from_enu(latitude, longitude).T @ one.rotation
    sigma = np.sqrt(np.diag(one.covariance))
    return {
        "exposure": one.image.number,
        "line": one.image.line,
        "source": one.source,
        "tie_points": one.ties,
        "latitude_deg": round(latitude, 10),
        "longitude_deg": round(longitude, 10),
        "height_m": round(height, 4),
        "omega_phi_kappa_deg": [round(math.degrees(a), 7) for a in omega_phi_kappa(enu)],
        "sigma_m": [float(v) for v in sigma[:3]],
        "sigma_mdeg": [math.degrees(float(v)) * 1e3 for v in sigma[3:]],
        "covariance": [float(v) for v in one.covariance.ravel()],
    }


def summary_json(done: MissionTriangulation) -> dict[str, Any]:
    """Figures of the block, for the page, the record and `--json`."""
    live = done.live
    accuracy, control = done.accuracy(), control_json(done.residuals)
    last = None if live is None else live.last
    return {
        "format": FORMAT,
        "mission": done.mission.id,
        "is_preliminary": not done.has_landed,
        "exposures": 0 if live is None else len(live.images),
        "adjusted": len(live.last_images) if live is not None else 0,
        "lines": [] if live is None else list(dict.fromkeys(i.line for i in live.images)),
        "sigma0": None if last is None else last.sigma0,
        "image_sigma_px": None if live is None else [float(v) for v in live.image_sigma_px],
        "accuracy": None if accuracy is None else accuracy.as_json(),
        "coverage": None if done.coverage is None else done.coverage.as_json(),
        "control": None if control is None else {**control, "residuals": None},
        "drifts": [one.as_json() for one in done.drifts],
        "line_ties": [
            {"lines": list(pair), "tried": tried, "found": found}
            for pair, (tried, found) in ({} if live is None else live_ties(live).pairs).items()
        ],
        "skipped": [{"exposure": k, "reason": v} for k, v in sorted(done.skipped.items())],
        "findings": [one.as_json() for one in done.findings],
        "reflights": reflights_json(done),
        "block_seconds": round(done.block_seconds, 3),
    }


def reflights_json(done: MissionTriangulation) -> list[dict[str, Any]]:
    """What to fly again by the tie points: exposures of a line, or lines that need a cross line."""
    advice: list[dict[str, Any]] = []
    live = done.live
    ties = None if live is None else live_ties(live)
    bad = {} if ties is None else dict.fromkeys(ties.untied_numbers, "no tie points")
    bad |= dict(done.skipped)
    line_of = {} if live is None else {i.number: i.line for i in live.images}
    runs: list[tuple[str | None, str, list[int]]] = []
    for number in sorted(bad):
        key = (line_of.get(number), bad[number])
        if runs and runs[-1][:2] == key and runs[-1][2][-1] == number - 1:
            runs[-1][2].append(number)
        else:
            runs.append((*key, [number]))
    advice += [
        {"kind": "exposures", "line": line, "from": own[0], "to": own[-1], "reason": reason}
        for line, reason, own in runs
    ]
    pairs = () if ties is None else ties.untied_pairs
    advice += [
        {"kind": "cross line", "lines": list(pair), "reason": "the lines do not tie"}
        for pair in pairs
    ]
    return advice


def live_json(done: MissionTriangulation) -> dict[str, Any]:
    """Content of `live.json`."""
    frame, live = done.frame, done.live
    place = (
        None
        if frame is None
        else {"latitude_deg": frame.latitude_deg, "longitude_deg": frame.longitude_deg}
    )
    own = [] if live is None or frame is None else live.orientations
    return {
        **summary_json(done),
        "control": control_json(done.residuals),
        "simulated": done.is_simulated,
        "places": PLACES,
        "angles": ANGLES,
        "covariance": COVARIANCE,
        "frame": place,
        "orientations": [exposure_json(one, frame) for one in own if frame is not None],
    }


def write_live(done: MissionTriangulation) -> Mapping[str, int]:
    """Write the files; those of an earlier moment are replaced at once.

    Raises:
        OSError: the disk refused.
    """
    content = live_json(done)
    return write_folder(
        done.folder,
        {
            "live.json": [canonical_bytes(content)],
            "orientations.csv": [_csv(content).encode("utf-8")],
            "report.html": [quality_page(content).encode("utf-8")],
        },
    )


def _csv(content: Mapping[str, Any]) -> str:
    lines = [
        f"# Orientations of {content['mission']}, {PLACES}.",
        f"# {ANGLES}. Sigmas: east, north, up; about the camera's x, y, z.",
        "exposure,line,latitude_deg,longitude_deg,height_m,omega_deg,phi_deg,kappa_deg,"
        "sx_m,sy_m,sz_m,rx_mdeg,ry_mdeg,rz_mdeg,tie_points,source",
    ]
    for one in content["orientations"]:
        line = str(one["line"]).replace('"', "'")
        cells = [
            f"{one['exposure']:06d}",
            f'"{line}"',
            f"{one['latitude_deg']:.10f}",
            f"{one['longitude_deg']:.10f}",
            f"{one['height_m']:.4f}",
            *(f"{v:.7f}" for v in one["omega_phi_kappa_deg"]),
            *(f"{v:.4f}" for v in one["sigma_m"]),
            *(f"{v:.4f}" for v in one["sigma_mdeg"]),
            str(one["tie_points"]),
            one["source"],
        ]
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"

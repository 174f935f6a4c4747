"""One row an exposure of a catalog, from the records of a mission.

Position and footprint are those of the navigation recorded in flight; no trajectory is needed, and
no frame is read.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from daemon.mission.canonical_json import sha256_hex
from daemon.mission.exposure import Exposure
from daemon.mission.exposure_batch import ExposureFailure, for_each_exposure
from daemon.mission.layout import Mission
from daemon.mission.store.level2 import read_report
from daemon.orientation.exterior_orientation import mount_of, sealed_exposures
from daemon.orientation.footprints import footprint_corners, utc_text
from daemon.orientation.stac_items import sun_angles_deg
from processing.rig import Rig, load_rig

Ring = tuple[tuple[float, float], ...]

COLUMNS: Final = (
    *("mission", "place", "exposure", "utc", "gps_ns", "state", "verdict", "flags", "gsd_m"),
    *("sun_elevation_deg", "sun_azimuth_deg", "latitude_deg", "longitude_deg", "height_m"),
    *("line", "strip", "rig", "calibration", "sensors", "frames", "record_sha256"),
    *("frame_sha256", "simulated"),
)
"""Columns of the table, in their order; the geometry follows."""


@dataclass(frozen=True)
class MissionRows:
    """Rows of a mission, `values` in the order of `COLUMNS`, and exposures that failed."""

    mission_id: str
    place: str
    rig_title: str
    rows: tuple[tuple[dict[str, Any], Ring | None], ...]
    failures: tuple[ExposureFailure, ...]


def mission_rows(mission: Mission, place: str) -> MissionRows:
    """The sealed exposures of a mission.

    Args:
        mission: a folder with the records; frames are not read.
        place: folder or address of the mission, for the table.

    Raises:
        DaemonError, RigError, OSError: rig or configuration cannot be read.
    """
    rig = load_rig(mission.rig_path)
    mount, plan = mount_of(mission)
    read = sealed_exposures(mission)

    def row_of(number: int) -> tuple[dict[str, Any], Ring | None]:
        exposure = read.results[number]
        ring = None
        if exposure.navigation is not None:
            corners = footprint_corners(rig, mount, exposure.navigation, plan.ground_height_m)
            ring = None if corners is None else tuple(corners)
        return _values(mission, place, rig, exposure, plan.ground_height_m), ring

    done = for_each_exposure(read.results, row_of, lambda _done: None)
    rows = tuple(done.results[number] for number in sorted(done.results))
    title = rig.title or rig.name
    return MissionRows(mission.id, place, title, rows, (*read.failures, *done.failures))


def _values(
    mission: Mission, place: str, rig: Rig, exposure: Exposure, ground_m: float
) -> dict[str, Any]:
    report = read_report(mission.level2(exposure.number)) or {}
    flags = dict.fromkeys(f["flag"] for f in report.get("findings", ()) if f.get("flag"))
    record = (mission.level0(exposure.number) / "exposure.json").read_bytes()
    where, instant = exposure.navigation, exposure.mark_gps_ns
    sun: tuple[float | None, float | None] = (None, None)
    if where is not None and instant is not None:
        sun = sun_angles_deg(instant, where.latitude_deg, where.longitude_deg)
    frames = [frame for frame in exposure.frames if frame.file]
    hashes = " ".join(f"{frame.sensor}:{frame.sha256}" for frame in frames)
    values = (
        *(mission.id, place, exposure.number),
        *(None if instant is None else utc_text(instant), instant, exposure.state),
        *(report.get("verdict"), " ".join(flags)),
        None if where is None else _gsd_m(rig, where.height_m, ground_m),
        *sun,
        *((None,) * 3 if where is None else (where.latitude_deg, where.longitude_deg)),
        *(() if where is None else (where.height_m,)),
        *(exposure.line_id, exposure.strip_id, rig.name, rig.calibration_id),
        *(" ".join(frame.sensor for frame in frames), len(frames), sha256_hex(record), hashes),
        exposure.simulated,
    )
    return dict(zip(COLUMNS, values, strict=True))


def _gsd_m(rig: Rig, height_m: float | None, ground_m: float) -> float | None:
    """Size of a pixel on level ground straight below."""
    if height_m is None:
        return None
    image = rig.virtual_image
    cone = rig.cone(rig.image_cone_name)
    ratio = cone.sensors[0].pitch_mm / cone.lens.f_mm
    return (height_m - ground_m) * (ratio if image is None else image.pitch_mm / image.f_mm)


def rings_of(rows: MissionRows) -> Iterator[Ring]:
    """Footprints there are."""
    return (ring for _, ring in rows.rows if ring is not None)

"""A set of exterior orientations of a mission, written as one folder next to earlier ones.

One folder a trajectory, `export/orientation/<trajectory>/`: what was known in flight stays when a
post-processed trajectory arrives.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from daemon import DaemonError
from daemon.configuration.model import MountSection
from daemon.mission.canonical_json import plain_name, sha256_hex
from daemon.mission.exposure import Exposure
from daemon.mission.exposure_batch import ExposureFailure
from daemon.mission.layout import Mission
from daemon.mission.store.level2 import verdict_of, write_folder
from daemon.orientation import footprints
from daemon.orientation.elevation import read_elevation
from daemon.orientation.exterior_orientation import (
    ExteriorOrientation,
    MissingOrientation,
    mount_of,
    orient,
    sealed_exposures,
)
from daemon.orientation.footprints import rings_on_terrain
from daemon.orientation.georeference import Georeference
from daemon.orientation.orientation_files import (
    OrientationSetInfo,
    about_text,
    bingo_text,
    certificate,
    csv_text,
    patb_text,
)
from daemon.orientation.orientation_inputs import OrientationError
from daemon.orientation.stac_items import ItemContext, item_collection
from daemon.orientation.trajectory import flown_trajectory
from daemon.postflight.batch.batch_run import Compute, in_this_process
from daemon.postflight.batch.executor import BatchTask
from daemon.postflight.export.orientation_work import OrientationWork, orientation_request
from processing.geometry.rotation import vectors_from_rotations
from processing.rig import Rig


@dataclass(frozen=True)
class OrientationSet:
    """The written set, and its differences from an earlier set.

    `change_m` and `change_deg` are the greatest differences of position and of any axis's
    direction against the in-flight orientation of the same images; `offset_m` is the median of the
    differences of position forward, right and down of the camera. None where there is none.
    `failures` are exposures that could not be read, or not be placed in the coordinate system.
    """

    folder: Path
    oriented: tuple[ExteriorOrientation, ...]
    missing: tuple[MissingOrientation, ...]
    crs: str
    height_system: str
    trajectory: str
    change_m: float | None
    change_deg: float | None
    offset_m: tuple[float, float, float] | None
    failures: tuple[ExposureFailure, ...]


def export_orientation(
    mission: Mission,
    *,
    crs: str | None = None,
    trajectory_file: Path | None = None,
    receiver: str | None = None,
    mount_file: Path | None = None,
    dem_file: Path | None = None,
    compute: Compute = in_this_process,
) -> OrientationSet:
    """Orient all sealed exposures and write the set.

    Args:
        crs: target system; by default the UTM zone of the first place, ellipsoidal heights.
        trajectory_file: a post-processed trajectory instead of the navigation of the flight.
        receiver: whose navigation, where the flight had several.
        mount_file: TOML with a `[mount]` in place of the one that was flown.
        dem_file: height model that footprints are followed to, in the same system.
        compute: where exposures are oriented.

    Raises:
        OrientationError: no exposure could be oriented.
        TrajectoryError, GeoreferenceError, RecordError: as their modules say.
    """
    read = sealed_exposures(mission)
    exposures = list(read.results.values())
    request = orientation_request(
        mission,
        exposures,
        crs=crs,
        trajectory_file=trajectory_file,
        mount_file=mount_file,
        receiver=receiver,
    )
    inputs = request.read()
    rig, trajectory, georeference = inputs.rig, inputs.trajectory, inputs.georeference
    done = compute(
        OrientationWork(request), [BatchTask(number, one) for number, one in read.results.items()]
    )
    failures = (*read.failures, *done.failures)
    found = [one for number in sorted(done.results) for one in done.results[number]]
    oriented = tuple(one for one in found if isinstance(one, ExteriorOrientation))
    missing = tuple(one for one in found if isinstance(one, MissingOrientation))
    if not oriented:
        reasons = ", ".join(
            [
                *sorted({one.reason for one in missing}),
                *dict.fromkeys(one.cause for one in failures),
            ]
        )
        raise OrientationError(
            f"{mission.path}: nothing could be oriented ({reasons}). A receiver without attitude "
            "orients nothing; give --trajectory with one that has it"
        )
    change = _Change(None, None, None)
    if trajectory_file is not None or mount_file is not None:
        change = _change(mission, oriented, rig, mount_of(mission)[0], georeference, exposures)
    simulated = any(exposure.simulated for exposure in exposures)
    on = "on level ground" if dem_file is None else f"on the height model {dem_file.name}"
    about = OrientationSetInfo(
        mission.id, rig, simulated, trajectory.name, inputs.mount, georeference, on
    )
    verdicts = {
        e.number: verdict
        for e in exposures
        if (verdict := verdict_of(mission.level2(e.number))) is not None
    }
    ground_m = inputs.ground_height_m
    rings = None
    if dem_file is not None:
        model = read_elevation(dem_file, georeference)
        rings = rings_on_terrain(oriented, rig, model, georeference)
    features = footprints.geojson(
        oriented, rig, ground_m, simulated=simulated, verdicts=verdicts, rings=rings
    )
    context = ItemContext(mission.id, rig, ground_m, simulated)
    items = item_collection(mission, context, oriented, verdicts=verdicts, base_href="../../..")
    texts = {
        "orientation.csv": csv_text(about, oriented),
        "orientation.ori": patb_text(about, oriented),
        "orientation.bingo": bingo_text(about, oriented),
        "footprints.geojson": json.dumps(features) + "\n",
        "items.json": json.dumps(items) + "\n",
        "about.txt": about_text(about, oriented, missing),
    }
    if rig.virtual_image is not None:
        texts["camera.json"] = json.dumps(certificate(rig), indent=1) + "\n"
    name = trajectory.name if plain_name(trajectory.name) else "post-processed"
    if mount_file is not None:
        name += f"-{sha256_hex(mount_file.read_bytes())[:8]}"
    folder = mission.export_dir / "orientation" / name
    write_folder(folder, {file: [text.encode("utf-8")] for file, text in texts.items()})
    return OrientationSet(
        folder=folder,
        oriented=oriented,
        missing=missing,
        crs=f"{georeference.name} ({georeference.crs.name})",
        height_system=georeference.height_system,
        trajectory=trajectory.name,
        change_m=change.metres,
        change_deg=change.degrees,
        offset_m=change.offset_m,
        failures=failures,
    )


def as_json(done: OrientationSet) -> Mapping[str, Any]:
    """The set as an object of JSON types."""
    return {
        "folder": str(done.folder),
        "crs": done.crs,
        "heights": done.height_system,
        "trajectory": done.trajectory,
        "change_m": done.change_m,
        "change_deg": done.change_deg,
        "offset_forward_right_down_m": done.offset_m,
        "oriented": [
            {
                "image": eo.name,
                "gps_ns": str(eo.gps_ns),
                "east_m": float(eo.centre_m[0]),
                "north_m": float(eo.centre_m[1]),
                "height_m": float(eo.centre_m[2]),
                "omega_phi_kappa_deg": list(eo.omega_phi_kappa_deg),
            }
            for eo in done.oriented
        ],
        "missing": [
            {"exposure": one.exposure, "cone": one.cone, "why": one.reason} for one in done.missing
        ],
        "failures": [failure.as_json() for failure in done.failures],
    }


@dataclass(frozen=True)
class _Change:
    """See `OrientationSet`."""

    metres: float | None
    degrees: float | None
    offset_m: tuple[float, float, float] | None


def _change(
    mission: Mission,
    oriented: tuple[ExteriorOrientation, ...],
    rig: Rig,
    mount: MountSection,
    georeference: Georeference,
    exposures: Sequence[Exposure],
) -> _Change:
    """Changes against the in-flight orientation."""
    try:
        trajectory = flown_trajectory(mission)
    except DaemonError:
        return _Change(None, None, None)
    before = {
        one.name: one
        for exposure in exposures
        for one in orient(exposure, rig, mount, trajectory, georeference)
        if isinstance(one, ExteriorOrientation)
    }
    both = [(before[eo.name], eo) for eo in oriented if eo.name in before]
    if not both:
        return _Change(None, None, None)
    moved = [float(np.linalg.norm(b.centre_m - a.centre_m)) for a, b in both]
    turned = vectors_from_rotations(np.array([a.rotation.T @ b.rotation for a, b in both]))
    right, forward, up = np.median(
        [a.rotation.T @ (b.centre_m - a.centre_m) for a, b in both if a.cone == rig.image_cone_name]
        or [np.full(3, np.nan)],
        axis=0,
    )
    return _Change(
        max(moved),
        float(np.degrees(np.linalg.norm(turned, axis=1).max())),
        None if np.isnan(up) else (float(forward), float(right), float(-up)),
    )

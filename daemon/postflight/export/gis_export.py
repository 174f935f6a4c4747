"""A mission for a GIS: `export/gis/mission.gpkg` and `mission.kmz`."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from daemon.mission.exposure_batch import ExposureFailure, for_each_exposure
from daemon.mission.layout import Mission
from daemon.mission.store.direct_io import create_file
from daemon.mission.store.durable import sync_file
from daemon.mission.store.output_places import refuse_foreign_files
from daemon.mission.store.publication import published
from daemon.orientation.elevation import read_elevation
from daemon.orientation.exterior_orientation import sealed_exposures
from daemon.orientation.footprints import rings_on_terrain
from daemon.orientation.orientation_inputs import OrientationError, read_orientation_inputs
from daemon.postflight.export.geopackage import write_geopackage
from daemon.postflight.export.gis_layers import GisLayer, ImagePlace, gis_layers, image_places
from daemon.postflight.export.kmz import kmz_bytes

_FILES = re.compile(r"mission\.(gpkg(-wal|-shm|-journal)?|kmz)")
"""What is written, and what SQLite puts next to it."""


@dataclass(frozen=True)
class GisExport:
    """The folder, its layers, and exposures that failed."""

    folder: Path
    layers: tuple[GisLayer, ...]
    failures: tuple[ExposureFailure, ...]


def export_gis(
    mission: Mission,
    *,
    crs: str | None = None,
    trajectory_file: Path | None = None,
    mount_file: Path | None = None,
    dem_file: Path | None = None,
    progress: Callable[[int], None] = lambda _done: None,
) -> GisExport:
    """Write the GeoPackage and the KMZ.

    Args:
        mission: whose images are described.
        crs: coordinate system of the angles; the layers are in WGS 84.
        trajectory_file: post-processed trajectory.
        mount_file: TOML file with the mount.
        dem_file: height model that footprints are followed to, in the coordinate system.
        progress: called with the number of exposures done.

    Raises:
        OrientationError: no exposure could be oriented.
        OutputPlaceError: the folder holds something else, such as a project of QGIS.
        TrajectoryError, GeoreferenceError: as their modules say.
    """
    read = sealed_exposures(mission)
    exposures = list(read.results.values())
    inputs = read_orientation_inputs(
        mission, exposures, crs=crs, trajectory_file=trajectory_file, mount_file=mount_file
    )
    model = None if dem_file is None else read_elevation(dem_file, inputs.georeference)

    def places_of(number: int) -> list[ImagePlace]:
        oriented = inputs.oriented([read.results[number]])
        rings = None
        if model is not None:
            rings = rings_on_terrain(oriented, inputs.rig, model, inputs.georeference)
        return image_places(mission, inputs.rig, oriented, inputs.ground_height_m, rings)

    done = for_each_exposure(read.results, places_of, progress)
    images = [place for number in sorted(done.results) for place in done.results[number]]
    failures = (*read.failures, *done.failures)
    if not images:
        causes = "; ".join(dict.fromkeys(failure.cause for failure in failures))
        raise OrientationError(
            f"{mission.path}: nothing could be oriented. Give --trajectory with one that has the "
            f"attitude{f' ({causes})' if causes else ''}"
        )
    simulated = any(exposure.simulated for exposure in exposures)
    layers = gis_layers(mission, inputs.rig, images, inputs.ground_height_m, simulated=simulated)
    folder = mission.export_dir / "gis"
    title = f"{'SIMULATED: ' if simulated else ''}{mission.id}"
    refuse_foreign_files(folder, _FILES)
    with published(folder) as part:
        write_geopackage(part / "mission.gpkg", layers)
        sync_file(part / "mission.gpkg")
        create_file(part / "mission.kmz", [kmz_bytes(title, layers)], mode=0o644)
    return GisExport(folder, layers, failures)

"""Export of the pictures of a mission: which exposures, where, and what could not be exported."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from daemon.mission.exposure_batch import ExposureFailure
from daemon.mission.layout import Mission
from daemon.mission.store.durable import make_directories
from daemon.orientation.exterior_orientation import sealed_exposures
from daemon.postflight.batch.batch_run import Compute, in_this_process
from daemon.postflight.batch.executor import BatchTask
from daemon.postflight.export.level2_export import PictureError
from daemon.postflight.export.orientation_work import orientation_request
from daemon.postflight.export.picture_work import PictureWork
from processing.rig import load_rig


def export_pictures(
    mission: Mission,
    kind: str,
    *,
    crs: str | None = None,
    trajectory_file: Path | None = None,
    mount_file: Path | None = None,
    only: Sequence[int] = (),
    level: int = 2,
    depth: int = 16,
    roll_pitch_yaw_sigma_deg: tuple[float, float, float] | None = None,
    compute: Compute = in_this_process,
) -> tuple[list[Path], tuple[ExposureFailure, ...]]:
    """Write every raster of a level as `kind` into `export/<kind>/`.

    Stitched products have a folder each, named after the product: programs that read several bands
    take images of different bands in one folder as those of one rig.

    Args:
        mission: whose pictures.
        kind: "cog", "tiff", "jp2" or "jpeg".
        crs: target system; None is the UTM zone of the trajectory's beginning.
        trajectory_file: post-processed; None is the navigation of the flight.
        mount_file: TOML with a `[mount]` in place of the one that was flown.
        only: numbers of exposures; none: all.
        level: 2, or 3 for pansharpened RGB and CIR.
        depth: 16 or 8 bits of Level-3; Level-2 has 16.
        roll_pitch_yaw_sigma_deg: standard deviations of attitude, where they are known.
        compute: where exposures are computed.

    Returns:
        The files, and the exposures that could not be exported.

    Raises:
        PictureError: no Level-2, no orientation, or rasterio is missing.
        TrajectoryError, GeoreferenceError: as their modules say.
    """
    read = sealed_exposures(mission)
    exposures = {
        number: exposure
        for number, exposure in read.results.items()
        if exposure.mark_gps_ns is not None and (not only or number in only)
    }
    unreadable = [f for f in read.failures if not only or f.exposure in only]
    if level == 2 and (bands := _single_bands(mission, exposures)):
        raise PictureError(
            f"{mission.path}: Level-2 has registered bands as single rasters, which this command "
            f"does not export; take L2/<exposure>/{bands[0]}.tif as it is, or heads with "
            "orientation by `syntopic export block --images raw`"
        )
    request = orientation_request(
        mission,
        list(exposures.values()),
        crs=crs,
        trajectory_file=trajectory_file,
        mount_file=mount_file,
    )
    folder = mission.export_dir / kind
    make_directories(folder)
    work = PictureWork(request, folder.absolute(), kind, level, depth, roll_pitch_yaw_sigma_deg)
    done = compute(work, [BatchTask(number, one) for number, one in exposures.items()])
    files = [folder / name for number in sorted(done.results) for name in done.results[number]]
    failures = (*unreadable, *done.failures)
    if not files:
        causes = "".join(f"; {cause}" for cause in dict.fromkeys(one.cause for one in failures))
        raise PictureError(
            f"{mission.path}: no exposure has both Level-{level} and an orientation; run "
            f"`syntopic {'process' if level == 2 else 'pansharpen'}` first, and give --trajectory "
            "where no receiver knew the attitude"
            f"{causes}"
        )
    return files, failures


def _single_bands(mission: Mission, exposures: Iterable[int]) -> list[str]:
    """Bands that Level-2 has as a raster each, in the geometry of one; empty with other rasters."""
    rig = load_rig(mission.rig_path)
    if rig.virtual_image is not None:
        return []
    cones = {cone.name for cone in rig.cones}
    bands = [band for cone in rig.cones for band in cone.bands if band not in cones]
    folders = [mission.level2(number) for number in exposures]
    if any((folder / f"{cone}.tif").exists() for folder in folders for cone in cones):
        return []
    return [b for b in bands if any((folder / f"{b}.tif").exists() for folder in folders)]

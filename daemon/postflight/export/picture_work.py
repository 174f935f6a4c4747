"""The work of `syntopic export pictures`: the pictures of one exposure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from daemon.mission.layout import Mission
from daemon.mission.store.durable import make_directories, replace_file
from daemon.orientation.orientation_inputs import OrientationInputs
from daemon.postflight.batch.capacity import PROCESS_NBYTES
from daemon.postflight.batch.executor import BatchTask
from daemon.postflight.export.level2_export import (
    jpeg_with_metadata,
    metadata_of,
    pictures_of,
    write_picture,
)
from daemon.postflight.export.orientation_work import OrientationRequest
from daemon.postflight.export.picture_files import SUFFIXES
from processing.rig import load_rig

PIXEL_NBYTES = 20
"""Of one pixel of the largest picture: its bands, a copy in tiles, and the encoded file."""


@dataclass(frozen=True)
class PictureWork:
    """What all pictures of a run have in common; it can be pickled.

    The payload of a task is its exposure. `folder` is an absolute path.
    """

    request: OrientationRequest
    folder: Path
    kind: str
    level: int
    depth: int
    roll_pitch_yaw_sigma_deg: tuple[float, float, float] | None = None
    threads: int = 1

    @property
    def memory_nbytes(self) -> int:
        mission = self.request.mission
        rig = load_rig(Mission(mission, mission.name).rig_path)
        sizes = [(sensor.width_px, sensor.height_px) for sensor in rig.sensors]
        if rig.virtual_image is not None:
            sizes = [(rig.virtual_image.width_px, rig.virtual_image.height_px)]
        return PROCESS_NBYTES + PIXEL_NBYTES * max(width * height for width, height in sizes)

    def open(self) -> PictureAction:
        """Read trajectory and mount.

        Raises:
            DaemonError: an input cannot be read.
        """
        mission = Mission.open(self.request.mission, checks_subfolders=False)
        return PictureAction(self, mission, self.request.read())


class PictureAction:
    """Writes the pictures of one exposure at a time."""

    def __init__(self, work: PictureWork, mission: Mission, inputs: OrientationInputs) -> None:
        self._work, self._mission, self._inputs = work, mission, inputs

    def clone(self) -> PictureAction:
        """The same: it has no buffers."""
        return self

    def __call__(self, task: BatchTask) -> list[str]:
        """Files that were written, relative to the folder of the export.

        Raises:
            RasterError: a raster cannot be read.
            OSError: the disk refused.
        """
        work, inputs, exposure = self._work, self._inputs, task.payload
        written = []
        oriented = inputs.oriented([exposure])
        for picture in pictures_of(
            self._mission, inputs.rig, exposure, oriented, work.level, work.depth
        ):
            shot = metadata_of(
                inputs.rig, picture, inputs.crs, simulated=exposure.simulated,
                mission_id=self._mission.id,
                roll_pitch_yaw_sigma_deg=work.roll_pitch_yaw_sigma_deg,
            )  # fmt: skip
            folder = work.folder / picture.product
            make_directories(folder)
            final = folder / f"{picture.name}{SUFFIXES[work.kind]}"
            if work.kind == "jpeg":
                replace_file(final, jpeg_with_metadata(picture, shot))
            else:
                write_picture(
                    work.kind, picture, shot, inputs.georeference, inputs.ground_height_m, final
                )
            written.append(final.relative_to(work.folder).as_posix())
        return written

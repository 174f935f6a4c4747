"""The work of `syntopic orient`: exterior orientations of one exposure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.orientation.exterior_orientation import ExteriorOrientation, MissingOrientation
from daemon.orientation.orientation_inputs import OrientationInputs, read_orientation_inputs
from daemon.postflight.batch.capacity import PROCESS_NBYTES
from daemon.postflight.batch.executor import BatchTask


@dataclass(frozen=True)
class OrientationRequest:
    """Files and options by which exposures are oriented; it can be pickled.

    `mission` and files are absolute paths. `stamped` is an exposure with a GPS time, from which the
    week of a trajectory is known. `inputs` is what was read of them; another process reads it
    again.
    """

    mission: Path
    stamped: Exposure
    crs: str
    trajectory_file: Path | None = None
    mount_file: Path | None = None
    receiver: str | None = None
    inputs: OrientationInputs | None = None

    def read(self) -> OrientationInputs:
        """Camera, mount, trajectory and coordinate system.

        Raises:
            DaemonError: see `daemon.orientation.orientation_inputs.read_orientation_inputs`.
        """
        return self.inputs or read_orientation_inputs(
            Mission.open(self.mission, checks_subfolders=False),
            [self.stamped],
            crs=self.crs,
            trajectory_file=self.trajectory_file,
            mount_file=self.mount_file,
            receiver=self.receiver,
        )

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "inputs": None}


def orientation_request(
    mission: Mission,
    exposures: list[Exposure],
    *,
    crs: str | None = None,
    trajectory_file: Path | None = None,
    mount_file: Path | None = None,
    receiver: str | None = None,
) -> OrientationRequest:
    """Read the inputs of an orientation, and note how to read them in another process.

    Args:
        mission: of the exposures.
        exposures: that are to be oriented.
        crs: such as EPSG:25833; None is the UTM zone of the trajectory's beginning.
        trajectory_file: post-processed; None is the navigation of the flight.
        mount_file: TOML with a `[mount]` in place of the one that was flown.
        receiver: whose navigation, where the flight had several.

    Raises:
        DaemonError: see `daemon.orientation.orientation_inputs.read_orientation_inputs`.
    """
    inputs = read_orientation_inputs(
        mission, exposures, crs=crs, trajectory_file=trajectory_file, mount_file=mount_file,
        receiver=receiver,
    )  # fmt: skip
    return OrientationRequest(
        mission.path.absolute(),
        next(exposure for exposure in exposures if exposure.mark_gps_ns is not None),
        inputs.crs,
        trajectory_file and trajectory_file.absolute(),
        mount_file and mount_file.absolute(),
        receiver,
        inputs,
    )


@dataclass(frozen=True)
class OrientationWork:
    """How all exposures of a run are oriented; the payload of a task is its exposure."""

    request: OrientationRequest
    threads: int = 1

    @property
    def memory_nbytes(self) -> int:
        return PROCESS_NBYTES

    def open(self) -> OrientationAction:
        """Read trajectory and mount.

        Raises:
            DaemonError: an input cannot be read.
        """
        return OrientationAction(self.request.read())


class OrientationAction:
    """Orients one exposure at a time."""

    def __init__(self, inputs: OrientationInputs) -> None:
        self._inputs = inputs

    def clone(self) -> OrientationAction:
        """The same: it has no buffers."""
        return self

    def __call__(self, task: BatchTask) -> list[ExteriorOrientation | MissingOrientation]:
        """Orientations of all cones, the one the image belongs to first.

        Raises:
            GeoreferenceError: outside the area of the coordinate system.
        """
        return list(self._inputs.of(task.payload))

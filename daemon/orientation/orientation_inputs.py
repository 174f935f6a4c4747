"""Inputs for orienting the exposures of a mission: camera, mount, trajectory, coordinate system.

Defaults are those of the flight; how one exposure is oriented is in
`daemon.orientation.exterior_orientation`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from daemon import DaemonError
from daemon.configuration.model import MountSection
from daemon.mission.canonical_json import sha256_hex
from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.orientation.exterior_orientation import (
    ExteriorOrientation,
    MissingOrientation,
    mount_of,
    orient,
    read_mount,
)
from daemon.orientation.geodesy import utm_of
from daemon.orientation.georeference import Georeference
from daemon.orientation.rtklib_positions import SUFFIX, read_positions, with_flown_attitude
from daemon.orientation.trajectory import (
    Trajectory,
    flown_trajectory,
    read_trajectory,
    trajectory_of_samples,
)
from daemon.orientation.trajectory_agreement import refuse_other_trajectory
from processing.rig import Rig, load_rig


class OrientationError(DaemonError):
    """Nothing can be oriented; the message states why."""


@dataclass(frozen=True)
class OrientationInputs:
    """Options of an orientation; `ground_height_m` as planned."""

    rig: Rig
    mount: MountSection
    ground_height_m: float
    trajectory: Trajectory
    crs: str
    georeference: Georeference

    def of(self, exposure: Exposure) -> Iterator[ExteriorOrientation | MissingOrientation]:
        """See `daemon.orientation.exterior_orientation.orient`."""
        return orient(exposure, self.rig, self.mount, self.trajectory, self.georeference)

    def oriented(self, exposures: Iterable[Exposure]) -> list[ExteriorOrientation]:
        """Exposures that can be oriented."""
        every = (one for exposure in exposures for one in self.of(exposure))
        return [one for one in every if isinstance(one, ExteriorOrientation)]


def read_orientation_inputs(
    mission: Mission,
    exposures: Sequence[Exposure],
    *,
    crs: str | None = None,
    trajectory_file: Path | None = None,
    mount_file: Path | None = None,
    receiver: str | None = None,
) -> OrientationInputs:
    """Inputs to orient these exposures with.

    Args:
        crs: such as EPSG:25833; None is the UTM zone of the trajectory's beginning.
        trajectory_file: post-processed; None is the navigation of the flight.
        mount_file: TOML with a `[mount]` in place of the one that was flown.
        receiver: whose navigation, where the flight had several.

    Raises:
        OrientationError: none of them has a GPS time.
        TrajectoryError, GeoreferenceError: as their modules say.
    """
    mount, plan = mount_of(mission)
    if mount_file is not None:
        mount = read_mount(mount_file)
    trajectory = trajectory_of(mission, exposures, trajectory_file, receiver)
    if crs is None:
        first = trajectory.sample(0).position
        if first is None:
            raise OrientationError(
                f"{trajectory.name}: no position in its first sample; give --crs"
            )
        crs = utm_of(*first)
        if crs is None:
            raise OrientationError(f"no UTM zone at {first[0]:.4f} deg latitude; give --crs")
    rig = load_rig(mission.rig_path)
    return OrientationInputs(rig, mount, plan.ground_height_m, trajectory, crs, Georeference(crs))


def trajectory_of(
    mission: Mission,
    exposures: Iterable[Exposure],
    trajectory_file: Path | None,
    receiver: str | None = None,
) -> Trajectory:
    """A file's trajectory, its week known from the exposures; without one, that of the flight.

    Raises:
        OrientationError: none of the exposures has a GPS time.
        TrajectoryError: a file that is not of this flight.
    """
    exposures = list(exposures)
    stamped = next((e.mark_gps_ns for e in exposures if e.mark_gps_ns is not None), None)
    if stamped is None:
        raise OrientationError(
            f"{mission.path}: no sealed exposure with a GPS time, so nothing can be oriented"
        )
    if trajectory_file is None:
        return flown_trajectory(mission, receiver)
    if trajectory_file.suffix.lower() == SUFFIX:
        positions = read_positions(trajectory_file)
        digest = sha256_hex(trajectory_file.read_bytes())[:8]
        name = f"{trajectory_file.stem}-{digest}"
        refuse_other_trajectory(trajectory_of_samples(name, positions), exposures)
        return with_flown_attitude(name, positions, flown_trajectory(mission, receiver))
    trajectory = read_trajectory(trajectory_file, around_gps_ns=stamped)
    refuse_other_trajectory(trajectory, exposures)
    return trajectory

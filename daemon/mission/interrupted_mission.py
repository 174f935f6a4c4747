"""The mission that a configuration was flying when its service ended."""

from __future__ import annotations

from daemon.configuration.model import Configuration
from daemon.mission.layout import Mission
from daemon.mission.mirror.mirror_startup import FoundDisks, find_disks


def disks_of(configuration: Configuration) -> FoundDisks | None:
    """The disks of a mirrored configuration, and the mission being flown on them; else None.

    Raises:
        OSError, MissionError: no disk can be used.
    """
    mission = configuration.mission
    if mission.mirror is None:
        return None
    return find_disks({"root": mission.root, "mirror": mission.mirror})


def interrupted_mission(configuration: Configuration) -> Mission | None:
    """The mission that was being flown when the service ended; None after an orderly end.

    Raises:
        MissionError: the marker of the mission being flown is damaged.
        OSError: no disk of a mirrored configuration can be used.
    """
    found = disks_of(configuration)
    if found is not None:
        return found.mission
    root = configuration.mission.root
    return Mission.current(root) if root.is_dir() else None

"""The rig: what the camera is made of, and the file that says so.

A leaf: it imports nothing of ours. What follows from the geometry (overlaps, parameter counts) is
in `processing.geometry.topology`; where a sensor's pixels fall in the virtual image is in
`processing.geometry.placement`.
"""

from processing.rig.file import (
    RIG_FORMAT,
    find_rig,
    load_rig,
    rig_from_mapping,
    shipped_rigs,
)
from processing.rig.model import (
    VIRTUAL_CAMERA,
    Cone,
    Drift,
    Lens,
    LensGrid,
    Rig,
    Role,
    Sensor,
    Timing,
    VirtualImage,
)
from processing.rig.table import RigError

__all__ = [
    "RIG_FORMAT",
    "VIRTUAL_CAMERA",
    "Cone",
    "Drift",
    "Lens",
    "LensGrid",
    "Rig",
    "RigError",
    "Role",
    "Sensor",
    "Timing",
    "VirtualImage",
    "find_rig",
    "load_rig",
    "rig_from_mapping",
    "shipped_rigs",
]

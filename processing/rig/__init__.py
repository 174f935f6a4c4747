"""The rig: the parts of the camera, and the file that describes them.

What follows from the geometry (overlaps, parameter counts) is
in `processing.geometry.topology`; where a sensor's pixels fall in the virtual image is in
`processing.geometry.placement`.
"""

from processing.rig.model import (
    VIRTUAL_CAMERA,
    Cone,
    Lens,
    LensGrid,
    Rig,
    Role,
    Sensor,
    ThermalDrift,
    Timing,
    VirtualImage,
)
from processing.rig.rig_file import (
    RIG_FORMAT,
    RigError,
    find_rig,
    load_rig,
    rig_from_mapping,
    shipped_rigs,
)

__all__ = [
    "RIG_FORMAT",
    "VIRTUAL_CAMERA",
    "Cone",
    "Lens",
    "LensGrid",
    "Rig",
    "RigError",
    "Role",
    "Sensor",
    "ThermalDrift",
    "Timing",
    "VirtualImage",
    "find_rig",
    "load_rig",
    "rig_from_mapping",
    "shipped_rigs",
]

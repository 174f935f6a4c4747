"""Controls of a head: their names, kinds and bounds.

They are read and written in `drivers.cameras.v4l2.control_port`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from drivers.cameras.v4l2 import uapi

NUMBERS: Final = (
    uapi.CTRL_TYPE_INTEGER,
    uapi.CTRL_TYPE_BOOLEAN,
    uapi.CTRL_TYPE_MENU,
    uapi.CTRL_TYPE_INTEGER64,
    uapi.CTRL_TYPE_BITMASK,
    uapi.CTRL_TYPE_INTEGER_MENU,
)
"""Types of controls whose value is one number."""


@dataclass(frozen=True)
class Control:
    """A control of the head, named as v4l2-ctl does; `path` is its sub-device, empty for the
    node."""

    id: int
    name: str
    type: int
    minimum: int
    maximum: int
    flags: int
    path: str = ""

    @property
    def is_button(self) -> bool:
        """Whether the control has no value and writing it causes an action."""
        return self.type == uapi.CTRL_TYPE_BUTTON

    @property
    def is_readable_number(self) -> bool:
        """Whether the control has a value that is a number and may be read."""
        return self.type in NUMBERS and not self.flags & uapi.CTRL_FLAG_WRITE_ONLY


def control_name(title: str) -> str:
    """The name of a control as v4l2-ctl prints it.

    Args:
        title: title from the kernel.

    Returns:
        Lower case letters, digits and underscores.

    Example:
        >>> control_name("Exposure Time, Absolute")
        'exposure_time_absolute'
    """
    return re.sub(r"[^a-z0-9]+", "_", title.lower()).strip("_")

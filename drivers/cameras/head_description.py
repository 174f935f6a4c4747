"""Properties of a head that a new configuration needs, read from the head itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class HeadDescription:
    """A head that answered.

    `width_px`, `height_px` are those it is set to, `full_width_px`, `full_height_px` those of its
    sensor (0: not stated). `filter_array` is "none" or the Bayer pattern as rig files write it.
    `settings` are those of its driver that reach it and choose its pixel format. `is_triggerable`:
    its exposures can be started by software.
    """

    driver: str
    model: str
    serial: str
    place: str
    width_px: int
    height_px: int
    pixel_format: str
    bits: int
    filter_array: str = "none"
    full_width_px: int = 0
    full_height_px: int = 0
    is_triggerable: bool = True
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def is_cropped(self) -> bool:
        """Whether the head is set to less than its sensor."""
        return self.full_width_px > self.width_px or self.full_height_px > self.height_px

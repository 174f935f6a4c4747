"""Description of a V4L2 head for a new configuration: size, format and trigger of its frames."""

from __future__ import annotations

from typing import Final

from drivers.cameras.head_description import HeadDescription
from drivers.cameras.v4l2.discovery import FoundNode
from drivers.cameras.v4l2.formats import FORMATS, PixelFormat
from drivers.cameras.v4l2.node import VideoNode
from drivers.contract import DeviceError

_PATTERN_AT: Final = slice(1, 5)
"""Of the Bayer pattern in a name such as SRGGB12."""


def describe(found: FoundNode) -> HeadDescription:
    """Open a capture node, read its size, formats and controls, and close it.

    Args:
        found: as the discovery found it.

    Returns:
        The head as it is set now.

    Raises:
        DeviceError: it does not answer, or has no usable format.
    """
    usable = [FORMATS[name] for name in found.formats if name in FORMATS]
    if not usable:
        raise DeviceError(
            f"head {found.card} at {found.path}: it has no pixel format of 8 to 16 bits, "
            "monochrome or Bayer; it cannot be used"
        )
    widest = max(usable, key=lambda one: (one.bits, one.name))
    try:
        node = VideoNode(found.path)
        try:
            layout = node.layout()
            buttons = [one.name for one in node.controls().values() if one.is_button]
        finally:
            node.close()
    except OSError as error:
        raise DeviceError(
            f"head {found.card} at {found.path}: its properties cannot be read "
            f"({error.strerror or error}); check power and cable, then try again"
        ) from None
    trigger = next((name for name in buttons if "trigger" in name), "")
    model, serial = (_printable(text) for text in (found.card, found.serial))
    return HeadDescription(
        driver="v4l2",
        model=model,
        serial=serial,
        place=found.path,
        width_px=layout.width_px,
        height_px=layout.height_px,
        pixel_format=widest.name,
        bits=widest.bits,
        filter_array=_filter_array(widest),
        is_triggerable=bool(trigger),
        settings={
            "device": found.path,
            **({"serial": serial} if serial else {}),
            "pixel_format": widest.name,
            "width_px": layout.width_px,
            "height_px": layout.height_px,
            **({"trigger_source": "software", "trigger_control": trigger} if trigger else {}),
        },
    )


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in text)


def _filter_array(pixel_format: PixelFormat) -> str:
    pattern = pixel_format.name[_PATTERN_AT]
    return pattern if pixel_format.name.startswith("S") else "none"

"""The kernel's media controller API and sub-device API as they lie in memory.

Nothing is called here; that is in `drivers.cameras.v4l2.media` and `drivers.cameras.v4l2.pipeline`.

Source: linux/media.h, linux/v4l2-subdev.h, linux/v4l2-mediabus.h, linux/media-bus-format.h.
"""

from __future__ import annotations

import ctypes
from typing import Final

ENT_F_CAM_SENSOR: Final = 0x0002_0001
LNK_FL_ENABLED: Final = 1 << 0
LNK_FL_LINK_TYPE: Final = 0xF << 28
LNK_FL_DATA_LINK: Final = 0
LNK_FL_INTERFACE_LINK: Final = 1 << 28
SUBDEV_FORMAT_ACTIVE: Final = 1
SEL_TGT_CROP: Final = 0
FIELD_NONE: Final = 1
"""V4L2_FIELD_NONE: progressive."""

BUS_CODES: Final = {
    "GREY": 0x2001,
    "Y10": 0x200A,
    "Y12": 0x2013,
    "Y14": 0x202D,
    "Y16": 0x202E,
    "SBGGR8": 0x3001,
    "SGBRG8": 0x3013,
    "SGRBG8": 0x3002,
    "SRGGB8": 0x3014,
    "SBGGR10": 0x3007,
    "SGBRG10": 0x300E,
    "SGRBG10": 0x300A,
    "SRGGB10": 0x300F,
    "SBGGR12": 0x3008,
    "SGBRG12": 0x3010,
    "SGRBG12": 0x3011,
    "SRGGB12": 0x3012,
    "SBGGR14": 0x3019,
    "SGBRG14": 0x301A,
    "SGRBG14": 0x301B,
    "SRGGB14": 0x301C,
    "SBGGR16": 0x301D,
    "SGBRG16": 0x301E,
    "SGRBG16": 0x301F,
    "SRGGB16": 0x3020,
}
"""Media bus codes of pixel formats, one sample a pixel: MEDIA_BUS_FMT_SBGGR10_1X10 of SBGGR10."""


def bus_code(pixel_format: str) -> int | None:
    """The media bus code of a pixel format.

    Args:
        pixel_format: name in V4L2.

    Returns:
        The code of one sample a pixel; None where there is none.

    Example:
        >>> hex(bus_code("SRGGB12P"))
        '0x3012'
    """
    return BUS_CODES.get(pixel_format.removesuffix("P").removesuffix("_BE"))


def bus_name(code: int) -> str:
    """Name a media bus code.

    Args:
        code: media bus code.

    Returns:
        The pixel format of V4L2, or the number.
    """
    return next((name for name, ours in BUS_CODES.items() if ours == code), f"0x{code:04x}")


class MediaEntity(ctypes.Structure):
    """struct media_v2_entity."""

    _fields_ = [
        ("id", ctypes.c_uint32),
        ("name", ctypes.c_char * 64),
        ("function", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 5),
    ]


class MediaInterface(ctypes.Structure):
    """struct media_v2_interface."""

    _fields_ = [
        ("id", ctypes.c_uint32),
        ("intf_type", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 9),
        ("raw", ctypes.c_uint32 * 16),
    ]
    """The first two of `raw` are major and minor number of the device node."""


class MediaPad(ctypes.Structure):
    """struct media_v2_pad."""

    _fields_ = [
        ("id", ctypes.c_uint32),
        ("entity_id", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("index", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 4),
    ]


class MediaLink(ctypes.Structure):
    """struct media_v2_link."""

    _fields_ = [
        ("id", ctypes.c_uint32),
        ("source_id", ctypes.c_uint32),
        ("sink_id", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 6),
    ]


class MediaTopology(ctypes.Structure):
    """struct media_v2_topology; the pointers are numbers of 64 bits."""

    _pack_ = 1
    _fields_ = [
        ("topology_version", ctypes.c_uint64),
        ("num_entities", ctypes.c_uint32),
        ("reserved1", ctypes.c_uint32),
        ("ptr_entities", ctypes.c_uint64),
        ("num_interfaces", ctypes.c_uint32),
        ("reserved2", ctypes.c_uint32),
        ("ptr_interfaces", ctypes.c_uint64),
        ("num_pads", ctypes.c_uint32),
        ("reserved3", ctypes.c_uint32),
        ("ptr_pads", ctypes.c_uint64),
        ("num_links", ctypes.c_uint32),
        ("reserved4", ctypes.c_uint32),
        ("ptr_links", ctypes.c_uint64),
    ]


class BusFormat(ctypes.Structure):
    """struct v4l2_mbus_framefmt."""

    _fields_ = [
        ("width", ctypes.c_uint32),
        ("height", ctypes.c_uint32),
        ("code", ctypes.c_uint32),
        ("field", ctypes.c_uint32),
        ("colorspace", ctypes.c_uint32),
        ("ycbcr_enc", ctypes.c_uint16),
        ("quantization", ctypes.c_uint16),
        ("xfer_func", ctypes.c_uint16),
        ("flags", ctypes.c_uint16),
        ("reserved", ctypes.c_uint16 * 10),
    ]


class SubDeviceFormat(ctypes.Structure):
    """struct v4l2_subdev_format."""

    _fields_ = [
        ("which", ctypes.c_uint32),
        ("pad", ctypes.c_uint32),
        ("format", BusFormat),
        ("reserved", ctypes.c_uint32 * 8),
    ]


class BusCodeDescription(ctypes.Structure):
    """struct v4l2_subdev_mbus_code_enum."""

    _fields_ = [
        ("pad", ctypes.c_uint32),
        ("index", ctypes.c_uint32),
        ("code", ctypes.c_uint32),
        ("which", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 7),
    ]


class SelectionRectangle(ctypes.Structure):
    """struct v4l2_rect."""

    _fields_ = [
        ("left", ctypes.c_int32),
        ("top", ctypes.c_int32),
        ("width", ctypes.c_uint32),
        ("height", ctypes.c_uint32),
    ]


class SubDeviceSelection(ctypes.Structure):
    """struct v4l2_subdev_selection."""

    _fields_ = [
        ("which", ctypes.c_uint32),
        ("pad", ctypes.c_uint32),
        ("target", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("r", SelectionRectangle),
        ("reserved", ctypes.c_uint32 * 8),
    ]


def _request(kind: str, number: int, argument: type[ctypes._CData]) -> int:
    """An ioctl request that reads and writes (asm-generic/ioctl.h)."""
    return 3 << 30 | ctypes.sizeof(argument) << 16 | ord(kind) << 8 | number


MEDIA_IOC_G_TOPOLOGY: Final = _request("|", 4, MediaTopology)
VIDIOC_SUBDEV_ENUM_MBUS_CODE: Final = _request("V", 2, BusCodeDescription)
VIDIOC_SUBDEV_G_FMT: Final = _request("V", 4, SubDeviceFormat)
VIDIOC_SUBDEV_S_FMT: Final = _request("V", 5, SubDeviceFormat)
VIDIOC_SUBDEV_G_SELECTION: Final = _request("V", 61, SubDeviceSelection)

"""The kernel's video capture API as it lies in memory: structures, constants, ioctl numbers.

Nothing is called here; that is in `drivers.cameras.v4l2.node`. A test holds every size, offset and
number against what a C compiler makes of linux/videodev2.h.

Source: linux/videodev2.h, linux/v4l2-controls.h, asm-generic/ioctl.h.
"""

from __future__ import annotations

import ctypes
from typing import Final

CAP_VIDEO_CAPTURE: Final = 0x0000_0001
CAP_VIDEO_CAPTURE_MPLANE: Final = 0x0000_1000
CAP_IO_MC: Final = 0x2000_0000
CAP_STREAMING: Final = 0x0400_0000
CAP_DEVICE_CAPS: Final = 0x8000_0000
BUF_TYPE_VIDEO_CAPTURE: Final = 1
BUF_TYPE_VIDEO_CAPTURE_MPLANE: Final = 9
MEMORY_MMAP: Final = 1
FIELD_NONE: Final = 1
VIDEO_MAX_PLANES: Final = 8

BUF_FLAG_ERROR: Final = 0x0000_0040
BUF_FLAG_TIMESTAMP_MASK: Final = 0x0000_E000
BUF_FLAG_TIMESTAMP_MONOTONIC: Final = 0x0000_2000
BUF_FLAG_TSTAMP_SRC_MASK: Final = 0x0007_0000
BUF_FLAG_TSTAMP_SRC_SOE: Final = 0x0001_0000

CTRL_FLAG_DISABLED: Final = 0x0001
CTRL_FLAG_WRITE_ONLY: Final = 0x0040
CTRL_FLAG_NEXT_CTRL: Final = 0x8000_0000
CTRL_TYPE_INTEGER: Final = 1
CTRL_TYPE_BOOLEAN: Final = 2
CTRL_TYPE_MENU: Final = 3
CTRL_TYPE_BUTTON: Final = 4
CTRL_TYPE_INTEGER64: Final = 5
CTRL_TYPE_BITMASK: Final = 8
CTRL_TYPE_INTEGER_MENU: Final = 9
CTRL_WHICH_CUR_VAL: Final = 0
CTRL_CLASS_USER: Final = 0x0098_0000
CTRL_CLASS_CAMERA: Final = 0x009A_0000
CTRL_CLASS_IMAGE_SOURCE: Final = 0x009E_0000
CTRL_CLASS_IMAGE_PROC: Final = 0x009F_0000
CID_AUTOGAIN: Final = 0x0098_0912
CID_GAIN: Final = 0x0098_0913
CID_EXPOSURE: Final = 0x0098_0911
CID_EXPOSURE_AUTO: Final = 0x009A_0901
CID_EXPOSURE_ABSOLUTE: Final = 0x009A_0902
CID_VBLANK: Final = 0x009E_0901
CID_HBLANK: Final = 0x009E_0902
CID_ANALOGUE_GAIN: Final = 0x009E_0903
CID_PIXEL_RATE: Final = 0x009F_0902
EXPOSURE_MANUAL: Final = 1


class Capability(ctypes.Structure):
    """struct v4l2_capability."""

    _fields_ = [
        ("driver", ctypes.c_char * 16),
        ("card", ctypes.c_char * 32),
        ("bus_info", ctypes.c_char * 32),
        ("version", ctypes.c_uint32),
        ("capabilities", ctypes.c_uint32),
        ("device_caps", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 3),
    ]


class FormatDescription(ctypes.Structure):
    """struct v4l2_fmtdesc."""

    _fields_ = [
        ("index", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("description", ctypes.c_char * 32),
        ("pixelformat", ctypes.c_uint32),
        ("mbus_code", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 3),
    ]


class PixFormat(ctypes.Structure):
    """struct v4l2_pix_format."""

    _fields_ = [
        ("width", ctypes.c_uint32),
        ("height", ctypes.c_uint32),
        ("pixelformat", ctypes.c_uint32),
        ("field", ctypes.c_uint32),
        ("bytesperline", ctypes.c_uint32),
        ("sizeimage", ctypes.c_uint32),
        ("colorspace", ctypes.c_uint32),
        ("priv", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("ycbcr_enc", ctypes.c_uint32),
        ("quantization", ctypes.c_uint32),
        ("xfer_func", ctypes.c_uint32),
    ]


class PlanePixFormat(ctypes.Structure):
    """struct v4l2_plane_pix_format."""

    _pack_ = 1
    _fields_ = [
        ("sizeimage", ctypes.c_uint32),
        ("bytesperline", ctypes.c_uint32),
        ("reserved", ctypes.c_uint16 * 6),
    ]


class PixFormatMplane(ctypes.Structure):
    """struct v4l2_pix_format_mplane."""

    _pack_ = 1
    _fields_ = [
        ("width", ctypes.c_uint32),
        ("height", ctypes.c_uint32),
        ("pixelformat", ctypes.c_uint32),
        ("field", ctypes.c_uint32),
        ("colorspace", ctypes.c_uint32),
        ("plane_fmt", PlanePixFormat * VIDEO_MAX_PLANES),
        ("num_planes", ctypes.c_uint8),
        ("flags", ctypes.c_uint8),
        ("ycbcr_enc", ctypes.c_uint8),
        ("quantization", ctypes.c_uint8),
        ("xfer_func", ctypes.c_uint8),
        ("reserved", ctypes.c_uint8 * 7),
    ]


class _FormatUnion(ctypes.Union):
    # A member of the real union holds a pointer, so it is aligned as one.
    _fields_ = [
        ("pix", PixFormat),
        ("pix_mp", PixFormatMplane),
        ("raw_data", ctypes.c_uint8 * 200),
        ("_alignment", ctypes.c_void_p),
    ]


class Format(ctypes.Structure):
    """struct v4l2_format."""

    _fields_ = [("type", ctypes.c_uint32), ("fmt", _FormatUnion)]


class RequestBuffers(ctypes.Structure):
    """struct v4l2_requestbuffers."""

    _fields_ = [
        ("count", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("memory", ctypes.c_uint32),
        ("capabilities", ctypes.c_uint32),
        ("flags", ctypes.c_uint8),
        ("reserved", ctypes.c_uint8 * 3),
    ]


class TimeVal(ctypes.Structure):
    """struct timeval."""

    _fields_ = [("tv_sec", ctypes.c_long), ("tv_usec", ctypes.c_long)]


class TimeCode(ctypes.Structure):
    """struct v4l2_timecode."""

    _fields_ = [
        ("type", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("frames", ctypes.c_uint8),
        ("seconds", ctypes.c_uint8),
        ("minutes", ctypes.c_uint8),
        ("hours", ctypes.c_uint8),
        ("userbits", ctypes.c_uint8 * 4),
    ]


class _PlaneMemory(ctypes.Union):
    _fields_ = [
        ("mem_offset", ctypes.c_uint32),
        ("userptr", ctypes.c_ulong),
        ("fd", ctypes.c_int32),
    ]


class BufferPlane(ctypes.Structure):
    """struct v4l2_plane."""

    _fields_ = [
        ("bytesused", ctypes.c_uint32),
        ("length", ctypes.c_uint32),
        ("m", _PlaneMemory),
        ("data_offset", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 11),
    ]


class _BufferMemory(ctypes.Union):
    _fields_ = [
        ("offset", ctypes.c_uint32),
        ("userptr", ctypes.c_ulong),
        ("planes", ctypes.POINTER(BufferPlane)),
        ("fd", ctypes.c_int32),
    ]


class Buffer(ctypes.Structure):
    """struct v4l2_buffer."""

    _fields_ = [
        ("index", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("bytesused", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("field", ctypes.c_uint32),
        ("timestamp", TimeVal),
        ("timecode", TimeCode),
        ("sequence", ctypes.c_uint32),
        ("memory", ctypes.c_uint32),
        ("m", _BufferMemory),
        ("length", ctypes.c_uint32),
        ("reserved2", ctypes.c_uint32),
        ("request_fd", ctypes.c_int32),
    ]


class Fract(ctypes.Structure):
    """struct v4l2_fract."""

    _fields_ = [("numerator", ctypes.c_uint32), ("denominator", ctypes.c_uint32)]


class CaptureParm(ctypes.Structure):
    """struct v4l2_captureparm."""

    _fields_ = [
        ("capability", ctypes.c_uint32),
        ("capturemode", ctypes.c_uint32),
        ("timeperframe", Fract),
        ("extendedmode", ctypes.c_uint32),
        ("readbuffers", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 4),
    ]


class _ParmUnion(ctypes.Union):
    _fields_ = [("capture", CaptureParm), ("raw_data", ctypes.c_uint8 * 200)]


class StreamParm(ctypes.Structure):
    """struct v4l2_streamparm."""

    _fields_ = [("type", ctypes.c_uint32), ("parm", _ParmUnion)]


class QueryExtCtrl(ctypes.Structure):
    """struct v4l2_query_ext_ctrl."""

    _fields_ = [
        ("id", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("name", ctypes.c_char * 32),
        ("minimum", ctypes.c_int64),
        ("maximum", ctypes.c_int64),
        ("step", ctypes.c_uint64),
        ("default_value", ctypes.c_int64),
        ("flags", ctypes.c_uint32),
        ("elem_size", ctypes.c_uint32),
        ("elems", ctypes.c_uint32),
        ("nr_of_dims", ctypes.c_uint32),
        ("dims", ctypes.c_uint32 * 4),
        ("reserved", ctypes.c_uint32 * 32),
    ]


class _ControlValue(ctypes.Union):
    _pack_ = 1
    _fields_ = [
        ("value", ctypes.c_int32),
        ("value64", ctypes.c_int64),
        ("ptr", ctypes.c_void_p),
    ]


class ExtControl(ctypes.Structure):
    """struct v4l2_ext_control."""

    _pack_ = 1
    _fields_ = [
        ("id", ctypes.c_uint32),
        ("size", ctypes.c_uint32),
        ("reserved2", ctypes.c_uint32 * 1),
        ("u", _ControlValue),
    ]


class ExtControls(ctypes.Structure):
    """struct v4l2_ext_controls."""

    _fields_ = [
        ("which", ctypes.c_uint32),
        ("count", ctypes.c_uint32),
        ("error_idx", ctypes.c_uint32),
        ("request_fd", ctypes.c_int32),
        ("reserved", ctypes.c_uint32 * 1),
        ("controls", ctypes.POINTER(ExtControl)),
    ]


def _request(direction: int, number: int, argument: type[ctypes._CData]) -> int:
    """An ioctl request of type 'V' (asm-generic/ioctl.h)."""
    return direction << 30 | ctypes.sizeof(argument) << 16 | ord("V") << 8 | number


_WRITE: Final = 1
_READ: Final = 2
QUERYCAP: Final = _request(_READ, 0, Capability)
ENUM_FMT: Final = _request(_READ | _WRITE, 2, FormatDescription)
G_FMT: Final = _request(_READ | _WRITE, 4, Format)
S_FMT: Final = _request(_READ | _WRITE, 5, Format)
REQBUFS: Final = _request(_READ | _WRITE, 8, RequestBuffers)
QUERYBUF: Final = _request(_READ | _WRITE, 9, Buffer)
QBUF: Final = _request(_READ | _WRITE, 15, Buffer)
DQBUF: Final = _request(_READ | _WRITE, 17, Buffer)
STREAMON: Final = _request(_WRITE, 18, ctypes.c_int)
STREAMOFF: Final = _request(_WRITE, 19, ctypes.c_int)
G_PARM: Final = _request(_READ | _WRITE, 21, StreamParm)
S_PARM: Final = _request(_READ | _WRITE, 22, StreamParm)
S_INPUT: Final = _request(_READ | _WRITE, 39, ctypes.c_int)
G_EXT_CTRLS: Final = _request(_READ | _WRITE, 71, ExtControls)
S_EXT_CTRLS: Final = _request(_READ | _WRITE, 72, ExtControls)
QUERY_EXT_CTRL: Final = _request(_READ | _WRITE, 103, QueryExtCtrl)


def fourcc(code: str) -> int:
    """A pixel format's four characters as the kernel's number.

    Args:
        code: up to four characters, padded with blanks; "-BE" at the end sets the flag of
            big-endian formats, as the kernel's own tools write it.

    Returns:
        The number, 32 bits.

    Source: Linux, include/uapi/linux/videodev2.h, v4l2_fourcc and v4l2_fourcc_be.
    """
    big_endian = code.endswith("-BE")
    number = int.from_bytes(code.removesuffix("-BE").ljust(4).encode("ascii"), "little")
    return number | (1 << 31 if big_endian else 0)


def fourcc_name(number: int) -> str:
    """The four characters of a pixel format's number.

    Args:
        number: 32 bits.

    Returns:
        The characters without blanks at the end, with "-BE" for big-endian formats.
    """
    text = (number & 0x7FFF_FFFF).to_bytes(4, "little").decode("ascii", errors="replace")
    return text.rstrip() + ("-BE" if number & 1 << 31 else "")

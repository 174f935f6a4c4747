"""The binding of the kernel's video API against what a C compiler makes of linux/videodev2.h."""

from __future__ import annotations

import ctypes
import json
import shutil
import subprocess
from pathlib import Path

import pytest

from drivers.cameras.v4l2 import media_uapi, uapi
from drivers.cameras.v4l2.formats import FORMATS

STRUCTURES = {
    "v4l2_capability": uapi.Capability,
    "v4l2_fmtdesc": uapi.FormatDescription,
    "v4l2_pix_format": uapi.PixFormat,
    "v4l2_plane_pix_format": uapi.PlanePixFormat,
    "v4l2_pix_format_mplane": uapi.PixFormatMplane,
    "v4l2_format": uapi.Format,
    "v4l2_requestbuffers": uapi.RequestBuffers,
    "v4l2_timecode": uapi.TimeCode,
    "v4l2_plane": uapi.BufferPlane,
    "v4l2_buffer": uapi.Buffer,
    "v4l2_fract": uapi.Fract,
    "v4l2_captureparm": uapi.CaptureParm,
    "v4l2_streamparm": uapi.StreamParm,
    "v4l2_query_ext_ctrl": uapi.QueryExtCtrl,
    "v4l2_ext_control": uapi.ExtControl,
    "v4l2_ext_controls": uapi.ExtControls,
    "media_v2_entity": media_uapi.MediaEntity,
    "media_v2_interface": media_uapi.MediaInterface,
    "media_v2_pad": media_uapi.MediaPad,
    "media_v2_link": media_uapi.MediaLink,
    "media_v2_topology": media_uapi.MediaTopology,
    "v4l2_mbus_framefmt": media_uapi.BusFormat,
    "v4l2_subdev_format": media_uapi.SubDeviceFormat,
    "v4l2_subdev_mbus_code_enum": media_uapi.BusCodeDescription,
    "v4l2_rect": media_uapi.SelectionRectangle,
    "v4l2_subdev_selection": media_uapi.SubDeviceSelection,
}
NAMED_OTHERWISE = {("v4l2_ext_control", "u"): "value", ("media_v2_interface", "raw"): "devnode"}
"""Members of unions that have no name in C, by one that has."""
REQUESTS = (
    *("QUERYCAP", "ENUM_FMT", "G_FMT", "S_FMT", "REQBUFS", "QUERYBUF", "QBUF", "DQBUF"),
    *("STREAMON", "STREAMOFF", "G_PARM", "S_PARM", "S_INPUT"),
    *("G_EXT_CTRLS", "S_EXT_CTRLS", "QUERY_EXT_CTRL"),
)
MEDIA_REQUESTS = (
    *("MEDIA_IOC_G_TOPOLOGY", "VIDIOC_SUBDEV_ENUM_MBUS_CODE", "VIDIOC_SUBDEV_G_FMT"),
    *("VIDIOC_SUBDEV_S_FMT", "VIDIOC_SUBDEV_G_SELECTION"),
)
MEDIA_CONSTANTS = {
    "MEDIA_ENT_F_CAM_SENSOR": media_uapi.ENT_F_CAM_SENSOR,
    "MEDIA_LNK_FL_ENABLED": media_uapi.LNK_FL_ENABLED,
    "MEDIA_LNK_FL_LINK_TYPE": media_uapi.LNK_FL_LINK_TYPE,
    "MEDIA_LNK_FL_DATA_LINK": media_uapi.LNK_FL_DATA_LINK,
    "MEDIA_LNK_FL_INTERFACE_LINK": media_uapi.LNK_FL_INTERFACE_LINK,
    "V4L2_SUBDEV_FORMAT_ACTIVE": media_uapi.SUBDEV_FORMAT_ACTIVE,
    "V4L2_SEL_TGT_CROP": media_uapi.SEL_TGT_CROP,
    "V4L2_FIELD_NONE": media_uapi.FIELD_NONE,
}
LATER_FORMATS = {"Y12P": "Y12P", "Y14P": "Y14P"}
"""Formats that a header of kernel 6.1 does not have, with their four characters in later ones."""
CONSTANTS = [name for name in vars(uapi) if name.startswith(("CAP_", "BUF_", "CTRL_", "CID_"))]


def _bus_macro(name: str) -> str:
    if name == "GREY":
        return "MEDIA_BUS_FMT_Y8_1X8"
    bits = "".join(c for c in name if c.isdigit())
    return f"MEDIA_BUS_FMT_{name}_1X{bits}"


@pytest.fixture(scope="module")
def header(tmp_path_factory: pytest.TempPathFactory) -> dict[str, int]:
    """Every size, offset and number as the compiler sees it."""
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("needs gcc (Debian packages gcc, libc6-dev)")
    if not Path("/usr/include/linux/videodev2.h").exists():
        pytest.skip("needs linux/videodev2.h (Debian package linux-libc-dev)")
    definitions = {
        **{f"sizeof {name}": f"sizeof(struct {name})" for name in STRUCTURES},
        **{
            f"{name}.{field}": f"offsetof(struct {name}, "
            f"{NAMED_OTHERWISE.get((name, field), field)})"
            for name, structure in STRUCTURES.items()
            for field, *_ in structure._fields_
        },
        **{name: f"VIDIOC_{name}" for name in REQUESTS},
        **{name: f"V4L2_{name}" for name in CONSTANTS},
        **{f"format {name}": f"V4L2_PIX_FMT_{name}" for name in FORMATS},
        **{name: name for name in (*MEDIA_REQUESTS, *MEDIA_CONSTANTS)},
        **{f"bus {name}": _bus_macro(name) for name in media_uapi.BUS_CODES},
        "MEMORY_MMAP": "V4L2_MEMORY_MMAP",
        "FIELD_NONE": "V4L2_FIELD_NONE",
        "EXPOSURE_MANUAL": "V4L2_EXPOSURE_MANUAL",
        "VIDEO_MAX_PLANES": "VIDEO_MAX_PLANES",
    }
    lines = [
        f'printf("%s\\"{key}\\": %lld\\n", c, (long long)({c})); c = ",";'
        for key, c in definitions.items()
    ]
    later = "\n".join(
        f"#ifndef V4L2_PIX_FMT_{name}\n#define V4L2_PIX_FMT_{name} "
        f"v4l2_fourcc({', '.join(map(repr, code))})\n#endif"
        for name, code in LATER_FORMATS.items()
    )
    later += "\n#ifndef MEDIA_BUS_FMT_Y16_1X16\n#define MEDIA_BUS_FMT_Y16_1X16 0x202e\n#endif"
    folder = tmp_path_factory.mktemp("layout")
    source = folder / "layout.c"
    source.write_text(
        "#include <stddef.h>\n#include <stdio.h>\n#include <linux/videodev2.h>\n"
        "#include <linux/media.h>\n#include <linux/v4l2-subdev.h>\n" + later + "\n"
        'int main(void) { const char *c = ""; puts("{");\n' + "\n".join(lines) + '\nputs("}"); }\n'
    )
    subprocess.run([compiler, "-o", folder / "layout", source], timeout=60, check=True)
    completed = subprocess.run([folder / "layout"], capture_output=True, timeout=10, check=True)
    found: dict[str, int] = json.loads(completed.stdout)
    return found


@pytest.mark.parametrize("name", STRUCTURES)
def test_a_structure_lies_in_memory_as_the_kernels_does(name: str, header: dict[str, int]) -> None:
    structure = STRUCTURES[name]
    ours = {f"{name}.{field}": getattr(structure, field).offset for field, *_ in structure._fields_}
    assert ours == {key: header[key] for key in ours}
    assert ctypes.sizeof(structure) == header[f"sizeof {name}"]


def test_every_ioctl_number_is_the_kernels(header: dict[str, int]) -> None:
    assert {name: getattr(uapi, name) for name in REQUESTS} == {
        name: header[name] & 0xFFFF_FFFF for name in REQUESTS
    }


def test_every_constant_is_the_kernels(header: dict[str, int]) -> None:
    names = [*CONSTANTS, "MEMORY_MMAP", "FIELD_NONE", "EXPOSURE_MANUAL", "VIDEO_MAX_PLANES"]
    assert len(names) > 35
    ours = {name: getattr(uapi, name) for name in names}
    assert ours == {name: header[name] & 0xFFFF_FFFF for name in names}


def test_every_pixel_format_has_the_kernels_code(header: dict[str, int]) -> None:
    assert {name: form.code for name, form in FORMATS.items()} == {
        name: header[f"format {name}"] & 0xFFFF_FFFF for name in FORMATS
    }


def test_media_ioctls_constants_and_bus_codes_are_the_kernels(header: dict[str, int]) -> None:
    assert {name: getattr(media_uapi, name) for name in MEDIA_REQUESTS} == {
        name: header[name] & 0xFFFF_FFFF for name in MEDIA_REQUESTS
    }
    assert {name: header[name] & 0xFFFF_FFFF for name in MEDIA_CONSTANTS} == MEDIA_CONSTANTS
    assert {name: header[f"bus {name}"] for name in media_uapi.BUS_CODES} == media_uapi.BUS_CODES

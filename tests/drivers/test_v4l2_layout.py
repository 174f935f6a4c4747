"""The binding of the kernel's video API against what a C compiler makes of linux/videodev2.h."""

from __future__ import annotations

import ctypes
import json
import shutil
import subprocess
from pathlib import Path

import pytest

from drivers.cameras.v4l2 import uapi
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
}
NAMED_OTHERWISE = {("v4l2_ext_control", "u"): "value"}
"""Members of unions that have no name in C, by one that has."""
REQUESTS = (
    *("QUERYCAP", "ENUM_FMT", "G_FMT", "S_FMT", "REQBUFS", "QUERYBUF", "QBUF", "DQBUF"),
    *("STREAMON", "STREAMOFF", "G_PARM", "S_PARM", "S_INPUT"),
    *("G_EXT_CTRLS", "S_EXT_CTRLS", "QUERY_EXT_CTRL"),
)
CONSTANTS = [name for name in vars(uapi) if name.startswith(("CAP_", "BUF_", "CTRL_", "CID_"))]


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
        "MEMORY_MMAP": "V4L2_MEMORY_MMAP",
        "FIELD_NONE": "V4L2_FIELD_NONE",
        "EXPOSURE_MANUAL": "V4L2_EXPOSURE_MANUAL",
        "VIDEO_MAX_PLANES": "VIDEO_MAX_PLANES",
    }
    lines = [
        f'printf("%s\\"{key}\\": %lld\\n", c, (long long)({c})); c = ",";'
        for key, c in definitions.items()
    ]
    folder = tmp_path_factory.mktemp("layout")
    source = folder / "layout.c"
    source.write_text(
        "#include <stddef.h>\n#include <stdio.h>\n#include <linux/videodev2.h>\n"
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

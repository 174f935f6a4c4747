"""A sensor on a sub-device before its video node: the kernel's vimc driver, set up by the head.

media-ctl and v4l2-ctl, which we did not write, read the pipeline and the pixels.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.cameras.v4l2.media import MediaGraph, read_graph
from drivers.cameras.v4l2.v4l2_head import V4l2Head
from drivers.contract import DeviceError, FrameStatus
from tests.installed.kernel import vivid

WIDTH_PX, HEIGHT_PX = 320, 240
SIDE_LINK = '"Debayer A":1 -> "Scaler":0'
STEADY = ["show_information=2", "test_pattern=20"]
"""A picture that does not change from frame to frame."""


@pytest.fixture(scope="module", autouse=True)
def sensor() -> Iterator[None]:
    vivid.unload()
    subprocess.run(["insmod", vivid.GUEST / "modules/vimc.ko"], timeout=60, check=True)
    # The kernel compares the formats of every enabled link, also of those after the debayer.
    media_ctl("-l", f"{SIDE_LINK} [0]")
    yield
    subprocess.run(["rmmod", "vimc"], timeout=60, check=True)


def graph() -> MediaGraph:
    return read_graph("/dev/media0")


def node_of(name: str) -> str:
    return next(each.path for each in graph().entities.values() if each.name == name)


def flight(**more: object) -> vivid.Flight:
    section = {
        "device": node_of("Raw Capture 0"),
        "width_px": WIDTH_PX,
        "height_px": HEIGHT_PX,
        "pixel_format": "SBGGR12",
        "exposure_control": "none",
        "controls": STEADY,
    }
    return vivid.Flight(**{**section, **more})


def media_ctl(*arguments: str) -> str:
    done = subprocess.run(
        ["media-ctl", *arguments], capture_output=True, text=True, timeout=60, check=True
    )
    return done.stdout


@pytest.mark.parametrize("name", ["SBGGR8", "SGRBG10", "SBGGR12"])
def test_frames_of_a_sensor_are_those_that_another_program_receives(
    name: str, tmp_path: Path
) -> None:
    with flight(pixel_format=name) as head:
        head.wait_frames(3)
    path = tmp_path / "frame.raw"
    subprocess.run(
        [
            *("v4l2-ctl", "-d", node_of("Raw Capture 0")),
            *("--stream-mmap", "--stream-count=1", f"--stream-to={path}"),
        ],
        capture_output=True,
        timeout=60,
        check=True,
    )
    wire = np.uint8 if name == "SBGGR8" else np.dtype("<u2")
    expected = np.fromfile(path, wire).reshape(HEIGHT_PX, WIDTH_PX)
    assert {frame.status for frame in head.frames} == {FrameStatus.COMPLETE}
    assert len(np.unique(expected)) > 3, "the pattern is a ramp"
    np.testing.assert_array_equal(head.pictures[-1], expected)
    assert head.frames[-1].settings["test_pattern"] == 20, "a control of the sub-device"
    code = f"{name}_1X{re.sub('[^0-9]', '', name)}"
    assert f"fmt:{code}/{WIDTH_PX}x{HEIGHT_PX}" in media_ctl("-p")


def test_the_graph_is_that_of_media_ctl() -> None:
    printed = media_ctl("-p")
    found = graph()
    assert sorted(each.name for each in found.entities.values()) == sorted(
        re.findall(r"^- entity \d+: (.*?) \(\d+ pad", printed, re.MULTILINE)
    )
    assert len(found.links) == len(re.findall(r"^\s+-> ", printed, re.MULTILINE))
    enabled = re.findall(r"^\s+-> .*ENABLED", printed, re.MULTILINE)
    assert sum(link.is_enabled for link in found.links) == len(enabled)


def test_a_pipeline_that_another_program_changed_is_lost_and_set_again() -> None:
    with_head = flight()
    with_head.head.bind()
    media_ctl("-V", '"Sensor A":0[fmt:SBGGR8_1X8/640x480]')
    with with_head as head:
        head.wait_event("lost")
        head.wait_frames(2)
    lost = next(event for event in head.events if event.name == "lost")
    assert "formats along its media pipeline differ" in lost.sentence
    assert head.frames[-1].pixel_format == "SBGGR12"


def test_formats_that_the_sensor_does_not_send_are_refused_with_those_it_sends() -> None:
    with pytest.raises(DeviceError, match=r"the sensor Sensor A sends .*SBGGR12.*SRGGB12") as found:
        flight(pixel_format="Y16").head.bind()
    assert "order of colours" in str(found.value)
    with pytest.raises(DeviceError, match=r"frame_interval_s is 0\.1; the sensor does not report"):
        flight(frame_interval_s=0.1).head.bind()


def test_a_node_without_our_formats_is_not_taken() -> None:
    head = V4l2Head(
        "SU00",
        {"device": node_of("RGB/YUV Capture"), "exposure_control": "none"},
        memory=vivid.Memory(WIDTH_PX * HEIGHT_PX * 2, 2),
    )
    media_ctl("-l", f"{SIDE_LINK} [1]")
    try:
        with pytest.raises(DeviceError, match="pixel_format is 'Y12'"):
            head.bind()
    finally:
        media_ctl("-l", f"{SIDE_LINK} [0]")
    assert vivid.descriptors() == set()


def test_a_disabled_link_is_refused_with_the_command_that_enables_it() -> None:
    with pytest.raises(DeviceError) as refused:
        flight(device=node_of("RGB/YUV Capture")).head.bind()
    command = str(refused.value).rpartition("run ")[2]
    assert command.startswith("media-ctl -d /dev/media0 -l '")
    assert '-> "Scaler":0 [1]' in command

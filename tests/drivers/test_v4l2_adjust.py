"""A V4L2 head's exposure time and gain are changed while it runs, or the reason is reported."""

from __future__ import annotations

from typing import Any, cast

import pytest

from drivers.cameras.v4l2 import uapi
from drivers.cameras.v4l2.camera import V4l2Camera
from drivers.cameras.v4l2.control import Control
from drivers.cameras.v4l2.node import VideoNode
from drivers.cameras.v4l2.settings import V4l2Settings
from drivers.contract import DeviceError

INTEGER = 1
EXPOSURE = Control(uapi.CID_EXPOSURE_ABSOLUTE, "exposure_time_absolute", INTEGER, 1, 400, 0)
GAIN = Control(uapi.CID_GAIN, "gain", INTEGER, 0, 100, 0)


class Node:
    """The controls of a head, that may refuse one."""

    def __init__(self, values: dict[str, int], refuses: str = "") -> None:
        self.values = values
        self.refuses = refuses

    def queried(self, control: Control) -> Control:
        return control

    def read(self, control: Control) -> int:
        return self.values[control.name]

    def write(self, control: Control, value: int) -> None:
        if control.name == self.refuses and value > 30:
            raise OSError(22, "Invalid argument")
        self.values[control.name] = value


def camera(node: Node, *, exposure: Control | None = EXPOSURE, **settings: Any) -> V4l2Camera:
    """One that was opened with the values of its node."""
    v4l2_camera = V4l2Camera.__new__(V4l2Camera)
    v4l2_camera._settings = V4l2Settings("cam", {"device": "/dev/video0", **settings})
    v4l2_camera._who = "cam at /dev/video0"
    v4l2_camera.node = cast(VideoNode, node)
    v4l2_camera.controls = {c.name: c for c in (EXPOSURE, GAIN)}
    v4l2_camera._exposure, v4l2_camera._exposure_unit_us = exposure, 100.0
    v4l2_camera._gain_control, v4l2_camera._gain_at_0_db = (
        v4l2_camera._find_gain(),
        node.values["gain"],
    )
    return v4l2_camera


def test_exposure_time_and_gain_are_written_in_the_units_of_the_head() -> None:
    node = Node({"exposure_time_absolute": 50, "gain": 10})
    head = camera(node, gain_unit_db=0.3)
    head.adjust(2040.0, 6.0)
    assert node.values == {"exposure_time_absolute": 20, "gain": 30}
    assert head.gain_db == pytest.approx(6.0)
    head.adjust(4000.0, 0.0)
    assert node.values == {"exposure_time_absolute": 40, "gain": 10}


def test_what_the_head_refuses_leaves_it_as_it_was() -> None:
    node = Node({"exposure_time_absolute": 50, "gain": 10}, refuses="gain")
    with pytest.raises(DeviceError, match="gain_db: gain = 40 is refused"):
        camera(node, gain_unit_db=0.3).adjust(1000.0, 9.0)
    assert node.values == {"exposure_time_absolute": 50, "gain": 10}
    with pytest.raises(DeviceError, match="takes 1 to 400"):
        camera(node).adjust(60_000.0, 0.0)
    assert node.values["exposure_time_absolute"] == 50


def test_a_head_without_control_or_unit_states_what_to_set() -> None:
    node = Node({"exposure_time_absolute": 50, "gain": 10})
    with pytest.raises(DeviceError, match="no control of its exposure time"):
        camera(node, exposure=None).adjust(1000.0, 0.0)
    with pytest.raises(DeviceError, match="set gain_unit_db"):
        camera(node).adjust(1000.0, 3.0)
    assert node.values == {"exposure_time_absolute": 50, "gain": 10}

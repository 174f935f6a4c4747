"""The way from a sensor to a video node, exposure in lines of a sub-device, kernel parameters."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest

from drivers import DriverError
from drivers.cameras.v4l2 import media_uapi, uapi
from drivers.cameras.v4l2.camera import V4l2Camera
from drivers.cameras.v4l2.control import Control
from drivers.cameras.v4l2.media import Entity, MediaGraph, PadLink
from drivers.cameras.v4l2.module_parameters import wrong_parameters
from drivers.cameras.v4l2.node import FrameLayout, VideoNode
from drivers.cameras.v4l2.pipeline import PadFormat, SensorPipeline, SubDevice, route_of
from drivers.cameras.v4l2.settings import V4l2Settings
from drivers.contract import DeviceError

SENSOR, RECEIVER, VIDEO, PROCESSOR, OUTPUT = 1, 2, 3, 4, 5
RASPBERRY = {
    SENSOR: Entity(SENSOR, "imx296 10-001a", media_uapi.ENT_F_CAM_SENSOR, "/dev/v4l-subdev2"),
    RECEIVER: Entity(RECEIVER, "csi2", 0x0002_0000, "/dev/v4l-subdev0"),
    VIDEO: Entity(VIDEO, "rp1-cfe-csi2_ch0", 0x0001_0001, "/dev/video0"),
    PROCESSOR: Entity(PROCESSOR, "pispbe", 0x0002_0000, ""),
    OUTPUT: Entity(OUTPUT, "pispbe-output0", 0x0001_0001, "/dev/video20"),
}
"""Parts of a Raspberry Pi 5 as media-ctl -p names them; both devices in one graph."""


def raspberry(*, is_enabled: bool = True) -> MediaGraph:
    links = (
        PadLink((SENSOR, 0), (RECEIVER, 0), is_enabled=True),
        PadLink((RECEIVER, 4), (VIDEO, 0), is_enabled),
        PadLink((PROCESSOR, 3), (OUTPUT, 0), is_enabled=True),
    )
    return MediaGraph("/dev/media0", RASPBERRY, links)


def test_the_route_begins_at_the_sensor() -> None:
    route = route_of(raspberry(), RASPBERRY[VIDEO])
    assert [(link.source, link.sink) for link in route] == [((1, 0), (2, 0)), ((2, 4), (3, 0))]


def test_a_disabled_link_is_refused_with_the_command_that_enables_it() -> None:
    with pytest.raises(DeviceError) as refused:
        route_of(raspberry(is_enabled=False), RASPBERRY[VIDEO])
    command = """media-ctl -d /dev/media0 -l '"csi2":4 -> "rp1-cfe-csi2_ch0":0 [1]'"""
    assert str(refused.value).endswith(command)


def test_an_output_of_an_image_processor_is_refused_as_one_of_libcamera() -> None:
    with pytest.raises(DeviceError, match="which streams only through libcamera"):
        route_of(raspberry(), RASPBERRY[OUTPUT])


def test_a_graph_whose_links_go_round_ends() -> None:
    links = (PadLink((2, 0), (4, 0), is_enabled=True), PadLink((4, 1), (2, 1), is_enabled=True))
    graph = MediaGraph("/dev/media0", RASPBERRY, links)
    assert graph.route_to(RASPBERRY[PROCESSOR]) == ()


class Pads:
    """A sub-device that takes what it is given, unless it insists on a format."""

    def __init__(self, formats: list[str], *, insists: PadFormat | None = None) -> None:
        self._codes = [media_uapi.BUS_CODES[name] for name in formats]
        self._insists = insists
        self.set: dict[int, PadFormat] = {0: PadFormat(1456, 1088, self._codes[0])}
        self.crop: tuple[int, int] | None = None

    def codes(self, pad: int) -> list[int]:
        return self._codes

    def pad_format(self, pad: int) -> PadFormat:
        return self.set[pad]

    def set_pad_format(self, pad: int, wanted: PadFormat) -> PadFormat:
        self.set[pad] = self._insists or wanted
        return self.set[pad]

    def crop_px(self, pad: int) -> tuple[int, int] | None:
        return self.crop


def pipeline(sensor: Pads, receiver: Pads) -> SensorPipeline:
    found = SensorPipeline.__new__(SensorPipeline)
    found._graph = raspberry()
    found._route = route_of(found._graph, RASPBERRY[VIDEO])
    found.parts = {SENSOR: cast(SubDevice, sensor), RECEIVER: cast(SubDevice, receiver)}
    found.sensor, found._sensor_pad = found.parts[SENSOR], 0
    found.sensor_name = "imx296 10-001a"
    return found


def test_every_pad_on_the_way_gets_the_sensors_format() -> None:
    sensor, receiver = Pads(["SRGGB10", "SRGGB12"]), Pads(["SRGGB12"])
    assert pipeline(sensor, receiver).configure(640, 480, "SRGGB12P") == []
    wanted = PadFormat(640, 480, 0x3012)
    assert sensor.set == {0: wanted}
    assert receiver.set == {0: wanted, 4: wanted}


def test_a_part_that_keeps_another_size_is_refused_with_it() -> None:
    other = PadFormat(320, 240, 0x3012)
    refusals = pipeline(Pads(["SRGGB12"]), Pads(["SRGGB12"], insists=other)).configure(
        0, 0, "SRGGB12"
    )
    assert refusals == [
        "pad 0 of csi2 gives 320 x 240 SRGGB12 where 1456 x 1088 SRGGB12 is configured"
    ]


def test_another_order_of_colours_is_refused() -> None:
    (refusal,) = pipeline(Pads(["SBGGR10"]), Pads(["SBGGR10"])).configure(0, 0, "SRGGB10")
    assert refusal.startswith("pixel_format is 'SRGGB10'; the sensor imx296 10-001a sends SBGGR10")


LINE_TIME_US = (1456 + 344) / 90e6 * 1e6
MARGIN = 9


class Sensor:
    """Controls of a sensor whose longest exposure follows from its blank lines."""

    def __init__(self) -> None:
        self.values = {"exposure": 100, "vertical_blanking": 30, "analogue_gain": 0}
        self.values |= {"horizontal_blanking": 344, "pixel_rate": 90_000_000}
        self.written: list[tuple[str, int]] = []

    def controls(self) -> dict[str, Control]:
        found = (
            Control(uapi.CID_EXPOSURE, "exposure", 1, 1, 1088 + 30 - MARGIN, 0),
            Control(uapi.CID_VBLANK, "vertical_blanking", 1, 30, 100_000, 0),
            Control(uapi.CID_ANALOGUE_GAIN, "analogue_gain", 1, 0, 480, 0),
            Control(uapi.CID_HBLANK, "horizontal_blanking", 1, 344, 344, 0),
            Control(uapi.CID_PIXEL_RATE, "pixel_rate", 5, 1, 90_000_000, 0),
        )
        return {control.name: control for control in found}

    def queried(self, control: Control) -> Control:
        if control.name != "exposure":
            return control
        maximum = 1088 + self.values["vertical_blanking"] - MARGIN
        return Control(uapi.CID_EXPOSURE, "exposure", 1, 1, maximum, 0)

    def read(self, control: Control) -> int:
        return self.values[control.name]

    def write(self, control: Control, value: int) -> None:
        self.written.append((control.name, value))
        self.values[control.name] = value


def camera(sensor: Sensor, *, crop: tuple[int, int] | None = None, **settings: Any) -> V4l2Camera:
    found = V4l2Camera.__new__(V4l2Camera)
    found._settings = V4l2Settings("cam", {"device": "/dev/video0", **settings})
    found._who = "cam at /dev/video0"
    found.node = cast(VideoNode, sensor)
    found.layout = FrameLayout(1456, 1088, 0, 0, 0)
    pads = Pads(["SRGGB10"])
    pads.crop = crop
    found._pipeline = pipeline(pads, Pads(["SRGGB10"]))
    found.controls = sensor.controls()
    refusals: list[str] = []
    if found._settings.frame_interval_s:
        found._write_interval(refusals)
    found._find_exposure(refusals)
    if not refusals:
        found._write_controls(refusals)
    found._gain_control, found._gain_at_0_db = found._find_gain(), 0
    if refusals:
        raise DeviceError("\n".join(refusals))
    return found


def test_an_exposure_time_becomes_lines_of_the_sensor() -> None:
    sensor = Sensor()
    camera(sensor, exposure_time_us=1000.0, gain=100)
    assert sensor.written == [("exposure", 50), ("analogue_gain", 100)]


def test_a_long_exposure_first_gets_the_blank_lines_it_needs() -> None:
    sensor = Sensor()
    camera(sensor, exposure_time_us=40_000.0)
    lines = round(40_000 / LINE_TIME_US)
    assert sensor.written == [
        ("vertical_blanking", lines - 1088 + MARGIN),
        ("exposure", lines),
    ]
    assert sensor.queried(sensor.controls()["exposure"]).maximum == lines


def test_a_frame_interval_becomes_blank_lines_and_is_not_lengthened_silently() -> None:
    sensor = Sensor()
    head = camera(sensor, frame_interval_s=0.1, exposure_time_us=1000.0)
    lines = sensor.values["vertical_blanking"] + 1088
    assert lines * LINE_TIME_US == pytest.approx(0.1e6, abs=LINE_TIME_US)
    with pytest.raises(DeviceError, match=r"200000 us does not fit into a frame of 0\.1 s"):
        head.adjust(200_000.0, 0.0)
    assert sensor.values["exposure"] == 50


def test_a_sensor_that_bins_does_not_report_the_time_of_a_line() -> None:
    with pytest.raises(DeviceError, match="a sensor that bins or skips does not report it"):
        camera(Sensor(), crop=(2912, 2176), exposure_time_us=1000.0)
    sensor = Sensor()
    camera(sensor, crop=(2912, 2176), exposure_time_us=1000.0, exposure_unit_us=10.0)
    assert sensor.written == [("exposure", 100)]


def test_a_parameter_of_a_module_is_checked_and_never_written(tmp_path: Path) -> None:
    place = tmp_path / "imx296/parameters"
    place.mkdir(parents=True)
    (place / "trigger_mode").write_text("0\n")
    (place / "flag").write_text("Y\n")
    (wrong,) = wrong_parameters(["imx296/trigger_mode=1"], modules=tmp_path)
    assert "it is 0. Write 'options imx296 trigger_mode=1'" in wrong
    assert wrong_parameters(["imx296/trigger_mode=0", "imx296/flag=1"], modules=tmp_path) == []
    assert "no such parameter" in wrong_parameters(["imx477/trigger_mode=1"], modules=tmp_path)[0]
    assert (place / "trigger_mode").read_text() == "0\n"
    with pytest.raises(DriverError, match=r"module_parameters has '\.\./x=1'"):
        V4l2Settings("cam", {"device": "/dev/video0", "module_parameters": ["../x=1"]})

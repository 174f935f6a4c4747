"""Controls, times of exposure, discovery and refused settings, on the real kernel."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from drivers.cameras.v4l2.discovery import capture_nodes
from drivers.contract import DeviceError
from tests.installed.kernel import vivid

SIZE = {"width_px": 640, "height_px": 360, "pixel_format": "SRGGB12"}
END_OF_FRAME, START_OF_EXPOSURE = 0, 1


@pytest.fixture(scope="module", autouse=True)
def webcam() -> Iterator[None]:
    vivid.load(node_types="0x1", input_types="0x0", num_inputs=1, multiplanar=1)
    yield
    vivid.unload()


def flight(**more: object) -> vivid.Flight:
    return vivid.Flight(**{**SIZE, "keep_frames": 0, **more})


def test_controls_are_written_and_recorded_with_each_frame() -> None:
    head = flight(
        gain=77,
        exposure_control="integer_32_bits",
        exposure_unit_us=10.0,
        exposure_time_us=2500.0,
        temperature_control="read_only_integer_32_bits",
        temperature_unit_c=0.1,
        controls=["contrast=99", "menu=4", "integer_64_bits=5000000000"],
    )
    found = head.head.bind()
    with head:
        head.wait_frames(2)
        vivid.set_control(0, "brightness", 33)
        head.wait(lambda: head.frames[-1].settings["brightness"] == 33, "the new brightness")
    frame = head.frames[0]
    assert frame.settings["gain"] == 77
    assert frame.settings["gain_automatic"] == 0, "a gain that is set is not left to the head"
    assert frame.settings["contrast"] == 99
    assert frame.settings["integer_64_bits"] == 5_000_000_000
    assert frame.settings["PixelFormat"] == "SRGGB12"
    assert frame.exposure_time_us == 2500.0
    raw = vivid.ctl(0, "-C", "read_only_integer_32_bits").split()[1]
    assert frame.temperature_c is not None
    assert 0 <= frame.temperature_c <= 25.5, f"in units of 0.1 degC, and it is {raw} now"
    assert vivid.ctl(0, "-C", "contrast,gain").split() == ["contrast:", "99", "gain:", "77"]
    assert found["model"] == "vivid"
    assert found["bus"].startswith("platform:vivid")
    assert found["frame"] == "640 x 360 SRGGB12"
    assert found["exposure"] == "2500 us"


def test_both_sources_of_time_give_the_start_of_exposure() -> None:
    exposure = {
        "exposure_control": "integer_32_bits",
        "exposure_unit_us": 1.0,
        "exposure_time_us": 3000.0,
        "readout_us": 2000.0,
    }
    lateness: dict[int, list[int]] = {}
    for source in (START_OF_EXPOSURE, END_OF_FRAME):
        with flight(**exposure, controls=[f"timestamp_source={source}"]) as head:
            head.wait_frames(12)
        assert {f.device_clock_ns == f.device_clock_mono_ns for f in head.frames} == {True}
        lateness[source] = [f.mono_ns - f.device_ns for f in head.frames if f.device_ns is not None]
        assert len(lateness[source]) >= 12
    # vivid stamps the end of a frame 9/10 of a frame interval after it begins, which may lie ahead.
    start = sorted(lateness[START_OF_EXPOSURE])[6]
    end = sorted(lateness[END_OF_FRAME])[6]
    assert 0 <= start < 1_000_000_000
    assert end < start + 5_000_000
    reported = vivid.ctl(0, "--get-parm")
    assert "Frames per second" in reported


def test_the_same_pixels_come_from_the_bus_name_as_from_the_path() -> None:
    (node,) = [n for n in capture_nodes() if n.driver == "vivid"]
    assert node.path == "/dev/video0"
    assert {"GREY", "Y10", "Y12", "Y16", "Y16_BE", "SRGGB8", "SBGGR10", "SGBRG12"} <= set(
        node.formats
    )
    with flight(device=node.bus) as head:
        head.wait_frames(2)
    assert head.reported == ["opened"]


def test_check_finds_the_head_and_states_what_to_write() -> None:
    from daemon.cli.find_heads import v4l2_heads

    (head,), problems = v4l2_heads()
    assert problems == []
    assert head["settings"] == {"device": "/dev/video0", "pixel_format": "Y16"}
    assert head["found"]["model"] == "vivid"
    settings = {**head["settings"], "pixel_format": "Y12", "width_px": 640, "height_px": 360}
    with flight(**settings) as found:
        found.wait_frames(1)


def test_settings_that_the_head_refuses_come_all_at_once() -> None:
    with pytest.raises(DeviceError) as refused:
        flight(
            width_px=641,
            height_px=361,
            gain=256,
            exposure_time_us=100.0,
            controls=["no_such_control=1", "contrast=1000"],
            temperature_control="thermometer",
        ).head.bind()
    lines = str(refused.value).splitlines()
    assert len(lines) == 6
    for expected in (
        "width_px x height_px is 641 x 361; the head gives",
        "gain would set gain to 256; the head takes 0 to 255",
        "exposure_time_us is 100; the head has no control of it",
        "controls names 'no_such_control'; the head has brightness",
        "controls would set contrast to 1000; the head takes 0 to 255",
        "temperature_control names 'thermometer'",
    ):
        assert any(expected in line for line in lines), f"{expected!r} is not in {lines}"
    assert vivid.descriptors() == set()


def test_a_software_trigger_presses_its_button() -> None:
    with flight(trigger_source="software", trigger_control="button") as head:
        head.wait_frames(1)
        head.head.trigger()
    with flight() as head:
        head.wait_frames(1)
        with pytest.raises(DeviceError, match="the head waits for its line"):
            head.head.trigger()


def test_a_frame_interval_is_set_and_kept() -> None:
    with flight(frame_interval_s=0.1) as head:
        head.wait_frames(6)
    stamps = [f.mono_ns for f in head.frames]
    assert stamps[-1] - stamps[0] >= 0.09e9 * (len(stamps) - 1) * 0.5

"""What the head driver writes before a head is used, against an emulated head with locks.

The description `small_camera.xml` locks the exposure time while automatic exposure is on, has a
category named Gain, a gain in raw steps only, and triggers by selector.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from drivers.cameras.aravis.aravis_head import AravisHead
from drivers.contract import DeviceError, DeviceEvent, FrameStatus
from sim_hw.gige.described_head import DescribedHead
from sim_hw.gige.genicam.power_on_state import InitialState
from tests.drivers.described_frames import Memory, first_frame

pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
pytestmark = pytest.mark.timeout(120)

DESCRIPTION = (Path(__file__).parents[1] / "sim_hw/gige/genicam/small_camera.xml").read_bytes()
ADDRESS = f"127.{1 + os.getpid() % 250}.80.1"


@contextmanager
def camera(
    state: InitialState = InitialState.USER_SET,
    *,
    big_endian_words: bool = False,
    **settings: object,
) -> Iterator[tuple[DescribedHead, AravisHead, Memory]]:
    emulated = DescribedHead(ADDRESS, DESCRIPTION, state=state, big_endian_words=big_endian_words)
    emulated.start()
    memory = Memory()
    settings = {"address": ADDRESS, "trigger_source": "software", **settings}
    try:
        driver = AravisHead("SU00", settings, memory=memory)
        try:
            yield emulated, driver, memory
        finally:
            driver.close()
    finally:
        emulated.close()


@pytest.mark.parametrize("state", InitialState)
def test_what_another_program_left_is_undone(state: InitialState) -> None:
    with camera(state) as (emulated, driver, _):
        driver.bind()
        registers = emulated.registers
        assert registers.symbolic_or("ExposureAuto", "") == "Off"
        assert registers.symbolic_or("TestPattern", "") == "Off"
        assert registers.symbolic_or("AcquisitionMode", "") == "Continuous"
        assert registers.symbolic_or("TriggerSelector", "") == "FrameStart"
        assert registers.symbolic_or("TriggerMode", "") == "On"
        assert registers.number_or("ReverseX", -1) == 0
        assert registers.number_or("OffsetX", -1) == 0
        assert registers.number_or("ExposureTimeAbs", -1) == 1000.0
        assert registers.number_or("GainRaw", -1) == 3
        assert not registers.refused


def test_the_other_trigger_is_off() -> None:
    with camera() as (emulated, driver, _):
        emulated.registers.nodes.write("SelectorReg", 0)
        emulated.registers.nodes.write("ModeReg", 1)
        driver.bind()
        memory = emulated.registers.memory
        assert memory.read(0x10030, 8) == bytes([0, 0, 0, 0, 0, 0, 0, 1])


def test_the_widest_format_is_the_default() -> None:
    with camera() as (_, driver, _memory):
        assert driver.bind()["frame"].endswith("Mono12")


@pytest.mark.parametrize("pixel_format", ["Mono8", "Mono12", "Mono12Packed"])
def test_every_format_pixel_by_pixel(pixel_format: str) -> None:
    with camera(pixel_format=pixel_format) as (emulated, driver, memory):
        driver.bind()
        frame, pixels = first_frame(driver, memory)
        assert emulated.last_image is not None
        shift = 4 if pixel_format == "Mono8" else 0
        assert frame.pixel_format == pixel_format
        assert np.array_equal(pixels, emulated.last_image >> shift)


@pytest.mark.parametrize("byte_order", ["little", "big"])
def test_words_of_either_byte_order(byte_order: str) -> None:
    with camera(big_endian_words=byte_order == "big", byte_order=byte_order) as (
        emulated,
        driver,
        memory,
    ):
        driver.bind()
        _, pixels = first_frame(driver, memory)
        assert emulated.last_image is not None
        assert np.array_equal(pixels, emulated.last_image)


@pytest.mark.parametrize("byte_order", ["little", "big"])
def test_words_of_the_other_byte_order_are_reported_and_not_used(byte_order: str) -> None:
    other = "big" if byte_order == "little" else "little"
    with camera(big_endian_words=byte_order == "little", byte_order=byte_order) as (
        _,
        driver,
        memory,
    ):
        events: list[DeviceEvent] = []
        driver.bind()
        frame, _ = first_frame(driver, memory, events=events)
        statistics = driver.statistics()
    assert frame.status is FrameStatus.CORRUPT
    assert statistics["frames_swapped"] == statistics["corrupt_byte_order"] >= 1
    assert statistics.get("frames", 0) == 0
    (event,) = [event for event in events if event.name == "byte-order"]
    assert event.is_fault
    assert f'byte_order is "{byte_order}"' in event.sentence
    assert f'Set byte_order = "{other}".' in event.sentence


def test_features_are_written_in_addition() -> None:
    with camera(features={"BlackLevel": 17, "GainRaw": 90, "ReverseX": True}) as (
        emulated,
        driver,
        _,
    ):
        driver.bind()
        assert emulated.registers.number_or("BlackLevel", -1) == 17
        assert emulated.registers.number_or("GainRaw", -1) == 90
        assert emulated.registers.number_or("ReverseX", -1) == 1


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"features": {"BlackLevels": 1}}, "the head has no feature BlackLevels"),
        ({"features": {"BlackLevel": 1.5}}, "a whole number is needed"),
        ({"features": {"BlackLevel": 999}}, "BlackLevel = 999 is refused"),
        ({"features": {"ExposureTimeAbs": 50.0}}, "set exposure_time_us"),
        ({"features": {"TestPattern": "Stripes"}}, "TestPattern has no entry Stripes"),
        ({"gain_db": 6.0}, "the head has no gain in dB; it has GainRaw"),
        ({"exposure_time_us": 200_000.0}, "the head takes 10 to 100000"),
        ({"pixel_format": "Mono16"}, "the head has Mono8, Mono12"),
        ({"trigger_source": "line", "trigger_line": "Line7"}, "the head has Software, Line1"),
        ({"trigger_delay_us": 5.0}, "the head has no trigger delay"),
        ({"strobe_line": "Line2"}, "the head has no LineSelector"),
        ({"width_px": 1000, "height_px": 480}, "width_px = 1000 is refused"),
        ({"preset": "unknown"}, "there are allied-vision-alvium"),
    ],
)
def test_what_is_missing_is_named(settings: dict[str, object], expected: str) -> None:
    # Settings by name, as a configuration has them.
    with pytest.raises(DeviceError) as refusal, camera(**settings) as (_, driver, _memory):  # type: ignore[arg-type]
        driver.bind()
    assert expected in str(refusal.value)


def test_all_refusals_come_at_once() -> None:
    with (
        pytest.raises(DeviceError) as refusal,
        camera(gain_db=6.0, trigger_delay_us=5.0, exposure_time_us=200_000.0) as (_, driver, _m),
    ):
        driver.bind()
    assert len(str(refusal.value).splitlines()) == 3

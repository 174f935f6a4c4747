"""Switches of the standard that another program left on, proved by the pixels that arrive.

Descriptions are variants of `small_camera.xml`.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import pytest

from tests.drivers.described_frames import first_frame
from tests.drivers.test_head_features import enumeration, number, register
from tests.drivers.test_odd_descriptions import head, with_nodes

pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
pytestmark = pytest.mark.timeout(120)

ADDRESS: Final = 0x10070
BIG_ENDIAN: Final = (
    '<Boolean Name="GevSCPSBigEndian"><pValue>GevSCPSBigEndianReg</pValue></Boolean>'
    + register("GevSCPSBigEndianReg", ADDRESS)
)
SELECTED_BINNING: Final = """
 <Enumeration Name="BinningSelector"><EnumEntry Name="Sensor"><Value>0</Value></EnumEntry>
  <EnumEntry Name="Digital"><Value>1</Value></EnumEntry><pValue>BinningSelectorReg</pValue>
  <pSelected>BinningHorizontal</pSelected></Enumeration>
 <Integer Name="BinningHorizontal"><pValue>BinningReg</pValue><Min>1</Min><Max>4</Max></Integer>
 <IntReg Name="BinningReg"><Address>0x10090</Address>
  <pIndex Offset="4">BinningSelectorReg</pIndex><Length>4</Length><AccessMode>RW</AccessMode>
  <pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>""" + register(
    "BinningSelectorReg", ADDRESS
)


@pytest.mark.parametrize(
    ("nodes", "feature", "left"),
    [
        (BIG_ENDIAN, "GevSCPSBigEndian", 1),
        (
            enumeration("DeviceStreamChannelEndianness", ADDRESS, "Little", "Big"),
            "DeviceStreamChannelEndianness",
            1,
        ),
    ],
    ids=["GigE Vision", "SFNC 2"],
)
def test_big_endian_words_are_switched_off_by_either_name(
    nodes: str, feature: str, left: int
) -> None:
    with head(with_nodes(nodes, feature)) as (emulated, driver, memory):
        emulated.registers.nodes.write(f"{feature}Reg", left)
        found = driver.bind()
        _, pixels = first_frame(driver, memory)
        assert emulated.last_image is not None
        assert np.array_equal(pixels, emulated.last_image)
    assert f"{feature} = " in found["features"]


def test_big_endian_words_that_are_wanted_are_read_as_such() -> None:
    text = with_nodes(BIG_ENDIAN, "GevSCPSBigEndian")
    features = {"GevSCPSBigEndian": True}
    with head(text, byte_order="big", features=features) as (emulated, driver, memory):
        driver.bind()
        assert emulated.registers.number_or("GevSCPSBigEndian", 0) == 1
        _, pixels = first_frame(driver, memory)
        assert emulated.last_image is not None
        assert np.array_equal(pixels, emulated.last_image)


@pytest.mark.parametrize(
    ("nodes", "feature", "held"),
    [
        (enumeration("ImageCompressionMode", ADDRESS, "Off", "JPEG"), "ImageCompressionMode", 0),
        (number("DigitalShift", ADDRESS, 4), "DigitalShift", 0),
        (enumeration("FlatFieldCorrection", ADDRESS, "Off", "On"), "FlatFieldCorrection", 0),
        (
            enumeration("VignettingCorrectionMode", ADDRESS, "Off", "On"),
            "VignettingCorrectionMode",
            0,
        ),
    ],
)
def test_what_changes_values_is_switched_off(nodes: str, feature: str, held: int) -> None:
    with head(with_nodes(nodes, feature)) as (emulated, driver, _):
        emulated.registers.nodes.write(f"{feature}Reg", 1)
        driver.bind()
        assert emulated.registers.nodes.number(f"{feature}Reg") == held


@pytest.mark.parametrize("selected", [0, 1])
def test_binning_is_one_for_every_entry_of_its_selector(selected: int) -> None:
    with head(with_nodes(SELECTED_BINNING, "BinningSelector", "BinningHorizontal")) as (
        emulated,
        driver,
        _,
    ):
        memory = emulated.registers.memory
        memory.write(0x10090, bytes([0, 0, 0, 2, 0, 0, 0, 4]))
        emulated.registers.nodes.write("BinningSelectorReg", selected)
        driver.bind()
        assert memory.read(0x10090, 8) == bytes([0, 0, 0, 1, 0, 0, 0, 1])
        assert emulated.registers.nodes.number("BinningSelectorReg") == selected

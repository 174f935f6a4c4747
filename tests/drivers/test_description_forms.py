"""Forms of a GenICam description that the standard allows and few cameras use: the head is armed.

Each is a variant of `small_camera.xml`. Source: GenApi schema 1.1.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import pytest

from tests.drivers.described_frames import first_frame
from tests.drivers.test_head_features import register
from tests.drivers.test_odd_descriptions import TEXT, head, with_nodes, without

pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
pytestmark = pytest.mark.timeout(120)

CONVERTER: Final = """
 <Float Name="ExposureTime"><Unit>us</Unit><pValue>ExposureOfTicks</pValue></Float>
 <Converter Name="ExposureOfTicks"><pVariable Name="TICK">TickReg</pVariable>
  <FormulaTo>FROM * 1000 / TICK</FormulaTo><FormulaFrom>TO * TICK / 1000</FormulaFrom>
  <pValue>TicksReg</pValue></Converter>"""
STRUCTURE: Final = """
 <Boolean Name="ReverseY"><pValue>ReverseBit</pValue></Boolean>
 <Boolean Name="GammaEnable"><pValue>GammaBit</pValue></Boolean>
 <StructReg Comment="Switches"><Address>0x1007C</Address><Length>4</Length>
  <AccessMode>RW</AccessMode><pPort>Device</pPort><Endianess>BigEndian</Endianess>
  <StructEntry Name="ReverseBit"><Bit>31</Bit></StructEntry>
  <StructEntry Name="GammaBit"><Bit>3</Bit></StructEntry></StructReg>"""
SECOND_PORT: Final = '<Port Name="Second"/>' + register("OffsetYReg", 0x10080).replace(
    "<pPort>Device", "<pPort>Second"
)
OFFSET: Final = '<Integer Name="OffsetY"><pValue>OffsetYReg</pValue></Integer>'
NO_ENTRY: Final = '<Enumeration Name="GainAuto"><pValue>GainAutoReg</pValue></Enumeration>'


@pytest.mark.parametrize(
    "text",
    [
        with_nodes(SECOND_PORT + OFFSET, "OffsetY"),
        with_nodes("", "NoSuchFeature"),
        with_nodes(OFFSET.replace("OffsetYReg", "NoSuchNode"), "OffsetY"),
        with_nodes(NO_ENTRY + register("GainAutoReg", 0x10084), "GainAuto"),
        "\ufeff" + TEXT,
        TEXT.replace('<Category Name="Root">', '<Group Comment=""><Category Name="Root">').replace(
            "</RegisterDescription>", "</Group></RegisterDescription>"
        ),
        TEXT.replace('SchemaMinorVersion="1"', 'SchemaMinorVersion="0"').replace(
            "Version_1_1", "Version_1_0"
        ),
        TEXT.replace("<pFeature>ReverseX</pFeature>", ""),
    ],
    ids=[
        *(
            "second-port",
            "feature-without-node",
            "value-without-node",
            "no-entry",
            "byte-order-mark",
        ),
        *("group", "schema-1.0", "in-no-category"),
    ],
)
def test_a_head_with_this_form_is_armed_and_sends_the_pattern(text: str) -> None:
    with head(text) as (emulated, driver, memory):
        driver.bind()
        _, pixels = first_frame(driver, memory)
        assert emulated.last_image is not None
        assert np.array_equal(pixels, emulated.last_image)


def test_an_exposure_time_in_ticks_of_a_clock_is_converted_both_ways() -> None:
    nodes = CONVERTER + register("TickReg", 0x10074) + register("TicksReg", 0x10078)
    text = with_nodes(nodes, "ExposureTime", text=without("ExposureTimeAbs"))
    with head(text, exposure_time_us=1200.0) as (emulated, driver, memory):
        emulated.registers.nodes.write("TickReg", 250)
        driver.bind()
        frame, _ = first_frame(driver, memory)
        assert emulated.registers.nodes.number("TicksReg") == 4800
        assert frame.settings["ExposureTime"] == 1200.0


def test_bits_of_a_structure_are_switched_off_and_leave_the_others() -> None:
    with head(with_nodes(STRUCTURE, "ReverseY", "GammaEnable")) as (emulated, driver, _):
        memory = emulated.registers.memory
        memory.write(0x1007C, bytes([0xFF] * 4))
        driver.bind()
        left = int.from_bytes(memory.read(0x1007C, 4), "big")
        assert left.bit_count() == 30
        assert emulated.registers.number_or("ReverseY", -1) == 0
        assert emulated.registers.number_or("GammaEnable", -1) == 0


def test_a_value_that_no_entry_of_an_enumeration_has_is_replaced() -> None:
    node = NO_ENTRY.replace('"GainAuto">', '"GainAuto"><EnumEntry Name="Off"><Value>0</Value>'
                            "</EnumEntry>")  # fmt: skip
    text = with_nodes(node + register("GainAutoReg", 0x10084), "GainAuto")
    with head(text) as (emulated, driver, _):
        emulated.registers.nodes.write("GainAutoReg", 7)
        driver.bind()
        assert emulated.registers.symbolic_or("GainAuto", "") == "Off"

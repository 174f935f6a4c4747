"""Features as JAI, Hikrobot and Matrix Vision name them: switched off, converted, or refused.

Descriptions are variants of `small_camera.xml`. Sources: roboception/rc_genicam_camera#4 and the
manuals of JAI's Go series; Hikrobot GigE Area Scan Camera User Manual; mvBlueFOX3 manual.
"""

from __future__ import annotations

import re
from typing import Final

import numpy as np
import pytest

from drivers.contract import DeviceError
from tests.drivers.described_frames import first_frame
from tests.drivers.test_head_features import enumeration, number, register, running
from tests.drivers.test_odd_descriptions import TEXT, burst_only, head, with_nodes, without

pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
pytestmark = pytest.mark.timeout(120)


def boolean(name: str, address: int) -> str:
    return f'<Boolean Name="{name}"><pValue>{name}Reg</pValue></Boolean>' + register(
        f"{name}Reg", address
    )


def factor(unit: str) -> str:
    """A gain that is a factor of 1 to 16, in hundredths in its register."""
    return (
        f'<Float Name="Gain"><Unit>{unit}</Unit><pValue>GainFactor</pValue></Float>'
        '<Converter Name="GainFactor"><FormulaTo>FROM * 100</FormulaTo>'
        "<FormulaFrom>TO / 100</FormulaFrom><pValue>GainHundredths</pValue></Converter>"
        '<Integer Name="GainHundredths"><pValue>GainHundredthsReg</pValue>'
        "<Min>100</Min><Max>1600</Max></Integer>" + register("GainHundredthsReg", 0x100C0)
    ).replace("<Unit></Unit>", "")


def of_maker(text: str, maker: str) -> str:
    """The description with a maker's name that is its own."""
    return with_nodes(
        f'<String Name="DeviceVendorName"><Value>{maker}</Value></String>',
        "DeviceVendorName",
        text=re.sub(
            r'<(\w+) Name="DeviceVendorName".*?</\1>', "", text, count=1, flags=re.DOTALL
        ).replace("<pFeature>DeviceVendorName</pFeature>", ""),
    )


@pytest.mark.parametrize(
    ("maker", "unit", "gain_db", "held"),
    [
        ("JAI Corporation", "", 0.0, 100),
        ("JAI Corporation", "", 6.0206, 200),
        ("Emergent", "x", 12.0412, 400),
        ("JAI Corporation", "dB", 6.0, 600),
    ],
)
def test_a_gain_that_is_a_factor_is_converted(
    maker: str, unit: str, gain_db: float, held: int
) -> None:
    text = of_maker(with_nodes(factor(unit), "Gain", text=without("Gain")), maker)
    with head(text, gain_db=gain_db) as (emulated, driver, _):
        driver.bind()
        assert emulated.registers.nodes.number("GainHundredthsReg") == pytest.approx(held, abs=1)
        with running(driver):
            driver.adjust(2000.0, 0.0, 0)
            assert emulated.registers.nodes.number("GainHundredthsReg") == 100


def test_a_factor_beyond_the_heads_highest_is_refused() -> None:
    text = of_maker(with_nodes(factor(""), "Gain", text=without("Gain")), "JAI Corporation")
    with (
        pytest.raises(DeviceError, match=r"gain_db = 60, as the factor Gain = 1000.0 is refused"),
        head(text, gain_db=60.0) as (_, driver, _memory),
    ):
        driver.bind()


@pytest.mark.parametrize(
    ("feature", "nodes"),
    [
        ("LUTMode", enumeration("LUTMode", 0x10070, "Off", "Gamma", "LUT")),
        ("ShadingMode", enumeration("ShadingMode", 0x10070, "Off", "FlatShading")),
        ("GradationCompressionMode", enumeration("GradationCompressionMode", 0x10070, "Off", "On")),
        ("ImageScalingMode", enumeration("ImageScalingMode", 0x10070, "Off", "On")),
        ("OverlayMode", boolean("OverlayMode", 0x10070)),
        ("BlemishEnable", boolean("BlemishEnable", 0x10070)),
        ("EdgeEnhancerEnable", boolean("EdgeEnhancerEnable", 0x10070)),
        ("HDREnable", boolean("HDREnable", 0x10070)),
        ("NUCEnable", boolean("NUCEnable", 0x10070)),
        ("DigitalShiftEnable", boolean("DigitalShiftEnable", 0x10070)),
        ("flatfieldCorrectionMode", enumeration("flatfieldCorrectionMode", 0x10070, "Off", "On")),
    ],
)
def test_what_a_maker_calls_otherwise_is_switched_off(feature: str, nodes: str) -> None:
    with head(with_nodes(nodes, feature)) as (emulated, driver, _):
        emulated.registers.nodes.write(f"{feature}Reg", 1)
        assert f"{feature} = " in driver.bind()["features"]
        assert emulated.registers.nodes.number(f"{feature}Reg") == 0


EMBEDDED: Final = """
 <Boolean Name="FrameSpecInfo"><pValue>SpecInfoReg</pValue></Boolean>
 <IntReg Name="SpecInfoReg"><Address>0x10090</Address>
  <pIndex Offset="4">FrameSpecInfoSelectorReg</pIndex><Length>4</Length><AccessMode>RW</AccessMode>
  <pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>""" + enumeration(
    "FrameSpecInfoSelector", 0x10070, "Timestamp", "Gain", "Framecounter"
)


def test_information_over_pixels_is_switched_off_for_every_kind_of_it() -> None:
    with head(with_nodes(EMBEDDED, "FrameSpecInfo", "FrameSpecInfoSelector")) as (
        emulated,
        driver,
        _,
    ):
        memory = emulated.registers.memory
        memory.write(0x10090, bytes([0, 0, 0, 1] * 3))
        driver.bind()
        assert memory.read(0x10090, 12) == bytes(12)


SHIFT_BEHIND_A_SWITCH: Final = (
    boolean("DigitalShiftEnable", 0x10070)
    + number("DigitalShift", 0x10074, 4).replace(
        "<pValue>", "<pIsLocked>NoShift</pIsLocked><pValue>", 1
    )
    + '<IntSwissKnife Name="NoShift"><pVariable Name="ON">DigitalShiftEnableReg</pVariable>'
    "<Formula>ON = 0</Formula></IntSwissKnife>"
)


def test_a_shift_whose_switch_is_off_is_no_refusal() -> None:
    text = with_nodes(SHIFT_BEHIND_A_SWITCH, "DigitalShiftEnable", "DigitalShift")
    with head(text) as (emulated, driver, memory):
        emulated.registers.nodes.write("DigitalShiftReg", 2)
        emulated.registers.nodes.write("DigitalShiftEnableReg", 1)
        driver.bind()
        assert emulated.registers.nodes.number("DigitalShiftEnableReg") == 0
        _, pixels = first_frame(driver, memory)
        assert np.array_equal(pixels, emulated.last_image)


def test_binning_with_entries_of_its_own_name_is_one() -> None:
    nodes = enumeration("BinningHorizontal", 0x10070, *(f"BinningHorizontal{n}" for n in (1, 2, 4)))
    with head(with_nodes(nodes, "BinningHorizontal")) as (emulated, driver, _):
        emulated.registers.nodes.write("BinningHorizontalReg", 2)
        driver.bind()
        assert emulated.registers.symbolic_or("BinningHorizontal", "") == "BinningHorizontal1"


HIKROBOT_LINES: Final = (
    enumeration("LineSelector", 0x10080, "Line0", "Line1", "Line2")
    + enumeration("LineMode", 0x10084, "Input", "Strobe")
    + enumeration("LineSource", 0x10088, "AcquisitionStartActive", "ExposureStartActive")
    + boolean("StrobeEnable", 0x1008C)
    + number("LineDebouncerTime", 0x10090, 1_000_000)
)
HIKROBOT_FEATURES: Final = (
    *("LineSelector", "LineMode", "LineSource", "StrobeEnable", "LineDebouncerTime"),
)


def test_a_hikrobot_head_is_armed_with_its_strobe_and_sends_the_pattern() -> None:
    text = with_nodes(HIKROBOT_LINES, *HIKROBOT_FEATURES, text=burst_only())
    with head(text, strobe_line="Line1", preset="hikrobot-gige") as (emulated, driver, memory):
        found = driver.bind()["features"]
        for held in (
            "LineMode = Strobe",
            "LineSource = ExposureStartActive",
            "StrobeEnable = 1",
        ):
            assert held in found
        assert emulated.registers.symbolic_or("LineSelector", "") == "Line1"
        _, pixels = first_frame(driver, memory)
        assert np.array_equal(pixels, emulated.last_image)


def test_a_preset_skips_an_entry_that_the_head_does_not_have() -> None:
    nodes = enumeration("SensorDigitizationBits", 0x10070, "Eight", "Ten")
    with head(with_nodes(nodes, "SensorDigitizationBits"), preset="jai-go") as (_, driver, _memory):
        assert "SensorDigitizationBits" not in driver.bind()["features"]


def test_the_debouncer_of_a_matrix_vision_head_is_written() -> None:
    nodes = number("mvLineDebounceTimeRisingEdge", 0x10070, 5000)
    text = with_nodes(nodes, "mvLineDebounceTimeRisingEdge", text=TEXT)
    with head(text, trigger_source="line", debounce_us=25.0) as (emulated, driver, _):
        driver.bind()
        assert emulated.registers.nodes.number("mvLineDebounceTimeRisingEdgeReg") == 25

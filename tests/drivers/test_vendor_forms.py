"""What makers write otherwise in a description: the head is armed, or refused with the true reason.

Each is a variant of `small_camera.xml`, served by the emulated head. Source: GenApi schema 1.1;
names of Daheng, Teledyne DALSA and Emergent as `neutral_features` states.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import pytest

from drivers.contract import DeviceError
from tests.drivers.described_frames import first_frame
from tests.drivers.test_head_features import enumeration, number, register
from tests.drivers.test_makers_forms import boolean
from tests.drivers.test_odd_descriptions import TEXT, head, refusal_of, with_nodes, without

pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
pytestmark = pytest.mark.timeout(120)

PLACE: Final = 0x10100
WAITS: Final = '<IntSwissKnife Name="{name}"><pVariable Name="M">ModeReg</pVariable><Formula>M = 1'
WAITS_END: Final = "</Formula></IntSwissKnife>"


def time_of(properties: str, nodes: str = "", kind: str = "Float") -> str:
    """The description with another exposure time; `T` stands behind it."""
    feature = f'<{kind} Name="ExposureTime">{properties}<pValue>T</pValue></{kind}>'
    return with_nodes(feature + nodes, "ExposureTime", text=without("ExposureTimeAbs"))


def converted(per_us: float) -> str:
    return (
        f'<Converter Name="T"><FormulaTo>FROM * {per_us}</FormulaTo>'
        f"<FormulaFrom>TO / {per_us}</FormulaFrom><pValue>TReg</pValue></Converter>"
        + register("TReg", PLACE)
    )


def placed(kind: str, more: str, nbytes: int = 4) -> str:
    return (
        f'<{kind} Name="T"><Address>{PLACE}</Address><Length>{nbytes}</Length>'
        f"<AccessMode>RW</AccessMode><pPort>Device</pPort>{more}</{kind}>"
    )


INDEXED: Final = (
    '<Integer Name="T"><pIndex>Place</pIndex><pValueIndexed Index="0">Other</pValueIndexed>'
    '<pValueIndexed Index="1">TReg</pValueIndexed><pValueDefault>Other</pValueDefault></Integer>'
    '<Integer Name="Place"><Value>1</Value></Integer>'
    + register("TReg", PLACE)
    + register("Other", PLACE + 4)
)
BY_FORMULA: Final = register("TReg", PLACE).replace(
    "<Length>",
    '<IntSwissKnife Name="Shift"><Constant Name="STEP">16</Constant>'
    "<Formula>STEP * 2</Formula></IntSwissKnife><Length>",
) + ('<Integer Name="T"><pValue>TReg</pValue></Integer>')
COMPUTED_LIMITS: Final = (
    "<pMin>Lowest</pMin><pMax>Highest</pMax>",
    '<SwissKnife Name="Lowest"><Formula>10.5</Formula></SwissKnife>'
    '<SwissKnife Name="Highest"><pVariable Name="ROWS">Height</pVariable>'
    '<Constant Name="ROW">20.5</Constant><Expression Name="ALL">ROWS * ROW</Expression>'
    "<Formula>(ROWS &gt; 3) ? ROUND(ALL * 10, 0) : (TRUNC(0.5))</Formula></SwissKnife>",
)
NO_LIMIT_YET: Final = (
    "<pMax>Highest</pMax>",
    '<SwissKnife Name="Highest"><pVariable Name="RATE">Rate</pVariable><Formula>1 / RATE</Formula>'
    '</SwissKnife><Integer Name="Rate"><Value>0</Value></Integer>',
)


@pytest.mark.parametrize(
    ("text", "node", "held"),
    [
        (time_of("<Unit>S</Unit>", converted(1e6)), "TReg", 1000),
        (time_of("<Unit>sec</Unit>", converted(1e6)), "TReg", 1000),
        (time_of("<Unit>msec</Unit>", converted(1e3)), "TReg", 1000),
        (time_of("<Unit>\N{GREEK SMALL LETTER MU}s</Unit>", converted(1)), "TReg", 1000),
        (time_of("<Unit>10 us</Unit>", converted(1)), "TReg", 100),
        (time_of("<Inc>8</Inc><Min>7</Min>", converted(1), "Integer"), "TReg", 999),
        (time_of("<Inc>0.5</Inc>", converted(2)), "TReg", 2000),
        (time_of("", placed("FloatReg", "<Endianess>LittleEndian</Endianess>")), "T", 1000),
        (time_of("", placed("FloatReg", "<Endianess>BigEndian</Endianess>", 8)), "T", 1000),
        (
            time_of("", placed("MaskedIntReg", "<LSB>31</LSB><MSB>8</MSB><Endianess>BigEndian"
                               "</Endianess>"), "Integer"), "T", 1000,
        ),
        (
            time_of("", placed("MaskedIntReg", "<LSB>4</LSB><MSB>27</MSB><Endianess>LittleEndian"
                               "</Endianess>"), "Integer"), "T", 1000,
        ),
        (
            time_of("", placed("IntReg", "<Endianess>BigEndian</Endianess>", 8), "Integer"),
            "T", 1000,
        ),
        (time_of("", INDEXED, "Integer"), "TReg", 1000),
        (time_of("", BY_FORMULA, "Integer"), "TReg", 1000),
        (time_of(COMPUTED_LIMITS[0], converted(1) + COMPUTED_LIMITS[1]), "TReg", 1000),
        (time_of(NO_LIMIT_YET[0], converted(1) + NO_LIMIT_YET[1]), "TReg", 1000),
        (
            with_nodes(number("Exposure", PLACE, 100_000), "Exposure",
                       text=without("ExposureTimeAbs")), "ExposureReg", 1000,
        ),
        (
            time_of("<ValidValueSet>500;1000;2000</ValidValueSet>", converted(1), "Integer"),
            "TReg", 1000,
        ),
    ],
    ids=["S", "sec", "msec", "mu", "ten-us", "step", "float-step", "float-little", "double-big",
         "masked-big", "masked-little", "64-bit", "indexed", "address-formula", "computed-limits",
         "no-limit-yet", "Emergent", "value-set"],
)  # fmt: skip
def test_an_exposure_time_is_written_in_the_unit_and_place_of_the_head(
    text: str, node: str, held: float
) -> None:
    with head(text) as (emulated, driver, memory):
        driver.bind()
        frame, pixels = first_frame(driver, memory)
        assert emulated.registers.nodes.number(node) == held
        assert frame.settings["ExposureTime"] == pytest.approx(1000.0, abs=1.0)
        assert np.array_equal(pixels, emulated.last_image)


def test_an_exposure_time_that_is_no_time_is_refused() -> None:
    text = time_of("<Unit>lines</Unit>", converted(1))
    assert "no feature that sets its exposure time (ExposureTime is in 'lines')" in refusal_of(text)


def test_a_value_outside_the_heads_set_is_refused_by_the_emulator() -> None:
    text = time_of("<ValidValueSet>500;2000</ValidValueSet>", converted(1), "Integer")
    assert "choose a time that the head has" in refusal_of(text)


TRIGGERED: Final = WAITS.format(name="Waits") + WAITS_END
PAYLOAD: Final = (
    '<pVariable Name="W">WidthReg</pVariable><pVariable Name="H">HeightReg</pVariable>'
    '<pVariable Name="F">PixelFormat</pVariable>'
    "<Formula>W * H * ((F &gt;&gt; 16) &amp; 0xFF) / 8</Formula></IntSwissKnife>"
)


@pytest.mark.parametrize(
    "text",
    [
        TEXT.replace("<pIsLocked>ExposureLocked", "<pIsLocked>Waits"),
        TEXT.replace('<Enumeration Name="PixelFormat">',
                     '<Enumeration Name="PixelFormat"><pIsLocked>Waits</pIsLocked>'),
        TEXT.replace('<Integer Name="Width">',
                     '<Integer Name="Width"><ImposedAccessMode>RO</ImposedAccessMode>'),
        without("TriggerSelector").replace('<pIndex Offset="4">SelectorReg</pIndex>', ""),
        TEXT.replace("<pValue>SoftwareReg</pValue><CommandValue>1</CommandValue>",
                     "<pValue>SoftwareNumber</pValue><pCommandValue>One</pCommandValue>"),
        with_nodes('<IntSwissKnife Name="PayloadSize">' + PAYLOAD, "PayloadSize",
                   text=without("PayloadSize")),
        with_nodes('<Integer Name="PayloadSize"><pValue>Size</pValue></Integer>'
                   '<IntSwissKnife Name="Size">' + PAYLOAD, "PayloadSize",
                   text=without("PayloadSize")),
        TEXT.replace("<pPort>Device</pPort>",
                     "<pPort>Device</pPort><Cachable>NoCache</Cachable><PollingTime>100"
                     "</PollingTime><pInvalidator>SelectorReg</pInvalidator>"),
        TEXT.replace(' Name="Width"', ' NameSpace="Standard" Name="Width"').replace(
            ' Name="GainRaw"', ' Name="GainRaw" NameSpace="Custom"'),
        TEXT.replace("\n", "\r\n"),
        TEXT.replace(' xmlns="http://www.genicam.org/GenApi/Version_1_1"', ""),
    ],
    ids=["time-locked-by-trigger", "format-locked-by-trigger", "fixed-width", "no-selector",
         "command-by-numbers", "payload-formula", "payload-of-formula", "polled", "namespaces",
         "crlf", "no-xmlns"],
)  # fmt: skip
def test_a_head_of_this_form_is_armed_and_sends_the_pattern(text: str) -> None:
    nodes = TRIGGERED + (
        '<Integer Name="One"><Value>1</Value></Integer>'
        '<Integer Name="SoftwareNumber"><pValue>SoftwareReg</pValue></Integer>'
    )
    with head(with_nodes(nodes, text=text)) as (emulated, driver, memory):
        emulated.registers.memory.write(0x10030, bytes([0, 0, 0, 1] * 2))
        driver.bind()
        frame, pixels = first_frame(driver, memory)
        assert frame.pixel_format == "Mono12"
        assert np.array_equal(pixels, emulated.last_image)


@pytest.mark.parametrize(
    ("nodes", "before", "after"),
    [
        (enumeration("TransferControlMode", PLACE, "Basic", "UserControlled"), 1, 0),
        (enumeration("TransferControlMode", PLACE, "Automatic", "UserControlled"), 1, 0),
        (enumeration("GenDCStreamingMode", PLACE, "Off", "On"), 1, 0),
        (boolean("turboTransferEnable", PLACE), 1, 0),
        (boolean("AutoGain", PLACE), 1, 0),
        (enumeration("AcquisitionFrameRateMode", PLACE, "Off", "On"), 1, 0),
        (enumeration("SharpnessMode", PLACE, "Off", "On"), 1, 0),
        (enumeration("DeadPixelCorrect", PLACE, "Off", "On"), 1, 0),
        (enumeration("BalanceWhiteAuto", PLACE, "Manual", "Continuous"), 1, 0),
        (number("ReverseY", PLACE, 1), 1, 0),
        (number("Gamma", PLACE, 4), 2, 1),
    ],
)
def test_other_switches_of_makers_are_off(nodes: str, before: int, after: int) -> None:
    name = nodes.partition('Name="')[2].partition('"')[0]
    with head(with_nodes(nodes, name)) as (emulated, driver, _):
        emulated.registers.nodes.write(f"{name}Reg", before)
        assert f"{name} = " in driver.bind()["features"]
        assert emulated.registers.nodes.number(f"{name}Reg") == after


def test_an_offset_that_centring_locks_is_zero() -> None:
    text = TEXT.replace('"OffsetX">', '"OffsetX"><pIsLocked>CenterXReg</pIsLocked>')
    with head(with_nodes(boolean("CenterX", PLACE), "CenterX", text=text)) as (emulated, driver, _):
        emulated.registers.nodes.write("CenterXReg", 1)
        emulated.registers.nodes.write("OffsetReg", 32)
        driver.bind()
        assert emulated.registers.number_or("OffsetX", -1) == 0


def test_the_selected_trigger_stays_selected_since_other_features_depend_on_it() -> None:
    text = TEXT.replace('"ExposureAuto">', '"ExposureAuto"><pIsLocked>SelectorReg</pIsLocked>')
    with head(text) as (emulated, driver, _):
        emulated.registers.nodes.write("SelectorReg", 0)
        emulated.registers.nodes.write("ExposureAutoReg", 2)
        driver.bind()
        assert emulated.registers.symbolic_or("ExposureAuto", "") == "Off"


def test_what_cannot_be_switched_off_is_refused() -> None:
    text = with_nodes(enumeration("BalanceWhiteAuto", PLACE, "Once", "Continuous"),
                      "BalanceWhiteAuto")  # fmt: skip
    with (
        pytest.raises(DeviceError, match="is Continuous and cannot be switched off"),
        head(text) as (emulated, driver, _),
    ):
        emulated.registers.nodes.write("BalanceWhiteAutoReg", 1)
        driver.bind()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            with_nodes('<Integer Name="Zero"><Value>0</Value></Integer>', text=TEXT.replace(
                '"TriggerSoftware">', '"TriggerSoftware"><pIsImplemented>Zero</pIsImplemented>')),
            'the head has no command TriggerSoftware, set trigger_source = "line"',
        ),
        (
            TEXT.replace('"Off"><Value>0</Value></EnumEntry><EnumEntry Name="On">',
                         '"FreeRun"><Value>0</Value></EnumEntry><EnumEntry Name="Triggered">'),
            "TriggerMode has no entry On; the head has FreeRun, Triggered",
        ),
        (without("TriggerSource"), "the head has no feature TriggerSource"),
        (
            TEXT.replace('"Mono8"', '"RGB8"').replace('"Mono12"', '"YUV422_8"').replace(
                '"Mono12Packed"', '"BGR8"'),
            "no monochrome or Bayer format of 8 to 16 bits (it has RGB8, YUV422_8, BGR8)",
        ),
        (
            TEXT.replace("<pValue>WidthReg</pValue>", "<pValue>\n WidthReg\n</pValue>"),
            "the head announces frames of 0 x 480 pixels",
        ),
    ],
    ids=["no-software", "mode-names", "no-source", "colour-only", "no-width"],
)  # fmt: skip
def test_a_head_of_this_form_is_refused_with_the_true_reason(text: str, expected: str) -> None:
    assert expected in refusal_of(text)


def packet_size(properties: str) -> str:
    nodes = (
        f'<Integer Name="GevSCPSPacketSize">{properties}<pValue>SizeReg</pValue></Integer>'
        '<MaskedIntReg Name="SizeReg"><Address>0xD04</Address><Length>4</Length><AccessMode>RW'
        "</AccessMode><pPort>Device</pPort><LSB>31</LSB><MSB>16</MSB><Endianess>BigEndian"
        "</Endianess></MaskedIntReg>"
    )
    return with_nodes(nodes, "GevSCPSPacketSize")


@pytest.mark.parametrize(
    ("properties", "size"),
    [
        ("<Min>576</Min><Max>9000</Max><Inc>8</Inc>", 1496),
        ("<Min>576</Min><Max>1400</Max><Inc>4</Inc>", 1400),
        ("<ImposedAccessMode>RO</ImposedAccessMode>", 1500),
    ],
    ids=["step", "limit", "fixed"],
)
def test_a_packet_has_a_size_that_the_head_allows(properties: str, size: int) -> None:
    # Packets of the loopback interface pass at any size, so the size is limited here.
    with head(packet_size(properties), packet_size_limit=1500) as (_, driver, memory):
        assert driver.bind()["packet_size"] == str(size)
        _, pixels = first_frame(driver, memory)
        assert pixels.any()


def test_a_packet_size_beyond_the_heads_limit_is_refused() -> None:
    text = packet_size("<Min>576</Min><Max>1400</Max><Inc>4</Inc>")
    found = refusal_of(text, packet_size=8192)
    assert "packet_size is 8192; the head takes at most 1400" in found


def thermometer(unit: str) -> str:
    nodes = (
        f'<Float Name="DeviceTemperature">{unit}<pValue>Tenths</pValue></Float>'
        '<Converter Name="Tenths"><FormulaTo>FROM * 10</FormulaTo><FormulaFrom>TO / 10'
        "</FormulaFrom><pValue>TenthsReg</pValue></Converter>"
    )
    return with_nodes(nodes + register("TenthsReg", PLACE, "RO"), "DeviceTemperature")


@pytest.mark.parametrize(
    ("unit", "tenths", "shown"),
    [
        ("<Unit>K</Unit>", 3100, "36.9 degC"),
        ("<Unit>F</Unit>", 1040, "40.0 degC"),
        ("<Unit>C</Unit>", 415, "41.5 degC"),
        ("", 415, "41.5 degC"),
    ],
)
def test_a_temperature_is_in_celsius_whatever_the_heads_unit(
    unit: str, tenths: int, shown: str
) -> None:
    with head(thermometer(unit)) as (emulated, driver, _):
        emulated.registers.nodes.write("TenthsReg", tenths)
        assert driver.bind()["temperature"] == shown


def test_a_delay_in_a_unit_that_is_no_time_is_refused_and_zero_is_written() -> None:
    text = with_nodes(
        number("TriggerDelay", PLACE, 100).replace("<pValue>", "<Unit>ticks</Unit><pValue>", 1),
        "TriggerDelay",
    )
    with head(text) as (emulated, driver, _):
        emulated.registers.nodes.write("TriggerDelayReg", 7)
        driver.bind()
        assert emulated.registers.nodes.number("TriggerDelayReg") == 0
    assert "TriggerDelay in 'ticks', which is no time" in refusal_of(text, trigger_delay_us=12.5)

"""The unit of a head's gain: read from its description, converted and recorded, or refused.

Descriptions are variants of `small_camera.xml`. Source: GenICam SFNC 2.7, Gain (unit "-").
"""

from __future__ import annotations

import math
from typing import Final

import pytest

from daemon.products.exposure_conditions import gain_factor
from drivers.contract import DeviceError
from tests.drivers.described_frames import first_frame
from tests.drivers.test_head_features import enumeration, register, running
from tests.drivers.test_odd_descriptions import head, with_nodes, without

pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
pytestmark = pytest.mark.timeout(120)

STANDARD: Final = "This is an amplification factor to be applied to the video signal."


def gain(properties: str, lowest: float = 0) -> str:
    """A gain in tenths in its register, up to 24."""
    nodes = (
        f'<Float Name="Gain">{properties}<pValue>GainTenths</pValue><Min>{lowest}</Min>'
        '<Max>24</Max></Float><Converter Name="GainTenths"><FormulaTo>FROM * 10</FormulaTo>'
        "<FormulaFrom>TO / 10</FormulaFrom><pValue>GainTenthsReg</pValue></Converter>"
    )
    return with_nodes(nodes + register("GainTenthsReg", 0x10100), "Gain", text=without("Gain"))


def unit(text: str) -> str:
    return f"<Unit>{text}</Unit>"


def tool_tip(text: str) -> str:
    return f"<ToolTip>{text}</ToolTip>"


@pytest.mark.parametrize(
    ("properties", "lowest", "stated", "held", "recorded"),
    [
        (unit("dB"), 0, "", 60, "dB"),
        (unit("db"), 0, "", 60, "dB"),
        (unit("[dB]"), 0, "", 60, "dB"),
        (unit("x"), 1, "", 19, "factor"),
        (tool_tip("Gain value. Units are usually in dB."), 0, "", 60, "dB"),
        (tool_tip(STANDARD), 1, "", 19, "factor"),
        ("", 0, "dB", 60, "dB"),
        (unit("raw"), 0, "factor", 19, "factor"),
    ],
    ids=["dB", "lower-case", "brackets", "x", "text-dB", "text-factor", "stated", "stated-factor"],
)
def test_a_gain_in_a_known_unit_is_written_and_recorded_with_it(
    properties: str, lowest: float, stated: str, held: int, recorded: str
) -> None:
    with head(gain(properties, lowest), gain_db=6.0, gain_unit=stated) as (
        emulated,
        driver,
        memory,
    ):
        driver.bind()
        assert emulated.registers.nodes.number("GainTenthsReg") == held
        frame, _ = first_frame(driver, memory)
        assert frame.settings["Gain"] == held / 10
        assert frame.settings["GainUnit"] == recorded
        assert 20.0 * math.log10(gain_factor(frame.settings)) == pytest.approx(6.0, abs=0.5)


@pytest.mark.parametrize(
    ("properties", "shown"),
    [
        ("", "it has Gain without a unit"),
        (unit("raw"), "it has Gain in 'raw'"),
        (unit("%"), "it has Gain in '%'"),
        (tool_tip("Gain in steps of 0.1 dB"), "it has Gain without a unit"),
        (tool_tip(STANDARD), "it has Gain without a unit"),
    ],
    ids=["none", "raw", "percent", "steps", "factor-from-zero"],
)
def test_a_gain_in_an_unknown_unit_is_its_lowest_and_recorded_so(
    properties: str, shown: str
) -> None:
    text = gain(properties)
    with head(text) as (emulated, driver, memory):
        emulated.registers.nodes.write("GainTenthsReg", 120)
        driver.bind()
        assert emulated.registers.nodes.number("GainTenthsReg") == 0
        with running(driver), pytest.raises(DeviceError, match="the head has no gain in dB"):
            driver.adjust(2000.0, 3.0, 0)
    with head(text, features={"Gain": 12.0}) as (_, driver, memory):
        driver.bind()
        frame, _ = first_frame(driver, memory)
        assert frame.settings["Gain"] == 12.0
        assert frame.settings["GainUnit"] == "unknown"
        assert gain_factor(frame.settings) == 1.0
    with (
        pytest.raises(DeviceError, match=f"{shown}; set gain_db = 0, or gain_unit to dB or factor"),
        head(text, gain_db=6.0) as (_, driver, _memory),
    ):
        driver.bind()


def test_a_gain_in_a_known_unit_is_no_feature_of_the_configuration() -> None:
    with (
        pytest.raises(DeviceError, match="set gain_db and gain_unit"),
        head(gain(unit("dB")), features={"Gain": 12.0}) as (_, driver, _memory),
    ):
        driver.bind()


def test_a_gain_between_the_steps_of_a_head_is_rounded_and_recorded_as_held() -> None:
    with head(gain(unit("dB")), gain_db=3.47) as (_, driver, memory):
        driver.bind()
        with running(driver):
            driver.adjust(1000.0, 7.89, 0)
    with head(gain(unit("dB")), gain_db=3.47) as (_, driver, memory):
        driver.bind()
        frame, _ = first_frame(driver, memory)
        assert frame.settings["Gain"] == pytest.approx(3.47, abs=0.1)


@pytest.mark.parametrize(("lowest", "held"), [(0.5, 10), (1, 10), (2, 20)])
def test_no_gain_is_the_factor_one_or_the_heads_lowest_above_it(lowest: float, held: int) -> None:
    with head(gain(unit("x"), lowest)) as (emulated, driver, _):
        driver.bind()
        assert emulated.registers.nodes.number("GainTenthsReg") == held


def test_a_gain_with_named_steps_is_left_and_recorded() -> None:
    text = with_nodes(enumeration("Gain", 0x10100, "Low", "High"), "Gain", text=without("Gain"))
    with head(text) as (emulated, driver, _):
        emulated.registers.nodes.write("GainReg", 1)
        assert "Gain = " in driver.bind()["features"]
    with (
        pytest.raises(DeviceError, match="the head has no gain in dB"),
        head(text, gain_db=3.0) as (_, driver, _memory),
    ):
        driver.bind()


@pytest.mark.parametrize(
    ("settings", "factor"),
    [
        ({"Gain": 6.0, "GainUnit": "dB"}, 1.9953),
        ({"Gain": 0.0, "GainUnit": "dB"}, 1.0),
        ({"Gain": 4.0, "GainUnit": "factor"}, 4.0),
        ({"Gain": 4.0, "GainUnit": "unknown"}, 1.0),
        ({"Gain": 4.0}, 4.0),
        ({"GainRaw": 12}, 1.0),
    ],
)
def test_the_factor_of_a_recorded_gain(
    settings: dict[str, float | int | str], factor: float
) -> None:
    assert gain_factor(settings) == pytest.approx(factor, rel=1e-4)

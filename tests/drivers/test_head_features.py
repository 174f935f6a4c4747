"""Features of real heads on an emulated one: pixel formats, triggers, strobe, presets, chunks.

Every value that is written is read from the head's registers, every format is compared by pixels.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from daemon.mission.log.log_records import message_of, record_of
from drivers.cameras.aravis.aravis_head import AravisHead
from drivers.cameras.aravis.formats import usual_format
from drivers.cameras.aravis.presets import preset_features, preset_names
from drivers.contract import DeviceError, DeviceEvent, LifeCycle, Record
from tests.drivers.described_frames import WITHIN_S, first_frame
from tests.drivers.test_odd_descriptions import TEXT, head, with_nodes, without

pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
pytestmark = pytest.mark.timeout(120)

SENSOR_BITS = 12
BAYER = {
    **{"BayerRG8": 0x0108_0009, "BayerGB10": 0x0110_000E, "BayerRG12": 0x0110_0011},
    **{"BayerBG10p": 0x010A_0052, "BayerRG12p": 0x010C_0059, "BayerGR12Packed": 0x010C_002A},
    **{"BayerRG16": 0x0110_002F, "Mono16": 0x0110_0007},
    **{"BayerGR10Packed": 0x010C_0026, "BayerRG10Packed": 0x010C_0027},
    **{"BayerGB10Packed": 0x010C_0028, "BayerBG10Packed": 0x010C_0029},
    **{"BayerRG12Packed": 0x010C_002B, "BayerGB12Packed": 0x010C_002C},
    **{"BayerBG12Packed": 0x010C_002D},
}
"""Codes of pixel formats. Source: PFNC 2.4, table of values."""


def register(name: str, address: int, access: str = "RW") -> str:
    return (
        f'<IntReg Name="{name}"><Address>{address}</Address><Length>4</Length>'
        f"<AccessMode>{access}</AccessMode><pPort>Device</pPort>"
        "<Endianess>BigEndian</Endianess></IntReg>"
    )


def enumeration(name: str, address: int, *entries: str) -> str:
    listed = "".join(
        f'<EnumEntry Name="{entry}"><Value>{value}</Value></EnumEntry>'
        for value, entry in enumerate(entries)
    )
    return (
        f'<Enumeration Name="{name}">{listed}<pValue>{name}Reg</pValue></Enumeration>'
        + register(f"{name}Reg", address)
    )


def number(name: str, address: int, highest: int) -> str:
    return (
        f'<Integer Name="{name}"><pValue>{name}Reg</pValue><Min>0</Min><Max>{highest}</Max>'
        "</Integer>" + register(f"{name}Reg", address)
    )


def with_formats(*formats: str) -> str:
    """The description with further pixel formats."""
    entries = "".join(
        f'<EnumEntry Name="{name}"><Value>{BAYER[name]}</Value></EnumEntry>' for name in formats
    )
    start = '<Enumeration Name="PixelFormat">'
    return TEXT.replace(start, start + entries)


@contextmanager
def running(driver: AravisHead) -> Iterator[list[Record]]:
    """The driver while it delivers; its records."""
    records: list[Record] = []
    thread = threading.Thread(target=driver.run, args=(records.append,))
    thread.start()
    try:
        deadline = time.monotonic() + WITHIN_S
        while driver.state is not LifeCycle.ACTIVE and time.monotonic() < deadline:
            time.sleep(0.01)
        assert driver.state is LifeCycle.ACTIVE
        yield records
    finally:
        driver.close()
        thread.join(WITHIN_S)


@pytest.mark.parametrize("pixel_format", BAYER)
def test_bayer_and_wide_formats_pixel_by_pixel(pixel_format: str) -> None:
    with head(with_formats(pixel_format), pixel_format=pixel_format) as (emulated, driver, memory):
        driver.bind()
        frame, pixels = first_frame(driver, memory)
        assert emulated.last_image is not None
        bits = int("".join(c for c in pixel_format if c.isdigit()))
        assert frame.pixel_format == pixel_format
        assert np.array_equal(pixels, emulated.last_image >> max(0, SENSOR_BITS - bits))


@pytest.mark.parametrize("pixel_format", ["Mono16", "BayerRG16"])
def test_sixteen_bits_with_the_upper_byte_first(pixel_format: str) -> None:
    with head(
        with_formats(pixel_format),
        big_endian_words=True,
        pixel_format=pixel_format,
        byte_order="big",
    ) as (emulated, driver, memory):
        driver.bind()
        _, pixels = first_frame(driver, memory)
        assert emulated.last_image is not None
        assert np.array_equal(pixels, emulated.last_image)


def test_a_colour_head_sends_its_raw_pixels() -> None:
    with head(with_formats("Mono16", "BayerRG16")) as (_, driver, _memory):
        assert driver.bind()["frame"].endswith("BayerRG16")
    assert usual_format(["Mono16", "BayerRG16", "BayerGR16"]) == "Mono16"
    assert usual_format(["Mono16", "BayerRG12", "BayerGR12"], "BayerGR") == "BayerGR12"
    assert usual_format(["Mono12", "BayerRG12"], "None") == "Mono12"


def test_a_raw_gain_is_not_taken_for_decibels() -> None:
    with head(TEXT) as (emulated, driver, _):
        driver.bind()
        with running(driver):
            before = emulated.registers.number_or("GainRaw", -1)
            with pytest.raises(DeviceError, match="no gain in dB; it has GainRaw"):
                driver.adjust(2000.0, 6.0, 0)
            assert emulated.registers.number_or("GainRaw", -1) == before
            driver.adjust(2000.0, 0.0, 0)
            assert emulated.registers.number_or("GainRaw", -1) == before
            assert emulated.registers.number_or("ExposureTimeAbs", -1) == 2000.0


def test_a_raw_gain_that_was_chosen_is_kept_and_recorded() -> None:
    with head(TEXT, features={"GainRaw": 90}) as (emulated, driver, memory):
        driver.bind()
        frame, _ = first_frame(driver, memory)
        assert frame.settings["GainRaw"] == 90
        assert emulated.registers.number_or("GainRaw", -1) == 90


def test_a_gain_in_decibels_returns_to_zero() -> None:
    text = without("Gain").replace("GainRaw", "Gain")
    text = text.replace("<Min>3</Min>", "<Min>0</Min><Unit>dB</Unit>")
    with head(text, gain_db=6.0) as (emulated, driver, _):
        driver.bind()
        with running(driver):
            driver.adjust(2000.0, 12.0, 0)
            assert emulated.registers.number_or("Gain", -1) == 12
            driver.adjust(2000.0, 0.0, 0)
            assert emulated.registers.number_or("Gain", -1) == 0


LINES = (
    enumeration("LineSelector", 0x10080, "Line1", "Line2")
    + enumeration("LineMode", 0x10084, "Input", "Output")
    + enumeration("LineSource", 0x10088, "Off", "ExposureActive")
    + enumeration("TriggerActivation", 0x1008C, "RisingEdge", "FallingEdge")
    + number("TriggerDelayAbs", 0x10090, 1000)
    + number("LineDebouncerTimeAbs", 0x10094, 1000)
)
LINE_FEATURES = (
    *("LineSelector", "LineMode", "LineSource", "TriggerActivation", "TriggerDelayAbs"),
    "LineDebouncerTimeAbs",
)


def test_strobe_debouncer_delay_and_edge_are_written_and_a_line_triggers() -> None:
    with head(
        with_nodes(LINES, *LINE_FEATURES),
        trigger_source="line",
        trigger_activation="FallingEdge",
        trigger_delay_us=15.0,
        debounce_us=25.0,
        strobe_line="Line2",
    ) as (emulated, driver, memory):
        found = driver.bind()["features"]
        registers = emulated.registers
        assert registers.symbolic_or("LineSelector", "") == "Line2"
        assert registers.symbolic_or("LineMode", "") == "Output"
        assert registers.symbolic_or("LineSource", "") == "ExposureActive"
        assert registers.symbolic_or("TriggerActivation", "") == "FallingEdge"
        assert registers.symbolic_or("TriggerSource", "") == "Line1"
        assert registers.number_or("TriggerDelayAbs", -1) == 15
        assert registers.number_or("LineDebouncerTimeAbs", -1) == 25
        assert "LineSource = ExposureActive" in found
        assert "TriggerDelayAbs = 15" in found
        assert "LineDebouncerTimeAbs = 25" in found
        _, pixels = first_frame(driver, memory, trigger=emulated.line_pulse)
        assert np.array_equal(pixels, emulated.last_image)


@pytest.mark.parametrize(("wanted_us", "expected"), [(0.0, 4), (50.0, 50)])
def test_a_head_that_needs_some_delay_gets_its_lowest(wanted_us: float, expected: int) -> None:
    delay = number("TriggerDelayAbs", 0x10090, 1000).replace("<Min>0</Min>", "<Min>4</Min>")
    text = with_nodes(delay, "TriggerDelayAbs")
    with head(text, trigger_delay_us=wanted_us) as (emulated, driver, _):
        assert f"TriggerDelayAbs = {expected}" in driver.bind()["features"]
        assert emulated.registers.number_or("TriggerDelayAbs", -1) == expected


def test_an_exposure_time_that_the_head_rounds_is_recorded_as_the_head_holds_it() -> None:
    text = TEXT.replace("FROM / 2", "FROM / 17").replace("TO * 2", "TO * 17")
    with head(text) as (emulated, driver, memory):
        driver.bind()
        held = emulated.registers.number_or("ExposureTimeAbs", -1)
        frame, _ = first_frame(driver, memory)
        assert frame.settings["ExposureTime"] == held
        assert 950 <= held <= 1050
        assert held % 17 == 0


def test_an_output_of_allied_vision_is_active_during_the_exposure() -> None:
    nodes = enumeration("SyncOutSelector", 0x10080, "SyncOut1", "SyncOut2")
    nodes += enumeration("SyncOutSource", 0x10084, "GPO", "Exposing")
    text = with_nodes(nodes, "SyncOutSelector", "SyncOutSource")
    with head(text, strobe_line="SyncOut2") as (emulated, driver, _):
        assert "SyncOutSource = Exposing" in driver.bind()["features"]
        assert emulated.registers.symbolic_or("SyncOutSelector", "") == "SyncOut2"
        assert emulated.registers.symbolic_or("SyncOutSource", "") == "Exposing"


@pytest.mark.parametrize("preset", preset_names())
def test_a_preset_is_written_and_what_the_head_does_not_have_is_skipped(preset: str) -> None:
    chosen = {
        name: value for name, value in preset_features(preset).items() if isinstance(value, str)
    }
    absent = next(iter(chosen))
    nodes, features = "", []
    for place, (name, value) in enumerate(chosen.items()):
        if name != absent or len(chosen) == 1:
            nodes += enumeration(name, 0x100A0 + 4 * place, "Other", value)
            features.append(name)
    with head(with_nodes(nodes, *features), preset=preset) as (emulated, driver, _):
        found = driver.bind()["features"]
        for name in features:
            assert emulated.registers.symbolic_or(name, "") == chosen[name]
            assert f"{name} = {chosen[name]}" in found


def test_what_was_written_and_switched_off_is_in_the_record_of_the_mission() -> None:
    with head(TEXT, features={"BlackLevel": 17}) as (emulated, driver, _):
        emulated.registers.nodes.write("ReverseReg", 1)
        found = driver.bind()["features"]
        with running(driver) as records:
            pass
        (opened,) = (r for r in records if isinstance(r, DeviceEvent) and r.name == "opened")
        assert opened.sentence.endswith("; nothing to do.")
        for name, held in (("ExposureAuto", "Off"), ("ReverseX", 0), ("BlackLevel", 17)):
            assert f"{name} = {held}" in found
            assert opened.settings[name] == held
        assert opened.settings["ExposureTime"] == pytest.approx(1000.0, rel=0.05)
        logged = record_of(message_of(opened))
        assert logged == opened


THERMOMETER = """
 <Float Name="DeviceTemperature"><pValue>Celsius</pValue></Float>
 <SwissKnife Name="Celsius"><pVariable Name="K">KelvinReg</pVariable>
  <Formula>K / 10 - 273</Formula></SwissKnife>""" + register("KelvinReg", 0x10098, "RO")


@pytest.mark.parametrize(("kelvin", "expected"), [(0, ""), (3000, "27.0 degC"), (9000, "")])
def test_an_impossible_temperature_is_no_reading_and_is_counted(kelvin: int, expected: str) -> None:
    with head(with_nodes(THERMOMETER, "DeviceTemperature")) as (emulated, driver, memory):
        emulated.registers.nodes.write("KelvinReg", kelvin)
        assert driver.bind()["temperature"] == expected
        frame, _ = first_frame(driver, memory)
        assert (frame.temperature_c is None) == (not expected)
        assert (driver.statistics()["temperatures_implausible"] > 0) == (not expected)


CHUNK_MODE = '<Boolean Name="ChunkModeActive"><pValue>ChunkModeReg</pValue></Boolean>' + register(
    "ChunkModeReg", 0x100C0
)
CHUNK_SELECTOR = enumeration("ChunkSelector", 0x100C4, "Image", "Timestamp").replace(
    'Name="ChunkSelector">', 'Name="ChunkSelector"><pIsAvailable>ChunkModeReg</pIsAvailable>'
)
CHUNK_ENABLE = '<Boolean Name="ChunkEnable"><pValue>ChunkEnableReg</pValue></Boolean>'


@pytest.mark.parametrize(
    ("nodes", "features", "expected"),
    [
        ("", (), "no: the head has no feature ChunkModeActive"),
        (CHUNK_MODE, ("ChunkModeActive",), "no: the description has no ChunkSelector, which"),
        (
            CHUNK_MODE + CHUNK_SELECTOR + CHUNK_ENABLE + register("ChunkEnableReg", 0x100C8),
            ("ChunkModeActive", "ChunkSelector", "ChunkEnable"),
            "Timestamp",
        ),
        (
            CHUNK_MODE + CHUNK_SELECTOR + CHUNK_ENABLE + register("ChunkEnableReg", 0x100C8, "RO"),
            ("ChunkModeActive", "ChunkSelector", "ChunkEnable"),
            "no: ChunkEnable is False and read-only",
        ),
    ],
    ids=["none", "unnamed", "once-active", "refused"],
)
def test_chunks_are_named_or_the_reason_is(
    nodes: str, features: tuple[str, ...], expected: str
) -> None:
    with head(with_nodes(nodes, *features)) as (emulated, driver, _):
        assert driver.bind()["chunks"].startswith(expected)
        is_active = emulated.registers.number_or("ChunkModeActive", 0)
        assert is_active == (expected == "Timestamp")


def test_a_head_above_its_limit_is_reported_once_until_it_has_cooled() -> None:
    text = with_nodes(THERMOMETER, "DeviceTemperature")
    with head(text, temperature_max_c=60.0) as (_, driver, _memory):
        driver.bind()
        reported: list[Record] = []
        driver.emitter.sink = reported.append
        for value_c in (59.0, 60.5, 70.0, None, 59.0, 61.0, 57.0, 60.0, 60.1):
            driver._check_temperature(value_c)
        sentences = [r.sentence for r in reported if isinstance(r, DeviceEvent) and r.name == "hot"]
        assert [s.partition(" has ")[2][:9] for s in sentences] == ["60.5 degC", "60.1 degC"]
        assert all("its limit is 60 degC" in s for s in sentences)


def test_a_hot_head_is_reported_while_it_delivers() -> None:
    text = with_nodes(THERMOMETER, "DeviceTemperature")
    with head(text, temperature_max_c=60.0) as (emulated, driver, _memory):
        emulated.registers.nodes.write("KelvinReg", 3500)
        driver.bind()
        came = threading.Event()

        def watch(record: Record) -> None:
            if isinstance(record, DeviceEvent) and record.name == "hot":
                came.set()

        thread = threading.Thread(target=driver.run, args=(watch,))
        thread.start()
        try:
            assert came.wait(WITHIN_S)
        finally:
            driver.close()
            thread.join(WITHIN_S)

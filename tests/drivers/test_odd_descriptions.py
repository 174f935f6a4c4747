"""Descriptions as cameras have them, and broken ones: armed, or refused with the true reason.

Each is a variant of `small_camera.xml`, served by the emulated head.
"""

from __future__ import annotations

import io
import os
import re
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from drivers.cameras.aravis.aravis_head import AravisHead
from drivers.cameras.aravis.description_cycles import (
    DescriptionUnreadableError,
    features_with_cycles,
)
from drivers.contract import DeviceError, FrameStatus
from sim_hw.gige.described_head import DescribedHead
from sim_hw.gige.genicam.description_file import DescriptionError, read_description
from tests.drivers.described_frames import Memory, first_frame
from tests.drivers.test_head_configuration import DESCRIPTION
from tests.support.genicam_descriptions import description, names, needs_descriptions

pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
pytestmark = pytest.mark.timeout(120)

ADDRESS = f"127.{1 + os.getpid() % 250}.82.1"
TEXT = DESCRIPTION.decode("utf-8")
BURST_LENGTH = """
 <Integer Name="AcquisitionBurstFrameCount"><pValue>BurstReg</pValue>
  <Min>{lowest}</Min><Max>100</Max></Integer>
 <IntReg Name="BurstReg"><Address>0x10060</Address><Length>4</Length>
  <AccessMode>{access}</AccessMode><pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
"""
LOOP = """
 <IntSwissKnife Name="LoopA"><pVariable Name="B">LoopB</pVariable>
  <Formula>B</Formula></IntSwissKnife>
 <IntSwissKnife Name="LoopB"><pVariable Name="A">LoopA</pVariable>
  <Formula>A</Formula></IntSwissKnife>
"""


def without(name: str, text: str = TEXT) -> str:
    """The description without a feature."""
    found = re.sub(
        rf'<(?!EnumEntry)(\w+) Name="{name}">.*?</\1>', "", text, count=1, flags=re.DOTALL
    )
    assert found != text
    return found.replace(f"<pFeature>{name}</pFeature>", "")


def with_nodes(nodes: str, *features: str, text: str = TEXT) -> str:
    """The description with further nodes, listed as features."""
    listed = "".join(f"<pFeature>{feature}</pFeature>" for feature in features)
    text = text.replace('<Category Name="All">', f'<Category Name="All">{listed}')
    return text.replace("</RegisterDescription>", f"{nodes}</RegisterDescription>")


def burst_only(lowest: int = 1, access: str = "RW") -> str:
    text = TEXT.replace('"FrameStart"', '"FrameBurstStart"')
    nodes = BURST_LENGTH.format(lowest=lowest, access=access)
    return with_nodes(nodes, "AcquisitionBurstFrameCount", text=text)


def zipped(text: str, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", method) as file:
        file.writestr("camera.xml", text)
    return archive.getvalue()


@contextmanager
def head(
    text: str | bytes, *, big_endian_words: bool = False, **settings: object
) -> Iterator[tuple[DescribedHead, AravisHead, Memory]]:
    data = text.encode("utf-8") if isinstance(text, str) else text
    emulated = DescribedHead(ADDRESS, data, big_endian_words=big_endian_words)
    emulated.start()
    memory = Memory()
    try:
        driver = AravisHead(
            "SU00", {"address": ADDRESS, "trigger_source": "software", **settings}, memory=memory
        )
        try:
            yield emulated, driver, memory
        finally:
            driver.close()
    finally:
        emulated.close()


def refusal_of(text: str | bytes, **settings: object) -> str:
    with pytest.raises(DeviceError) as refusal, head(text, **settings) as (_, driver, _memory):
        driver.bind()
    return str(refusal.value)


@pytest.mark.parametrize(
    "text",
    [
        burst_only(),
        burst_only(access="RO"),
        zipped(TEXT),
        zipped(TEXT, zipfile.ZIP_STORED),
        TEXT.encode("utf-8") + b"\0\0\r\n",
        b"<!-- saved -->" + TEXT.partition("?>")[2].encode("utf-8"),
        TEXT.replace('encoding="utf-8"', 'encoding="ISO-8859-1"')
        .replace('ToolTip=""', 'ToolTip="25 \xb0C"')
        .encode("latin-1"),
        with_nodes(LOOP, text=TEXT.replace(
            '<Integer Name="OffsetX">', '<Integer Name="OffsetX"><pIsLocked>LoopA</pIsLocked>')),
    ],
    ids=["burst", "burst-of-one", "zip", "stored", "trailing", "comment", "latin-1",
         "cycle-elsewhere"],
)  # fmt: skip
def test_it_is_armed_and_sends_the_pattern(text: str | bytes) -> None:
    with head(text) as (emulated, driver, memory):
        driver.bind()
        frame, pixels = first_frame(driver, memory)
        assert emulated.last_image is not None
        assert np.array_equal(pixels, emulated.last_image)
        assert frame.pixel_format == "Mono12"
        if "FrameBurstStart" in str(text):
            assert emulated.registers.number_or("AcquisitionBurstFrameCount", -1) == 1
            assert emulated.registers.symbolic_or("TriggerSelector", "") == "FrameBurstStart"


ABSENT = """
 <IntReg Name="ReverseInq"><Address>0x10070</Address><Length>4</Length><AccessMode>RO</AccessMode>
  <pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>"""


@pytest.mark.parametrize(
    "where", ['<Boolean Name="ReverseX">', '<IntReg Name="ReverseReg">'], ids=["feature", "value"]
)
def test_what_a_head_does_not_implement_is_left_alone(where: str) -> None:
    """A family shares one description; presence is stated of a feature, or of its register."""
    condition = f"{where}<pIsImplemented>ReverseInq</pIsImplemented>"
    text = with_nodes(ABSENT, text=TEXT.replace(where, condition))
    with head(text) as (emulated, driver, memory):
        nodes = emulated.registers.nodes
        nodes.write("ReverseInq", 0)
        nodes.write("ReverseReg", 1)
        found = driver.bind()
        frame, _ = first_frame(driver, memory)
        assert frame.status is FrameStatus.COMPLETE
        assert "ReverseX" not in found["features"]
        assert not emulated.registers.refused
    with (
        pytest.raises(DeviceError, match="the head has no feature ReverseX"),
        head(text, features={"ReverseX": True}) as (emulated, driver, _),
    ):
        emulated.registers.nodes.write("ReverseInq", 0)
        driver.bind()


def test_a_trigger_mode_that_only_the_frame_trigger_has_is_found() -> None:
    of_frames = """<IntSwissKnife Name="OfFrames"><pVariable Name="S">SelectorReg</pVariable>
     <Formula>S = 1</Formula></IntSwissKnife>"""
    text = TEXT.replace(
        '<Enumeration Name="TriggerMode">',
        '<Enumeration Name="TriggerMode"><pIsImplemented>OfFrames</pIsImplemented>',
    )
    with head(with_nodes(of_frames, text=text)) as (emulated, driver, _):
        emulated.registers.nodes.write("SelectorReg", 0)
        driver.bind()
        assert emulated.registers.symbolic_or("TriggerMode", "") == "On"


def test_an_exposure_time_in_seconds_is_written_in_seconds() -> None:
    text = TEXT.replace(
        '<Float Name="ExposureTimeAbs">', '<Float Name="ExposureTimeAbs"><Unit>s</Unit>'
    )
    with head(text, exposure_time_us=2e7) as (emulated, driver, memory):
        driver.bind()
        assert emulated.registers.number_or("ExposureTimeAbs", -1) == 20.0
        frame, _ = first_frame(driver, memory)
        assert frame.settings["ExposureTime"] == 2e7


def test_a_mode_of_exposure_in_the_makers_own_words_is_kept() -> None:
    nodes = """
     <Enumeration Name="ExposureMode"><EnumEntry Name="TriggerWidth"><Value>0</Value></EnumEntry>
      <EnumEntry Name="{own}"><Value>1</Value></EnumEntry>
      <pValue>ModeOfExposure</pValue></Enumeration>
     <IntReg Name="ModeOfExposure"><Address>0x10064</Address><Length>4</Length>
      <AccessMode>RW</AccessMode><pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>"""
    with head(with_nodes(nodes.format(own="EdgePreSelect"), "ExposureMode")) as (
        emulated,
        driver,
        _,
    ):
        driver.bind()
        assert emulated.registers.symbolic_or("ExposureMode", "") == "EdgePreSelect"
    found = refusal_of(with_nodes(nodes.format(own="TriggerControlled"), "ExposureMode"))
    assert "has no timed exposure mode (ExposureMode has TriggerWidth, Trigger" in found


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            TEXT.replace(
                '<Enumeration Name="TriggerSource"><EnumEntry Name="Software"><Value>0<',
                '<Enumeration Name="TriggerSource"><ImposedAccessMode>RO</ImposedAccessMode>'
                '<EnumEntry Name="Other"><Value>0</Value></EnumEntry>'
                '<EnumEntry Name="Software"><Value>9<',
            ),
            "its trigger source is fixed at Other",
        ),
        (
            TEXT.replace('"Continuous"><Value>0', '"Permanent"><Value>0'),
            "the mode Continuous is needed",
        ),
        (without("TriggerSoftware"), 'no command TriggerSoftware, set trigger_source = "line"'),
        (without("PayloadSize"), "the head has no feature PayloadSize"),
        (without("Width"), "the head has no feature Width"),
        (without("AcquisitionStart"), "the head has no command AcquisitionStart"),
        (burst_only(2), "the head starts bursts of frames only"),
        (
            TEXT.replace('"FrameStart"', '"FrameBurstStart"'),
            "FrameStart or AcquisitionBurstFrameCount is needed",
        ),
        (TEXT.replace('"FrameStart"', '"LineStart"'), "LineStart, where FrameStart is needed"),
        (zipped(TEXT, zipfile.ZIP_BZIP2), "description cannot be read (Invalid Genicam data)"),
        (
            TEXT.replace('ToolTip=""', 'ToolTip="25 \xb0C"').encode("latin-1"),
            "description cannot be read (Invalid Genicam data); update its firmware",
        ),
        (
            with_nodes(LOOP, text=TEXT.replace(
                '<Float Name="ExposureTimeAbs"><pIsLocked>ExposureLocked',
                '<Float Name="ExposureTimeAbs"><pIsLocked>LoopA')),
            "its description refers to itself (ExposureTimeAbs, LoopA, LoopB); update its",
        ),
        (
            TEXT.replace('<Float Name="ExposureTimeAbs">',
                         '<Float Name="ExposureTimeAbs"><ImposedAccessMode>RO</ImposedAccessMode>'),
            "its exposure time is fixed, set exposure_time_us = 5000",
        ),
    ],
    ids=["source", "acquisition", "software", "payload", "width", "start", "burst-of-two",
         "burst-endless", "line", "bzip2", "encoding", "cycle", "fixed-exposure"],
)  # fmt: skip
def test_it_is_refused_with_the_true_reason(text: str | bytes, expected: str) -> None:
    found = refusal_of(text)
    assert expected in found
    assert "power, cable" not in found


def test_a_gain_that_is_fixed_is_refused_with_its_value_and_accepted_at_it() -> None:
    text = without("Gain").replace('Name="GainRaw"', 'Name="Gain"').replace("GainRaw", "Gain")
    text = text.replace('<Integer Name="Gain">', '<Integer Name="Gain"><Unit>dB</Unit>')
    text = text.replace(
        "0x1001C</Address><Length>4</Length><AccessMode>RW",
        "0x1001C</Address><Length>4</Length><AccessMode>RO",
    )
    assert "its gain cannot be set; set gain_db = 3" in refusal_of(text, gain_db=6.0)
    with head(text, gain_db=3.0) as (_, driver, _memory):
        driver.bind()


@pytest.mark.parametrize(
    ("feature", "value", "link"),
    [
        ("GevLinkSpeed", 100, "100 Mbit/s"),
        ("DeviceLinkSpeed", 125_000_000, "1000 Mbit/s"),
        ("GevLinkSpeed", 0, ""),
    ],
)
def test_the_rate_of_its_own_link_is_reported(feature: str, value: int, link: str) -> None:
    node = f'<Integer Name="{feature}"><Value>{value}</Value></Integer>'
    with head(with_nodes(node, feature)) as (_, driver, _memory):
        assert driver.bind()["link"] == link


@needs_descriptions
def test_no_real_description_refers_to_itself() -> None:
    for name in names():
        stored = description(name)
        # Some have text around the XML, which its reader skips.
        xml = stored[stored.find(b"<") : stored.rfind(b">") + 1]
        assert features_with_cycles(xml) == frozenset(), name


def test_limits_of_each_other_are_no_cycle_and_values_of_each_other_are() -> None:
    rate = '<Float Name="Rate"><pValue>R</pValue><pMax>RateMax</pMax></Float><FloatReg Name="R"/>'
    time = '<Float Name="Time"><pValue>T</pValue><pMax>TimeMax</pMax></Float><FloatReg Name="T"/>'
    knife = '<SwissKnife Name="{}"><pVariable Name="X">{}</pVariable></SwissKnife>'
    limits = knife.format("RateMax", "Time") + knife.format("TimeMax", "Rate")
    assert features_with_cycles(f"<D>{rate}{time}{limits}</D>".encode()) == frozenset()
    of_maxima = limits.replace('Name="X"', 'Name="X.Max"')
    found = features_with_cycles(f"<D>{rate}{time}{of_maxima}</D>".encode())
    assert found == {"Rate", "Time", "RateMax", "TimeMax"}
    entry = '<Enumeration Name="E"><EnumEntry Name="A"><pIsAvailable>K</pIsAvailable></EnumEntry>'
    entry += "<pValue>K</pValue></Enumeration>"
    assert features_with_cycles(f"<D>{entry}{knife.format('K', 'K')}</D>".encode()) == {"E", "K"}
    assert features_with_cycles(f"<D>{entry}{knife.format('K', 'Z')}</D>".encode()) == frozenset()
    chain = '<Integer Name="F"><pValue>R</pValue></Integer><Integer Name="R">{}</Integer>'
    for condition in ("pIsLocked", "pIsAvailable", "pIsImplemented", "pMin", "pMax", "pInc"):
        text = chain.format(f"<{condition}>K</{condition}>") + knife.format("K", "K")
        assert features_with_cycles(f"<D>{text}</D>".encode()) == {"F", "R", "K"}, condition
    text = chain.format("<pSelected>K</pSelected>") + knife.format("K", "K")
    assert features_with_cycles(f"<D>{text}</D>".encode()) == {"K"}
    for wrong in (b"<D>", b"<D/>", b""):
        with pytest.raises(DescriptionUnreadableError):
            features_with_cycles(wrong)


def test_a_file_that_is_no_description_is_refused_by_the_emulator() -> None:
    for data in (b"", b"PK\3\4broken", b"<a/>", b"no xml", TEXT[:3000].encode("utf-8")):
        with pytest.raises(DescriptionError):
            read_description(data)
    marked = TEXT.replace('encoding="utf-8"', 'encoding="UTF-16"').encode("utf-16")
    assert read_description(marked).model == "Small"
    assert read_description(zipped(TEXT)).file_name == "head.zip"
    assert read_description(DESCRIPTION).file_name == "head.xml"

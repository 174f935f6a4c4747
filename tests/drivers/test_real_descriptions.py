"""The head driver against the descriptions of real cameras, served on the wire.

Which of them must arm is decided by the reference implementation of GenApi, not by Aravis: a
camera arms if it has a start of acquisition, a format we decode, an exposure time that may be
written, and a frame trigger. Every other one is refused with a sentence that names what is missing.
"""

from __future__ import annotations

import functools
import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from drivers.cameras.aravis.aravis_head import AravisHead
from drivers.cameras.aravis.formats import packing_of
from drivers.contract import (
    DeviceError,
    FrameStatus,
)
from sim_hw.gige.described_head import DescribedHead
from sim_hw.gige.described_registers import SparseMemory
from sim_hw.gige.genicam.description_file import read_description
from sim_hw.gige.genicam.node_map import NodeMap
from sim_hw.gige.genicam.power_on_state import (
    InitialState,
    write_power_on_state,
)
from tests.drivers.described_frames import Memory, first_frame
from tests.support.genicam_descriptions import description, names, needs_descriptions
from tests.support.genicam_reference import Port, genapi

pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
pytestmark = [needs_descriptions, pytest.mark.timeout(180)]

NETWORK = f"127.{1 + os.getpid() % 250}.79"
SENSOR_BITS = 12
EXPOSURE_TIME_US = 1000.0
EXPOSURES = ("ExposureTime", "ExposureTimeAbs", "ExposureTimeRaw")
FRAME_TRIGGERS = {"FrameStart", "ExposureStart", "FrameTrigger"}
MANDATORY = ("AcquisitionStart", "TriggerSoftware", "Width", "Height", "PayloadSize")
MISSING = (*MANDATORY, "pixel format", "PixelFormat", "exposure", "trigger", "Trigger")
ARMED_MIN = 50
"""Of the 62 descriptions, so many must arm; about a dozen are of grabbers and other links."""


@pytest.fixture(autouse=True, scope="module")
def fewer_collections() -> Iterator[None]:
    """A description makes many small objects; looking for cycles in them takes a third of the
    time."""
    before = gc.get_threshold()
    gc.set_threshold(100_000, *before[1:])
    yield
    gc.set_threshold(*before)


@functools.cache
def must_arm(name: str) -> bool:
    """What the reference implementation reports of a camera after power-on."""
    found = read_description(description(name))
    memory = SparseMemory()
    write_power_on_state(NodeMap(found, memory))
    reference = genapi.NodeMap()
    reference.load_xml_from_string(found.xml.decode("utf-8", "replace"))
    port = Port(memory)
    reference.connect(port, "Device")

    def node_of(feature: str) -> Any:
        return reference.get_node(feature) if feature in found.nodes else None

    def is_writable(feature: str) -> bool:
        node = node_of(feature)
        return node is not None and node.get_access_mode() == genapi.EAccessMode.RW

    def entries(feature: str) -> set[str]:
        node = node_of(feature)
        if node is None or node.get_access_mode() not in (
            genapi.EAccessMode.RW,
            genapi.EAccessMode.RO,
        ):
            return set()
        return {entry.symbolic for entry in node.entries if genapi.is_available(entry.node)}

    selectors = entries("TriggerSelector")
    if "FrameStart" in selectors and is_writable("TriggerSelector"):
        reference.get_node("TriggerSelector").value = "FrameStart"
    return (
        all(node_of(name) is not None for name in MANDATORY)
        and any(packing_of(entry) is not None for entry in entries("PixelFormat"))
        and any(is_writable(feature) for feature in EXPOSURES)
        and is_writable("TriggerMode")
        and (
            not selectors
            or bool(selectors & FRAME_TRIGGERS)
            or selectors == {"AcquisitionStart"}
            or ("FrameBurstStart" in selectors and is_writable("AcquisitionBurstFrameCount"))
        )
        and "Software" in entries("TriggerSource")
    )


@contextmanager
def served(
    name: str, state: InitialState, number: int, **settings: object
) -> Iterator[tuple[DescribedHead, AravisHead, Memory]]:
    address = f"{NETWORK}.{1 + number % 250}"
    emulated = DescribedHead(address, description(name), state=state)
    emulated.start()
    memory = Memory()
    driver = AravisHead(
        "SU00",
        {
            "address": address,
            "trigger_source": "software",
            "exposure_time_us": EXPOSURE_TIME_US,
            **settings,
        },
        memory=memory,
    )
    try:
        yield emulated, driver, memory
    finally:
        driver.close()
        emulated.close()


CASES = [(name, state) for name in names() for state in InitialState]


@pytest.mark.parametrize(
    ("name", "state"), CASES, ids=[f"{name}-{state.value}" for name, state in CASES]
)
def test_a_real_camera_arms_or_is_refused_with_what_is_missing(
    name: str, state: InitialState
) -> None:
    with served(name, state, CASES.index((name, state))) as (emulated, driver, memory):
        if not must_arm(name):
            with pytest.raises(DeviceError) as refusal:
                driver.bind()
            assert any(word in str(refusal.value) for word in MISSING), refusal.value
            return
        driver.bind()
        frame, pixels = first_frame(driver, memory)
        assert frame.status is FrameStatus.COMPLETE
        assert emulated.last_image is not None
        bits = int("".join(c for c in frame.pixel_format if c.isdigit())[:2])
        assert np.array_equal(pixels, emulated.last_image >> max(0, SENSOR_BITS - bits))
        exposure_us = frame.settings["ExposureTime"]
        assert isinstance(exposure_us, float)
        assert exposure_us == pytest.approx(EXPOSURE_TIME_US, rel=0.02)
        assert emulated.registers.symbolic_or("ExposureAuto", "Off") == "Off"
        assert emulated.registers.symbolic_or("GainAuto", "Off") == "Off"
        assert emulated.registers.symbolic_or("TestPattern", "Off") == "Off"
        for mirrored in ("ReverseX", "ReverseY", "OffsetX", "OffsetY"):
            assert emulated.registers.number_or(mirrored, 0) == 0
        for binned in ("BinningHorizontal", "BinningVertical"):
            assert emulated.registers.number_or(binned, 1) <= 1


def test_most_descriptions_are_of_cameras_that_must_arm() -> None:
    assert sum(must_arm(name) for name in names()) >= ARMED_MIN

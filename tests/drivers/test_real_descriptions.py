"""The head driver against the descriptions of real cameras, served on the wire.

What each must offer is decided by the reference implementation of GenApi, not by Aravis: a camera
arms if it has a start of acquisition, a format we decode, an exposure time that may be written, and
a frame trigger. Every other one is refused with one sentence that names what is missing.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Final

import numpy as np
import pytest

from drivers.cameras.aravis.aravis_head import AravisHead
from drivers.contract import (
    DeviceError,
    FrameStatus,
)
from sim_hw.gige import features as registers_at
from sim_hw.gige.described_head import DescribedHead
from sim_hw.gige.genicam.power_on_state import InitialState
from tests.drivers.described_frames import Memory, first_frame
from tests.drivers.real_camera_table import armed_row, refused_row, rows_of_page
from tests.drivers.reference_camera import Offered, offered
from tests.support.genicam_descriptions import description, names, needs_descriptions

pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
pytestmark = [needs_descriptions, pytest.mark.timeout(180)]

NETWORK = f"127.{1 + os.getpid() % 250}.79"
SENSOR_BITS = 12
EXPOSURE_TIME_US = 1000.0
NO_EXPOSURE_TIME: Final = (
    "no feature that sets its exposure time (none of ExposureTime, ExposureTimeAbs, "
    "ExposureTimeRaw, ExposureValue, Exposure)"
)
MODULE: Final = (
    "the head is the {} module of a frame grabber, which is no camera and has no command "
    "AcquisitionStart; choose a GigE Vision or USB3 Vision head"
)
COAXPRESS: Final = (
    "the head is a CoaXPress camera, which needs a frame grabber, and has {}; choose a GigE Vision "
    "or USB3 Vision head"
)
REFUSED: Final = {
    "Euresys_Coaxlink_TLDataStream": MODULE.format("data stream"),
    "Euresys_Coaxlink_TLInterface": MODULE.format("interface"),
    "Euresys_Coaxlink_TLSystem": MODULE.format("system"),
    "FLIR_A35": f"the head has {NO_EXPOSURE_TIME} and no feature TriggerMode, so it cannot be "
    "used; choose another head",
    "Mikrotron_CXP_MC206xS11": COAXPRESS.format("no feature PayloadSize"),
    "Orca_Fire_C16240-20UP": COAXPRESS.format("no feature TriggerMode and no feature PayloadSize"),
    "Tucsen_CXP_Dhyana6060BSI": COAXPRESS.format(
        f"{NO_EXPOSURE_TIME}, no feature TriggerMode and no feature PayloadSize"
    ),
}
"""The whole sentence for each description that is of no head we can use."""
WORDS: Final = ("no feature ", "no command ", "no pixel format", "no trigger ", "no monochrome ")
"""One of them is in the sentence for any other one."""


@pytest.fixture(autouse=True, scope="module")
def fewer_collections() -> Iterator[None]:
    """A description makes many small objects; looking for cycles in them takes a third of the
    time."""
    before = gc.get_threshold()
    gc.set_threshold(100_000, *before[1:])
    yield
    gc.set_threshold(*before)


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


STATES: Final = tuple(InitialState)
CASES: Final = [(name, state) for name in names() for state in STATES]


def _marks(number: int) -> list[pytest.MarkDecorator]:
    """Each camera in one state, in turn; `make soak` has all."""
    camera, state = divmod(number, len(STATES))
    return [] if state == camera % len(STATES) else [pytest.mark.soak]


@pytest.mark.parametrize(
    ("name", "state"),
    [
        pytest.param(name, state, id=f"{name}-{state.value}", marks=_marks(number))
        for number, (name, state) in enumerate(CASES)
    ],
)
def test_a_real_camera_arms_or_is_refused_with_what_is_missing(
    name: str, state: InitialState
) -> None:
    """With automatic functions on, a pulse at a line triggers; else a command."""
    # What another program has left on decides nothing: the driver switches it off.
    expected = offered(name, state if state is InitialState.SPARSE else InitialState.FACTORY)
    by_line = state is InitialState.AUTOMATIC and bool(expected.line)
    source = {"trigger_source": "line", "trigger_line": expected.line} if by_line else {}
    with served(name, state, CASES.index((name, state)), **source) as (emulated, driver, memory):
        if not expected.arms:
            assert_refused(name, driver)
            return
        found = driver.bind()
        assert_as_offered(found, expected, emulated)
        if state is InitialState.FACTORY:
            assert rows_of_page().get(name, armed_row(name, found)) == armed_row(name, found)
        if state is InitialState.SPARSE:
            return
        trigger = emulated.line_pulse if by_line else None
        frame, pixels = first_frame(driver, memory, trigger=trigger)
        assert frame.status is FrameStatus.COMPLETE
        assert emulated.last_image is not None
        bits = int("".join(c for c in frame.pixel_format if c.isdigit())[:2])
        assert np.array_equal(pixels, emulated.last_image >> max(0, SENSOR_BITS - bits))
        exposure_us = frame.settings["ExposureTime"]
        assert isinstance(exposure_us, float)
        assert exposure_us == pytest.approx(EXPOSURE_TIME_US, rel=0.02)
        assert expected.gain in ("", *frame.settings)
        assert emulated.registers.symbolic_or("ExposureAuto", "Off") == "Off"
        assert emulated.registers.symbolic_or("GainAuto", "Off") == "Off"
        assert emulated.registers.symbolic_or("TestPattern", "Off") == "Off"
        for mirrored in ("ReverseX", "ReverseY", "OffsetX", "OffsetY"):
            assert emulated.registers.number_or(mirrored, 0) == 0
        for binned in ("BinningHorizontal", "BinningVertical"):
            assert emulated.registers.number_or(binned, 1) <= 1


def assert_refused(name: str, driver: AravisHead) -> None:
    with pytest.raises(DeviceError) as refusal:
        driver.bind()
    who, _, sentence = str(refusal.value).partition(": ")
    assert who == f"SU00 at {driver.address}"
    assert "\n" not in sentence
    assert sentence == REFUSED.get(name, sentence)
    assert any(word in sentence for word in WORDS), sentence
    row = refused_row(name, sentence)
    assert rows_of_page().get(name, row) == row


def assert_as_offered(found: Mapping[str, str], expected: Offered, emulated: DescribedHead) -> None:
    chunks = "" if found["chunks"].startswith("no: ") else found["chunks"]
    assert set(filter(None, chunks.split(", "))) - {"CounterValue"} == expected.chunks
    assert (found["clock"] != "no") == expected.has_clock
    held = emulated.registers.register(registers_at.STREAM_PACKET_SIZE)
    assert int(found["packet_size"]) == held & registers_at.PACKET_SIZE_MASK


def test_the_page_has_every_description_and_its_own_count_of_armed_ones() -> None:
    rows = rows_of_page()
    assert sorted(rows) == sorted(names())
    armed = {name for name, row in rows.items() if "| armed |" in row}
    assert armed == {name for name in names() if name not in REFUSED}

"""A head whose control another application holds: control channel privilege of GigE Vision.

The other application is a few packets written here. Source: GigE Vision 2.0, 10.6 and 28.33.
"""

from __future__ import annotations

import os
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import pytest

from drivers.cameras.aravis.aravis_head import AravisHead
from drivers.cameras.aravis.description import describe
from drivers.cameras.aravis.discovery import FoundHead
from drivers.contract import DeviceError, DeviceEvent, Record
from sim_hw.gige.described_head import DescribedHead
from tests.drivers.described_frames import Memory, first_frame
from tests.drivers.test_head_configuration import DESCRIPTION

pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
pytestmark = pytest.mark.timeout(120)

ADDRESS: Final = f"127.{1 + os.getpid() % 250}.84.1"
GVCP_PORT: Final = 3956
READ: Final = 0x0080
WRITE: Final = 0x0082
CONTROL_PRIVILEGE: Final = 0x0A00
CONTROL: Final = 0b10
EXCLUSIVE: Final = 0b01
BEAT_S: Final = 0.2


class OtherApplication:
    """Holds the control of a head, and reads a register as its heartbeat."""

    def __init__(self, privilege: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(5.0)
        self._socket.connect((ADDRESS, GVCP_PORT))
        self._request(WRITE, struct.pack(">II", CONTROL_PRIVILEGE, privilege))
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat)
        self._thread.start()

    def end(self) -> None:
        """Release the control."""
        if self._ended.is_set():
            return
        self._ended.set()
        self._thread.join(10.0)
        self._request(WRITE, struct.pack(">II", CONTROL_PRIVILEGE, 0))
        self._socket.close()

    def _beat(self) -> None:
        while not self._ended.wait(BEAT_S):
            self._request(READ, struct.pack(">I", CONTROL_PRIVILEGE))

    def _request(self, command: int, body: bytes) -> None:
        self._socket.send(struct.pack(">BBHHH", 0x42, 0x01, command, len(body), 1) + body)
        answer = self._socket.recv(600)
        assert struct.unpack(">H", answer[:2]) == (0,), "the head refuses the other application"


@contextmanager
def held_head(
    privilege: int, *, control_wait_limit_s: float = 1.0
) -> Iterator[tuple[AravisHead, OtherApplication, Memory]]:
    emulated = DescribedHead(ADDRESS, DESCRIPTION)
    emulated.start()
    other = OtherApplication(privilege)
    memory = Memory()
    settings = {
        "address": ADDRESS,
        "trigger_source": "software",
        "control_wait_limit_s": control_wait_limit_s,
    }
    try:
        driver = AravisHead("SU00", settings, memory=memory)
        try:
            yield driver, other, memory
        finally:
            driver.close()
    finally:
        other.end()
        emulated.close()


@pytest.mark.parametrize("privilege", [CONTROL, EXCLUSIVE], ids=["control", "exclusive"])
def test_a_head_that_another_application_controls_is_refused_with_the_cure(
    privilege: int,
) -> None:
    events: list[DeviceEvent] = []

    def sink(record: Record) -> None:
        if isinstance(record, DeviceEvent):
            events.append(record)

    with held_head(privilege) as (driver, _other, _memory), pytest.raises(DeviceError) as refusal:
        driver.bind(sink)
    assert str(refusal.value) == (
        f"SU00 at {ADDRESS}: another program has had control of the head for 1 s, so it is "
        "running; end that program"
    )
    assert [event.name for event in events] == ["held-by-another"]
    assert "Another controller has control of the head SU00" in events[0].sentence
    assert "Retrying automatically for up to 1 s" in events[0].sentence


def test_a_head_that_is_released_while_it_is_waited_for_is_armed() -> None:
    with held_head(CONTROL, control_wait_limit_s=60.0) as (driver, other, memory):
        timer = threading.Timer(1.0, other.end)
        timer.start()
        try:
            driver.bind()
        finally:
            timer.join(20.0)
        first_frame(driver, memory)


@pytest.mark.parametrize(
    ("privilege", "sentence"),
    [
        (CONTROL, "another program controls the head; end that program"),
        (EXCLUSIVE, "another program has exclusive access to the head; end that program"),
    ],
    ids=["control", "exclusive"],
)
def test_a_head_that_is_described_for_a_new_configuration_is_refused_alike(
    privilege: int, sentence: str
) -> None:
    with held_head(privilege), pytest.raises(DeviceError) as refusal:
        describe(FoundHead(ADDRESS, "Syntopic", "Small", "", "GigEVision"))
    assert str(refusal.value).endswith(sentence)

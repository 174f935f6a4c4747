"""Frames of an emulated head that is given by its description."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.aravis.aravis_head import AravisHead
from drivers.contract import CHUNK_ALLOWANCE_NBYTES, DeviceEvent, Frame, LifeCycle, Record
from sim_hw.gige.genicam.power_on_state import SENSOR_HEIGHT_PX, SENSOR_WIDTH_PX

WITHIN_S: Final = 30.0
ATTEMPTS: Final = 4


class Memory:
    """Slots for frames of the emulated sensor."""

    slot_count = 3
    slot_nbytes = 4 * SENSOR_WIDTH_PX * SENSOR_HEIGHT_PX * 2 + CHUNK_ALLOWANCE_NBYTES

    def __init__(self) -> None:
        self.slots = np.zeros((self.slot_count, self.slot_nbytes), np.uint8)

    def address(self, slot: int) -> int:
        return int(self.slots[slot].ctypes.data)


def first_frame(
    driver: AravisHead,
    memory: Memory,
    *,
    events: list[DeviceEvent] | None = None,
    trigger: Callable[[], None] | None = None,
) -> tuple[Frame, NDArray[np.uint16]]:
    """Run the driver until one triggered frame has come; its events are added to `events`.

    `trigger` starts the exposure; the head's own software trigger without.
    """
    frames: list[tuple[Frame, NDArray[np.uint16]]] = []
    arrived = threading.Event()

    def sink(record: Record) -> None:
        if isinstance(record, DeviceEvent) and events is not None:
            events.append(record)
        if isinstance(record, Frame) and not frames:
            pixels = memory.slots[record.slot, : 2 * record.width_px * record.height_px]
            image = pixels.view(np.uint16).reshape(record.height_px, record.width_px).copy()
            frames.append((record, image))
            arrived.set()

    thread = threading.Thread(target=driver.run, args=(sink,))
    thread.start()
    try:
        deadline = time.monotonic() + WITHIN_S
        while driver.state is not LifeCycle.ACTIVE and time.monotonic() < deadline:
            time.sleep(0.01)
        for _ in range(ATTEMPTS):
            (trigger or driver.trigger)()
            if arrived.wait(WITHIN_S / ATTEMPTS):
                break
    finally:
        driver.close()
        thread.join(WITHIN_S)
    assert frames, "no frame came"
    return frames[0]

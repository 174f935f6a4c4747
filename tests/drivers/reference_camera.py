"""What a camera must offer by its description, as the reference implementation of GenApi reads it.

Aravis takes no part in it: the head driver is held against this.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from drivers.cameras.aravis.formats import packing_of
from sim_hw.gige.described_registers import SparseMemory
from sim_hw.gige.genicam.description_file import read_description
from sim_hw.gige.genicam.node_map import NodeMap
from sim_hw.gige.genicam.power_on_state import InitialState, write_power_on_state
from tests.support.genicam_descriptions import description
from tests.support.genicam_reference import Port, genapi

EXPOSURES: Final = ("ExposureTime", "ExposureTimeAbs", "ExposureTimeRaw")
FRAME_TRIGGERS: Final = {"FrameStart", "ExposureStart", "FrameTrigger"}
MANDATORY: Final = ("AcquisitionStart", "TriggerSoftware", "Width", "Height", "PayloadSize")
CHUNKS: Final = (*("Timestamp", "ExposureTime", "Gain", "Temperature", "FrameID", "Framecounter"),)
"""Without CounterValue, which also needs a counter that counts exposures."""
CLOCKS: Final = (
    ("TimestampLatch", "TimestampLatchValue"),
    ("TimestampLatch", "Timestamp"),
    ("GevTimestampControlLatch", "GevTimestampValue"),
)


@dataclass(frozen=True)
class Offered:
    """What the head driver must find.

    `arms` is whether it must open the head for single triggered frames, `gain` the feature of the
    gain, `line` a line that can trigger; both may be empty.
    """

    arms: bool
    chunks: frozenset[str]
    has_clock: bool
    gain: str
    line: str


class ReferenceCamera:
    """A camera of this description after power-on, in the reference implementation."""

    def __init__(self, name: str, state: InitialState) -> None:
        self._description = read_description(description(name))
        memory = SparseMemory()
        write_power_on_state(NodeMap(self._description, memory), state)
        self._nodes = genapi.NodeMap()
        self._nodes.load_xml_from_string(self._description.xml.decode("utf-8", "replace"))
        self._port = Port(memory)
        self._nodes.connect(self._port, "Device")

    def has(self, feature: str) -> bool:
        return feature in self._description.nodes

    def node(self, feature: str) -> Any:
        return self._nodes.get_node(feature) if self.has(feature) else None

    def access(self, feature: str) -> Any:
        node = self.node(feature)
        return genapi.EAccessMode.NI if node is None else node.get_access_mode()

    def is_writable(self, feature: str) -> bool:
        return self.access(feature) == genapi.EAccessMode.RW

    def is_readable(self, feature: str) -> bool:
        return self.access(feature) in (genapi.EAccessMode.RW, genapi.EAccessMode.RO)

    def entries(self, feature: str) -> set[str]:
        if not self.is_readable(feature):
            return set()
        listed = self.node(feature).entries
        return {entry.symbolic for entry in listed if genapi.is_available(entry.node)}

    def choose(self, feature: str, entry: str) -> None:
        if entry in self.entries(feature) and self.is_writable(feature):
            self.node(feature).value = entry

    def chunks(self) -> Iterator[str]:
        """Chunks that can be switched on."""
        if not self.is_writable("ChunkModeActive"):
            return
        self.node("ChunkModeActive").value = True
        for chunk in CHUNKS:
            if chunk in self.entries("ChunkSelector"):
                self.choose("ChunkSelector", chunk)
                is_on = self.is_readable("ChunkEnable") and self.node("ChunkEnable").value
                if is_on or self.is_writable("ChunkEnable"):
                    yield chunk


@functools.cache
def offered(name: str, state: InitialState) -> Offered:
    """What the reference implementation reports of a camera after power-on."""
    camera = ReferenceCamera(name, state)
    selectors = camera.entries("TriggerSelector")
    camera.choose("TriggerSelector", "FrameStart")
    arms = (
        all(camera.has(feature) for feature in MANDATORY)
        and any(packing_of(entry) is not None for entry in camera.entries("PixelFormat"))
        and any(camera.is_writable(feature) for feature in EXPOSURES)
        and camera.is_writable("TriggerMode")
        and (
            not selectors
            or bool(selectors & FRAME_TRIGGERS)
            or selectors == {"AcquisitionStart"}
            or ("FrameBurstStart" in selectors and camera.is_writable("AcquisitionBurstFrameCount"))
        )
        and "Software" in camera.entries("TriggerSource")
    )
    if not arms:
        return Offered(arms=False, chunks=frozenset(), has_clock=False, gain="", line="")
    lines = sorted(entry for entry in camera.entries("TriggerSource") if entry.startswith("Line"))
    commands = (genapi.EAccessMode.RW, genapi.EAccessMode.WO)
    clocks = [
        value
        for command, value in CLOCKS
        if camera.access(command) in commands and camera.is_readable(value)
    ]
    gains = [
        name
        for name in ("Gain", "GainRaw")
        if camera.is_readable(name) and not isinstance(camera.node(name), genapi.ICategory)
    ]
    return Offered(
        arms=True,
        chunks=frozenset(camera.chunks()),
        has_clock=bool(clocks),
        gain=gains[0] if gains else "",
        line=lines[0] if lines else "",
    )

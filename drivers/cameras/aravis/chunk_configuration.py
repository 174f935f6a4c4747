"""Lets a head append what it knows of a frame to its pixels.

Source: GenICam SFNC 2.7, chapter 20 "Chunk data control".
"""

from __future__ import annotations

import contextlib
from typing import Final

from drivers.cameras.aravis.feature_access import FeatureError, Features

CHUNKS: Final = (
    *("Timestamp", "ExposureTime", "CounterValue", "Gain", "Temperature", "FrameID"),
    "Framecounter",
)
COUNTERS: Final = ("Counter1", "Counter0")
COUNTER_EVENTS: Final = ("ExposureStart", "FrameStart", "FrameTrigger", "AcquisitionTrigger")


def switch_on_chunks(features: Features) -> tuple[list[str], str]:
    """Let the head append what it knows of each frame.

    Args:
        features: the head's features.

    Returns:
        Names of the chunks that it appends, and the reason if there are none.
    """
    if not features.is_available("ChunkModeActive"):
        return [], "the head has no feature ChunkModeActive"
    if features.kind("ChunkSelector") != "enumeration":
        # Such a head appends data whose layout its description does not state.
        return [], "the description has no ChunkSelector, which names the chunks"
    found: list[str] = []
    refused: list[str] = []
    try:
        features.set("ChunkModeActive", True)
        offered = features.entries("ChunkSelector")
        for chunk in CHUNKS:
            if chunk not in offered or (
                chunk == "CounterValue" and not _configure_counter(features)
            ):
                continue
            try:
                features.set("ChunkSelector", chunk)
                features.set("ChunkEnable", True)
                found.append(chunk)
            except FeatureError as error:
                refused.append(str(error))
        if not found and not refused:
            has = ", ".join(offered) or "no entry"
            refused.append(f"ChunkSelector has {has}, of which none is used")
    except FeatureError as error:
        found, refused = [], [str(error)]
    if found:
        return found, ""
    with contextlib.suppress(FeatureError):
        features.set("ChunkModeActive", False)
    return [], refused[0]


def _configure_counter(features: Features) -> bool:
    """Let a counter count exposures; False if the head's counters cannot."""
    if not features.entries("CounterEventSource"):
        return not features.entries("CounterSelector")
    counter = features.first_entry("CounterSelector", COUNTERS)
    try:
        if counter is not None:
            features.set("CounterSelector", counter)
        event = features.first_entry("CounterEventSource", COUNTER_EVENTS)
        if event is None:
            return False
        features.set("CounterEventSource", event)
        if "Off" in features.entries("CounterResetSource"):
            features.set("CounterResetSource", "Off")
        if counter is not None and counter in features.entries("ChunkCounterSelector"):
            features.set("ChunkCounterSelector", counter)
        if features.is_available("CounterReset"):
            features.execute("CounterReset")
    except FeatureError:
        return False
    return True

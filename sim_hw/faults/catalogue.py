"""The names of the faults: what each does, to which devices, and its default duration.

Names only. `plan` reads them, `channel` applies them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

DeviceKind = Literal["head", "receiver", "thermometer", "trigger"]
Level = Literal["message", "link", "clock", "content"]

HEAD: Final[DeviceKind] = "head"
RECEIVER: Final[DeviceKind] = "receiver"
THERMOMETER: Final[DeviceKind] = "thermometer"
TRIGGER: Final[DeviceKind] = "trigger"

MARK, NAVIGATION = "mark", "navigation"
TOPICS: Final[Mapping[DeviceKind, tuple[str, ...]]] = {RECEIVER: (MARK, NAVIGATION)}
"""What the messages of a device are about, where a fault may be of some of them only."""

_ALL: Final = frozenset((HEAD, RECEIVER, THERMOMETER, TRIGGER))


@dataclass(frozen=True)
class FaultKind:
    """One name. A *message* is one transmission of a device: a frame, an epoch, an answer, a line.

    `duration_s` is how long it lasts where no duration is given; None means that it hits the next
    message only (level message and content) or lasts until the end (level clock). `amount` is what
    a scenario may change, with its unit in `amount_key`.
    """

    name: str
    level: Level
    description: str
    devices: frozenset[DeviceKind] = _ALL
    duration_s: float | None = None
    amount_key: str = ""
    amount: float = 0.0


_KINDS: Final = (
    FaultKind("lost", "message", "the message is never sent"),
    FaultKind("late", "message", "the message comes late", amount_key="by_s", amount=2.0),
    FaultKind("duplicate", "message", "the message is sent twice"),
    FaultKind("reordered", "message", "the message is sent after the one that follows it"),
    FaultKind(
        "corrupt",
        "message",
        "bits of the message are flipped; a frame has another size than it should",
    ),
    FaultKind("truncated", "message", "the message breaks off"),
    FaultKind(
        "stuck", "message", "the last message is repeated instead of a new one", duration_s=5.0
    ),
    FaultKind("silent", "message", "powered and connected, but sends nothing", duration_s=5.0),
    FaultKind(
        "flooding",
        "link",
        "sends far more than was requested: noise, and frames without a trigger",
        duration_s=5.0,
    ),
    FaultKind(
        "counter-reset",
        "content",
        "the count of frames, edges or pulses starts again",
        frozenset((HEAD, RECEIVER, TRIGGER)),
    ),
    FaultKind(
        "clock-step",
        "clock",
        "the device's clock jumps",
        frozenset((HEAD, RECEIVER)),
        amount_key="by_s",
        amount=0.37,
    ),
    FaultKind(
        "clock-drift",
        "clock",
        "the device's clock runs fast",
        frozenset((HEAD, RECEIVER)),
        amount_key="ppm",
        amount=200.0,
    ),
    FaultKind(
        "wrong-week",
        "clock",
        "the receiver's week is off, as after a rollover",
        frozenset((RECEIVER,)),
        duration_s=10.0,
        amount_key="weeks",
        amount=-1024.0,
    ),
    FaultKind(
        "cable-pulled", "link", "nothing passes either way, then all is back", duration_s=5.0
    ),
    FaultKind(
        "power-cycle",
        "link",
        "off, then back with initial counts, clocks and settings",
        duration_s=3.0,
    ),
    FaultKind(
        "older-frame",
        "content",
        "the frame of the exposure before is sent, with its own time and count",
        frozenset((HEAD,)),
    ),
    FaultKind(
        "half-frame",
        "content",
        "the second half of a frame never comes, asked for again or not",
        frozenset((HEAD,)),
    ),
    FaultKind(
        "open-sensor",
        "content",
        "the probe's wire is broken; the module reports it",
        frozenset((THERMOMETER,)),
        duration_s=5.0,
    ),
)

CATALOGUE: Final[Mapping[str, FaultKind]] = {kind.name: kind for kind in _KINDS}
"""Every fault by name, in the order of the documents."""

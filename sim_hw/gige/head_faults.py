"""Faults of a head and its connection, by name and reproducible."""

from __future__ import annotations

import random
import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sim_hw.faults.channel import Channel
from sim_hw.faults.plan import PlannedFault
from sim_hw.gige.ptp_slave import PtpSlave
from sim_hw.world.world_clock import FreeRunningClock


@dataclass(frozen=True)
class WireFaults:
    """Faults between a head's sensor and the receiver.

    `packet_loss` is the probability that a stream packet never leaves, resent ones included.
    `drop_frame` holds the pulse counts whose frame is exposed and counted but never sent.
    `planned` are faults of the library, for this head.
    """

    packet_loss: float = 0.0
    drop_frame: frozenset[int] = frozenset()
    planned: tuple[PlannedFault, ...] = ()

    def __post_init__(self) -> None:
        if not 0.0 <= self.packet_loss <= 1.0:
            raise ValueError(f"packet_loss is {self.packet_loss}; a probability lies in 0..1")


NO_FAULTS = WireFaults()


@dataclass(frozen=True)
class ExposedFrame:
    """A frame between exposure and stream. Of its packets the first `share` are sent.

    `start_ns` is on the head's own clock: it belongs to the frame, whenever that is sent.
    """

    image: NDArray[np.uint16]
    start_ns: int
    counter: int
    share: float = 1.0


class ExposedFrameDamage:
    """Damage of a frame."""

    def corrupt(self, message: ExposedFrame, rng: random.Random) -> ExposedFrame:
        """Half of its rows, honestly announced: not the size that was configured."""
        rows = message.image.shape[0] // 2
        return replace(message, image=np.ascontiguousarray(message.image[:rows]))

    def truncated(self, message: ExposedFrame, rng: random.Random) -> ExposedFrame:
        return replace(message, share=rng.uniform(0.1, 0.9))

    def first_half(self, message: ExposedFrame) -> ExposedFrame:
        return replace(message, share=0.5)


def channel_of(faults: WireFaults, serial: str) -> Channel[ExposedFrame]:
    """The way out of a head with this serial number."""
    return Channel(faults.planned, ExposedFrameDamage(), seed=serial)


class HeadClock:
    """A head's own clock, with the error of its clock faults; restarted by a power cycle."""

    def __init__(self, clock: FreeRunningClock, channel: Channel[ExposedFrame]) -> None:
        self._clock = clock
        self._channel = channel
        self.ptp: PtpSlave | None = None
        """The clock that PTP disciplines, while it is switched on."""

    def device_ns(self, mono_ns: int) -> int:
        """What the clock shows at a monotonic time."""
        ptp = self.ptp
        shown_ns = self._clock.device_ns(mono_ns) if ptp is None else ptp.clock_ns(mono_ns)
        return shown_ns + self._channel.clock_error_ns(mono_ns)

    def mono_ns(self, device_ns: int) -> int:
        """When, near now, the clock shows `device_ns`."""
        found = time.monotonic_ns()
        for _ in range(2):
            found += device_ns - self.device_ns(found)
        return found

    def restart(self, mono_ns: int) -> None:
        """It begins at zero, as after power on."""
        drift_ppm = self._clock.drift_ppm
        elapsed_ns = FreeRunningClock(0, drift_ppm).device_ns(mono_ns)
        self._clock = FreeRunningClock(-elapsed_ns, drift_ppm)

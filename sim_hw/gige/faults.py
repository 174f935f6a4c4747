"""What can be wrong with a head's connection, by name and reproducible."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class WireFaults:
    """Faults between a head's sensor and the receiver.

    `packet_loss` is the probability that a stream packet never leaves, resent ones included.
    `drop_frame` holds the pulse counts whose frame is exposed and counted but never sent.
    """

    packet_loss: float = 0.0
    drop_frame: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        if not 0.0 <= self.packet_loss <= 1.0:
            raise ValueError(f"packet_loss is {self.packet_loss}; a probability lies in 0..1")


NO_FAULTS = WireFaults()

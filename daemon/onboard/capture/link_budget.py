"""Link budget: what all heads on one link send per exposure, and at which rates that fits.

Computation only. `daemon.onboard.capture.link_settings` reads interfaces and configures heads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

IP_UDP_GVSP_NBYTES: Final = 20 + 8 + 8
"""Headers inside GevSCPSPacketSize."""
ETHERNET_NBYTES: Final = 14 + 4 + 8 + 12
"""Header, check sequence, preamble and gap of an Ethernet frame, outside GevSCPSPacketSize."""
ETHERNET_PAYLOAD_MIN_NBYTES: Final = 46
LEADER_NBYTES: Final = 36
"""Image leader after the GVSP header."""
TRAILER_NBYTES: Final = 12
"""Image trailer with chunk data after the GVSP header."""
USABLE_SHARE: Final = 0.9
"""Share of a link for first transmissions; the rest is for resent packets, control and clocks."""


@dataclass(frozen=True)
class Link:
    """The slowest link between some heads and this computer.

    Args:
        interface: name of the interface of this computer.
        rate_bytes_per_s: rate of the link.
        head_rate_bytes_per_s: rate of the link of each head to the switch.
        buffer_nbytes: bytes that the switch can queue for the link.
    """

    interface: str
    rate_bytes_per_s: float
    head_rate_bytes_per_s: float
    buffer_nbytes: int


@dataclass(frozen=True)
class HeadDemand:
    """What a head sends per exposure: pixels and chunk data, in packets of which size.

    `packet_size` is GevSCPSPacketSize in bytes: the IP packet.
    """

    head: str
    payload_nbytes: int
    packet_size: int

    @property
    def packet_count(self) -> int:
        """Datagrams of a frame: data, leader and trailer."""
        return 2 + -(-self.payload_nbytes // (self.packet_size - IP_UDP_GVSP_NBYTES))

    @property
    def packet_wire_nbytes(self) -> int:
        """Bytes of a full packet on the wire."""
        return self.packet_size + ETHERNET_NBYTES

    @property
    def wire_nbytes(self) -> int:
        """Bytes of a frame on the wire, with all headers.

        Example:
            >>> HeadDemand("A", 1464, 1500).wire_nbytes  # one full packet, leader and trailer
            1734
        """
        full, rest = divmod(self.payload_nbytes, self.packet_size - IP_UDP_GVSP_NBYTES)
        parts = [LEADER_NBYTES, TRAILER_NBYTES] + ([rest] if rest else [])
        return full * self.packet_wire_nbytes + sum(
            max(part + IP_UDP_GVSP_NBYTES, ETHERNET_PAYLOAD_MIN_NBYTES) + ETHERNET_NBYTES
            for part in parts
        )


@dataclass(frozen=True)
class HeadShare:
    """How a head sends its frame.

    `packet_delay_s` is the pause after each packet (GevSCPD), `transfer_delay_s` the pause between
    readout and first packet. `duration_s` holds for a head that pauses between the end of a packet
    and the next, as the standard defines it; heads that count from the start of a packet are done
    sooner. `is_gap_exact`: the packet's own time is not part of the pause.
    """

    demand: HeadDemand
    rate_bytes_per_s: float
    packet_delay_s: float
    transfer_delay_s: float
    duration_s: float
    is_gap_exact: bool


@dataclass(frozen=True)
class LinkPlan:
    """The budget of a link: what its heads need, and their shares; none where it does not fit."""

    link: Link
    interval_s: float
    demands: tuple[HeadDemand, ...]
    shares: tuple[HeadShare, ...]

    @property
    def payload_nbytes(self) -> int:
        """Pixels and chunk data of an exposure."""
        return sum(demand.payload_nbytes for demand in self.demands)

    @property
    def wire_nbytes(self) -> int:
        """Bytes of an exposure on the wire."""
        return sum(demand.wire_nbytes for demand in self.demands)

    @property
    def needed_s(self) -> float:
        """Time that the link takes for an exposure at its full rate, or the slowest head at its."""
        slowest = max((demand.wire_nbytes for demand in self.demands), default=0)
        link = self.link
        return max(self.wire_nbytes / link.rate_bytes_per_s, slowest / link.head_rate_bytes_per_s)

    @property
    def usable_s(self) -> float:
        """Part of the interval that first transmissions may take."""
        return self.interval_s * USABLE_SHARE

    @property
    def fits(self) -> bool:
        """Whether the heads can send an exposure before the next; then each has its share."""
        return len(self.shares) == len(self.demands)

    @property
    def duration_s(self) -> float:
        """Time from readout to the last packet of the last head."""
        return max((s.transfer_delay_s + s.duration_s for s in self.shares), default=0.0)

    @property
    def wave_count(self) -> int:
        """Groups of heads that send one after another; 1 where all send at once."""
        return len({share.transfer_delay_s for share in self.shares})


def plan_link(link: Link, demands: Sequence[HeadDemand], interval_s: float) -> LinkPlan:
    """The shares of the heads on a link.

    A head alone on a link that is no slower than its own is not paced. Otherwise the heads share
    the usable rate in proportion to what they send, so that they end together. If one packet of
    each head does not fit the buffer of the switch, the heads send in waves.

    Args:
        link: the link.
        demands: the heads on it.
        interval_s: time between exposures.

    Raises:
        ValueError: a rate, interval or packet size is not positive.
    """
    rates = (link.rate_bytes_per_s, link.head_rate_bytes_per_s, interval_s)
    if not all(math.isfinite(rate) and rate > 0 for rate in rates):
        raise ValueError(f"rates and interval are {rates}; each is positive and finite")
    small = [d.head for d in demands if d.packet_size <= IP_UDP_GVSP_NBYTES or d.payload_nbytes < 0]
    if small:
        raise ValueError(f"packets of {', '.join(small)} hold no pixels")
    plan = LinkPlan(link, interval_s, tuple(demands), ())
    if plan.needed_s > plan.usable_s or not demands:
        return plan
    if len(demands) == 1 and link.head_rate_bytes_per_s <= link.rate_bytes_per_s:
        return LinkPlan(link, interval_s, plan.demands, (_unpaced(link, demands[0]),))
    for is_gap_exact in (False, True):
        shares = _shares(link, demands, is_gap_exact=is_gap_exact)
        planned = LinkPlan(link, interval_s, plan.demands, shares)
        if planned.duration_s <= plan.usable_s * (1 + 1e-9):
            return planned
    return plan if planned.duration_s > interval_s else planned


def _unpaced(link: Link, demand: HeadDemand) -> HeadShare:
    rate = link.head_rate_bytes_per_s
    return HeadShare(demand, rate, 0.0, 0.0, demand.wire_nbytes / rate, True)


def _shares(
    link: Link, demands: Sequence[HeadDemand], *, is_gap_exact: bool
) -> tuple[HeadShare, ...]:
    shares: list[HeadShare] = []
    delay_s = 0.0
    for wave in _waves(link, demands):
        group = _wave_shares(link, wave, delay_s, is_gap_exact=is_gap_exact)
        shares += group
        delay_s += max(share.duration_s for share in group)
    return tuple(shares)


def _waves(link: Link, demands: Sequence[HeadDemand]) -> list[list[HeadDemand]]:
    """Heads that send at the same time: one packet of each fits the buffer of the switch."""
    waves: list[list[HeadDemand]] = [[]]
    queued = 0
    for demand in demands:
        if waves[-1] and queued + demand.packet_wire_nbytes > link.buffer_nbytes:
            waves.append([])
            queued = 0
        waves[-1].append(demand)
        queued += demand.packet_wire_nbytes
    return waves


def _wave_shares(
    link: Link, wave: Sequence[HeadDemand], delay_s: float, *, is_gap_exact: bool
) -> list[HeadShare]:
    total = sum(demand.wire_nbytes for demand in wave)
    duration_s = max(
        total / (link.rate_bytes_per_s * USABLE_SHARE),
        max(demand.wire_nbytes for demand in wave) / link.head_rate_bytes_per_s,
    )
    shares = []
    for demand in wave:
        rate = demand.wire_nbytes / duration_s
        own_s = demand.packet_wire_nbytes / link.head_rate_bytes_per_s
        pause_s = demand.packet_wire_nbytes / rate - (own_s if is_gap_exact else 0.0)
        taken_s = demand.wire_nbytes / link.head_rate_bytes_per_s
        taken_s += (demand.packet_count - 1) * max(pause_s, 0.0)
        shares.append(HeadShare(demand, rate, max(pause_s, 0.0), delay_s, taken_s, is_gap_exact))
    return shares

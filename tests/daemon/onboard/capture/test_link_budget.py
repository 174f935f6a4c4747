"""The budget of a link: wire bytes, shares, waves and refusals."""

from __future__ import annotations

import dataclasses
import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.onboard.capture.link_budget import (
    USABLE_SHARE,
    HeadDemand,
    Link,
    LinkPlan,
    plan_link,
)

GIGABIT = 125e6
ULTRACAM_X = 4992 * 3328 * 2
MINI = 1248 * 832 * 2


def gigabit(buffer_nbytes: int = 131_072, rate: float = GIGABIT) -> Link:
    return Link("eth1", rate, GIGABIT, buffer_nbytes)


def heads(count: int, payload: int = MINI, packet_size: int = 8192) -> list[HeadDemand]:
    return [HeadDemand(f"SU{i:02d}", payload, packet_size) for i in range(count)]


def test_wire_bytes_of_a_frame_counted_packet_by_packet() -> None:
    # Two full packets of 1,500, one of 100 pixels' bytes: 36 headers, 38 of Ethernet each.
    demand = HeadDemand("A", 2 * 1464 + 100, 1500)
    leader, trailer, rest = 36 + 36 + 38, 12 + 36 + 38, 100 + 36 + 38
    assert demand.packet_count == 5
    assert demand.wire_nbytes == 2 * 1538 + rest + leader + trailer


def test_the_shortest_ethernet_frame_counts_as_padded() -> None:
    assert HeadDemand("A", 1, 1500).wire_nbytes == (46 + 38) + (72 + 38) + (48 + 38)


def test_thirteen_full_heads_on_one_gigabit_are_refused_with_their_figures() -> None:
    plan = plan_link(gigabit(), heads(13, ULTRACAM_X), 1.35)
    assert not plan.fits
    assert plan.shares == ()
    assert plan.payload_nbytes / 1e6 == pytest.approx(431.9, abs=0.1)
    assert plan.needed_s == pytest.approx(3.49, abs=0.01)


def test_thirteen_full_heads_fit_ten_gigabits() -> None:
    plan = plan_link(gigabit(rate=10 * GIGABIT), heads(13, ULTRACAM_X), 1.35)
    assert plan.fits
    assert plan.duration_s < 1.35


def test_a_head_alone_on_its_link_is_not_paced() -> None:
    (share,) = plan_link(gigabit(), heads(1), 1.35).shares
    assert (share.packet_delay_s, share.transfer_delay_s) == (0.0, 0.0)


def test_a_head_alone_behind_a_slower_link_is_paced() -> None:
    (share,) = plan_link(gigabit(rate=GIGABIT / 10), heads(1), 1.35).shares
    wire = share.demand.packet_wire_nbytes
    assert wire / share.packet_delay_s == pytest.approx(GIGABIT / 10 * USABLE_SHARE)


def test_thirteen_mini_heads_share_a_gigabit_and_end_in_time() -> None:
    plan = plan_link(gigabit(), heads(13), 1.35)
    assert plan.wave_count == 1
    assert sum(s.rate_bytes_per_s for s in plan.shares) == pytest.approx(USABLE_SHARE * GIGABIT)
    assert plan.duration_s == pytest.approx(0.2608, abs=0.001)


def test_heads_of_different_size_end_together() -> None:
    plan = plan_link(gigabit(), [*heads(2), HeadDemand("L", 4 * MINI, 8192)], 1.35)
    small, _, large = plan.shares
    assert large.rate_bytes_per_s == pytest.approx(4 * small.rate_bytes_per_s, rel=0.001)


def test_a_small_buffer_makes_the_heads_send_in_waves() -> None:
    plan = plan_link(gigabit(buffer_nbytes=4 * 8230), heads(13), 1.35)
    delays = [share.transfer_delay_s for share in plan.shares]
    assert plan.wave_count == 4
    assert [delays.count(delay) for delay in sorted(set(delays))] == [4, 4, 4, 1]
    for earlier, later in zip(plan.shares[::4], plan.shares[4::4], strict=False):
        assert later.transfer_delay_s >= earlier.transfer_delay_s + earlier.duration_s - 1e-9


def test_near_the_limit_the_pause_is_shortened_by_the_packets_own_time() -> None:
    relaxed, tight = (plan_link(gigabit(), heads(2, 50_000_000), t) for t in (2.0, 1.0))
    assert not relaxed.shares[0].is_gap_exact
    assert tight.shares[0].is_gap_exact
    assert tight.duration_s <= 0.9001


@pytest.mark.parametrize("name", ["rate_bytes_per_s", "head_rate_bytes_per_s"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_rates_that_are_no_rates_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match="positive and finite"):
        plan_link(Link(**{**dataclasses.asdict(gigabit()), name: value}), heads(1), 1.0)


def test_packets_without_space_for_pixels_are_refused() -> None:
    with pytest.raises(ValueError, match="SU00 hold no pixels"):
        plan_link(gigabit(), heads(1, packet_size=36), 1.0)


@given(
    counts=st.lists(st.integers(10_000, 40_000_000), min_size=1, max_size=16),
    packet_size=st.sampled_from([576, 1500, 8192, 9000]),
    rate=st.sampled_from([0.1, 1.0, 2.5, 10.0]),
    buffer_nbytes=st.integers(2_000, 1_000_000),
    interval_s=st.floats(0.05, 5.0),
)
def test_what_is_granted_never_exceeds_the_link_under_either_reading(
    counts: list[int], packet_size: int, rate: float, buffer_nbytes: int, interval_s: float
) -> None:
    demands = [HeadDemand(f"H{i}", n, packet_size) for i, n in enumerate(counts)]
    plan = plan_link(gigabit(buffer_nbytes, rate * GIGABIT), demands, interval_s)
    if not plan.fits:
        return
    assert plan.duration_s <= interval_s
    waves: dict[float, float] = {}
    for share in plan.shares:
        own_s = share.demand.packet_wire_nbytes / GIGABIT
        if len(plan.shares) > 1 or rate < 1:
            # As the standard reads the pause: after the end of the packet.
            fastest = share.demand.packet_wire_nbytes / (share.packet_delay_s + own_s)
            assert fastest <= share.rate_bytes_per_s * (1 + 1e-9)
        waves.setdefault(share.transfer_delay_s, 0.0)
        waves[share.transfer_delay_s] += share.rate_bytes_per_s
    if len(plan.shares) > 1:
        assert max(waves.values()) <= USABLE_SHARE * rate * GIGABIT * (1 + 1e-9)
        _ends_before_the_next_wave(plan)


def _ends_before_the_next_wave(plan: LinkPlan) -> None:
    starts = sorted({share.transfer_delay_s for share in plan.shares})
    for start, following in itertools.pairwise(starts):
        wave = [s for s in plan.shares if s.transfer_delay_s == start]
        assert start + max(s.duration_s for s in wave) <= following + 1e-9

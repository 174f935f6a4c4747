"""How fast an emulated head sends."""

from __future__ import annotations

import math

import pytest

from sim_hw.gige.pacing import Pacing, PacketTimer, TokenBucket

MS = 1_000_000


@pytest.mark.parametrize("rmem_max", [100_000, 212_992, 425_984, 1 << 20, 4 << 20, 64 << 20])
def test_what_comes_in_20_ms_of_latency_fits_the_receivers_socket(rmem_max: int) -> None:
    pacing = Pacing.for_receive_buffer(rmem_max)
    assert pacing.burst_bytes + pacing.rate_bytes_per_s * 0.020 <= rmem_max


def test_a_plain_debian_gets_8_megabytes_a_second_and_4_mib_get_60() -> None:
    assert Pacing.for_receive_buffer(212_992).rate_bytes_per_s == pytest.approx(7.99e6, rel=0.01)
    assert Pacing.for_receive_buffer(4 << 20).rate_bytes_per_s == 60e6


def test_thirteen_mini_frames_keep_their_interval_on_a_plain_debian() -> None:
    frame_bytes = 1248 * 832 * 2
    assert frame_bytes / Pacing.for_receive_buffer(212_992).rate_bytes_per_s < 0.3


def test_the_bucket_gives_its_burst_at_once_and_then_the_rate() -> None:
    bucket = TokenBucket(Pacing(rate_bytes_per_s=1e6, burst_bytes=50_000), now_ns=0)
    assert bucket.available(0) == 50_000
    bucket.spend(50_000)
    assert bucket.available(10 * MS) == pytest.approx(10_000)
    assert bucket.available(1000 * MS) == 50_000


def test_a_packet_longer_than_the_burst_is_worked_off_afterwards() -> None:
    bucket = TokenBucket(Pacing(rate_bytes_per_s=1e6, burst_bytes=20_000), now_ns=0)
    bucket.spend(65_000)
    assert bucket.available(0) == -45_000
    assert bucket.available(65 * MS) == pytest.approx(20_000)


def test_the_packet_delay_lies_between_the_end_of_a_packet_and_the_next() -> None:
    # 1,000 bytes on the wire take 8 us at 1 Gbit/s, and then the pause of 92 us.
    timer = PacketTimer(125e6, packet_delay_ns=92_000, limit_bytes_per_s=math.inf)
    timer.start(0)
    assert timer.wait_ns(0) == 0
    timer.sent(962, 0)
    assert timer.wait_ns(0) == pytest.approx(100_000)
    assert timer.wait_ns(100_000) == pytest.approx(0)


def test_the_throughput_limit_counts_all_bytes_on_the_wire() -> None:
    timer = PacketTimer(125e6, packet_delay_ns=0, limit_bytes_per_s=1e6)
    timer.start(0)
    timer.sent(962, 0)
    assert timer.wait_ns(0) == pytest.approx(1e6)


def test_a_late_sender_does_not_catch_up() -> None:
    timer = PacketTimer(125e6, packet_delay_ns=92_000, limit_bytes_per_s=math.inf)
    timer.start(0)
    timer.sent(962, 500 * MS)
    assert timer.wait_ns(500 * MS) == pytest.approx(100_000)


def test_the_pause_goes_on_between_frames() -> None:
    timer = PacketTimer(125e6, packet_delay_ns=92_000, limit_bytes_per_s=math.inf)
    timer.sent(962, 0)
    timer.start(10_000)
    assert timer.wait_ns(10_000) == pytest.approx(90_000)


def test_packets_sent_again_delay_the_frame() -> None:
    timer = PacketTimer(125e6, packet_delay_ns=92_000, limit_bytes_per_s=math.inf)
    timer.start(0)
    timer.charge([962] * 5)
    assert timer.wait_ns(0) == pytest.approx(500_000)


def test_without_limits_nothing_is_held_back() -> None:
    assert not PacketTimer(60e6, 0, math.inf).is_limiting
    assert not PacketTimer(60e6, 0, 125e6).is_limiting
    assert PacketTimer(60e6, 0, 30e6).is_limiting

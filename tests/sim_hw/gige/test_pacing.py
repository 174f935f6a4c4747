"""How fast an emulated head sends."""

from __future__ import annotations

import pytest

from sim_hw.gige.pacing import Pacing, TokenBucket

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


def test_the_controllers_packet_delay_slows_the_bucket_down() -> None:
    bucket = TokenBucket(Pacing(rate_bytes_per_s=1e9, burst_bytes=10_000), now_ns=0)
    bucket.spend(10_000)
    assert bucket.available(5 * MS, rate_limit_bytes_per_s=1e6) == pytest.approx(5_000)

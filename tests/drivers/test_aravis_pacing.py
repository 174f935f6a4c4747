"""Pacing of a stream: what the driver writes into the head, and what then goes over the wire."""

from __future__ import annotations

import time
from typing import Any

import pytest

pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")

from drivers.cameras.aravis.packet_pacing import packet_delay_ticks, write_pacing
from tests.drivers.test_aravis_head import SHAPE, flying

PAYLOAD = SHAPE[0] * SHAPE[1] * 2

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(240)]


@pytest.mark.parametrize(
    ("size", "rate_mbps", "link_mbps", "tick_hz", "ticks"),
    [
        (1462, 100.0, 0.0, 1_000_000_000, 120_000),
        (1462, 100.0, 1000.0, 1_000_000_000, 108_000),
        (1462, 100.0, 0.0, 125_000_000, 15_000),
        (1462, 100.0, 0.0, 1_000_000, 120),
        (1462, 1000.0, 1000.0, 1_000_000_000, 0),
        (1462, 2000.0, 1000.0, 1_000_000_000, 0),
        (1463, 100.0, 0.0, 1_000_000, 121),
    ],
)
def test_the_pause_is_in_ticks_of_the_heads_clock_and_rounded_up(
    size: int, rate_mbps: float, link_mbps: float, tick_hz: int, ticks: int
) -> None:
    assert packet_delay_ticks(size, rate_mbps, link_mbps, tick_hz) == ticks


def test_the_head_holds_the_rate_and_every_frame_records_the_pause() -> None:
    with flying(packet_size=1460, stream_rate_mbps=40.0, packet_timeout_ms=100.0) as (pair,):
        packets = -(-PAYLOAD // (1460 - 36)) + 2
        durations = []
        for number in (1, 2, 3):
            started = time.monotonic()
            pair.pulse(number)
            pair.wait_frames(number)
            durations.append(time.monotonic() - started)
        pause_ns = pair.emulated._registers.integer("GevSCPD")
    assert pause_ns == 299_600
    assert {frame.settings["GevSCPD"] for frame in pair.frames} == {299_600}
    assert min(durations) >= (packets - 1) * 299e-6


def test_without_a_rate_the_head_sends_as_fast_as_it_can() -> None:
    with flying(packet_size=1460) as (pair,):
        pair.pulse(1)
        pair.wait_frames(1)
        assert pair.emulated._registers.integer("GevSCPD") == 0
    assert "GevSCPD" not in pair.frames[0].settings


def test_a_transfer_is_delayed_after_the_readout() -> None:
    with flying(stream_rate_mbps=400.0, transfer_delay_us=300_000.0) as (pair,):
        pair.pulse(1)
        pair.wait_frames(1)
        assert pair.emulated._registers.integer("GevSCFTD") == 300_000_000
    frame = pair.frames[0]
    assert frame.mono_ns - pair.starts_ns[0] >= 300_000_000
    assert frame.settings["GevSCFTD"] == 300_000_000


def test_a_configured_feature_takes_precedence() -> None:
    with flying(stream_rate_mbps=40.0, features={"GevSCPD": 1000}) as (pair,):
        assert pair.emulated._registers.integer("GevSCPD") == 1000


class FewFeatures:
    """Features of a head that is described by a mapping of name to limits."""

    def __init__(self, **limits: tuple[float, float, int]) -> None:
        self.limits, self.held = limits, dict[str, Any]()

    def is_available(self, name: str) -> bool:
        return name in self.limits

    is_writable = is_available

    def kind(self, name: str) -> str:
        return "integer"

    def number(self, name: str) -> float | None:
        return self.held.get(name)

    def text(self, name: str) -> str:
        return str(self.held.get(name, ""))

    def entries(self, name: str) -> list[str]:
        return []

    def bounds(self, name: str) -> tuple[float, float]:
        return self.limits[name][:2]

    def increment(self, name: str) -> int:
        return self.limits[name][2]

    def set(self, name: str, value: Any) -> Any:
        from drivers.cameras.aravis.feature_access import FeatureError

        low, high, step = self.limits[name]
        if not low <= value <= high or (value - low) % step:
            raise FeatureError(f"{name} = {value} is refused: between {low} and {high}")
        self.held[name] = value
        return value


def settings(**more: object) -> Any:
    from drivers.cameras.aravis.settings import AravisSettings

    return AravisSettings("SU00", {"address": "10.0.0.5", **more})


def test_a_step_of_the_head_rounds_the_pause_up() -> None:
    head = FewFeatures(GevSCPD=(0, 10**9, 7000))
    # Only the used features of a camera exist.
    written, refusals = write_pacing(head, settings(stream_rate_mbps=100.0), 1462, 10**9)  # type: ignore[arg-type]
    assert (written, refusals) == ({"GevSCPD": 126_000}, [])


def test_a_head_without_a_pause_is_limited_by_its_throughput() -> None:
    head = FewFeatures(DeviceLinkThroughputLimit=(1000, 10**9, 900))
    # Only the used features of a camera exist.
    written, refusals = write_pacing(head, settings(stream_rate_mbps=100.0), 1462, 10**9)  # type: ignore[arg-type]
    held = written["DeviceLinkThroughputLimit"]
    assert refusals == []
    assert isinstance(held, int)
    assert 12_500_000 - 900 < held <= 12_500_000


def test_a_head_in_the_mode_of_bytes_per_second_is_limited_by_them() -> None:
    head = FewFeatures(GevSCPD=(0, 10**9, 1), StreamBytesPerSecond=(1_000_000, 124_000_000, 1))
    head.held["BandwidthControlMode"] = "StreamBytesPerSecond"
    # Only the used features of a camera exist.
    written, refusals = write_pacing(head, settings(stream_rate_mbps=100.0), 1462, 10**9)  # type: ignore[arg-type]
    assert (written, refusals) == ({"StreamBytesPerSecond": 12_500_000}, [])


def test_a_head_that_cannot_be_paced_is_refused_with_the_action() -> None:
    head = FewFeatures()
    asked = settings(stream_rate_mbps=100.0, transfer_delay_us=5.0)
    # Only the used features of a camera exist.
    _, refusals = write_pacing(head, asked, 1462, 10**9)  # type: ignore[arg-type]
    assert len(refusals) == 2
    assert "connect it to an interface of its own" in refusals[0]
    assert "GevSCFTD" in refusals[1]


def test_a_pause_beyond_the_heads_bounds_is_refused() -> None:
    head = FewFeatures(GevSCPD=(0, 1000, 1))
    # Only the used features of a camera exist.
    _, (refusal,) = write_pacing(head, settings(stream_rate_mbps=1.0), 1462, 10**9)  # type: ignore[arg-type]
    assert refusal.startswith("stream_rate_mbps = 1 is refused")


def test_a_pause_left_by_an_earlier_controller_is_reported() -> None:
    head = FewFeatures(GevSCPD=(0, 10**9, 1))
    head.held["GevSCPD"] = 5000
    # Only the used features of a camera exist.
    assert write_pacing(head, settings(), 1462, 10**9) == ({"GevSCPD": 5000}, [])  # type: ignore[arg-type]

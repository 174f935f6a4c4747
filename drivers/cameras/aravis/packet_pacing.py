"""Pacing of a head's stream: the pause between packets, and the pause before the first one.

The rate of a head is decided by its caller; this module converts it to the head's features.

Source: GigE Vision 2.0, section 28 (stream channel packet delay, in ticks of the timestamp
counter); GenICam SFNC 2.7, DeviceLinkThroughputLimit (bytes per second).
"""

from __future__ import annotations

import math
from typing import Final

from drivers.cameras.aravis.feature_access import FeatureError, Features
from drivers.cameras.aravis.presets import FeatureValue
from drivers.cameras.aravis.settings import AravisSettings

ETHERNET_NBYTES: Final = 38
"""Header, check sequence, preamble and gap of an Ethernet frame, outside the packet size."""
BYTES_PER_S_OF_MBPS: Final = 125_000
PACKET_DELAY: Final = "GevSCPD"
THROUGHPUT_LIMIT: Final = "DeviceLinkThroughputLimit"
STREAM_BYTES: Final = "StreamBytesPerSecond"
TRANSFER_DELAYS: Final = ("GevSCFTD", "StreamTransferStartDelay")


LINK_SPEEDS: Final = (("DeviceLinkSpeed", 1 / BYTES_PER_S_OF_MBPS), ("GevLinkSpeed", 1.0))
"""Features with the rate of the head's own link, and their unit in Mbit/s."""
LINK_MIN_MBPS: Final = 1.0


def link_rate_mbps(features: Features) -> float | None:
    """The rate that a head reports of its own link.

    Args:
        features: the head's features.

    Returns:
        Rate, Mbit/s; None if it reports none.

    Source: GenICam SFNC 2.7, DeviceLinkSpeed (bytes per second); GigE Vision 2.0, link speed
    register (Mbit/s).
    """
    for name, unit in LINK_SPEEDS:
        value = features.number(name)
        if value is not None and value * unit >= LINK_MIN_MBPS:
            return value * unit
    return None


def packet_delay_ticks(
    packet_size: int, stream_rate_mbps: float, head_link_mbps: float, tick_hz: int
) -> int:
    """The pause after each packet that holds a rate, rounded up.

    Args:
        packet_size: size of the IP packet in bytes.
        stream_rate_mbps: rate on the wire, Mbit/s, positive.
        head_link_mbps: rate of the head's link, whose time for the packet is subtracted; 0: none.
        tick_hz: frequency of the timestamp counter.

    Returns:
        The pause in ticks, at least 0.

    Source: GigE Vision 2.0, section 28, stream channel packet delay.

    Example:
        >>> packet_delay_ticks(8962, 100.0, 0.0, 1_000_000_000)  # 9000 bytes at 12.5 MB/s
        720000
    """
    wire_nbytes = packet_size + ETHERNET_NBYTES
    pause_s = wire_nbytes / (stream_rate_mbps * BYTES_PER_S_OF_MBPS)
    if head_link_mbps:
        pause_s -= wire_nbytes / (head_link_mbps * BYTES_PER_S_OF_MBPS)
    return max(math.ceil(round(pause_s * tick_hz, 6)), 0)


def write_pacing(
    features: Features, settings: AravisSettings, packet_size: int, tick_hz: int
) -> tuple[dict[str, FeatureValue], list[str]]:
    """Limit the rate of a head.

    Without `stream_rate_mbps` the head keeps its pause, which is reported. Features that are
    configured by name are left as they are.

    Args:
        features: the head's features.
        settings: the configured settings.
        packet_size: size of the IP packet in bytes.
        tick_hz: frequency of the head's timestamp counter.

    Returns:
        What the head holds afterwards, by feature, and one sentence per refusal.
    """
    written: dict[str, FeatureValue] = {}
    refusals: list[str] = []
    for write in (_write_rate, _write_transfer_delay):
        try:
            written |= write(features, settings, packet_size, tick_hz)
        except FeatureError as error:
            refusals.append(str(error))
    return written, refusals


def _write_rate(
    features: Features, settings: AravisSettings, packet_size: int, tick_hz: int
) -> dict[str, FeatureValue]:
    rate_mbps = settings.stream_rate_mbps
    if {PACKET_DELAY, THROUGHPUT_LIMIT, STREAM_BYTES} & settings.features.keys():
        return {}
    if not rate_mbps:
        held = features.number(PACKET_DELAY)
        return {PACKET_DELAY: int(held)} if held else {}
    if features.text("BandwidthControlMode") == STREAM_BYTES:
        # Quirk: in this mode of Allied Vision heads the pause has no effect.
        # Upstream: manual: GenICam description of Mako G-234B, BandwidthControlMode.
        return _write_limit(features, STREAM_BYTES, rate_mbps)
    if features.is_writable(PACKET_DELAY):
        ticks = packet_delay_ticks(packet_size, rate_mbps, settings.head_link_mbps, tick_hz)
        low, _ = features.bounds(PACKET_DELAY)
        step, start = features.increment(PACKET_DELAY), int(low) if math.isfinite(low) else 0
        ticks = start + math.ceil(max(ticks - start, 0) / step) * step
        return {PACKET_DELAY: _set(features, PACKET_DELAY, ticks, "stream_rate_mbps", rate_mbps)}
    if not features.is_available(THROUGHPUT_LIMIT):
        raise FeatureError(
            f"stream_rate_mbps is {rate_mbps:g}; the head has neither {PACKET_DELAY} nor "
            f"{THROUGHPUT_LIMIT} and cannot share a link; connect it to an interface of its own"
        )
    if "On" in features.entries("DeviceLinkThroughputLimitMode"):
        features.set("DeviceLinkThroughputLimitMode", "On")
    return _write_limit(features, THROUGHPUT_LIMIT, rate_mbps)


def _write_limit(features: Features, name: str, rate_mbps: float) -> dict[str, FeatureValue]:
    """Bytes per second, rounded down to the head's step."""
    low, _ = features.bounds(name)
    limit = rate_mbps * BYTES_PER_S_OF_MBPS
    if math.isfinite(low):
        step = features.increment(name)
        limit = low + math.floor((limit - low) / step) * step
    return {name: _set(features, name, limit, "stream_rate_mbps", rate_mbps)}


def _write_transfer_delay(
    features: Features, settings: AravisSettings, _packet_size: int, tick_hz: int
) -> dict[str, FeatureValue]:
    """Pause before the first packet; ticks, or microseconds in the feature of SFNC 2.7."""
    delay_us = settings.transfer_delay_us
    name = next((n for n in TRANSFER_DELAYS if features.is_writable(n)), None)
    if name is None or name in settings.features:
        if delay_us and name is None:
            raise FeatureError(
                f"transfer_delay_us is {delay_us:g}; the head cannot delay its transfer (it has no "
                f"{TRANSFER_DELAYS[0]}); use a switch with a larger buffer and set "
                "network.switch_buffer_bytes"
            )
        return {}
    value = math.ceil(delay_us * 1e-6 * tick_hz) if name == TRANSFER_DELAYS[0] else delay_us
    return {name: _set(features, name, value, "transfer_delay_us", delay_us)}


def _set(features: Features, name: str, value: float, key: str, wanted: float) -> FeatureValue:
    try:
        return features.set(name, int(value) if features.kind(name) == "integer" else value)
    except FeatureError as error:
        raise FeatureError(
            f"{key} = {wanted:g} is refused ({error}); connect the head to an interface of its own"
        ) from None

"""Detection of a protocol: all decoders receive the bytes, and their messages identify the device.

Ports and baud rates are chosen in `drivers.detection.port_search`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from drivers.contract import DeviceError
from drivers.detection.line_format import line_format_of
from drivers.receivers.applanix.decoder import ApplanixDecoder
from drivers.receivers.applanix.navigator import ApplanixNavigator
from drivers.receivers.fix_monitor import fix_description
from drivers.receivers.gsof.decoder import GsofDecoder
from drivers.receivers.gsof.navigator import GsofNavigator
from drivers.receivers.mavlink.decoder import MavlinkDecoder
from drivers.receivers.mavlink.navigator import MavlinkNavigator
from drivers.receivers.message_decoder import MessageDecoder
from drivers.receivers.nmea.decoder import NmeaDecoder
from drivers.receivers.nmea.navigator import NmeaNavigator
from drivers.receivers.novatel.decoder import NovatelDecoder
from drivers.receivers.novatel.navigator import NovatelNavigator
from drivers.receivers.sbg.decoder import SbgDecoder
from drivers.receivers.sbg.navigator import SbgNavigator
from drivers.receivers.septentrio.decoder import SbfDecoder
from drivers.receivers.septentrio.navigator import SeptentrioNavigator
from drivers.receivers.streaming_navigator import StreamingNavigator
from drivers.receivers.ublox.decoder import UbxDecoder
from drivers.receivers.ublox.navigator import UbloxNavigator
from drivers.receivers.vectornav.decoder import VectornavDecoder
from drivers.receivers.vectornav.navigator import VectornavNavigator
from drivers.receivers.xsens.decoder import XsensDecoder
from drivers.receivers.xsens.navigator import XsensNavigator

TEXT_BUFFER_NBYTES: Final = 20_000
_GPSD: Final = re.compile(rb'(^|\n)\{"class": ?"VERSION", ?"release":')
MIN_MESSAGES: Final = 2
"""Minimum number of undamaged messages; a single one may occur in noise by chance."""


@dataclass(frozen=True)
class DetectedDevice:
    """A detected device: its `driver`, what was `received`, and what a flight still requires."""

    kind: str
    driver: str
    protocol: str
    received: str
    missing: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _ProtocolCandidate:
    driver: str
    navigator: type[StreamingNavigator]
    new: Callable[[str], MessageDecoder]


# Binary protocols first: their receivers often send NMEA in addition.
_PROTOCOL_CANDIDATES: Final = (
    _ProtocolCandidate("ublox", UbloxNavigator, UbxDecoder),
    _ProtocolCandidate("septentrio", SeptentrioNavigator, SbfDecoder),
    _ProtocolCandidate("novatel", NovatelNavigator, NovatelDecoder),
    _ProtocolCandidate("sbg", SbgNavigator, SbgDecoder),
    _ProtocolCandidate("vectornav", VectornavNavigator, VectornavDecoder),
    _ProtocolCandidate("xsens", XsensNavigator, XsensDecoder),
    _ProtocolCandidate("applanix", ApplanixNavigator, ApplanixDecoder),
    _ProtocolCandidate("gsof", GsofNavigator, GsofDecoder),
    _ProtocolCandidate("mavlink", MavlinkNavigator, MavlinkDecoder),
    _ProtocolCandidate("nmea", NmeaNavigator, NmeaDecoder),
)


class ProtocolDetector:
    """The bytes and messages received on one port at one baud rate."""

    def __init__(self) -> None:
        self.nbytes = 0
        self._text = b""
        self._decoders: list[tuple[_ProtocolCandidate, MessageDecoder]] = []
        for candidate in _PROTOCOL_CANDIDATES:
            try:
                self._decoders.append((candidate, candidate.new("found")))
            except DeviceError:
                # A library is not installed: that protocol cannot be recognized.
                continue

    @property
    def has_messages(self) -> bool:
        """Whether a message or text was received so far."""
        return any(decoder.frames for _, decoder in self._decoders) or self.looks_like_text

    @property
    def looks_like_text(self) -> bool:
        """Whether the last bytes are more than 8 and at least 98 % of them printable."""
        text = self._text.translate(None, b"\x00")
        printable = sum(32 <= byte < 127 or byte in b"\t\r\n\xb0" for byte in text)
        return len(text) > 8 and printable >= 0.98 * len(text)

    def feed(self, data: bytes, mono_ns: int) -> None:
        """Pass bytes to all decoders.

        Args:
            data: bytes as received.
            mono_ns: their arrival on CLOCK_MONOTONIC, ns.
        """
        self.nbytes += len(data)
        self._text = (self._text + data)[-TEXT_BUFFER_NBYTES:]
        for _, decoder in self._decoders:
            decoder.feed(data, mono_ns)

    def is_certain(self, *, has_listened_long_enough: bool) -> bool:
        """Whether further listening cannot change the result.

        A receiver may send text in addition to binary messages. Until the device has been listened
        to long enough, only binary messages are decisive.

        Args:
            has_listened_long_enough: whether every message that is sent once a second was received.

        Returns:
            True if the device is known and nothing that a flight requires is missing.
        """
        detected = self.detected()
        if detected is None or detected.missing:
            return False
        return has_listened_long_enough or detected.driver not in ("nmea", "ascii-line", "gpsd")

    def detected(self) -> DetectedDevice | None:
        """The device, by the messages received so far.

        Returns:
            The device; None if no protocol is recognized.
        """
        for candidate, decoder in self._decoders:
            if any(decoder.seen[name] for name in candidate.navigator.required):
                return _detected_device(candidate, decoder, missing="")
        for candidate, decoder in self._decoders:
            if decoder.frames >= MIN_MESSAGES:
                wanted = " or ".join(candidate.navigator.required)
                return _detected_device(candidate, decoder, missing=wanted)
        return self._detected_text_device()

    def _detected_text_device(self) -> DetectedDevice | None:
        if _GPSD.search(self._text):
            return DetectedDevice("navigator", "gpsd", "gpsd", "its greeting")
        if not self.looks_like_text:
            return None
        lines = line_format_of(self._text)
        if lines is None:
            return None
        received = f"lines such as {lines.example!r}"
        if lines.pattern is None:
            missing = "a pattern: the lines differ, see docs/reference/drivers/ascii-line.md"
            return DetectedDevice("thermometer", "ascii-line", "lines of text", received, missing)
        channels = [str(number) for number in range(lines.readings)]
        settings = {"pattern": lines.pattern, "channels": channels}
        return DetectedDevice(
            "thermometer", "ascii-line", "lines of text", received, settings=settings
        )


def _detected_device(
    candidate: _ProtocolCandidate, decoder: MessageDecoder, *, missing: str
) -> DetectedDevice:
    received = ", ".join(sorted(decoder.seen)) or f"{decoder.frames} other messages"
    if decoder.fix is not None:
        received += f"; {fix_description(decoder.fix, decoder.satellites)}"
    return DetectedDevice(
        "navigator", candidate.driver, candidate.navigator.protocol, received, missing
    )

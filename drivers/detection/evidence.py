"""What speaks, by what was heard: every decoder listens at once, and the messages decide.

Which ports are listened to, and how fast, is in `drivers.detection.search`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from drivers.contract import DeviceError
from drivers.detection.lines import lines_in
from drivers.receivers.mavlink.decoder import MavlinkDecoder
from drivers.receivers.mavlink.navigator import MavlinkNavigator
from drivers.receivers.message_decoder import MessageDecoder
from drivers.receivers.nmea.decoder import NmeaDecoder
from drivers.receivers.nmea.navigator import NmeaNavigator
from drivers.receivers.novatel.decoder import NovatelDecoder
from drivers.receivers.novatel.navigator import NovatelNavigator
from drivers.receivers.receiver import ListeningNavigator
from drivers.receivers.receiver_fix import fix_in_words
from drivers.receivers.septentrio.decoder import SbfDecoder
from drivers.receivers.septentrio.navigator import SeptentrioNavigator
from drivers.receivers.ublox.decoder import UbxDecoder
from drivers.receivers.ublox.navigator import UbloxNavigator

KEPT_TEXT_NBYTES: Final = 20_000
_GPSD: Final = re.compile(rb'(^|\n)\{"class": ?"VERSION", ?"release":')
FEW_MESSAGES: Final = 2
"""So many undamaged messages are no accident; one is, in enough noise."""


@dataclass(frozen=True)
class Speaker:
    """Who speaks: `driver` for it, what was `heard`, and what is `missing` for a flight."""

    kind: str
    driver: str
    protocol: str
    heard: str
    missing: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _Listener:
    driver: str
    navigator: type[ListeningNavigator]
    new: Callable[[str], MessageDecoder]


# Binary protocols first: their receivers often send NMEA beside them, and mean it less.
_LISTENERS: Final = (
    _Listener("ublox", UbloxNavigator, UbxDecoder),
    _Listener("septentrio", SeptentrioNavigator, SbfDecoder),
    _Listener("novatel", NovatelNavigator, NovatelDecoder),
    _Listener("mavlink", MavlinkNavigator, MavlinkDecoder),
    _Listener("nmea", NmeaNavigator, NmeaDecoder),
)


class Evidence:
    """What has been heard on one port at one speed."""

    def __init__(self) -> None:
        self.nbytes = 0
        self._text = b""
        self._decoders: list[tuple[_Listener, MessageDecoder]] = []
        for listener in _LISTENERS:
            try:
                self._decoders.append((listener, listener.new("found")))
            except DeviceError:
                # A library that is not installed: that protocol cannot be recognised.
                continue

    @property
    def has_messages(self) -> bool:
        """Whether anything made sense so far: it is worth listening on."""
        return any(decoder.frames for _, decoder in self._decoders) or self.looks_like_text

    @property
    def looks_like_text(self) -> bool:
        text = self._text.translate(None, b"\x00")
        printable = sum(32 <= byte < 127 or byte in b"\t\r\n\xb0" for byte in text)
        return len(text) > 8 and printable >= 0.98 * len(text)

    def feed(self, data: bytes, mono_ns: int) -> None:
        self.nbytes += len(data)
        self._text = (self._text + data)[-KEPT_TEXT_NBYTES:]
        for _, decoder in self._decoders:
            decoder.feed(data, mono_ns)

    def is_certain(self, *, has_settled: bool) -> bool:
        """Whether more listening would change nothing.

        Text may be what a receiver says beside its binary messages: until it has settled, only
        these decide.
        """
        speaker = self.speaker()
        if speaker is None or speaker.missing:
            return False
        return has_settled or speaker.driver not in ("nmea", "ascii-line", "gpsd")

    def speaker(self) -> Speaker | None:
        """Who it is, by what was heard so far."""
        for listener, decoder in self._decoders:
            if any(decoder.seen[name] for name in listener.navigator.required):
                return _speaker(listener, decoder, missing="")
        for listener, decoder in self._decoders:
            if decoder.frames >= FEW_MESSAGES:
                wanted = " or ".join(listener.navigator.required)
                return _speaker(listener, decoder, missing=wanted)
        return self._text_speaker()

    def _text_speaker(self) -> Speaker | None:
        if _GPSD.search(self._text):
            return Speaker("navigator", "gpsd", "gpsd", "its greeting")
        if not self.looks_like_text:
            return None
        lines = lines_in(self._text)
        if lines is None:
            return None
        heard = f"lines such as {lines.example!r}"
        if lines.pattern is None:
            missing = "a pattern: the lines differ, see docs/drivers/ascii-line.md"
            return Speaker("thermometer", "ascii-line", "lines of text", heard, missing)
        channels = [str(number) for number in range(lines.readings)]
        settings = {"pattern": lines.pattern, "channels": channels}
        return Speaker("thermometer", "ascii-line", "lines of text", heard, settings=settings)


def _speaker(listener: _Listener, decoder: MessageDecoder, *, missing: str) -> Speaker:
    heard = ", ".join(sorted(decoder.seen)) or f"{decoder.frames} messages of no use here"
    if decoder.fix is not None:
        heard += f"; {fix_in_words(decoder.fix, decoder.satellites)}"
    return Speaker("navigator", listener.driver, listener.navigator.protocol, heard, missing)

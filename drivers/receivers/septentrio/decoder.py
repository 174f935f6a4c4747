"""SBF blocks into records: bytes in, NavSample and EventMark out, no I/O and no clock.

Taking a block apart is in `drivers.receivers.septentrio.blocks`.

Source: Septentrio mosaic-X5 reference guide, firmware 4.14, chapter 4; AsteRx-i3 for INSNavGeod.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from dataclasses import dataclass, field
from typing import Final

from drivers.contract import POSITION_FIXES, EventMark, NavSample, Velocity
from drivers.receivers.message_decoder import MessageDecoder, Nav
from drivers.receivers.septentrio.blocks import (
    INS_PART,
    SbfBlock,
    accuracies_m,
    block_of,
    number,
    sbf_framer,
)
from drivers.timescales.gps_time import MAX_LEAP_SECONDS, RECENT_NS

FIXES: Final = {0: "none", 3: "time"}
"""By PVT mode; every other one is a fix of position and height."""
MODE_2D: Final = 0x80
RANGE_ERROR_M: Final = 5.0
"""Times the dilution of precision where the receiver gives no sigma."""
WEEK_AND_TOW_SET: Final = 0x03
LEAP_UNKNOWN: Final = -128
RISING: Final = 0
FALLING: Final = 1
OSCILLATOR_NS_PER_S: Final = 100
"""By which a mark's accuracy worsens with the age of the last PVT: 0.1 ppm, a TCXO."""
COUNT_BITS: Final = 32
NO_COUNT: Final = 0
"""The block has no count: ours, of what came, is no witness of what the receiver saw."""
EPOCH_KINDS: Final = frozenset(
    ("PVTGeodetic", "PosCovGeodetic", "VelCovGeodetic", "DOP", "AttEuler")
)

Triple = tuple[float | None, float | None, float | None]
Pair = tuple[float | None, float | None]


@dataclass
class _Epoch:
    """What has come for one time stamp."""

    rx_ns: int
    mono_ns: int
    kinds: set[str] = field(default_factory=set)
    pvt: SbfBlock | None = None
    sigmas_m: tuple[float, float] | None = None
    speed_sigma_mps: float | None = None
    hdop: float | None = None
    vdop: float | None = None
    attitude: Triple = (None, None, None)
    is_emitted: bool = False


class SbfDecoder(MessageDecoder):
    """Decodes what a Septentrio receiver sends.

    Blocks of one time stamp (PVTGeodetic, covariances, DOP, AttEuler) become one NavSample, as soon
    as all kinds of the epoch before have come or the next epoch begins. INSNavGeod becomes one by
    itself, and while it comes the others do not. ExtEvent of the kind `edge` becomes an EventMark.
    Nothing that is fed raises.
    """

    decode_errors = (ValueError, TypeError, struct.error, OverflowError)
    bad_counter = "bad_blocks"

    def __init__(self, receiver: str, *, edge: str = "rising", mark_accuracy_ns: int = 100) -> None:
        super().__init__(
            receiver,
            sbf_framer(),
            ("samples", "blocks_without_time", "marks", "marks_far", "marks_other_edge",
             "marks_without_time", "marks_lost"),
        )  # fmt: skip
        self._polarity = FALLING if edge == "falling" else RISING
        self._mark_accuracy_ns = mark_accuracy_ns
        self._time_good = True
        self._satellites: int | None = None
        self._bias_ns = 0
        self._inertial_ns: int | None = None
        self._epoch: _Epoch | None = None
        self._expected: frozenset[str] = frozenset()
        self._counts: Counter[int] = Counter()
        self._marked_rx_ns: int | None = None

    def reset(self) -> None:
        super().reset()
        self._epoch = None
        self._marked_rx_ns = None

    def on_message(self, message: bytes, mono_ns: int) -> list[Nav]:
        block = block_of(message)
        if block is None:
            return []
        decoded: list[Nav] = []
        if block.name == "ReceiverTime":
            self._on_receiver_time(block)
        elif block.rx_ns is None:
            self.counters["blocks_without_time"] += 1
            if block.name == "PVTGeodetic":
                # Switched on a moment ago: it knows neither time nor place.
                self.fix, self.satellites = "none", 0
            self.counters["marks_without_time"] += block.name == "ExtEvent"
        elif block.name == "ExtEvent":
            decoded = self._on_event(block, block.rx_ns, mono_ns)
        elif block.name == "ExtEventPVTGeodetic":
            self._on_event_position(block.rx_ns)
        elif block.name == "INSNavGeod":
            decoded = self._on_inertial(block, block.rx_ns, mono_ns)
        elif block.name in EPOCH_KINDS:
            decoded = self._on_part_of_epoch(block, block.rx_ns, mono_ns)
        self.seen[block.name] += 1
        return decoded

    # Epochs

    def _on_part_of_epoch(self, block: SbfBlock, rx_ns: int, mono_ns: int) -> list[Nav]:
        decoded: list[Nav] = []
        if self._epoch is None or self._epoch.rx_ns != rx_ns:
            decoded = self._close()
            self._epoch = _Epoch(rx_ns, mono_ns)
        epoch = self._epoch
        values = block.values
        if block.name == "PVTGeodetic":
            epoch.pvt = block
            self._satellites = values[14] if values[14] != 255 else None
            self._bias_ns = round((values[10] or 0.0) * 1e6)
        elif block.name == "DOP":
            epoch.hdop, epoch.vdop = (dop * 0.01 if dop else None for dop in values[3:5])
        elif block.name == "AttEuler":
            heading, pitch, roll = values[4:7]
            epoch.attitude = _attitude(roll, pitch, heading)
        elif values[1] == 0 and None not in values[2:5]:
            if block.name == "PosCovGeodetic":
                epoch.sigmas_m = math.sqrt(values[2] + values[3]), math.sqrt(values[4])
            else:
                epoch.speed_sigma_mps = math.sqrt(sum(values[2:5]))
        epoch.kinds.add(block.name)
        if self._expected and self._expected <= epoch.kinds:
            decoded.extend(self._emit(epoch))
        return decoded

    def _close(self) -> list[Nav]:
        if self._epoch is None:
            return []
        self._expected = frozenset(self._epoch.kinds)
        return self._emit(self._epoch)

    def _emit(self, epoch: _Epoch) -> list[Nav]:
        block = epoch.pvt
        if epoch.is_emitted or block is None:
            return []
        epoch.is_emitted = True
        mode, error, latitude, longitude, height, _, north, east, up = block.values[:9]
        bias_ms = block.values[10]
        gps_ns = epoch.rx_ns - round((bias_ms or 0.0) * 1e6)
        if self._inertial_ns is not None and abs(gps_ns - self._inertial_ns) < RECENT_NS:
            return []
        has_fix = error == 0 and None not in (latitude, longitude, height)
        fix = FIXES.get(mode & 0x0F, "2d" if mode & MODE_2D else "3d") if has_fix else "none"
        source = "receiver"
        sigmas_m: Pair = epoch.sigmas_m or accuracies_m(block) or (None, None)
        if sigmas_m == (None, None) and epoch.hdop:
            source = "dop"
            sigmas_m = RANGE_ERROR_M * epoch.hdop, epoch.vdop and RANGE_ERROR_M * epoch.vdop
        return self._sample(
            gps_ns,
            epoch.mono_ns,
            fix=fix,
            place=(latitude, longitude, height),
            velocity=(north, east, up),
            sigmas=(*sigmas_m, epoch.speed_sigma_mps),
            attitude=epoch.attitude,
            has_time=bias_ms is not None and has_fix,
            sigma_source=source,
        )

    def _on_inertial(self, block: SbfBlock, rx_ns: int, mono_ns: int) -> list[Nav]:
        mode, error = block.values[:2]
        latitude, longitude, height = block.values[4:7]
        parts = _ins_parts(block)
        if error != 0 or None in (latitude, longitude, height):
            return []
        # The block has no clock bias of its own: that of the last PVT holds.
        gps_ns = self._inertial_ns = rx_ns - self._bias_ns
        deviations = parts.get(0)
        accuracy = block.values[8]
        sigmas_m: Pair = None, None
        if deviations is not None:
            sigmas_m = math.hypot(*deviations[:2]), deviations[2]
        elif accuracy != 0xFFFF:
            sigmas_m = accuracy * 0.01, accuracy * 0.01
        heading, pitch, roll = parts.get(1) or (None, None, None)
        east, north, up = parts.get(3) or (None, None, None)
        speeds = parts.get(4)
        return self._sample(
            gps_ns,
            mono_ns,
            # Without a GNSS solution the inertial one is carried on by itself.
            fix="3d" if mode & 0x0F else "dead-reckoning",
            place=(latitude, longitude, height),
            velocity=(north, east, up),
            sigmas=(*sigmas_m, None if speeds is None else math.hypot(*speeds)),
            attitude=_attitude(roll, pitch, heading),
            has_time=True,
        )

    def _sample(
        self,
        gps_ns: int,
        mono_ns: int,
        *,
        fix: str,
        place: Triple,
        velocity: Triple,
        sigmas: Triple,
        attitude: Triple,
        has_time: bool,
        sigma_source: str = "receiver",
    ) -> list[Nav]:
        latitude, longitude, height = place
        if fix not in POSITION_FIXES or latitude is None or longitude is None:
            latitude = longitude = None
        elif not (abs(latitude) <= math.pi / 2 and abs(longitude) <= 2 * math.pi):
            raise ValueError("a position that is none")
        has_position = latitude is not None
        # In a 2d fix the height is one that the receiver was given, not one that it measured.
        has_height = has_position and fix != "2d" and height is not None
        horizontal_m, vertical_m, speed_sigma_mps = sigmas
        valid = has_time and self._time_good
        if valid:
            self._gps_ns = gps_ns
        north, east, up = velocity
        self.counters["samples"] += 1
        return [
            NavSample(
                receiver=self.receiver,
                gps_ns=gps_ns,
                mono_ns=mono_ns,
                fix=fix,
                satellites=self._satellites,
                latitude_deg=None if latitude is None else math.degrees(latitude),
                longitude_deg=None if longitude is None else math.degrees(longitude),
                height_m=height if has_height else None,
                horizontal_sigma_m=horizontal_m if has_position else None,
                vertical_sigma_m=vertical_m if has_height else None,
                velocity_ned_mps=_ned(north, east, up) if has_position else None,
                speed_sigma_mps=speed_sigma_mps if has_position else None,
                roll_rad=attitude[0],
                pitch_rad=attitude[1],
                heading_rad=attitude[2],
                leap_seconds=self._leap,
                time_valid=valid,
                sigma_source=sigma_source if horizontal_m is not None else "none",
            )
        ]

    # Time and marks

    def _on_receiver_time(self, block: SbfBlock) -> None:
        leap, level = block.values[6:8]
        self._time_good = level & WEEK_AND_TOW_SET == WEEK_AND_TOW_SET
        if leap != LEAP_UNKNOWN and 0 <= leap <= MAX_LEAP_SECONDS and self._time_good:
            self._leap = leap

    def _on_event(self, block: SbfBlock, rx_ns: int, mono_ns: int) -> list[Nav]:
        channel, polarity, offset_s, bias_s = block.values
        self._marked_rx_ns = rx_ns
        if polarity != self._polarity:
            self.counters["marks_other_edge"] += 1
            self.other_edges += 1
            return []
        self.other_edges = 0
        # t = TOW + Offset - RxClkBias; without a bias the receiver has had no PVT for ten minutes.
        gps_ns = rx_ns + round(offset_s * 1e9) - round((bias_s or 0.0) * 1e9)
        age_s = int.from_bytes(block.rest[:2], "little") if block.revision >= 1 else 0
        valid = bias_s is not None and self._time_good and self.is_near_navigation(gps_ns)
        self.counters["marks"] += 1
        self._counts[channel] += 1
        return [
            EventMark(
                receiver=self.receiver,
                channel=channel,
                gps_ns=gps_ns,
                accuracy_ns=self._mark_accuracy_ns + age_s * OSCILLATOR_NS_PER_S,
                count=self._counts[channel] % (1 << COUNT_BITS),
                count_bits=NO_COUNT,
                time_valid=valid,
                mono_ns=mono_ns,
            )
        ]

    def _on_event_position(self, rx_ns: int) -> None:
        """It follows its ExtEvent; one without an ExtEvent means a lost mark, which is counted."""
        if rx_ns == self._marked_rx_ns:
            return
        self._marked_rx_ns = rx_ns
        # Quirk: the block contains neither input nor edge. They are known only if there is one
        # kind.
        # Upstream: manual: Septentrio mosaic-X5 reference guide, ExtEventPVTGeodetic.
        if len(self._counts) == 1 and not self.counters["marks_other_edge"]:
            self._counts[next(iter(self._counts))] += 1
            self.counters["marks_lost"] += 1


def _ins_parts(block: SbfBlock) -> dict[int, tuple[float, float, float]]:
    """The optional parts that are there and can be used, by number of their bit."""
    listed = block.values[11]
    parts: dict[int, tuple[float, float, float]] = {}
    at = 0
    for bit in range(8):
        if listed & 1 << bit:
            first, second, third = (number(n) for n in INS_PART.unpack_from(block.rest, at))
            at += INS_PART.size
            if first is not None and second is not None and third is not None:
                parts[bit] = (first, second, third)
    return parts


def _ned(north: float | None, east: float | None, up: float | None) -> Velocity | None:
    if north is None or east is None:
        return None
    return north, east, None if up is None else -up


def _attitude(roll: float | None, pitch: float | None, heading: float | None) -> Triple:
    return (
        None if roll is None else math.radians(roll),
        None if pitch is None else math.radians(pitch),
        None if heading is None else math.radians(heading) % math.tau,
    )

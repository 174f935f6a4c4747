"""NMEA sentences into records: bytes in, NavSample and EventMark out, no I/O and no clock.

Taking a sentence apart is in `drivers.receivers.nmea.sentences`, what the sentences of one time say
together in `drivers.receivers.nmea.epoch`.

Source: NMEA 0183 as published in gpsd's "NMEA Revealed"; Trimble's $PTNL,EVT.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from drivers.contract import EventMark, NavSample, Velocity
from drivers.receivers.message_decoder import MessageDecoder, Nav
from drivers.receivers.message_framer import MessageFramer
from drivers.receivers.nmea.epoch import SENTENCES, TIME_AT, Epoch
from drivers.receivers.nmea.sentences import (
    fields_of,
    has_checksum,
    is_proprietary,
    is_sentence,
    number,
    size_of,
    time_of_day_ns,
)
from drivers.timescales.gps_time import DAY_NS, RECENT_NS, SECOND_NS, WEEK_NS
from drivers.timescales.leap_seconds import leap_seconds_at

COUNT_BITS: Final = 16
EPOCHS_EXPECTED: Final = 12
"""An epoch is complete when all kinds of the last ones have come: GGA may come once a second."""
UNCHECKED_FIRST: Final = 10
"""So many sentences without a checksum, and none with one, and the receiver sends none."""
ROLL_OVER_DAYS: Final = 1024 * 7


class NmeaDecoder(MessageDecoder):
    """Decodes what an NMEA 0183 receiver sends.

    Sentences of one UTC time (`drivers.receivers.nmea.epoch.TIME_AT`, and those without a time that
    follow them) become one NavSample, as soon as all kinds of the last epochs have come or the next
    epoch begins. An epoch without a fix becomes none; `fix` and `satellites` say so. $PTNL,EVT
    becomes an EventMark. Nothing that is fed raises.

    Args:
        range_error_m: sigma of a range, times the dilution of precision that of the position,
            where the receiver sends no sigma.
        undulation_m: geoid above ellipsoid for receivers that do not send it.
        not_before_day: days since the GPS epoch before which no date can be: an earlier one is of
            a receiver whose count of weeks rolled over, and is corrected by 1024 weeks.
    """

    decode_errors = (ValueError, IndexError, OverflowError)
    bad_counter = "bad_sentences"

    def __init__(
        self,
        receiver: str,
        *,
        range_error_m: float = 5.0,
        speed_sigma_mps: float = 0.5,
        mark_accuracy_ns: int = 1000,
        undulation_m: float | None = None,
        not_before_day: int = 0,
    ) -> None:
        super().__init__(
            receiver,
            MessageFramer(b"$", size_of, is_sentence),
            ("samples", "samples_without_date", "samples_contradictory", "dates_rolled_over",
             "sentences_unchecked", "marks", "marks_far"),
        )  # fmt: skip
        self._range_error_m = range_error_m
        self._speed_sigma_mps = speed_sigma_mps
        self._mark_accuracy_ns = mark_accuracy_ns
        self._undulation_m = undulation_m
        self._not_before_day = not_before_day
        self._utc_ns: int | None = None
        self._epoch: Epoch | None = None
        self._kinds: deque[frozenset[str]] = deque(maxlen=EPOCHS_EXPECTED)
        self._checked = 0

    def reset(self) -> None:
        super().reset()
        self._epoch = None

    def on_message(self, message: bytes, mono_ns: int) -> list[Nav]:
        if has_checksum(message):
            self._checked += 1
        elif is_proprietary(message):
            # Quirk: some manufacturers send their own sentences without a checksum.
            # Upstream: no report known (2026-11-23).
            return []
        else:
            # A receiver that sends checksums sends them always: this one was damaged.
            self.counters["sentences_unchecked"] += 1
            if self._checked or self.counters["sentences_unchecked"] <= UNCHECKED_FIRST:
                raise ValueError("a sentence without a checksum")
        return self._on_sentence(fields_of(message), mono_ns)

    def _on_sentence(self, fields: list[str], mono_ns: int) -> list[Nav]:
        kind = _kind_of(fields)
        if kind == "PTNL,EVT":
            mark = self._mark(fields, mono_ns)
            self.seen[kind] += 1
            return [mark]
        if kind not in SENTENCES:
            return []
        decoded: list[Nav] = []
        if kind in TIME_AT:
            text = fields[TIME_AT[kind]] if len(fields) > TIME_AT[kind] else ""
            if not text:
                self._on_sentence_without_time(kind, fields, mono_ns)
                return []
            time = time_of_day_ns(text)
            if self._epoch is None or self._epoch.time != time:
                decoded = self._close()
                self._epoch = Epoch(time, mono_ns)
        if self._epoch is None:
            self.seen[kind] += 1
            return []
        self._epoch.add(kind, fields)
        self.seen[kind] += 1
        expected = frozenset[str]().union(*self._kinds)
        if expected and expected <= self._epoch.kinds:
            decoded.extend(self._complete(self._epoch))
        return decoded

    def _on_sentence_without_time(self, kind: str, fields: list[str], mono_ns: int) -> None:
        """A receiver that has never had a fix sends its sentences without a time."""
        epoch = Epoch((0, False), mono_ns)
        epoch.add(kind, fields)
        self.seen[kind] += 1
        if epoch.fixes and epoch.fix == "none":
            self.fix = "none"
        if epoch.satellites is not None:
            self.satellites = epoch.satellites

    # Epochs

    def _close(self) -> list[Nav]:
        if self._epoch is None:
            return []
        self._kinds.append(frozenset(self._epoch.kinds))
        return self._complete(self._epoch)

    def _complete(self, epoch: Epoch) -> list[Nav]:
        if epoch.is_complete or not epoch.fixes:
            return []
        epoch.is_complete = True
        self.counters["samples_contradictory"] += epoch.is_contradictory
        height_m = epoch.height_m(self._undulation_m)
        fix = epoch.fix
        if fix == "2d" or (fix == "3d" and height_m is None):
            fix, height_m = "2d", None
        self.fix = fix
        if epoch.satellites is not None:
            self.satellites = epoch.satellites
        if fix in ("none", "time") or epoch.position is None:
            return []
        at = self._gps_of(epoch)
        if at is None:
            self.counters["samples_without_date"] += 1
            return []
        gps_ns, valid = at
        velocity = _velocity(epoch)
        horizontal_m, vertical_m, source = self._sigmas(epoch)
        self.counters["samples"] += 1
        return [
            NavSample(
                receiver=self.receiver,
                gps_ns=gps_ns,
                mono_ns=epoch.mono_ns,
                fix=fix,
                satellites=epoch.satellites,
                latitude_deg=epoch.position[0],
                longitude_deg=epoch.position[1],
                height_m=height_m,
                horizontal_sigma_m=horizontal_m,
                vertical_sigma_m=None if height_m is None else vertical_m,
                velocity_ned_mps=velocity,
                speed_sigma_mps=None if velocity is None else self._speed_sigma_mps,
                roll_rad=epoch.roll_rad,
                pitch_rad=epoch.pitch_rad,
                heading_rad=epoch.heading_rad,
                leap_seconds=self._leap,
                time_valid=valid,
                sigma_source=source,
                leap_source="table",
            )
        ]

    def _sigmas(self, epoch: Epoch) -> tuple[float | None, float | None, str]:
        """Horizontal and vertical sigma, and where they come from."""
        if epoch.horizontal_sigma_m is not None:
            return epoch.horizontal_sigma_m, epoch.vertical_sigma_m, "receiver"
        if epoch.hdop is None:
            return None, None, "none"
        vdop = epoch.vdop or 2 * epoch.hdop
        return self._range_error_m * epoch.hdop, self._range_error_m * vdop, "dop"

    def _gps_of(self, epoch: Epoch) -> tuple[int, bool] | None:
        of_day, in_leap_second = epoch.time
        valid = True
        if epoch.day is not None:
            day = epoch.day
            # Quirk: receivers with an old firmware send dates of 1024 weeks ago.
            # Upstream: openvehicles/Open-Vehicle-Monitoring-System-3#284.
            if day < self._not_before_day:
                self.counters["dates_rolled_over"] += 1
                day += -((day - self._not_before_day) // ROLL_OVER_DAYS) * ROLL_OVER_DAYS
            utc = day * DAY_NS + of_day
        elif self._utc_ns is not None:
            # No date of its own: the nearest such time of day, over midnight too.
            away = (of_day - self._utc_ns + DAY_NS // 2) % DAY_NS - DAY_NS // 2
            utc = self._utc_ns + away
            valid = abs(away) < RECENT_NS
        else:
            return None
        leap = leap_seconds_at(utc - SECOND_NS if in_leap_second else utc)
        gps_ns = utc + leap * SECOND_NS
        if valid:
            self._utc_ns, self._gps_ns, self._leap = utc, gps_ns, leap
        return gps_ns, valid

    # Marks

    def _mark(self, fields: list[str], mono_ns: int) -> EventMark:
        of_day, _ = time_of_day_ns(fields[2])
        channel, count, week, day, leap = (int(number(text)) for text in fields[3:8])
        if not (0 <= day <= 6 and 0 <= leap <= 99 and 0 <= week < 65_536 and count >= 0):
            raise ValueError("week, day or leap seconds of an event out of range")
        start = week * WEEK_NS + day * DAY_NS
        by_utc_day = start + of_day + leap * SECOND_NS
        by_gps_day = start + (of_day + leap * SECOND_NS) % DAY_NS
        gps_ns, valid = by_utc_day, True
        if self._gps_ns is not None:
            # Quirk: in the last seconds of a UTC day the GPS day is the next one already, and whose
            # day and week the sentence gives differs by receiver. Navigation decides.
            # Upstream: no report known (2026-11-23).
            near = self._gps_ns
            gps_ns = min((by_utc_day, by_gps_day), key=lambda at: abs(at - near))
            valid = self.is_near_navigation(gps_ns)
        elif by_utc_day != by_gps_day:
            valid = False
        self.counters["marks"] += 1
        return EventMark(
            receiver=self.receiver,
            channel=channel,
            gps_ns=gps_ns,
            accuracy_ns=self._mark_accuracy_ns,
            count=count % (1 << COUNT_BITS),
            count_bits=COUNT_BITS,
            time_valid=valid,
            mono_ns=mono_ns,
        )


def _kind_of(fields: list[str]) -> str:
    """A sentence's name without its talker; proprietary ones with their distinguishing field."""
    address = fields[0]
    if address == "PASHR":
        return "PASHR" if fields[1][:1].isdigit() else "PASHR,other"
    if address in ("PUBX", "PTNL"):
        return f"{address},{fields[1]}"
    if address.startswith("P"):
        return address
    return address[2:] if len(address) == 5 else address


def _velocity(epoch: Epoch) -> Velocity | None:
    """North, east, down; None where speed or course did not come. A speed of 0 has no course."""
    if epoch.speed_mps is None or (epoch.speed_mps and epoch.course_rad is None):
        return None
    course = epoch.course_rad or 0.0
    return epoch.speed_mps * math.cos(course), epoch.speed_mps * math.sin(course), epoch.down_mps

"""RINEX observation files, 3.04, 4.00 and 4.02, with event marks as events of flag 5.

Epochs have 100 ns in the first two, so that a mark is rounded to 100 ns; 4.02 has five more digits
of the second behind the clock offset. A sidecar keeps nanoseconds and standard deviations.

Source: IGS and RTCM SC-104, RINEX 3.04 (2018), RINEX 4.00 (2021), RINEX 4.02 (2024), tables A1 to
A3.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from drivers.receivers.observations import Observation, ObservationEpoch

VERSIONS = ("3.04", "4.00", "4.02")
FINE_VERSION = "4.02"
SYSTEMS = "GRESCJI"
KINDS = ("C", "L", "D", "S")
TICK_NS = 100
EPOCH_FLAG_EVENT = 5
_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
_LOCK_ROUNDING_S = 0.1
_LIMIT = {"C": 1e10, "L": 1e10, "D": 1e10, "S": 1e10}
"""A field is F14.3: what does not fit is left out and counted."""


@dataclass(frozen=True)
class RinexHeader:
    """What a header states besides observations.

    `position_m` is earth-centred, approximate; `delta_hen_m` from the marker to the antenna's
    reference point; `lever_m` the antenna in the body, forward, right, down: a vehicle's record.
    """

    marker: str
    receiver: tuple[str, str, str] = ("", "", "")
    antenna: tuple[str, str] = ("", "")
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    delta_hen_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lever_m: tuple[float, float, float] | None = None
    comments: tuple[str, ...] = ()


@dataclass(frozen=True)
class RinexText:
    """The file, and how many epochs, marks and values it has; `left_out` values do not fit."""

    text: str
    epochs: int
    marks: int
    values: int
    left_out: int


def observation_text(
    header: RinexHeader,
    epochs: Sequence[ObservationEpoch],
    marks_ns: Sequence[int],
    *,
    version: str,
) -> RinexText:
    """An observation file.

    Args:
        header: names and places.
        epochs: observations; of two at one instant the first is written.
        marks_ns: event marks, GPS time.
        version: one of `VERSIONS`.

    Raises:
        ValueError: no epochs, or another version.
    """
    if version not in VERSIONS or not epochs:
        raise ValueError(f"version {version}, {len(epochs)} epochs")
    is_fine = version == FINE_VERSION
    ordered: dict[int, ObservationEpoch] = {}
    for epoch in epochs:
        ordered.setdefault(written_ns(epoch.gps_ns, version), epoch)
    instants = sorted(ordered)
    types = _types(ordered.values())
    lines = _header(header, ordered, types, version)
    pending = sorted(written_ns(mark, version) for mark in marks_ns)
    lock: dict[tuple[str, str], tuple[float, int]] = {}
    values = left_out = 0
    for instant in instants:
        while pending and pending[0] <= instant:
            lines.append(_event(pending.pop(0), is_fine=is_fine))
        body, written, lost = _epoch(ordered[instant], types, lock)
        lines += [_time(instant, 0, len(body), is_fine=is_fine), *body]
        values, left_out = values + written, left_out + lost
    lines += [_event(mark, is_fine=is_fine) for mark in pending]
    return RinexText("\n".join(lines) + "\n", len(instants), len(marks_ns), values, left_out)


def written_ns(gps_ns: int, version: str) -> int:
    """An instant as a version holds it: to the nanosecond, or rounded to 100 ns."""
    if version == FINE_VERSION:
        return gps_ns
    return (gps_ns + TICK_NS // 2) // TICK_NS * TICK_NS


def _types(epochs: Iterable[ObservationEpoch]) -> dict[str, list[str]]:
    found: dict[str, set[str]] = {}
    for epoch in epochs:
        for one in epoch.observations:
            found.setdefault(one.satellite[0], set()).add(one.code)
    return {system: sorted(found[system]) for system in SYSTEMS if system in found}


def _line(content: str, label: str) -> str:
    return f"{content:<60.60}{label:<20}".rstrip()


def _header(
    header: RinexHeader,
    epochs: Mapping[int, ObservationEpoch],
    types: Mapping[str, Sequence[str]],
    version: str,
) -> list[str]:
    number, kind, firmware = header.receiver
    first, last = min(epochs), max(epochs)
    made = f"{'Syntopic':<20}{'':<20}{_calendar(first)[0]:%Y%m%d %H%M%S} UTC"
    lines = [
        _line(
            f"{version:>9}{'':11}{'OBSERVATION DATA':<20}{'M: Mixed':<20}", "RINEX VERSION / TYPE"
        ),
        _line(made, "PGM / RUN BY / DATE"),
        *(_line(comment, "COMMENT") for comment in header.comments),
        _line(header.marker, "MARKER NAME"),
        _line("AIRBORNE", "MARKER TYPE"),
        _line("", "OBSERVER / AGENCY"),
        _line(f"{number:<20.20}{kind:<20.20}{firmware:<20.20}", "REC # / TYPE / VERS"),
        _line(f"{header.antenna[0]:<20.20}{header.antenna[1]:<20.20}", "ANT # / TYPE"),
        _line("".join(f"{v:14.4f}" for v in header.position_m), "APPROX POSITION XYZ"),
        _line("".join(f"{v:14.4f}" for v in header.delta_hen_m), "ANTENNA: DELTA H/E/N"),
    ]
    if header.lever_m is not None:
        lines.append(_line("".join(f"{v:14.4f}" for v in header.lever_m), "ANTENNA: DELTA X/Y/Z"))
    for system, codes in types.items():
        names = [kind + code for code in codes for kind in KINDS]
        for at in range(0, len(names), 13):
            count = f"{system}  {len(names):3d}" if at == 0 else " " * 6
            lines.append(
                _line(count + "".join(f" {n}" for n in names[at : at + 13]), "SYS / # / OBS TYPES")
            )
    lines += [
        _line("DBHZ", "SIGNAL STRENGTH UNIT"),
        _line(_instant(first, "GPS"), "TIME OF FIRST OBS"),
        _line(_instant(last, "GPS"), "TIME OF LAST OBS"),
        *(
            _line(f"{system} L{code}", "SYS / PHASE SHIFT")
            for system, codes in types.items()
            for code in codes
        ),
        *_glonass(epochs),
        # Blank: not known. Zeros would state that code and phase are aligned.
        _line("", "GLONASS COD/PHS/BIS"),
        _line("", "END OF HEADER"),
    ]
    return lines


def _glonass(epochs: Mapping[int, ObservationEpoch]) -> list[str]:
    channels: dict[str, int] = {}
    for epoch in epochs.values():
        for one in epoch.observations:
            if one.channel is not None:
                channels[one.satellite] = one.channel
    named = [f" {name} {channels[name]:2d}" for name in sorted(channels)]
    lines = [
        _line(
            (f"{len(named):3d}" if at == 0 else "   ") + "".join(named[at : at + 8]),
            "GLONASS SLOT / FRQ #",
        )
        for at in range(0, len(named), 8)
    ]
    return lines or [_line("  0", "GLONASS SLOT / FRQ #")]


def _epoch(
    epoch: ObservationEpoch,
    types: Mapping[str, Sequence[str]],
    lock: dict[tuple[str, str], tuple[float, int]],
) -> tuple[list[str], int, int]:
    by_satellite: dict[str, dict[str, Observation]] = {}
    for one in epoch.observations:
        by_satellite.setdefault(one.satellite, {}).setdefault(one.code, one)
    lines, written, left_out = [], 0, 0
    for satellite in sorted(by_satellite, key=lambda name: (SYSTEMS.index(name[0]), name)):
        fields = [satellite]
        for code in types[satellite[0]]:
            signal = by_satellite[satellite].get(code)
            values = _values(signal)
            slip = _loss_of_lock(satellite, signal, epoch.gps_ns, lock)
            for kind in KINDS:
                value = values[kind]
                if value is not None and abs(value) >= _LIMIT[kind] * (0.1 if value < 0 else 1.0):
                    value, left_out = None, left_out + 1
                written += value is not None
                shown = f"{value:14.3f}" if value is not None else " " * 14
                flag = f"{slip}" if kind == "L" and slip and value is not None else " "
                fields.append(f"{shown}{flag} ")
        lines.append("".join(fields).rstrip())
    return lines, written, left_out


def _values(one: Observation | None) -> dict[str, float | None]:
    if one is None:
        return dict.fromkeys(KINDS)
    return {
        "C": one.pseudorange_m,
        "L": one.phase_cycles,
        "D": one.doppler_hz,
        "S": one.strength_dbhz,
    }


def _loss_of_lock(
    satellite: str,
    one: Observation | None,
    gps_ns: int,
    lock: dict[tuple[str, str], tuple[float, int]],
) -> int:
    """1: the phase was lost since it was last seen; 2: it may be off by half a cycle.

    It was lost where it is tracked for less time than before, or than has passed since: after a
    gap of the recording, or behind the largest time that a receiver counts.
    """
    if one is None or one.phase_cycles is None:
        return 0
    key = (satellite, one.code)
    slipped = one.lock_s == 0.0
    if key in lock:
        before_s, seen_ns = lock[key]
        since_s = (gps_ns - seen_ns) * 1e-9
        slipped = one.lock_s < before_s or one.lock_s < since_s - _LOCK_ROUNDING_S
    lock[key] = one.lock_s, gps_ns
    return int(slipped) + 2 * one.half_cycle


def _calendar(gps_ns: int) -> tuple[datetime, int]:
    seconds, remainder = divmod(gps_ns, 1_000_000_000)
    return _GPS_EPOCH + timedelta(seconds=seconds), remainder // TICK_NS


def _instant(gps_ns: int, system: str) -> str:
    at, ticks = _calendar(gps_ns)
    second = f"{at.second:5d}.{ticks:07d}"
    return f"{at.year:6d}{at.month:6d}{at.day:6d}{at.hour:6d}{at.minute:6d}{second}     {system}"


def _time(gps_ns: int, flag: int, count: int, *, is_fine: bool) -> str:
    at, ticks = _calendar(gps_ns)
    line = f"> {at:%Y %m %d %H %M} {at.second:02d}.{ticks:07d}  {flag}{count:3d}"
    # 6X, the clock offset (F15.12) blank, 1X, I5.5: picoseconds beyond the 100 ns.
    return f"{line}{'':22}{gps_ns % TICK_NS * 1000:05d}" if is_fine else line


def _event(gps_ns: int, *, is_fine: bool) -> str:
    return _time(gps_ns, EPOCH_FLAG_EVENT, 0, is_fine=is_fine)

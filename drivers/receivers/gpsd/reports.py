"""Conversion of gpsd's reports, JSON lines, to navigation samples.

The connection is in `drivers.receivers.gpsd.navigator`. No line raises, whatever it holds.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Mapping
from typing import Any, Final

from drivers.contract import NavSample, Velocity
from drivers.timescales.gps_time import MAX_LEAP_SECONDS, SECOND_NS, UtcFields, utc_ns
from drivers.timescales.leap_seconds import leap_seconds_at

MAX_LINE: Final = 65_536
"""gpsd's own longest report, SKY of all constellations, stays below 20 kB."""
SIGMA_MAX_M: Final = 10_000.0
SIGMA_MAX_MPS: Final = 1_000.0
"""A larger one means that the receiver does not know."""
ATTITUDE_SLACK_NS: Final = 1_000_000
FIXES: Final = {2: "2d", 3: "3d"}
NOT_MEASURED: Final = {7: "time", 8: "none"}
"""`status` of TPV: a surveyed position that only time is computed with, and a simulated one."""
DEAD_RECKONING: Final = (5, 6)
"""`status` of TPV: dead reckoning, and together with GNSS."""
_UTC: Final = re.compile(
    r"(\d{4})-(\d\d)-(\d\d)T(\d\d):(\d\d):(\d\d)(?:\.(\d{1,9})\d{0,9})?Z", re.ASCII
)
_RADIAN: Final = math.pi / 180


class GpsdReports:
    """Takes a gpsd's lines and gives a NavSample for every TPV that has time and position.

    `seen` counts reports by class, `bad_messages` what is no report; `release` and `devices` are
    what the gpsd reports about itself. If `device` is set, only its reports are used.

    Source: gpsd_json(5), protocol 3.14.
    """

    def __init__(self, receiver: str, device: str = "") -> None:
        self._receiver = receiver
        self._device = device
        self.seen: Counter[str] = Counter()
        self.counters: Counter[str] = Counter(
            samples=0, samples_by_leap_table=0, reports_without_fix=0, pps=0
        )
        self.bad_messages = 0
        self.bad_bytes = 0
        self.error = ""
        self.reset()

    def reset(self) -> None:
        """Forget what belongs to one connection."""
        self._pending = b""
        self._overlong = False
        self.release = ""
        self.devices: tuple[str, ...] = ()
        self._attitude: Mapping[str, Any] = {}
        self._leap_seconds: int | None = None
        self.fix: str | None = None
        self.satellites: int | None = None

    @property
    def leap_seconds(self) -> str:
        """Those in use, and where they come from, in words."""
        if self._leap_seconds is not None:
            return str(self._leap_seconds)
        return "by our table, gpsd sends none" if self.counters["samples"] else "unknown"

    def feed(self, data: bytes, mono_ns: int) -> list[NavSample]:
        """Decode bytes of the connection.

        Args:
            data: bytes as received, cut anywhere.
            mono_ns: their arrival on CLOCK_MONOTONIC, ns.

        Returns:
            The samples of the lines that became complete.
        """
        samples = []
        *lines, rest = (self._pending + data).split(b"\n")
        for line in lines:
            overlong, self._overlong = self._overlong, False
            if overlong or len(line) > MAX_LINE:
                self._bad(line)
            elif line.strip():
                samples += self._report(line, mono_ns)
        if self._overlong or len(rest) > MAX_LINE:
            self.bad_bytes += len(rest)
            self._overlong, rest = True, b""
        self._pending = rest
        return samples

    def _bad(self, line: bytes) -> None:
        self.bad_messages += 1
        self.bad_bytes += len(line)

    def _report(self, line: bytes, mono_ns: int) -> list[NavSample]:
        try:
            report = json.loads(line)
        except (ValueError, RecursionError):
            self._bad(line)
            return []
        name = report.get("class") if isinstance(report, dict) else None
        if not isinstance(name, str) or len(name) > 16:
            self._bad(line)
            return []
        if self._device and report.get("device", self._device) != self._device:
            self.counters["other_devices"] += 1
            return []
        self.seen[name if name in _READ or name in _KNOWN else "other"] += 1
        if name == "TPV":
            return self._position(report, mono_ns)
        if name in _READ:
            _READ[name](self, report)
        return []

    def _version(self, report: Mapping[str, Any]) -> None:
        self.release = str(report.get("release", ""))[:40]

    def _device_list(self, report: Mapping[str, Any]) -> None:
        devices = report.get("devices")
        if isinstance(devices, list):
            paths = [device.get("path") for device in devices if isinstance(device, dict)]
            self.devices = tuple(str(path)[:80] for path in paths[:16] if path)

    def _sky(self, report: Mapping[str, Any]) -> None:
        used = _number(report, "uSat")
        satellites = report.get("satellites")
        if used is not None:
            self.satellites = min(max(int(used), 0), 999)
        elif isinstance(satellites, list):
            self.satellites = sum(isinstance(s, dict) and s.get("used") is True for s in satellites)

    def _att(self, report: Mapping[str, Any]) -> None:
        self._attitude = report

    def _pps(self, report: Mapping[str, Any]) -> None:
        self.counters["pps"] += 1

    def _error(self, report: Mapping[str, Any]) -> None:
        self.error = str(report.get("message", ""))[:120]

    def _position(self, report: Mapping[str, Any], mono_ns: int) -> list[NavSample]:
        leap = _number(report, "leapseconds")
        if leap is not None and 0 < leap <= MAX_LEAP_SECONDS:
            self._leap_seconds = int(leap)
        mode = _number(report, "mode") or 0.0
        utc = _utc_ns(report.get("time"))
        latitude, longitude = _number(report, "lat"), _number(report, "lon")
        not_measured = NOT_MEASURED.get(int(_number(report, "status") or 0))
        if mode < 2 or not_measured is not None:
            self.fix = not_measured or "none"
            self.counters["reports_without_fix"] += 1
            return []
        if utc is None or latitude is None or longitude is None:
            self.counters["reports_without_fix"] += 1
            return []
        if not (-90 <= latitude <= 90 and -180 <= longitude <= 360):
            self.counters["reports_without_fix"] += 1
            return []
        fix = FIXES.get(int(mode), "3d")
        if _number(report, "status") in DEAD_RECKONING:
            fix = "dead-reckoning"
        # In two dimensions the height is one that was held, not one that was measured.
        height = _number(report, "altHAE") if mode >= 3 else None
        if height is None and fix == "3d":
            fix = "2d"
        velocity, speed_sigma = _velocity(report)
        horizontal_m = _horizontal_sigma_m(report)
        # Quirk: gpsd sends leap seconds only for receivers that decode them, never with NMEA. The
        # built-in table is used. Upstream: no report known (2026-11-23); gpsd_json(5), TPV,
        # leapseconds.
        is_by_table = self._leap_seconds is None
        leap_seconds = leap_seconds_at(utc) if self._leap_seconds is None else self._leap_seconds
        self.fix = fix
        self.counters["samples_by_leap_table"] += is_by_table
        roll, pitch, heading = self._attitude_at(utc)
        self.counters["samples"] += 1
        return [
            NavSample(
                receiver=self._receiver,
                gps_ns=utc + leap_seconds * SECOND_NS,
                mono_ns=mono_ns,
                fix=fix,
                satellites=self.satellites,
                latitude_deg=latitude,
                longitude_deg=longitude if longitude <= 180 else longitude - 360,
                height_m=height,
                horizontal_sigma_m=horizontal_m,
                vertical_sigma_m=None if height is None else _sigma(report, "epv", SIGMA_MAX_M),
                velocity_ned_mps=velocity,
                speed_sigma_mps=speed_sigma,
                roll_rad=roll,
                pitch_rad=pitch,
                heading_rad=heading,
                leap_seconds=leap_seconds,
                time_valid=True,
                sigma_source="none" if horizontal_m is None else "receiver",
                leap_source="table" if is_by_table else "receiver",
            )
        ]

    def _attitude_at(self, utc: int) -> tuple[float | None, float | None, float | None]:
        """Roll, pitch and heading, if the last attitude is of this very instant."""
        attitude_ns = _utc_ns(self._attitude.get("time"))
        if attitude_ns is None or abs(attitude_ns - utc) > ATTITUDE_SLACK_NS:
            return None, None, None
        angles = [_number(self._attitude, key) for key in ("roll", "pitch", "heading")]
        roll, pitch, heading = (None if angle is None else angle * _RADIAN for angle in angles)
        return roll, pitch, heading


_READ: Final = {
    "VERSION": GpsdReports._version,
    "DEVICES": GpsdReports._device_list,
    "SKY": GpsdReports._sky,
    "ATT": GpsdReports._att,
    "PPS": GpsdReports._pps,
    "ERROR": GpsdReports._error,
}
_KNOWN: Final = ("TPV", "DEVICE", "WATCH", "TOFF", "GST", "IMU", "OSC", "RAW", "SUBFRAME")


def _number(report: Mapping[str, Any], key: str) -> float | None:
    value = report.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) and abs(number) < 1e9 else None


def _sigma(report: Mapping[str, Any], key: str, most: float) -> float | None:
    value = _number(report, key)
    return value if value is not None and 0 < value < most else None


def _horizontal_sigma_m(report: Mapping[str, Any]) -> float | None:
    east, north = _sigma(report, "epx", SIGMA_MAX_M), _sigma(report, "epy", SIGMA_MAX_M)
    if _number(report, "eph") is not None or east is None or north is None:
        return _sigma(report, "eph", SIGMA_MAX_M)
    return math.hypot(east, north)


def _velocity(report: Mapping[str, Any]) -> tuple[Velocity | None, float | None]:
    """North, east, down in m/s, and sigma of the speed; None where not reported."""
    north, east, down = (_number(report, key) for key in ("velN", "velE", "velD"))
    speed, track, climb = (_number(report, key) for key in ("speed", "track", "climb"))
    if speed is not None and (track is not None or speed == 0):
        # A speed of 0 has no course.
        north = speed * math.cos((track or 0.0) * _RADIAN)
        east = speed * math.sin((track or 0.0) * _RADIAN)
    if climb is not None:
        down = -climb
    if north is None or east is None:
        return None, None
    return (north, east, down), _sigma(report, "eps", SIGMA_MAX_MPS)


def _utc_ns(text: object) -> int | None:
    """An ISO 8601 instant as nanoseconds since the GPS epoch without leap seconds."""
    match = _UTC.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        return None
    year, month, day, hour, minute, second = (int(part) for part in match.groups()[:6])
    nano = int((match[7] or "").ljust(9, "0"))
    return utc_ns(UtcFields(year, month, day, hour, minute, second, nano))

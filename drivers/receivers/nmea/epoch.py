"""Data of all sentences of one UTC time: position, height, fix, sigmas, velocity.

Taking a sentence apart is in `drivers.receivers.nmea.sentences`, GPS time and samples in
`drivers.receivers.nmea.decoder`.

Source: NMEA 0183 as published in gpsd's "NMEA Revealed"; u-blox M8 receiver description
UBX-13003221, chapter 31 ($PUBX); Trimble's $PTNL,GGK; Garmin's $PGRME; $PASHR as inertial systems
send it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

from drivers.receivers.nmea.sentences import (
    day_number,
    day_of,
    dop_or_none,
    number,
    number_or_none,
    position_of,
    resolution_deg,
)

KNOT_MPS: Final = 1852 / 3600
KMH_MPS: Final = 1 / 3.6
QUALITIES: Final = {0: "none", 6: "dead-reckoning", 7: "none", 8: "none"}
"""By GGA quality: 7 is entered by hand, 8 is simulated; every other one is a fix."""
MODES: Final = {"N": "none", "M": "none", "S": "none", "E": "dead-reckoning"}
"""By mode indicator of RMC, GLL, VTG: no fix, manual, simulated, estimated; others are fixes."""
GGK_QUALITIES: Final = {0: "none"}
PUBX_STATUS: Final = {
    "NF": "none", "TT": "time", "DR": "dead-reckoning", "RK": "dead-reckoning",
    "G2": "2d", "D2": "2d", "G3": "3d", "D3": "3d",
}  # fmt: skip
DRMS_OF_CEP: Final = math.sqrt(2 / (2 * math.log(2)))
"""Garmin's horizontal error is a circle that holds one half; ours is the root of both variances."""
SIGMA_OF_PROBABLE: Final = 1 / 0.674490
SAME_POSITION_DIGITS: Final = 2.0
SAME_POSITION_DEG: Final = 2e-5
"""Two sentences of one time may give positions so many last digits, and so far, apart: 2 m."""

Fields = list[str]


@dataclass
class Epoch:
    """What has come for one UTC time of day.

    `fixes` are the words of the sentences about the fix; the worst one counts.
    """

    time: tuple[int, bool]
    """Time of day in ns, and whether that is within a leap second."""
    mono_ns: int
    kinds: set[str] = field(default_factory=set)
    day: int | None = None
    fixes: set[str] = field(default_factory=set)
    position: tuple[float, float] | None = None
    position_rank: int = 0
    resolution_deg: float = 0.0
    is_contradictory: bool = False
    above_geoid_m: float | None = None
    undulation_m: float | None = None
    ellipsoidal_m: float | None = None
    satellites: int | None = None
    hdop: float | None = None
    vdop: float | None = None
    horizontal_sigma_m: float | None = None
    vertical_sigma_m: float | None = None
    speed_mps: float | None = None
    course_rad: float | None = None
    down_mps: float | None = None
    heading_rad: float | None = None
    roll_rad: float | None = None
    pitch_rad: float | None = None
    is_complete: bool = False

    @property
    def fix(self) -> str:
        """The worst reported fix status; "none" if there is none."""
        for fix_status in ("none", "time", "dead-reckoning"):
            if fix_status in self.fixes:
                return fix_status
        if not self.fixes or self.position is None or self.is_contradictory:
            return "none"
        return "2d" if "2d" in self.fixes else "3d"

    def height_m(self, undulation_m: float | None) -> float | None:
        """Height above the ellipsoid.

        Args:
            undulation_m: geoid above ellipsoid, m, if the receiver does not send it; None if
            unknown.

        Returns:
            Height, m; None if none was received, or only one above the geoid without undulation.
        """
        if self.ellipsoidal_m is not None:
            return self.ellipsoidal_m
        undulation_m = self.undulation_m if self.undulation_m is not None else undulation_m
        if self.above_geoid_m is None or undulation_m is None:
            return None
        return self.above_geoid_m + undulation_m

    def add(self, kind: str, fields: Fields) -> None:
        """Add the content of a sentence.

        Args:
            kind: key of SENTENCES.
            fields: address and fields of the sentence.

        Raises:
            ValueError, IndexError: the content is invalid; the epoch may hold a part of it.
        """
        SENTENCES[kind](self, fields)
        self.kinds.add(kind)

    def _set_position(self, fields: Fields, rank: int) -> None:
        """A position, in four fields; that of the highest rank counts.

        One that contradicts another of the same time by more than its digits makes both unusable:
        a sentence was damaged in spite of its checksum, or belongs to another time.
        """
        position = position_of(fields)
        if position is None:
            return
        resolution = max(resolution_deg(fields[0]), resolution_deg(fields[2]))
        if self.position is not None:
            allowed = SAME_POSITION_DEG + SAME_POSITION_DIGITS * max(
                resolution, self.resolution_deg
            )
            north = abs(position[0] - self.position[0])
            east = abs(math.remainder(position[1] - self.position[1], 360))
            east *= math.cos(math.radians(position[0]))
            self.is_contradictory |= max(north, east) > allowed
        if rank > self.position_rank:
            self.position, self.position_rank = position, rank
            self.resolution_deg = resolution

    def _add_fix(self, fix_status: str) -> bool:
        """Note a word about the fix; whether it comes with a position.

        Without one the other fields mean nothing: receivers fill them with what they like.
        """
        self.fixes.add(fix_status)
        return fix_status not in ("none", "time")

    def _mode(self, status: str, mode: str) -> bool:
        """Status A or V, and the mode indicator where the version has one. See `_add_fix`."""
        return self._add_fix("none" if status != "A" else MODES.get(mode, "fix"))

    # Sentences

    def _rmc(self, fields: Fields) -> None:
        if not self._mode(fields[2], fields[12] if len(fields) > 12 else ""):
            return
        self._set_position(fields[3:7], rank=2)
        speed, course = number_or_none(fields[7]), number_or_none(fields[8])
        if fields[9]:
            self.day = day_of(fields[9])
        if speed is not None:
            self.speed_mps = speed * KNOT_MPS
        if course is not None:
            self.course_rad = math.radians(course)

    def _gga(self, fields: Fields) -> None:
        quality = int(number(fields[6] or "0"))
        self._satellites(fields[7])
        if not self._add_fix(QUALITIES.get(quality, "fix")):
            return
        self.hdop = dop_or_none(fields[8]) or self.hdop
        self._set_position(fields[2:6], rank=4)
        self._heights(fields[9:13:2], fields[10:13:2])

    def _gns(self, fields: Fields) -> None:
        modes = {MODES.get(mode, "fix") for mode in fields[6]}
        self._satellites(fields[7])
        if not self._add_fix(
            next(
                (fix_status for fix_status in ("fix", "dead-reckoning") if fix_status in modes),
                "none",
            )
        ):
            return
        self.hdop = dop_or_none(fields[8]) or self.hdop
        self._set_position(fields[2:6], rank=5)
        self._heights(fields[9:11])

    def _gll(self, fields: Fields) -> None:
        # Quirk: before version 2.3, GLL has neither time nor status.
        # Upstream: manual: gpsd's NMEA Revealed, GLL.
        if self._mode(fields[6], fields[7] if len(fields) > 7 else ""):
            self._set_position(fields[1:5], rank=1)

    def _gst(self, fields: Fields) -> None:
        self._sigmas(*(number_or_none(fields[n]) for n in (6, 7, 8)))

    def _gbs(self, fields: Fields) -> None:
        if self.horizontal_sigma_m is None:
            self._sigmas(*(number_or_none(fields[n]) for n in (2, 3, 4)))

    def _zda(self, fields: Fields) -> None:
        if all(fields[2:5]):
            day, month, year = (int(number(text)) for text in fields[2:5])
            self.day = day_number(year, month, day)

    def _vtg(self, fields: Fields) -> None:
        # Quirk: before version 2, VTG has course and speed in knots without letters between them.
        # Upstream: manual: gpsd's NMEA Revealed, VTG.
        if len(fields) > 2 and fields[2] not in ("T", ""):
            fields = [fields[0], fields[1], "T", "", "", fields[3], "N", ""]
        course, knots = number_or_none(fields[1]), number_or_none(fields[5])
        kmh = number_or_none(fields[7]) if len(fields) > 7 else None
        # RMC of the same epoch has a time of its own, VTG has none.
        if self.course_rad is None and course is not None:
            self.course_rad = math.radians(course)
        if self.speed_mps is None and kmh is not None:
            self.speed_mps = kmh * KMH_MPS
        elif self.speed_mps is None and knots is not None:
            self.speed_mps = knots * KNOT_MPS

    def _hdt(self, fields: Fields) -> None:
        heading = number_or_none(fields[1])
        if heading is not None:
            self.heading_rad = math.radians(heading)

    def _gsa(self, fields: Fields) -> None:
        # One for each constellation; only a 2d fix is new: that there is none, others say with it.
        if fields[2] == "2":
            self._add_fix("2d")
        self.hdop = self.hdop or dop_or_none(fields[16])
        self.vdop = dop_or_none(fields[17])

    def _pashr(self, fields: Fields) -> None:
        heading, roll, pitch = (number_or_none(fields[n]) for n in (2, 4, 5))
        if heading is not None:
            self.heading_rad = math.radians(heading)
        self.roll_rad = None if roll is None else math.radians(roll)
        self.pitch_rad = None if pitch is None else math.radians(pitch)

    def _pgrme(self, fields: Fields) -> None:
        circle, vertical = number_or_none(fields[1]), number_or_none(fields[3])
        if circle and self.horizontal_sigma_m is None:
            self.horizontal_sigma_m = circle * DRMS_OF_CEP
            self.vertical_sigma_m = vertical * SIGMA_OF_PROBABLE if vertical else None

    def _pubx(self, fields: Fields) -> None:
        """PUBX,00: position and its accuracy."""
        fix_status = PUBX_STATUS.get(fields[8], "none")
        if not self._add_fix(fix_status):
            return
        self._set_position(fields[3:7], rank=3)
        if fix_status == "3d":
            self.ellipsoidal_m = number_or_none(fields[7])
        if self.horizontal_sigma_m is None:
            self.horizontal_sigma_m = number_or_none(fields[9]) or None
            self.vertical_sigma_m = number_or_none(fields[10]) or None
        speed, course, down = (number_or_none(text) for text in fields[11:14])
        if speed is not None and self.speed_mps is None:
            self.speed_mps = speed * KMH_MPS
        if course is not None and self.course_rad is None:
            self.course_rad = math.radians(course)
        self.down_mps = down
        self.hdop = self.hdop or dop_or_none(fields[15])
        self.vdop = self.vdop or dop_or_none(fields[16])
        if self.satellites is None:
            self._satellites(fields[18])

    def _ptnl(self, fields: Fields) -> None:
        """PTNL,GGK: position with the height above the ellipsoid."""
        if fields[3]:
            month_day = fields[3]
            self.day = day_of(month_day[2:4] + month_day[:2] + month_day[4:])
        self._satellites(fields[9])
        if not self._add_fix(GGK_QUALITIES.get(int(number(fields[8] or "0")), "fix")):
            return
        self._set_position(fields[4:8], rank=6)
        if fields[11].startswith("EHT"):
            self.ellipsoidal_m = number_or_none(fields[11][3:])

    def _satellites(self, text: str) -> None:
        count = number_or_none(text)
        self.satellites = self.satellites if count is None else int(count)

    def _heights(self, values: Fields, units: Iterable[str] = ()) -> None:
        if any(unit not in ("M", "") for unit in units):
            raise ValueError("a height that is not in metres")
        height, undulation = (number_or_none(text) for text in values)
        if height is not None:
            self.above_geoid_m = height
        if undulation is not None:
            self.undulation_m = undulation

    def _sigmas(
        self, latitude_m: float | None, longitude_m: float | None, height_m: float | None
    ) -> None:
        # No receiver knows a position exactly: zeros mean that it does not estimate.
        if latitude_m and longitude_m:
            self.horizontal_sigma_m = math.hypot(latitude_m, longitude_m)
            self.vertical_sigma_m = height_m or None


SENTENCES: Final[Mapping[str, Callable[[Epoch, Fields], None]]] = {
    "RMC": Epoch._rmc, "GGA": Epoch._gga, "GNS": Epoch._gns, "GLL": Epoch._gll,
    "GST": Epoch._gst, "GBS": Epoch._gbs, "ZDA": Epoch._zda, "PASHR": Epoch._pashr,
    "PUBX,00": Epoch._pubx, "PTNL,GGK": Epoch._ptnl,
    "VTG": Epoch._vtg, "HDT": Epoch._hdt, "GSA": Epoch._gsa, "PGRME": Epoch._pgrme,
}  # fmt: skip
TIME_AT: Final = {
    "RMC": 1, "GGA": 1, "GNS": 1, "GLL": 5, "GST": 1, "GBS": 1, "ZDA": 1, "PASHR": 1,
    "PUBX,00": 2, "PTNL,GGK": 2,
}  # fmt: skip
"""In which field the time of day is; sentences without one belong to the epoch that runs."""

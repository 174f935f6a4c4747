"""Exposure settings of the heads, set by an operator or by automatic exposure control.

Automatic control is `processing.radiometry.exposure_control`. All PAN cones share one setting, so
that their images match. Every other cone has its own. Settings change between exposures only, and
not on a line on which they have converged.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any, Protocol

from daemon.configuration.model import Configuration, ExposureSection
from daemon.onboard.service.messages import ApplyExposureSettings
from daemon.orientation.navigation import Track
from processing.radiometry.exposure_control import (
    ExposureLimits,
    ExposureSettings,
    next_settings,
)
from processing.rig import Cone, Rig

PAN = "pan"
EXPOSURES_REMEMBERED = 64
"""Number of exposures whose settings are kept."""

CHANGED_US, CHANGED_DB = 0.05, 0.005


class FlightView(Protocol):
    """The part of `daemon.onboard.flight.flight.Flight` that is used here."""

    track: Track

    @property
    def awaits_frames(self) -> bool: ...


class ExposureController:
    """The exposure settings of a flight, by group: "pan", or a cone's name.

    Args:
        configuration: initial settings of the heads, and their limits.
        rig: the camera.
        flight: source of positions; states whether heads are exposing or sending.
        send: sends a message to a process, by its name.
        emit: emits an event for every change, with its author.
    """

    def __init__(
        self,
        configuration: Configuration,
        rig: Rig,
        flight: FlightView,
        send: Callable[[str, object], None],
        emit: Callable[..., None],
    ) -> None:
        self._section: ExposureSection = configuration.exposure
        self._plan = configuration.plan
        self._flight = flight
        self._send = send
        self._emit = emit
        self.is_automatic = self._section.control == "automatic"
        self._heads: dict[str, list[str]] = {}
        self._cones: dict[str, Cone] = {}
        self.settings: dict[str, ExposureSettings] = {}
        self._tdi_shifts_max: dict[str, int] = {}
        for head in configuration.head:
            cone = rig.cone_of(head.sensor)
            group = PAN if cone.role == "pan" else cone.name
            self._heads.setdefault(group, []).append(head.sensor)
            if group not in self.settings:
                shifts = int(head.settings.get("tdi_shifts", 0))
                self._cones[group] = cone
                self._tdi_shifts_max[group] = self._section.tdi_shifts_max if shifts else 0
                self.settings[group] = ExposureSettings(
                    float(head.settings.get("exposure_time_us", 1000.0)),
                    float(head.settings.get("gain_db", 0.0)),
                    shifts,
                )
        self._rig = rig
        self._requested = dict(self.settings)
        self._used: dict[int, tuple[str, dict[str, ExposureSettings]]] = {}
        self._by = "automatic"
        self._is_reported = False
        self._locked_line: str | None = None

    @property
    def times_ns(self) -> dict[str, int]:
        """Exposure time in force, by cone."""
        return {
            cone.name: round(self.settings[group].exposure_time_us * 1000)
            for cone in self._rig.cones
            if (group := PAN if cone.role == "pan" else cone.name) in self.settings
        }

    def ordered(self, number: int, line_id: str) -> None:
        """Record that an exposure uses the present settings."""
        self._used[number] = (line_id, dict(self.settings))
        self._used.pop(number - EXPOSURES_REMEMBERED, None)
        if self._locked_line not in (None, line_id):
            self._lock_settings(None)

    def update_from_histograms(self, number: int, histograms: Mapping[str, Sequence[int]]) -> None:
        """Compute the next settings from the raw histograms of an exposure."""
        if not self.is_automatic or number not in self._used or not histograms:
            return
        line_id, used = self._used[number]
        if line_id and line_id == self._locked_line:
            return
        for group, heads in self._heads.items():
            columns = [histograms[head] for head in heads if head in histograms]
            counts = [sum(bins) for bins in zip(*columns, strict=True)]
            limits = self.limits(group)
            self._requested[group] = (
                next_settings(counts, used[group], limits) if counts else used[group]
            )
        self._by = "automatic"
        is_converged = all(_nearly_equal(self._requested[group], used[group]) for group in used)
        if is_converged and line_id and self._section.lock == "line":
            self._lock_settings(line_id)

    def _lock_settings(self, line_id: str | None) -> None:
        """Lock the settings on this line; None unlocks them."""
        self._locked_line = line_id
        self._emit("exposure-settings", by="automatic", **self.as_json())

    def apply(self) -> bool:
        """Send requested settings to the heads between exposures; True if they were sent."""
        if not self._is_reported:
            self._is_reported = True
            self._emit("exposure-settings", by="configuration", **self.as_json())
        changed = [
            g for g, now in self.settings.items() if not _nearly_equal(now, self._requested[g])
        ]
        if not changed or self._flight.awaits_frames:
            return False
        for group in changed:
            self.settings[group] = self._requested[group]
        heads = {head: self._requested[group] for group in changed for head in self._heads[group]}
        self._send("capture", ApplyExposureSettings(heads))
        self._emit("exposure-settings", by=self._by, **self.as_json())
        return True

    def as_json(self) -> dict[str, Any]:
        """Control mode and settings as plain JSON types, for the page and the API."""
        return {
            "control": "automatic" if self.is_automatic else "manual",
            "lock": self._section.lock,
            "locked_on": self._locked_line,
            "settings": {group: asdict(one) for group, one in self.settings.items()},
        }

    def command(self, requested: Mapping[str, Any], by: str) -> str | None:
        """Apply an operator's request; return the reason if it is refused, else None.

        `requested` may hold `control`, and `exposure_time_us`, `gain_db`, `tdi_shifts` for the
        group `of`, or for all groups. Manual settings switch automatic control off.
        """
        keys = ("exposure_time_us", "gain_db", "tdi_shifts")
        given = {key: requested[key] for key in keys if requested.get(key) is not None}
        control, group = requested.get("control"), requested.get("of")
        if control is None and not given:
            return "exposure needs control, or exposure_time_us, gain_db, tdi_shifts"
        if control == "automatic" and given:
            return "automatic control chooses the settings; give control or settings, not both"
        if group is not None and group not in self.settings:
            return f"there is no {group!r} to expose; there is {', '.join(self.settings)}"
        updated = dict(self._requested)
        for name in [group] if group else self.settings if given else []:
            updated[name] = ExposureSettings(**{**asdict(self._requested[name]), **given})
            if (refusal := self._refusal(name, updated[name])) is not None:
                return refusal
        self.is_automatic = control == "automatic"
        self._requested, self._by, self._locked_line = updated, by, None
        if not given:
            self._requested = dict(self.settings)
            self._emit("exposure-settings", by=by, **self.as_json())
        return None

    def limits(self, group: str) -> ExposureLimits:
        """Limits of a group from the last position's height and speed, else from the plan."""
        position = self._flight.track.last
        section, cone = self._section, self._cones[group]
        speed_mps, height_m = self._plan.ground_speed_mps, self._plan.height_above_ground_m
        crab_rad = 0.0
        if position is not None and position.height_m is not None:
            height_m = position.height_m - self._plan.ground_height_m
        if position is not None and position.velocity_ned_mps is not None:
            north, east = position.velocity_ned_mps[:2]
            speed_mps = math.hypot(north, east)
            if position.heading_rad is not None and speed_mps > 1.0:
                crab_rad = math.remainder(position.heading_rad - math.atan2(east, north), math.tau)
        sensor = cone.sensors[0]
        is_moving = height_m > 1.0 and speed_mps > 1.0
        gsd_m = sensor.pitch_mm * height_m / cone.lens.f_mm
        return ExposureLimits(
            exposure_time_min_us=section.exposure_time_min_us,
            exposure_time_max_us=section.exposure_time_max_us,
            gain_max_db=section.gain_max_db,
            tdi_shifts_max=self._tdi_shifts_max[group],
            rows_per_s=speed_mps / gsd_m if is_moving else None,
            smear_px=section.smear_px,
            crab_rad=crab_rad if abs(crab_rad) < math.pi / 4 else 0.0,
            target=section.target,
            black=sensor.black_dn / sensor.full_scale_dn,
        )

    def _refusal(self, group: str, requested: ExposureSettings) -> str | None:
        limits = self.limits(group)
        low_us, high_us = limits.exposure_time_min_us, limits.exposure_time_max_us
        if not low_us <= requested.exposure_time_us <= high_us:
            return f"exposure_time_us is {requested.exposure_time_us:g}; {low_us:g} to {high_us:g}"
        if not 0.0 <= requested.gain_db <= limits.gain_max_db:
            return f"gain_db is {requested.gain_db:g}; 0 to {limits.gain_max_db:g}"
        if not 0 <= requested.tdi_shifts <= limits.tdi_shifts_max:
            return f"tdi_shifts is {requested.tdi_shifts} for {group}; 0 to {limits.tdi_shifts_max}"
        return None


def _nearly_equal(one: ExposureSettings, other: ExposureSettings) -> bool:
    return (
        abs(one.exposure_time_us - other.exposure_time_us) < CHANGED_US
        and abs(one.gain_db - other.gain_db) < CHANGED_DB
        and one.tdi_shifts == other.tdi_shifts
    )

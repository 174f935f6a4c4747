"""State of the flight, gathered from the service's events, for complete or incremental telemetry.

Pure: events in, JSON types out. Events may be missing, since the connection to the service drops
events when it is full. The `status` event corrects the essential state once a second.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from daemon.mission.operator_decisions import OperatorDecision, manual_verdicts, summary_of
from daemon.onboard.flight.fault_latches import (
    DELIVERING,
    FIXED,
    SEARCHING,
    UNAVAILABLE,
    FaultLatches,
)
from daemon.onboard.flight.phases import Phase
from daemon.onboard.monitoring.finite_values import finite, is_place, places_or_none
from daemon.onboard.monitoring.live_map_state import LiveMapState
from daemon.onboard.monitoring.previews import Preview
from processing.quality.figures import QualityFigures
from processing.quality.figures.circumstances import DcFigures, EstimatedDcFigures
from processing.quality.figures.stitching import AdjustmentFigures

PHASES = frozenset(phase.value for phase in Phase)
EXPOSURES_MAX = 2000
"""In the snapshot; earlier ones are on disk, and `/exposures` reports them."""
FOOTPRINTS_MAX = 50_000
"""Exposures before those of the snapshot, of which footprint and verdict are kept."""
FOOTPRINT_DIGITS = 6
"""Decimals of a degree: 0.1 m."""
EVENTS_MAX = 500
HISTORY_MAX = 7200
FIGURES_REPORTED = (
    *("sigma0_px", "sigma0_um", "tie_points_pp", "tie_points_pc", "outliers", "dc_k"),
    *("dc_estimated_k", "dc_estimated_sigma_k", "displaced_sensor", "gsd_m", "tilt_deg"),
    *("crab_deg", "sharpness", "saturated_fraction", "mean_dn", "valid_fraction", "method"),
    *("forward_overlap", "sidelap", "sun_deg", "time_sigma_ns", "bright_fraction"),
    *("stitched_sigma_px", "missing_sensors", "smear_along_px", "smear_across_px"),
)
PARTS = ("exposures", "devices", "settings", "track", "history", "events")
"""Parts of the state in addition to the brief, in order of priority on a slow link."""

PREVIEW_PARTS = ("residuals", "thumbnails")
"""Parts of lowest priority, for clients without the page; not in the snapshot."""

RESIDUALS_MAX, PIECES_MAX = 5, 40

PLACE_KEYS = (
    *("latitude_deg", "longitude_deg", "height_m"),
    *("roll_rad", "pitch_rad", "heading_rad", "leap_seconds"),
)
VERDICT_RANK = {"good": 0, "usable": 1, "refly": 2}

Json = dict[str, Any]


class FlightState:
    """The state of one flight, for monitoring clients.

    `sequence` grows with every event, so that a client detects missing events.
    """

    def __init__(
        self,
        software: str,
        footprint: Callable[[Mapping[str, Any]], Any] = lambda _: None,
        pictures: Callable[[str | None, int], Preview] = lambda _mission, _number: Preview(),
    ) -> None:
        """`footprint` computes the corners of an exposure from its navigation, or None.

        `pictures` reads the preview of an exposure of a mission.
        """
        self.sequence = 0
        self._footprint = footprint
        self._pictures = pictures
        self._residuals: deque[Json] = deque(maxlen=RESIDUALS_MAX)
        self._pieces: deque[Json] = deque(maxlen=PIECES_MAX)
        self._software = software
        self._settings: list[Json] = []
        self._phase = "idle"
        self._mission: Json = {}
        self._status: Json = {}
        self._devices: dict[str, Json] = {}
        self._counters: Mapping[str, Any] = {}
        self._latches = FaultLatches()
        self._exposures: dict[int, Json] = {}
        self._dropped_verdicts = dict.fromkeys(VERDICT_RANK, 0)
        """Counts of verdicts of dropped exposures, so that totals do not decrease."""
        self._dropped: dict[int, Json] = {}
        self._temperatures: dict[int, Any] = {}
        self._events: deque[Json] = deque(maxlen=EVENTS_MAX)
        self._history: deque[Json] = deque(maxlen=HISTORY_MAX)
        self._track: deque[Json] = deque(maxlen=HISTORY_MAX)
        self._retakes: list[Json] = []
        self._triangulation: Json = {}
        self.live_map = LiveMapState()
        self._landing: Json = {}
        self.guidance: Mapping[str, Any] = {}
        """The last guidance; it has no sequence, since the next one replaces it."""
        self.guidance_count = 0

    def apply(self, event: Mapping[str, Any]) -> None:
        """Apply one event of the service; an unknown kind is only listed."""
        event = finite(event)
        if event.get("event") == "guidance":
            self.guidance = {key: value for key, value in event.items() if key != "event"}
            self.guidance_count += 1
            return
        self.sequence += 1
        kind = str(event.get("event", ""))
        self._latches.apply(event, sequence=self.sequence)
        handler = _HANDLERS.get(kind)
        if handler is not None:
            handler(self, event)
        if kind not in (
            "status",
            "counters",
            "judged",
            "processed",
            "triangulated",
            "triangulation",
            "orthomosaic",
            "landing-action",
        ):
            self._events.append({"sequence": self.sequence, **event})

    def brief(self) -> Json:
        """The essential state; a few hundred bytes."""
        return {
            "sequence": self.sequence,
            "software": self._software,
            "phase": self._phase,
            "mission": self._mission,
            "simulated": bool(self._mission.get("simulated")),
            "status": self._status,
            "faults": self.faults(),
            "last_number": max(self._exposures, default=None),
            "verdicts": self._verdict_counts(),
            **({"retakes": len(self._retakes)} if self._retakes else {}),
            **({"landing": self._landing} if self._landing else {}),
            **({"orthomosaic": self.live_map.version} if self.live_map.version else {}),
        }

    def changed(self, part: str, after: int) -> list[Json]:
        """Items of one of PARTS or PREVIEW_PARTS that are newer than a sequence.

        Ordered by sequence, so that a client may receive the first items now and the rest later.
        """
        items: Iterable[Json] = {
            "exposures": self._exposures.values(),
            "devices": self._devices.values(),
            "settings": self._settings,
            "track": self._track,
            "history": self._history,
            "events": self._events,
            "residuals": self._residuals,
            "thumbnails": self._pieces,
        }[part]
        newer = [item for item in items if item["sequence"] > after]
        return sorted(newer, key=lambda item: item["sequence"])

    def devices(self) -> list[Json]:
        """Every device with its counters, which are not part of telemetry: they change always."""
        listed = self.changed("devices", 0)
        return [{**device, "counters": self._counters.get(device["name"], {})} for device in listed]

    def snapshot(self) -> Json:
        """The complete state, for a new client."""
        return {"version": 1, **self.brief(), **{part: self.changed(part, 0) for part in PARTS}}

    @property
    def phase(self) -> str:
        return self._phase

    @property
    def mission_path(self) -> str | None:
        path = self._mission.get("path")
        return path if isinstance(path, str) else None

    def faults(self) -> list[Json]:
        """Active faults and cleared, unacknowledged ones; the newest first."""
        return self._latches.listed()

    def exposures(self, after: int = 0, limit: int = EXPOSURES_MAX) -> list[Json]:
        found = [record for number, record in sorted(self._exposures.items()) if number > after]
        return found[:limit]

    def exposure(self, number: int) -> Json | None:
        """One exposure; one before those of the snapshot has only what the map shows of it."""
        found = self._exposures.get(number)
        if found is None and (dropped := self._dropped.get(number)) is not None:
            step = "lost" if dropped["verdict"] == "lost" else "processed"
            return {**dropped, "sequence": 0, "step": step, "flags": [], "findings": []}
        return found

    def older_footprints(self, newest: int = EXPOSURES_MAX) -> list[Json]:
        """Number, verdict and footprint of all but the newest exposures, oldest first."""
        older = sorted(self._exposures)[:-newest]
        whole = (_reduced(number, self._exposures[number]) for number in older)
        dropped = (self._dropped[number] for number in sorted(self._dropped))
        return [*dropped, *(one for one in whole if one is not None)]

    def retakes(self) -> list[Json]:
        """Lines that were added to be flown again."""
        return list(self._retakes)

    def add_decisions(self, decisions: Sequence[OperatorDecision]) -> None:
        """Add the manual verdicts of an earlier run; received events take precedence."""
        for number, decision in manual_verdicts(decisions).items():
            record = self._exposures.get(number)
            if record is not None and "manual" not in record:
                self.sequence += 1
                record |= {"sequence": self.sequence, "manual": summary_of(decision)}

    def triangulation(self) -> Json:
        """The last state of the live triangulation; empty where it is off."""
        return self._triangulation

    def acknowledge(self, fault: str, by: str = "") -> bool:
        """Acknowledge a fault. A cleared one leaves the list; an active one stays."""
        self.sequence += 1
        return self._latches.acknowledge(fault, by)

    def add_sealed(self, sealed: Mapping[str, Any], report: Mapping[str, Any] | None) -> None:
        """Add an earlier exposure from its files; received events take precedence."""
        number = sealed["number"]
        if number in self._exposures:
            return
        self.sequence += 1
        self._on_sealed(sealed)
        if sealed["state"] == "lost":
            self._exposure(sealed)["step"] = "lost"
        elif report is not None:
            self._apply_products({"number": number, "report": report})

    # Handlers by event

    def _on_mission(self, event: Mapping[str, Any]) -> None:
        if self._mission and self._mission["id"] != event.get("id"):
            self._forget_flight()
        self._mission = {
            key: event.get(key) for key in ("id", "path", "resumed", "rig", "simulated", "recovery")
        }
        self._phase = "idle"
        self._retakes.clear()
        self._triangulation = {}
        self.live_map.clear()
        self._landing = {}

    def _on_bound(self, event: Mapping[str, Any]) -> None:
        device = self._device(str(event.get("device")))
        device |= {"kind": event.get("kind"), "found": event.get("found", {})}
        if device["state"] == "unknown":
            # A trigger unit has nothing to open; other devices report when they deliver.
            device["state"] = "ready" if event.get("kind") == "trigger" else "found"

    def _on_device(self, event: Mapping[str, Any]) -> None:
        name = str(event.get("device"))
        device = self._device(name)
        device["sentence"] = event.get("sentence", "")
        device["since_mono_ns"] = event.get("mono_ns")
        if event.get("name") in UNAVAILABLE:
            device["state"] = "absent" if event.get("name") == "absent" else "lost"
        elif event.get("name") == SEARCHING:
            device["state"] = "searching"
        elif event.get("name") in DELIVERING or event.get("name") == FIXED:
            device["state"] = "ready"

    def _on_counters(self, event: Mapping[str, Any]) -> None:
        counters = event.get("devices")
        self._counters = counters if isinstance(counters, Mapping) else {}

    def _on_fault(self, event: Mapping[str, Any]) -> None:
        self._phase = "fault"

    def _on_phase(self, event: Mapping[str, Any]) -> None:
        phase = event.get("phase")
        if phase in PHASES:
            self._phase = str(phase)

    def _on_status(self, event: Mapping[str, Any]) -> None:
        status = {key: value for key, value in event.items() if key != "event"}
        self._status = status
        phase = status.get("phase")
        if phase in PHASES and self._phase != "fault":
            self._phase = str(phase)
        position = status.get("position")
        if isinstance(position, Mapping):
            at = [position.get("latitude_deg"), position.get("longitude_deg")]
            if not is_place(*at):
                self._status = {**status, "position": None}
            elif not self._track or self._track[-1]["at"] != at:
                self._track.append({"sequence": self.sequence, "at": at})

    def _on_triggered(self, event: Mapping[str, Any]) -> None:
        self._exposure(event)["step"] = "triggered"

    def _on_exposure_settings(self, event: Mapping[str, Any]) -> None:
        record = {key: value for key, value in event.items() if key not in ("event", "mono_ns")}
        self._settings = [{"sequence": self.sequence, **record}]

    def _on_stored(self, event: Mapping[str, Any]) -> None:
        self._exposure(event)["step"] = "stored"

    def _on_sealed(self, event: Mapping[str, Any]) -> None:
        record = self._exposure(event)
        left_out = ("event", "mono_ns", "navigation", "temperatures_c")
        record |= {key: value for key, value in event.items() if key not in left_out}
        record["step"] = "sealed"
        self._temperatures[record["number"]] = event.get("temperatures_c", {})
        if event.get("navigation"):
            record["footprint"] = places_or_none(self._footprint(event["navigation"]))
            record["place"] = {key: event["navigation"].get(key) for key in PLACE_KEYS}

    def _on_verdict(self, event: Mapping[str, Any]) -> None:
        """Apply the verdict, which precedes the pictures."""
        record = self._exposure(event)
        record.setdefault("verdict_mono_ns", event.get("mono_ns"))
        report = event.get("report", {})
        _apply_report(record, report)
        figures = report.get("figures", {})
        record["figures"] = {key: figures[key] for key in FIGURES_REPORTED if key in figures}
        if report.get("valid_area"):
            record["valid_area"] = report["valid_area"]

    def _on_processed(self, event: Mapping[str, Any]) -> None:
        self._apply_products(event)
        self._add_preview(int(event["number"]))

    def _apply_products(self, event: Mapping[str, Any]) -> None:
        self._on_verdict(event)
        record = self._exposure(event)
        figures = QualityFigures.from_json(event.get("report", {}).get("figures", {}))
        record["step"] = "processed"
        record["duration_s"] = event.get("duration_s")
        self._history.append(
            {
                "sequence": self.sequence,
                "number": record["number"],
                "sigma0_px": figures.of(AdjustmentFigures).sigma0_px,
                "dc_k": figures.of(DcFigures).dc_k,
                "dc_estimated_k": figures.of(EstimatedDcFigures).dc_estimated_k,
                "time_sigma_ns": record.get("mark_sigma_ns"),
                "temperatures_c": self._temperatures.pop(record["number"], {}),
            }
        )

    def _add_preview(self, number: int) -> None:
        """Each piece is sent separately and has a sequence of its own."""
        found = self._pictures(self.mission_path, number)
        if found.vectors:
            residuals = {"number": number, "size_px": found.size_px, "vectors": found.vectors}
            self.sequence += 1
            self._residuals.append({"sequence": self.sequence, **residuals})
        for piece, data in enumerate(found.pieces):
            self.sequence += 1
            about = {"number": number, "piece": piece, "pieces": len(found.pieces)}
            self._pieces.append({"sequence": self.sequence, **about, "data": data})

    def _on_manual_verdict(self, event: Mapping[str, Any]) -> None:
        self._exposure(event)["manual"] = event.get("manual")

    def _on_retake(self, event: Mapping[str, Any]) -> None:
        keys = ("line", "of", "number", "by", "at", "places_m")
        self._retakes.append({key: event.get(key) for key in keys})

    def _on_triangulated(self, event: Mapping[str, Any]) -> None:
        latest = {key: value for key, value in event.items() if key not in ("event", "mono_ns")}
        self._triangulation = {**self._triangulation, "latest": latest}

    def _on_triangulation(self, event: Mapping[str, Any]) -> None:
        block = {key: value for key, value in event.items() if key not in ("event", "mono_ns")}
        self._triangulation = {**self._triangulation, "block": block}

    def _on_orthomosaic(self, event: Mapping[str, Any]) -> None:
        self.live_map.apply(event)

    def _on_not_processed(self, event: Mapping[str, Any]) -> None:
        record = self._exposure(event)
        record |= {"step": "not processed", "sentence": event.get("sentence")}
        _apply_report(record, event.get("report", {}))

    def _on_lost(self, event: Mapping[str, Any]) -> None:
        record = self._exposure(event)
        record |= {"step": "lost", "state": "lost", "sentence": event.get("cause")}
        record["verdict_mono_ns"] = event.get("mono_ns")

    def _on_not_written(self, event: Mapping[str, Any]) -> None:
        self._exposure(event)["step"] = "not written"

    def _on_landing(self, event: Mapping[str, Any]) -> None:
        self._landing = {key: event.get(key) for key in ("folders", "poweroff")} | {"actions": {}}

    def _on_landing_action(self, event: Mapping[str, Any]) -> None:
        known = {key: value for key, value in event.items() if key not in ("event", "mono_ns")}
        actions = {**self._landing.get("actions", {}), str(known.pop("action", "")): known}
        self._landing = {**self._landing, "actions": actions}

    def _on_ended(self, event: Mapping[str, Any]) -> None:
        self._phase = "landed" if event.get("failure") is None else "fault"
        self._status = {**self._status, "ledger": event.get("ledger")}

    # Bookkeeping

    def _forget_flight(self) -> None:
        """Exposures and curves are those of one mission; devices and faults outlive it."""
        for kept in (self._exposures, self._dropped, self._temperatures):
            kept.clear()
        for curve in (self._history, self._track, self._residuals, self._pieces):
            curve.clear()
        self._dropped_verdicts = dict.fromkeys(VERDICT_RANK, 0)
        self._status, self.guidance = {}, {}

    def _device(self, name: str) -> Json:
        initial: Json = {
            "name": name,
            "kind": None,
            "state": "unknown",
            "sentence": "",
            "found": {},
        }
        device = self._devices.setdefault(name, initial)
        device["sequence"] = self.sequence
        return device

    def _exposure(self, event: Mapping[str, Any]) -> Json:
        number = int(event["number"])
        record = self._exposures.setdefault(number, {"number": number, "step": "triggered"})
        record["sequence"] = self.sequence
        while len(self._exposures) > EXPOSURES_MAX:
            self._drop(min(self._exposures))
        return record

    def _drop(self, number: int) -> None:
        """Reduce an exposure to what the map shows of it."""
        dropped = self._exposures.pop(number)
        verdict = dropped.get("verdict")
        if verdict in self._dropped_verdicts:
            self._dropped_verdicts[verdict] += 1
        if (reduced := _reduced(number, dropped)) is not None:
            self._dropped[number] = reduced
        while len(self._dropped) > FOOTPRINTS_MAX:
            del self._dropped[next(iter(self._dropped))]

    def _verdict_counts(self) -> dict[str, int]:
        counts = dict(self._dropped_verdicts)
        for record in self._exposures.values():
            verdict = record.get("verdict")
            if verdict in counts:
                counts[verdict] += 1
        return counts


def _reduced(number: int, record: Json) -> Json | None:
    """Footprint and verdict of an exposure; None for one without a footprint."""
    if not record.get("footprint"):
        return None
    corners = [[round(x, FOOTPRINT_DIGITS) for x in one] for one in record["footprint"]]
    shown = "lost" if record.get("step") == "lost" else record.get("verdict")
    return {"number": number, "verdict": shown, "footprint": corners}


def _apply_report(record: Json, report: Mapping[str, Any]) -> None:
    """Copy a quality report into the record of its exposure."""
    record["verdict"] = report.get("verdict")
    record["flags"] = report.get("flags", [])
    record["findings"] = [
        {key: finding.get(key) for key in ("flag", "sentence", "verdict")}
        for finding in report.get("findings", [])
    ]


_HANDLERS: Mapping[str, Callable[[FlightState, Mapping[str, Any]], None]] = {
    "mission": FlightState._on_mission,
    "bound": FlightState._on_bound,
    "device": FlightState._on_device,
    "counters": FlightState._on_counters,
    "fault": FlightState._on_fault,
    "phase": FlightState._on_phase,
    "status": FlightState._on_status,
    "triggered": FlightState._on_triggered,
    "exposure-settings": FlightState._on_exposure_settings,
    "stored": FlightState._on_stored,
    "sealed": FlightState._on_sealed,
    "judged": FlightState._on_verdict,
    "processed": FlightState._on_processed,
    "triangulated": FlightState._on_triangulated,
    "triangulation": FlightState._on_triangulation,
    "orthomosaic": FlightState._on_orthomosaic,
    "not-processed": FlightState._on_not_processed,
    "manual-verdict": FlightState._on_manual_verdict,
    "retake": FlightState._on_retake,
    "not-written": FlightState._on_not_written,
    "lost": FlightState._on_lost,
    "landing": FlightState._on_landing,
    "landing-action": FlightState._on_landing_action,
    "ended": FlightState._on_ended,
}

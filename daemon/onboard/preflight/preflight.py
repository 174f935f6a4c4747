"""Phase of a running service: its prerequisites, arming and overrides.

The prerequisites are defined in `daemon.onboard.flight.arming`, the phases in
`daemon.onboard.flight.phases`. This module collects the state of the service.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from daemon.configuration.model import Configuration
from daemon.onboard.capture.device_states import DeviceStates
from daemon.onboard.capture.devices import stated_serial_problems
from daemon.onboard.flight.arming import (
    MissingPrerequisite,
    Readiness,
    absent_parts,
    missing_prerequisites,
)
from daemon.onboard.flight.flight import Flight
from daemon.onboard.flight.phases import Phase, PhaseInputs, PhaseMachine
from daemon.onboard.pipeline.pipeline_queue import PipelineQueue
from daemon.onboard.service.flight_line import FlightLine
from processing.rig import Rig

IMMEDIATE_START = 'the configuration (trigger.start = "immediate")'
"""Author of the override when the line starts without a command."""


class Preflight:
    """Evaluates the prerequisites of a service.

    `accepted` are the names of the overridden prerequisites.
    """

    def __init__(
        self,
        configuration: Configuration,
        rig: Rig,
        flight: Flight,
        line: FlightLine,
        devices: DeviceStates,
        pipeline: PipelineQueue,
    ) -> None:
        self._configuration = configuration
        self._rig = rig
        self._flight = flight
        self._line = line
        self._devices = devices
        self._pipeline = pipeline
        self._machine = PhaseMachine()
        self.accepted: frozenset[str] = frozenset()
        self._is_armed = False
        self.on_override: Callable[[str, Sequence[MissingPrerequisite], str], None] = lambda *_: (
            None
        )
        """Called with author, missing prerequisites and reason of each override."""

    @property
    def phase(self) -> Phase:
        return self._machine.phase

    def missing_prerequisites(self) -> tuple[MissingPrerequisite, ...]:
        """The missing prerequisites that are not overridden."""
        readiness = self._readiness(time.monotonic_ns())
        missing = missing_prerequisites(readiness, self._configuration.limits)
        return tuple(item for item in missing if item.name not in self.accepted)

    def absent(self) -> list[str]:
        """Absent devices and data, as text."""
        return absent_parts(self._readiness(time.monotonic_ns()))

    def arm(self) -> None:
        """Arm by command; the service stays armed while no prerequisite is missing."""
        self._is_armed = True

    def override(self, by: str, missing: Sequence[MissingPrerequisite], reason: str = "") -> None:
        """Override missing prerequisites."""
        self.accepted |= {item.name for item in missing if item.may_be_overridden}
        self.on_override(by, missing, reason)

    def advance(
        self,
        *,
        is_prepared: bool,
        has_landed: bool,
        has_failed: bool,
    ) -> list[Phase]:
        """The phases entered since the last call."""
        if self._line.is_running:
            self._is_armed = True  # by the configuration, or by the command that started it
        facts = PhaseInputs(
            is_prepared=is_prepared,
            is_armed=self._is_armed and is_prepared and not self.missing_prerequisites(),
            is_running=self._line.is_running and not self._line.is_flown,
            has_landed=has_landed,
            has_failed=has_failed,
        )
        return self._machine.advance(facts)

    def _readiness(self, mono_ns: int) -> Readiness:
        configuration, flight = self._configuration, self._flight
        delivering = self._devices.delivering
        absent = [f"head {h.sensor}" for h in configuration.head if h.sensor not in delivering]
        if not self._devices.has_trigger:
            absent.append("trigger")
        last = flight.track.last
        read = {t.probe: (t.value_c, t.age_ns * 1e-9) for t in flight.temperatures.at(mono_ns)}
        is_measured = bool(configuration.thermometer) or any(
            head.settings.get("temperature_probe") for head in configuration.head
        )
        probes = self._rig.probes if is_measured else ()
        return Readiness(
            has_kernels=self._pipeline.is_ready,
            absent=absent,
            exposures_left=self._line.guard.check().exposures,
            exposures_planned=self._line.remaining or 1,
            needs_time=bool(configuration.navigator),
            has_time=flight.clock.gps_at(mono_ns) is not None and not flight.clock.is_suspect,
            position_age_s=None if last is None else (mono_ns - last.mono_ns) * 1e-9,
            has_fix=last is not None and last.fix != "none",
            probes_c={probe: read.get(probe) for probe in probes},
            serials_unreported=[
                head
                for head, serial in self._devices.serials.items()
                if not serial and self._rig.sensor(head).serial
            ],
            serials_mismatched=stated_serial_problems(configuration, self._rig),
        )

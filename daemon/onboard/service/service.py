"""The service: one asyncio loop that receives from every process and waits for the time-outs.

It starts and ends the processes and carries out commands. When to expose is in
`daemon.onboard.service.flight_line`, what becomes of an exposure in
`daemon.onboard.service.exposure_sequence`. It imports nothing that handles pixels.
"""

from __future__ import annotations

import asyncio
import signal
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from daemon.configuration.model import Configuration
from daemon.mission.layout import Mission
from daemon.mission.operator_decisions import DECISIONS_FILE
from daemon.mission.verification import recovery
from daemon.onboard.capture.device_states import DeviceStates
from daemon.onboard.capture.devices import bound_problem
from daemon.onboard.capture.exposure_controller import ExposureController
from daemon.onboard.capture.link_settings import head_link_problem
from daemon.onboard.flight.decisions import Decision
from daemon.onboard.flight.fault_latches import FILE as UNHANDLED
from daemon.onboard.flight.fault_latches import (
    FaultLatches,
    LatchedFault,
    previous_faults,
    read_unhandled,
    unhandled_content,
)
from daemon.onboard.flight.flight import Flight
from daemon.onboard.flight.flight_identity import identity
from daemon.onboard.flight.ledger import Ledger
from daemon.onboard.flight.recovery_match import seal_from_log
from daemon.onboard.pipeline.pipeline_queue import PipelineQueue
from daemon.onboard.preflight.preflight import IMMEDIATE_START, Preflight
from daemon.onboard.preflight.preparation import Preparation
from daemon.onboard.service.command_execution import CommandHandlers
from daemon.onboard.service.exposure_sequence import ExposureSequence
from daemon.onboard.service.flight_line import FlightLine, Order
from daemon.onboard.service.guidance_feed import GuidanceFeed
from daemon.onboard.service.landed_stage import LandedStage
from daemon.onboard.service.message_dispatcher import MessageDispatcher
from daemon.onboard.service.messages import (
    AppendToLog,
    BeginProcessing,
    Bound,
    ServiceEvent,
    UseMission,
)
from daemon.onboard.service.monitoring_link import NAME as WATCH
from daemon.onboard.service.monitoring_link import (
    MonitoringLink,
    present_temperatures_c,
    status_event,
)
from daemon.onboard.service.notify import Notifier
from daemon.onboard.service.operator_journal import OperatorJournal
from daemon.onboard.service.override_record import OverrideRecord
from daemon.onboard.service.startup import (
    capture_process,
    frame_rings,
    watch_process,
    worker_process,
    writer_process,
)
from daemon.onboard.service.supervisor import Supervisor
from daemon.onboard.service.triangulation_link import TriangulationLink
from daemon.onboard.storage.mirror import Mirror
from processing.rig import Rig

PING_S = 1.0
WAIT_MIN_S = 0.001
LANDING_TIMEOUT_S = 20.0
NO_TIMEOUT_S = 1e9

Events = Callable[[Mapping[str, Any]], None]


class Service:
    """One run of the onboard service over one mission.

    Args:
        configuration: the active configuration.
        rig: the camera.
        config_path: the configuration file; it is copied into the mission.
        events: called with every event, as plain JSON types.
    """

    def __init__(
        self, configuration: Configuration, rig: Rig, config_path: Path, events: Events
    ) -> None:
        self.configuration = configuration
        self.rig = rig
        self.config_path = config_path
        self.events = events
        self.notifier = Notifier()
        self.supervisor = Supervisor(self._dispatch, self._child_died)
        self.latches = FaultLatches()
        self.unhandled: tuple[LatchedFault, ...] = ()
        self.monitoring = MonitoringLink(self.supervisor, watch_process(configuration))
        section = configuration.triangulation
        self.triangulation = TriangulationLink(self.supervisor, section, self._event)
        folders = configuration.landing.copy_to
        self.landed = LandedStage(self.supervisor, folders, self._event, self.notifier)
        self.is_ready = False
        self.is_power_failing = False
        self.failure: str | None = None
        self.stopping = asyncio.Event()
        self.changed = asyncio.Event()
        self.continues = False
        self._note_verdict: Events = lambda _: None
        self.guidance: GuidanceFeed | None = None
        self.mission_lock = ExitStack()
        self.preparation = Preparation(configuration, rig, config_path, self._event, self._fail)
        self.dispatcher = MessageDispatcher()
        self.dispatcher.add({**self.preparation.handlers, **self.landed.handlers})
        self.dispatcher.add({ServiceEvent: lambda message: self._event(**message.event)})

    async def run(self) -> int:
        """Fly until a stop is requested, or until the planned exposures are done.

        Returns:
            The exit status: 0 after an orderly end, 1 after a fault that needs a person or a
            restart.
        """
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: self._on_internal_error(context))
        for name in (signal.SIGTERM, signal.SIGINT, signal.SIGPWR):
            loop.add_signal_handler(name, self._end)
        mission = await self._prepare()
        if mission is None:
            await self.supervisor.end(("worker",))
            return 0 if self.failure is None else 1
        with self.mission_lock:
            self.mission_lock.enter_context(mission.held())
            self._start(mission)
            loop.add_signal_handler(signal.SIGPWR, self._power_fails)
            tasks = [
                loop.create_task(self._run_sequence()),
                loop.create_task(self._monitor_processes()),
                loop.create_task(self._fly()),
            ]
            for task in tasks:
                task.add_done_callback(self._task_ended)
            await self.stopping.wait()
            goes_on = self.continues or self.landed.is_wanted
            notify = self.notifier.status if goes_on else self.notifier.stopping
            notify("landing: sealing what is open")
            await self._land(tasks)
            await self._save_unhandled()
            self.flight.land()
            if imbalances := self.flight.ledger.imbalances(has_landed=True):
                self._event("ledger", fault=True, sentence=f"not balanced: {'; '.join(imbalances)}")
        if self.failure is None and not self.mirror.is_on:
            mission.close()
        self._event("ended", failure=self.failure, ledger=self.flight.ledger.sheet().as_json())
        if self.landed.is_wanted and self.failure is None:
            await self.landed.stay(self.mission.path, self._status, self.monitoring.emit)
        await self.supervisor.end((WATCH,))
        return 0 if self.failure is None else 1

    # Before the flight

    async def _prepare(self) -> Mission | None:
        """The mission, with its worker begun; None where the service ends before there is one."""
        if not await self.preparation.check():
            return None
        interrupted, self.rig = self.preparation.interrupted, self.preparation.rig
        self.is_resumed = interrupted is not None
        self.rings = frame_rings(self.configuration, self.rig)
        self.supervisor.spawn(*worker_process(self.configuration, interrupted, self.rings))
        if interrupted is None:
            # No mission is created before the pipeline is built.
            await self._until(
                lambda: self.preparation.is_built or self.stopping.is_set(), NO_TIMEOUT_S
            )
        return None if self.stopping.is_set() else self.preparation.mission()

    def _start(self, mission: Mission) -> None:
        self.monitoring.start()
        self.mission = mission
        disks, send = self.preparation.disks, self.supervisor.send
        self.mirror = Mirror(
            disks, mission, self.configuration, self.rig, send, self._event, self._use_mission
        )
        report = recovery.recover(mission, self.mirror.naming_disks(seal_from_log(self.rig)))
        self.mission_details = {
            "rig": self.rig.name,
            "simulated": self.configuration.mission.simulated,
            "resumed": self.is_resumed,
            "recovery": [*self.mirror.done, *report.sentences],
            "next_number": report.next_number,
        }
        self._use_mission(mission)
        self.mirror.emit_disk_problems()
        heads = [head.sensor for head in self.configuration.head]
        self.flight = Flight(
            self.rig,
            {head: self.rig.sensor(head).serial for head in heads},
            identity(self.configuration, self.rig, mission),
            self.configuration.limits,
            Ledger.resume(report.finalized, heads=heads, sheet=report.ledger_sheet),
            report.next_number,
        )
        flown = len(report.finalized)
        self.line = FlightLine(
            self.configuration, self.rig, self.flight, mission.path, flown,
            plan=mission.plan_path, free_bytes=self.mirror.free_bytes,
            flown_lines=Counter(one.line_id for one in report.finalized),
        )  # fmt: skip
        self.journal = OperatorJournal(
            mission.path, self.line,
            lambda content: self.mirror.save_now(f"{self.mission.id}/{DECISIONS_FILE}", content),
            self._event,
            lambda: self.flight.last_number,
        )  # fmt: skip
        self._note_verdict = self.journal.note
        if (steering := self.line.steering) is not None:
            self.guidance = GuidanceFeed(
                steering, self.configuration.plan, self.rig, self.line.position,
                self.monitoring.emit_latest, self._event,
            )  # fmt: skip
        self.exposure = ExposureController(
            self.configuration, self.rig, self.flight, send, self._event
        )
        self.pipeline = PipelineQueue(self.configuration.processing.parallel_exposures)
        self.sequence = ExposureSequence(
            self.flight, self.pipeline, send, self._event, self.exposure.update_from_histograms
        )
        self.devices = DeviceStates(self.flight, self.sequence.log, self._event, self._on_bound)
        self.preflight = Preflight(
            self.configuration, self.rig, self.flight, self.line, self.devices, self.pipeline
        )
        record = OverrideRecord(lambda: self.mission.path, send, self.mirror.save_now, self._event)
        self.preflight.on_override = record.record
        self._emit_previous_faults(mission)
        commands = CommandHandlers(self, self.monitoring.answer, send, self._event)
        for part in (self.devices, self.sequence, self.mirror, self.triangulation, commands):
            self.dispatcher.add(part.handlers)
        if self.mirror.is_on:
            self.mission_lock.close()  # the writer holds each copy, and never waits here for a disk
        self.supervisor.spawn(*writer_process(mission, self.rings, self.mirror.plan))
        send("worker", BeginProcessing(mission.path))
        self.supervisor.spawn(*capture_process(self.configuration, self.rig, self.rings))
        identified = {"software": self.flight.identity.software, "resumed": self.is_resumed}
        self.triangulation.start(self.mission.path)
        begin = Decision("begin", time.monotonic_ns(), report.next_number, identified)
        send("writer", AppendToLog(begin.message()))

    def _use_mission(self, mission: Mission) -> None:
        """Use this folder for products and monitoring: its disk is the leading one."""
        if mission != self.mission:
            self.mission = mission
            self.supervisor.send("worker", UseMission(mission.path))
            self.triangulation.use_mission(mission.path)
        self._event("mission", id=mission.id, path=str(mission.path), **self.mission_details)

    # Messages of the processes

    def _dispatch(self, message: object) -> None:
        self.dispatcher.dispatch(message)
        self.changed.set()

    def _emit_previous_faults(self, mission: Mission) -> None:
        """Emit the unacknowledged faults of an earlier run."""
        self.unhandled = read_unhandled(mission.root)
        for event in previous_faults(self.unhandled):
            self._event(**event)
        self.monitoring.faults = lambda: previous_faults(self.latches.unhandled())

    def _child_died(self, name: str) -> None:
        if name == WATCH:
            if not self.stopping.is_set() or self.landed.is_entered:
                self.monitoring.died()
        elif name == LandedStage.name:
            self.landed.died()
        elif name == TriangulationLink.name:
            self.triangulation.died()
        elif not self.stopping.is_set():
            self._fail(
                f"process {name} died, and the service ends; what was stored is safe. "
                f"{self.notifier.restart}"
            )

    def _on_bound(self, bound: Bound) -> None:
        problem = bound_problem(self.rig, bound.kind, bound.name, bound.found)
        problem = problem or head_link_problem(self.configuration, bound.name, bound.found)
        if problem is not None:
            self._fail(problem)

    # In flight

    async def _run_sequence(self) -> None:
        """Carry out what is due after every message, and when a time-out expires."""
        while True:
            due_ns = [self.sequence.advance()]
            if self.guidance is not None:
                due_ns.append(self.guidance.advance())
            if self.exposure.apply():
                self.line.set_exposure_times(self.exposure.times_ns)
            next_ns = min((one for one in due_ns if one is not None), default=None)
            wait_s = PING_S if next_ns is None else (next_ns - time.monotonic_ns()) * 1e-9
            await self._wait(min(max(wait_s, WAIT_MIN_S), PING_S))

    async def _monitor_processes(self) -> None:
        while True:
            imbalances = self.flight.ledger.imbalances()
            if imbalances:
                self._fail(f"the ledger does not balance: {'; '.join(imbalances)}")
            silent = self.supervisor.ping()
            if silent:
                self.notifier.status(f"no answer from {', '.join(silent)}")
            else:
                self.notifier.watchdog()
                self.notifier.status(f"{len(self.flight.open_numbers)} exposures open")
            self._follow_phase()
            self.mirror.check()
            if (warning := self.line.guard.warning()) is not None:
                self._event("disk", fault=True, sentence=warning)
            self.monitoring.emit(status := self._status())
            self.latches.apply(status)
            if (counters := self.devices.changed_counters()) is not None:
                self.monitoring.emit(counters)
            await self._save_unhandled()
            await asyncio.sleep(PING_S)

    async def _fly(self) -> None:
        limit_s = self.configuration.limits.ready_timeout_s
        await self._until(lambda: not self.absent(), limit_s)
        # Devices may be absent, which is reported; kernels may not: nothing compiles in flight.
        await self._until(lambda: self.pipeline.is_ready, NO_TIMEOUT_S)
        absent = self.absent()
        self.is_ready = True
        self._event("ready", absent=absent)
        self.notifier.ready(f"flying without {', '.join(absent)}" if absent else "ready")
        if self.line.is_running and (missing := self.preflight.missing_prerequisites()):
            self.preflight.override(IMMEDIATE_START, missing)
        self._follow_phase()
        await self.line.fly(self._fire, lambda why: self._event("disk", fault=True, sentence=why))
        await self._until(lambda: not self._is_unfinished(), NO_TIMEOUT_S)
        self._event("done")
        if self.configuration.mission.end_when_done:
            self.stopping.set()

    # Commands (`daemon.onboard.service.command_execution`)

    def absent(self) -> list[str]:
        """Absent devices and data, as text."""
        return self.preflight.absent()

    def acknowledge(self, fault: str) -> bool:
        """Acknowledge a fault."""
        return self.latches.acknowledge(fault)

    def land(self, *, new_mission: bool = False) -> None:
        """End the flight and seal what is open; then the service stays, or begins a new mission."""
        self._end()
        self.continues, self.landed.is_wanted = new_mission, not new_mission

    def _end(self) -> None:
        self.landed.leave()
        self.stopping.set()

    def _status(self) -> dict[str, Any]:
        now_ns = time.monotonic_ns()
        sheet = self.flight.ledger.sheet()
        return status_event(
            phase=self.preflight.phase,
            ledger=sheet.as_json(),
            disk=self.line.guard.check(),
            exposures_planned=self.line.remaining,
            position=self.flight.track.last,
            temperatures_c=present_temperatures_c(
                self.flight.temperatures.at(now_ns), self.configuration.limits.temperature_stale_s
            ),
            time_now=self.flight.clock.gps_at(now_ns),
            queue=len(self.pipeline),
            missing=list(map(str, self.preflight.missing_prerequisites())),
            disks=self.mirror.status,
            absent=self.absent() if self.is_ready else (),
            guidance=self.guidance,
        )

    def _follow_phase(self) -> None:
        entered = self.preflight.advance(
            is_prepared=self.is_ready,
            has_landed=self.line.is_flown or self.stopping.is_set(),
            has_failed=self.failure is not None,
        )
        for phase in entered:
            self._event("phase", phase=phase.value)
        if entered:
            self.monitoring.emit(status := self._status())
            self.latches.apply(status)

    async def _save_unhandled(self) -> None:
        """Save the unacknowledged faults for the next start."""
        if (unhandled := self.latches.unhandled()) != self.unhandled:
            self.unhandled = unhandled
            # The error of the disk is reported elsewhere.
            with suppress(OSError):
                await self.mirror.save(UNHANDLED, unhandled_content(unhandled))

    def _fire(self, order: Order) -> None:
        self.sequence.fire(order)
        self.exposure.ordered(order.number, self.flight.order_details(order.number)["line_id"])
        self.changed.set()

    async def _until(self, condition: Callable[[], bool], limit_s: float) -> bool:
        """Wait for a condition that messages change; False after the time-out."""
        deadline = time.monotonic() + limit_s
        while not condition():
            remaining_s = deadline - time.monotonic()
            if remaining_s <= 0:
                return False
            await self._wait(min(remaining_s, PING_S))
        return True

    async def _wait(self, limit_s: float) -> None:
        """Wait for a message, or until the time-out."""
        self.changed.clear()
        # `wait_for` of Python 3.11 loses a cancellation that comes with the event.
        with suppress(TimeoutError):
            async with asyncio.timeout(limit_s):
                await self.changed.wait()

    # After the flight

    async def _land(self, tasks: list[asyncio.Task[None]]) -> None:
        tasks[-1].cancel()  # no more exposures
        self._follow_phase()  # with nothing left to finish nothing else would
        if self.is_power_failing:
            limit_s = self.configuration.limits.power_fail_s
            await self._until(lambda: not self.flight.open_numbers, limit_s)
        elif self.failure is None:
            await self._until(lambda: not self._is_unfinished(), LANDING_TIMEOUT_S)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self.mirror.land(ends_mission=self.failure is None)
        await self.supervisor.end(("capture", "worker", "writer"))
        await self.triangulation.land(adjusts=self.failure is None and not self.is_power_failing)

    def _power_fails(self) -> None:
        """Handle the power-fail signal: the supply ends within seconds.

        Data in transit have half of that time to arrive; then all time-outs expire.
        """
        limits = self.configuration.limits
        self.is_power_failing = True
        loop = asyncio.get_running_loop()
        loop.call_later(limits.power_fail_s / 2, self._expire_timeouts)
        sentence = (
            f"power fails; what is open is stored and sealed within {limits.power_fail_s:g} s"
        )
        self._event("power", fault=True, sentence=sentence)
        self._end()

    def _expire_timeouts(self) -> None:
        self.sequence.expire_timeouts()
        self.changed.set()

    def _is_unfinished(self) -> bool:
        return bool(self.flight.open_numbers) or bool(self.pipeline)

    def _task_ended(self, task: asyncio.Task[None]) -> None:
        error = None if task.cancelled() else task.exception()
        if error is not None:
            self._on_internal_error({"exception": error})

    def _on_internal_error(self, context: Mapping[str, Any]) -> None:
        """Handle an internal error: print its trace and end; the restart resumes the flight."""
        error = context.get("exception")
        if isinstance(error, BaseException):
            traceback.print_exception(error)
        message = f"{type(error).__name__}: {error}" if error else context.get("message")
        self._fail(f"the service itself failed ({message}); report this. {self.notifier.restart}")

    # Output

    def _event(self, event: str, **content: Any) -> None:
        message = {"event": event, "mono_ns": str(time.monotonic_ns()), **content}
        self.latches.apply(message)
        self._note_verdict(message)
        self.events(message)
        self.monitoring.emit(message)
        self.triangulation.note(message)

    def _fail(self, sentence: str) -> None:
        self._end()
        if self.failure is None:
            self.failure = sentence
            self._event("fault", sentence=sentence)

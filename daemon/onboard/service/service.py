"""The service: one asyncio loop that receives from every process and checks the deadlines.

It contains no logic of matching (`daemon.onboard.flight.flight`), when to expose
(`daemon.onboard.service.flight_line`), what goes to disk
(`daemon.onboard.storage.storage_coordinator`) or pixels (`daemon.onboard.pipeline.worker`), and
imports none of what those need.
"""

from __future__ import annotations

import asyncio
import signal
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, ClassVar

from daemon.configuration.model import Configuration
from daemon.mission.layout import Mission
from daemon.mission.log.log_records import LoggedTrigger, Message, message_of
from daemon.mission.verification import recovery
from daemon.onboard.capture.devices import bound_problem
from daemon.onboard.capture.exposure_controller import ExposureController
from daemon.onboard.flight.arming import FILE as OVERRIDES
from daemon.onboard.flight.arming import MissingPrerequisite, override_message, overrides_content
from daemon.onboard.flight.decisions import Decision, tick
from daemon.onboard.flight.fault_latches import FILE as UNHANDLED
from daemon.onboard.flight.fault_latches import (
    FaultLatches,
    LatchedFault,
    previous_faults,
    read_unhandled,
    unhandled_content,
)
from daemon.onboard.flight.flight import Flight
from daemon.onboard.flight.ledger import Ledger
from daemon.onboard.flight.recovery_match import seal_from_log
from daemon.onboard.pipeline.pipeline_queue import PipelineQueue
from daemon.onboard.preflight.preflight import IMMEDIATE_START, Preflight
from daemon.onboard.preflight.preparation import Preparation
from daemon.onboard.service.command_execution import (
    audit_message,
    command_event,
    execute,
    invalid_event,
    invalid_message,
    refusal_event,
    refusal_message,
    refused_command,
)
from daemon.onboard.service.command_rules import violation
from daemon.onboard.service.flight_line import FlightLine, Order
from daemon.onboard.service.message_dispatcher import MessageDispatcher
from daemon.onboard.service.messages import (
    Answer,
    AppendToLog,
    BeginProcessing,
    Bound,
    CommandRefused,
    Fire,
    InvalidMessages,
    Pong,
    ServiceCommand,
    ServiceEvent,
    UseMission,
)
from daemon.onboard.service.monitoring_link import NAME as WATCH
from daemon.onboard.service.monitoring_link import MonitoringLink, status_event
from daemon.onboard.service.notify import Notifier
from daemon.onboard.service.record_ingest import RecordIngest
from daemon.onboard.service.startup import (
    capture_process,
    frame_rings,
    identity,
    watch_process,
    worker_process,
    writer_process,
)
from daemon.onboard.service.supervisor import Supervisor
from daemon.onboard.storage.mirror import Mirror
from daemon.onboard.storage.storage_coordinator import StorageCoordinator
from drivers.contract import Record
from processing.rig import Rig

TICK_S = 0.05
PING_S = 1.0
LANDING_TIMEOUT_S = 20.0
NO_TIMEOUT_S = 1e9

Events = Callable[[Mapping[str, Any]], None]


class Service(MessageDispatcher):
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
        self.is_ready = False
        self.is_power_failing = False
        self.deadline_advance_ns = 0
        self.failure: str | None = None
        self.stopping = asyncio.Event()
        self.changed = asyncio.Event()
        self.continues = False
        self.mission_lock = ExitStack()
        self.preparation = Preparation(configuration, rig, config_path, self._event, self._fail)
        self.dispatchers: tuple[MessageDispatcher, ...] = (self, self.preparation)

    async def run(self) -> int:
        """Fly until a stop is requested, or until the planned exposures are done.

        Returns:
            The exit status: 0 after an orderly end, 1 after a fault that needs a person or a
            restart.
        """
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: self._on_internal_error(context))
        for name in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(name, self.stopping.set)
        loop.add_signal_handler(signal.SIGPWR, self._power_fails)
        mission = await self._prepare()
        if mission is None:
            await self.supervisor.end(("worker",))
            return 0 if self.failure is None else 1
        with self.mission_lock:
            self.mission_lock.enter_context(mission.held())
            self._start(mission)
            tasks = [
                loop.create_task(self._run_deadlines()),
                loop.create_task(self._monitor_processes()),
                loop.create_task(self._fly()),
            ]
            for task in tasks:
                task.add_done_callback(self._task_ended)
            await self.stopping.wait()
            notify = self.notifier.status if self.continues else self.notifier.stopping
            notify("landing: sealing what is open")
            await self._land(tasks)
            await self._save_unhandled()
            self.flight.land()
            if imbalances := self.flight.ledger.imbalances(has_landed=True):
                self._event("ledger", fault=True, sentence=f"not balanced: {'; '.join(imbalances)}")
        if self.failure is None and not self.mirror.is_on:
            mission.close()
        self._event("ended", failure=self.failure, ledger=self.flight.ledger.sheet().as_json())
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
        self.ingest = RecordIngest(self.flight, self._log, self._event, self._on_decision)
        flown = len(report.finalized)
        self.line = FlightLine(
            self.configuration, self.rig, self.flight, mission.path, flown,
            plan=mission.plan_path, free_bytes=self.mirror.free_bytes,
        )  # fmt: skip
        self.exposure = ExposureController(
            self.configuration, self.rig, self.flight, send, self._event
        )
        parallel_exposures = self.configuration.processing.parallel_exposures
        self.pipeline = PipelineQueue(
            parallel_exposures,
            send,
            self._event,
            self._on_decision,
            self.exposure.update_from_histograms,
        )
        self.storage = StorageCoordinator(
            self.flight, self.pipeline, send, self._event, self._on_decision
        )
        self.preflight = Preflight(
            self.configuration, self.rig, self.flight, self.line, self.ingest, self.pipeline
        )
        self.preflight.on_override = self._record_override
        self._emit_previous_faults(mission)
        self.dispatchers += (self.ingest, self.storage, self.pipeline, self.mirror)
        if self.mirror.is_on:
            self.mission_lock.close()  # the writer holds each copy, and never waits here for a disk
        self.supervisor.spawn(*writer_process(mission, self.rings, self.mirror.plan))
        send("worker", BeginProcessing(mission.path))
        self.supervisor.spawn(*capture_process(self.configuration, self.rig, self.rings))
        self._on_decision(
            Decision(
                "begin",
                time.monotonic_ns(),
                report.next_number,
                {"software": self.flight.identity.software, "resumed": self.is_resumed},
            )
        )

    def _use_mission(self, mission: Mission) -> None:
        """Use this folder for products and monitoring: its disk is the leading one."""
        if mission != self.mission:
            self.mission = mission
            self.supervisor.send("worker", UseMission(mission.path))
        self._event("mission", id=mission.id, path=str(mission.path), **self.mission_details)

    # Messages of the processes

    def _dispatch(self, message: object) -> None:
        if not any(dispatcher.dispatch(message) for dispatcher in self.dispatchers):
            raise TypeError(f"a process sent {type(message).__name__}, which has no handler")
        self.changed.set()

    def _emit_previous_faults(self, mission: Mission) -> None:
        """Emit the unacknowledged faults of an earlier run."""
        self.unhandled = read_unhandled(mission.root)
        for event in previous_faults(self.unhandled):
            self._event(**event)
        self.monitoring.faults = lambda: previous_faults(self.latches.unhandled())

    def _record_override(
        self, by: str, missing: Sequence[MissingPrerequisite], reason: str
    ) -> None:
        self.supervisor.send("writer", AppendToLog(override_message(by, missing, reason)))
        message = "; ".join(map(str, missing)) + (f". Reason: {reason}" if reason else "")
        self._event("override", by=by, sentence=f"{by} overrides: {message}")
        try:
            note = overrides_content(self.mission.path, by, missing, reason=reason)
            self.mirror.save_now(f"{self.mission.id}/{OVERRIDES}", note)
        except OSError as error:
            # The log has it too.
            self._event("disk", fault=True, sentence=f"the override is not noted: {error}")

    def _child_died(self, name: str) -> None:
        if name == WATCH:
            if not self.stopping.is_set():
                self.monitoring.died()
        elif not self.stopping.is_set():
            self._fail(
                f"process {name} died, and the service ends; what was stored is safe. "
                f"{self.notifier.restart}"
            )

    def _on_bound(self, bound: Bound) -> None:
        self.ingest.dispatch(bound)
        problem = bound_problem(self.rig, bound.kind, bound.name, bound.found)
        if problem is not None:
            self._fail(problem)

    def _on_service_event(self, message: ServiceEvent) -> None:
        """Events of the watch process and the writer."""
        self._event(**message.event)

    def _on_command(self, command: ServiceCommand) -> None:
        problem = violation(command)
        if problem is not None:
            # The page's process rejects these commands: it may be compromised.
            self.monitoring.answer(Answer(command.number, False, problem))
            self._on_command_refused(refused_command(command, problem))
            return
        answer = execute(command, self)
        self.monitoring.answer(answer)
        self._audit(audit_message(command, answer), command_event(command, answer))

    def _on_invalid_messages(self, invalid: InvalidMessages) -> None:
        self._audit(invalid_message(invalid), invalid_event(invalid))

    def _on_command_refused(self, refused: CommandRefused) -> None:
        self._audit(refusal_message(refused), refusal_event(refused))

    def _audit(self, message: Message, event: Mapping[str, Any]) -> None:
        self.supervisor.send("writer", AppendToLog(message, is_durable=True))
        self._event(**event)

    def _on_pong(self, pong: Pong) -> None:
        if pong.statistics:
            self.statistics = pong.statistics

    handlers: ClassVar = {
        Bound: _on_bound,
        Pong: _on_pong,
        ServiceEvent: _on_service_event,
        ServiceCommand: _on_command,
        CommandRefused: _on_command_refused,
        InvalidMessages: _on_invalid_messages,
    }

    # In flight

    async def _run_deadlines(self) -> None:
        while True:
            now_ns = time.monotonic_ns() + self.deadline_advance_ns
            due = tick(self.flight, now_ns, may_seal=self.storage.may_seal(now_ns))
            if (detail := due.detail) is not None:
                self._on_decision(Decision("tick", now_ns, detail=detail))
            for waiting in due.to_store:
                self.storage.store(waiting)
            for number, cause in due.given_up:
                self._event("lost", number=number, cause=cause)
            for head, slot in self.flight.idle_slots:
                self.pipeline.recycle({head: slot})
            self.flight.idle_slots.clear()
            if self.exposure.apply():
                self.line.set_exposure_times(self.exposure.times_ns)
            self.ingest.emit_time_events(now_ns - self.deadline_advance_ns)
            if due.provisional is not None:
                self.pipeline.provisional(due.provisional)
            if due.to_seal is not None:
                self.storage.seal(due.to_seal)
            await asyncio.sleep(TICK_S)

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
        await self.line.fly(self._fire, self._disk_full)
        await self._until(lambda: not self._is_unfinished(), NO_TIMEOUT_S)
        self._event("done")
        if self.configuration.mission.end_when_done:
            self.stopping.set()

    # Commands (`daemon.onboard.service.command_execution`)

    def absent(self) -> list[str]:
        """Absent devices and data, as text."""
        return self.line.absent(
            self.ingest.active.__contains__, has_trigger=self.ingest.has_trigger
        )

    def acknowledge(self, fault: str) -> bool:
        """Acknowledge a fault."""
        return self.latches.acknowledge(fault)

    def land(self, *, new_mission: bool = False) -> None:
        """End the flight: open exposures are sealed first. `new_mission`: another one follows."""
        self.continues = new_mission
        self.stopping.set()

    def _status(self) -> dict[str, Any]:
        now_ns = time.monotonic_ns()
        sheet = self.flight.ledger.sheet()
        return status_event(
            phase=self.preflight.phase,
            ledger=sheet.as_json(),
            exposures_left=self.line.guard.check().exposures,
            position=self.flight.track.last,
            temperatures=self.flight.temperatures.at(now_ns),
            temperature_stale_s=self.configuration.limits.temperature_stale_s,
            time_now=self.flight.clock.gps_at(now_ns),
            queue=len(self.pipeline),
            missing=list(map(str, self.preflight.missing_prerequisites())),
            disks=self.mirror.status,
            absent=self.absent() if self.is_ready else (),
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
        self.ingest.orders[order.number] = order
        order_details = self.flight.order_details(order.number)
        self._on_decision(Decision("order", order.mono_ns, order.number, order_details))
        self.supervisor.send("capture", Fire(order.number, order.delays_ns))
        self.exposure.ordered(order.number, order_details["line_id"])
        self._event("triggered", number=order.number)

    def _disk_full(self, sentence: str) -> None:
        self._event("disk", fault=True, sentence=sentence)

    async def _until(self, condition: Callable[[], bool], limit_s: float) -> bool:
        """Wait for a condition that messages change; False after the time-out."""
        deadline = time.monotonic() + limit_s
        while not condition():
            remaining_s = deadline - time.monotonic()
            if remaining_s <= 0:
                return False
            self.changed.clear()
            # `wait_for` of Python 3.11 loses a cancellation that comes with the event.
            with suppress(TimeoutError):
                async with asyncio.timeout(min(remaining_s, PING_S)):
                    await self.changed.wait()
        return True

    # After the flight

    async def _land(self, tasks: list[asyncio.Task[None]]) -> None:
        tasks[-1].cancel()  # no more exposures
        if self.is_power_failing:
            limit_s = self.configuration.limits.power_fail_s
            await self._until(lambda: not self._has_unsealed(), limit_s)
        elif self.failure is None:
            await self._until(lambda: not self._is_unfinished(), LANDING_TIMEOUT_S)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self.mirror.land(ends_mission=self.failure is None)
        await self.supervisor.end(("capture", "worker", "writer"))

    def _power_fails(self) -> None:
        """Handle the power-fail signal: the supply ends within seconds.

        Data in transit have half of that time to arrive; then all time-outs expire.
        """
        limits = self.configuration.limits
        self.is_power_failing = True
        asyncio.get_running_loop().call_later(limits.power_fail_s / 2, self._advance_deadlines)
        sentence = (
            f"power fails; what is open is stored and sealed within {limits.power_fail_s:g} s"
        )
        self._event("power", fault=True, sentence=sentence)
        self.stopping.set()

    def _advance_deadlines(self) -> None:
        limits = self.configuration.limits
        self.deadline_advance_ns = round(
            (limits.frame_timeout_s + limits.mark_timeout_s + 1.0) * 1e9
        )

    def _has_unsealed(self) -> bool:
        return self.storage.is_sealing or bool(self.flight.open_numbers)

    def _is_unfinished(self) -> bool:
        return self._has_unsealed() or bool(self.pipeline)

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

    def _log(self, record: Record | LoggedTrigger) -> None:
        self.supervisor.send("writer", AppendToLog(message_of(record)))

    def _on_decision(self, decision: Decision) -> None:
        self.supervisor.send("writer", AppendToLog(decision.message()))

    def _event(self, event: str, **content: Any) -> None:
        message = {"event": event, "mono_ns": str(time.monotonic_ns()), **content}
        self.latches.apply(message)
        self.events(message)
        self.monitoring.emit(message)

    def _fail(self, sentence: str) -> None:
        self.stopping.set()
        if self.failure is None:
            self.failure = sentence
            self._event("fault", sentence=sentence)

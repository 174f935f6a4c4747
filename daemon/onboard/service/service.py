"""The service: one asyncio loop that hears every process and keeps the deadlines.

It decides nothing about matching (`daemon.onboard.flight.flight`), when to expose
(`daemon.onboard.service.line`), what goes to disk (`daemon.onboard.storage.keeping`) or pixels
(`daemon.onboard.pipeline.worker`), and imports none of what those need.
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
from daemon.onboard.capture.exposure_control import ExposureControl
from daemon.onboard.flight.arming import FILE as OVERRIDES
from daemon.onboard.flight.arming import Lack, override_message, override_note
from daemon.onboard.flight.decisions import Decision, tick
from daemon.onboard.flight.flight import Flight
from daemon.onboard.flight.latches import FILE as UNHANDLED
from daemon.onboard.flight.latches import (
    Latch,
    Latches,
    previous_faults,
    read_unhandled,
    unhandled_note,
)
from daemon.onboard.flight.ledger import Ledger
from daemon.onboard.flight.recovery_match import seal_from_log
from daemon.onboard.pipeline.pipeline_queue import PipelineQueue
from daemon.onboard.preflight.preflight import AT_ONCE, Preflight
from daemon.onboard.preflight.preparation import Preparation
from daemon.onboard.service.command_rules import violation
from daemon.onboard.service.commanding import (
    audit_message,
    command_event,
    invalid_event,
    invalid_message,
    obey,
    refusal_event,
    refusal_message,
    refused_command,
)
from daemon.onboard.service.departure import (
    capture_process,
    frame_rings,
    identity,
    watch_process,
    worker_process,
    writer_process,
)
from daemon.onboard.service.desk import Desk
from daemon.onboard.service.hearing import Hearing
from daemon.onboard.service.line import Line, Order
from daemon.onboard.service.messages import (
    Answer,
    Begin,
    Bound,
    Command,
    CommandRefused,
    Fire,
    InvalidMessages,
    Log,
    Pong,
    Told,
    UseMission,
)
from daemon.onboard.service.notify import Notifier
from daemon.onboard.service.supervisor import Supervisor
from daemon.onboard.service.watching import NAME as WATCH
from daemon.onboard.service.watching import Watching, status_event
from daemon.onboard.storage.keeping import Keeping
from daemon.onboard.storage.mirror import Mirror
from drivers.contract import Record
from processing.rig import Rig

TICK_S = 0.05
PING_S = 1.0
LANDING_TIMEOUT_S = 20.0
END_OF_WAITING_S = 1e9

Events = Callable[[Mapping[str, Any]], None]


class Service(Desk):
    """One run of the onboard service over one mission.

    Args:
        configuration: what to do.
        rig: the camera.
        config_path: the file the configuration came from; its bytes go into the mission.
        events: told of everything a person or a program may want to know, as plain JSON types.
    """

    def __init__(
        self, configuration: Configuration, rig: Rig, config_path: Path, events: Events
    ) -> None:
        self.configuration = configuration
        self.rig = rig
        self.config_path = config_path
        self.events = events
        self.notifier = Notifier()
        self.supervisor = Supervisor(self._hear, self._child_died)
        self.latches = Latches()
        self.unhandled: tuple[Latch, ...] = ()
        self.watching = Watching(self.supervisor, watch_process(configuration))
        self.is_ready = False
        self.is_power_failing = False
        self.hurry_ns = 0
        self.failure: str | None = None
        self.stopping = asyncio.Event()
        self.changed = asyncio.Event()
        self.goes_on = False
        self.holding = ExitStack()
        self.preparation = Preparation(configuration, rig, config_path, self._event, self._fail)
        self.desks: tuple[Desk, ...] = (self, self.preparation)

    async def run(self) -> int:
        """Fly until told to stop, or until the planned exposures are done.

        Returns:
            The exit status: 0 after an orderly end, 1 after a fault that needs a person or a
            restart.
        """
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: self._broke(context))
        for name in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(name, self.stopping.set)
        loop.add_signal_handler(signal.SIGPWR, self._power_fails)
        mission = await self._prepare()
        if mission is None:
            await self.supervisor.end(("worker",))
            return 0 if self.failure is None else 1
        with self.holding:
            self.holding.enter_context(mission.held())
            self._start(mission)
            tasks = [
                loop.create_task(self._keep_deadlines()),
                loop.create_task(self._watch_processes()),
                loop.create_task(self._fly()),
            ]
            for task in tasks:
                task.add_done_callback(self._task_ended)
            await self.stopping.wait()
            say = self.notifier.status if self.goes_on else self.notifier.stopping
            say("landing: sealing what is open")
            await self._land(tasks)
            await self._keep_unhandled()
            self.flight.land()
            if left := self.flight.ledger.imbalances(has_landed=True):
                self._event("ledger", fault=True, sentence=f"not settled: {'; '.join(left)}")
        if self.failure is None and not self.mirror.is_on:
            mission.close()
        self._event("ended", failure=self.failure, ledger=self.flight.ledger.sheet().as_json())
        await self.supervisor.end((WATCH,))
        return 0 if self.failure is None else 1

    # Before the flight

    async def _prepare(self) -> Mission | None:
        """The mission, with its worker begun; None where the service ends before there is one."""
        if not await self.preparation.look():
            return None
        interrupted, self.rig = self.preparation.interrupted, self.preparation.rig
        self.is_resumed = interrupted is not None
        self.rings = frame_rings(self.configuration, self.rig)
        self.supervisor.spawn(*worker_process(self.configuration, interrupted, self.rings))
        if interrupted is None:
            # A mission that no image can be made of is not begun.
            is_built = self._until(
                lambda: self.preparation.is_built or self.stopping.is_set(), END_OF_WAITING_S
            )
            await is_built
        return None if self.stopping.is_set() else self.preparation.mission()

    def _start(self, mission: Mission) -> None:
        self.watching.start()
        self.mission = mission
        disks, send = self.preparation.disks, self.supervisor.send
        self.mirror = Mirror(
            disks, mission, self.configuration, self.rig, send, self._event, self._lead
        )
        report = recovery.recover(mission, self.mirror.naming_disks(seal_from_log(self.rig)))
        self.about_mission = {
            "rig": self.rig.name,
            "simulated": self.configuration.mission.simulated,
            "resumed": self.is_resumed,
            "recovery": [*self.mirror.done, *report.sentences],
            "next_number": report.next_number,
        }
        self._lead(mission)
        self.mirror.tell_findings()
        heads = [head.sensor for head in self.configuration.head]
        self.flight = Flight(
            self.rig,
            {head: self.rig.sensor(head).serial for head in heads},
            identity(self.configuration, self.rig, mission),
            self.configuration.limits,
            Ledger.resume(report.settled, heads=heads, sheet=report.ledger_sheet),
            report.next_number,
        )
        self.hearing = Hearing(self.flight, self._log, self._event, self._decided)
        flown = len(report.settled)
        self.line = Line(
            self.configuration, self.rig, self.flight, mission.path, flown,
            plan=mission.plan_path, free_bytes=self.mirror.free_bytes,
        )  # fmt: skip
        self.exposure = ExposureControl(
            self.configuration, self.rig, self.flight, send, self._event
        )
        lanes = self.configuration.processing.exposures_in_work
        self.pipeline = PipelineQueue(lanes, send, self._event, self._decided, self.exposure.seen)
        self.keeping = Keeping(self.flight, self.pipeline, send, self._event, self._decided)
        self.preflight = Preflight(
            self.configuration, self.rig, self.flight, self.line, self.hearing, self.pipeline
        )
        self.preflight.overridden = self._overridden
        self._tell_previous(mission)
        self.desks += (self.hearing, self.keeping, self.pipeline, self.mirror)
        if self.mirror.is_on:
            self.holding.close()  # the writer holds each copy, and never waits here for a disk
        self.supervisor.spawn(*writer_process(mission, self.rings, self.mirror.plan))
        send("worker", Begin(mission.path))
        self.supervisor.spawn(*capture_process(self.configuration, self.rig, self.rings))
        self._decided(
            Decision(
                "begin",
                time.monotonic_ns(),
                report.next_number,
                {"software": self.flight.identity.software, "resumed": self.is_resumed},
            )
        )

    def _lead(self, mission: Mission) -> None:
        """Products go into this folder from now on, and watchers read it: its disk leads."""
        if mission != self.mission:
            self.mission = mission
            self.supervisor.send("worker", UseMission(mission.path))
        self._event("mission", id=mission.id, path=str(mission.path), **self.about_mission)

    # What the processes say

    def _hear(self, message: object) -> None:
        if not any(desk.hear(message) for desk in self.desks):
            raise TypeError(f"a process said {type(message).__name__}, which nobody expects")
        self.changed.set()

    def _tell_previous(self, mission: Mission) -> None:
        """What an earlier start of the service left for a person to see."""
        self.unhandled = read_unhandled(mission.root)
        for event in previous_faults(self.unhandled):
            self._event(**event)
        self.watching.faults = lambda: previous_faults(self.latches.unhandled())

    def _overridden(self, by: str, missing: Sequence[Lack], reason: str) -> None:
        self.supervisor.send("writer", Log(override_message(by, missing, reason)))
        told = "; ".join(map(str, missing)) + (f". Why: {reason}" if reason else "")
        self._event("override", by=by, sentence=f"{by} flies all the same: {told}")
        try:
            note = override_note(self.mission.path, by, missing, reason=reason)
            self.mirror.keep_now(f"{self.mission.id}/{OVERRIDES}", note)
        except OSError as error:
            # The log has it too.
            self._event("disk", fault=True, sentence=f"the override is not noted: {error}")

    def _child_died(self, name: str) -> None:
        if name == WATCH:
            if not self.stopping.is_set():
                self.watching.died()
        elif not self.stopping.is_set():
            self._fail(
                f"process {name} died, and the service ends; what was stored is safe. "
                f"{self.notifier.restart}"
            )

    def _on_bound(self, bound: Bound) -> None:
        self.hearing.hear(bound)
        problem = bound_problem(self.rig, bound.kind, bound.name, bound.found)
        if problem is not None:
            self._fail(problem)

    def _on_told(self, told: Told) -> None:
        """What the watch process and the writer have to say of themselves."""
        self._event(**told.event)

    def _on_command(self, command: Command) -> None:
        problem = violation(command)
        if problem is not None:
            # The page's process lets none of these pass: this one is no longer itself.
            self.watching.answer(Answer(command.number, False, problem))
            self._on_command_refused(refused_command(command, problem))
            return
        answer = obey(command, self)
        self.watching.answer(answer)
        self._audit(audit_message(command, answer), command_event(command, answer))

    def _on_invalid_messages(self, invalid: InvalidMessages) -> None:
        self._audit(invalid_message(invalid), invalid_event(invalid))

    def _on_command_refused(self, refused: CommandRefused) -> None:
        self._audit(refusal_message(refused), refusal_event(refused))

    def _audit(self, message: Message, event: Mapping[str, Any]) -> None:
        self.supervisor.send("writer", Log(message, is_durable=True))
        self._event(**event)

    def _on_pong(self, pong: Pong) -> None:
        if pong.statistics:
            self.statistics = pong.statistics

    handlers: ClassVar = {
        Bound: _on_bound,
        Pong: _on_pong,
        Told: _on_told,
        Command: _on_command,
        CommandRefused: _on_command_refused,
        InvalidMessages: _on_invalid_messages,
    }

    # In flight

    async def _keep_deadlines(self) -> None:
        while True:
            now_ns = time.monotonic_ns() + self.hurry_ns
            due = tick(self.flight, now_ns, may_seal=self.keeping.may_seal(now_ns))
            if (detail := due.detail) is not None:
                self._decided(Decision("tick", now_ns, detail=detail))
            for waiting in due.to_store:
                self.keeping.store(waiting)
            for number, cause in due.given_up:
                self._event("lost", number=number, cause=cause)
            for head, slot in self.flight.idle_slots:
                self.pipeline.recycle({head: slot})
            self.flight.idle_slots.clear()
            if self.exposure.apply():
                self.line.exposes_for(self.exposure.times_ns)
            self.hearing.tell_of_time(now_ns - self.hurry_ns)
            if due.foreseen is not None:
                self.pipeline.foreseen(due.foreseen)
            if due.to_seal is not None:
                self.keeping.seal(due.to_seal)
            await asyncio.sleep(TICK_S)

    async def _watch_processes(self) -> None:
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
            self.mirror.look()
            if (warning := self.line.guard.warning()) is not None:
                self._event("disk", fault=True, sentence=warning)
            self.watching.tell(status := self._status())
            self.latches.apply(status)
            await self._keep_unhandled()
            await asyncio.sleep(PING_S)

    async def _fly(self) -> None:
        limit_s = self.configuration.limits.ready_timeout_s
        await self._until(lambda: not self.absent(), limit_s)
        # Devices may be missing and said to be; kernels may not: nothing compiles in flight.
        await self._until(lambda: self.pipeline.is_ready, END_OF_WAITING_S)
        absent = self.absent()
        self.is_ready = True
        self._event("ready", absent=absent)
        self.notifier.ready(f"flying without {', '.join(absent)}" if absent else "ready")
        if self.line.runs and (missing := self.preflight.lacks()):
            self.preflight.override(AT_ONCE, missing)
        self._follow_phase()
        await self.line.fly(self._fire, self._disk_full)
        await self._until(lambda: not self._is_unfinished(), END_OF_WAITING_S)
        self._event("done")
        if self.configuration.mission.end_when_done:
            self.stopping.set()

    # What may be commanded (`daemon.onboard.service.commanding`)

    def absent(self) -> list[str]:
        """What is not there yet, in words."""
        return self.line.absent(
            self.hearing.active.__contains__, has_trigger=self.hearing.has_trigger
        )

    def acknowledge(self, fault: str) -> bool:
        """A person has seen a fault."""
        return self.latches.acknowledge(fault)

    def land(self, *, again: bool = False) -> None:
        """End in good order: what is open is sealed first. `again`: a new mission follows."""
        self.goes_on = again
        self.stopping.set()

    def _status(self) -> dict[str, Any]:
        now_ns = time.monotonic_ns()
        sheet = self.flight.ledger.sheet()
        return status_event(
            phase=self.preflight.phase,
            ledger=sheet.as_json(),
            exposures_left=self.line.guard.look().exposures,
            position=self.flight.track.last,
            temperatures=self.flight.temperatures.at(now_ns),
            temperature_stale_s=self.configuration.limits.temperature_stale_s,
            time_now=self.flight.clock.gps_at(now_ns),
            queue=len(self.pipeline),
            missing=list(map(str, self.preflight.lacks())),
            disks=self.mirror.status,
            absent=self.absent() if self.is_ready else (),
        )

    def _follow_phase(self) -> None:
        entered = self.preflight.follow(
            is_prepared=self.is_ready,
            has_landed=self.line.is_flown or self.stopping.is_set(),
            has_failed=self.failure is not None,
        )
        for phase in entered:
            self._event("phase", phase=phase.value)
        if entered:
            self.watching.tell(status := self._status())
            self.latches.apply(status)

    async def _keep_unhandled(self) -> None:
        """What nobody has acknowledged is there when the service starts next."""
        if (unhandled := self.latches.unhandled()) != self.unhandled:
            self.unhandled = unhandled
            # A disk that refuses has told so itself.
            with suppress(OSError):
                await self.mirror.keep(UNHANDLED, unhandled_note(unhandled))

    def _fire(self, order: Order) -> None:
        self.hearing.orders[order.number] = order
        about = self.flight.about(order.number)
        self._decided(Decision("order", order.mono_ns, order.number, about))
        self.supervisor.send("capture", Fire(order.number, order.delays_ns))
        self.exposure.ordered(order.number, about["line_id"])
        self._event("triggered", number=order.number)

    def _disk_full(self, sentence: str) -> None:
        self._event("disk", fault=True, sentence=sentence)

    async def _until(self, is_so: Callable[[], bool], limit_s: float) -> bool:
        """Wait for something that messages bring about; False when the time is over first."""
        deadline = time.monotonic() + limit_s
        while not is_so():
            left_s = deadline - time.monotonic()
            if left_s <= 0:
                return False
            self.changed.clear()
            # `wait_for` of Python 3.11 loses a cancellation that comes with the event.
            with suppress(TimeoutError):
                async with asyncio.timeout(min(left_s, PING_S)):
                    await self.changed.wait()
        return True

    # After the flight

    async def _land(self, tasks: list[asyncio.Task[None]]) -> None:
        tasks[-1].cancel()  # no more exposures
        if self.is_power_failing:
            limit_s = self.configuration.limits.power_fail_s
            await self._until(lambda: not self._is_unsafe(), limit_s)
        elif self.failure is None:
            await self._until(lambda: not self._is_unfinished(), LANDING_TIMEOUT_S)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self.mirror.land(ends_mission=self.failure is None)
        await self.supervisor.end(("capture", "worker", "writer"))

    def _power_fails(self) -> None:
        """The supply said that it will be gone in seconds.

        What is on its way has half of them to arrive; after that no time-out is waited for.
        """
        limits = self.configuration.limits
        self.is_power_failing = True
        asyncio.get_running_loop().call_later(limits.power_fail_s / 2, self._hurry)
        sentence = (
            f"power fails; what is open is stored and sealed within {limits.power_fail_s:g} s"
        )
        self._event("power", fault=True, sentence=sentence)
        self.stopping.set()

    def _hurry(self) -> None:
        limits = self.configuration.limits
        self.hurry_ns = round((limits.frame_timeout_s + limits.mark_timeout_s + 1.0) * 1e9)

    def _is_unsafe(self) -> bool:
        return self.keeping.is_sealing or bool(self.flight.open_numbers)

    def _is_unfinished(self) -> bool:
        return self._is_unsafe() or bool(self.pipeline)

    def _task_ended(self, task: asyncio.Task[None]) -> None:
        error = None if task.cancelled() else task.exception()
        if error is not None:
            self._broke({"exception": error})

    def _broke(self, context: Mapping[str, Any]) -> None:
        """A fault of our own: end with its trace, and be started again into the same flight."""
        error = context.get("exception")
        if isinstance(error, BaseException):
            traceback.print_exception(error)
        told = f"{type(error).__name__}: {error}" if error else context.get("message")
        self._fail(f"the service itself failed ({told}); report this. {self.notifier.restart}")

    # Telling

    def _log(self, record: Record | LoggedTrigger) -> None:
        self.supervisor.send("writer", Log(message_of(record)))

    def _decided(self, decision: Decision) -> None:
        self.supervisor.send("writer", Log(decision.message()))

    def _event(self, event: str, **content: Any) -> None:
        told = {"event": event, "mono_ns": str(time.monotonic_ns()), **content}
        self.latches.apply(told)
        self.events(told)
        self.watching.tell(told)

    def _fail(self, sentence: str) -> None:
        self.stopping.set()
        if self.failure is None:
            self.failure = sentence
            self._event("fault", sentence=sentence)

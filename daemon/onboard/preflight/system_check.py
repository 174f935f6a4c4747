"""A flight without a mission: the processes of `run`, until each device and process is verified.

The same builders, messages and arming rules as in flight (`daemon.onboard.service.startup`,
`daemon.onboard.preflight.preflight`); nothing is written, and nothing is fired unless that is asked
for.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from daemon import DaemonError
from daemon.configuration.model import Configuration
from daemon.onboard.capture.device_states import DeviceStates
from daemon.onboard.capture.devices import bound_problem, device_specs
from daemon.onboard.capture.link_settings import head_link_problem
from daemon.onboard.flight.flight import Flight
from daemon.onboard.flight.flight_identity import FlightIdentity
from daemon.onboard.flight.ledger import Ledger
from daemon.onboard.pipeline.pipeline_queue import PipelineQueue
from daemon.onboard.preflight.check_results import CheckOutcome, CheckResult, failed, passed
from daemon.onboard.preflight.preflight import Preflight
from daemon.onboard.service.exposure_sequence import ExposureSequence
from daemon.onboard.service.flight_line import FlightLine
from daemon.onboard.service.message_dispatcher import Handlers, MessageDispatcher
from daemon.onboard.service.messages import (
    BeginProcessing,
    BindFailed,
    Bound,
    DeviceSpec,
    Fired,
    WorkerBuilt,
    WorkerRefused,
)
from daemon.onboard.service.startup import capture_process, frame_rings, worker_process
from daemon.onboard.service.supervisor import Supervisor
from drivers.base.device_support import is_from_manual_only, proof_summary
from drivers.contract import (
    DeviceEvent,
    EventMark,
    Frame,
    FrameStatus,
    NavSample,
    PpsEdge,
    TemperatureSample,
)
from drivers.receivers.fix_monitor import fix_description, missing_for_flight
from processing.rig import Rig

BIND_TIMEOUT_S: Final = 25.0
DATA_TIMEOUT_S: Final = 10.0
"""From when every device has answered: a receiver that is not sure of its time by then searches."""
KERNELS_TIMEOUT_S: Final = 120.0
"""Loading takes seconds; compiling may take minutes and is not awaited."""
STEP_S: Final = 0.1
FIRE_TRIES: Final = 3
FIRE_TIMEOUT_S: Final = 5.0
FIRE_PAUSE_S: Final = 0.5
WITHOUT_MARKS: Final = frozenset({"gpsd"})
"""Drivers of receivers that have no event marks."""
MARK_ACTION: Final = "check the strobe cable, and that the receiver is set to send its marks"
ACTIONS: Final = {
    "position": "wait, or check its antenna",
    "usable time": "wait, or check its antenna",
    "height": "wait for a fix in three dimensions; a receiver that sends no height above the "
    "ellipsoid has to be set to send it, or the undulation has to be configured",
}
"""By what is missing (`drivers.receivers.fix_monitor.missing_for_flight`)."""
ARRIVING_LATER: Final = frozenset({"arming-time", "arming-navigation", "arming-kernels"})
"""Prerequisites that are met later without action if nothing else fails."""


class SystemCheck:
    """Starts the processes of a flight and verifies each part.

    Args:
        configuration: what is tried.
        rig: the camera that it names.
        fire: whether one exposure is fired, to prove frames and event marks.
    """

    def __init__(self, configuration: Configuration, rig: Rig, *, fire: bool) -> None:
        self._configuration = configuration
        self._rig = rig
        self._fire = fire
        self._specs = device_specs(configuration, rig)
        self._supervisor = Supervisor(self._dispatch, self._on_death)
        heads = [head.sensor for head in configuration.head]
        identity = FlightIdentity("", "", rig.calibration_id, "", "", "", simulated=False)
        flight = Flight(
            rig,
            {head: rig.sensor(head).serial for head in heads},
            identity,
            configuration.limits,
            Ledger(heads=heads),
            1,
        )
        self._line = FlightLine(
            configuration, rig, flight, _existing(configuration.mission.root), 0,
            plan=configuration.plan.file,
        )  # fmt: skip
        self._pipeline = PipelineQueue(1)
        self._sequence = ExposureSequence(flight, self._pipeline, self._supervisor.send, _no_event)
        self._devices = devices = DeviceStates(flight, self._sequence.log, _no_event)
        self._preflight = Preflight(configuration, rig, flight, self._line, devices, self._pipeline)
        self._dispatcher = MessageDispatcher()
        for handlers in (self._handlers, devices.handlers, self._sequence.handlers):
            self._dispatcher.add(handlers)
        self._changed = asyncio.Event()
        self._bound: dict[str, Mapping[str, str]] = {}
        self._unbound: dict[str, str] = {}
        self._refusal = ""
        self._data: dict[str, Any] = {}
        """The last datum of each stream, by kind and name."""
        self._device_faults: dict[str, str] = {}
        self._not_fired = ""
        self._has_fired: bool | None = None

    async def run(self) -> list[CheckResult]:
        """Everything that was found, in the order of the devices.

        Raises:
            DaemonError: a flight cannot even be laid out.
        """
        rings = frame_rings(self._configuration, self._rig)
        try:
            self._supervisor.spawn(*worker_process(self._configuration, None, rings))
            self._supervisor.spawn(*capture_process(self._configuration, self._rig, rings))
            await self._until(lambda: all(map(self._has_answered, self._specs)), BIND_TIMEOUT_S)
            if self._fire and "trigger" in self._bound:
                await self._until(self._heads_are_open, DATA_TIMEOUT_S)
                await self._fire_once()
            await self._until(self._is_verified, DATA_TIMEOUT_S)
            await self._until(self._worker_has_answered, KERNELS_TIMEOUT_S)
            return list(self._findings())
        finally:
            await self._supervisor.end(("capture", "worker"))

    # While it runs

    async def _fire_once(self) -> None:
        """Fire one exposure; again if no head could be triggered, as while its stream starts."""
        for _ in range(FIRE_TRIES):
            self._has_fired = None
            self._sequence.fire(self._line.order(time.monotonic_ns()))
            await self._until(lambda: self._has_fired is not None, FIRE_TIMEOUT_S)
            if self._has_fired:
                return
            await asyncio.sleep(FIRE_PAUSE_S)

    def _heads_are_open(self) -> bool:
        heads = {spec.name for spec in self._specs if spec.kind == "head"}
        return heads & self._bound.keys() <= self._devices.delivering

    def _dispatch(self, message: object) -> None:
        if (record := self._recorders.get(type(message))) is not None:
            record(message)
        self._dispatcher.dispatch(message)
        self._changed.set()

    def _on_death(self, name: str) -> None:
        if name == "worker":
            self._refusal = self._refusal or "the worker died while it built the pipeline"
        else:
            for spec in self._specs:
                if not self._has_answered(spec):
                    self._unbound[spec.name] = f"the process {name} died while it opened devices"
        self._changed.set()

    def _on_bound(self, bound: Bound) -> None:
        self._bound[bound.name] = bound.found

    def _on_bind_failed(self, unbound: BindFailed) -> None:
        self._unbound[unbound.name] = unbound.sentence

    def _on_built(self, _built: WorkerBuilt) -> None:
        self._supervisor.send("worker", BeginProcessing(None))

    def _on_refused(self, refused: WorkerRefused) -> None:
        self._refusal = refused.sentence

    def _on_navigation(self, sample: NavSample) -> None:
        self._data[f"navigator {sample.receiver}"] = sample

    def _on_mark(self, mark: EventMark) -> None:
        self._data[f"mark {mark.receiver}"] = mark

    def _on_temperature(self, sample: TemperatureSample) -> None:
        self._data[f"probe {sample.probe}"] = sample

    def _on_pps(self, edge: PpsEdge) -> None:
        self._data[f"pps {edge.source}"] = edge

    def _on_frame(self, frame: Frame) -> None:
        if frame.status is FrameStatus.COMPLETE:
            self._data[f"head {frame.head}"] = frame

    def _on_device_event(self, event: DeviceEvent) -> None:
        if event.name != "opened":
            self._device_faults[event.device] = event.sentence

    def _on_fired(self, fired: Fired) -> None:
        self._has_fired = fired.pulse is not None
        self._not_fired = "" if self._has_fired else fired.sentence

    @property
    def _handlers(self) -> Handlers:
        return {WorkerBuilt: self._on_built, WorkerRefused: self._on_refused}

    @property
    def _recorders(self) -> Handlers:
        """What is noted of messages that a flight handles."""
        return {
            Bound: self._on_bound,
            BindFailed: self._on_bind_failed,
            NavSample: self._on_navigation,
            EventMark: self._on_mark,
            TemperatureSample: self._on_temperature,
            PpsEdge: self._on_pps,
            Frame: self._on_frame,
            DeviceEvent: self._on_device_event,
            Fired: self._on_fired,
        }

    async def _until(self, condition: Callable[[], bool], limit_s: float) -> None:
        deadline = time.monotonic() + limit_s
        while not condition() and time.monotonic() < deadline:
            self._changed.clear()
            with suppress(TimeoutError):
                async with asyncio.timeout(STEP_S):
                    await self._changed.wait()

    # What was found

    def _has_answered(self, spec: DeviceSpec) -> bool:
        return spec.name in self._bound or spec.name in self._unbound

    def _worker_has_answered(self) -> bool:
        return bool(self._refusal) or self._pipeline.is_ready

    def _is_verified(self) -> bool:
        """Whether nothing is left that more time could prove."""
        bound = {spec.kind for spec in self._specs if spec.name in self._bound}
        waits = {"arming-time", "arming-navigation"} if "navigator" in bound else set()
        has_probe = any(
            spec.name in self._bound and spec.settings.get("temperature_probe")
            for spec in self._specs
        )
        waits |= {"arming-temperature"} if "thermometer" in bound or has_probe else set()
        if any(item.name in waits for item in self._preflight.missing_prerequisites()):
            return False
        return not any(f.outcome is not CheckOutcome.PASS for f in self._streams(is_final=False))

    def _findings(self) -> Iterator[CheckResult]:
        for spec in self._specs:
            yield self._device(spec)
        yield from self._streams(is_final=True)
        if self._refusal:
            yield failed("pipeline", "worker", self._refusal, is_blocking=True)
        elif self._pipeline.is_ready:
            yield passed("pipeline", "worker")
        for item in self._preflight.missing_prerequisites():
            if item.name == "arming-device" or (item.name == "arming-kernels" and self._refusal):
                continue  # the device or the pipeline itself is among the findings
            outcome = CheckOutcome.WAITING if item.name in ARRIVING_LATER else CheckOutcome.FAIL
            yield CheckResult("arming", item.name.removeprefix("arming-"), outcome, str(item))

    def _device(self, spec: DeviceSpec) -> CheckResult:
        found = self._bound.get(spec.name)
        if found is not None:
            problem = bound_problem(self._rig, spec.kind, spec.name, found)
            problem = problem or head_link_problem(self._configuration, spec.name, found)
            if problem is not None:
                return failed(spec.kind, spec.name, problem, is_blocking=True)
            properties = {"driver": spec.driver, **found}
            if proofs := proof_summary(spec.kind, spec.driver):
                properties["proof"] = proofs
            return CheckResult(spec.kind, spec.name, CheckOutcome.PASS, found=properties)
        timeout_sentence = (
            f"no answer within {BIND_TIMEOUT_S:g} s while opening it; check its power and cable"
        )
        return failed(spec.kind, spec.name, self._unbound.get(spec.name, timeout_sentence))

    def _streams(self, *, is_final: bool) -> Iterator[CheckResult]:
        """One datum of each stream of the devices that answered."""
        for spec in self._specs:
            if spec.name not in self._bound:
                continue
            if spec.kind == "navigator":
                yield self._navigation(spec)
                if self._fire:
                    yield self._mark(spec)
            elif spec.kind == "pps" and f"pps {spec.name}" not in self._data:
                sentence = f"no pulse per second of {spec.name} yet; check the receiver's output"
                yield CheckResult("stream", f"pps {spec.name}", CheckOutcome.WAITING, sentence)
            elif spec.kind == "pps":
                yield passed("stream", f"pps {spec.name}")
            elif spec.kind == "head" and (is_final or self._fire):
                yield self._frame(spec.name)

    def _navigation(self, spec: DeviceSpec) -> CheckResult:
        sample = self._data.get(f"navigator {spec.name}")
        name = f"position of {spec.name}"
        if sample is None:
            sentence = self._device_faults.get(
                spec.name, f"receiver {spec.name} answers and sends no position yet; it searches"
            )
            return CheckResult("stream", name, CheckOutcome.WAITING, sentence)
        state = fix_description(sample.fix, sample.satellites)
        missing = missing_for_flight(sample)
        if missing is not None:
            sentence = f"receiver {spec.name} has no {missing} yet ({state}); {ACTIONS[missing]}"
            return CheckResult("stream", name, CheckOutcome.WAITING, sentence)
        table = ", GPS time by our table of leap seconds" if sample.leap_source == "table" else ""
        return passed("stream", name, state + table)

    def _mark(self, spec: DeviceSpec) -> CheckResult:
        name = f"event mark of {spec.name}"
        if spec.driver in WITHOUT_MARKS:
            sentence = f"receivers of driver {spec.driver} have no event marks"
            return CheckResult("stream", name, CheckOutcome.NOT_TRIED, sentence)
        if f"mark {spec.name}" in self._data:
            return passed("stream", name, self._mark_note(spec))
        sentence = f"receiver {spec.name} gave no event mark of the exposure"
        return failed("stream", name, f"{sentence}; {MARK_ACTION}")

    def _mark_note(self, spec: DeviceSpec) -> str:
        if not is_from_manual_only(spec.kind, spec.driver, "event marks"):
            return ""
        return f"marks of driver {spec.driver} are decoded from the manual only"

    def _frame(self, head: str) -> CheckResult:
        name = f"frame of {head}"
        if f"head {head}" in self._data:
            return passed("stream", name)
        if not self._fire:
            return CheckResult(
                "stream", name, CheckOutcome.NOT_TRIED, "nothing is fired without --fire"
            )
        if head in self._device_faults and head not in self._devices.delivering:
            return failed("stream", name, self._device_faults[head])
        why = f" ({self._not_fired})" if self._not_fired else ""
        return failed(
            "stream", name, f"Head {head} sent no image{why}. Check its trigger cable and settings"
        )


async def run_system_check(
    configuration: Configuration, rig: Rig, *, fire: bool
) -> list[CheckResult]:
    """Everything that a flight needs of processes and devices.

    A flight that cannot even be laid out is one finding with the error's sentence.
    """
    try:
        return await SystemCheck(configuration, rig, fire=fire).run()
    except (DaemonError, OSError, ValueError) as error:
        return [failed("service", "layout", str(error), is_blocking=True)]


def _no_event(event: str, **content: Any) -> None:
    """Nothing is reported while the check runs."""


def _existing(folder: Path) -> Path:
    """A folder, or the nearest one above it that exists."""
    return next(path for path in (folder, *folder.parents) if path.is_dir())

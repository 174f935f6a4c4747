"""One worker process of the emulator: some heads of the rig, rendering what they see.

Pulses come in and reports go out through one pipe; everything else a worker needs follows from the
settings of the world. The main process is in `simulator`.
"""

from __future__ import annotations

import hashlib
import json
import math
import signal
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.rig import Cone, Sensor
from sim_hw.faults.channel import for_device
from sim_hw.faults.plan import PlannedFault
from sim_hw.gige.gige_head import NO_PULSE, ExposureRequest, FrameSize, GigeHead, HeadIdentity
from sim_hw.gige.head_faults import WireFaults
from sim_hw.processes.parent_death import terminate_with_parent
from sim_hw.world import sensor_calibration
from sim_hw.world.electronics import Electronics, true_sensor
from sim_hw.world.flight import SimulatedFlight
from sim_hw.world.rendering import ExposureParameters, Map, light_on_sensor
from sim_hw.world.scene import Scene, open_scene
from sim_hw.world.seeding import random_stream
from sim_hw.world.snapshots import exposure_parameters_of
from sim_hw.world.truth import SensorExposure
from sim_hw.world.world import World, WorldSettings
from sim_hw.world.world_clock import FreeRunningClock, WorldClock

VENDOR = "Syntopic emulator"
WARM_UP = ExposureParameters(mid_gps_ns=0, exposure_time_us=4000.0, tdi_shifts=1)
POLL_S = 0.5
DISTANT_FIRST_LINE_M = 1e7
"""A first line so far ahead that the aircraft does not turn for two days."""
HEAD_TEMPERATURE_SIGMA_C = 0.1
FREEZE_AFTER_NS = 20_000_000_000
"""Flown so far when the one exposure that heads hold still is taken."""


@dataclass(frozen=True)
class HeadPlan:
    """One head of this process: which sensor, and where it answers."""

    sensor: str
    address: str
    packet_loss: float
    faults: tuple[PlannedFault, ...] = ()


@dataclass(frozen=True)
class WorkerPlan:
    """What one worker process is to do."""

    settings: WorldSettings
    clock: WorldClock
    scene_cache: Path
    calibration: Path
    heads: tuple[HeadPlan, ...]
    is_frozen: bool = False
    sent: Path | None = None
    """Where the digests of frames are written, `SENSOR.jsonl`."""


@dataclass(frozen=True)
class PulseMessage:
    """Sent to a worker: a pulse of the bus, with the start of exposure of every sensor."""

    count: int
    start_mono_ns: dict[str, int]


@dataclass(frozen=True)
class FaultClockStart:
    """Sent to a worker: every device answers; the seconds of the faults count from this time."""

    mono_ns: int


@dataclass(frozen=True)
class AddedFaults:
    """Sent to a worker: further faults of any heads, their seconds counted from this time."""

    planned: tuple[PlannedFault, ...]
    mono_ns: int


@dataclass(frozen=True)
class WorkerStatus:
    """Sent by a worker: its heads answer, or the reason why they cannot."""

    event: Literal["ready", "failed"]
    sentence: str = ""


class FirstLine:
    """Where the first line begins, in metres flown; shared by all processes, set once.

    Nobody has seen the ground before the first exposure, so the line and its scene are laid where
    the first exposure finds the aircraft. Until then it flies straight on.
    """

    def __init__(self, flight: SimulatedFlight, shared: Synchronized[float]) -> None:
        self._waiting = flight.beginning_first_line_at(DISTANT_FIRST_LINE_M)
        self._begun: SimulatedFlight | None = None
        self._shared = shared

    def begin(self, gps_ns: int) -> None:
        """Begin the line here, if it has not begun."""
        with self._shared.get_lock():
            if math.isnan(self._shared.value):
                self._shared.value = self._waiting.distance_flown_m(gps_ns)

    @property
    def flight(self) -> SimulatedFlight:
        """The flight as it is known now."""
        if self._begun is not None:
            return self._begun
        begins_m = self._shared.value
        if math.isnan(begins_m):
            return self._waiting
        self._begun = self._waiting.beginning_first_line_at(begins_m)
        return self._begun


class RenderedHead:
    """A sensor of the world behind a GigE Vision head."""

    def __init__(
        self,
        world: World,
        scene: Scene,
        line: FirstLine,
        clock: WorldClock,
        plan: HeadPlan,
        report: Callable[[SensorExposure], None],
        sent: Path | None = None,
    ) -> None:
        self._sent = None if sent is None else sent / f"{plan.sensor}.jsonl"
        self._world = world
        self._scene = scene
        self._line = line
        self._clock = clock
        self._report = report
        self._still: Map | None = None
        self._frozen: tuple[tuple[float, int, float], NDArray[np.uint16]] | None = None
        self.sensor: Sensor = world.rig.sensor(plan.sensor)
        self.cone: Cone = world.rig.cone_of(plan.sensor)
        seed = world.settings.seed
        self.truth = true_sensor(
            self.cone, self.sensor, seed, field_radius_mm=world.field_radius_mm(self.cone)
        )
        self._electronics = Electronics(
            self.sensor, self.truth, world.electrons_per_radiance_s(self.cone)
        )
        random = random_stream(seed, "head", plan.sensor)
        self._temperature_error_c = float(random.normal(0, HEAD_TEMPERATURE_SIGMA_C))
        self.head = GigeHead(
            HeadIdentity(
                address=plan.address,
                serial=self.sensor.serial or f"{world.rig.name}-{plan.sensor}",
                model=world.rig.title[:31],
                vendor=VENDOR,
                user_id=plan.sensor,
            ),
            FrameSize(self.sensor.width_px, self.sensor.height_px),
            expose=self.expose,
            temperature_c=self.temperature_c,
            clock=FreeRunningClock(
                offset_ns=int(random.integers(0, 10**12)), drift_ppm=float(random.normal(0, 10))
            ),
            faults=WireFaults(packet_loss=plan.packet_loss, planned=plan.faults),
        )

    def temperature_c(self, mono_ns: int) -> float:
        """The reading of the head's own thermometer."""
        true_c = self._world.temperature_c(self.sensor.probe, self._clock.gps_ns(mono_ns))
        return true_c + self._temperature_error_c

    def expose(self, request: ExposureRequest) -> NDArray[np.uint16]:
        """Take a frame; on a pulse of the bus, report it for the truth and for the strobe."""
        half_ns = round(request.exposure_time_us * 500)
        parameters = ExposureParameters(
            mid_gps_ns=self._clock.gps_ns(request.start_mono_ns) + half_ns,
            exposure_time_us=request.exposure_time_us,
            tdi_shifts=request.tdi_shifts,
        )
        self._line.begin(parameters.mid_gps_ns)
        if request.pulse_count != NO_PULSE:
            self._report(SensorExposure(self.sensor.name, request.pulse_count, parameters))
        if self._still is None:
            pixels = self.frame(parameters, gain_db=request.gain_db, number=request.start_mono_ns)
        else:
            pixels = self._frozen_frame(parameters, request.gain_db)
        self._write_digest(request.pulse_count, pixels)
        return pixels

    def _write_digest(self, pulse_count: int, pixels: NDArray[np.uint16]) -> None:
        """Note what is sent, for whoever compares it with what was stored."""
        if self._sent is None:
            return
        digest = hashlib.sha256(pixels.tobytes()).hexdigest()
        with self._sent.open("a") as file:
            file.write(json.dumps({"pulse": pulse_count, "sha256": digest}) + "\n")

    def freeze_scene(self) -> None:
        """From now on show the same ground in the same light: nothing is rendered any more."""
        world = self._world
        mark_ns = world.settings.epoch_gps_ns + FREEZE_AFTER_NS
        flight = world.flight.beginning_first_line_at(world.flight.distance_flown_m(mark_ns))
        parameters = exposure_parameters_of(world, self.cone, mark_ns)
        self._still = light_on_sensor(
            world, self._scene, flight, self.cone, self.sensor, parameters
        )
        self._frozen_frame(parameters, 0.0)

    def _frozen_frame(self, parameters: ExposureParameters, gain_db: float) -> NDArray[np.uint16]:
        """The frame that is sent repeatedly; rendered again after a change of the settings."""
        settings = (parameters.exposure_time_us, parameters.tdi_shifts, gain_db)
        if self._frozen is None or self._frozen[0] != settings:
            assert self._still is not None
            self._frozen = settings, self._read_out(self._still, parameters, gain_db, number=0)
        return self._frozen[1]

    def frame(
        self, parameters: ExposureParameters, *, gain_db: float, number: int
    ) -> NDArray[np.uint16]:
        """Render a frame; `number` chooses its noise."""
        world = self._world
        light = light_on_sensor(
            world, self._scene, self._line.flight, self.cone, self.sensor, parameters
        )
        return self._read_out(light, parameters, gain_db, number=number)

    def _read_out(
        self, light: Map, parameters: ExposureParameters, gain_db: float, *, number: int
    ) -> NDArray[np.uint16]:
        world = self._world
        return self._electronics.frame(
            light,
            exposure_time_us=parameters.exposure_time_us,
            tdi_shifts=parameters.tdi_shifts,
            gain_db=gain_db,
            temperature_c=world.temperature_c(self.sensor.probe, parameters.mid_gps_ns),
            random=random_stream(world.settings.seed, "noise", self.sensor.name, number),
        )


def run(plan: WorkerPlan, pipe: Connection, first_line_m: Synchronized[float]) -> None:
    """Body of a worker process: until the pipe closes, or a signal comes."""
    stopping = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stopping.set())
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    terminate_with_parent()
    cv2.setNumThreads(1)
    sending = threading.Lock()

    def send_status(message: WorkerStatus | SensorExposure) -> None:
        with sending:
            pipe.send(message)

    try:
        heads = _open(plan, first_line_m, send_status)
    except (OSError, ValueError) as error:
        send_status(WorkerStatus("failed", f"{type(error).__name__}: {error}"))
        return
    try:
        send_status(WorkerStatus("ready"))
        _serve(pipe, heads, stopping)
    finally:
        for head in heads:
            head.head.close()


def _open(
    plan: WorkerPlan,
    first_line_m: Synchronized[float],
    send_status: Callable[[SensorExposure], None],
) -> Sequence[RenderedHead]:
    world = World(plan.settings)
    scene = open_scene(world.scene_settings, plan.scene_cache)
    line = FirstLine(world.flight, first_line_m)
    if plan.sent is not None:
        plan.sent.mkdir(parents=True, exist_ok=True)
    heads = [
        RenderedHead(world, scene, line, plan.clock, head, send_status, plan.sent)
        for head in plan.heads
    ]
    for head in heads:
        radiometry = sensor_calibration.measure(head.sensor, head.truth, plan.settings.seed)
        sensor_calibration.write_radiometry(plan.calibration, head.sensor, radiometry)
    # Kernels are compiled, or read from their cache, before anyone waits for a frame.
    heads[0].frame(WARM_UP, gain_db=0.0, number=0)
    if plan.is_frozen:
        for head in heads:
            head.freeze_scene()
    started: list[RenderedHead] = []
    try:
        for head in heads:
            head.head.start()
            started.append(head)
    except OSError:
        for head in started:
            head.head.close()
        raise
    return heads


def _serve(pipe: Connection, heads: Sequence[RenderedHead], stopping: threading.Event) -> None:
    while not stopping.is_set():
        try:
            if not pipe.poll(POLL_S):
                continue
            pulse = pipe.recv()
        except (EOFError, OSError):
            return
        if isinstance(pulse, FaultClockStart):
            for head in heads:
                head.head.channel.begin(pulse.mono_ns)
            continue
        if isinstance(pulse, AddedFaults):
            for head in heads:
                head.head.channel.add(for_device(pulse.planned, head.sensor.name), pulse.mono_ns)
            continue
        if not isinstance(pulse, PulseMessage):
            return
        for head in heads:
            start_ns = pulse.start_mono_ns.get(head.sensor.name)
            if start_ns is not None:
                head.head.line(start_ns, pulse.count)

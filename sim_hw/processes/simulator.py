"""The emulated rig: heads in worker processes; bus, receiver and probes in this one.

Composition only. The messages of a device are defined in its own file, what it sees in
`rendering`, what is true in `truth`.
"""

from __future__ import annotations

import functools
import ipaddress
import json
import math
import multiprocessing
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, TextIO

from sim_hw import SimulatorError
from sim_hw.devices.pps_source import PpsSource
from sim_hw.devices.pulse_bus import Firing, PulseBus
from sim_hw.faults.channel import BytesDamage, Channel, for_device
from sim_hw.faults.faulty_line import FaultyWire, FaultyWorldClock
from sim_hw.faults.plan import FaultPlanError, read_plan
from sim_hw.processes.discrete_event_rig import PROBES_NAME, RECEIVER_NAME, TRIGGER_NAME, devices_of
from sim_hw.processes.head_process import (
    AddedFaults,
    FaultClockStart,
    FirstLine,
    HeadPlan,
    PulseMessage,
    WorkerPlan,
    WorkerStatus,
    run,
)
from sim_hw.processes.parent_death import terminate_with_parent
from sim_hw.receivers import device_kinds as receivers
from sim_hw.receivers.device_kinds import EmulatedDevice
from sim_hw.receivers.emulated_receiver import ReceiverState
from sim_hw.world import scene, sensor_calibration, world
from sim_hw.world.seeding import random_stream
from sim_hw.world.truth import SensorExposure, TruthWriter
from sim_hw.world.world import World, WorldSettings
from sim_hw.world.world_clock import WorldClock

READY_TIMEOUT_S = 180.0
WORKER_STOP_TIMEOUT_S = 5.0
REPORT_POLL_S = 0.5
PROBE_DRIVERS = {"modbus": "modbus-rtu", "ascii": "ascii-line"}
PROBE_OFFSET_SIGMA_C = 0.07
PROBE_NOISE_SIGMA_C = 0.07
"""Together the 0.1 K that probes of this kind are good for."""


@dataclass(frozen=True)
class SimulatorSettings:
    """What the emulator is asked for, besides the world itself."""

    out: Path
    scene_cache: Path
    first_address: str = "127.0.0.2"
    packet_loss: float = 0.0
    processes: int = 2
    faults: tuple[str, ...] = ()
    scenario: Path | None = None
    receiver: str = "ublox"
    probe: str = "modbus"
    has_pps: bool = False
    is_frozen: bool = False
    has_digests: bool = False
    reads_faults: bool = False
    """Whether stdin holds faults, one in a line."""


class Simulator:
    """An emulated rig, from `start` to `close`. `report` receives messages for a person."""

    def __init__(
        self,
        settings: SimulatorSettings,
        world_: World,
        clock: WorldClock,
        report: Callable[[str], None],
    ) -> None:
        self._settings = settings
        self._world = world_
        self._clock = clock
        self._report = report
        context = multiprocessing.get_context("spawn")
        self._first_line_m = context.Value("d", math.nan)
        self._line = FirstLine(world_.flight, self._first_line_m)
        self._context = context
        self._workers: list[SpawnProcess] = []
        self._pipes: list[Connection] = []
        self._sending = threading.Lock()
        self._closing = threading.Event()
        self._reports: threading.Thread | None = None
        self._truth = TruthWriter(world_, settings.out / "truth")
        rig = world_.rig
        self._strobe = rig.cone(rig.reference_cone).sensors[0].name
        self.addresses = head_addresses(world_, settings.first_address)
        self.planned = read_plan(settings.faults, settings.scenario, devices_of(rig))
        self._channels = {
            name: Channel(
                for_device(self.planned, name),
                BytesDamage(),
                seed=f"{world_.settings.seed}-{name}",
                report=functools.partial(_report_device_fault, report, name),
            )
            for name in (TRIGGER_NAME, RECEIVER_NAME, PROBES_NAME)
        }
        self._bus = PulseBus(
            rig.name,
            [c.name for c in rig.cones],
            self._on_fire,
            faults=self._channels[TRIGGER_NAME],
        )
        ports = settings.out.resolve() / "ports"
        self._receiver = self._faulty_receiver(ports / RECEIVER_NAME)
        self._probes = receivers.probes(
            settings.probe,
            {probe: self._probe_reading(probe) for probe in rig.probes},
            ports / PROBES_NAME,
        )
        self._put_faults_on(self._probes, PROBES_NAME)
        self._pps = PpsSource(clock, seed=world_.settings.seed) if settings.has_pps else None

    def start(self) -> None:
        """Build the scene, measure the calibration, and open every device.

        Raises:
            SimulatorError: a device or the scene cannot be had.
        """
        out = self._settings.out
        try:
            self._report("scene: reading or building it")
            built = scene.open_scene(self._world.scene_settings, self._settings.scene_cache)
        except (scene.SceneError, OSError) as error:
            raise SimulatorError(str(error)) from error
        for sentence in scene.describe(built):
            self._report(sentence)
        sensor_calibration.write_rig(Path(self._world.settings.rig_file), out / "calibration")
        self._truth.write_parameters()
        self._report("heads: measuring their calibration and opening them")
        self._start_workers()
        self._bus.start()
        self._receiver.device.start()
        self._probes.device.start()
        if self._pps is not None:
            self._pps.start()
        self._reports = threading.Thread(target=self._follow_reports, name="reports", daemon=True)
        self._reports.start()
        self._begin_faults(time.monotonic_ns())

    def add_fault(self, text: str) -> None:
        """Plan a fault of a running rig, its seconds counted from now.

        Args:
            text: NAME@TIME[:DEVICE][,DURATION]

        Raises:
            FaultPlanError: it cannot be planned.
        """
        planned = read_plan([text], None, devices_of(self._world.rig))
        mono_ns = time.monotonic_ns()
        for name, channel in self._channels.items():
            channel.add(for_device(planned, name), mono_ns)
        with self._sending:
            for pipe in self._pipes:
                pipe.send(AddedFaults(planned, mono_ns))

    def close(self) -> None:
        """Close every device and write what truth is still open."""
        self._closing.set()
        self._bus.close()
        if self._reports is not None:
            self._reports.join(WORKER_STOP_TIMEOUT_S)
        for pipe in self._pipes:
            pipe.close()
        for worker in self._workers:
            worker.join(WORKER_STOP_TIMEOUT_S)
            if worker.is_alive():
                worker.kill()
                worker.join(WORKER_STOP_TIMEOUT_S)
        self._receiver.device.close()
        self._probes.device.close()
        if self._pps is not None:
            self._pps.close()
        self._truth.write_overdue(self._line.flight, wait_s=0.0)

    def ready_message(self) -> dict[str, Any]:
        """What a program needs to connect."""
        rig, out = self._world.rig, self._settings.out
        host, port = self._bus.address
        return {
            "event": "ready",
            "rig": rig.name,
            "rig_file": str(Path(self._world.settings.rig_file).resolve()),
            "heads": {
                sensor.name: {
                    "address": self.addresses[sensor.name],
                    "serial": sensor.serial or f"{rig.name}-{sensor.name}",
                }
                for sensor in rig.sensors
            },
            "pulse_bus": f"{host}:{port}",
            "receiver": {"driver": self._settings.receiver, **self._receiver.settings},
            "probes": {"driver": PROBE_DRIVERS[self._settings.probe], **self._probes.settings},
            "pps": None if self._pps is None else {"driver": "kernel", "device": self._pps.device},
            "calibration": str((out / "calibration").resolve()),
            "truth": str((out / "truth").resolve()),
            "plan": asdict(self._world.plan),
            "mono_ns_at_line_start": self._clock.mono_ns_at_start,
            "faults": [asdict(fault) for fault in self.planned],
        }

    def _faulty_receiver(self, port: Path) -> EmulatedDevice:
        """The receiver, with a clock of its own: what goes in and out is in times of the world."""
        clock = FaultyWorldClock(self._clock, self._channels[RECEIVER_NAME])
        self._receiver_clock = clock
        receiver = receivers.receiver(
            self._settings.receiver,
            clock,
            lambda own_gps_ns: self._receiver_state(clock.world_gps_ns(own_gps_ns)),
            port,
        )
        self._put_faults_on(receiver, RECEIVER_NAME)
        return receiver

    def _put_faults_on(self, emulated: EmulatedDevice, name: str) -> None:
        device = emulated.device
        device.byte_filter = FaultyWire(device, self._channels[name], emulated.cable)

    def _begin_faults(self, mono_ns: int) -> None:
        """Everything answers: the seconds of the faults count from now."""
        for channel in self._channels.values():
            channel.begin(mono_ns)
        with self._sending:
            for pipe in self._pipes:
                pipe.send(FaultClockStart(mono_ns))

    def _start_workers(self) -> None:
        sensors = self._world.rig.sensors
        groups = [sensors[i :: self._settings.processes] for i in range(self._settings.processes)]
        for group in filter(None, groups):
            plan = WorkerPlan(
                settings=self._world.settings,
                clock=self._clock,
                scene_cache=self._settings.scene_cache,
                calibration=self._settings.out / "calibration",
                heads=tuple(
                    HeadPlan(
                        s.name,
                        self.addresses[s.name],
                        self._settings.packet_loss,
                        for_device(self.planned, s.name),
                    )
                    for s in group
                ),
                is_frozen=self._settings.is_frozen,
                sent=self._settings.out / "sent" if self._settings.has_digests else None,
            )
            ours, theirs = self._context.Pipe()
            worker = self._context.Process(
                target=run,
                args=(plan, theirs, self._first_line_m),
                name=f"heads-{group[0].name}",
                daemon=True,
            )
            worker.start()
            theirs.close()
            self._workers.append(worker)
            self._pipes.append(ours)
        deadline_s = time.monotonic() + READY_TIMEOUT_S
        for pipe in self._pipes:
            self._wait_until_ready(pipe, deadline_s)

    def _wait_until_ready(self, pipe: Connection, deadline_s: float) -> None:
        if not pipe.poll(max(0.0, deadline_s - time.monotonic())):
            raise SimulatorError(f"heads were not ready within {READY_TIMEOUT_S:.0f} s")
        try:
            status = pipe.recv()
        except EOFError:
            raise SimulatorError("a process of heads died while it was opening them") from None
        if not isinstance(status, WorkerStatus) or status.event != "ready":
            raise SimulatorError(f"heads cannot be opened: {status.sentence}")

    def _on_fire(self, firing: Firing) -> None:
        """Hand a firing of the bus to the heads of every cone."""
        pulses = firing.pulses_mono_ns
        first_ns = pulses.get(self._world.rig.reference_cone, min(pulses.values()))
        self._line.begin(self._clock.gps_ns(first_ns))
        for channel in self._channels.values():
            channel.pulse(firing.count, first_ns)
        starts = {
            sensor.name: pulses[cone.name]
            for cone in self._world.rig.cones
            if cone.name in pulses
            for sensor in cone.sensors
        }
        with self._sending:
            for pipe in self._pipes:
                try:
                    pipe.send(PulseMessage(firing.count, starts))
                except OSError:
                    self._report("a process of heads is gone; its pulses are lost")

    def _follow_reports(self) -> None:
        """Strobes to the receiver, exposures to the truth, until the end."""
        open_pipes = list(self._pipes)
        while not self._closing.is_set():
            for pipe in wait(open_pipes, REPORT_POLL_S) if open_pipes else ():
                assert isinstance(pipe, Connection)
                try:
                    message = pipe.recv()
                except (EOFError, OSError):
                    open_pipes.remove(pipe)
                    if not self._closing.is_set():
                        self._report("a process of heads has ended")
                    continue
                if isinstance(message, SensorExposure):
                    self._on_exposure(message)
            if not open_pipes:
                self._closing.wait(REPORT_POLL_S)
            self._truth.write_overdue(self._line.flight)

    def _on_exposure(self, taken: SensorExposure) -> None:
        if taken.sensor == self._strobe:
            self._receiver.device.mark(self._receiver_clock.own_gps_ns(taken.parameters.mid_gps_ns))
        if not self._settings.is_frozen:
            self._truth.add(taken, self._line.flight)

    def _receiver_state(self, gps_ns: int) -> ReceiverState:
        flight = self._line.flight
        pose = flight.pose(gps_ns)
        latitude, longitude, height = flight.geodetic(pose.position_enu_m)
        roll, pitch, heading = flight.attitude_rad(pose)
        return ReceiverState(
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_m=height,
            velocity_ned_mps=flight.velocity_ned_mps(pose),
            roll_deg=math.degrees(roll),
            pitch_deg=math.degrees(pitch),
            heading_deg=math.degrees(heading),
        )

    def _probe_reading(self, probe: str) -> Callable[[], float | None]:
        random = random_stream(self._world.settings.seed, "probe", probe)
        offset_c = float(random.normal(0, PROBE_OFFSET_SIGMA_C))

        def reading() -> float | None:
            now_ns = time.monotonic_ns()
            if self._channels[PROBES_NAME].sensor_is_open(now_ns):
                return None
            gps_ns = self._clock.gps_ns(now_ns)
            noise_c = float(random.normal(0, PROBE_NOISE_SIGMA_C))
            return self._world.temperature_c(probe, gps_ns) + offset_c + noise_c

        return reading


def _report_device_fault(report: Callable[[str], None], device: str, sentence: str) -> None:
    report(f"{device}: {sentence}")


def head_addresses(world_: World, first_address: str) -> dict[str, str]:
    """One loopback address for each sensor, counting up from the first.

    Raises:
        SimulatorError: not a loopback address.
    """
    try:
        first = ipaddress.IPv4Address(first_address)
    except ValueError as error:
        raise SimulatorError(f"first address {first_address!r}: {error}") from error
    if not first.is_loopback:
        raise SimulatorError(f"first address {first} is not a loopback address (127.x.x.x)")
    return {s.name: str(first + i) for i, s in enumerate(world_.rig.sensors)}


def simulate(settings: SimulatorSettings, world_settings: WorldSettings, clock: WorldClock) -> int:
    """Run an emulated rig until a signal ends it or its parent dies; say "ready" on stdout."""

    def report(sentence: str) -> None:
        print(f"sim_hw: {sentence}", file=sys.stderr, flush=True)

    stopping = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopping.set())
    terminate_with_parent()
    settings.out.mkdir(parents=True, exist_ok=True)
    try:
        simulator = Simulator(settings, World(world_settings), clock, report)
    except (SimulatorError, ValueError) as error:
        for sentence in str(error).splitlines():
            report(sentence)
        return 1
    describe(simulator, report)
    try:
        simulator.start()
        print(json.dumps(simulator.ready_message()), flush=True)
        if settings.reads_faults:
            reader = (simulator, sys.stdin, report)
            threading.Thread(target=_read_faults, args=reader, name="faults", daemon=True).start()
        while not stopping.wait(1.0):
            pass
    except SimulatorError as error:
        report(str(error))
        return 1
    finally:
        simulator.close()
    return 0


def _read_faults(simulator: Simulator, lines: TextIO, report: Callable[[str], None]) -> None:
    """Plan the fault of each line until the end of the input."""
    for line in lines:
        try:
            simulator.add_fault(line.strip())
        except (FaultPlanError, OSError) as error:
            report(str(error))


def describe(simulator: Simulator, report: Callable[[str], None]) -> None:
    """Say what is going to be flown."""
    sentences: Sequence[str] = world.describe(simulator._world)
    for sentence in sentences:
        report(sentence)

"""The emulated rig on the caller's clock: no threads, no sockets, no pixels, no waiting.

Trigger unit, heads, receiver and probes send the same messages as on the wire and have the same
faults; a flight of hours takes seconds. Only this module knows the truth.
"""

from __future__ import annotations

import heapq
import itertools
import math
import random
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

from processing.rig import Rig
from sim_hw.devices.modbus_probe import OPEN_SENSOR, READ_INPUT_REGISTERS, crc16
from sim_hw.faults.catalogue import (
    HEAD,
    MARK,
    NAVIGATION,
    RECEIVER,
    THERMOMETER,
    TRIGGER,
    DeviceKind,
)
from sim_hw.faults.channel import BytesDamage, Channel, for_device
from sim_hw.faults.plan import PlannedFault
from sim_hw.receivers.emulated_receiver import ReceiverAccuracy, ReceiverState
from sim_hw.receivers.ublox_messages import (
    nav_att,
    nav_pvt,
    nav_timegps,
    nav_timels,
    tim_tm2,
)
from sim_hw.world.world_clock import LEAP_SECONDS, NS_PER_S, FreeRunningClock, WorldClock

RECEIVER_NAME = "receiver"
PROBES_NAME = "probes"
TRIGGER_NAME = "trigger"
PROBE_UNIT = 1

NAV_PERIOD_NS = 200_000_000
SERIAL_LATENCY_NS = (30_000_000, 80_000_000)
ANSWER_LATENCY_NS = (150_000, 900_000)
TRANSFER_NS = (80_000_000, 200_000_000)
STROBE_WIDTH_NS = 50_000
BOOT_NS = 3 * NS_PER_S
"""From power on to the first position."""
SATELLITES = 14
TRACK_SPEED_MPS = 62.0
EARTH_M_PER_DEG = 111_200.0
NO_PULSE = 0
"""The exposure of a frame that no pulse asked for."""

Integrity = Literal["whole", "half", "corrupt"]


@dataclass(frozen=True)
class SentFrame:
    """A frame as it leaves a head. `exposure` is the pulse that its pixels were exposed by."""

    head: str
    exposure: int
    counter: int
    device_ns: int
    integrity: Integrity = "whole"


class FrameDamage:
    """Damage of a frame."""

    def corrupt(self, message: SentFrame, rng: random.Random) -> SentFrame:
        return replace(message, integrity="corrupt")

    def truncated(self, message: SentFrame, rng: random.Random) -> SentFrame:
        return replace(message, integrity="half")

    def first_half(self, message: SentFrame) -> SentFrame:
        return replace(message, integrity="half")


class DeviceListener(Protocol):
    """Receives the devices' messages at the moment of their arrival."""

    def on_trigger_answer(self, line: bytes, now_ns: int) -> None: ...

    def on_frame(self, frame: SentFrame, now_ns: int) -> None: ...

    def on_receiver_data(self, data: bytes, now_ns: int) -> None: ...

    def on_probe_data(self, data: bytes, now_ns: int) -> None: ...


@dataclass(frozen=True)
class SentMark:
    """A mark as the receiver put it into a message: for whom, and when it left."""

    exposure: int
    true_gps_ns: int
    sent_ns: int


class EventQueue:
    """What happens when: callbacks in the order of their instants."""

    def __init__(self) -> None:
        self._events: list[tuple[int, int, Callable[[int], None]]] = []
        self._order = itertools.count()

    def at(self, at_ns: int, do: Callable[[int], None]) -> None:
        """Have it done then; the instant is handed over."""
        heapq.heappush(self._events, (at_ns, next(self._order), do))

    def run_until(
        self,
        end_ns: int,
        set_clock: Callable[[int], None],
        until: Callable[[], bool] | None = None,
    ) -> None:
        """Do all that is due up to then, the clock set before each; or until something is so."""
        while self._events and self._events[0][0] <= end_ns:
            at_ns, _, do = heapq.heappop(self._events)
            set_clock(at_ns)
            do(at_ns)
            if until is not None and until():
                return


class DiscreteEventHead:
    """A head: pulses in, frames out."""

    def __init__(self, name: str, channel: Channel[SentFrame], rng: random.Random) -> None:
        self.name = name
        self.channel = channel
        self._rng = rng
        self._clock = FreeRunningClock(rng.randrange(10**12), rng.gauss(0.0, 10.0))
        self._counter = 0
        self._is_acquiring = False
        self._busy_until_ns = 0

    def is_responding(self, now_ns: int) -> bool:
        """Whether a question to the head is answered."""
        if self.channel.has_power_cycled(now_ns):
            self._is_acquiring = False
            self._clock = FreeRunningClock(-now_ns, self._rng.gauss(0.0, 10.0))
        return self.channel.is_connected(now_ns) and not self.channel.is_silent(now_ns)

    @property
    def is_acquiring(self) -> bool:
        """Whether it still knows that it was started."""
        return self._is_acquiring

    def begin(self) -> None:
        """AcquisitionStart: the count starts at 1."""
        self._is_acquiring = True
        self._counter = 0

    def clock_ns(self, now_ns: int) -> int:
        """The head's own clock."""
        return self._clock.device_ns(now_ns) + self.channel.clock_error_ns(now_ns)

    def expose_pulse(self, start_ns: int, exposure: int, lasts_ns: int) -> SentFrame | None:
        """The frame of a pulse; None where the head was off, not started, or exposing already."""
        if not self.channel.is_powered(start_ns) or not self._is_acquiring:
            return None
        if start_ns < self._busy_until_ns:
            return None
        self._busy_until_ns = start_ns + lasts_ns
        if self.channel.counter_restarts(start_ns):
            self._counter = 0
        self._counter += 1
        return SentFrame(self.name, exposure, self._counter, self.clock_ns(start_ns))

    def transfer_ns(self) -> int:
        """How long this frame is on its way."""
        return self._rng.randrange(*TRANSFER_NS)


class DiscreteEventReceiver:
    """A u-blox receiver on an aircraft that flies north in shallow waves."""

    def __init__(self, channel: Channel[bytes], world: WorldClock, rng: random.Random) -> None:
        self.channel = channel
        self._world = world
        self._rng = rng
        self._accuracy = ReceiverAccuracy()
        self._edges: list[tuple[int, int]] = []
        self._count = rng.randrange(1 << 16)
        self._boots_until_ns = 0
        self.sent_marks: dict[int, SentMark] = {}
        """Every mark that was put into a message, by the GPS time stated in it."""

    def state(self, gps_ns: int) -> ReceiverState:
        """Where the aircraft truly is."""
        t_s = (gps_ns - self._world.gps_ns_at_start) / NS_PER_S
        wave = 2 * math.pi * t_s / 90.0
        metres_per_degree_east = EARTH_M_PER_DEG * math.cos(math.radians(48.0))
        east_m, east_mps = 120.0 * math.sin(wave), 120.0 * 2 * math.pi / 90.0 * math.cos(wave)
        return ReceiverState(
            latitude_deg=48.0 + TRACK_SPEED_MPS * t_s / EARTH_M_PER_DEG % 20.0,
            longitude_deg=11.0 + east_m / metres_per_degree_east,
            height_m=3400.0,
            velocity_ned_mps=(TRACK_SPEED_MPS, east_mps, 0.0),
            roll_deg=0.0,
            pitch_deg=0.0,
            heading_deg=math.degrees(math.atan2(east_mps, TRACK_SPEED_MPS)) % 360.0,
        )

    def strobe(self, at_ns: int, exposure: int) -> None:
        """The rising edge of the strobe; nothing counts it while the receiver is off."""
        if self.channel.is_powered(at_ns):
            self._edges.append((at_ns, exposure))

    def epoch(self, now_ns: int) -> list[tuple[str, str, bytes]]:
        """Its messages for the epoch at this instant: topic, name and bytes of each."""
        channel = self.channel
        if channel.has_power_cycled(now_ns):
            self._boots_until_ns = now_ns + BOOT_NS
            self._count = 0
            self._edges.clear()
        if not channel.is_powered(now_ns) or now_ns < self._boots_until_ns:
            return []
        true_gps_ns = self._world.gps_ns(now_ns)
        gps_ns = true_gps_ns + channel.clock_error_ns(now_ns)
        state = self.state(true_gps_ns)
        navigation = [
            nav_pvt(gps_ns, state, self._accuracy, SATELLITES, LEAP_SECONDS),
            nav_att(gps_ns, state, self._accuracy),
            nav_timegps(gps_ns, self._accuracy, LEAP_SECONDS),
        ]
        if true_gps_ns % NS_PER_S < NAV_PERIOD_NS:
            navigation.append(nav_timels(gps_ns, LEAP_SECONDS))
        messages = [(NAVIGATION, "", b"".join(navigation))]
        mark = self._mark(now_ns)
        return [*messages, mark] if mark is not None else messages

    def _mark(self, now_ns: int) -> tuple[str, str, bytes] | None:
        """TIM-TM2 for the last edge before this epoch; earlier ones are counted only."""
        due = [edge for edge in self._edges if edge[0] <= now_ns]
        self._edges = [edge for edge in self._edges if edge[0] > now_ns]
        if self.channel.counter_restarts(now_ns):
            self._count = 0
        if not due:
            return None
        self._count += len(due)
        edge_ns, exposure = due[-1]
        true_gps_ns = self._world.gps_ns(edge_ns)
        noise_ns = round(self._rng.gauss(0.0, self._accuracy.mark_ns))
        sent_ns = true_gps_ns + self.channel.clock_error_ns(edge_ns) + noise_ns
        self.sent_marks[sent_ns] = SentMark(exposure, true_gps_ns, now_ns)
        message = tim_tm2(
            rising_gps_ns=sent_ns,
            falling_gps_ns=sent_ns + STROBE_WIDTH_NS,
            is_new_rising=True,
            is_new_falling=True,
            rising_count=self._count & 0xFFFF,
            accuracy_ns=self._accuracy.mark_ns,
        )
        return MARK, str(exposure), message


class DiscreteEventRig:
    """All devices of a rig on one timeline; `listener` receives their messages.

    Time zero of the faults is the start of the world. The devices are named as on the wire: heads
    by their sensors, `receiver`, `probes` and `trigger`.
    """

    def __init__(
        self,
        rig: Rig,
        timeline: EventQueue,
        listener: DeviceListener,
        planned: Sequence[PlannedFault],
        *,
        world: WorldClock,
        seed: int,
        exposure_ns: int,
    ) -> None:
        self.rig = rig
        self._timeline = timeline
        self._listener = listener
        self._rng = random.Random(f"clockwork-{seed}")
        self._world = world
        self._exposure_ns = exposure_ns
        frames = FrameDamage()
        fields = BytesDamage()

        def channel(name: str) -> Channel[bytes]:
            return Channel(for_device(planned, name), fields, seed=f"{seed}-{name}")

        self.heads = {
            sensor.name: DiscreteEventHead(
                sensor.name,
                Channel(for_device(planned, sensor.name), frames, seed=f"{seed}-{sensor.name}"),
                random.Random(f"clockwork-{seed}-{sensor.name}"),
            )
            for sensor in rig.sensors
        }
        self.receiver = DiscreteEventReceiver(
            channel(RECEIVER_NAME), world, random.Random(f"clockwork-{seed}-receiver")
        )
        self.trigger = channel(TRIGGER_NAME)
        self.probes = channel(PROBES_NAME)
        self.pulses: dict[int, int] = {}
        """Every pulse that was given, by the caller's sequence: the truth of it."""
        self._count = 0
        self._delays_ns = {cone.name: 0 for cone in rig.cones}
        self._exposure = 0
        self.true_strobe_gps_ns: dict[int, int] = {}
        for each in self.channels.values():
            each.begin(world.mono_ns_at_start)
        timeline.at(world.mono_ns_at_start + NAV_PERIOD_NS, self._epoch)
        timeline.at(world.mono_ns_at_start + NAV_PERIOD_NS // 2, self._flood)

    @property
    def channels(self) -> Mapping[str, Channel[bytes] | Channel[SentFrame]]:
        """The way out of every device, by its name."""
        return {
            **{name: head.channel for name, head in self.heads.items()},
            RECEIVER_NAME: self.receiver.channel,
            PROBES_NAME: self.probes,
            TRIGGER_NAME: self.trigger,
        }

    def connect_trigger_client(self, now_ns: int) -> None:
        """A program connects to the trigger unit."""
        if self.trigger.has_power_cycled(now_ns):
            self._count = 0
            self._delays_ns = dict.fromkeys(self._delays_ns, 0)
        outputs = " ".join(cone.name for cone in self.rig.cones)
        self._answer(f"PULSEBUS 1 {self.rig.name} {outputs}", now_ns)

    def execute(self, line: bytes, now_ns: int) -> None:
        """A line of the program (docs/reference/flight/pulse-bus.md).

        It is not received if the cable is out.
        """
        if not self.trigger.is_connected(now_ns):
            return
        match line.decode().split():
            case ["DELAY", output, delay_ns]:
                self._delays_ns[output] = int(delay_ns)
                self._answer(f"OK DELAY {output} {delay_ns}", now_ns)
            case ["FIRE", sequence]:
                self._fire(int(sequence), now_ns)
            case ["STATUS"]:
                self._answer(f"STATUS {self._count}", now_ns)
            case fields:
                raise ValueError(f"the trigger client sent {fields}")

    def _fire(self, sequence: int, now_ns: int) -> None:
        received_ns = now_ns + self._rng.randrange(*ANSWER_LATENCY_NS) // 2
        if self.trigger.counter_restarts(now_ns):
            self._count = 0
        self._count += 1
        self._exposure += 1
        exposure = self._exposure
        self.pulses[exposure] = sequence
        for channel in self.channels.values():
            channel.pulse(exposure, received_ns)
        strobe_ns = received_ns + self._delays_ns[self.rig.reference_cone] + self._exposure_ns // 2
        self.true_strobe_gps_ns[exposure] = self._world.gps_ns(strobe_ns)
        self._timeline.at(strobe_ns, lambda at_ns: self.receiver.strobe(at_ns, exposure))
        for cone in self.rig.cones:
            for sensor in cone.sensors:
                start_ns = received_ns + self._delays_ns[cone.name]
                self._expose(self.heads[sensor.name], start_ns, exposure)
        self._answer(f"FIRED {sequence} {self._count}", received_ns, what=str(exposure))

    def _answer(self, text: str, now_ns: int, *, what: str = "") -> None:
        transit_ns = self._rng.randrange(*ANSWER_LATENCY_NS) // 2
        for delivery in self.trigger.send(text.encode() + b"\n", now_ns, what=what):
            self._schedule_arrival(
                delivery.at_ns + transit_ns, self._listener.on_trigger_answer, delivery.message
            )

    def poll_probes(self, values_c: Sequence[float], now_ns: int) -> None:
        """The thermometers are asked; the answer comes 20 ms later, or not."""
        probes = self.probes
        probes.has_power_cycled(now_ns)
        is_open = probes.sensor_is_open(now_ns)
        fields = [OPEN_SENSOR if is_open else round(v * 10) & 0xFFFF for v in values_c]
        body = struct.pack(
            f">BBB{len(fields)}H", PROBE_UNIT, READ_INPUT_REGISTERS, 2 * len(fields), *fields
        )
        for delivery in probes.send(body + struct.pack("<H", crc16(body)), now_ns):
            self._schedule_arrival(
                delivery.at_ns + 20_000_000, self._listener.on_probe_data, delivery.message
            )

    def _expose(self, head: DiscreteEventHead, start_ns: int, exposure: int) -> None:
        def expose(at_ns: int) -> None:
            frame = head.expose_pulse(at_ns, exposure, self._exposure_ns)
            if frame is not None:
                self._timeline.at(
                    at_ns + self._exposure_ns, lambda end_ns: self._send(head, frame, end_ns)
                )

        self._timeline.at(start_ns, expose)

    def _send(self, head: DiscreteEventHead, frame: SentFrame, now_ns: int) -> None:
        transfer_ns = head.transfer_ns()
        for delivery in head.channel.send(frame, now_ns, what=str(frame.exposure)):
            self._schedule_arrival(
                delivery.at_ns + transfer_ns, self._listener.on_frame, delivery.message
            )

    def _epoch(self, now_ns: int) -> None:
        latency_ns = self._rng.randrange(*SERIAL_LATENCY_NS)
        channel = self.receiver.channel
        for topic, what, data in self.receiver.epoch(now_ns):
            for delivery in channel.send(data, now_ns, topic=topic, what=what):
                self._schedule_arrival(
                    delivery.at_ns + latency_ns, self._listener.on_receiver_data, delivery.message
                )
        self._timeline.at(now_ns + NAV_PERIOD_NS, self._epoch)

    def _flood(self, now_ns: int) -> None:
        for head in self.heads.values():
            if head.channel.flood_is_due(now_ns):
                untriggered = head.expose_pulse(now_ns, NO_PULSE, self._exposure_ns)
                if untriggered is not None:
                    self._send(head, untriggered, now_ns)
        if self.receiver.channel.flood_is_due(now_ns):
            self._listener.on_receiver_data(self.receiver.channel.noise(2000), now_ns)
        if self.probes.flood_is_due(now_ns):
            self._listener.on_probe_data(self.probes.noise(500), now_ns)
        if self.trigger.flood_is_due(now_ns):
            self._listener.on_trigger_answer(b"FIRED 4294967295 1\n", now_ns)
        self._timeline.at(now_ns + NAV_PERIOD_NS // 2, self._flood)

    def _schedule_arrival(
        self, at_ns: int, handler: Callable[..., None], message: bytes | SentFrame
    ) -> None:
        self._timeline.at(at_ns, lambda now_ns: handler(message, now_ns))


def devices_of(rig: Rig) -> dict[str, DeviceKind]:
    """The devices of an emulated rig, by the names that faults are planned for."""
    devices: dict[str, DeviceKind] = {sensor.name: HEAD for sensor in rig.sensors}
    return {
        **devices,
        RECEIVER_NAME: RECEIVER,
        PROBES_NAME: THERMOMETER,
        TRIGGER_NAME: TRIGGER,
    }

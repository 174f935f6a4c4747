"""A flight on a fake clock: the service's real pieces against the emulated rig without wires.

Line, trigger client, decoders, flight, matching, clock, track and ledger are the ones that fly.
What stands in for processes and disks is here: reopening of lost devices, slots of memory, a disk
that takes 150 ms. What was recorded is compared with the truth in `benchmarks.fast_flight_score`.
"""

from __future__ import annotations

import functools
import random
import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from benchmarks.fast_flight_score import Comparison, PulseTruth, Score
from daemon.configuration.model import Configuration
from daemon.mission.exposure import CaptureRecord, Exposure
from daemon.onboard.flight.flight import Flight
from daemon.onboard.flight.flight_identity import FlightIdentity
from daemon.onboard.flight.ledger import Ledger
from daemon.onboard.preflight.service_file import from_mapping
from daemon.onboard.service.flight_line import FlightLine, Order
from daemon.onboard.timing.matching import Cause, FiredPulse
from drivers.contract import (
    DeviceError,
    EventMark,
    Frame,
    FrameStatus,
    NavSample,
    TemperatureSample,
)
from drivers.receivers.ublox.decoder import UbxDecoder
from drivers.thermometers.modbus_rtu.frames import find_reply
from drivers.timescales.clock import BackOff
from drivers.triggers.pulse_bus import PulseBusTrigger
from processing.rig import Rig, find_rig
from sim_hw.faults.plan import PlannedFault
from sim_hw.processes.discrete_event_rig import (
    DiscreteEventHead,
    DiscreteEventRig,
    EventQueue,
    SentFrame,
)
from sim_hw.world.world_clock import NS_PER_S, NS_PER_WEEK, WorldClock

EXPOSURE_NS = 4_000_000
TICK_NS = 100_000_000
LATCH_NS = 2 * NS_PER_S
LATCH_SIGMA_NS = 80_000
SUSPICION_NS = 2 * NS_PER_S
"""A head that answers nothing for so long is lost; see `drivers.cameras.aravis.head_session`."""
REOPENED_SERIAL_NS = 5 * NS_PER_S
"""Longest pause before a lost serial port is tried again."""
ANSWER_TIMEOUT_NS = NS_PER_S // 2
DISK_NS = 150_000_000
PROBE_C = 32.5
FLIGHT_TIMEOUT_NS = 60 * NS_PER_S
"""An exposure that is open for so long hangs."""


class FakeClock:
    """The clock of the drivers: the timeline's."""

    def __init__(self) -> None:
        self.now_ns = 0

    def mono_ns(self) -> int:
        return self.now_ns

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        return event.is_set()


class _Wire:
    """The trigger client's connection on the timeline: waiting moves the clock."""

    def __init__(self, flight: FastFlight, host: str, port: int, timeout_s: float) -> None:
        self._flight = flight
        self._timeout_s = timeout_s
        flight.inbox.clear()
        if not flight.clockwork.trigger.is_connected(flight.clock.now_ns):
            flight.advance(flight.clock.now_ns + round(timeout_s * NS_PER_S))
            raise TimeoutError("timed out")
        flight.clockwork.connect_trigger_client(flight.clock.now_ns)

    def settimeout(self, value: float, /) -> None:
        self._timeout_s = value

    def sendall(self, data: bytes, /) -> None:
        self._flight.clockwork.execute(data, self._flight.clock.now_ns)

    def recv(self, size: int, /) -> bytes:
        flight = self._flight
        end_ns = flight.clock.now_ns + round(self._timeout_s * NS_PER_S)
        flight.advance(end_ns, until=lambda: bool(flight.inbox))
        if not flight.inbox:
            raise TimeoutError("timed out")
        return flight.inbox.popleft()

    def shutdown(self, how: int, /) -> None:
        pass

    def close(self) -> None:
        pass


@dataclass
class _Session:
    """What the driver of a head knows."""

    is_open: bool = False
    suspected_ns: int | None = None
    next_try_ns: int = 0
    latch: tuple[int, int] | None = None
    latched_ns: int = 0
    pause: BackOff = field(default_factory=BackOff)


class FastFlight:
    """One flight with its faults, from `fly` to its `Score`."""

    def __init__(
        self,
        rig_name: str,
        planned: Sequence[PlannedFault],
        *,
        exposures: int,
        seed: int,
        mission: Path,
    ) -> None:
        self.rig = find_rig(rig_name)
        self.configuration = configuration(self.rig, exposures)
        self.clock = FakeClock()
        self.timeline = EventQueue()
        # A week ends an hour after the start: every long flight passes a rollover.
        world = WorldClock(2400 * NS_PER_WEEK - 3600 * NS_PER_S, 1000 * NS_PER_S)
        self.world = world
        self.clock.now_ns = world.mono_ns_at_start
        self.clockwork = DiscreteEventRig(
            self.rig, self.timeline, self, planned, world=world, seed=seed, exposure_ns=EXPOSURE_NS
        )
        self.inbox: deque[bytes] = deque()
        heads = [sensor.name for sensor in self.rig.sensors]
        self.flight = Flight(
            self.rig,
            dict.fromkeys(heads, ""),
            FlightIdentity("boot", "1", "calibration", "", "", "syntopic", simulated=True),
            self.configuration.limits,
            Ledger(heads),
            first_number=1,
        )
        self.line = FlightLine(self.configuration, self.rig, self.flight, mission, 0)
        self.trigger = PulseBusTrigger(
            "trigger",
            {"port": 1},
            clock=self.clock,
            connect=lambda host, port, timeout_s: _Wire(self, host, port, timeout_s),
        )
        self._programmed: Mapping[str, int] = {}
        self._decoder = UbxDecoder("receiver")
        self._receiver_is_open = True
        self._receiver_back_ns = 0
        self._sessions = {head: _Session() for head in heads}
        self._slots = {
            head: list(range(self.configuration.limits.exposures_in_memory)) for head in heads
        }
        self._pixels: dict[tuple[str, int], int] = {}
        """Which exposure's pixels lie in a slot: the truth, for the heads only."""
        self._requested_ns: int | None = None
        self._probe_bytes = b""
        self._next_probe_ns = 0
        self._rng = random.Random(f"host-{seed}")
        self._captures: dict[int, CaptureRecord] = {}
        self._stored_pixels: dict[int, dict[str, int]] = {}
        self._answered: set[int] = set()
        self._ordered_ns: dict[int, int] = {}
        self.truth: dict[int, PulseTruth] = {}
        self.records: list[Exposure] = []
        self.open_s: list[float] = []
        self.score = Score(exposures=exposures)
        self.events: Counter[str] = Counter()

    def fly(self) -> Score:
        """Fly all exposures and compare the records with the truth."""
        for head, session in self._sessions.items():
            self._open_head(self.clockwork.heads[head], session)
        self.advance(self.clock.now_ns + 2 * NS_PER_S)
        while not self.line.is_flown:
            wait_s = self.line.wait_s(self.clock.now_ns)
            if wait_s > 0:
                self.advance(self.clock.now_ns + round(wait_s * NS_PER_S))
            else:
                self._fire(self.line.order(self.clock.now_ns))
        end_ns = self.clock.now_ns + FLIGHT_TIMEOUT_NS
        self.advance(end_ns, until=lambda: not self.flight.open_numbers)
        self.score.hangs += len(self.flight.open_numbers)
        for exposure in self.clockwork.pulses:
            self._truth(exposure)
        Comparison(
            self.clockwork,
            self._sessions,
            self.truth,
            self.records,
            self._stored_pixels,
            self.open_s,
            self.score,
        ).compare()
        return self.score

    def advance(self, end_ns: int, until: Callable[[], bool] | None = None) -> None:
        """Let time pass, tick by tick, until then or until something is so."""
        while self.clock.now_ns < end_ns:
            if until is not None and until():
                return
            next_ns = min(end_ns, self.clock.now_ns // TICK_NS * TICK_NS + TICK_NS)
            self.timeline.run_until(next_ns, self._set_clock, until)
            if until is not None and until():
                return
            self.clock.now_ns = next_ns
            if next_ns % TICK_NS == 0:
                self._tick(next_ns)

    def _set_clock(self, now_ns: int) -> None:
        self.clock.now_ns = now_ns

    # What the devices say

    def on_trigger_answer(self, line: bytes, now_ns: int) -> None:
        self.inbox.append(line)

    def on_receiver_data(self, data: bytes, now_ns: int) -> None:
        if not self._receiver_is_open:
            return
        for record in self._decoder.feed(data, now_ns):
            if isinstance(record, NavSample):
                self.flight.take(record)
            elif isinstance(record, EventMark):
                sent_marks = self.clockwork.receiver.sent_marks.get(record.gps_ns)
                exposure = None if sent_marks is None else self._truth(sent_marks.exposure)
                if exposure is not None:
                    waited_ns = now_ns - exposure.ordered_ns
                    limit_ns = self.configuration.limits.mark_timeout_s * NS_PER_S
                    exposure.mark_received |= waited_ns < limit_ns and record.time_valid
                self.flight.take(record)

    def on_probe_data(self, data: bytes, now_ns: int) -> None:
        if self._requested_ns is None or now_ns - self._requested_ns > ANSWER_TIMEOUT_NS:
            return
        self._probe_bytes += data
        reply = find_reply(self._probe_bytes, 1, len(self.rig.probes))
        if reply is None or reply.exception is not None:
            return
        self._requested_ns = None
        for probe, register in zip(self.rig.probes, reply.registers, strict=True):
            value_c = None if register == 0x7FFF else register / 10
            if value_c not in (None, PROBE_C):
                self.score.add_example(f"probe {probe} reported {value_c}, it is {PROBE_C}")
                self.score.imbalances += 1
            self.flight.take(TemperatureSample(probe, value_c, now_ns))

    def on_frame(self, frame: SentFrame, now_ns: int) -> None:
        session = self._sessions[frame.head]
        head = self.clockwork.heads[frame.head]
        if not session.is_open or not head.channel.is_connected(now_ns):
            return
        if not self._slots[frame.head]:
            self.events["underruns"] += 1
            return
        slot = self._slots[frame.head].pop(0)
        self._pixels[frame.head, slot] = frame.exposure
        truth = self._truth(frame.exposure)
        if truth is not None and frame.integrity == "whole":
            limit_ns = self.configuration.limits.frame_timeout_s * NS_PER_S
            if now_ns - truth.ordered_ns < limit_ns:
                truth.frames.add(frame.head)
        cause = self.flight.take(self._frame(frame, slot, session, now_ns))
        if cause is not Cause.USED:
            self._slots[frame.head].append(slot)

    def _frame(self, frame: SentFrame, slot: int, session: _Session, now_ns: int) -> Frame:
        sensor = self.rig.sensor(frame.head)
        status = {
            "whole": FrameStatus.COMPLETE,
            "half": FrameStatus.INCOMPLETE,
            "corrupt": FrameStatus.CORRUPT,
        }[frame.integrity]
        is_complete = status is FrameStatus.COMPLETE
        latch = session.latch
        return Frame(
            head=frame.head,
            slot=slot,
            status=status,
            frame_id=frame.counter,
            counter=frame.counter if is_complete else None,
            width_px=sensor.width_px,
            height_px=sensor.height_px,
            pixel_format="Mono16",
            device_ns=frame.device_ns if is_complete else None,
            device_clock_ns=None if latch is None else latch[0],
            device_clock_mono_ns=None if latch is None else latch[1],
            latch_sigma_ns=None if latch is None else LATCH_SIGMA_NS,
            mono_ns=now_ns,
            exposure_time_us=EXPOSURE_NS / 1000,
            temperature_c=None,
        )

    # What the service does

    def _fire(self, order: Order) -> None:
        """Order a pulse and report its outcome to the flight; see `daemon.onboard.capture`."""
        self._ordered_ns[order.number] = order.mono_ns
        try:
            if order.delays_ns != self._programmed:
                self.trigger.program(order.delays_ns)
                self._programmed = order.delays_ns
            pulse = self.trigger.fire(order.number)
        except DeviceError as error:
            self._programmed = {}
            self.events["not fired"] += 1
            self.flight.not_fired(order.number, str(error))
        else:
            self.flight.fired(
                FiredPulse(
                    number=order.number,
                    mono_ns=pulse.mono_ns,
                    sigma_ns=pulse.sigma_ns,
                    count=pulse.count,
                    delays_ns=order.delays_ns,
                    strobe_delay_ns=order.strobe_delay_ns,
                )
            )
            self._answered.add(order.number)

    def _truth(self, exposure: int) -> PulseTruth | None:
        """The truth of a pulse that was given; None for a frame without a pulse."""
        if exposure not in self.truth and exposure in self.clockwork.pulses:
            number = self.clockwork.pulses[exposure]
            self.truth[exposure] = PulseTruth(number, self._ordered_ns[number])
        return self.truth.get(exposure)

    def _tick(self, now_ns: int) -> None:
        for name, session in self._sessions.items():
            self._maintain_head(self.clockwork.heads[name], session, now_ns)
        self._maintain_receiver(now_ns)
        if now_ns >= self._next_probe_ns:
            self._next_probe_ns = now_ns + NS_PER_S
            self._requested_ns, self._probe_bytes = now_ns, b""
            self.clockwork.poll_probes([PROBE_C] * len(self.rig.probes), now_ns)
        flight = self.flight
        actions = flight.advance(now_ns)
        for due in actions.store:
            number, slots = due.capture.number, dict(due.slots)
            self._captures[number] = due.capture
            self._stored_pixels[number] = {h: self._pixels[h, s] for h, s in slots.items()}
            self.timeline.at(now_ns + DISK_NS, functools.partial(self._stored, number, slots))
        if actions.seal is not None:
            self._sealed(actions.seal, now_ns)

    def _stored(self, number: int, slots: Mapping[str, int], now_ns: int) -> None:
        frames = tuple(
            replace(record, file=f"{record.sensor}.tif", sha256="0" * 64)
            for record in self._captures.pop(number).frames
        )
        self.flight.stored(number, frames)
        for head, slot in slots.items():
            self._slots[head].append(slot)

    def _sealed(self, exposure: Exposure, now_ns: int) -> None:
        flight = self.flight
        flight.sealed(exposure.number)
        imbalances = flight.ledger.imbalances()
        self.score.imbalances += len(imbalances)
        for imbalance in imbalances:
            self.score.add_example(imbalance)
        self.records.append(exposure)
        self.open_s.append((now_ns - self._ordered_ns[exposure.number]) / NS_PER_S)

    def _maintain_head(self, head: DiscreteEventHead, session: _Session, now_ns: int) -> None:
        """What the driver of a head does between frames; see
        `drivers.cameras.aravis.aravis_head`."""
        is_responding = head.is_responding(now_ns)
        if not session.is_open:
            if is_responding and now_ns >= session.next_try_ns:
                self._open_head(head, session)
            return
        if not is_responding:
            session.suspected_ns = session.suspected_ns or now_ns
            if now_ns - session.suspected_ns > SUSPICION_NS:
                self._lose_head(head, session, now_ns)
            return
        session.suspected_ns = None
        if not head.is_acquiring:
            self._lose_head(head, session, now_ns)
        elif now_ns - session.latched_ns >= LATCH_NS:
            self._latch(head, session, now_ns)

    def _open_head(self, head: DiscreteEventHead, session: _Session) -> None:
        if not head.is_responding(self.clock.now_ns):
            return
        head.begin()
        session.is_open, session.suspected_ns = True, None
        session.pause.reset()
        self._latch(head, session, self.clock.now_ns)
        self.flight.absent_heads.discard(head.name)
        self.events["opened"] += 1

    def _lose_head(self, head: DiscreteEventHead, session: _Session, now_ns: int) -> None:
        session.is_open = False
        session.next_try_ns = now_ns + round(session.pause.next_s() * NS_PER_S)
        self.flight.absent_heads.add(head.name)
        self.events["lost"] += 1

    def _latch(self, head: DiscreteEventHead, session: _Session, now_ns: int) -> None:
        error_ns = self._rng.randrange(-LATCH_SIGMA_NS, LATCH_SIGMA_NS)
        session.latch = (head.clock_ns(now_ns), now_ns + error_ns)
        session.latched_ns = now_ns

    def _maintain_receiver(self, now_ns: int) -> None:
        """A port that goes away is opened again; what was half received is forgotten."""
        connected = self.clockwork.receiver.channel.is_connected(now_ns)
        if self._receiver_is_open and not connected:
            self._receiver_is_open = False
        elif not self._receiver_is_open and connected:
            self._receiver_back_ns = self._receiver_back_ns or now_ns + REOPENED_SERIAL_NS
            if now_ns >= self._receiver_back_ns:
                self._receiver_is_open, self._receiver_back_ns = True, 0
                self._decoder.reset()


def configuration(rig: Rig, exposures: int) -> Configuration:
    """A service configuration for this rig, flown by distance."""
    content = {
        "mission": {"root": "missions", "rig": rig.name, "simulated": True},
        "trigger": {
            "driver": "pulse-bus",
            "port": 1,
            "mode": "distance",
            "distance_m": 85.0,
            "count": exposures,
        },
        "navigator": [{"name": "receiver", "driver": "ublox", "port": "none"}],
        "head": [
            {
                "sensor": sensor.name,
                "driver": "aravis",
                "address": f"127.0.0.{number}",
                "exposure_time_us": EXPOSURE_NS / 1000,
            }
            for number, sensor in enumerate(rig.sensors, start=2)
        ],
    }
    return from_mapping(content, Path("service.toml"))[0]

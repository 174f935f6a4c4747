"""An autopilot on MAVLink, on a serial line, UDP or TCP, and the port for other MAVLink traffic.

What its bytes mean is in `drivers.receivers.mavlink.decoder`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, Final

from drivers.base.settings import Setting
from drivers.contract import ClockReading
from drivers.receivers.mavlink.decoder import MavlinkDecoder, Timesync
from drivers.receivers.mavlink.library import dialect
from drivers.receivers.streaming_navigator import StreamingNavigator
from drivers.timescales.clock import Clock
from drivers.transport.serial_device import (
    LineLostError,
    PortOpener,
    Sample,
    SerialLine,
    open_serial_port,
)

SECOND_NS: Final = 1_000_000_000
COMPANION: Final = 191
"""MAV_COMP_ID_ONBOARD_COMPUTER: component ID of this program on the autopilot's bus."""
REQUEST_INTERVAL_NS: Final = 5 * SECOND_NS
ANSWER_TIMEOUT_NS: Final = SECOND_NS
"""A later answer to TIMESYNC is inaccurate, and may be of an autopilot that has restarted."""
SET_MESSAGE_INTERVAL: Final = 511
AUTOPILOTS: Final = {3: "ArduPilot", 12: "PX4"}

TimesyncListener = Callable[[Timesync], None]


class MavlinkNavigator(StreamingNavigator):
    """An autopilot that speaks MAVLink 1 or 2.

    Yields a NavSample for every GLOBAL_POSITION_INT, an EventMark for every CAMERA_TRIGGER, and a
    ClockReading for every answered TIMESYNC request. It announces itself by a heartbeat once
    a second, as an onboard computer, and requests required messages that do
    not come. It commands nothing else.

    Source: MAVLink common message set.
    """

    kind: ClassVar = "navigator"
    what = "autopilot"
    protocol = "MAVLink"
    required = ("GLOBAL_POSITION_INT",)
    enable_hint = "switch it on for this port, or let this computer ask for it (request = true)"

    port = Setting(
        "",
        required=True,
        help="serial port, tcp://host:port, udpin://host:port (listens) or udpout://host:port",
    )
    system = Setting(
        0, minimum=0, maximum=255, help="system ID of the autopilot; 0: the first that is received"
    )
    request = Setting(True, help="ask the autopilot for messages that do not come")
    position_hz = Setting(10.0, minimum=0.1, maximum=400, help="rate of GLOBAL_POSITION_INT")
    attitude_hz = Setting(
        50.0, minimum=0.1, maximum=1000, help="rate of ATTITUDE_QUATERNION or ATTITUDE"
    )
    imu_hz = Setting(0.0, minimum=0, maximum=1000, help="rate of HIGHRES_IMU; 0: not asked for")
    timesync_hz = Setting(
        1.0, minimum=0, maximum=20, help="how often its clock is asked for (TIMESYNC); 0: never"
    )
    mark_accuracy_ns = Setting(
        1_000_000, minimum=1, maximum=1_000_000_000, help="accuracy of CAMERA_TRIGGER's time"
    )
    undulation_m = Setting(
        0.0,
        minimum=-200,
        maximum=200,
        help="geoid above ellipsoid, m, for autopilots that send no ellipsoidal height; "
        "if neither is known, heights are absent",
    )

    decoder: MavlinkDecoder

    def __init__(
        self,
        name: str,
        settings: Mapping[str, object],
        *,
        clock: Clock | None = None,
        open_port: PortOpener = open_serial_port,
    ) -> None:
        super().__init__(name, settings, clock=clock, open_port=open_port)
        self._writing = threading.Lock()
        self._talking: SerialLine | None = None
        self._sequence = 0
        self._heartbeat_ns = 0
        self._ask_ns = 0
        self._seen_at_request: dict[str, int] = {}
        self._steps_reported = 0
        self._timesync_ns = 0
        self._requested_at_ns: set[int] = set()
        self._timesync_listener: TimesyncListener | None = None
        self.counters.update(requests=0, refusals=0, timesyncs=0)

    def new_decoder(self) -> MavlinkDecoder:
        return MavlinkDecoder(
            self.name,
            system=self.system,
            mark_accuracy_ns=self.mark_accuracy_ns,
            undulation_m=self.undulation_m if "undulation_m" in self.given else None,
        )

    # The port for TIMESYNC

    def subscribe_timesync(self, callback: TimesyncListener | None) -> None:
        """Pass every TIMESYNC of the autopilot to a listener.

        Args:
            callback: called from the thread that runs the device, returns quickly; None ends the
                subscription.
        """
        self._timesync_listener = callback

    def send_timesync(self, *, tc1_ns: int, ts1_ns: int) -> bool:
        """Send a TIMESYNC; from any thread.

        Args:
            tc1_ns: 0 in a request, our own time in an answer, ns.
            ts1_ns: our own time in a request, the requester's `ts1_ns` in an answer, ns.

        Returns:
            False if the line is not open, just lost, or the autopilot is not known yet.

        Source: MAVLink, time synchronization protocol, TIMESYNC (111).
        """
        line = self._talking
        if line is None or not self.decoder.system:
            return False
        message = dialect().MAVLink_timesync_message(tc1_ns, ts1_ns)
        try:
            self._send_message(line, message)
        except LineLostError:
            return False
        return True

    # The device

    def identify(self, line: SerialLine) -> Mapping[str, str]:
        found = super().identify(line)
        number = self.decoder.autopilot
        kind = "unknown" if number is None else AUTOPILOTS.get(number, f"kind {number}")
        return {"autopilot": kind, "system": str(self.decoder.system), **found}

    def is_identified(self) -> bool:
        return self.decoder.autopilot is not None

    def connected(self) -> None:
        super().connected()
        self._heartbeat_ns = self._ask_ns = self._timesync_ns = self.clock.mono_ns()
        self._seen_at_request = {}
        self._requested_at_ns = set()

    def step(self, line: SerialLine) -> Iterable[Sample]:
        self._talking = line
        self._run_periodic_tasks(line)
        samples = [*super().step(line)]
        self._report_steps()
        while self.decoder.timesyncs:
            timesync = self.decoder.timesyncs.popleft()
            samples += self._reading(timesync)
            if self._timesync_listener is not None:
                self._timesync_listener(timesync)
        while self.decoder.refusals:
            self._on_refusal(*self.decoder.refusals.popleft())
        return samples

    def _report_steps(self) -> None:
        clock = self.decoder.clock
        if clock.steps == self._steps_reported:
            return
        self._steps_reported = clock.steps
        what = (
            "started again"
            if clock.last_step_ns is None
            else f"set its UTC by {clock.last_step_ns * 1e-9:+.3f} s against its own clock"
        )
        self.emitter.emit_throttled(
            "receiver-stepped",
            f"The autopilot {self.name} {what} ({clock.steps} so far). Its times are good to "
            f"{clock.sigma_ns(clock.last_boot_ns) * 1e-6:.1f} ms now, and better after some "
            "seconds. If it happens again: check its power and its GPS receiver.",
        )

    def _reading(self, timesync: Timesync) -> list[ClockReading]:
        """The autopilot's clock, where this is the answer to what we asked; it is used once."""
        round_trip_ns = timesync.mono_ns - timesync.ts1_ns
        if timesync.tc1_ns <= 0 or timesync.ts1_ns not in self._requested_at_ns:
            return []
        self._requested_at_ns.discard(timesync.ts1_ns)
        if not 0 <= round_trip_ns <= ANSWER_TIMEOUT_NS:
            return []
        self.counters["timesyncs"] += 1
        half_ns = round_trip_ns // 2
        return [ClockReading(self.name, timesync.tc1_ns, timesync.ts1_ns + half_ns, half_ns + 1)]

    def close(self) -> None:
        self._talking = None
        super().close()

    def _run_periodic_tasks(self, line: SerialLine) -> None:
        """Heartbeat, TIMESYNC and requests, when they are due."""
        now_ns = self.clock.mono_ns()
        if now_ns >= self._heartbeat_ns:
            self._heartbeat_ns = now_ns + SECOND_NS
            here = dialect()
            self._send_message(
                line,
                here.MAVLink_heartbeat_message(
                    here.MAV_TYPE_ONBOARD_CONTROLLER,
                    here.MAV_AUTOPILOT_INVALID,
                    0,
                    0,
                    here.MAV_STATE_ACTIVE,
                    3,
                ),
            )
        if self.timesync_hz and self.decoder.system and now_ns >= self._timesync_ns:
            self._timesync_ns = now_ns + round(SECOND_NS / self.timesync_hz)
            self._requested_at_ns = {
                at for at in self._requested_at_ns if now_ns - at < ANSWER_TIMEOUT_NS
            }
            requested_ns = self.clock.mono_ns()
            self._requested_at_ns.add(requested_ns)
            self._send_message(line, dialect().MAVLink_timesync_message(0, requested_ns))
        if self.request and self.decoder.system and now_ns >= self._ask_ns:
            self._ask_ns = now_ns + REQUEST_INTERVAL_NS
            self._request_missing_messages(line)

    def _request_missing_messages(self, line: SerialLine) -> None:
        wanted = {
            "SYSTEM_TIME": 1.0,
            "GPS_RAW_INT": 1.0,
            "GLOBAL_POSITION_INT": self.position_hz,
            "ATTITUDE_QUATERNION": self.attitude_hz,
            "HIGHRES_IMU": self.imu_hz,
        }
        here = dialect()
        quaternions = self.decoder.seen["ATTITUDE_QUATERNION"]
        if self._seen_at_request.get("ATTITUDE_QUATERNION") == quaternions:
            wanted["ATTITUDE"] = self.attitude_hz
            if self.decoder.seen["ATTITUDE"] > self._seen_at_request.get("ATTITUDE", 0):
                del wanted["ATTITUDE_QUATERNION"]
        for name, hertz in wanted.items():
            seen = self.decoder.seen[name]
            # Half of what is wanted is enough: a line that is full would not carry more.
            enough = hertz * REQUEST_INTERVAL_NS / SECOND_NS / 2
            before = self._seen_at_request.get(name)
            self._seen_at_request[name] = seen
            if not hertz or (before is not None and seen - before >= enough):
                continue
            self.counters["requests"] += 1
            self._send_message(
                line,
                here.MAVLink_command_long_message(
                    self.decoder.system,
                    self.decoder.component,
                    SET_MESSAGE_INTERVAL,
                    0,
                    getattr(here, f"MAVLINK_MSG_ID_{name}"),
                    1e6 / hertz,
                    0,
                    0,
                    0,
                    0,
                    0,
                ),
            )

    def _on_refusal(self, command: int, result: int) -> None:
        if command != SET_MESSAGE_INTERVAL:
            return
        self.counters["refusals"] += 1
        self.emitter.emit_throttled(
            "refused",
            f"The autopilot {self.name} refuses to send a message it was asked for (result "
            f"{result}). Switch GLOBAL_POSITION_INT, ATTITUDE_QUATERNION, GPS_RAW_INT and "
            "SYSTEM_TIME on there for this port.",
        )

    def _send_message(self, line: SerialLine, message: Any) -> None:
        """Pack and send as a companion of the autopilot's own system."""
        with self._writing:
            packer = dialect().MAVLink(None, self.decoder.system or self.system or 1, COMPANION)
            packer.seq = self._sequence
            self._sequence = (self._sequence + 1) % 256
            line.write(bytes(message.pack(packer)))

"""An emulated MAVLink autopilot: streams, camera triggers, TIMESYNC, parameters, commands.

Its messages are encoded in `mavlink_messages`. It flies as `state` states and commands
nothing.

Source: MAVLink common message set; guides on time synchronisation, parameters and message rates.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from scipy.spatial.transform import Rotation

from sim_hw.devices.device_loop import DeviceLine, LineDevice
from sim_hw.devices.pseudo_terminal import PseudoTerminal
from sim_hw.faults.catalogue import MARK, NAVIGATION
from sim_hw.receivers.emulated_receiver import BOOT_NS, ReceiverAccuracy, ReceiverState
from sim_hw.receivers.mavlink_messages import (
    MavlinkStreamParser,
    ReceivedMessage,
    by_number,
    message,
    messages_in,
)
from sim_hw.receivers.nmea_sentences import GEOID_UNDULATION_M, course_deg, longitude_deg, speed_mps
from sim_hw.receivers.utc_jitter import UtcErrors, UtcJitter
from sim_hw.world.world_clock import (
    LEAP_SECONDS,
    NS_PER_S,
    FreeRunningClock,
    WorldClock,
    unix_ns_from_gps_ns,
)

FIXED_WING, PX4, ACTIVE = 1, 12, 4
ARMED_AND_CUSTOM_MODE = 0x80 | 0x01
AUTOPILOT_COMPONENT = 1
FIX_RTK_FIXED = 6
SATELLITES = 17
GRAVITY_MPS2 = 9.80665
RATE_STEP_NS = 5_000_000

SET_MESSAGE_INTERVAL, GET_MESSAGE_INTERVAL, REQUEST_MESSAGE = 511, 510, 512
ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3
CAPABILITY_MAVLINK2_COMMAND_INT_FLOAT = 0x2000 | 0x8 | 0x2
DEFAULT_HZ = {
    "HEARTBEAT": 1.0,
    "SYSTEM_TIME": 1.0,
    "GPS_RAW_INT": 5.0,
    "GLOBAL_POSITION_INT": 5.0,
    "ATTITUDE_QUATERNION": 10.0,
    "HIGHRES_IMU": 0.0,
}
ANGLES_HZ = {
    "ATTITUDE" if name == "ATTITUDE_QUATERNION" else name: hertz
    for name, hertz in DEFAULT_HZ.items()
}
STREAMS = {
    0: (
        "SYSTEM_TIME",
        "GPS_RAW_INT",
        "GLOBAL_POSITION_INT",
        "ATTITUDE_QUATERNION",
        "ATTITUDE",
        "HIGHRES_IMU",
    ),
    1: ("HIGHRES_IMU", "GPS_RAW_INT"),
    2: ("SYSTEM_TIME", "GPS_RAW_INT"),
    6: ("GLOBAL_POSITION_INT",),
    10: ("ATTITUDE_QUATERNION", "ATTITUDE"),
}
"""By MAV_DATA_STREAM; 0 is all."""
TRIGGER_LATENCY_NS = 4_000_000
SYSTEM_ID = 1
MIN_PERIOD_NS = 1_000_000
REAL32 = 9
"""MAV_PARAM_TYPE of the parameters here."""


class MavlinkAutopilot(LineDevice):
    """The autopilot, from `start()` to `close()`; over UDP the host listens at `port`.

    Its own clock begins `boot_ns` before the world's and runs `drift_ppm` fast. Stamps of
    CAMERA_TRIGGER are of that clock, as PX4's are, or of UTC with `triggers_in_utc`. `mark` is the
    strobe at its camera feedback input; CAMERA_TRIGGER reports every rising edge. `utc_jitter`
    is that of SYSTEM_TIME and of stamps in UTC; with `sends_angles` attitude comes as ATTITUDE, and
    ATTITUDE_QUATERNION is denied.
    """

    def __init__(
        self,
        clock: WorldClock,
        state: Callable[[int], ReceiverState],
        *,
        leap_seconds: int = LEAP_SECONDS,
        accuracy: ReceiverAccuracy = ReceiverAccuracy(),  # noqa: B008 - frozen
        boot_ns: int = 754 * NS_PER_S,
        drift_ppm: float = 3.0,
        triggers_in_utc: bool = False,
        utc_jitter: UtcJitter | None = None,
        sends_angles: bool = False,
        first_edge_count: int = 0,
        line: DeviceLine | None = None,
    ) -> None:
        super().__init__("mavlink-autopilot", line or PseudoTerminal())
        self._clock = clock
        self._state = state
        self._leap_seconds = leap_seconds
        self._accuracy = accuracy
        self._device_clock = FreeRunningClock(boot_ns, drift_ppm)
        self._triggers_in_utc = triggers_in_utc
        self.utc = UtcErrors(utc_jitter)
        self._default_hz = ANGLES_HZ if sends_angles else DEFAULT_HZ
        self._listener = MavlinkStreamParser()
        self._sequence = 0
        self._lock = threading.Lock()
        self._edges: list[tuple[int, int]] = []
        self._edge_count = first_edge_count
        self.parameters: dict[str, float] = {
            "TRIG_MODE": 4.0,
            "TRIG_INTERFACE": 1.0,
            "SYS_AUTOSTART": 2100.0,
        }
        self._period_ns = _periods(self._default_hz)
        self._next_ns = dict.fromkeys(self._default_hz, clock.mono_ns_at_start)
        self._height_at_start_m: float | None = None

    def mark(self, gps_ns: int) -> None:
        """The rising edge of a strobe at that GPS time; from any thread, also before it happens."""
        with self._lock:
            self._edges.append((gps_ns, self._edge_count))
            self._edges.sort()
            self._edge_count += 1

    def statistics(self) -> Mapping[str, int]:
        names = ("marks", "commands", "timesyncs", "parameters_sent", "messages_received")
        return {**super().statistics(), **{name: self.counts[name] for name in names}}

    def boot_ns(self, gps_ns: int) -> int:
        """The autopilot's own clock at a GPS time."""
        return self._device_clock.device_ns(gps_ns - self._clock.gps_ns_at_start)

    # Faults

    def parts(self, data: bytes) -> list[tuple[str, bytes]]:
        return [
            (MARK if name == "CAMERA_TRIGGER" else NAVIGATION, received)
            for name, received in messages_in(data)
        ]

    def restart_count(self) -> None:
        with self._lock:
            self._edge_count = 0

    def restart(self) -> None:
        """Its clock counts from the start, which is now; rates are those of its own."""
        now_ns = time.monotonic_ns()
        with self._lock:
            self._edge_count = 0
            self._edges.clear()
        elapsed_ns = self._clock.gps_ns(now_ns) - self._clock.gps_ns_at_start
        self._device_clock = FreeRunningClock(
            self._device_clock.offset_ns - self._device_clock.device_ns(elapsed_ns),
            self._device_clock.drift_ppm,
        )
        self._period_ns = _periods(self._default_hz)
        self._next_ns = dict.fromkeys(self._default_hz, now_ns + BOOT_NS)

    # Unsolicited messages

    def due_mono_ns(self) -> int:
        due = [self._next_ns[name] for name, period_ns in self._period_ns.items() if period_ns]
        with self._lock:
            if self._edges:
                due.append(self._clock.mono_ns(self._edges[0][0]) + TRIGGER_LATENCY_NS)
        return min(due, default=time.monotonic_ns() + NS_PER_S)

    def emit_due(self) -> bytes:
        now_ns = time.monotonic_ns()
        return self.messages_until(now_ns)

    def messages_until(self, mono_ns: int) -> bytes:
        """Everything due at a moment of the host's clock."""
        gps_ns = self._clock.gps_ns(mono_ns)
        received = b""
        while (edge := self._take_edge(mono_ns)) is not None:
            self.counts["marks"] += 1
            received += self._trigger(*edge)
        for name, period_ns in self._period_ns.items():
            if period_ns and self._next_ns[name] <= mono_ns:
                received += self._stream(name, gps_ns)
                behind = (mono_ns - self._next_ns[name]) // period_ns
                self._next_ns[name] += (behind + 1) * period_ns
        return received

    def _take_edge(self, mono_ns: int) -> tuple[int, int] | None:
        with self._lock:
            if not self._edges:
                return None
            if self._clock.mono_ns(self._edges[0][0]) + TRIGGER_LATENCY_NS > mono_ns:
                return None
            return self._edges.pop(0)

    def _pack_message(self, name: str, **values: Any) -> bytes:
        self._sequence += 1
        return message(name, self._sequence, SYSTEM_ID, AUTOPILOT_COMPONENT, **values)

    def _trigger(self, gps_ns: int, number: int) -> bytes:
        if self._triggers_in_utc:
            stamp_ns = unix_ns_from_gps_ns(gps_ns, self._leap_seconds)
            stamp_ns += self.utc.error_ns(self.boot_ns(gps_ns))
        else:
            stamp_ns = self.boot_ns(gps_ns)
        return self._pack_message("CAMERA_TRIGGER", time_usec=stamp_ns // 1000, seq=number)

    def _stream(self, name: str, gps_ns: int) -> bytes:
        boot_ns = self.boot_ns(gps_ns)
        if name == "HEARTBEAT":
            return self._pack_message(
                name,
                type=FIXED_WING,
                autopilot=PX4,
                base_mode=ARMED_AND_CUSTOM_MODE,
                system_status=ACTIVE,
                mavlink_version=3,
            )
        if name == "SYSTEM_TIME":
            unix_ns = unix_ns_from_gps_ns(gps_ns, self._leap_seconds)
            unix_ns += self.utc.error_ns(boot_ns)
            return self._pack_message(
                name, time_unix_usec=unix_ns // 1000, time_boot_ms=boot_ns // 1_000_000
            )
        state = self._state(gps_ns)
        if name == "GPS_RAW_INT":
            return self._gps(state, boot_ns)
        if name == "GLOBAL_POSITION_INT":
            return self._position(state, boot_ns)
        rates = self._body_rates(gps_ns)
        if name == "ATTITUDE":
            degrees = (state.roll_deg, state.pitch_deg, state.heading_deg)
            roll, pitch, yaw = (math.remainder(math.radians(angle), math.tau) for angle in degrees)
            spins = dict(zip(("rollspeed", "pitchspeed", "yawspeed"), rates, strict=True))
            return self._pack_message(
                name, time_boot_ms=boot_ns // 1_000_000, roll=roll, pitch=pitch, yaw=yaw, **spins
            )
        if name == "ATTITUDE_QUATERNION":
            q = attitude(state).as_quat(canonical=True, scalar_first=True)
            values = dict(zip(("q1", "q2", "q3", "q4"), q.tolist(), strict=True))
            spins = dict(zip(("rollspeed", "pitchspeed", "yawspeed"), rates, strict=True))
            return self._pack_message(name, time_boot_ms=boot_ns // 1_000_000, **values, **spins)
        return self._imu(state, rates, boot_ns)

    def _gps(self, state: ReceiverState, boot_ns: int) -> bytes:
        accuracy = self._accuracy
        return self._pack_message(
            "GPS_RAW_INT",
            time_usec=boot_ns // 1000,
            fix_type=FIX_RTK_FIXED,
            lat=round(state.latitude_deg * 1e7),
            lon=round(longitude_deg(state.longitude_deg) * 1e7),
            alt=round((state.height_m - GEOID_UNDULATION_M) * 1e3),
            eph=80,
            epv=90,
            vel=round(speed_mps(state) * 100),
            cog=round(course_deg(state) * 100) % 36_000,
            satellites_visible=SATELLITES,
            alt_ellipsoid=round(state.height_m * 1e3),
            h_acc=round(accuracy.horizontal_m * 1e3),
            v_acc=round(accuracy.vertical_m * 1e3),
            vel_acc=round(accuracy.speed_mps * 1e3),
            hdg_acc=round(accuracy.heading_deg * 1e5),
            yaw=0,
        )

    def _position(self, state: ReceiverState, boot_ns: int) -> bytes:
        if self._height_at_start_m is None:
            self._height_at_start_m = state.height_m
        north, east, down = state.velocity_ned_mps
        return self._pack_message(
            "GLOBAL_POSITION_INT",
            time_boot_ms=boot_ns // 1_000_000,
            lat=round(state.latitude_deg * 1e7),
            lon=round(longitude_deg(state.longitude_deg) * 1e7),
            alt=round((state.height_m - GEOID_UNDULATION_M) * 1e3),
            relative_alt=round((state.height_m - self._height_at_start_m) * 1e3),
            vx=round(north * 100),
            vy=round(east * 100),
            vz=round(down * 100),
            hdg=round(state.heading_deg % 360.0 * 100) % 36_000,
        )

    def _imu(self, state: ReceiverState, rates: tuple[float, float, float], boot_ns: int) -> bytes:
        """Of level flight without acceleration: gravity as the leaning body feels it."""
        roll, pitch = math.radians(state.roll_deg), math.radians(state.pitch_deg)
        all_of_accelerations_rates_and_temperature = 0x103F
        return self._pack_message(
            "HIGHRES_IMU",
            time_usec=boot_ns // 1000,
            xacc=GRAVITY_MPS2 * math.sin(pitch),
            yacc=-GRAVITY_MPS2 * math.sin(roll) * math.cos(pitch),
            zacc=-GRAVITY_MPS2 * math.cos(roll) * math.cos(pitch),
            xgyro=rates[0],
            ygyro=rates[1],
            zgyro=rates[2],
            temperature=31.5,
            fields_updated=all_of_accelerations_rates_and_temperature,
        )

    def _body_rates(self, gps_ns: int) -> tuple[float, float, float]:
        """rad/s, from what the attitude is shortly before and after."""
        before, after = self._state(gps_ns - RATE_STEP_NS), self._state(gps_ns + RATE_STEP_NS)
        turned = (attitude(before).inv() * attitude(after)).as_rotvec()
        x, y, z = (turned / (2 * RATE_STEP_NS * 1e-9)).tolist()
        return x, y, z

    # What it answers

    def on_received(self, data: bytes) -> bytes:
        now_ns = time.monotonic_ns()
        return b"".join(self.answer(received, now_ns) for received in self._listener.feed(data))

    def answer(self, received: ReceivedMessage, mono_ns: int) -> bytes:
        """The answer to one message received at that host time; may be empty."""
        self.counts["messages_received"] += 1
        values = received.values
        if received.name == "TIMESYNC":
            if values["tc1"] != 0:
                return b""
            self.counts["timesyncs"] += 1
            own_ns = self.boot_ns(self._clock.gps_ns(mono_ns))
            return self._pack_message("TIMESYNC", tc1=own_ns, ts1=values["ts1"])
        if values.get("target_system", SYSTEM_ID) not in (0, SYSTEM_ID):
            return b""
        if received.name == "COMMAND_LONG":
            self.counts["commands"] += 1
            return self._on_command(received, mono_ns)
        if received.name == "REQUEST_DATA_STREAM":
            hertz = values["req_message_rate"] if values["start_stop"] else 0
            for name in self._default_hz.keys() & set(STREAMS.get(values["req_stream_id"], ())):
                self._set_period(name, round(NS_PER_S / hertz) if hertz else 0, mono_ns)
            return b""
        if received.name == "PARAM_REQUEST_LIST":
            return b"".join(self._parameter(name) for name in self.parameters)
        if received.name in ("PARAM_REQUEST_READ", "PARAM_SET"):
            return self._on_parameter(received)
        return b""

    def _on_parameter(self, received: ReceivedMessage) -> bytes:
        index = received.values.get("param_index", -1)
        if 0 <= index < len(self.parameters):
            name = list(self.parameters)[index]
        else:
            name = received.values["param_id"].rstrip(b"\x00").decode("ascii", "replace")
        if name not in self.parameters:
            return b""
        if received.name == "PARAM_SET" and math.isfinite(received.values["param_value"]):
            self.parameters[name] = received.values["param_value"]
        return self._parameter(name)

    def _parameter(self, name: str) -> bytes:
        self.counts["parameters_sent"] += 1
        return self._pack_message(
            "PARAM_VALUE",
            param_id=name.encode("ascii"),
            param_value=self.parameters[name],
            param_type=REAL32,
            param_count=len(self.parameters),
            param_index=list(self.parameters).index(name),
        )

    def _on_command(self, received: ReceivedMessage, mono_ns: int) -> bytes:
        number, first, second = (received.values[name] for name in ("command", "param1", "param2"))
        named = by_number().get(round(first)) if math.isfinite(first) else None
        name = "" if named is None else named.name
        extra = b""
        if number == SET_MESSAGE_INTERVAL:
            result = (
                DENIED if name not in self._default_hz or not math.isfinite(second) else ACCEPTED
            )
            if result == ACCEPTED:
                default_ns = _periods(self._default_hz)[name]
                period_ns = default_ns if second == 0 else 0 if second < 0 else round(second * 1e3)
                self._set_period(name, period_ns, mono_ns)
        elif number == GET_MESSAGE_INTERVAL:
            result = ACCEPTED if name in self._default_hz else UNSUPPORTED
            if named is not None and result == ACCEPTED:
                period_us = self._period_ns[name] // 1000
                extra = self._pack_message(
                    "MESSAGE_INTERVAL", message_id=named.number, interval_us=period_us or -1
                )
        elif number == REQUEST_MESSAGE and name == "AUTOPILOT_VERSION":
            result, extra = ACCEPTED, self._version()
        elif number == REQUEST_MESSAGE and name in self._default_hz:
            result, extra = ACCEPTED, self._stream(name, self._clock.gps_ns(mono_ns))
        else:
            result = UNSUPPORTED
        acknowledgement = self._pack_message(
            "COMMAND_ACK",
            command=number,
            result=result,
            target_system=received.system,
            target_component=received.component,
        )
        return acknowledgement + extra

    def _version(self) -> bytes:
        return self._pack_message(
            "AUTOPILOT_VERSION",
            capabilities=CAPABILITY_MAVLINK2_COMMAND_INT_FLOAT,
            flight_sw_version=0x010F00FF,
            flight_custom_version=list(b"emulated"),
            uid=0x5359_4E54_4F50_4943,
        )

    def _set_period(self, name: str, period_ns: int, mono_ns: int) -> None:
        self._period_ns[name] = max(period_ns, MIN_PERIOD_NS) if period_ns else 0
        self._next_ns[name] = mono_ns


def _periods(hertz: Mapping[str, float]) -> dict[str, int]:
    return {name: round(NS_PER_S / each) if each else 0 for name, each in hertz.items()}


def attitude(state: ReceiverState) -> Rotation:
    """Body to north, east, down."""
    angles = (state.heading_deg, state.pitch_deg, state.roll_deg)
    return Rotation.from_euler("ZYX", angles, degrees=True)

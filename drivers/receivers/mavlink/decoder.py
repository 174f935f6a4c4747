"""MAVLink messages into records: bytes in, NavSample and EventMark out, no I/O and no clock.

Taking a message apart is pymavlink's; time is in `drivers.receivers.mavlink.boot_clock`.

Source: MAVLink common message set, https://mavlink.io/en/messages/common.html.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from drivers.contract import POSITION_FIXES, EventMark, NavSample
from drivers.receivers.attitude import (
    Quaternion,
    angles_of,
    interpolated_quaternion,
    quaternion_of,
)
from drivers.receivers.mavlink.boot_clock import MS_NS, BootClock
from drivers.receivers.mavlink.library import MavlinkParser
from drivers.receivers.message_decoder import MessageDecoder, Nav

AUTOPILOT_INVALID: Final = 8
"""MAV_AUTOPILOT of whatever is on the bus and is none: cameras, gimbals, ground stations."""
FIXES: Final = {0: "none", 1: "none", 2: "2d"}
"""By GPS_FIX_TYPE; every other one is a fix of position and height."""
GPS_MAX_AGE_MS: Final = 5_000
ATTITUDE_HISTORY_LENGTH: Final = 256
QUATERNION_MAX_AGE_MS: Final = 1_000
"""After so long without ATTITUDE_QUATERNION, ATTITUDE is read."""
ATTITUDE_GAP_MS: Final = 500
"""Between attitudes further apart nothing is interpolated."""
COUNT_BITS: Final = 32
FEEDBACK_COUNT_BITS: Final = 16
OPEN_LOOP: Final = 4
"""CAMERA_FEEDBACK of a command: no pulse of the camera has been seen."""
UNIX_FROM_2000_US: Final = 946_684_800_000_000

Sigmas = tuple[float | None, float | None, float | None]


@dataclass(frozen=True)
class Timesync:
    """A TIMESYNC as it came: a request has `tc1_ns` 0, an answer carries our own `ts1_ns` back."""

    tc1_ns: int
    ts1_ns: int
    mono_ns: int
    system: int
    component: int


class MavlinkDecoder(MessageDecoder):
    """Decodes what an autopilot sends.

    GLOBAL_POSITION_INT becomes a NavSample with the attitude of ATTITUDE_QUATERNION, or of ATTITUDE
    where that does not come, at its instant, fix and accuracy of GPS_RAW_INT; CAMERA_TRIGGER
    becomes an EventMark, and so does CAMERA_FEEDBACK where no CAMERA_TRIGGER comes. SYSTEM_TIME
    ties the autopilot's clock to GPS time. HIGHRES_IMU is checked and counted. Messages of other
    systems on the bus are counted and left alone. Nothing that is fed raises.
    """

    def __init__(
        self,
        receiver: str,
        *,
        system: int = 0,
        mark_accuracy_ns: int = 1_000_000,
        undulation_m: float | None = None,
    ) -> None:
        self._parser = MavlinkParser()
        super().__init__(
            receiver,
            self._parser.framer(),
            ("samples", "samples_without_time", "marks", "marks_far",
             "marks_without_time", "marks_open_loop",
             "messages_of_others", "messages_lost", "clock_steps"),
        )  # fmt: skip
        self.decode_errors = self._parser.errors
        self.clock = BootClock()
        self.system = system
        """The autopilot's number; 0 until its first heartbeat."""
        self._chosen = system
        self.component = 1
        self.autopilot: int | None = None
        self.timesyncs: deque[Timesync] = deque(maxlen=64)
        """Those that came since they were last taken away."""
        self.refusals: deque[tuple[int, int]] = deque(maxlen=64)
        """Likewise, commands that were not accepted: number and result."""
        self._mark_accuracy_ns = mark_accuracy_ns
        self._undulation_m = undulation_m
        self._sequence: int | None = None
        self._gps: tuple[int, Any] | None = None
        self._boot_ms = 0
        self._attitudes: deque[tuple[int, Quaternion]] = deque(maxlen=ATTITUDE_HISTORY_LENGTH)
        self._quaternion_ms: int | None = None
        self._held: tuple[Any, int] | None = None
        self._handlers: Mapping[str, Callable[[Any, int], list[Nav]]] = {
            "GLOBAL_POSITION_INT": self._on_position,
            "ATTITUDE_QUATERNION": self._on_quaternion,
            "ATTITUDE": self._on_angles,
            "HIGHRES_IMU": self._on_imu,
            "GPS_RAW_INT": self._on_gps,
            "CAMERA_TRIGGER": self._on_trigger,
            "CAMERA_FEEDBACK": self._on_feedback,
            "SYSTEM_TIME": self._on_system_time,
            "TIMESYNC": self._on_timesync,
            "HEARTBEAT": lambda message, mono_ns: [],
            "COMMAND_ACK": self._on_ack,
        }

    @property
    def leap_seconds(self) -> int | None:
        """Those in force at the autopilot's UTC, by the table: MAVLink does not send them."""
        return self.clock.leap_seconds

    def reset(self) -> None:
        super().reset()
        self._held = None
        self._sequence = None
        self._attitudes.clear()
        # It may be another autopilot; until a heartbeat shows that, it is taken for the same one.
        self.autopilot = None

    def on_message(self, message: bytes, mono_ns: int) -> list[Nav]:
        parsed = self._parser.parse(message)
        name: str = parsed.get_type()
        if name == "HEARTBEAT" and self._chosen in (0, parsed.get_srcSystem()):
            self._on_heartbeat(parsed)
        if parsed.get_srcSystem() != self.system or parsed.get_srcComponent() != self.component:
            self.counters["messages_of_others"] += 1
            return []
        if self._sequence is not None:
            self.counters["messages_lost"] += (parsed.get_seq() - self._sequence - 1) % 256
        self._sequence = parsed.get_seq()
        handler = self._handlers.get(name)
        if handler is None:
            return []
        decoded = handler(parsed, mono_ns)
        self.seen[name] += 1
        return decoded

    def _on_heartbeat(self, message: Any) -> None:
        if message.autopilot == AUTOPILOT_INVALID:
            return
        if self.autopilot is None:
            self.system, self.component = message.get_srcSystem(), message.get_srcComponent()
        if (message.get_srcSystem(), message.get_srcComponent()) == (self.system, self.component):
            self.autopilot = int(message.autopilot)

    # Navigation

    def _on_gps(self, message: Any, _mono_ns: int) -> list[Nav]:
        self._gps = (self._boot_ms, message)
        self.fix = FIXES.get(message.fix_type, "3d")
        self.satellites = None if message.satellites_visible == 0xFF else message.satellites_visible
        return []

    def _on_imu(self, message: Any, _mono_ns: int) -> list[Nav]:
        accelerations = (message.xacc, message.yacc, message.zacc)
        rates = (message.xgyro, message.ygyro, message.zgyro)
        if not all(math.isfinite(value) for value in (*accelerations, *rates)):
            raise ValueError("a measurement that is no number")
        return []

    def _on_quaternion(self, message: Any, _mono_ns: int) -> list[Nav]:
        q = (message.q1, message.q2, message.q3, message.q4)
        norm = math.hypot(*q)
        if not 0.5 < norm < 2.0:
            raise ValueError("a quaternion that is no rotation")
        w, x, y, z = (value / norm for value in q)
        self._quaternion_ms = message.time_boot_ms
        return self._on_attitude(message.time_boot_ms, (w, x, y, z))

    def _on_angles(self, message: Any, _mono_ns: int) -> list[Nav]:
        angles = (message.roll, message.pitch, message.yaw)
        if not all(math.isfinite(angle) and abs(angle) <= math.tau for angle in angles):
            raise ValueError("angles that are none")
        last_ms = self._quaternion_ms
        if last_ms is not None and 0 <= message.time_boot_ms - last_ms < QUATERNION_MAX_AGE_MS:
            return []
        return self._on_attitude(message.time_boot_ms, quaternion_of(*angles))

    def _on_attitude(self, boot_ms: int, quaternion: Quaternion) -> list[Nav]:
        self._at(boot_ms)
        self._attitudes.append((boot_ms, quaternion))
        if self._held is not None and boot_ms >= self._held[0].time_boot_ms:
            return self._release()
        return []

    def _on_position(self, message: Any, mono_ns: int) -> list[Nav]:
        self._at(message.time_boot_ms)
        decoded = self._release()
        last_ms = self._attitudes[-1][0] if self._attitudes else None
        # Where attitudes come, the one after the position is waited for, and both interpolated.
        if last_ms is not None and 0 < message.time_boot_ms - last_ms < ATTITUDE_GAP_MS:
            self._held = (message, mono_ns)
            return decoded
        return [*decoded, *self._sample(message, mono_ns)]

    def _release(self) -> list[Nav]:
        if self._held is None:
            return []
        (message, mono_ns), self._held = self._held, None
        return self._sample(message, mono_ns)

    def _at(self, boot_ms: int) -> None:
        """The autopilot's clock stands there; far behind what it was, it has restarted."""
        if boot_ms < self._boot_ms - 1000:
            self._attitudes.clear()
            self._quaternion_ms = None
        self._boot_ms = boot_ms

    def _sample(self, message: Any, mono_ns: int) -> list[Nav]:
        latitude, longitude = message.lat * 1e-7, message.lon * 1e-7
        if not (abs(latitude) <= 90 and abs(longitude) <= 180):
            raise ValueError("a position that is none")
        # Time since start is cut to milliseconds: half of one is added on the average.
        boot_ns = message.time_boot_ms * MS_NS + MS_NS // 2
        gps_ns = self.clock.gps_ns(boot_ns)
        if gps_ns is None:
            self.counters["samples_without_time"] += 1
            return []
        self._gps_ns = gps_ns
        fix, satellites, sigmas, undulation_m = self._quality()
        has_position = fix in POSITION_FIXES
        has_height = has_position and fix != "2d" and undulation_m is not None
        horizontal_m, vertical_m, speed_mps = sigmas if has_position else (None, None, None)
        # A time that is off by so much is a place that is off by the way flown meanwhile.
        north, east, down = message.vx * 1e-2, message.vy * 1e-2, message.vz * 1e-2
        time_sigma_s = self.clock.sigma_ns(boot_ns) * 1e-9
        if horizontal_m is not None:
            horizontal_m = math.hypot(horizontal_m, math.hypot(north, east) * time_sigma_s)
        if vertical_m is not None:
            vertical_m = math.hypot(vertical_m, down * time_sigma_s)
        angles = self._angles_at(message.time_boot_ms)
        roll, pitch, heading = angles or (None, None, None)
        self.counters["samples"] += 1
        return [
            NavSample(
                receiver=self.receiver,
                gps_ns=gps_ns,
                mono_ns=mono_ns,
                fix=fix,
                satellites=satellites,
                latitude_deg=latitude if has_position else None,
                longitude_deg=longitude if has_position else None,
                height_m=message.alt * 1e-3 + (undulation_m or 0.0) if has_height else None,
                horizontal_sigma_m=horizontal_m,
                vertical_sigma_m=vertical_m if has_height else None,
                velocity_ned_mps=(north, east, down) if has_position else None,
                speed_sigma_mps=speed_mps,
                roll_rad=roll,
                pitch_rad=pitch,
                heading_rad=heading,
                leap_seconds=self.leap_seconds,
                time_valid=True,
                sigma_source="none" if horizontal_m is None else "receiver",
                leap_source="table",
            )
        ]

    def _quality(self) -> tuple[str, int | None, Sigmas, float | None]:
        """Fix, satellites, sigmas of place, height and speed, and the geoid's height."""
        if self._gps is None:
            return "none", None, (None, None, None), self._undulation_m
        received_ms, gps = self._gps
        # Quirk: extensions are zero where the autopilot does not send them.
        # Upstream: manual: MAVLink, guide, section Message Extensions.
        undulation_m = (
            (gps.alt_ellipsoid - gps.alt) * 1e-3 if gps.alt_ellipsoid else self._undulation_m
        )
        if self._boot_ms - received_ms > GPS_MAX_AGE_MS:
            # Its present accuracy is unknown.
            return "dead-reckoning", None, (None, None, None), undulation_m
        horizontal_m, vertical_m, speed_mps = (
            value * 1e-3 if value else None for value in (gps.h_acc, gps.v_acc, gps.vel_acc)
        )
        satellites = gps.satellites_visible
        count = None if satellites == 0xFF else int(satellites)
        fix = FIXES.get(gps.fix_type, "3d")
        return fix, count, (horizontal_m, vertical_m, speed_mps), undulation_m

    def _angles_at(self, boot_ms: int) -> tuple[float, float, float] | None:
        before = next(((t, q) for t, q in reversed(self._attitudes) if t <= boot_ms), None)
        after = next(((t, q) for t, q in self._attitudes if t >= boot_ms), None)
        if before is None or after is None:
            return None
        if after[0] - before[0] > ATTITUDE_GAP_MS:
            return None
        fraction = (boot_ms - before[0]) / max(after[0] - before[0], 1)
        return angles_of(interpolated_quaternion(before[1], after[1], fraction))

    # Time and marks

    def _on_system_time(self, message: Any, _mono_ns: int) -> list[Nav]:
        self._at(message.time_boot_ms)
        self.clock.add_system_time(message.time_unix_usec, message.time_boot_ms)
        self.counters["clock_steps"] = self.clock.steps
        return []

    def _on_timesync(self, message: Any, mono_ns: int) -> list[Nav]:
        self.timesyncs.append(
            Timesync(
                message.tc1,
                message.ts1,
                mono_ns,
                message.get_srcSystem(),
                message.get_srcComponent(),
            )
        )
        return []

    def _on_ack(self, message: Any, _mono_ns: int) -> list[Nav]:
        if message.result:
            self.refusals.append((int(message.command), int(message.result)))
        return []

    def _on_trigger(self, message: Any, mono_ns: int) -> list[Nav]:
        return self._mark(message.time_usec, 0, (int(message.seq), COUNT_BITS), mono_ns)

    def _on_feedback(self, message: Any, mono_ns: int) -> list[Nav]:
        if self.seen["CAMERA_TRIGGER"]:
            return []
        is_utc = message.time_usec >= UNIX_FROM_2000_US
        self.counters["marks_open_loop"] += message.flags == OPEN_LOOP
        return self._mark(
            message.time_usec,
            int(message.cam_idx),
            (int(message.img_idx), FEEDBACK_COUNT_BITS),
            mono_ns,
            # Before the first fix its time is zero; it never counts from the start.
            is_trusted=is_utc and message.flags != OPEN_LOOP,
        )

    def _mark(
        self,
        time_us: int,
        channel: int,
        count: tuple[int, int],
        mono_ns: int,
        *,
        is_trusted: bool = True,
    ) -> list[Nav]:
        """A mark of a time in UTC or since the start; `count` is a number and its bits."""
        known = self.clock.gps_of_us(time_us)
        if known is None or not is_trusted:
            self.counters["marks_without_time"] += 1
            gps_ns, sigma_ns, valid = time_us * 1000, self.clock.utc_sigma_ns, False
        else:
            gps_ns, sigma_ns = known
            valid = self.is_near_navigation(gps_ns)
        self.counters["marks"] += 1
        return [
            EventMark(
                receiver=self.receiver,
                channel=channel,
                gps_ns=gps_ns,
                accuracy_ns=round(math.hypot(self._mark_accuracy_ns, sigma_ns)),
                count=count[0],
                count_bits=count[1],
                time_valid=valid,
                mono_ns=mono_ns,
            )
        ]

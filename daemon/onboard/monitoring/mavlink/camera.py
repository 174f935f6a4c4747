"""The rig as one camera of a vehicle: MAVLink's camera protocol over UDP.

Ground stations and autopilots see a camera that takes pictures and reports each of them once, and
again on request. The index of a picture is the exposure number minus one, so that it is unique in a
mission. Source: the MAVLink camera protocol v2; the dialect is pymavlink's.
"""

from __future__ import annotations

import asyncio
import logging
import math
import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, cast

from daemon.configuration.model import MavlinkCameraSection
from daemon.onboard.monitoring.access.command_gateway import (
    AnswerTimeoutError,
    CommandGateway,
    NotPermittedError,
)
from daemon.onboard.monitoring.access.roles import Principal, Role
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.mavlink.requests import (
    ACTIONS,
    BY_IDENTITY,
    REQUESTS,
    as_integer,
    service_command,
)
from daemon.onboard.monitoring.mavlink.senders import Address, Senders
from daemon.onboard.monitoring.mavlink.signatures import Signatures, read_key
from drivers.base.extras import require
from drivers.receivers.attitude import quaternion_of
from drivers.receivers.mavlink.library import MavlinkParser
from drivers.timescales.leap_seconds import leap_seconds_at
from processing.rig import Rig

HEARTBEAT_S = 1.0
TICK_S = 0.1
SAVE_EVERY_S = 30.0
SAVE_WITHIN_S = 1.0
"""Time limit for saving the last timestamps."""
GPS_EPOCH_UNIX_S = 315_964_800
COORDINATE_UNKNOWN = 2**31 - 1
"""INT32_MAX, as in MAVLink's other messages with a latitude."""
UNKNOWN_ANGLE = (1.0, 0.0, 0.0, 0.0)
VENDOR, FIRMWARE = "Syntopic", 1 << 24
NAME_BYTES = 32
MODE_IMAGE = 0
ROLE: Role = "operator"
"""Role of senders that may command by the configuration."""

_log = logging.getLogger(__name__)


class MavlinkCamera(asyncio.DatagramProtocol):
    """A camera component.

    `counts` are statistics by stable name: messages received, bad bytes, commands refused.
    """

    def __init__(
        self,
        settings: MavlinkCameraSection,
        state: FlightState,
        gateway: CommandGateway,
        rig: Callable[[], Rig | None],
        ground_height_m: Callable[[], float | None] = lambda: None,
        report: Callable[[str], None] = _log.error,
    ) -> None:
        """`rig` returns the rig, `ground_height_m` the height of the ground.

        Both return None before a mission has begun. `report` receives error messages.
        """
        self._settings = settings
        self._state = state
        self._gateway = gateway
        self._rig = rig
        self._ground_height_m = ground_height_m
        self._report = report
        self._dialect = _dialect()
        self._mav = self._dialect.MAVLink(
            None, srcSystem=settings.system_id, srcComponent=settings.component_id
        )
        self._parser = MavlinkParser()
        self._senders = Senders(self._parser)
        self._signatures = self._load_signatures()
        self._saver = ThreadPoolExecutor(1, "mavlink-timestamps")
        self._boot_s = time.monotonic()
        self._fixed: tuple[Address, ...] = ()
        self._sent: set[int] = set()
        self._sent_mission: str | None = None
        self._interval_s = 0.0
        self._task: asyncio.Task[None] | None = None
        self._commands: set[asyncio.Task[None]] = set()
        self._transport: asyncio.DatagramTransport | None = None
        self.counts: dict[str, int] = {}

    async def begin(self) -> None:
        """Open the socket and start the heartbeat. OSError: the address is in use."""
        scheme, _, rest = self._settings.connect.partition(":")
        host, _, port = rest.rpartition(":")
        address = (host, int(port))
        loop = asyncio.get_running_loop()
        if scheme == "udpin":
            await loop.create_datagram_endpoint(lambda: self, local_addr=address)
        else:
            self._fixed = (address,)
            local = "127.0.0.1" if host.startswith("127.") else "0.0.0.0"
            await loop.create_datagram_endpoint(lambda: self, local_addr=(local, 0))
        self._task = asyncio.create_task(self._run())

    def end(self) -> None:
        for task in (self._task, *self._commands):
            if task is not None:
                task.cancel()
        if self._signatures is not None:
            self._saver.submit(self._signatures.save)
        self._saver.shutdown(wait=False)
        if self._transport is not None:
            self._transport.close()

    # Receiving

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.DatagramTransport, transport)

    def error_received(self, exc: Exception) -> None:
        self._count("send_errors")

    def datagram_received(self, data: bytes, addr: Address) -> None:
        """Parse and answer; bad bytes are counted, never raised."""
        now_s = time.monotonic()
        frames, bad_bytes = self._senders.messages(data, addr, now_s)
        self._count("bad_bytes", bad_bytes)
        for frame in frames:
            is_signed = self._signatures is not None and self._signatures.accept(frame)
            try:
                message = self._parser.parse(frame)
            except self._parser.errors:
                self._count("bad_bytes", len(frame))
                continue
            self._count("messages")
            is_peer = self._senders.register(addr, now_s, is_signed=is_signed)
            if message.get_type() == "HEARTBEAT" and not is_peer:
                # One heartbeat per heartbeat, so that every peer detects the camera.
                self._send(self._heartbeat(), addr)
            elif message.get_type() == "COMMAND_LONG" and self._is_for_us(message):
                self._command(message, addr, is_signed=is_signed)

    def _is_for_us(self, message: Any) -> bool:
        return message.target_system in (0, self._settings.system_id) and (
            message.target_component in (0, self._settings.component_id)
        )

    # Commands

    def _command(self, message: Any, address: Address, *, is_signed: bool) -> None:
        number = int(message.command)
        if number in REQUESTS:
            self._request(message, address, REQUESTS[number])
        elif number in ACTIONS:
            self._execute(message, address, ACTIONS[number], is_signed=is_signed)
        else:
            self._acknowledge(message, address, self._dialect.MAV_RESULT_UNSUPPORTED)

    def _request(self, message: Any, address: Address, requested: str | None) -> None:
        """Command 512 and its predecessors: send one message again."""
        if requested is None:
            requested = BY_IDENTITY.get(as_integer(message.param1))
        if requested == "CAMERA_IMAGE_CAPTURED":
            given = message.param1 if message.command == 2002 else message.param2
            index = as_integer(given)
            one = None if index is None else self._state.exposure(index + 1)
            if one is None or not self._is_final(one):
                self._acknowledge(message, address, self._dialect.MAV_RESULT_DENIED)
                return
            self._acknowledge(message, address, self._dialect.MAV_RESULT_ACCEPTED)
            self._send(self._captured(one), address)
            return
        encode = {
            "CAMERA_INFORMATION": self._information,
            "CAMERA_SETTINGS": self._camera_settings,
            "STORAGE_INFORMATION": self._storage,
            "CAMERA_CAPTURE_STATUS": self._capture_status,
        }.get(requested or "")
        if encode is None:
            self._acknowledge(message, address, self._dialect.MAV_RESULT_UNSUPPORTED)
            return
        self._acknowledge(message, address, self._dialect.MAV_RESULT_ACCEPTED)
        self._send(encode(), address)

    def _execute(self, message: Any, address: Address, action: str, *, is_signed: bool) -> None:
        """Execute a command of an authorized sender."""
        if self._settings.commands != "any" and not (
            self._settings.commands == "signed" and is_signed
        ):
            self._count("commands_refused")
            self._acknowledge(message, address, self._dialect.MAV_RESULT_DENIED)
            requested = None if action == "mode" else service_command(action, message)
            self._gateway.refuse(
                action if requested is None else requested[0],
                _principal(message, address, None),
                f"[watch.mavlink] commands is {self._settings.commands!r}"
                + ("" if self._settings.commands == "none" else ", and the signature is not valid"),
            )
            return
        if action == "mode":
            is_image = as_integer(message.param2) == MODE_IMAGE
            result = "ACCEPTED" if is_image else "UNSUPPORTED"
            self._acknowledge(message, address, getattr(self._dialect, f"MAV_RESULT_{result}"))
            if is_image:
                self._send(self._camera_settings(), address)
            return
        requested = service_command(action, message)
        if requested is None:
            self._acknowledge(message, address, self._dialect.MAV_RESULT_DENIED)
            return
        task = asyncio.create_task(self._forward(message, address, *requested))
        self._commands.add(task)
        task.add_done_callback(self._commands.discard)

    async def _forward(
        self, message: Any, address: Address, name: str, arguments: Mapping[str, Any]
    ) -> None:
        await self._save_timestamps()
        try:
            answer = await self._gateway.command(
                name, arguments, _principal(message, address, ROLE)
            )
            done = answer.done
        except (AnswerTimeoutError, NotPermittedError):
            done = False
        result = "ACCEPTED" if done else "TEMPORARILY_REJECTED"
        self._acknowledge(message, address, getattr(self._dialect, f"MAV_RESULT_{result}"))
        if done:
            self._interval_s = float(arguments.get("interval_s", 0.0))
            self._send(self._capture_status(), address)

    def _acknowledge(self, message: Any, address: Address, result: int) -> None:
        self._send(
            self._mav.command_ack_encode(
                int(message.command),
                result,
                target_system=message.get_srcSystem(),
                target_component=message.get_srcComponent(),
            ),
            address,
        )

    # Unrequested messages

    async def _run(self) -> None:
        beat_s, saved_s = -math.inf, time.monotonic()
        while True:
            now_s = time.monotonic()
            if now_s - beat_s >= HEARTBEAT_S:
                beat_s = now_s
                self._broadcast(self._heartbeat())
            if now_s - saved_s >= SAVE_EVERY_S:
                saved_s = now_s
                await self._save_timestamps()
            self._advance_clock()
            self._send_captures()
            await asyncio.sleep(TICK_S)

    def _send_captures(self) -> None:
        mission = self._state.mission_path
        if mission != self._sent_mission:
            self._sent_mission = mission
            self._sent.clear()
        for one in self._state.exposures():
            if one["number"] in self._sent or not self._is_final(one):
                continue
            self._sent.add(one["number"])
            self._broadcast(self._captured(one))
            if self._settings.feedback and one.get("state") != "lost":
                self._broadcast(self._feedback(one))
            self._broadcast(self._capture_status())

    def _is_final(self, one: Mapping[str, Any]) -> bool:
        """Whether its time and position are final, or it is lost."""
        return one.get("state") == "lost" or "mark_gps_ns" in one

    def _broadcast(self, message: Any) -> None:
        for address in {*self._fixed, *self._senders.peers}:
            self._send(message, address)

    def _send(self, message: Any, address: Address) -> None:
        if self._transport is not None and not self._transport.is_closing():
            if self._signatures is not None:
                self._mav.signing.timestamp = self._signatures.next_timestamp()
            self._transport.sendto(bytes(message.pack(self._mav)), address)

    # Messages

    def _boot_ms(self) -> int:
        return round((time.monotonic() - self._boot_s) * 1000) & 0xFFFFFFFF

    def _heartbeat(self) -> Any:
        flying = self._state.phase in ("ready", "armed", "flying")
        status = self._dialect.MAV_STATE_ACTIVE if flying else self._dialect.MAV_STATE_STANDBY
        if self._state.phase == "fault":
            status = self._dialect.MAV_STATE_CRITICAL
        return self._mav.heartbeat_encode(
            self._dialect.MAV_TYPE_CAMERA, self._dialect.MAV_AUTOPILOT_INVALID, 0, 0, status
        )

    def _information(self) -> Any:
        rig = self._rig()
        virtual = rig.virtual_image if rig is not None else None
        width, height = (virtual.width_px, virtual.height_px) if virtual else (0, 0)
        pitch_mm = virtual.pitch_mm if virtual else math.nan
        flags = (
            self._dialect.CAMERA_CAP_FLAGS_CAPTURE_IMAGE
            | self._dialect.CAMERA_CAP_FLAGS_HAS_MODES
            | self._dialect.CAMERA_CAP_FLAGS_HAS_IMAGE_SURVEY_MODE
        )
        return self._mav.camera_information_encode(
            self._boot_ms(),
            _name(VENDOR),
            _name(rig.name if rig is not None else "waiting"),
            FIRMWARE,
            virtual.f_mm if virtual else math.nan,
            width * pitch_mm,
            height * pitch_mm,
            min(width, 65535),
            min(height, 65535),
            0,
            flags,
            0,
            b"",
        )

    def _camera_settings(self) -> Any:
        return self._mav.camera_settings_encode(self._boot_ms(), MODE_IMAGE, math.nan, math.nan)

    def _storage(self) -> Any:
        total_mb, used_mb, free_mb = _disk_mb(self._state.mission_path)
        return self._mav.storage_information_encode(
            self._boot_ms(),
            1,
            1,
            self._dialect.STORAGE_STATUS_READY,
            total_mb,
            used_mb,
            free_mb,
            math.nan,
            math.nan,
            self._dialect.STORAGE_TYPE_HD,
            b"missions",
        )

    def _capture_status(self) -> Any:
        runs = self._state.phase == "flying"
        _, _, free_mb = _disk_mb(self._state.mission_path)
        triggers = (self._state.brief()["status"].get("ledger") or {}).get("triggers", {})
        return self._mav.camera_capture_status_encode(
            self._boot_ms(),
            3 if runs and self._interval_s else 2 if runs else 0,
            0,
            self._interval_s if runs else 0.0,
            0,
            free_mb,
            int(triggers.get("triggers", 0)),
        )

    def _captured(self, one: Mapping[str, Any]) -> Any:
        place = one.get("place") or {}
        latitude, longitude = place.get("latitude_deg"), place.get("longitude_deg")
        height_m, ground_m = place.get("height_m"), self._ground_height_m()
        above_m = None if height_m is None or ground_m is None else height_m - ground_m
        return self._mav.camera_image_captured_encode(
            self._boot_ms(),
            _utc_us(one.get("mark_gps_ns")),
            0,
            _scaled(latitude, 1e7),
            _scaled(longitude, 1e7),
            _scaled(height_m, 1e3),
            _scaled(above_m, 1e3),
            _quaternion(place),
            one["number"] - 1,
            0 if one.get("state") == "lost" else 1,
            f"L0/{one['number']:06d}".encode(),
        )

    def _feedback(self, one: Mapping[str, Any]) -> Any:
        place = one.get("place") or {}
        height_m, ground_m = place.get("height_m"), self._ground_height_m()
        radians = [place.get(f"{name}_rad") for name in _ANGLES]
        angles = [math.nan if angle is None else math.degrees(angle) for angle in radians]
        virtual = rig.virtual_image if (rig := self._rig()) is not None else None
        return self._mav.camera_feedback_encode(
            _utc_us(one.get("mark_gps_ns")),
            self._settings.system_id,
            0,
            (one["number"] - 1) & 0xFFFF,
            _scaled(place.get("latitude_deg"), 1e7),
            _scaled(place.get("longitude_deg"), 1e7),
            math.nan if height_m is None else height_m,
            math.nan if height_m is None or ground_m is None else height_m - ground_m,
            *angles,
            virtual.f_mm if virtual else 0.0,
            0,
            one["number"] & 0xFFFF,
        )

    def _load_signatures(self) -> Signatures | None:
        if self._settings.signing_key is None:
            return None
        signatures = Signatures(read_key(self._settings.signing_key), self._settings.signing_state)
        self._mav.signing.secret_key = signatures.key
        self._mav.signing.sign_outgoing = True
        return signatures

    async def _save_timestamps(self) -> None:
        """Save the timestamps before executing; a slow disk delays a command briefly."""
        if self._signatures is None or self._signatures.is_saved:
            return
        saving = asyncio.get_running_loop().run_in_executor(self._saver, self._signatures.save)
        try:
            await asyncio.wait_for(saving, SAVE_WITHIN_S)
        except (OSError, TimeoutError) as error:
            self._count("timestamps_not_saved")
            reason = str(error) or f"the disk did not answer within {SAVE_WITHIN_S:g} s"
            self._report(
                f"the last timestamps of signed commands cannot be saved at "
                f"{self._settings.signing_state}: {reason}. After a restart a recorded command "
                "could be executed again; check that disk"
            )

    def _advance_clock(self) -> None:
        """Advance the signing clock by GPS time; emulated GPS time is not used."""
        brief = self._state.brief()
        unix_us = _utc_us(brief["status"].get("gps_ns"))
        if self._signatures is not None and not brief["simulated"]:
            self._signatures.advance(unix_us * 1000)

    def _count(self, name: str, by: int = 1) -> None:
        self.counts[name] = self.counts.get(name, 0) + by


_ANGLES = ("roll", "pitch", "heading")


def _principal(message: Any, address: Address, role: Role | None) -> Principal:
    name = f"mavlink {message.get_srcSystem()}/{message.get_srcComponent()}"
    return Principal(name, role, f"udp {address[0]}")


def _name(text: str) -> list[int]:
    return list(text.encode("ascii", "replace")[:NAME_BYTES].ljust(NAME_BYTES, b"\0"))


def _utc_us(gps_ns: object) -> int:
    """GPS time as microseconds of Unix time; 0 if unknown."""
    if not isinstance(gps_ns, str):
        return 0
    instant = int(gps_ns)
    leap_s = leap_seconds_at(instant - leap_seconds_at(instant) * 1_000_000_000)
    return (instant - leap_s * 1_000_000_000) // 1000 + GPS_EPOCH_UNIX_S * 1_000_000


def _scaled(value: float | None, scale: float) -> int:
    """A coordinate as MAVLink's integer; the largest value if unknown."""
    return COORDINATE_UNKNOWN if value is None else round(value * scale)


def _quaternion(place: Mapping[str, Any]) -> tuple[float, ...]:
    """Camera attitude as quaternion w, x, y, z relative to north, east, down."""
    roll, pitch, heading = (place.get(f"{name}_rad") for name in _ANGLES)
    if roll is None or pitch is None or heading is None:
        return UNKNOWN_ANGLE
    return quaternion_of(roll, pitch, heading)


def _disk_mb(path: str | None) -> tuple[float, float, float]:
    """Total, used and available of the mission's disk, MiB."""
    try:
        status = os.statvfs(path or "/")
    except OSError:
        return 0.0, 0.0, 0.0
    unit = status.f_frsize / 2**20
    return status.f_blocks * unit, (status.f_blocks - status.f_bfree) * unit, status.f_bavail * unit


def _dialect() -> Any:
    require("mavlink")
    from pymavlink.dialects.v20 import ardupilotmega

    return ardupilotmega

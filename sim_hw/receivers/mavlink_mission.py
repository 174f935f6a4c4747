"""An emulated autopilot that flies a mission and executes its camera commands, over UDP.

Its position is given: `sim_hw.world` computes the motion. Missions are text as
ground stations save it ("QGC WPL 110"). Items that command the camera are sent to it when the
waypoint before them is reached, as an autopilot does.

Source: MAVLink mission and camera protocols; the file format of MAVLink missions.
"""

from __future__ import annotations

import math
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sim_hw.receivers.mavlink_messages import MavlinkStreamParser, message

HEADER = "QGC WPL 110"
WAYPOINT = 16
CAMERA_COMMANDS = (206, 2000, 2001)
"""Trigger distance, start and stop of capture."""
AUTOPILOT_COMPONENT, CAMERA_COMPONENT = 1, 100
POSITION_INTERVAL_S = 0.02
METRES_PER_DEGREE = 111_320.0

LatLon = tuple[float, float]
"""Latitude and longitude, degrees."""


@dataclass(frozen=True)
class MissionItem:
    """A line of a mission: a command and its seven parameters."""

    command: int
    parameters: tuple[float, ...]

    @property
    def place(self) -> LatLon:
        return self.parameters[4], self.parameters[5]


def read_mission(text: str) -> list[MissionItem]:
    """The items of a mission file. ValueError: it is none."""
    header, *lines = text.strip().splitlines()
    if header.strip() != HEADER:
        raise ValueError(f"a mission begins with {HEADER!r}, not {header!r}")
    rows = [line.split("\t") for line in lines]
    return [MissionItem(int(row[3]), tuple(float(value) for value in row[4:11])) for row in rows]


class MissionAutopilot:
    """Flies a mission from `start()` to `close()`.

    `reached` are the indices of the waypoints reached, with the host's time; `results` what the
    camera answered to each command, MAV_RESULT.

    Args:
        items: the mission.
        place: where the aircraft is, at a moment of the host's clock.
        camera: host and port of the camera component.
    """

    def __init__(
        self,
        items: Sequence[MissionItem],
        place: Callable[[int], LatLon],
        camera: tuple[str, int],
        *,
        system: int = 1,
    ) -> None:
        self._items = deque(enumerate(items))
        self._place = place
        self._camera = camera
        self._system = system
        self._sequence = 0
        self._before: LatLon | None = None
        self._closing = threading.Event()
        self._listener = MavlinkStreamParser()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._thread = threading.Thread(target=self._fly, name="autopilot", daemon=True)
        self.reached: list[tuple[int, int]] = []
        self.results: list[int] = []

    def start(self) -> None:
        self._before = self._place(time.monotonic_ns())
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join(5.0)
        self._socket.close()

    def _fly(self) -> None:
        while not self._closing.wait(POSITION_INTERVAL_S):
            self._update_position(time.monotonic_ns())
            self._receive()

    def _update_position(self, mono_ns: int) -> None:
        """Go past the waypoint, if it lies behind by now, and do what stands behind it."""
        if not self._items or self._before is None:
            return
        index, item = self._items[0]
        if item.command == WAYPOINT:
            leg = _metres(self._before, item.place)
            away = _metres(item.place, self._place(mono_ns))
            if leg[0] * away[0] + leg[1] * away[1] < 0:
                return
            self._before = item.place
            self.reached.append((index, mono_ns))
            self._send_message("MISSION_ITEM_REACHED", seq=index)
        self._items.popleft()
        while self._items and self._items[0][1].command in CAMERA_COMMANDS:
            _, todo = self._items.popleft()
            self._command(todo)

    def _command(self, item: MissionItem) -> None:
        parameters = {f"param{k}": value for k, value in enumerate(item.parameters, start=1)}
        target = {"target_system": self._system, "target_component": CAMERA_COMPONENT}
        self._send_message("COMMAND_LONG", command=item.command, **target, **parameters)

    def _send_message(self, name: str, **values: float) -> None:
        self._sequence += 1
        data = message(name, self._sequence, self._system, AUTOPILOT_COMPONENT, **values)
        self._socket.sendto(data, self._camera)

    def _receive(self) -> None:
        try:
            while data := self._socket.recv(2048):
                for received in self._listener.feed(data):
                    if received.name == "COMMAND_ACK":
                        self.results.append(int(received.values["result"]))
        except (BlockingIOError, ConnectionRefusedError):
            return


def _metres(start: LatLon, end: LatLon) -> tuple[float, float]:
    """North and east from one place to another nearby."""
    north_m = (end[0] - start[0]) * METRES_PER_DEGREE
    east_m = (end[1] - start[1]) * METRES_PER_DEGREE * math.cos(math.radians(start[0]))
    return north_m, east_m

"""An emulated autopilot flies the missions we write; pymavlink reads its messages."""

from __future__ import annotations

import socket
from typing import Any

import pytest

from daemon.planning.model import PlannedLine, Point
from daemon.planning.reflight_files import mavlink_mission
from daemon.planning.reflight_planning import Segment
from sim_hw.receivers.mavlink_mission import MissionAutopilot, read_mission

LATITUDE, LONGITUDE = 47.0, 15.0
SPEED_DEG = 1e-3
"""So much further north at every look."""
WITHIN_S = 10.0


def test_cameras_are_commanded_when_a_waypoint_lies_behind_and_not_before() -> None:
    dialect = "pymavlink.dialects.v20.common"
    common = pytest.importorskip(dialect, reason="pip install 'syntopic[mavlink]'")
    text = "\n".join(
        ["QGC WPL 110"]
        + [
            f"{2 * k}\t0\t3\t16\t0\t0\t0\t0\t{LATITUDE + north}\t{LONGITUDE}\t100\t1\n"
            f"{2 * k + 1}\t0\t2\t2000\t0\t0\t1\t0\t0\t0\t0\t1"
            for k, north in enumerate((0.0025, 0.0055))
        ]
    )
    position_count = 0

    def place(_mono_ns: int) -> tuple[float, float]:
        nonlocal position_count
        position_count += 1
        return LATITUDE + (position_count - 1) * SPEED_DEG, LONGITUDE

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as camera:
        camera.bind(("127.0.0.1", 0))
        camera.settimeout(WITHIN_S)
        autopilot = MissionAutopilot(read_mission(text), place, camera.getsockname())
        autopilot.start()
        try:
            received: list[Any] = []
            mav = common.MAVLink(None)
            while len(received) < 4:
                data, address = camera.recvfrom(2048)
                received += mav.parse_buffer(bytearray(data)) or []
        finally:
            autopilot.close()
    assert address[0] == "127.0.0.1"
    commands = [
        (one.get_type(), getattr(one, "seq", None) or getattr(one, "command", 0))
        for one in received
    ]
    waypoint, order = "MISSION_ITEM_REACHED", ("COMMAND_LONG", 2000)
    assert commands == [(waypoint, 0), order, (waypoint, 2), order]
    assert (received[1].param3, received[1].target_component) == (1.0, 100)
    assert [index for index, _ in autopilot.reached] == [0, 2]


def test_the_mission_that_the_advisor_writes_is_read() -> None:
    start, end = Point(LATITUDE, LONGITUDE), Point(LATITUDE + 0.01, LONGITUDE)
    again = Segment(PlannedLine("A", start, end), 0.0, 1113.0, start, end, ("refly",))
    items = read_mission(mavlink_mission([again], height_m=500.0, distance_m=80.0))
    assert [item.command for item in items] == [16, 206, 16, 206]
    assert [items[1].parameters[0], items[3].parameters[0]] == [80.0, 0.0]

"""The track that was flown, from the navigation in the flight log."""

from __future__ import annotations

from collections import Counter
from typing import Final

from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import logs_of, read
from daemon.mission.log.log_records import record_of
from daemon.planning.model import Point
from drivers.contract import NavSample

TOPIC: Final = "navigation/"
INTERVAL_NS: Final = 1_000_000_000
"""Between the points of a track: one second."""
BREAK_NS: Final = 5_000_000_000
"""Without a position for longer, the track is interrupted: its course there is not known."""


def flown_track(mission: Mission) -> tuple[tuple[Point, ...], ...]:
    """The flown track as polylines, about one point a second.

    With several receivers it is that of the one with the most positions. A torn log is read up to
    its end.

    Args:
        mission: the mission.

    Returns:
        Polylines in the order of time, each of two points or more; empty without navigation.

    Raises:
        OSError: a log cannot be read.
    """
    found: dict[str, list[list[Point]]] = {}
    for log in logs_of(mission.log_dir):
        last_ns: dict[str, int] = {}
        for message in read(log):
            topic = message.topic
            if not topic.startswith(TOPIC):
                continue
            elapsed_ns = message.mono_ns - last_ns.get(topic, message.mono_ns - BREAK_NS - 1)
            # What is not used is not parsed: a receiver may send a hundred samples a second.
            if 0 <= elapsed_ns < INTERVAL_NS:
                continue
            record = record_of(message)
            position = record.position if isinstance(record, NavSample) else None
            if position is None or abs(position[0]) > 90.0 or abs(position[1]) > 180.0:
                continue
            last_ns[topic] = message.mono_ns
            parts = found.setdefault(topic, [])
            if not 0 <= elapsed_ns <= BREAK_NS:
                parts.append([])
            parts[-1].append(Point(*position))
    counts = Counter({topic: sum(map(len, parts)) for topic, parts in found.items()})
    if not counts:
        return ()
    topic, _ = counts.most_common(1)[0]
    return tuple(tuple(part) for part in found[topic] if len(part) > 1)

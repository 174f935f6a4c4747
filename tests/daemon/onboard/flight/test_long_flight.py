"""Thousands of exposures on a fake clock: what an exposure takes, it gives back.

Flight, ledger, matching, clocks, Level-0 writer, index and flight log are those that fly. What was
sealed long ago is deleted here, which the product never does, so that the disk stays small.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest

from daemon.mission.log.flight_log import FlightLog
from daemon.mission.log.log_records import LoggedTrigger, message_of
from daemon.mission.store import durable
from daemon.mission.store.store import Level0Writer
from daemon.onboard.flight.flight import Flight
from drivers.contract import PpsEdge, TemperatureSample, TriggerPulse
from tests.daemon.onboard.flight.test_flight import HEADS, NS, RIG, flight, frame, mark, nav, pulse
from tests.daemon.small_camera import new_mission

INTERVAL_S = 2
NAVIGATION_HZ = 5
KEPT = 20
WIDTH_PX, HEIGHT_PX = 16, 12
GROWTH_BYTES = 4_000_000
"""Of the whole process between a fifth of the flight and its end; of 5,000 exposures less than
1 kB each."""


def resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.fixture
def root() -> Iterator[Path]:
    memory = Path("/dev/shm")
    made = Path(mkdtemp(prefix="syntopic-", dir=memory if memory.is_dir() else None))
    yield made
    durable.remove_tree(made)


def expose(flown: Flight, log: FlightLog, number: int) -> None:
    """The devices' part of an exposure: trigger, frames, mark, navigation, temperatures, PPS."""
    at_s = number * INTERVAL_S
    for step in range(INTERVAL_S * NAVIGATION_HZ):
        flown.take(sample := nav(at_s - INTERVAL_S + step / NAVIGATION_HZ))
        log.write(message_of(sample))
    for second in (at_s - 1, at_s):
        flown.take(PpsEdge("gnss", second, second * NS, 1_000))
    for probe in RIG.probes:
        flown.take(TemperatureSample(probe, 20.0, (at_s - 1) * NS))
    assert flown.order(at_s * NS) == number
    given = pulse(number, at_s)
    flown.fired(given)
    unit = TriggerPulse(number, given.mono_ns, given.sigma_ns, given.count)
    log.write(message_of(LoggedTrigger(number, unit, given.delays_ns, given.strobe_delay_ns)))
    for head in HEADS:
        arrived = replace(frame(head, given), width_px=WIDTH_PX, height_px=HEIGHT_PX)
        flown.take(arrived)
        log.write(message_of(arrived))
    flown.take(stamped := mark(given))
    log.write(message_of(stamped))


def fly(root: Path, exposures: int) -> dict[str, int | float]:
    mission = new_mission(root)
    writer = Level0Writer(mission)
    log = FlightLog.create(mission.log_dir)
    flown = flight()
    pixels = {head: np.zeros((HEIGHT_PX, WIDTH_PX), np.uint16) for head in HEADS}
    begun_s = time.monotonic()
    resident = open_before = 0
    for number in range(1, exposures + 1):
        if number == exposures // 5:
            resident, open_before = resident_bytes(), descriptors()
        expose(flown, log, number)
        now_ns = (number * INTERVAL_S + 1) * NS
        while (actions := flown.advance(now_ns)).decision is not None:
            for due in actions.store:
                position = {record.sensor: pixels[record.sensor] for record in due.capture.frames}
                flown.stored(due.capture.number, writer.write(due.capture, position))
            if (record := actions.seal) is not None:
                writer.seal(record)
                flown.sealed(record.number)
        assert flown.ledger.imbalances() == []
        if number > KEPT and (old := mission.level0(number - KEPT)).is_dir():
            durable.remove_tree(old)
    flown.land()
    while (record := flown.advance((exposures + 10) * INTERVAL_S * NS).seal) is not None:
        writer.seal(record)
        flown.sealed(record.number)
    figures = {
        "exposures": exposures,
        "growth_bytes": resident_bytes() - resident,
        "descriptors": descriptors() - open_before,
        "seconds": round(time.monotonic() - begun_s, 1),
        "log_bytes": log.path.stat().st_size,
    }
    sheet = flown.ledger.sheet()
    log.close()
    writer.close()
    assert flown.ledger.imbalances(has_landed=True) == []
    assert (sheet.triggers, sheet.complete) == (exposures, exposures)
    assert flown.open_numbers == ()
    print(json.dumps(figures))
    return figures


def test_three_hundred_exposures_leave_memory_and_descriptors_as_they_were(root: Path) -> None:
    figures = fly(root, 300)
    assert figures["growth_bytes"] < GROWTH_BYTES
    assert figures["descriptors"] <= 0


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_five_thousand_exposures_leave_memory_and_descriptors_as_they_were(root: Path) -> None:
    figures = fly(root, 5000)
    assert figures["growth_bytes"] < GROWTH_BYTES
    assert figures["descriptors"] <= 0

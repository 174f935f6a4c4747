"""The flight whose writes are recorded.

`python -m tests.robustness.crash.scripted_flight ROOT ACKS EXPOSURES FORGETS` flies it.

The real writer process, recovery and products over a camera of tiny heads, in two lives: the first
ends as by `kill -9` with an exposure stored and not sealed, the second begins with recovery and
lands. Every acknowledgement is written as a line to ACKS at the moment it is sent.
"""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.mission.log import log_seals
from daemon.mission.log.log_records import LoggedTrigger, message_of
from daemon.mission.store import durable
from daemon.mission.store.level0_folder import read_sealed
from daemon.mission.store.level2 import write_level2
from daemon.mission.verification.recovery import recover
from daemon.onboard.flight.recovery_match import seal_from_log
from daemon.onboard.service.messages import (
    AppendToLog,
    IndexProducts,
    Seal,
    Sealed,
    Stop,
    Store,
    Stored,
    WriteFailed,
)
from daemon.onboard.storage import writer
from drivers.contract import TriggerPulse
from tests.daemon.small_camera import (
    SENSORS,
    capture_of,
    final_record,
    mark_of,
    new_mission,
    pixels_of,
    small_rig,
)

REFUSING_DISK = "disk"
"""Flown on a disk that sometimes refuses: lost log messages are not acknowledged."""

Durability = Literal["synced", "handed over", "not all"]
"""What a log is sure to keep: what was synced (power may fail), what was handed over (the program
may be killed), or not even that (the disk refuses)."""

NEVER_S = 1e9
TIMES = 20
FOR_EVER = 1_000_000


class Ring:
    """Frames of one head as the writer finds them in shared memory; a slot is a number."""

    def __init__(self, head: str) -> None:
        self.head = head

    def frame(self, slot: int, height_px: int, width_px: int) -> Any:
        return pixels_of(slot)[self.head].reshape(height_px, width_px)


class _Without:
    """A module one of whose functions does nothing."""

    def __init__(self, module: Any, name: str) -> None:
        self._module, self._name = module, name

    def __getattr__(self, name: str) -> Any:
        return (lambda *_: None) if name == self._name else getattr(self._module, name)


class ScriptedService:
    """Takes the place of the service: sends the requests, and records the answers."""

    def __init__(
        self, mission: Mission, acks: int, numbers: range, *, lands: bool, durability: Durability
    ) -> None:
        self._mission = mission
        self._durability = durability
        self._acks = acks
        self._answers: list[object] = []
        self._orders = self._flight(numbers, lands)
        self._logged = 0
        self._triggered = 0
        self._acknowledged = 0

    def send(self, message: object) -> None:
        if isinstance(message, Stored):
            acknowledge(self._acks, f"stored {message.number}")
        elif isinstance(message, Sealed):
            acknowledge(self._acks, f"sealed {message.number} {message.sha256}")
        self._answers.append(message)

    def receive(self, _timeout_s: float) -> object:
        if (
            self._durability == "synced"
            and self._acknowledged < self._logged
            and writer.LOG_SYNC_INTERVAL_S == 0.0
        ):
            acknowledge(self._acks, f"logged {self._logged}")
            self._acknowledged = self._logged
        if self._durability == "handed over" and self._triggered:
            acknowledge(self._acks, f"triggered {self._triggered}")
            self._triggered = 0
        # Every now and then a second has passed.
        order = next(self._orders)
        is_logged = isinstance(order, AppendToLog)
        self._logged += is_logged
        writer.LOG_SYNC_INTERVAL_S = 0.0 if is_logged and self._logged % 3 == 0 else NEVER_S
        return order

    def _flight(self, numbers: range, lands: bool) -> Iterator[object]:
        for number in numbers:
            pulse = TriggerPulse(number, number * 10**9, 1000, number)
            self._triggered = number
            yield AppendToLog(message_of(LoggedTrigger(number, pulse, {"0": 0, "1": 0})))
            yield AppendToLog(message_of(mark_of(number)))
            sensors = SENSORS if number % 2 else SENSORS[:2]
            capture = capture_of(number, sensors)
            stored: object = None
            if number % 4:  # else nothing came of it
                yield Store(capture, dict.fromkeys(sensors, number))
                stored = self._last(Stored, WriteFailed)
            if not isinstance(stored, Stored):
                missing = tuple((sensor, "no frame came") for sensor in SENSORS)
                lost = Exposure(number=number, boot_id="", state="lost", missing=missing)
                yield from self._seal(lost)
                continue
            if not lands and number == numbers[-1]:
                break
            yield from self._seal(final_record(replace(capture, frames=stored.frames)))
            yield from self._process(number)
        if lands:
            yield Stop()
        os._exit(0)  # killed: nothing is closed

    def _seal(self, record: Exposure) -> Iterator[object]:
        """As the service does: a disk that refuses is asked again."""
        for _ in range(TIMES):
            yield Seal(record)
            answer = self._last(Sealed, WriteFailed)
            if isinstance(answer, Sealed):
                return
            assert isinstance(answer, WriteFailed) and answer.is_transient, answer
        raise AssertionError(f"not sealed after {TIMES} times")

    def _last(self, *kinds: type) -> object:
        return next(a for a in reversed(self._answers) if isinstance(a, kinds))

    def _process(self, number: int) -> Iterator[object]:
        """What a worker does in parallel; the second exposure is processed twice."""
        for _ in range(2 if number == 2 else 1):
            pan = np.full((4, 6), number, np.uint16)
            try:
                done = write_level2(
                    self._mission,
                    number,
                    report_json={"verdict": "good"},
                    pan=pan,
                    colour={},
                    quicklook=None,
                )
            except OSError:
                assert self._durability == "not all"
                return
            acknowledge(self._acks, f"processed {number}")
            yield IndexProducts(number, done.files, done.verdict)


def acknowledge(acks: int, line: str) -> None:
    """Say something to the world: from now on it must hold.

    Into a file with a call that nothing else here makes, so that a test may let the others fail.
    """
    found = os.fstat(acks)
    if stat.S_ISFIFO(found.st_mode):
        os.write(acks, line.encode() + b"\n")
    else:
        os.pwritev(acks, [line.encode() + b"\n"], found.st_size)


def forget(what: str) -> None:
    """Leave a step out, so that a test can show that the missing step is found."""
    if what == "folders":
        durable.sync_directory = lambda path: None
    elif what == "frames":
        durable.os = _Without(os, "fsync")
    elif what == "log":
        log_seals.durable = _Without(durable, "sync_file")


def main() -> None:
    root, acks_path, count = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    forget(sys.argv[4])
    acks = os.open(acks_path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    durability: Durability = "not all" if sys.argv[4] == REFUSING_DISK else "synced"
    mission = new_mission(root)
    acknowledge(acks, f"mission {mission.id}")
    for numbers, lands in ((range(1, count + 1), False), (range(count + 1, 2 * count + 1), True)):
        one = os.fork()
        if not one:
            with mission.held():
                run_until_end(mission, acks, numbers, lands=lands, durability=durability)
        _, status = os.waitpid(one, 0)
        assert status == 0, "the flight did not go on"
    acknowledge(acks, "closing 0")
    mission.close()


def run_until_end(
    mission: Mission, acks: int, numbers: range | None, *, lands: bool, durability: Durability
) -> None:
    """One life of the service: recovery and flight, without numbers for ever. It never returns."""
    report = recover(mission, seal_from_log(small_rig()))
    for exposure in report.finalized:
        sealed = read_sealed(mission.level0(exposure.number))
        assert sealed is not None
        acknowledge(acks, f"sealed {exposure.number} {sealed.sha256}")
    acknowledge(acks, "flying 0")
    if numbers is None:
        numbers = range(report.next_number, report.next_number + FOR_EVER)
    link: Any = ScriptedService(mission, acks, numbers, lands=lands, durability=durability)
    rings: Any = tuple(Ring(sensor) for sensor in SENSORS)
    writer.main(link, mission.path, rings)
    os._exit(0)


if __name__ == "__main__":
    main()

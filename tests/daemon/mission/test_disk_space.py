"""Free space, the time it lasts, and the warning and flag when it becomes low."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon.configuration.model import LimitsSection
from daemon.mission.store.disk_space import DiskSpaceMonitor, needed_nbytes
from processing.quality.report import Flag
from tests.daemon.onboard.flight.test_flight import flight

NBYTES = 1_000_000
NEEDED = 3 * NBYTES
RESERVE = 50_000_000


def guard(free: int, *, warn: int = 100) -> tuple[DiskSpaceMonitor, list[int]]:
    free_nbytes = [free]
    limits = LimitsSection(disk_reserve_bytes=RESERVE, disk_warn_exposures=warn)
    return DiskSpaceMonitor(limits, NBYTES, Path("/disk"), lambda _: free_nbytes[0]), free_nbytes


@pytest.mark.parametrize(
    ("free", "exposures"),
    [
        (RESERVE + 10 * NEEDED, 10),
        (RESERVE + 10 * NEEDED - 1, 9),
        (RESERVE + NEEDED - 1, 0),
        (0, 0),
    ],
)
def test_exposures_left_keep_the_reserve_and_room_for_products(free: int, exposures: int) -> None:
    free_nbytes = guard(free)[0].check()
    assert free_nbytes.exposures == exposures
    assert free_nbytes.is_full == (exposures == 0)


def test_the_time_left_follows_the_rate_of_the_last_exposures() -> None:
    monitor, _ = guard(RESERVE + 120 * NEEDED)
    assert monitor.check().seconds is None
    for second in (0, 1000, 1002, 1004, 1006, 1008, 1010, 1012, 1014, 1016):
        monitor.add_exposure(second * 10**9)
    assert monitor.check().seconds == pytest.approx(240.0)


def test_an_exposure_needs_its_frames_and_twice_as_much_for_products() -> None:
    assert [needed_nbytes(n) for n in (0, 1, 10, NBYTES)] == [1, 3, 30, 3 * NBYTES]


def test_the_rate_is_known_from_the_second_exposure_and_follows_the_last_nine() -> None:
    monitor, _ = guard(RESERVE + 10 * NEEDED)
    monitor.add_exposure(5 * 10**9)
    assert monitor.check().seconds is None
    monitor.add_exposure(8 * 10**9)
    assert monitor.check().seconds == pytest.approx(30.0, abs=1e-9)
    for second in range(100, 108):
        monitor.add_exposure(second * 10**9)
    # Of nine exposures the oldest is the one at 8 s: eight intervals over 99 s.
    assert monitor.check().seconds == pytest.approx(10 * 99 / 8, abs=1e-9)
    monitor.add_exposure(108 * 10**9)
    assert monitor.check().seconds == pytest.approx(10.0, abs=1e-9)


def test_a_disk_that_is_low_from_the_start_warns_with_the_minutes_left() -> None:
    monitor, _ = guard(RESERVE + 90 * NEEDED)
    for second in (0, 2):
        monitor.add_exposure(second * 10**9)
    assert monitor.warning() == (
        "the disk is low: room for 90 exposures, 3 min at this rate; finish this line and "
        "change the disk, or free /disk"
    )


def test_low_space_is_reported_once_and_again_after_space_was_free() -> None:
    monitor, free_nbytes = guard(RESERVE + 100 * NEEDED)
    assert monitor.warning() is None
    free_nbytes[0] -= 1
    sentence = monitor.warning()
    assert sentence is not None and "room for 99 exposures" in sentence and "change" in sentence
    assert monitor.warning() is None
    free_nbytes[0] = RESERVE + 200 * NEEDED
    assert monitor.warning() is None
    free_nbytes[0] = RESERVE
    assert "room for 0 exposures" in str(monitor.warning())


def test_what_is_ordered_on_a_low_disk_is_flagged_and_nothing_else_is() -> None:
    flown = flight()
    flags = []
    for is_low in (False, True, False):
        flown.disk_is_low = is_low
        number = flown.order(0)
        flown.not_fired(number, "no pulse")
        record = flown.advance(0).seal
        assert record is not None
        flags.append(Flag(record.flags))
        flown.sealed(number)
    assert [bool(f & Flag.DISK_LOW) for f in flags] == [False, True, False]

"""What a flight needs of disk, memory and calibration, at the limits."""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from daemon.configuration.model import Configuration
from daemon.onboard.capture.link_settings import exposure_interval_s
from daemon.onboard.preflight import prerequisites
from daemon.onboard.preflight.check_results import CheckOutcome, CheckResult
from daemon.onboard.preflight.prerequisites import (
    CHECKS,
    CHECKS_AFTER_RESTART,
    CHECKS_AT_START,
)
from daemon.onboard.preflight.service_file import load
from processing.rig import Rig
from tests.daemon.onboard.service.flight_parts import Planted

pytestmark = pytest.mark.trust

FRAME_NBYTES = 64 * 48 * 2 + 4096
"""Pixels of 16 bits and room for chunk data."""


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Planted]:
    made = Planted(tmp_path, monkeypatch)
    made.write()
    (tmp_path / "missions").mkdir()
    yield made


def loaded(planted: Planted, trigger: str = "interval_s = 0.2", plan: str = "") -> Any:
    planted.service = planted.service.replace("interval_s = 0.2", trigger) + plan
    planted.write()
    return load(planted.config)


@pytest.mark.parametrize(
    ("trigger", "interval_s"),
    [
        ("interval_s = 3.0", 3.0),
        ("interval_s = 0.01", 0.2),  # the camera is no faster
        ('mode = "distance"\ndistance_m = 90.0', 1.5),
    ],
)
def test_the_shortest_interval_follows_from_trigger_speed_and_camera(
    planted: Planted, trigger: str, interval_s: float
) -> None:
    configuration, rig = loaded(planted, trigger, "\n[plan]\nground_speed_mps = 60.0\n")
    assert exposure_interval_s(configuration, rig) == pytest.approx(interval_s)


@pytest.mark.parametrize(
    ("factor", "outcome"), [(1.01, CheckOutcome.PASS), (0.99, CheckOutcome.FAIL)]
)
def test_the_disk_has_to_write_frames_and_products_in_the_interval(
    planted: Planted, factor: float, outcome: CheckOutcome
) -> None:
    configuration, rig = loaded(planted, "interval_s = 2.0")
    needed = 3 * 2 * FRAME_NBYTES / 2.0
    planted.monkeypatch.setattr(
        prerequisites, "measure_write_s", lambda _root, nbytes: nbytes / (needed * factor)
    )
    (found,) = prerequisites.pace(configuration, rig)
    assert (found.outcome, found.is_blocking) == (outcome, False)


def test_the_best_of_three_tries_counts_and_a_good_one_ends_the_trying(planted: Planted) -> None:
    configuration, rig = loaded(planted)
    tries = iter((1e6, 1e-3, 1e6))
    planted.monkeypatch.setattr(prerequisites, "measure_write_s", lambda *_: next(tries))
    (found,) = prerequisites.pace(configuration, rig)
    assert found.outcome is CheckOutcome.PASS and next(tries) == 1e6


def test_what_is_written_to_measure_is_of_its_size_and_is_removed(planted: Planted) -> None:
    root = planted.folder / "missions"
    sizes: list[int] = []
    create = prerequisites.durable.create_file

    def seen(path: Path, parts: Any, **how: Any) -> int:
        sizes.append(create(path, parts, **how))
        return sizes[-1]

    planted.monkeypatch.setattr(prerequisites.durable, "create_file", seen)
    assert prerequisites.measure_write_s(root, 5_000_001) > 0.0
    assert sizes == [5_000_001] and not list(root.iterdir())


@pytest.mark.parametrize(("short", "outcome"), [(0, CheckOutcome.PASS), (1, CheckOutcome.FAIL)])
def test_memory_is_needed_for_every_frame_that_is_held(
    planted: Planted, short: int, outcome: CheckOutcome
) -> None:
    configuration, rig = loaded(planted)
    needed = configuration.limits.exposures_in_memory * 2 * FRAME_NBYTES
    planted.monkeypatch.setattr(prerequisites, "available_memory_nbytes", lambda: needed - short)
    (found,) = prerequisites.memory(configuration, rig)
    assert (found.outcome, found.is_blocking) == (outcome, outcome is CheckOutcome.FAIL)


@pytest.mark.parametrize(("days", "outcome"), [(730, CheckOutcome.PASS), (731, CheckOutcome.FAIL)])
def test_a_calibration_is_trusted_to_its_last_day(
    planted: Planted, days: int, outcome: CheckOutcome
) -> None:
    configuration, rig = loaded(planted)
    today = datetime.date.fromisoformat(rig.calibration_date) + datetime.timedelta(days)
    planted.monkeypatch.setattr(prerequisites, "_today", lambda: today)
    (found,) = prerequisites.calibration(configuration, rig)
    assert found.outcome is outcome


def test_what_prevents_ends_the_looking_and_a_restart_measures_nothing(planted: Planted) -> None:
    configuration, rig = loaded(planted)

    def is_blocking(_configuration: Configuration, _rig: Rig) -> Iterator[CheckResult]:
        yield CheckResult("a", "b", CheckOutcome.FAIL, "no", is_blocking=True)

    def never(_configuration: Configuration, _rig: Rig) -> Iterator[CheckResult]:
        raise AssertionError("looked at in vain")

    found = prerequisites.prerequisites(configuration, rig, (is_blocking, never))
    assert [one.name for one in found] == ["b"]
    # The health of disks is watched in flight, and the process of the page checks its own.
    assert set(CHECKS) - set(CHECKS_AT_START) == {prerequisites.monitoring}
    assert set(CHECKS_AT_START) - set(CHECKS_AFTER_RESTART) == {
        prerequisites.pace,
        prerequisites.disk_health,
    }

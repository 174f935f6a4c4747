"""Devices killed and restarted at random: noticed, back by themselves, the others undisturbed."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from tests.robustness.faults.restarts import (
    SPAWNER,
    descriptors,
    figures,
    kill_at_random,
    running,
    wait_until_all_speak,
)

pytest.importorskip("gi", reason="needs PyGObject (extra aravis)")
pytest.importorskip("pymavlink", reason="needs pymavlink (extra mavlink)")
pytestmark = [pytest.mark.realtime, pytest.mark.timeout(400)]

MARGIN_S = 6.0
"""What a loaded machine may add to a stated time."""


def fly(folder: Path, lasts_s: float, seed: int) -> None:
    SPAWNER.submit(int).result()
    threads_before = threading.active_count()
    with running(folder) as started_devices:
        wait_until_all_speak(started_devices, 120.0)
        baseline = (threading.active_count(), descriptors())
        kills = kill_at_random(started_devices, lasts_s, seed)
        back_s = wait_until_all_speak(started_devices, 120.0)
        found = {device.name: figures(device) for device in started_devices}
        for device in started_devices:
            print(found[device.name].row(device), f"unnoticed {found[device.name].unnoticed}")
            for sentence in found[device.name].disturbances:
                print("   ", sentence)
        deadline = time.monotonic() + 30
        while (threading.active_count(), descriptors()) != baseline:
            assert time.monotonic() < deadline, (
                f"threads and descriptors {(threading.active_count(), descriptors())}, "
                f"at first {baseline}"
            )
            time.sleep(0.2)
        print(f"{kills} kills, all back after {back_s:.1f} s, {baseline} threads and descriptors")
        assert kills >= len(started_devices), "every device was killed"
        for device in started_devices:
            seen = found[device.name]
            assert not seen.disturbances, device.name
            assert max(seen.detected_s, default=0.0) < device.stated.detected_s + MARGIN_S
            assert max(seen.back_s) < device.stated.back_s + MARGIN_S, device.name
            for down, up in device.down:
                # A death that lasts longer than what is stated does not pass unnoticed.
                is_long = up - down > device.stated.detected_s + MARGIN_S
                reported = [
                    s for s, e in device.events if e.is_fault and down <= s <= up + MARGIN_S
                ]
                assert reported or not is_long
    deadline = time.monotonic() + 30
    while threading.active_count() > threads_before:
        assert time.monotonic() < deadline, threading.enumerate()
        time.sleep(0.2)


@pytest.mark.soak
def test_half_a_minute_of_kills(tmp_path: Path) -> None:
    fly(tmp_path, 30.0, seed=1)


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_ten_minutes_of_kills(tmp_path: Path) -> None:
    fly(tmp_path, 600.0, seed=2)

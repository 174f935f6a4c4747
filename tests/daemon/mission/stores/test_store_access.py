"""A store that refuses the credentials in mid-run, and one that is slow."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest

from daemon.mission.layout import Mission
from daemon.mission.transfer.store_products import list_products
from daemon.postflight.batch.store_level2 import StoreLevel2Action
from tests.daemon.diverging_camera import flown_mission
from tests.daemon.mission.stores.faulty_s3 import Faults
from tests.daemon.mission.stores.test_store_process import process, uploaded

GENERAL_CURE = "Check that the credentials have not expired, their rights to the bucket, and"
pytestmark = [pytest.mark.peer, pytest.mark.trust]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Mission:
    return flown_mission(tmp_path_factory.mktemp("flown"), range(1, 9))


@pytest.mark.parametrize(
    ("method", "code", "cure"),
    [
        ("GET", "ExpiredToken", "The credentials have expired. Set new ones"),
        (
            "GET",
            "RequestTimeTooSkewed",
            "The clock of this machine is wrong by more than the store",
        ),
        ("GET", "AccessDenied", GENERAL_CURE),
        # An answer to HEAD has no body, so its code is not known.
        ("HEAD", "ExpiredToken", GENERAL_CURE),
    ],
    ids=("expired", "clock", "denied", "expired-head"),
)
def test_credentials_refused_in_mid_run_end_it_and_the_same_command_continues(
    flown: Mission, store: Callable[..., str], method: str, code: str, cure: str
) -> None:
    faults = Faults()
    place = uploaded(flown, store(faults))
    refused = tuple(f"L0/{number:06d}/LEFT.tif" for number in range(3, 9))

    def is_refused(of: str, path: str) -> bool:
        return of == method and path.endswith(refused)

    faults.is_for = is_refused
    faults.kinds, faults.every = (code,), 1
    output = process(place.url, status=1)
    causes = [failure["cause"] for failure in output["failures"]]
    assert output["done"] + len(causes) == 8 and output["done"] <= 2
    assert any(cure in cause and "run the command again" in cause for cause in causes)
    assert "not attempted, because the store refused exposure" in causes[-1]
    assert output["store_retries"] == 0 and faults.counts[code] <= 4  # not asked again and again
    faults.every = 0
    again = process(place.url)
    assert again["complete_before"] == output["done"] and again["failures"] == []


def test_a_slow_store_does_not_fill_memory_with_exposures(
    flown: Mission, store: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    faults = Faults(kinds=("slow",), hang_s=0.1)
    place = uploaded(flown, store(faults))
    lock, held, most = threading.Lock(), set[int](), [0]
    read, compute = StoreLevel2Action._frames, StoreLevel2Action.__call__

    def reads(action: StoreLevel2Action, number: int, files: Any) -> dict[str, bytes]:
        with lock:
            held.add(number)
            most.append(len(held))
        return read(action, number, files)

    def computes(action: StoreLevel2Action, task: Any) -> dict[str, Any]:
        try:
            return compute(action, task)
        finally:
            with lock:
                held.discard(task.number)

    monkeypatch.setattr(StoreLevel2Action, "_frames", reads)
    monkeypatch.setattr(StoreLevel2Action, "__call__", computes)
    faults.is_for = lambda method, path: method == "PUT" and path.endswith(".tif")
    faults.every = 1
    assert process(place.url)["done"] == 8
    assert faults.counts["slow"] == 16
    assert max(most) == 2  # in work, as one process has them; none waits in memory for the store
    assert len(list(list_products(place).committed())) == 8

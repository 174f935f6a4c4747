"""A store whose lists miss objects that were written, and a clock that is set during a run."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from daemon.mission.layout import Mission
from daemon.mission.store import store as verification
from daemon.mission.transfer import store_products, store_transfer
from daemon.mission.transfer.object_store import ObjectStore, StoredObject
from daemon.mission.transfer.store_transfer import transfer_to_store
from daemon.mission.transfer.store_verification import verify_in_store
from daemon.mission.transfer.transfer_manifest import TransferError
from daemon.postflight.batch.level2_work import Level2Action
from tests.daemon.diverging_camera import copied, flown_mission
from tests.daemon.mission.stores.test_store_process import (
    change,
    compared,
    compared_in_folder,
    process,
    uploaded,
)

pytestmark = [pytest.mark.peer, pytest.mark.trust]

Start = Callable[..., str]
JUMPS_S = (0.0, 86_400.0, -86_400.0, 3.0e8, -3.0e8)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Mission:
    return flown_mission(tmp_path_factory.mktemp("flown"), (1, 2))


@pytest.fixture
def late(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[str], bool]], None]:
    """Leaves objects out of every list, by their name."""
    listed = ObjectStore.list_objects

    def leave_out(is_late: Callable[[str], bool]) -> None:
        def short(place: ObjectStore, folder: str = "") -> list[StoredObject]:
            return [one for one in listed(place, folder) if not is_late(one.name)]

        monkeypatch.setattr(ObjectStore, "list_objects", short)

    return leave_out


@pytest.fixture
def counts(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """Computations and commits of product sets."""
    found = {"computed": 0, "committed": 0}
    make, create = Level2Action.make, ObjectStore.create_small

    def makes(action: Level2Action, *arguments: Any, **options: Any) -> Any:
        found["computed"] += 1
        return make(action, *arguments, **options)

    def creates(place: ObjectStore, name: str, data: bytes) -> bool:
        is_created = create(place, name, data)
        found["committed"] += is_created
        return is_created

    monkeypatch.setattr(Level2Action, "make", makes)
    monkeypatch.setattr(ObjectStore, "create_small", creates)
    return found


def test_products_that_no_list_shows_are_committed_once_and_not_computed_again(
    flown: Mission, store: Start, late: Any, counts: dict[str, int]
) -> None:
    place = uploaded(flown, store())
    with pytest.MonkeyPatch.context() as patched:
        listed = ObjectStore.list_objects
        patched.setattr(
            ObjectStore,
            "list_objects",
            lambda place, folder="": [
                one for one in listed(place, folder) if not one.name.startswith("processed/")
            ],
        )
        for _ in range(2):
            output = process(place.url)
            assert output["failures"] == [] and len(output["exposures"]) == 2
        assert counts == {"computed": 2, "committed": 2}
    assert len(compared(place)) == 2
    # Some objects of a set, and then the manifests alone.
    for is_late in (lambda name: name.endswith("LEFT.tif"), lambda name: "/manifests/" in name):
        late(is_late)
        assert process(place.url)["failures"] == []
    assert counts == {"computed": 2, "committed": 2}


def test_products_that_are_missing_are_not_taken_for_late(
    flown: Mission, store: Start, counts: dict[str, int]
) -> None:
    place = uploaded(flown, store())
    process(place.url)
    before = compared(place)
    number, key = next(iter(store_products.list_products(place).committed()))
    change(place, f"{store_products.product_folder(number, key)}/LEFT.tif", None)
    assert process(place.url)["complete_before"] == 1
    assert counts == {"computed": 3, "committed": 2} and compared(place) == before


def test_a_copy_that_no_list_shows_is_not_sent_again_and_verified(
    flown: Mission, store: Start, late: Any
) -> None:
    url = store()
    place = uploaded(flown, url)
    late(lambda _name: True)
    report = transfer_to_store(flown, ObjectStore(url))
    assert report.copied == 0 and report.already_present > 10
    found = verify_in_store(place)
    assert found.problems == () and found.frames == 4
    change(place, "L0/000002/RIGHT.tif", None)
    assert any("RIGHT.tif is missing" in one for one in verify_in_store(place).problems)


def test_captured_data_that_differ_from_a_late_copy_are_not_replaced(
    flown: Mission, store: Start, late: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = store()
    place, intact = uploaded(flown, url), verification.verify(flown)
    held = place.read_small("L0/000001/LEFT.tif")
    source = copied(flown, tmp_path)
    frame = source.level0(1) / "LEFT.tif"
    frame.chmod(0o644)
    frame.write_bytes(frame.read_bytes()[::-1])
    monkeypatch.setattr(store_transfer, "verify", lambda _mission: intact)  # it misses the change
    late(lambda _name: True)
    with pytest.raises(TransferError, match=r"LEFT.tif differs from the copy that was verified"):
        transfer_to_store(source, ObjectStore(url))
    assert place.read_small("L0/000001/LEFT.tif") == held


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of the machine is set by days and years, forward and back, at every reading."""
    real, jumps = time.time, itertools.cycle(JUMPS_S)
    monkeypatch.setattr(time, "time", lambda: real() + next(jumps))


@pytest.mark.usefixtures("clock")
def test_a_clock_that_is_set_during_a_run_changes_no_product_and_no_commit(
    flown: Mission, store: Start, tmp_path: Path, counts: dict[str, int]
) -> None:
    place, folder = uploaded(flown, store()), copied(flown, tmp_path)
    for _ in range(2):
        in_store, in_folder = process(place.url), process(str(folder.path))
        assert in_store["failures"] == in_folder["failures"] == []
    assert in_store["complete_before"] == in_folder["complete_before"] == 2
    assert counts == {"computed": 4, "committed": 2}
    assert compared(place) == compared_in_folder(folder)
    assert verification.verify(folder).problems == ()
    assert transfer_to_store(flown, ObjectStore(place.url.rpartition("/")[0])).copied == 0

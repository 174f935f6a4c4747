"""A copy that is behind is brought up to date: what is copied, what is not, and what is counted."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon.mission.layout import DISCARDED, Mission
from daemon.mission.mirror.generations import STATE_FILE, read_generations
from daemon.mission.mirror.resync import SUPERSEDED, Resync
from daemon.mission.store.level0_folder import CAPTURE_FILE
from daemon.mission.store.store import verify
from tests.daemon.small_camera import fly, new_mission

pytestmark = pytest.mark.trust


@pytest.fixture
def source(tmp_path: Path) -> Mission:
    mission = new_mission(tmp_path / "a")
    fly(mission, [1, 2, 3])
    return mission


@pytest.fixture
def target(tmp_path: Path, source: Mission) -> Mission:
    return Mission(tmp_path / "b" / source.id, source.id)


def files(mission: Mission) -> set[str]:
    return {
        path.relative_to(mission.path).as_posix()
        for path in mission.path.rglob("*")
        if path.is_file()
    }


def test_records_and_configuration_are_copied_but_neither_products_nor_index_nor_hidden_files(
    source: Mission, target: Mission
) -> None:
    (source.path / "notes").mkdir()
    for name in ("notes/crew.txt", "notes/.hidden", ".hidden", STATE_FILE, "L2/x.tif", "export/x"):
        (source.path / name).write_text(name)
    Resync(source, target, 1, lambda: None).run()
    there = files(target)
    assert {"mission.json", "rig.toml", "service.toml", "notes/crew.txt"} <= there
    rest = {name for name in files(source) - there if not name.startswith("mission.db")}
    assert rest == {"notes/.hidden", ".hidden", STATE_FILE, "L2/x.tif", "export/x", "chain.jsonl"}


def test_exposures_that_wait_are_counted_down_and_a_copy_in_step_takes_nothing(
    source: Mission, target: Mission
) -> None:
    waiting: list[int] = []
    resync = Resync(source, target, 1, lambda: waiting.append(resync.waiting))
    assert resync.run() > 0
    assert {3, 2, 1} <= set(waiting) and resync.waiting == 0
    assert Resync(source, target, 1, lambda: None).run() == 0
    capture = target.level0(2) / CAPTURE_FILE
    capture.chmod(0o644)
    capture.write_bytes(capture.read_bytes() + b" ")
    assert Resync(source, target, 1, lambda: None).run() == 1
    assert [path.name for path in (target.level0_root / DISCARDED).iterdir()] == ["000002-1"]


def test_an_open_log_is_copied_from_its_first_byte_and_goes_on_where_it_ended(
    source: Mission, target: Mission
) -> None:
    resync = Resync(source, target, 1, lambda: None)
    resync.run()
    log, copy = source.log_dir / "x.mcap", target.log_dir / "x.mcap"
    log.write_bytes(b"0123456789")
    copy.write_bytes(b"of an earlier flight")
    resync.copy_open_log("x.mcap", 6)
    assert copy.read_bytes() == b"012345"
    resync.copy_open_log("x.mcap", 10)
    assert copy.read_bytes() == b"0123456789"
    assert (target.path / SUPERSEDED / "x.mcap-1").read_bytes() == b"of an earlier flight"


def test_a_copy_with_chain_and_index_verifies(source: Mission, target: Mission) -> None:
    resync = Resync(source, target, 1, lambda: None)
    resync.run()
    resync.copy_chain_and_index()
    assert verify(target).problems == ()


def test_a_generation_without_a_first_exposure_begins_with_the_first_one(tmp_path: Path) -> None:
    generations = '{"format": 1, "generations": [{"number": 2, "token": "a", "disks": ["b"]}]}'
    (tmp_path / STATE_FILE).write_text(generations)
    assert [generation.first for generation in read_generations(tmp_path)] == [1]

"""The mission folder and which one a restarted service continues."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta, timezone

import pytest

from daemon.mission.layout import Mission, MissionError
from tests.daemon.small_camera import RIG_TOML, new_mission


def test_a_new_mission_is_complete_and_is_the_current_one(tmp_path):
    mission = new_mission(tmp_path / "flights" / "2026")
    assert mission.id == "20261121T101500Z-small"
    assert mission.rig_path.read_text() == RIG_TOML
    assert mission.service_path.read_bytes() == b"# flown by a test\n"
    assert {p.name for p in mission.path.iterdir()} == {
        "L0", "L2", "export", "log", "mission.json", "rig.toml", "service.toml", "chain.jsonl",
    }  # fmt: skip
    about = json.loads((mission.path / "mission.json").read_bytes())
    assert about["started_utc"] == "2026-11-21T10:15:00.000000Z"
    assert Mission.current(mission.root) == mission
    assert mission.level0(123) == mission.path / "L0" / "000123"
    assert mission.next_number() == 1


def test_a_closed_mission_is_not_continued_and_the_next_gets_its_own_id(tmp_path):
    first = new_mission(tmp_path)
    with pytest.raises(MissionError, match="is not closed"):
        new_mission(tmp_path)
    first.close()
    first.close()
    assert Mission.current(tmp_path) is None
    second = new_mission(tmp_path)
    assert second.id == "20261121T101500Z-small-2"
    first.close()
    assert Mission.current(tmp_path) == second


def test_the_id_is_in_utc_whatever_zone_the_start_is_given_in(tmp_path):
    mission = Mission.create(
        tmp_path,
        "small",
        rig_toml=b"",
        service_toml=b"",
        started_utc=datetime(2026, 11, 21, 11, 15, tzinfo=timezone(timedelta(hours=1))),
    )
    assert mission.id.startswith("20261121T101500Z")


def test_numbers_count_everything_that_ever_had_one(tmp_path):
    mission = new_mission(tmp_path)
    for name in ("000002", "000004.part", ".discarded/000007-1", "not-an-exposure"):
        (mission.level0_root / name).mkdir(parents=True)
    assert mission.numbers() == [2]
    assert mission.next_number() == 8
    (mission.level2_root / "001000").mkdir()
    assert mission.next_number() == 1001


def test_a_folder_that_is_no_mission_is_refused_with_a_sentence(tmp_path):
    with pytest.raises(MissionError, match="no such folder"):
        Mission.open(tmp_path / "none")
    with pytest.raises(MissionError, match="has no folder L0"):
        Mission.open(tmp_path)


@pytest.mark.parametrize("content", [b'{"mission":"../x"}', b'{"mission":"gone"}', b"{}"])
def test_a_damaged_marker_is_reported_with_its_cure(tmp_path, content):
    (tmp_path / "current-mission.json").write_bytes(content)
    with pytest.raises(MissionError, match="remove"):
        Mission.current(tmp_path)


def test_two_services_cannot_hold_one_mission(tmp_path):
    mission = new_mission(tmp_path)
    refusal = pytest.raises(MissionError, match="held by another process")
    with mission.held(), refusal, mission.held():
        pass
    with mission.held():
        pass


def test_a_start_without_a_zone_and_an_odd_rig_name_are_refused(tmp_path):
    naive = datetime(2026, 11, 21)
    for name, started in (("small", naive), ("../up", datetime(2026, 11, 21, tzinfo=UTC))):
        with pytest.raises(MissionError):
            Mission.create(tmp_path, name, rig_toml=b"", service_toml=b"", started_utc=started)
    assert list(tmp_path.iterdir()) == []

"""An interrupted mission is resumed with its own rig, and what differs is named."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from daemon.cli.run import run as run_command
from daemon.mission.layout import Mission
from daemon.mission.mirror.mirror_startup import interrupted_mission
from daemon.onboard.preflight.resumption import resume, rig_differences
from daemon.onboard.preflight.service_file import load
from daemon.onboard.service.notify import Notifier
from daemon.onboard.service.startup import create_mission
from tests.daemon.onboard.service.flight_parts import RIG, Planted, in_threads

pytestmark = pytest.mark.trust


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Planted]:
    made = Planted(tmp_path, monkeypatch)
    in_threads(made)
    made.frames("A")
    made.frames("B")
    made.change("simulated = true", "simulated = true\nend_when_done = true")
    made.write()
    yield made


def interrupted(planted: Planted) -> Mission:
    return create_mission(*load(planted.config), planted.config)


def fly(planted: Planted, capsys: pytest.CaptureFixture[str], **options: bool) -> list[dict]:
    """The events of `syntopic run` until the planned exposure is made."""
    capsys.readouterr()
    with pytest.raises(typer.Exit) as ended:
        run_command(planted.config, json_lines=True, **options)
    assert ended.value.exit_code == 0
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_a_changed_rig_is_named_with_keys_and_values_and_the_old_one_is_flown(
    planted: Planted, capsys: pytest.CaptureFixture[str]
) -> None:
    mission = interrupted(planted)
    planted.change('id = "pair-1"', 'id = "pair-2"')
    planted.change("h_um = 7.2", "h_um = 7.25")
    planted.write()
    events = fly(planted, capsys)
    (reported,) = [event for event in events if event["event"] == "resumed"]
    assert reported["sentence"].startswith(
        f"resuming mission {mission.id} with the rig of calibration pair-1 (2026-11-01); the "
        "configured rig differs in calibration.id ('pair-1' in the mission, 'pair-2' now), "
        "cone[0].sensor[0].pitch_um (7.2 in the mission, 7.25 now)"
    )
    assert reported["sentence"].endswith(f"syntopic run {planted.config} --new-mission")
    assert len(reported["differences"]) == 3
    record = json.loads((mission.path / "L0/000001/exposure.json").read_text())
    assert record["calibration_id"] == "pair-1"
    assert interrupted_mission(load(planted.config)[0]) is None, "it is closed after its flight"


def test_a_new_mission_closes_the_interrupted_one_and_flies_the_configured_rig(
    planted: Planted, capsys: pytest.CaptureFixture[str]
) -> None:
    mission = interrupted(planted)
    planted.change('id = "pair-1"', 'id = "pair-2"')
    planted.write()
    events = fly(planted, capsys, new_mission=True)
    assert events[0]["event"] == "closed" and events[0]["id"] == mission.id
    assert not [event for event in events if event["event"] == "resumed"]
    (begun,) = [event for event in events if event["event"] == "mission"]
    record = json.loads((Path(begun["path"]) / "L0/000001/exposure.json").read_text())
    assert begun["id"] != mission.id and record["calibration_id"] == "pair-2"
    assert not list(mission.level0_root.glob("0*"))


def test_a_damaged_rig_of_the_mission_is_no_obstacle_to_a_new_one(
    planted: Planted, capsys: pytest.CaptureFixture[str]
) -> None:
    mission = interrupted(planted)
    mission.rig_path.chmod(0o600)
    mission.rig_path.write_text("format = 1\n")
    events = fly(planted, capsys, new_mission=True)
    assert "syntopic repair" in events[0]["recovery"][0]
    assert any(event["event"] == "stored" for event in events)


def test_the_same_rig_is_resumed_without_a_word_about_differences(planted: Planted) -> None:
    mission = interrupted(planted)
    configuration, rig = load(planted.config)
    (planted.folder / "rig.toml").write_text("# a remark\n" + RIG.replace("100.0", "100.00"))
    found = resume(mission, configuration, rig, planted.config)
    assert not found.differences and not found.refusal
    assert found.sentence.endswith("with the rig of calibration pair-1 (2026-11-01)")


def test_differences_name_what_was_added_and_taken_away(tmp_path: Path) -> None:
    old, new = tmp_path / "old.toml", tmp_path / "new.toml"
    old.write_text('a = 1\nb = [1, 2]\n[[cone]]\nname = "A"\n')
    new.write_text('b = [1, 3]\n[[cone]]\nname = "A"\n[[cone]]\nname = "B"\n')
    assert rig_differences(old, new) == [
        "a (1 in the mission, absent now)",
        "b ([1, 2] in the mission, [1, 3] now)",
        "cone[1].name (absent in the mission, 'B' now)",
    ]


def test_no_automatic_restart_is_announced_without_systemd() -> None:
    assert "systemd" not in Notifier("").restart and "syntopic run" in Notifier("").restart
    assert "systemd starts" in Notifier("/run/systemd/notify").restart

"""The folder of the mission being flown was removed by hand: the sentence, and its two cures."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon import cli
from daemon.mission.layout import CURRENT_FILE, Mission
from daemon.mission.mirror.mirror_startup import interrupted_mission
from daemon.onboard.preflight.service_file import load
from daemon.onboard.service.startup import create_mission
from tests.daemon.onboard.service.flight_parts import Planted

pytestmark = pytest.mark.trust


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Planted]:
    made = Planted(tmp_path, monkeypatch)
    made.add("[watch]\nport = 0")
    made.write()
    yield made
    for close in made.closing:
        close()


@pytest.mark.parametrize(
    "command", [("check",), ("check", "--json"), ("run",), ("run", "--new-mission")]
)
def test_a_removed_mission_folder_is_named_with_cures_that_work(
    command: tuple[str, ...],
    planted: Planted,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    configuration, rig = load(planted.config)
    mission = create_mission(configuration, rig, planted.config)
    marker, aside = mission.root / CURRENT_FILE, planted.folder / "aside"
    mission.path.rename(aside)
    monkeypatch.setattr(sys, "argv", ["syntopic", *command, str(planted.config)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 1
    output = capsys.readouterr()
    assert output.err.splitlines() == [
        f"{marker}: names mission {mission.id}, and {mission.path} is no folder; put the folder "
        f"back to continue the mission, or remove {marker} to start without it"
    ]
    assert output.out == ""
    assert json.loads(marker.read_text())["mission"] == mission.id, "nothing was changed"
    # The first cure.
    shutil.copytree(aside, mission.path)
    assert interrupted_mission(configuration) == mission
    # The second one.
    shutil.rmtree(mission.path)
    marker.unlink()
    assert interrupted_mission(configuration) is None
    begun = create_mission(configuration, rig, planted.config)
    assert Mission.current(mission.root) == begun

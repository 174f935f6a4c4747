"""What is sent to support holds what helps, and neither pixels nor places nor secrets."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

from typer.testing import CliRunner

from daemon.cli import app
from daemon.disk.flight_log import FlightLog
from daemon.export.support_bundle import without_secrets, write_bundle
from tests.daemon.small_camera import fly, new_mission


def test_a_bundle_tells_what_happened_and_nothing_secret(tmp_path: Path) -> None:
    mission = new_mission(tmp_path)
    fly(mission, [1, 2])
    mission.service_path.chmod(0o640)
    mission.service_path.write_text('[watch]\ntokens = "t.toml"\nwifi_password = "hunter2"\n')
    log = FlightLog.create(mission.log_dir)
    log.append("event/SU00", 5, {"name": "lost", "sentence": "Look at its cable."})
    log.append("raw/gnss", 6, b"secret bytes of a receiver")
    log.append("navigation/gnss", 7, {"latitude_deg": 47.123456})
    log.close()
    bundle = write_bundle(mission)
    with zipfile.ZipFile(bundle.path) as opened:
        texts = {name: opened.read(name).decode() for name in opened.namelist()}
    assert sorted(texts) == sorted(bundle.contents)
    everything = "\n".join(texts.values())
    assert "Look at its cable." in texts["log.jsonl"]
    assert "hunter2" not in everything
    assert "secret bytes" not in everything
    assert "47.123456" not in everything
    records = [json.loads(line) for line in texts["exposures.jsonl"].splitlines()]
    assert [one["number"] for one in records] == [1, 2]
    assert "navigation" not in records[0]["record"]
    assert json.loads(texts["versions.json"])["packages"]["numpy"]
    for line in texts["log.jsonl"].splitlines():
        json.loads(line)


def test_values_that_sound_secret_are_left_out() -> None:
    text = 'api_token = "x"\nkey="y"\n  Password = 3\nport = 4\nkeyboard = "us"\n'
    left = without_secrets(text)
    assert '"x"' not in left
    assert '"y"' not in left
    assert "= 3" not in left
    assert "port = 4" in left


def test_the_command_writes_report_and_bundle(tmp_path: Path) -> None:
    mission = new_mission(tmp_path)
    fly(mission, [1])
    said = CliRunner().invoke(app, ["report", str(mission.path), "--bundle", "--json"])
    assert said.exit_code == 0, said.output
    told = json.loads(said.stdout)
    assert Path(told["report"]).exists()
    assert "verify.json" in told["contents"]

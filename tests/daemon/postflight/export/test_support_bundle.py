"""What is sent to support holds what helps, and neither pixels nor places nor secrets."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.log.flight_log import FlightLog
from daemon.postflight.export.redaction import without_secrets
from daemon.postflight.export.support_bundle import write_bundle
from tests.daemon.small_camera import fly, new_mission


def test_a_bundle_contains_what_happened_and_no_secret(tmp_path: Path) -> None:
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
    all_text = "\n".join(texts.values())
    assert "Look at its cable." in texts["log.jsonl"]
    assert "hunter2" not in all_text
    assert "secret bytes" not in all_text
    assert "47.123456" not in all_text
    records = [json.loads(line) for line in texts["exposures.jsonl"].splitlines()]
    assert [one["number"] for one in records] == [1, 2]
    assert "navigation" not in records[0]["record"]
    assert json.loads(texts["versions.json"])["packages"]["numpy"]
    for line in texts["log.jsonl"].splitlines():
        json.loads(line)


HIDDEN = "hunter2"
HIDING_PLACES = {
    "a plain key": 'wifi_password = "hunter2"',
    "a quoted key": '"wifi \\u0070assword" = "hunter2"',
    "a dotted key": 'a."b password".c = "hunter2"',
    "a key of a table's name": '[signing_key]\nvalue = "hunter2"',
    "an inline table": 'login = { user = "u", password = "hunter2" }',
    "a list of inline tables": 'logins = [{ user = "u" }, { secret = ["hunter2"] }]',
    "several lines": 'token = """\nfirst\nhunter2\n"""',
    "several lines in apostrophes": "token = '''\nhunter2\n'''",
    "a number": "pin_key = 1234\n",
    "the user of an address": 'port = "ntrip://me:hunter2@caster:2101/MOUNT"',
    "a parameter of an address": 'port = "tcp://host:1?speed=9&api_key=hunter2"',
    "a header": 'header = "Authorization: Bearer hunter2"',
    "a comment": "# the password is hunter2",
    "a private key": 'pem = """\n-----BEGIN A KEY-----\nhunter2\n-----END A KEY-----"""',
    "no TOML": 'password = "hunter2"\n= broken',
    "no UTF-8": b'password = "hunter2"\n\xff',
}


@pytest.mark.trust
@pytest.mark.parametrize("place", HIDING_PLACES)
def test_a_secret_is_left_out_of_the_bundle_wherever_the_configuration_hides_it(
    tmp_path: Path, place: str
) -> None:
    mission = new_mission(tmp_path)
    fly(mission, [1])
    mission.service_path.unlink()
    hidden = HIDING_PLACES[place]
    data = hidden if isinstance(hidden, bytes) else hidden.encode()
    mission.service_path.write_bytes(b'[trigger]\ndriver = "pulse-bus"\n' + data)
    with zipfile.ZipFile(write_bundle(mission).path) as opened:
        texts = {name: opened.read(name).decode() for name in opened.namelist()}
    assert not [name for name, text in texts.items() if HIDDEN in text]
    flown = json.loads(texts["service.json"])
    parses = not place.startswith("no ")
    assert ("driver" in json.dumps(flown)) == parses, "what helps is there, or nothing at all"


def test_secrets_in_events_and_records_are_left_out_too(tmp_path: Path) -> None:
    mission = new_mission(tmp_path)
    fly(mission, [1])
    log = FlightLog.create(mission.log_dir)
    log.append("event/gnss", 5, {"name": "x", "sentence": "ntrip://me:hunter2@caster refused"})
    log.append("audit", 6, {"login": {"api-token": "hunter2"}, "password": ["hunter2"]})
    log.close()
    with zipfile.ZipFile(write_bundle(mission).path) as opened:
        output = opened.read("log.jsonl").decode()
    assert HIDDEN not in output and "caster refused" in output
    for line in output.splitlines():
        json.loads(line)


def test_what_is_no_secret_stays() -> None:
    content = {"port": 4, "sensor": "SU00", "url": "tcp://10.0.0.5:3001", "list": [1, {"a": True}]}
    assert without_secrets(content) == content


def test_the_command_writes_report_and_bundle(tmp_path: Path) -> None:
    mission = new_mission(tmp_path)
    fly(mission, [1])
    result = CliRunner().invoke(app, ["report", str(mission.path), "--bundle", "--json"])
    assert result.exit_code == 0, result.output
    output = json.loads(result.stdout)
    assert Path(output["report"]).exists()
    assert "verify.json" in output["contents"]

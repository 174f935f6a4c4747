"""What options, addresses and sidecars of batch commands cannot mean is refused in a sentence."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from daemon.cli import app
from daemon.mission.canonical_json import RecordError, parse_record
from daemon.mission.layout import Mission
from daemon.mission.store.product_manifests import (
    MANIFESTS,
    committed_keys,
    duration_of,
    provenance_of,
)
from daemon.postflight.batch import capacity
from daemon.postflight.batch.executor import DataAbsentError
from daemon.postflight.batch.level2_work import Level2Work
from tests.daemon.diverging_camera import copied, flown_mission


@pytest.fixture(scope="module")
def processed(tmp_path_factory: pytest.TempPathFactory) -> Mission:
    mission = flown_mission(tmp_path_factory.mktemp("flown"), (1, 2))
    assert run("process", str(mission.path), "--processes", "0").exit_code == 0
    return mission


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


def sentence(done: Result) -> str:
    assert done.exit_code != 0
    return f"{done.output} {done.exception}"


@pytest.mark.parametrize("text", ["1e400", "-1e400", "[1e999]"])
def test_a_number_beyond_those_of_a_record_is_refused(text: str) -> None:
    with pytest.raises(RecordError, match="beyond the numbers of a record"):
        parse_record(f'{{"a": {text}}}'.encode(), "x")
    assert parse_record(b'{"a": 1.5e3}', "x") == {"a": 1500.0}


@pytest.mark.parametrize("duration", ["1e400", "-5", "1e300", "true", '"long"', "null"])
def test_a_duration_that_cannot_be_right_is_unknown(
    processed: Mission, tmp_path: Path, duration: str
) -> None:
    mission = copied(processed, tmp_path)
    for number in (1, 2):
        (key,) = committed_keys(mission, number)
        path = mission.path / MANIFESTS / f"L2/{number:06d}" / f"{key}.provenance.json"
        path.write_text(f'{{"duration_s": {duration}}}')
        assert duration_of(provenance_of(mission, number, key)) is None
    done = run("process", str(mission.path), "--processes", "0", "--json")
    content = json.loads(done.stdout, parse_constant=pytest.fail)
    assert [one["duration_s"] for one in content["exposures"]] == [0.0, 0.0]
    dry = run("process", str(mission.path), "--again", "--dry-run", "--json")
    assert json.loads(dry.stdout, parse_constant=pytest.fail)["expected_s"] is None


def test_a_folder_at_the_same_path_that_is_another_one_is_refused(
    processed: Mission, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    works: list[Level2Work] = []

    def noted(work: Level2Work) -> None:
        works.append(work)
        raise DataAbsentError("noted")

    monkeypatch.setattr(Level2Work, "open", noted)
    command = ("process", str(processed.path), "--processes", "0", "--again", "--only", "1")
    assert "noted" in sentence(run(*command))
    monkeypatch.undo()
    (work,) = works
    with pytest.raises(DataAbsentError, match="has another folder than the command at"):
        replace(work, mission=copied(processed, tmp_path).path).open()
    with pytest.raises(DataAbsentError, match=r"has no folder .*gone\. Mount that of the command"):
        replace(work, mission=tmp_path / "gone").open()
    work.open()


def test_a_dry_run_refuses_an_exposure_that_is_not_there(processed: Mission) -> None:
    done = run("process", str(processed.path), "--dry-run", "--only", "77", "--only", "1")
    assert f"--only 77: {processed.path} has no such exposure" in sentence(done)
    assert run("process", str(processed.path), "--dry-run", "--only", "1").exit_code == 0


@pytest.mark.parametrize("command", ["process", "pansharpen", "verify"])
@pytest.mark.parametrize("option", ["--tls-ca", "--tls-certificate", "--tls-key"])
def test_tls_options_without_a_scheduler_are_refused(
    processed: Mission, command: str, option: str
) -> None:
    done = run(command, str(processed.path), option, "x.pem")
    assert f"{option} is for a cluster; give its address" in sentence(done)


@pytest.mark.parametrize("command", ["process", "verify"])
def test_tls_options_with_an_address_without_tls_are_refused(
    processed: Mission, command: str
) -> None:
    address = "tcp://127.0.0.1:9"
    done = run(command, str(processed.path), "--scheduler", address, "--tls-ca", "ca.pem")
    assert f"--tls-ca has no effect on {address}" in sentence(done)
    worker = run("worker", address, "--tls-key", "key.pem")
    assert "give tls://127.0.0.1:9" in sentence(worker)


@pytest.mark.parametrize(
    "command",
    [
        ["pansharpen"], ["orient"], ["orthomosaic"], ["report"], ["triangulate"], ["repair"],
        ["export", "pictures"],
    ],
)  # fmt: skip
@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("s3://survey/2026", "s3://survey/2026: this command works on folders. Copy the mission"),
        ("file:///data/m", "file:///data/m: this command works on folders; give the path: /data/m"),
    ],
)
def test_an_address_in_the_place_of_a_folder_is_named_as_it_was_given(
    command: list[str], address: str, expected: str
) -> None:
    assert expected in sentence(run(*command, address))


def test_more_threads_than_cores_are_warned_of(
    processed: Mission, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capacity, "usable_cores", lambda: 2)
    for threads, is_warned in (("256", True), ("2", False)):
        done = run("process", str(processed.path), "--dry-run", "--threads", threads)
        assert done.exit_code == 0
        assert ("this machine has 2 cores" in done.stderr) is is_warned

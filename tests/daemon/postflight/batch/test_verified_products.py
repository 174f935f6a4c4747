"""`syntopic verify` compares every byte of committed products with their manifests."""

from __future__ import annotations

import json
import os
import threading
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.layout import Mission
from daemon.mission.store import product_manifests
from daemon.mission.store.product_manifests import (
    MANIFESTS,
    committed_keys,
    parse_manifest,
    read_manifest,
)
from daemon.mission.verification.verification import VerifyReport, verify
from tests.daemon.diverging_camera import copied, flown_mission

pytestmark = pytest.mark.trust


@pytest.fixture(scope="module")
def processed(tmp_path_factory: pytest.TempPathFactory) -> Mission:
    mission = flown_mission(tmp_path_factory.mktemp("flown"), (1, 2))
    process(mission)
    return mission


def process(mission: Mission, *options: str) -> None:
    done = CliRunner().invoke(app, ["process", str(mission.path), "--processes", "0", *options])
    assert done.exit_code == 0, done.output


def uncovered(report: VerifyReport) -> set[str]:
    return {name for one in report.not_covered for name in one.files}


def test_intact_products_are_covered_by_their_manifests(processed: Mission) -> None:
    report = verify(processed)
    assert report.problems == ()
    assert not [name for name in uncovered(report) if name.startswith("L2/")]
    products = [one for one in report.covered if one.what == "products"]
    assert [one.by for one in products] == [MANIFESTS]
    assert products[0].files == len(list(processed.level2_root.rglob("*.*")))


@pytest.mark.parametrize("name", ["LEFT.tif", "quality.json", "quicklook.jpg"])
def test_a_flipped_byte_of_the_same_size_is_named_with_the_remedy(
    processed: Mission, tmp_path: Path, name: str
) -> None:
    mission = copied(processed, tmp_path)
    path = mission.level2(1) / name
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    done = CliRunner().invoke(app, ["verify", str(mission.path), "--json"])
    assert done.exit_code == 1
    (problem,) = json.loads(done.stdout)["problems"]
    assert problem.startswith(f"L2/000001/{name}: differs from its manifest")
    assert "--again --only 1" in problem
    process(mission, "--again", "--only", "1")
    assert verify(mission).problems == ()


def test_missing_products_links_and_pipes_are_problems(processed: Mission, tmp_path: Path) -> None:
    mission = copied(processed, tmp_path)
    (mission.level2(1) / "LEFT.tif").unlink()
    for name, make in (("RIGHT.tif", lambda p: p.symlink_to("quality.json")), ("x", os.mkfifo)):
        path = mission.level2(2) / name
        path.unlink(missing_ok=True)
        make(path)
    (mission.level2(2) / "quicklook.jpg").unlink()
    os.mkfifo(mission.level2(2) / "quicklook.jpg")
    problems = "\n".join(verify(mission).problems)
    assert "L2/000001/LEFT.tif: cannot be read (No such file" in problems
    assert "L2/000002/RIGHT.tif: cannot be read" in problems
    assert "L2/000002/quicklook.jpg: cannot be read (is no plain file)" in problems


def test_a_damaged_manifest_is_a_problem(processed: Mission, tmp_path: Path) -> None:
    mission = copied(processed, tmp_path)
    (key,) = committed_keys(mission, 1)
    (mission.path / MANIFESTS / "L2/000001" / f"{key}.json").write_bytes(b"{}")
    (problem,) = verify(mission).problems
    assert problem.startswith(f"exposure 1: the manifest of key {key[:12]} is damaged")


def test_products_that_are_replaced_meanwhile_are_no_problem(
    processed: Mission, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mission = copied(processed, tmp_path)
    real, once = product_manifests.read_manifest, threading.Event()

    def replaced_after(mission: Mission, number: int, key: str) -> object:
        found = real(mission, number, key)
        if not once.is_set() and number == 1:
            once.set()
            process(mission, "--again", "--only", "1")
        return found

    monkeypatch.setattr(product_manifests, "read_manifest", replaced_after)
    (key,) = committed_keys(mission, 1)
    assert product_manifests.product_problems(mission, 1, key) == []
    assert once.is_set()


@pytest.mark.parametrize("name", ["../../x", "/etc/passwd", "..", "", "a/b", "a\0b"])
def test_a_manifest_with_a_name_outside_of_its_folder_is_refused(
    processed: Mission, name: str
) -> None:
    key, content = manifest_content(processed)
    content["files"][name] = {"nbytes": 1, "sha256": "0" * 64}
    assert parse_manifest(json.dumps(content).encode(), key) is None


@pytest.mark.parametrize("nbytes", ["1e400", "-1", "1.5", '"7"', "true", "null"])
def test_a_manifest_with_a_size_that_is_no_count_is_refused(
    processed: Mission, tmp_path: Path, nbytes: str
) -> None:
    key, content = manifest_content(processed)
    content["files"]["LEFT.tif"]["nbytes"] = 987654321
    data = json.dumps(content).replace("987654321", nbytes).encode()
    assert parse_manifest(data, key) is None
    mission = copied(processed, tmp_path)
    (mission.path / MANIFESTS / "L2/000001" / f"{key}.json").write_bytes(data)
    process(mission, "--dry-run")


def test_a_manifest_without_quality_report_is_refused(processed: Mission) -> None:
    key, content = manifest_content(processed)
    assert parse_manifest(json.dumps(content).encode(), key) is not None
    del content["files"]["quality.json"]
    assert parse_manifest(json.dumps(content).encode(), key) is None


def manifest_content(mission: Mission) -> tuple[str, dict]:
    (key,) = committed_keys(mission, 1)
    manifest = read_manifest(mission, 1, key)
    assert manifest is not None
    return key, manifest.as_json()

"""A mission in a bucket is processed there: same bytes, one commit, whatever requests meet."""

from __future__ import annotations

import json
import pickle
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import boto3
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.cli.process import as_flown
from daemon.configuration.model import ProcessingSection
from daemon.mission.layout import Mission
from daemon.mission.store.product_manifests import ProductFile, committed_keys, read_manifest
from daemon.mission.transfer import store_products
from daemon.mission.transfer.object_store import (
    ObjectStore,
    ObjectStoreError,
    ObjectStoreUnavailableError,
)
from daemon.mission.transfer.store_mission import open_stored
from daemon.mission.transfer.store_products import (
    commit_stored,
    is_stored,
    list_products,
    manifest_name,
    product_folder,
    publish_stored,
    read_stored_manifest,
)
from daemon.mission.transfer.store_transfer import transfer_to_store
from daemon.mission.transfer.store_verification import verify_in_store
from daemon.planning.overlaps import overlaps_of
from daemon.postflight.batch import software_identity
from daemon.postflight.batch.level2_sources import level2_source
from daemon.postflight.batch.level2_work import Level2Work
from tests.daemon.diverging_camera import ROOT, SERVICE_TOML, copied, flown_mission
from tests.daemon.mission.stores.faulty_s3 import BUCKET, REGION, Faults

pytestmark = [pytest.mark.peer, pytest.mark.trust]
KEY, OTHER_KEY = "a" * 64, "b" * 64


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Mission:
    return flown_mission(tmp_path_factory.mktemp("flown"))


@pytest.fixture(scope="module")
def processed(flown: Mission, tmp_path_factory: pytest.TempPathFactory) -> Mission:
    """The same mission processed in a folder."""
    mission = copied(flown, tmp_path_factory.mktemp("processed"))
    process(str(mission.path))
    return mission


def process(place: str, *options: str, status: int = 0) -> dict[str, Any]:
    options = options if "--processes" in options else ("--processes", "0", *options)
    done = CliRunner().invoke(app, ["process", place, "--json", *options])
    assert done.exit_code == status, (done.output, done.exception)
    return json.loads(done.stdout)


def uploaded(mission: Mission, url: str) -> ObjectStore:
    transfer_to_store(mission, ObjectStore(url))
    return ObjectStore(f"{url}/{mission.id}")


def change(place: ObjectStore, name: str, data: bytes | None) -> None:
    """Replace or remove an object behind the back of everything."""
    client, key = boto3.client("s3", region_name=REGION), f"missions/{place.url[-200:]}"
    key = f"{place.url.removeprefix(f's3://{BUCKET}/')}/{name}"
    if data is None:
        client.delete_object(Bucket=BUCKET, Key=key)
    else:
        client.put_object(Bucket=BUCKET, Key=key, Body=data)


def compared(place: ObjectStore) -> dict[int, str]:
    """Hash of each committed product set; every byte is compared with its manifest."""
    assert verify_in_store(place).problems == ()
    found = {}
    for number, key in list_products(place).committed():
        assert number not in found
        manifest = read_stored_manifest(place, number, key)
        assert manifest is not None
        found[number] = manifest.compared_sha256
    return found


def compared_in_folder(mission: Mission) -> dict[int, str]:
    found = {}
    for number in mission.numbers():
        (key,) = committed_keys(mission, number)
        manifest = read_manifest(mission, number, key)
        assert manifest is not None
        found[number] = manifest.compared_sha256
    return found


def test_products_in_a_store_have_the_keys_and_bytes_of_those_in_a_folder(
    flown: Mission, processed: Mission, store: Callable[..., str]
) -> None:
    place = uploaded(flown, store())
    output = process(place.url)
    assert (output["done"], output["failures"]) == (4, [])
    assert compared(place) == compared_in_folder(processed)
    for number, key in list_products(place).committed():
        assert committed_keys(processed, number) == [key]
        pixels = b"".join(place.blocks(place.find(f"{product_folder(number, key)}/LEFT.tif")))
        assert pixels == (processed.level2(number) / "LEFT.tif").read_bytes()
    again = process(place.url)
    assert (again["complete_before"], again["done"]) == (4, 0)
    assert [one["exposure"] for one in again["exposures"]] == [1, 2, 3, 4]
    assert all(one["duration_s"] > 0 and one["timings_s"] for one in again["exposures"])
    dry = process(place.url, "--dry-run", "--again")
    assert dry["pending"] == [1, 2, 3, 4] and dry["expected_s"] > 0
    # A later run of the transfer leaves the products alone.
    assert transfer_to_store(flown, ObjectStore(place.url.rpartition("/")[0])).copied == 0
    assert len(compared(place)) == 4


def test_worker_processes_without_room_on_their_disk_process_a_mission_of_a_store(
    flown: Mission, processed: Mission, store: Callable[..., str]
) -> None:
    place = uploaded(flown, store())
    output = process(place.url, "--processes", "2", "--threads", "1")
    assert output["executor"] == "2 processes" and output["failures"] == []
    assert compared(place) == compared_in_folder(processed)


@pytest.mark.parametrize("seed", [3, 4])
def test_one_request_of_six_fails_and_the_products_are_the_same(
    flown: Mission, processed: Mission, store: Callable[..., str], seed: int
) -> None:
    faults = Faults(seed=seed)
    place = uploaded(flown, store(faults))
    faults.shares = {"500": 0.04, "503": 0.04, "lost answer": 0.05, "truncated": 0.05}
    output = process(place.url)
    # Which requests meet which fault depends on the order in which threads send them.
    assert sum(faults.counts.values()) > 10 and len(faults.counts) >= 3
    faults.shares = {}
    assert output["failures"] == []
    assert compared(place) == compared_in_folder(processed)


@pytest.mark.parametrize(
    ("name", "data", "cause"),
    [
        ("L0/000002/LEFT.tif", b"short", "has 5 bytes"),
        ("L0/000002/LEFT.tif", None, "is missing"),
        ("L0/000002/LEFT.tif", "swapped", "is of head S-RIGHT|altered after it was stored"),
    ],
)
def test_a_frame_that_is_not_the_transferred_one_is_listed_and_the_others_are_done(
    flown: Mission, store: Callable[..., str], name: str, data: Any, cause: str
) -> None:
    place = uploaded(flown, store())
    if data == "swapped":
        data = (flown.level0(2) / "RIGHT.tif").read_bytes()
    change(place, name, data)
    output = process(place.url, status=1)
    (failure,) = output["failures"]
    assert failure["exposure"] == 2 and output["done"] == 3
    assert any(text in failure["cause"] for text in cause.split("|")), failure
    assert sorted(number for number, _ in list_products(place).committed()) == [1, 3, 4]


@pytest.mark.parametrize("name", ["L0/000002/exposure.json", "rig.toml", "service.toml"])
def test_a_record_or_calibration_that_was_changed_in_the_store_is_refused(
    flown: Mission, store: Callable[..., str], name: str
) -> None:
    place = uploaded(flown, store())
    data = (flown.path / name).read_bytes()
    change(place, name, data.replace(b"0", b"1", 1))
    done = CliRunner().invoke(app, ["process", place.url, "--processes", "0"])
    assert isinstance(done.exception, ObjectStoreError) or done.exit_code
    assert f"{name} was changed: another hash" in f"{done.output} {done.exception}"
    assert not list(list_products(place).committed())


def test_what_is_not_complete_in_a_store_is_computed_again(
    flown: Mission, processed: Mission, store: Callable[..., str]
) -> None:
    place = uploaded(flown, store())
    process(place.url)
    keys = dict(list_products(place).committed())
    change(place, f"{product_folder(1, keys[1])}/LEFT.tif", b"half")
    change(place, f"{product_folder(2, keys[2])}/quality.json", None)
    change(place, manifest_name(3, keys[3]), None)
    other = b"".join(place.blocks(place.find(manifest_name(1, keys[1]))))
    change(place, manifest_name(4, keys[4]), other)  # of another exposure, and another key
    assert verify_in_store(place).problems
    output = process(place.url, status=1)
    assert output["complete_before"] == 0 and output["done"] == 3
    (failure,) = output["failures"]
    assert failure["exposure"] == 4 and "is there with another content" in failure["cause"]
    change(place, manifest_name(4, keys[4]), None)
    assert process(place.url)["done"] == 1
    assert compared(place) == compared_in_folder(processed)


def test_other_settings_have_other_keys_and_neither_replaces_the_other(
    flown: Mission, store: Callable[..., str]
) -> None:
    place = uploaded(flown, store())
    process(place.url, "--only", "1")
    process(place.url, "--only", "1", "--interpolation", "bilinear")
    keys = [key for _, key in list_products(place).committed()]
    assert len(set(keys)) == 2
    assert process(place.url, "--only", "1")["complete_before"] == 1
    assert verify_in_store(place).problems == ()


def test_a_catalog_of_a_bucket_has_the_verdicts_of_products_computed_there(
    flown: Mission, processed: Mission, store: Callable[..., str], tmp_path: Path
) -> None:
    pytest.importorskip("geopandas", reason="pip install 'syntopic[catalog]'")
    from daemon.postflight.mission_catalog.mission_sources import missions_at

    place = uploaded(flown, store())
    process(place.url, "--only", "2")
    process(place.url, "--only", "2", "--interpolation", "bilinear")
    with missions_at(place.url.rpartition("/")[0]) as found:
        ((mission, address),) = found
        assert address == place.url
        assert [path.parent.name for path in mission.path.glob("L2/*/quality.json")] == ["000002"]
        report = json.loads((mission.level2(2) / "quality.json").read_bytes())
    flags = json.loads((processed.level2(2) / "quality.json").read_bytes())["flags"]
    assert report["flags"] == flags


def test_a_worker_of_another_version_publishes_nothing(
    flown: Mission, store: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    place = uploaded(flown, store())
    process(place.url, "--only", "1")
    before = set(list_products(place).committed())
    older = {**software_identity.software_identity(), "software": "0.0.1"}
    monkeypatch.setattr(software_identity, "software_identity", lambda: older)
    assert process(place.url, "--dry-run")["pending"] == [1, 2, 3, 4]  # other code, another key
    done = CliRunner().invoke(app, ["process", place.url, "--processes", "0"])
    assert done.exit_code and "instead of 0.0.1" in f"{done.output} {done.exception}"
    assert set(list_products(place).committed()) == before


@pytest.mark.soak
def test_two_runs_at_once_one_of_them_killed_leave_every_product_set_committed_once(
    store: Callable[..., str], tmp_path: Path
) -> None:
    numbers = list(range(1, 41))
    mission = flown_mission(tmp_path / "flown", numbers)
    faults = Faults()
    place = uploaded(mission, store(faults))
    command = [sys.executable, "-m", "daemon", "process", place.url, "--json"]
    runs = [
        subprocess.Popen([*command, "--processes", count], cwd=ROOT, stdout=subprocess.PIPE)
        for count in ("0", "2")
    ]
    limit = time.monotonic() + 300
    while len(list(list_products(place).committed())) < 5:
        assert time.monotonic() < limit and all(run.poll() is None for run in runs)
        time.sleep(0.05)
    runs[1].kill()
    output = json.loads(runs[0].communicate(timeout=300)[0])
    runs[1].communicate(timeout=60)
    assert output["failures"] == [] and runs[0].returncode == 0
    found = compared(place)
    assert sorted(found) == numbers
    process(str(mission.path))
    assert found == compared_in_folder(mission)


def test_of_two_writers_of_a_key_one_commits(store: Callable[..., str]) -> None:
    place = ObjectStore(store())
    contents = {"a.tif": [b"pixels"], "quality.json": [b'{"exposure":1,"duration_s":2.5}']}
    slower = {**contents, "quality.json": [b'{"exposure":1,"duration_s":9.0}']}
    first, durations = publish_stored(place, 1, KEY, contents)
    second, _ = publish_stored(place, 1, KEY, slower)
    assert first == second and durations == {"duration_s": 2.5}
    assert commit_stored(place, 1, first, {"host": "one"}) is True
    assert commit_stored(place, 1, second, {"host": "two"}) is False
    assert store_products.stored_provenance(place, 1, KEY)["host"] == "one"
    assert is_stored(place, 1, KEY) and not is_stored(place, 1, OTHER_KEY)
    # Between the look and the put of the second one the first one commits.
    wrong = replace(first, files={**first.files, "b": ProductFile(1, "0" * 64)})
    with pytest.raises(ObjectStoreError, match="another content"):
        commit_stored(place, 1, wrong, {})
    assert read_stored_manifest(place, 1, KEY) == first


def test_an_answer_lost_after_the_commit_is_no_error(store: Callable[..., str]) -> None:
    faults = Faults()
    place = ObjectStore(store(faults))
    manifest, _ = publish_stored(place, 1, KEY, {"quality.json": [b"{}"]})
    lost: list[str] = []

    def is_first(method: str, path: str) -> bool:
        is_commit = method == "PUT" and path.endswith(f"{KEY}.json") and not lost
        lost.extend([path] if is_commit else [])
        return is_commit

    faults.shares, faults.is_for = {"lost answer": 1.0}, is_first
    commit_stored(place, 1, manifest, {})
    assert len(lost) == 1 and is_stored(place, 1, KEY)


def test_a_store_that_is_away_is_tried_again_by_the_run() -> None:
    error = pickle.loads(pickle.dumps(ObjectStoreUnavailableError("the store is away")))
    assert type(error) is ObjectStoreUnavailableError and str(error) == "the store is away"
    assert isinstance(error, ConnectionError) and isinstance(error, ObjectStoreError)


def test_half_a_product_set_is_not_committed(
    store: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    place = ObjectStore(store())
    monkeypatch.setattr(ObjectStore, "put", lambda *_arguments: None)
    with pytest.raises(ObjectStoreError, match="does not hold what was written"):
        publish_stored(place, 1, KEY, {"quality.json": [b"{}"]})


def test_a_mission_that_is_not_all_there_is_refused(
    flown: Mission, store: Callable[..., str]
) -> None:
    place = uploaded(flown, store())
    with pytest.raises(ObjectStoreError, match="no mission that a transfer wrote"):
        open_stored(place.url.rpartition("/")[0])
    content = json.loads(place.read_small("transfer.json") or b"")
    change(place, "transfer.json", json.dumps({**content, "state": "copying"}).encode())
    with pytest.raises(ObjectStoreError, match="the transfer is not complete"):
        open_stored(place.url)
    hostile = {"../../x": {"nbytes": 1, "sha256": "0" * 64}}
    change(place, "transfer.json", json.dumps({**content, "files": hostile}).encode())
    with pytest.raises(Exception, match="is damaged"):
        open_stored(place.url)


def test_an_exposure_that_is_not_there_is_listed(flown: Mission, store: Callable[..., str]) -> None:
    place = uploaded(flown, store())
    (failure,) = process(place.url, "--only", "99", status=1)["failures"]
    assert "has no exposure 99" in failure["cause"]


def test_a_worker_takes_the_height_model_of_the_mission_it_fetched(
    store: Callable[..., str], tmp_path: Path
) -> None:
    service = SERVICE_TOML + b'elevation = "dem.asc"\nelevation_crs = "EPSG:25832"\n'
    mission = flown_mission(tmp_path / "flown", (1, 2), service)
    heights = "\n".join(["120 120 120 120"] * 4)
    grid = f"ncols 4\nnrows 4\nxllcorner 600000\nyllcorner 5280000\ncellsize 25000\n{heights}\n"
    (mission.path / "dem.asc").write_text(grid)
    place = uploaded(mission, store())
    with level2_source(place.url) as source:
        plan, radiometry = as_flown(source.mission, None)
        local = Level2Work(
            source.mission.path, None, ProcessingSection(threads=1), plan, radiometry,
            software_identity.software_identity(),
        )  # fmt: skip
        work = source.placed(local)
        found = source.survey(work, [1], overlaps_of(source.mission, local.rig))
    assert not plan.elevation.exists()  # the command's own folder is gone, as on another machine
    work.open()(found.pending[0])
    assert [number for number, _ in list_products(place).committed()] == [1]
    process(str(mission.path))
    assert compared(place)[1] == compared_in_folder(mission)[1]


def test_no_frame_is_ever_written_to_a_disk(
    flown: Mission, store: Callable[..., str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    place = uploaded(flown, store())
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    blocks: list[int] = []
    removed: list[str] = []
    real = shutil.rmtree

    def looked(path: Any, *arguments: Any, **options: Any) -> None:
        removed.append(Path(path).name)
        found = Path(path).rglob("*.tif")
        blocks.extend(one.stat().st_blocks for one in found)
        real(path, *arguments, **options)

    monkeypatch.setattr(shutil, "rmtree", looked)
    process(place.url)
    assert len(blocks) >= 8 and not any(blocks)
    assert {f"{number:06d}" for number in flown.numbers()} <= set(removed)  # one after the other
    assert not list(tmp_path.glob("*"))


def test_each_frame_is_read_once(flown: Mission, store: Callable[..., str]) -> None:
    faults, reads = Faults(), list[str]()
    place = uploaded(flown, store(faults))

    def note(method: str, path: str) -> bool:
        if method == "GET" and path.endswith(".tif") and "/L0/" in path:
            reads.append(path.rpartition("/L0/")[2])
        return False

    faults.is_for = note
    assert process(place.url)["done"] == 4
    heads = ("LEFT", "RIGHT")
    assert sorted(reads) == [f"{n:06d}/{head}.tif" for n in flown.numbers() for head in heads]

"""A mission in Google Cloud Storage, over the XML API, with requests that fail."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.transfer.object_store import ObjectStore, ObjectStoreError
from daemon.mission.transfer.store_products import commit_stored, is_stored, publish_stored
from daemon.mission.transfer.store_transfer import transfer_to_store
from daemon.mission.transfer.store_verification import verify_in_store
from tests.daemon.diverging_camera import flown_mission
from tests.daemon.mission.stores.faulty_s3 import Faults
from tests.daemon.mission.stores.gcs_server import GcsBucket, serving_gcs

pytestmark = pytest.mark.trust

PLACE = "gs://survey/missions"


@pytest.fixture
def bucket() -> GcsBucket:
    return GcsBucket("survey")


@pytest.fixture
def faults() -> Faults:
    return Faults()


@pytest.fixture
def place(bucket: GcsBucket, faults: Faults, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Address of a folder in the bucket."""
    pytest.importorskip("obstore", reason="pip install 'syntopic[stores]'")
    pytest.importorskip("moto.server")
    with serving_gcs(bucket, faults) as endpoint:
        account = {
            "gcs_base_url": endpoint, "disable_oauth": True, "client_email": "",
            "private_key": "", "private_key_id": "",
        }  # fmt: skip
        monkeypatch.setenv("GOOGLE_SERVICE_ACCOUNT_KEY", json.dumps(account))
        monkeypatch.setenv("GOOGLE_ALLOW_HTTP", "true")
        yield PLACE


def test_a_mission_is_copied_verified_and_processed_in_a_bucket(
    place: str, bucket: GcsBucket, faults: Faults, tmp_path: Path
) -> None:
    faults.kinds, faults.every = ("500", "503", "lost answer", "truncated"), 15
    mission = flown_mission(tmp_path / "flown", (1, 2))
    (mission.export_dir / "large.bin").write_bytes(bytes(range(256)) * 65_000)
    report = transfer_to_store(mission, ObjectStore(place))
    stored = ObjectStore(report.target)
    assert verify_in_store(stored).problems == ()
    assert transfer_to_store(mission, ObjectStore(place)).copied == 0
    done = CliRunner().invoke(app, ["process", stored.url, "--processes", "0", "--json"])
    assert done.exit_code == 0, (done.output, done.exception)
    assert json.loads(done.stdout)["done"] == 2
    assert verify_in_store(stored).problems == ()
    again = CliRunner().invoke(app, ["process", stored.url, "--processes", "0", "--json"])
    assert json.loads(again.stdout)["complete_before"] == 2
    assert not bucket.uploads and faults.largest <= 16_000_000
    assert {"500", "503", "lost answer"} <= faults.counts.keys()


def test_of_many_writers_of_a_key_one_commits_in_a_bucket(place: str, faults: Faults) -> None:
    faults.kinds, faults.every = ("500",), 7
    stored, key = ObjectStore(f"{place}/m"), "a" * 64
    manifest, _ = publish_stored(stored, 1, key, {"quality.json": [b"{}"]})
    with ThreadPoolExecutor(8) as pool:
        committed = list(
            pool.map(lambda n: commit_stored(stored, 1, manifest, {"host": str(n)}), range(8))
        )
    assert committed.count(True) == 1 and is_stored(stored, 1, key)
    assert stored.create_small("x", b"one") is True
    assert stored.create_small("x", b"one") is False
    with pytest.raises(ObjectStoreError, match="another content"):
        stored.create_small("x", b"two")


def test_a_list_has_all_its_pages_and_a_removed_object_is_gone(
    place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daemon.mission.transfer.object_store.READ_ATTEMPTS", 1)
    stored = ObjectStore(place)
    names = [f"L0/{n:06d}/a & b.txt" for n in range(12)]
    for name in names:
        stored.replace_small(name, name.encode())
    assert [one.name for one in stored.list_objects("L0")] == names
    stored.delete(names[3])
    assert stored.find(names[3]) is None and len(stored.list_objects()) == 11
    with pytest.raises(ObjectStoreError):
        ObjectStore("gs://another/missions").list_objects()
